"""A hall of rigs in virtual time: slrig's own `PooledWorker` and `DaskCluster` on dask's own scheduler and workers.

What is modelled is the rest: a capture, a transfer and a reconstruction take their measured time and do nothing.
`Host.done` is `compute` here, for it would hold the loop: it is heard of at once, and every BEAT_S, and looks for its
stop as often. What the rig's threads wait for (`Future.result`, `Event.wait`, a transfer) is awaited by greenlets, and
looked at once a second, where a rig looks every POLL_S.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from distributed import Scheduler, get_worker
from distributed import Worker as DaskWorker
from distributed.comm.inproc import global_manager
from sqlalchemy.util import await_only, greenlet_spawn

from slrig.compute import cluster
from slrig.compute.cluster import CONNECT_S, DaskCluster, Told
from slrig.compute.host import BEAT_S, Answer, Order, resource
from slrig.compute.pooled import PooledWorker
from slrig.compute.serving import RETURN_S
from slrig.compute.store import CHUNK_BYTES, PoolError, PoolStore
from slrig.config import ServiceSettings
from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.versions import versions
from slrig.jobs.worker_process import Task
from tests.unit.compute.tame_pool import TameWorker

PLACE = f"inproc://{global_manager.new_address()}"
ADDRESS = f"{PLACE}:0"
POLL_S = 1.0
REQUEST_LIMIT_S = 20.0
"""Of `slrig.compute.store`: one request, which carries a chunk."""

BACKLOG = ServiceSettings.model_fields["backlog_length"].default
CALM_LOOK_S, LOOK_S = 60.0, cluster.LOOK_S
"""How often a rig looks for its scheduler; as slrig does where anything could be seen, rarely where nothing can."""


@dataclass(frozen=True)
class Lines:
    """Bytes a second: of each rig's line, of each worker's, and of the store, shared by those who use it.
    rig_slowness : how many times as long a rig computes as a worker.
    """

    rig: float
    worker: float
    store: float
    rig_slowness: float


@dataclass
class Scan:
    """A scan, and when, in seconds of the day, what became of it. service_s : to reconstruct it on a worker."""

    key: str
    service_s: float
    bundle_bytes: int
    result_bytes: int
    captured_s: float = 0.0
    begun_s: float = 0.0
    ended_s: float = 0.0
    where: str = ""


@dataclass(frozen=True)
class Visit:
    """Scans of one rig in a row, pause_s from a frame that was the last to the next scan's first; and the model of
    them, which takes combine_s.
    """

    asked_s: float
    scans: Sequence[Scan]
    capture_s: float
    pause_s: float = 0.0
    combine_s: float = 0.0


class Store:
    """The pool's store, and the lines to it. slowness : how many times as long everything takes."""

    def __init__(self, lines: Lines) -> None:
        self.lines = lines
        self.slowness = 1.0
        self.carried = 0
        self.held: set[str] = set()
        self.most_held = 0
        self.stops: set[str] = set()
        self._users = 0

    async def carry(self, size: int, line: float, check: Callable[[], object]) -> None:
        """Bring so many bytes there or back, in chunks. Raises PoolError."""
        self._users += 1
        try:
            while size > 0:
                check()
                chunk = min(size, CHUNK_BYTES)
                took_s = self.slowness * chunk / min(line, self.lines.store / self._users)
                await asyncio.sleep(min(took_s, REQUEST_LIMIT_S))
                if took_s > REQUEST_LIMIT_S:
                    message = "the store failed (TimeoutError)"
                    raise PoolError(message)
                size -= chunk
                self.carried += chunk
        finally:
            self._users -= 1


class _RigStore(PoolStore):
    """The store as a rig sees it, which waits in a greenlet."""

    def __init__(self, rig: Rig) -> None:
        super().__init__("the store", None)  # type: ignore[arg-type]
        self._rig, self._of = rig, rig.hall.store

    def _carry(self, size: int, check: Callable[[], None]) -> None:
        line = self._of.lines.rig if not self._rig.cluster.cut else 1.0
        await_only(self._of.carry(size, line, check))

    def put_bundle(self, bundle: Path, check: Callable[[], None]) -> str:
        if bundle.name not in self._of.held:
            self._carry(self._rig.hall.scans[bundle.name].bundle_bytes, check)
            self._of.held.add(bundle.name)
            self._of.most_held = max(self._of.most_held, len(self._of.held))
        return bundle.name

    def fetch_result(
        self, job: str, hashes: Mapping[str, str], folder: Path, check: Callable[[], None]  # noqa: ARG002
    ) -> Iterator[str]:  # fmt: skip
        for name in hashes:
            self._carry(self._rig.hall.scans[folder.name].result_bytes, check)
            yield name

    def stop(self, job: str) -> None:
        self._of.stops.add(job)

    def clear(self, *, bundle: str | None = None, job: str | None = None) -> None:  # noqa: ARG002
        self._of.held.discard(str(bundle))


