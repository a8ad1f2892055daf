"""A machine of a pool: it fetches a bundle, has it computed by a worker as a rig has, and brings the result back."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import structlog
from distributed import Worker as DaskWorker
from distributed import WorkerPlugin, get_worker

from slrig.compute.store import PoolError, PoolStore
from slrig.errors import ScanCancelledError, WorkerLostError
from slrig.failure import JobFailure, job_failure
from slrig.jobs.compute import Compute
from slrig.jobs.data_folder import BUNDLE, RESULT
from slrig.jobs.versions import versions
from slrig.jobs.worker_process import Task

BEAT_S = 2.0
"""How often a machine says that it works at a job, and looks whether it is to stop."""

TELL_S = 0.2
"""How often a stage's progress is told at most: each time passes through this machine, the scheduler and the rig."""

POOL_FAULT = "pool"
"""The code of a fault that is not the task's own: another try may go well."""

Tell = Callable[[Mapping[str, Any]], None]

_VERSIONS = Task(versions, what="statement of versions")

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PoolRequest:
    """A task for a pool. bundle : its key in the store. task : its files are the rig's, see `Task.movable`.
    topic : of dask's events, where its progress is told. versions : of the rig; others must not compute it.
    """

    job: str
    bundle: str
    task: Task
    topic: str
    versions: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PoolResponse:
    """What came of an order: the task's result, and the hash of each file in the store by its name; or a fault."""

    result: Any = None
    files: Mapping[str, str] = field(default_factory=dict)
    fault: JobFailure | None = None


def resource(found: Mapping[str, str]) -> str:
    """The name that dask knows machines of these versions by: only they are given what asks for it."""
    return f"slrig-{hashlib.sha256(json.dumps(dict(found), sort_keys=True).encode()).hexdigest()[:16]}"


class Host(WorkerPlugin):
    """Does orders with `worker`. clock : seconds that only grow."""

    name = "slrig"

    def __init__(self, store: PoolStore, worker: Compute, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._left = False
        self._store = store
        self._worker = worker
        self._clock = clock

    def teardown(self, worker: DaskWorker) -> None:  # noqa: ARG002 - dask's own signature
        """Drop what is computed: the pool is left, and dask gives it to another one. See `WorkerPlugin`."""
        self._left = True

    def done(self, order: PoolRequest, tell: Tell) -> PoolResponse:
        """Do an order. tell : takes progress, and signs of life. Whatever goes wrong is in the answer."""
        beaten_s, looked_s, stop = self._clock(), self._clock(), False

        def beat() -> None:
            nonlocal beaten_s
            if self._clock() - beaten_s >= BEAT_S:
                beaten_s = self._clock()
                tell({"job": order.job})

        def stopped() -> bool:
            nonlocal looked_s, stop
            beat()
            if not stop and self._clock() - looked_s >= BEAT_S:
                looked_s = self._clock()
                try:
                    stop = self._store.stopped(order.job)
                except PoolError as error:
                    _log.warning("whether a job is to stop could not be found out", cause=str(error))
            return stop or self._left

        tell({"job": order.job})
        _log.info("computes for a rig", job=order.job, what=order.task.what)
        try:
            return self._computed(order, tell, beat, stopped)
        except (PoolError, WorkerLostError) as error:
            # A process that is lost, as where memory runs out, is the machine's fault rather than the task's.
            return PoolResponse(fault=JobFailure(POOL_FAULT, str(error)))
        except BaseException as error:  # noqa: BLE001 - a panic of obstore, too: the rig is told, and computes by itself
            if not isinstance(error, ScanCancelledError):
                _log.warning("an order came to nothing", job=order.job, cause=repr(error))
            return PoolResponse(fault=job_failure(error))

    def _computed(
        self, order: PoolRequest, tell: Tell, beat: Callable[[], None], stopped: Callable[[], bool]
    ) -> PoolResponse:
        # Of the process that computes: after an update of the files beneath, it is newer than this one.
        mine = self._worker.run(_VERSIONS, cancelled=stopped)
        if mine != order.versions:
            message = "the machine's versions of slrig and its libraries have changed; start slrig worker again"
            raise PoolError(message)
        with tempfile.TemporaryDirectory(prefix="slrig-pool-") as scratch:
            last, told_s = "", 0.0

            def progress(stage: str, fraction: float, detail: str) -> None:
                nonlocal last, told_s
                if stage == last and self._clock() - told_s < TELL_S:
                    return
                last, told_s = stage, self._clock()
                told = detail.replace(f"{scratch}/", "")
                tell({"job": order.job, "stage": stage, "fraction": fraction, "detail": told})

            bundle, result = Path(scratch) / BUNDLE, Path(scratch) / RESULT
            self._store.fetch_bundle(order.bundle, bundle, beat)
            files = None if order.task.files is None else replace(order.task.files, folder=Path(scratch), place=None)
            task = replace(order.task, files=files, where={"where": "pool"}, remedy="Its rig computes by itself.")
            # While the next file is made, the last one travels.
            line, sent = ThreadPoolExecutor(1, thread_name_prefix="slrig-store"), dict[str, Future[str]]()

            def made(name: str) -> None:
                sent[name] = line.submit(self._store.put_result, order.job, result / name, beat)

            try:
                answer = self._worker.run(task, progress=progress, cancelled=stopped, made=made)
                # A task that makes no file makes no folder.
                for path in result.glob("*"):
                    if path.name not in sent:
                        made(path.name)
                return PoolResponse(answer, {name: sent[name].result() for name in sorted(sent)})
            finally:
                line.shutdown(cancel_futures=True)


def compute(order: PoolRequest) -> PoolResponse:
    """Do an order on the machine that dask chose: what a rig submits."""
    worker = get_worker()
    host: Any = worker.plugins[Host.name]
    answer: PoolResponse = host.done(order, lambda told: worker.log_event(order.topic, dict(told)))
    return answer
