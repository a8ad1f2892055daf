"""Work with the rig: a piece of it, who it is named by while it holds the rig, and what the runner tells."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Protocol
from uuid import UUID

import structlog

from slrig.devices import Rig
from slrig.errors import RigBusyError, SlrigError
from slrig.failure import UNEXPECTED, failure_of, interruption
from slrig.jobs.records import utc_now
from slrig.rig.session import RigSession, driver_errors

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds the rig. name : what an answer calls it, the id of a scan; words : the same for a person; path : where
    it is found over HTTP, below which `cancel` ends it.
    """

    name: str
    words: str
    path: str


class Job(Protocol):
    """A piece of work with the rig. Its first end stands: whatever ends it again later is not told."""

    id: UUID
    holder: Holder
    since: datetime
    stop: threading.Event
    """Set when it is to end early."""

    def run(self, held: RigSession) -> None:
        """Do the work, on the thread that owns the rig. The projector is darkened afterwards, whatever happened."""
        ...

    def clear_up(self) -> None:
        """Do what remains and needs no light. On the same thread; the rig is not free yet."""
        ...

    def conclude(self) -> None:
        """Take note that the work is over. The rig is being freed, and a lock is held: return at once."""
        ...

    def cut_off(self, error: SlrigError) -> None:
        """Take note that it ends before its time, on any thread, under the same lock."""
        ...

    def settle(self) -> None:
        """Tell how it ended, if that was noted. The rig is free; on any thread."""
        ...


@dataclass(slots=True, eq=False)
class RigWork:
    """The rig for work that is no scan.

    work : called on the owner thread with the open rig and `cancelled`; it raises ScanCancelledError when that turned
    true. ended : called once, when the rig is free again, with what was raised, None where nothing was. ending : tells
    that the service ends.
    """

    id: UUID
    holder: Holder
    since: datetime
    work: Callable[[Rig, Callable[[], bool]], None]
    ended: Callable[[Exception | None], None]
    ending: Callable[[], bool]
    stop: threading.Event = field(default_factory=threading.Event)
    _error: Exception | None = None
    _noted: bool = False
    _telling: threading.Lock = field(default_factory=threading.Lock)
    _told: bool = False

    def run(self, held: RigSession) -> None:
        """See `Job`."""
        self.since = utc_now()
        try:
            rig = held.open()
            with driver_errors(held.name):
                self.work(rig, self.stop.is_set)
        except Exception as error:  # noqa: BLE001 - the owner thread outlives whatever happens to one piece of work
            if self.ending():
                self._keep(interruption())
                return
            if failure_of(error).code == UNEXPECTED:
                _log.exception("work with the rig failed", work=self.holder.words)
            held.doubt(error)
            self._keep(error)

    def clear_up(self) -> None:
        """See `Job`."""

    def conclude(self) -> None:
        """See `Job`."""
        self._noted = True

    def cut_off(self, error: SlrigError) -> None:
        """See `Job`."""
        self._keep(error)
        self._noted = True

    def _keep(self, error: Exception) -> None:
        if not self._noted:
            self._error = error

    def settle(self) -> None:
        """See `Job`."""
        with self._telling:
            if not self._noted or self._told:
                return
            self._told = True
        self.ended(self._error)


def busy(job: Job) -> RigBusyError:
    """The error that names who holds the rig."""
    since = job.since.isoformat(timespec="seconds")
    message = (
        f"The rig is held by {job.holder.words} since {since}. Wait for it, cancel it with "
        f'POST {job.holder.path}/cancel, or send "if_busy": "queue" to wait in line.'
    )
    return RigBusyError(message, holder=job.holder.name, since=since)
