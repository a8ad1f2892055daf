"""Stands in for `slrig.jobs.worker`: does each task on the thread that asks for it, one at a time."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from slrig.errors import ScanCancelledError
from slrig.failure import interruption_error
from slrig.jobs.frame_feed import FedCaptures, FrameFeed
from slrig.jobs.worker import READY, Worker
from slrig.jobs.worker_process import Task
from slrig.model import Region
from tests.unit.scan.fakes import WAIT_S

Cancelled = Callable[[], bool]


class TameCompute:
    """Computes without a process of its own. Only `task` gives functions that are done in one, by a real worker.

    module : as of a worker, `tests.unit.scan.fake_pipeline`. before : called at the beginning of each task.
    """

    condition, loading = READY, False

    def __init__(self, module: str, before: Callable[[Cancelled], object] = lambda _: None) -> None:
        self.module = module
        self._pipeline = import_module(module)
        self._before = before
        self._captures = FedCaptures(self._pipeline.frame_receiver)
        self._numbers = itertools.count(1)
        self._turn = threading.Lock()
        self._closed = threading.Event()
        self._apart = Worker(module)

    def start(self) -> None:
        """It is ready."""

    def feed(self, region: Region | None = None) -> FrameFeed:
        number = next(self._numbers)

        def send(message: object) -> bool:
            self._captures.hear(number, message)
            return True

        return FrameFeed(send, number=number, region=region)

    def run(
        self,
        task: Task,
        *,
        progress: Callable[[str, float, str], None] = lambda *_: None,
        cancelled: Cancelled = lambda: False,
        made: Callable[[str], None] = lambda _: None,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        del within_s

        def told(stage: str, fraction: float, detail: str) -> None:
            if self._closed.is_set():
                raise interruption_error()
            progress(stage, fraction, detail)

        while not self._turn.acquire(timeout=0.01):
            if self._closed.is_set():
                raise interruption_error()
            if cancelled():
                raise ScanCancelledError(f"The {task.what} was cancelled.")
        try:
            self._before(cancelled)
            whole = feed is not None and feed.settled(WAIT_S) and feed.whole
            live = self._captures.taken(feed.number) if feed is not None and whole else None
            function = getattr(self._pipeline, task.function.partition(":")[2])
            return partial(function, *task.given, **task.options)(
                progress=told, cancelled=cancelled, made=made, live=live
            )
        finally:
            self._turn.release()

    def task(self, function: str, what: str) -> Callable[..., Any]:
        return self._apart.task(function, what)

    def close(self) -> None:
        self._closed.set()
        self._apart.close()
