"""The rig's end of dask.distributed: a connection that comes back by itself, and orders that are under way."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import Any, Protocol
from uuid import uuid4

import dask
import structlog
from distributed import Client, Future, Security

from slrig.compute.host import PoolRequest, PoolResponse, compute, resource
from slrig.compute.store import PoolError
from slrig.jobs.versions import versions

CONNECT_S = 5.0
"""The longest that the scheduler may take to answer: it does nothing else."""

CLOSE_S = 1.0
"""How long a connection may take to be closed."""

LOOK_S = 2.0
"""How often the connection is looked at."""

ASK_S = 30.0
"""How often what the workers can do is asked for, unless their number changes. A scheduler tells it in 0.7 kB and 6 µs
for each: at every look of 1 000 rigs, 320 workers would take its whole core and 0.9 Gbit/s."""

Told = Callable[[Mapping[str, Any]], None]
"""Is told what a machine tells of an order; without a stage, that it is at work."""

_log = structlog.get_logger(__name__)


def join_logs() -> None:
    """Have the lines of distributed, which brings handlers of its own along, go the way of all others."""
    for name in [each for each in logging.root.manager.loggerDict if each.partition(".")[0] == "distributed"]:
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
        logger.setLevel(logging.NOTSET)


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

    def submit(self, order: PoolRequest, told: Told) -> concurrent.futures.Future[PoolResponse]:
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
        self._told: dict[str, Told] = {}

    def start(self) -> None:
        """See `Cluster`."""
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._live, name="slrig-pool", daemon=True)
                self._thread.start()

    def usable(self, timeout_s: float = 0.0) -> bool:
        """See `Cluster`."""
        return self._usable.wait(timeout_s)

    def submit(self, order: PoolRequest, told: Told) -> concurrent.futures.Future[PoolResponse]:
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
        future: Future[PoolResponse] | None = None
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
