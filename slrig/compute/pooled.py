"""A worker that has bundles reconstructed by a pool over TLS, and by this machine's own process whenever that fails.

Records and staging folders are the rig's: a pool only gives files back, and a late answer is ignored. So each scan has
one result, even if a machine is lost in the middle.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from uuid import uuid4

import structlog

from slrig.compute.host import PoolStore, PoolTask, open_store
from slrig.compute.link import (
    CONNECT_S,
    POOL_FAULT,
    Hello,
    Link,
    Message,
    PoolError,
    PoolRequest,
    PoolResponse,
    Progress,
    Withdrawal,
    Workers,
    cause,
    connect,
)
from slrig.compute.security import PoolAddress, pool_address
from slrig.config import ServiceSettings
from slrig.disk import storage_errors
from slrig.errors import ConfigError, StorageError
from slrig.jobs.data_folder import BUNDLE, RESULT
from slrig.jobs.job import FrameFeed
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.records import versions
from slrig.jobs.worker import POLL_S, Compute, JobFiles, Task, Worker
from slrig.model import Region
from slrig.scan.job import ScanJob

RETRY_S = 2.0
"""Interval of attempts to reach a missing pool."""

_log = structlog.get_logger(__name__)


class PoolClient:
    """A rig's connection to the pool at `address`. fault : why no order can be given, as of late."""

    def __init__(self, address: PoolAddress) -> None:
        self.fault = f"the pool {address} has not answered yet"
        self._address = address
        self._usable = threading.Event()
        self._thread = threading.Thread(target=self._live, name="slrig-pool", daemon=True)
        # The rest is of that thread.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._life: asyncio.Task[None] | None = None
        self._link: Link | None = None
        self._orders: dict[str, tuple[SimpleQueue[Progress], Future[PoolResponse]]] = {}

    def start(self) -> None:
        """Begin to connect. Returns at once. Idempotent."""
        with suppress(RuntimeError):  # it has begun
            self._thread.start()

    def usable(self, timeout_s: float = 0.0) -> bool:
        """Wait at most so long until orders can be given; return whether they can."""
        return self._usable.wait(timeout_s)

    def submit(self, order: PoolRequest, reports: SimpleQueue[Progress]) -> Future[PoolResponse]:
        """Give an order, which is withdrawn where the future is cancelled. Its exception is a PoolError. reports :
        takes progress. Raises PoolError.
        """
        if not self.usable():
            raise PoolError(self.fault)
        coming: Future[PoolResponse] = Future()
        coming.add_done_callback(partial(self._call, self._forget, order.job))
        self._call(self._give, order, reports, coming)
        return coming

    def close(self) -> None:
        """Leave the pool. Idempotent."""
        if self._life is not None:
            self._call(self._life.cancel)
            self._thread.join(CONNECT_S)

    def _call(self, call: Callable[..., object], *given: object) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(call, *given)

    def _live(self) -> None:
        with suppress(asyncio.CancelledError):
            asyncio.run(self._keep_connected())

    async def _keep_connected(self) -> None:
        self._loop, self._life = asyncio.get_running_loop(), asyncio.current_task()
        while True:
            fault = f"the pool {self._address} has ended the connection"
            try:
                self._link = await connect(self._address, Hello())
                await self._link.hear(self._heard)
            except Exception as error:  # noqa: BLE001 - after any error this machine computes
                fault = f"the pool {self._address} does not answer: {cause(error)}"
            finally:
                if self._link is not None:
                    self._link.close()
                self._link = None
            self._note(fault)
            while self._orders:
                _, (_, coming) = self._orders.popitem()
                _settle(coming, PoolError(f"the pool lost the job: {fault}"))
            await asyncio.sleep(RETRY_S)

    def _heard(self, message: Message) -> None:
        match message:
            case Workers(versions=found):
                self._note(self._lack(found))
            case Progress(job=job) if job in self._orders:
                self._orders[job][0].put(message)
            case PoolResponse(job=job) if job in self._orders:
                _settle(self._orders.pop(job)[1], message)

    def _lack(self, found: list[dict[str, str]]) -> str | None:
        """Reason why the pool takes no orders, None if it does. found : the versions of its workers."""
        if not found:
            return f"the pool {self._address} has no workers"
        if dict(versions()) not in found:
            return f"no worker of {self._address} has this machine's versions of slrig and its libraries"
        return None

    def _note(self, fault: str | None) -> None:
        if fault is None:
            if not self._usable.is_set():
                _log.info("the pool computes for this rig", pool=str(self._address))
            self._usable.set()
            return
        if self._usable.is_set() or fault != self.fault:
            _log.warning("the pool cannot be used, this machine computes", pool=str(self._address), cause=fault)
        self.fault = fault
        self._usable.clear()

    def _give(self, order: PoolRequest, reports: SimpleQueue[Progress], coming: Future[PoolResponse]) -> None:
        if self._link is None:
            _settle(coming, PoolError(self.fault))
        else:
            self._orders[order.job] = reports, coming
            self._link.send(order)

    def _forget(self, job: str, _coming: Future[PoolResponse]) -> None:
        if self._orders.pop(job, None) is not None and self._link is not None:
            self._link.send(Withdrawal(job=job))


