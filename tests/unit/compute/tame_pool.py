"""A pool without processes: its machines compute when their rig asks for the answer, or do what a test says."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from obstore.store import MemoryStore

from slrig.compute.cluster import Told
from slrig.compute.host import Answer, Host, Order
from slrig.compute.pooled import PooledWorker
from slrig.compute.store import PoolError, PoolStore
from slrig.errors import ScanInterruptedError
from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.worker import READY
from slrig.jobs.worker_process import Task
from slrig.model import Region
from slrig.scan.job import reconstruction
from slrig.scan.plan import ReconstructionPlan

PIPELINE = "tests.unit.scan.fake_pipeline"


class Clock:
    """Seconds that a test makes pass."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class TameWorker:
    """`Compute` in this process. done : the tasks that it was given."""

    module, condition, loading = PIPELINE, READY, False

    def __init__(self) -> None:
        self.done: list[Task] = []
        self.feeds: list[FrameFeed] = []
        self.closed = False

    def start(self) -> None:
        """Nothing to be done."""

    def close(self) -> None:
        self.closed = True

    def feed(self, region: Region | None = None) -> FrameFeed:
        self.feeds.append(FrameFeed(lambda _: True, receiver=self, region=region))
        return self.feeds[-1]

    def task(self, function: str, what: str) -> Callable[..., Any]:
        return lambda *given: self.run(Task(function, given, what=what))

    def run(
        self,
        task: Task,
        *,
        progress: Callable[[str, float, str], None] = lambda *_: None,
        cancelled: Callable[[], bool] = lambda: False,
        made: Callable[[str], None] = lambda _: None,
        feed: FrameFeed | None = None,  # noqa: ARG002
        within_s: float | None = None,  # noqa: ARG002
    ) -> Any:
        if self.closed:
            message = "closed"
            raise ScanInterruptedError(message)
        self.done.append(task)
        module, name = task.function.split(":")
        told = {"progress": progress, "cancelled": cancelled, "made": made} if task.movable else {}
        return getattr(importlib.import_module(module), name)(*task.given, **task.options, **told)


class TameOrder(Future[Answer]):
    """An order: `act` is asked for its answer."""

    def __init__(self, act: Callable[[Order], Answer | None], order: Order, told: Told) -> None:
        super().__init__()
        self._act = act
        self.order = order
        self.told = told

    def result(self, timeout: float | None = None) -> Answer:  # noqa: ARG002
        if (answer := self._act(self.order)) is None:
            raise TimeoutError
        return answer


class TameCluster:
    """`Cluster`. acts : what becomes of the orders, one after another; without any, a machine does them."""

    topic, fault = "rig", "the pool does not answer"

    def __init__(self, host: Host) -> None:
        self.host = host
        self.there = True
        self.acts: list[Callable[[Order], Answer | None]] = []
        self.orders: list[TameOrder] = []
        self.told: list[Mapping[str, Any]] = []

    def start(self) -> None:
        """Nothing to be done."""

    def close(self) -> None:
        """Nothing to be done."""

    def usable(self, timeout_s: float = 0.0) -> bool:  # noqa: ARG002
        return self.there

    def submit(self, order: Order, told: Told) -> TameOrder:
        act = self.acts.pop(0) if self.acts else lambda each: self.host.done(each, self.told.append)
        self.orders.append(TameOrder(act, order, told))
        return self.orders[-1]


class Pool:
    """A rig, a machine of a pool, and the store between them, whose objects are `objects`."""

    def __init__(self) -> None:
        self.objects = MemoryStore()
        self.store = PoolStore("memory://", self.objects)
        self.clock = Clock()
        self.local, self.remote = TameWorker(), TameWorker()
        self.cluster = TameCluster(Host(self.store, self.remote, clock=self.clock))
        self.worker = PooledWorker(self.local, self.cluster, self.store, clock=self.clock)

    def passes(self, seconds: float) -> Callable[[Order], None]:
        """An act: time passes without an answer."""

        def act(_order: Order) -> None:
            self.clock.now_s += seconds

        return act

    def tidied(self) -> set[str]:
        """What the store holds, once nothing more is to be removed."""
        self.worker._tidying.shutdown(wait=True)
        return {each["path"] for each in self.objects.list().collect()}


def lost(_order: Order) -> Answer | None:
    message = "the pool lost the job"
    raise PoolError(message)


def job(folder: Path, order: str = "finish") -> Task:
    """The reconstruction of a bundle that says what is to be done: see `tests.unit.scan.fake_pipeline`."""
    bundle, result = folder / "staged" / "bundle", folder / "staged" / "result"
    (bundle / "frames").mkdir(parents=True)
    result.mkdir()
    (bundle / "order").write_text(order)
    (bundle / "frames" / "0.png").write_bytes(bytes(range(256)) * 100)
    return reconstruction(PIPELINE, bundle, result, ReconstructionPlan())
