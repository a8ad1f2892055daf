"""Work with the rig: a piece of it, who it is named by while it holds the rig, and what the runner tells."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol
from uuid import UUID

import structlog

from slrig.devices import Rig
from slrig.errors import RigBusyError, SlrigError
from slrig.scan.faults import UNEXPECTED, fault_of, interruption
from slrig.scan.feed import FrameSink
from slrig.scan.holding import ActiveCalibration, HeldRig, RigFacts, driver_errors
from slrig.scan.plan import ScanPlan
from slrig.scan.records import utc_now

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds the rig. name : what an answer calls it, the id of a scan; words : the same for a person; path : where
    it is found over HTTP, below which `cancel` ends it.
    """

    name: str
    words: str
    path: str


class Task(Protocol):
    """A piece of work with the rig. Its first end stands: whatever ends it again later is not told."""

    id: UUID
    holder: Holder
    since: datetime
    stop: threading.Event
    """Set when it is to end early."""

    def run(self, held: HeldRig) -> None:
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
class Loan:
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

    def run(self, held: HeldRig) -> None:
        """See `Task`."""
        self.since = utc_now()
        try:
            rig = held.open()
            with driver_errors(held.name):
                self.work(rig, self.stop.is_set)
        except Exception as error:  # noqa: BLE001 - the owner thread outlives whatever happens to one piece of work
            if self.ending():
                self._keep(interruption())
                return
            if fault_of(error).kind == UNEXPECTED:
                _log.exception("work with the rig failed", work=self.holder.words)
            held.doubt(error)
            self._keep(error)

    def clear_up(self) -> None:
        """See `Task`."""

    def conclude(self) -> None:
        """See `Task`."""
        self._noted = True

    def cut_off(self, error: SlrigError) -> None:
        """See `Task`."""
        self._keep(error)
        self._noted = True

    def _keep(self, error: Exception) -> None:
        if not self._noted:
            self._error = error

    def settle(self) -> None:
        """See `Task`."""
        with self._telling:
            if not self._noted or self._told:
                return
            self._told = True
        self.ended(self._error)


class CaptureBundle(Protocol):
    """`slrig.scan.acquisition.capture_bundle`, or what a test puts in its place."""

    def __call__(
        self,
        rig: Rig,
        plan: ScanPlan,
        folder: Path,
        /,
        *,
        progress: Callable[[str, float, str], None],
        cancelled: Callable[[], bool],
        frames: FrameSink,
    ) -> None:
        """Play the patterns and write a complete bundle into `folder`; show each frame to `frames`."""
        ...


class WatchesHealth(Protocol):
    """What knows the health of the rig's calibration, and learns from scans."""

    def stamp(self) -> Mapping[str, Any] | None:
        """The health now, as a scan's report has it; None where nothing was verified yet."""
        ...

    def note(self, report: Mapping[str, Any]) -> None:
        """Take note of what a finished scan's report says of the calibration."""
        ...


@dataclass(frozen=True, slots=True)
class RunnerStatus:
    """What the runner is at: the rig as far as it is known, who holds it and since when, and how many wait.

    `active` is the calibration that takes the place of the rig's own, `misfit` why it cannot be used. `holder` is
    `Holder.name`. `opening` is what the rig's driver told last, while it is opened. `reconstruction` is
    `Worker.condition`, `preparing` whether that is on its way to ready.
    """

    rig: str
    facts: RigFacts | None
    active: ActiveCalibration | None
    misfit: str | None
    fault: str | None
    holder: str | None
    since: datetime | None
    waiting: int
    queue_length: int
    opening: str
    reconstruction: str
    preparing: bool
    ending: bool


def busy(task: Task) -> RigBusyError:
    """The error that names who holds the rig."""
    since = task.since.isoformat(timespec="seconds")
    message = (
        f"The rig is held by {task.holder.words} since {since}. Wait for it, cancel it with "
        f'POST {task.holder.path}/cancel, or send "if_busy": "queue" to wait in line.'
    )
    return RigBusyError(message, holder=task.holder.name, since=since)