def _settle(coming: Future[PoolResponse], answer: PoolResponse | PoolError) -> None:
    if not coming.set_running_or_notify_cancel():
        return
    if isinstance(answer, PoolError):
        coming.set_exception(answer)
    else:
        coming.set_result(answer)


TRIES = 2
"""Most times that a job is given to the pool, as when its worker was lost."""

BEGIN_LIMIT_S = 30.0
"""A job that has not begun so long is withdrawn: others are before it, and this machine takes it 2 to 9 s."""

TRANSFER_LIMIT_S = 120.0
"""The longest that a bundle or a result may take to or from the store: 0.5 GB at 40 Mbit/s."""

WAITING = "waiting for the pool"

RETURN_LIMIT_S = 5.0
"""Longest wait for a pool that lost a job: a restarted scheduler is back in two seconds."""


class PooledWorker:
    """`local` is this machine's own process, which does all that is not reconstruction. clock : seconds that grow."""

    def __init__(
        self, local: Compute, pool: PoolClient, store: PoolStore, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._local = local
        self._pool = pool
        self._store = store
        self._clock = clock
        self._closed = False
        # Tidied in the background.
        self._tidying = ThreadPoolExecutor(1, thread_name_prefix="slrig-store")

    @property
    def condition(self) -> str:
        """Condition of this machine's own process: without it nothing is certain to be computed."""
        return self._local.condition

    @property
    def loading(self) -> bool:
        """See `Compute`."""
        return self._local.loading

    def start(self) -> None:
        """See `Compute`."""
        self._local.start()
        self._pool.start()

    def feed(self, region: Region | None = None) -> FrameFeed:
        """See `Compute`. While the pool can be used frames go nowhere: it is brought the bundle."""
        if not self._pool.usable():
            return self._local.feed(region)
        feed = FrameFeed(lambda _: False)
        feed.abandon()
        return feed

    def run(
        self,
        task: Task,
        listener: Listener = SILENT,
        *,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """See `Compute`. Raises what the local process raises, and nothing else."""
        # A call of `ScanJob.compute`, of which the pool gets the plan alone.
        job = getattr(task.function, "__self__", None)
        if isinstance(job, ScanJob) and task.files is not None:
            try:
                if feed is not None and feed.receiver is not None:
                    # Frames that the local process has taken already are half of its work.
                    raise PoolError(f"{self._pool.fault} when the frames came")  # noqa: TRY301
                return self._by_pool(task, job, task.files, listener)
            except (PoolError, StorageError) as error:
                if not self._closed:
                    _log.warning("a job is computed by this machine", job=task.what, cause=str(error))
                task = replace(task, where={"where": "local", "because": str(error)})
        return self._local.run(task, listener, feed=feed, within_s=within_s)

    def close(self) -> None:
        """See `Compute`."""
        self._closed = True
        self._local.close()
        self._pool.close()
        self._tidying.shutdown(wait=False, cancel_futures=True)

    def _by_pool(self, task: Task, job: ScanJob, files: JobFiles, listener: Listener) -> Any:
        if not self._pool.usable():
            raise PoolError(self._pool.fault)
        bundle, result, key = files.folder / BUNDLE, files.folder / RESULT, None
        with storage_errors(result):
            result.mkdir(exist_ok=True)
        try:
            for left in reversed(range(TRIES)):
                try:
                    listener.report(WAITING, 0.0, "")
                    key = self._store.put_bundle(bundle, self._check(task, listener))
                    wanted = PoolTask(id=files.id, bundle=key, plan=job.plan, evidence=files.evidence)
                    return self._tried(task, wanted, result, listener)
                except PoolError as error:
                    if error.final or not left or self._closed or not self._pool.usable(RETURN_LIMIT_S):
                        raise
                    _log.warning("a job is given to the pool again", job=task.what, cause=str(error))
        finally:
            if key is not None:
                self._tidy(partial(self._store.clear, bundle=key))

    def _tried(self, task: Task, wanted: PoolTask, result: Path, listener: Listener) -> Any:
        order = PoolRequest(job=uuid4().hex, versions=dict(versions()), task=wanted.model_dump(mode="json"))
        reports: SimpleQueue[Progress] = SimpleQueue()
        coming = self._pool.submit(order, reports)
        try:
            answer = self._answer(task, coming, reports, listener)
            if answer.fault is not None:
                raise PoolError(answer.fault.message, final=answer.fault.code != POOL_FAULT)
            for name in self._store.fetch_result(order.job, answer.files, result, self._check(task, listener)):
                listener.file_ready(name)
            return answer.result
        finally:
            coming.cancel()
            self._tidy(partial(self._store.clear, job=order.job))

    def _answer(
        self, task: Task, coming: Future[PoolResponse], reports: SimpleQueue[Progress], listener: Listener
    ) -> PoolResponse:
        given_s, begun = self._clock(), False
        while True:
            answer = None
            with suppress(TimeoutError):
                answer = coming.result(POLL_S)
            while not reports.empty():
                heard, begun = reports.get(), True
                if heard.stage:
                    listener.report(heard.stage, heard.fraction, heard.detail)
            if answer is not None:
                return answer
            self._stay(task, listener)
            if not begun and self._clock() - given_s > BEGIN_LIMIT_S:
                message = f"the job has not begun in the pool for {self._clock() - given_s:.0f} s"
                # In a pool that has too much to do, a second try would wait behind all others once more.
                raise PoolError(message, final=True)

    def _stay(self, task: Task, listener: Listener) -> None:
        """Raise what ends the wait for the pool."""
        listener.check(f"The {task.what} was cancelled.")
        if self._closed:
            message = "the service ends"
            raise PoolError(message)

    def _check(self, task: Task, listener: Listener) -> Callable[[], None]:
        """A check that ends a transfer to or from the store that begins now."""
        until_s = self._clock() + TRANSFER_LIMIT_S

        def check() -> None:
            self._stay(task, listener)
            if self._clock() > until_s:
                message = f"the store {self._store.address} took longer than {TRANSFER_LIMIT_S:.0f} s"
                raise PoolError(message)

        return check

    def _tidy(self, tidied: Callable[[], None]) -> None:
        """Run a removal in the store in the background. If it fails, the store expires the object."""

        def tidy() -> None:
            try:
                tidied()
            except PoolError as error:
                _log.info("something was left in the pool's store", cause=str(error))

        with suppress(RuntimeError):  # the service ends
            self._tidying.submit(tidy)


def pooled(settings: ServiceSettings, local: Worker) -> PooledWorker:
    """The worker of a service that uses a pool. Raises ConfigError."""
    if settings.compute is None or settings.compute_store is None:
        message = "compute: a pool needs a store as well, compute_store. Set both, or neither."
        raise ConfigError(message)
    address = pool_address(settings.compute, settings.compute_certificates)
    store = open_store(settings.compute_store, settings.compute_login_file)
    return PooledWorker(local, PoolClient(address), store)
