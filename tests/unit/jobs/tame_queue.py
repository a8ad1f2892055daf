"""The real queue without its threads of the rig: whoever submits a job does its first part."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from slrig.devices import Rig
from slrig.errors import QueueFullError, RigBusyError
from slrig.jobs.job import Job
from slrig.jobs.queue import JobQueue
from slrig.rig.session import RigSession


class PowerCut(BaseException):
    """Nobody catches it, and nothing is told of how the job ended."""


class TameQueue(JobQueue):
    """Does the first part of a job on the caller's own thread, as soon as it is submitted.

    busy : who holds the rig, for those who do not wait. full : refuses. error : ends a job in place of its first part.
    lazy : jobs stay in line. cancelled : asked in place of `Job.stop`. holders : of the jobs that had the rig.
    """

    def __init__(self, rig: Rig, *, opened: bool = True) -> None:
        self.bare = rig
        self.busy: str | None = None
        self.full = self.lazy = False
        self.error: Exception | None = None
        self.cancelled: Callable[[], bool] = lambda: False
        self.holders: list[str] = []
        session = RigSession(rig.name, lambda: self.bare)
        super().__init__(session, queue_length=8, backlog_length=8, give_up=lambda _: None)
        if opened:
            self.rig.open()

    def submit(self, make: Callable[[], Sequence[Job]], *, wait: bool) -> None:
        if self.full:
            raise QueueFullError("As many wait as may.")
        if self.busy is not None and not wait:
            raise RigBusyError(f"The rig is held by {self.busy}.", holder=self.busy, since="")
        self.add(make())

    def add(self, jobs: Sequence[Job]) -> None:
        for job in jobs:
            if job.work is None:
                super().add([job])
                self._begin_computing(job)
            elif not self.lazy:
                self._do(job)

    def _do(self, job: Job) -> None:
        self.holders.append(job.holder.name)
        if self.error is not None:
            job.conclude(self.error)
            job.settle()
            return
        job.stop = _Stop(job, self.cancelled)
        self._active = job
        self._run(job)


class _Stop(threading.Event):
    """That of a job, set when `cancelled` says so."""

    def __init__(self, job: Job, cancelled: Callable[[], bool]) -> None:
        super().__init__()
        self._job = job
        self._cancelled = cancelled

    def is_set(self) -> bool:
        try:
            return self._cancelled()
        except PowerCut:
            self._job.clear_up = self._job.concluded = self._job.ended = lambda _: None
            raise
