"""A worker that has bundles reconstructed by a pool, and by this machine's own process whenever that fails.

What is on record, and in staging, is the rig's: a pool only ever gives files back, and an answer that comes late
belongs to nobody. So each scan has one result, whatever is lost in the middle.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from uuid import uuid4

import structlog

from slrig.compute.cluster import Cluster, DaskCluster
from slrig.compute.host import POOL_FAULT, PoolRequest, PoolResponse
from slrig.compute.security import pool_security
from slrig.compute.store import PoolError, PoolStore, open_store
from slrig.config import ServiceSettings
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ScanCancelledError, StorageError
from slrig.jobs.compute import Compute
from slrig.jobs.data_folder import BUNDLE, RESULT
from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.versions import versions
from slrig.jobs.worker import Worker
from slrig.jobs.worker_process import Task
from slrig.jobs.worker_wait import POLL_S, Made, Told
from slrig.model import Region

TRIES = 2
"""How often a job is given to the pool. One machine that is lost costs none: dask gives its job to another one."""

BEGIN_LIMIT_S = 30.0
"""A job that has not begun so long is withdrawn: others are before it, and this machine takes it 2 to 9 s."""

SILENCE_LIMIT_S = 20.0
"""So long after the last sign of life the machine, or the way to it, is taken for lost. It gives one every 2 s."""

TRANSFER_LIMIT_S = 120.0
"""The longest that a bundle or a result may take to or from the store: 0.5 GB at 40 Mbit/s."""

RETURN_LIMIT_S = 5.0
"""How long a pool that lost a job is waited for: a scheduler that is started again is back in two."""

WAITING = "waiting for the pool"

_log = structlog.get_logger(__name__)


class PooledWorker:
    """`local` is this machine's own process, which does all that is not reconstruction. clock : seconds that grow."""

    def __init__(
        self, local: Compute, cluster: Cluster, store: PoolStore, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._local = local
        self._cluster = cluster
        self._store = store
        self._clock = clock
        self._closed = False
        # Nobody waits for the store to be tidied.
        self._tidying = ThreadPoolExecutor(1, thread_name_prefix="slrig-store")

    @property
    def condition(self) -> str:
        """Of this machine's own process: without it nothing is certain to be computed."""
        return self._local.condition

    @property
    def loading(self) -> bool:
        """See `Compute`."""
        return self._local.loading

    def start(self) -> None:
        """See `Compute`."""
        self._local.start()
        self._cluster.start()

    def feed(self, region: Region | None = None) -> FrameFeed:
        """See `Compute`. While the pool can be used frames go nowhere: it is brought the bundle."""
        if not self._cluster.usable():
            return self._local.feed(region)
        feed = FrameFeed(lambda _: False)
        feed.abandon()
        return feed

    def run(
        self,
        task: Task,
        *,
        progress: Told = lambda *_: None,
        cancelled: Callable[[], bool] = lambda: False,
        made: Made = lambda _: None,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """See `Compute`. Raises what the local process raises, and nothing else."""
        if task.movable:
            try:
                if feed is not None and feed.receiver is not None:
                    # Frames that the local process has taken already are half of its work.
                    raise PoolError(f"{self._cluster.fault} when the frames came")  # noqa: TRY301
                return self._by_pool(task, progress, cancelled, made)
            except (PoolError, StorageError) as error:
                if not self._closed:
                    _log.warning("a job is computed by this machine", job=task.what, cause=str(error))
                task = replace(task, where={"where": "local", "because": str(error)})
        return self._local.run(task, progress=progress, cancelled=cancelled, made=made, feed=feed, within_s=within_s)

    def close(self) -> None:
        """See `Compute`."""
        self._closed = True
        self._local.close()
        self._cluster.close()
        self._tidying.shutdown(wait=False, cancel_futures=True)

    def _by_pool(self, task: Task, progress: Told, cancelled: Callable[[], bool], made: Made) -> Any:
        if not self._cluster.usable():
            raise PoolError(self._cluster.fault)
        if task.files is None:
            raise PoolError("the task has no bundle")
        bundle, result, key = task.files.folder / BUNDLE, task.files.folder / RESULT, None
        with storage_errors(result):
            result.mkdir(exist_ok=True)
        try:
            for left in reversed(range(TRIES)):
                try:
                    progress(WAITING, 0.0, "")
                    key = self._store.put_bundle(bundle, self._check(task, cancelled))
                    return self._tried(task, key, result, progress, cancelled, made)
                except PoolError as error:
                    if error.final or not left or self._closed or not self._cluster.usable(RETURN_LIMIT_S):
                        raise
                    _log.warning("a job is given to the pool again", job=task.what, cause=str(error))
        finally:
            if key is not None:
                self._tidy(partial(self._store.clear, bundle=key))

    def _tried(
        self, task: Task, key: str, result: Path, progress: Told, cancelled: Callable[[], bool], made: Made
    ) -> Any:
        job = uuid4().hex
        order = PoolRequest(job, key, task, self._cluster.topic, versions())
        told: SimpleQueue[Mapping[str, Any]] = SimpleQueue()
        coming, answer = self._cluster.submit(order, told.put), None
        try:
            answer = self._answer(task, coming, told, progress, cancelled)
            if answer.fault is not None:
                raise PoolError(answer.fault.message, final=answer.fault.code != POOL_FAULT)
            for name in self._store.fetch_result(job, answer.files, result, self._check(task, cancelled)):
                made(name)
            return answer.result
        finally:
            coming.cancel()
            # Without an answer a machine may be at it still.
            self._tidy(partial(self._store.stop if answer is None else self._store.clear, job=job))

    def _answer(
        self,
        task: Task,
        coming: Future[PoolResponse],
        told: SimpleQueue[Mapping[str, Any]],
        progress: Told,
        cancelled: Callable[[], bool],
    ) -> PoolResponse:
        heard_s, begun = self._clock(), False
        while True:
            answer = None
            try:
                answer = coming.result(POLL_S)
            except TimeoutError:
                pass
            except CancelledError as error:
                message = "the pool lost the job: its scheduler is gone"
                raise PoolError(message) from error
            while not told.empty():
                heard, heard_s, begun = told.get(), self._clock(), True
                if "stage" in heard:
                    progress(heard["stage"], heard["fraction"], heard["detail"])
            if answer is not None:
                return answer
            self._stay(task, cancelled)
            if self._clock() - heard_s > (SILENCE_LIMIT_S if begun else BEGIN_LIMIT_S):
                silence = "nothing more was heard of the job" if begun else "the job has not begun"
                message = f"{silence} in the pool for {self._clock() - heard_s:.0f} s"
                # In a pool that has too much to do, a second try would wait behind all others once more.
                raise PoolError(message, final=not begun)

    def _stay(self, task: Task, cancelled: Callable[[], bool]) -> None:
        """Raise what ends the wait for the pool."""
        if cancelled():
            message = f"The {task.what} was cancelled."
            raise ScanCancelledError(message)
        if self._closed:
            message = "the service ends"
            raise PoolError(message)

    def _check(self, task: Task, cancelled: Callable[[], bool]) -> Callable[[], None]:
        """What ends a transfer to or from the store that begins now."""
        until_s = self._clock() + TRANSFER_LIMIT_S

        def check() -> None:
            self._stay(task, cancelled)
            if self._clock() > until_s:
                message = f"the store {self._store.address} took longer than {TRANSFER_LIMIT_S:.0f} s"
                raise PoolError(message)

        return check

    def _tidy(self, tidied: Callable[[], None]) -> None:
        """Have something done in the store by and by. What stays there when that fails is for the store to expire."""

        def tidy() -> None:
            try:
                tidied()
            except PoolError as error:
                _log.info("something was left in the pool's store", cause=str(error))

        with suppress(RuntimeError):  # the service ends
            self._tidying.submit(tidy)


def pooled(settings: ServiceSettings, local: Worker) -> PooledWorker:
    """The worker of a service whose settings name a pool. Raises ConfigError."""
    if settings.compute is None or settings.compute_store is None:
        message = "compute: a pool needs a store as well, compute_store. Set both, or neither."
        raise ConfigError(message)
    security = pool_security(settings.compute, settings.compute_certificates)
    store = open_store(settings.compute_store, settings.compute_login_file)
    return PooledWorker(local, DaskCluster(settings.compute, security), store)