class _Event:
    """A `threading.Event` whose wait is a greenlet's."""

    def __init__(self) -> None:
        self._event = asyncio.Event()
        self.set, self.clear, self.is_set = self._event.set, self._event.clear, self._event.is_set

    def wait(self, timeout_s: float) -> bool:
        if timeout_s > 0:
            with suppress(TimeoutError):
                await_only(asyncio.wait_for(self._event.wait(), timeout_s))
        return self._event.is_set()


class _Coming:
    """A `concurrent.futures.Future` whose wait is a greenlet's."""

    def __init__(self, future: concurrent.futures.Future[Answer]) -> None:
        self._future, self.cancel = future, future.cancel
        self._done = asyncio.get_running_loop().create_future()
        future.add_done_callback(lambda _: self._done.set_result(None))

    def result(self, _timeout: float) -> Answer:
        if not self._future.done():
            await_only(asyncio.wait({self._done}, timeout=POLL_S))
        return self._future.result(0)


class _RigCluster(DaskCluster):
    """`DaskCluster` on the loop of all. cut : nothing passes, and nobody is told."""

    def __init__(self) -> None:
        super().__init__(ADDRESS, None)
        self.cut = False
        self._usable = _Event()  # type: ignore[assignment]

    def start(self) -> None:
        self.life = asyncio.get_running_loop().create_task(self._keep_connected())

    def submit(self, order: Order, told: Told) -> Any:
        return _Coming(super().submit(order, told))

    async def _keep_connected(self) -> None:
        identity = self._identity

        async def asked(client: Any, workers: int) -> Mapping[str, Any]:
            if self.cut:
                await asyncio.sleep(2 * CONNECT_S)
            return await identity(client, workers)

        self._identity = asked  # type: ignore[method-assign]
        await super()._keep_connected()

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        if not self.cut:
            super()._hear(event)


class _Local(TameWorker):
    """The process of a rig: one task at a time."""

    def __init__(self, hall: Hall) -> None:
        super().__init__()
        self._hall, self._turn = hall, asyncio.Lock()

    def run(self, task: Task, **_: Any) -> Any:
        await_only(self._done(task))

    async def _done(self, task: Task) -> None:
        async with self._turn:
            scan, now = self._hall.scans.get(task.given[0].name), asyncio.get_running_loop().time
            if scan is None:
                await asyncio.sleep(task.given[1])
                return
            scan.where, scan.begun_s = task.where.get("because", "the pool was not there when it was captured"), now()
            await asyncio.sleep(self._hall.store.lines.rig_slowness * scan.service_s)


class _AtOnce:
    """An executor that has no threads."""

    def submit(self, what: Callable[[], None]) -> None:
        what()

    def shutdown(self, **_: Any) -> None:
        """Nothing to be done."""


class Rig:
    """A rig and its visits, in their order. As in `JobQueue`, no capture begins while BACKLOG scans compute."""

    def __init__(self, hall: Hall) -> None:
        self.hall = hall
        self.cluster = _RigCluster()
        self.worker = PooledWorker(
            _Local(hall), self.cluster, _RigStore(self), clock=asyncio.get_running_loop().time
        )  # fmt: skip
        self.worker._tidying = _AtOnce()  # type: ignore[assignment]
        self.worker.start()
        self._room = asyncio.Semaphore(BACKLOG)

    async def live(self, visits: Sequence[Visit]) -> None:
        """Make the visits, one after another."""
        now, tasks = asyncio.get_running_loop().time, []
        for visit in visits:
            await asyncio.sleep(max(visit.asked_s - now(), 0.0))
            computing = []
            for scan in visit.scans:
                await self._room.acquire()
                feed = self.worker.feed()
                await asyncio.sleep(visit.capture_s)
                scan.captured_s = now()
                computing.append(asyncio.create_task(self._computed(scan, feed)))
                await asyncio.sleep(visit.pause_s)
            tasks.append(asyncio.create_task(self._combined(visit, computing)))
        await asyncio.gather(*tasks)

    async def _computed(self, scan: Scan, feed: FrameFeed) -> None:
        place = Path(scan.key)
        task = Task("a:reconstruction", (place, place), what="reconstruction", movable=True)
        await greenlet_spawn(self.worker.run, task, feed=feed)
        scan.ended_s = asyncio.get_running_loop().time()
        self._room.release()

    async def _combined(self, visit: Visit, computing: Sequence[asyncio.Task[None]]) -> None:
        await asyncio.gather(*computing)
        if visit.combine_s:
            await greenlet_spawn(self.worker.run, Task("a:model", (Path("model"), visit.combine_s)))


