"""Stands in for `slrig.jobs.worker`: does each task on the thread that asks for it, one at a time."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from slrig.errors import WorkerBusyError
from slrig.failure import interruption_error
from slrig.jobs.job import FedCaptures, FrameFeed, JobRun
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.worker import READY, Task
from slrig.model import Region
from tests.unit.scan.fakes import WAIT_S

Cancelled = Callable[[], bool]


class TameCompute:
    """Computes without a process of its own.

    module : as of a worker, `tests.unit.scan.fake_pipeline`. before : called at the beginning of each job.
    """

    condition, loading = READY, False

    def __init__(self, module: str, before: Callable[[Cancelled], object] = lambda _: None) -> None:
        self._pipeline = import_module(module)
        self._before = before
        self._captures = FedCaptures(self._pipeline.LiveScan)
        self._numbers = itertools.count(1)
        self.jobs = 0
        self._turn = threading.Lock()
        self._closed = threading.Event()

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
        listener: Listener = SILENT,
        *,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        self.jobs += 1
        try:
            self._take_turn(task, listener, within_s)
            try:
                return self._done(task, listener, feed)
            finally:
                self._turn.release()
        finally:
            self.jobs -= 1

    def _take_turn(self, task: Task, listener: Listener, within_s: float | None) -> None:
        until_s = math.inf if within_s is None else time.monotonic() + within_s
        while not self._turn.acquire(timeout=0.01):
            if self._closed.is_set():
                raise interruption_error()
            listener.check(f"The {task.what} was cancelled.")
            if time.monotonic() > until_s:
                raise WorkerBusyError(f"Another job is computed, and the {task.what} has to wait. Ask again.")

    def _done(self, task: Task, listener: Listener, feed: FrameFeed | None) -> Any:
        def told(stage: str, fraction: float, detail: str) -> None:
            if self._closed.is_set():
                raise interruption_error()
            listener.report(stage, fraction, detail)

        files = task.files
        if files is None:
            return task.function(*task.given)
        self._before(listener.cancelled)
        whole = feed is not None and feed.settled(WAIT_S) and feed.whole
        live = self._captures.taken(feed.number) if feed is not None and whole else None
        run = JobRun(
            files.id, files.folder, files.place, report=told, cancelled=listener.cancelled,
            file_ready=listener.file_ready, live=live, evidence=files.evidence, where=task.where,
            pipeline=self._pipeline,
        )  # fmt: skip
        return task.function(run)

    def close(self) -> None:
        self._closed.set()
