"""A worker that has bundles reconstructed by a pool over TLS, and by this machine's own process whenever that fails.

Records and staging folders are the rig's: a pool only gives files back, and a late answer is ignored. So each scan has
one result, even if a machine is lost in the middle.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol
from uuid import uuid4

import dask
import distributed
import structlog
from distributed import Client, Security

from slrig.compute.host import (
    CONNECT_S,
    POOL_FAULT,
    PoolError,
    PoolRequest,
    PoolResponse,
    PoolStore,
    compute,
    join_logs,
    open_store,
    resource,
)
from slrig.compute.security import pool_security
from slrig.config import ServiceSettings
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ScanCancelledError, StorageError
from slrig.jobs.data_folder import BUNDLE, RESULT
from slrig.jobs.database import versions
from slrig.jobs.job import FrameFeed
from slrig.jobs.worker import POLL_S, Compute, Made, Task, Told, Worker
from slrig.model import Region

if TYPE_CHECKING:
    from distributed import Security


CLOSE_S = 1.0
"""How long a connection may take to be closed."""

LOOK_S = 2.0
"""How often the connection is looked at."""

ASK_S = 30.0
"""How often what the workers can do is asked for, unless their number changes. A scheduler tells it in 0.7 kB and 6 µs
for each: at every look of 1 000 rigs, 320 workers would take its whole core and 0.9 Gbit/s."""

NewsCallback = Callable[[Mapping[str, Any]], None]
"""Is told what a machine tells of an order; without a stage, that it is at work."""


class Cluster(Protocol):
    """A pool as a rig sees it: `DaskCluster`, or what a test puts in its place.

    topic : `Order.topic` of this rig. fault : why no order can be given, as of late.
    """

    topic: str
    fault: str

    def start(self) -> None:
        """Begin to connect. Returns at once. Idempotent."""
        ...

    def usable(self, timeout_s: float = 0.0) -> bool:
        """Wait at most so long until orders can be given; return whether they can."""
        ...

    def submit(self, order: PoolRequest, told: NewsCallback) -> Future[PoolResponse]:
        """Give an order, which ends where the future is cancelled before it has begun. Its exception is a PoolError, or
        CancelledError where the pool is gone. Raises PoolError.
        """
        ...

    def close(self) -> None:
        """Let the pool go. Idempotent."""
        ...


class DaskCluster:
    """The pool whose scheduler is at `address`. security : see `slrig.compute.security.pool_security`."""

    def __init__(self, address: str, security: Security | None) -> None:
        self.topic = f"slrig-{uuid4().hex}"
        self.fault = f"the pool {address} has not answered yet"
        self._address = address
        self._security = security
        self._resource = resource(versions())
        self._usable = threading.Event()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        # Of that thread: dask's client is used on it alone.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._life: asyncio.Task[None] | None = None
        self._client: Client | None = None
        self._told: dict[str, NewsCallback] = {}

    def start(self) -> None:
        """See `Cluster`."""
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._live, name="slrig-pool", daemon=True)
                self._thread.start()

    def usable(self, timeout_s: float = 0.0) -> bool:
        """See `Cluster`."""
        return self._usable.wait(timeout_s)

    def submit(self, order: PoolRequest, told: NewsCallback) -> Future[PoolResponse]:
        """See `Cluster`."""
        if self._loop is None or not self._usable.is_set():
            raise PoolError(self.fault)
        self._told[order.job] = told
        return asyncio.run_coroutine_threadsafe(self._answer(order), self._loop)

    def close(self) -> None:
        """See `Cluster`."""
        if self._thread is not None and self._loop is not None and self._life is not None:
            with suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(self._life.cancel)
            self._thread.join(2 * CLOSE_S)

    def _live(self) -> None:
        join_logs()
        # A rig computes by itself while it has no connection, and says so once.
        for name in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        # dask's client asks for the same that `_watch` asks for.
        dask.config.set({"distributed.client.scheduler-info-interval": "1 day"})
        with suppress(asyncio.CancelledError):
            asyncio.run(self._keep_connected())

    async def _keep_connected(self) -> None:
        self._loop, self._life = asyncio.get_running_loop(), asyncio.current_task()
        while True:
            client: Client | None = None
            try:
                # Reads the certificates, every time: they may have been renewed.
                client = Client(
                    self._address, security=self._security, timeout=CONNECT_S, asynchronous=True, set_as_default=False
                )
                await asyncio.wait_for(client, CONNECT_S)
                client.subscribe_topic(self.topic, self._hear)
                self._client = client
                await self._watch(client)
            except Exception as error:  # noqa: BLE001 - whatever it is, this machine computes
                self._note(f"the pool {self._address} does not answer ({type(error).__name__})")
            finally:
                self._client = None
                self._usable.clear()
                if client is not None:
                    with suppress(Exception):
                        await client.close(timeout=CLOSE_S)
                    # One whose network is gone cannot be closed, and would try again when it is forgotten.
                    client.status = "closed"
            await asyncio.sleep(LOOK_S)

    async def _watch(self, client: Client) -> None:
        """Look at the pool until it does not answer, which raises."""
        known, asked_s, lack = -1, 0.0, None
        while True:
            found = await asyncio.wait_for(self._identity(client, 0), CONNECT_S)
            now_s = asyncio.get_running_loop().time()
            if found["n_workers"] != known or now_s - asked_s >= ASK_S:
                found = await asyncio.wait_for(self._identity(client, -1), CONNECT_S)
                known, asked_s, lack = found["n_workers"], now_s, self._lack(found["workers"].values())
            self._note(lack)
            await asyncio.sleep(LOOK_S)

    @staticmethod
    async def _identity(client: Client, workers: int) -> Mapping[str, Any]:
        """What the scheduler tells of itself, and of so many workers; -1: of all."""
        scheduler: Any = client.scheduler
        found: Mapping[str, Any] = await scheduler.identity(n_workers=workers)
        return found

    def _note(self, fault: str | None) -> None:
        if fault is None:
            if not self._usable.is_set():
                _log.info("the pool computes for this rig", pool=self._address)
            self._usable.set()
            return
        if self._usable.is_set() or fault != self.fault:
            _log.warning("the pool cannot be used, this machine computes", pool=self._address, cause=fault)
        self.fault = fault
        self._usable.clear()

    def _lack(self, workers: Collection[Mapping[str, Any]]) -> str | None:
        """What the pool lacks, None if orders can be given."""
        if not workers:
            return f"the pool {self._address} has no workers"
        if not any(self._resource in worker["resources"] for worker in workers):
            return f"no worker of {self._address} has this machine's versions of slrig and its libraries"
        return None

    async def _answer(self, order: PoolRequest) -> PoolResponse:
        future: distributed.Future[PoolResponse] | None = None
        try:
            if self._client is None:
                raise PoolError(self.fault)  # noqa: TRY301 - lost since it was asked
            # By a key of its own: two orders of one bundle are two. dask gives it to another machine when one is lost;
            # a scheduler that is lost knows nothing of it any more.
            future = self._client.submit(compute, order, key=order.job, pure=False, resources={self._resource: 1})
            answer: PoolResponse = await future
            return answer  # noqa: TRY300
        except asyncio.CancelledError:
            raise
        except BaseException as error:
            message = f"the pool {self._address} lost the job ({type(error).__name__})"
            self._note(message)
            raise PoolError(message) from error
        finally:
            self._told.pop(order.job, None)
            if future is not None:
                with suppress(Exception):
                    await future.cancel()

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        if (told := self._told.get(event[1]["job"])) is not None:
            told(event[1])


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