@dataclass
class Hall:
    """Rigs, a scheduler and workers. scans : by their key. rests_s : how long a worker that ended is gone."""

    store: Store
    scans: dict[str, Scan]
    rigs: list[Rig] = field(default_factory=list)
    members: dict[int, DaskWorker] = field(default_factory=dict)
    rests_s: dict[int, float] = field(default_factory=dict)
    busy: int = 0
    busy_s: float = 0.0
    scheduler: Scheduler | None = None
    _lives: list[asyncio.Task[None]] = field(default_factory=list)

    async def open(self, rigs: int, workers: int, patch: pytest.MonkeyPatch) -> None:
        """Start everything."""
        patch.setattr(cluster, "compute", compute)
        patch.setattr(cluster, "LOOK_S", LOOK_S)
        await self.serve()
        self._lives = [asyncio.create_task(self._member(number)) for number in range(workers)]
        await asyncio.sleep(10.0)
        self.rigs = [Rig(self) for _ in range(rigs)]
        await asyncio.sleep(10.0)
        assert all(rig.cluster.usable() for rig in self.rigs)

    async def serve(self) -> None:
        """Start a scheduler."""
        self.scheduler = await Scheduler(host=PLACE, protocol="inproc", dashboard=False, dashboard_address=":0")

    async def close(self) -> None:
        """End everything."""
        for each in self._lives:
            each.cancel()
        for rig in self.rigs:
            rig.cluster.life.cancel()
        await asyncio.sleep(10.0)
        assert self.scheduler is not None
        await self.scheduler.close()

    async def kill(self, worker: int) -> None:
        """End a worker as a power cut would."""
        member = self.members[worker]
        member.batched_stream.abort()
        await member.close(executor_wait=False)

    async def _member(self, number: int) -> None:
        """`slrig.compute.serving.serve_worker`, without the process beneath."""
        while True:
            with suppress(OSError, RuntimeError, TimeoutError):
                member: Any = DaskWorker(
                    ADDRESS, name=f"worker-{number}", nthreads=1, memory_limit=0, resources={resource(versions()): 1},
                    death_timeout=CONNECT_S, dashboard=False, dashboard_address=":0", protocol="inproc",
                )  # fmt: skip
                member.hall = self
                async with member:
                    self.members[number] = member
                    await member.finished()
            await asyncio.sleep(self.rests_s.pop(number, RETURN_S))


async def compute(order: Order) -> Answer:
    """What `slrig.compute.host.compute` does, in the time that it takes."""
    worker: Any = get_worker()
    loop = asyncio.get_running_loop()
    hall: Hall = worker.hall
    scan, store, begun_s = hall.scans[order.bundle], hall.store, loop.time()

    beaten_s = -BEAT_S

    def beat() -> None:
        nonlocal beaten_s
        if loop.time() - beaten_s >= BEAT_S:
            beaten_s = loop.time()
            worker.log_event(order.topic, {"job": order.job})

    hall.busy += 1
    try:
        beat()
        scan.where, scan.begun_s = "pool", begun_s
        await store.carry(scan.bundle_bytes, store.lines.worker, beat)
        left_s = scan.service_s
        while left_s > 0:
            await asyncio.sleep(min(left_s, BEAT_S))
            left_s -= BEAT_S
            beat()
            if order.job in store.stops:
                return Answer()
        await store.carry(scan.result_bytes, store.lines.worker, beat)
        return Answer(None, {"mesh.ply": ""})
    finally:
        hall.busy -= 1
        hall.busy_s += loop.time() - begun_s
