"""The real manager without its thread of the rig: the thread that submits a job does its first part."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

from slrig.api.server import KINDS
from slrig.devices import Rig
from slrig.errors import QueueFullError, RigBusyError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Job
from slrig.jobs.manager import JobManager, _Work
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Compute
from slrig.rig.session import RigSession


class PowerCut(BaseException):
    """Nobody catches it, and nothing is on record of how the job ended."""


class TameManager(JobManager):
    """Does the first part of a job on the caller's own thread, as soon as it is submitted.

    busy : who holds the rig, for those who do not wait. full : refuses. error : ends a job in place of its first part.
    lazy : jobs stay in line. cancelled : asked in place of whether it was. holders : of the jobs that had the rig.
    """

    def __init__(
        self,
        store: JobStore,
        data: DataFolder,
        rig: Rig,
        worker: Compute,
        *kinds: type[Job],
        opened: bool = True,
    ) -> None:
        self.bare = rig
        self.busy: str | None = None
        self.full = self.lazy = False
        self.error: Exception | None = None
        self.cancelled: Callable[[], bool] = lambda: False
        self.holders: list[str] = []
        session = RigSession(rig.name, lambda: self.bare)
        super().__init__(store, data, session, worker, *(kinds or KINDS), backlog_length=8)
        if opened:
            self.rig.open()

    def _require_place(self, *, wait: bool) -> None:
        if self.full:
            raise QueueFullError("As many wait as may.")
        if self.busy is not None and not wait:
            raise RigBusyError(f"The rig is held by {self.busy}.", holder=self.busy, since="")

    def _line_up(self, works: Iterable[_Work]) -> None:
        for work in works:
            if work.captured or not work.job.uses_rig:
                self._computing.append(work)
                self._begin_computing(work)
            elif not self.lazy:
                self._do(work)

    def _do(self, work: _Work) -> None:
        self.holders.append(work.holder.name)
        if self.error is not None:
            self._end(work, self.error)
            self._settle(work)
            return
        work.stop = stop = _Stop(work, self.cancelled)
        self._active = work
        self._run(work)
        if stop.cut:
            raise PowerCut

    def _clear_up(self, work: _Work, error: Exception | None) -> None:
        # After a power cut nobody clears up.
        if not getattr(work.stop, "cut", False):
            super()._clear_up(work, error)


class _Stop(threading.Event):
    """That of a job, set when `cancelled` says so."""

    def __init__(self, work: _Work, cancelled: Callable[[], bool]) -> None:
        super().__init__()
        self._work = work
        self._cancelled = cancelled
        self.cut = False

    def is_set(self) -> bool:
        try:
            return self._cancelled()
        except PowerCut:
            self.cut = self._work.ended = self._work.settled = True
            raise
