"""Automatic removal of old jobs and calibrations, by the limits of the settings.

DATA/.trash/SECOND-KIND-ID    what was removed less than a day of the service ago; moved back to its place it is on
                              record again after the next start
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Protocol
from uuid import UUID

import structlog
from pydantic import BaseModel, ValidationError

from slrig.bundle import write_file
from slrig.errors import (
    CalibrationNotFoundError,
    CalibrationStateError,
    JobNotFoundError,
    ScanStateError,
    StorageError,
)
from slrig.failure import LastingThread, disk_errors
from slrig.jobs.data_folder import remove
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Clock, JobKind, JobState, utc_now
from slrig.jobs.store import Audit

CLOCK = "clock.json"
"""In the data folder: the state of a `SteadyClock`."""

CHECK_S = 3600.0
"""Interval of the check of ages; counts and sizes are checked after each job, too."""

READ_S = 900.0
"""Time after a request for a file of a job in which the job counts as in use: 15 minutes carry a bundle of 2 GB over
a network of 20 Mbit/s."""

MAX_JUMP = timedelta(days=1)
"""By so much the system's clock may differ from where it was, and the time since, before it is doubted."""

DOUBT_S = 7 * 86400.0
"""Time that the service has to run before it accepts a clock that jumped by more."""

TRASH, TRASH_S = ".trash", 86400.0
"""Folder of removed files in the data folder, and how long they stay there, in seconds in which the service runs."""

_WRITE_S = 60.0
"""Least interval between writes of a clock's state, while no jump is in doubt."""

_END_S = 1.0
"""Longest wait of the service's end for a removal under way; the next start completes an interrupted one."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the jobs of a kind that are kept; None for no limit. days : since a job ended. size_bytes : of all."""

    count: int | None = None
    days: float | None = None
    size_bytes: int | None = None

    @property
    def any(self) -> bool:
        """Whether a limit is set."""
        return (self.count, self.days, self.size_bytes) != (None, None, None)


class _ClockState(BaseModel, extra="forbid"):
    """State of a `SteadyClock`: its time, for how long the system's has differed, and how long services have run."""

    time: datetime
    doubt_s: float
    ran_s: float = 0.0


class SteadyClock:
    """A clock for what cannot be undone: one wrong reading of the system's clock does not move it.

    Any thread may call. It follows the system's clock. Where that jumps by more than `MAX_JUMP`, while the service runs
    or between two runs, it goes on from where it was by the monotonic clock, until the service has run for `DOUBT_S`
    with the new time. file : keeps its state over restarts. first : the time to begin with where there is no such file.
    """

    def __init__(
        self,
        file: Path,
        *,
        first: datetime | None = None,
        clock: Clock = utc_now,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._file = file
        self._clock = clock
        self._now_s = now_s
        self._at_s = now_s()
        self._written_s = -math.inf
        self._lock = threading.Lock()
        try:
            self._state = _ClockState.model_validate_json(file.read_bytes())
        except (OSError, ValidationError):
            self._state = _ClockState(time=first or clock(), doubt_s=0.0)

    def now(self) -> datetime:
        """The time, never later than the system's."""
        with self._lock:
            return self._now()

    def _now(self) -> datetime:
        wall, at_s = self._clock(), self._now_s()
        elapsed_s, self._at_s = at_s - self._at_s, at_s
        expected = self._state.time + timedelta(seconds=elapsed_s)
        doubt_s = 0.0
        if abs(wall - expected) > MAX_JUMP:
            if self._state.doubt_s == 0.0:
                _log.warning(
                    "the system's clock jumped; nothing is removed by its age for now",
                    clock=wall.isoformat(timespec="seconds"),
                    expected=expected.isoformat(timespec="seconds"),
                )
            doubt_s = self._state.doubt_s + max(elapsed_s, 1e-3)
        believed = doubt_s == 0.0 or doubt_s >= DOUBT_S
        before, self._state = (
            self._state,
            _ClockState(
                time=wall if believed else expected,
                doubt_s=0.0 if believed else doubt_s,
                ran_s=self._state.ran_s + max(elapsed_s, 0.0),
            ),
        )
        if at_s - self._written_s > _WRITE_S or (before.doubt_s > 0.0) != (self._state.doubt_s > 0.0):
            # After one that the disk refused, the next start doubts a little more.
            with suppress(StorageError):
                write_file(self._file, self._state.model_dump_json().encode())
                self._written_s = at_s
        return min(wall, self._state.time)

    @property
    def ran_s(self) -> float:
        """For how many seconds services have run on the data folder, by the monotonic clock, as of the last `now`."""
        return self._state.ran_s


@dataclass(frozen=True, slots=True)
class Kept:
    """One job that is over, or one calibration. created_at, ended_at : as its record says. pinned : it stays."""

    id: UUID
    label: str | None
    created_at: datetime
    ended_at: datetime
    succeeded: bool
    pinned: bool


class Archive(Protocol):
    """All of a kind that is over."""

    @property
    def kind(self) -> str:
        """Its name in its path and its settings."""
        ...

    def kept(self) -> Sequence[Kept]:
        """Return them, newest first."""
        ...

    def needed(self, old: Collection[UUID]) -> Collection[UUID]:
        """Return those of them that something else needs."""
        ...

    def place(self, item: UUID) -> Path:
        """Return the folder of its files."""
        ...

    def remove(self, item: UUID, trash: Path) -> None:
        """Take it off record, and move its folder to `trash`. Raises an error of its state: it is in use, or gone."""
        ...


@dataclass(frozen=True, slots=True)
class JobArchive:
    """The jobs of a kind. unused : a block within which nothing else comes to need one; see `JobManager.delete`."""

    manager: JobManager
    kind: JobKind
    folder: Path
    unused: Callable[[UUID], AbstractContextManager[object]] = nullcontext

    def kept(self) -> Sequence[Kept]:
        """See `Archive`."""
        return [
            Kept(
                each.id, each.label, each.created_at, each.finished_at or each.created_at,
                each.state is JobState.SUCCEEDED, each.pinned,
            )
            for each in self.manager.store.finished(self.kind)
        ]  # fmt: skip

    def needed(self, old: Collection[UUID]) -> Collection[UUID]:  # noqa: ARG002
        """See `Archive`; `remove` finds out."""
        return ()

    def place(self, item: UUID) -> Path:
        """See `Archive`."""
        return self.folder / str(item)

    def remove(self, item: UUID, trash: Path) -> None:
        """See `Archive`."""
        self.manager.delete(item, self.unused(item), trash)


class Retention:
    """Removes what is beyond the limits, on a thread of its own, and empties the trash. Any thread may call.

    Only what succeeded counts; what failed has a count of its own, and goes first. What is pinned, needed by something
    else, or being read stays. A removal is on record in the audit.

    archives : each with its limits.
    """

    def __init__(
        self,
        root: Path,
        archives: Sequence[tuple[Archive, Limits]],
        audit: Audit,
        clock: SteadyClock,
        *,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._trash = root / TRASH
        self._archives: Mapping[str, tuple[Archive, Limits]] = {each.kind: (each, limits) for each, limits in archives}
        self._audit = audit
        self._clock = clock
        self._now_s = now_s
        self._read_s: dict[UUID, float] = {}
        self._due = threading.Condition()
        self._kinds = set(self._archives)
        self._closed = False
        self._thread = LastingThread(self._keep_on, "slrig-retention")

    def start(self) -> None:
        """Check all now and every hour, and a kind after `check`. Does nothing without limits and trash."""
        if self._trash.is_dir() or any(limits.any for _, limits in self._archives.values()):
            self._thread.start()

    def check(self, kind: str) -> None:
        """Request a check of the limits of a kind. Returns at once."""
        if kind in self._archives:
            with self._due:
                self._kinds.add(kind)
                self._due.notify()

    def reading(self, item: UUID) -> None:
        """Note a request for a file."""
        self._read_s[item] = self._now_s()

    def close(self) -> None:
        """Stop. Idempotent."""
        with self._due:
            self._closed = True
            self._due.notify()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    def _keep_on(self) -> None:
        while not self._closed:
            with self._due:
                self._due.wait_for(lambda: self._closed or self._kinds, CHECK_S)
                # After an hour without a job, all.
                kinds, self._kinds = self._kinds or set(self._archives), set()
            if not self._closed:
                try:
                    self.apply(kinds)
                except Exception:  # noqa: BLE001 - a disk that refuses now may answer in an hour
                    _log.exception("the limits of the settings could not be checked")

    def apply(self, kinds: Collection[str] | None = None) -> Sequence[UUID]:
        """Remove what is beyond the limits of kinds, None for all, say so in log and audit, and return which."""
        now = self._clock.now()
        self._empty_trash()
        self._read_s = {item: at_s for item, at_s in self._read_s.items() if self._now_s() - at_s < READ_S}
        removed = []
        for kind in self._archives if kinds is None else kinds:
            archive, limits = self._archives[kind]
            beyond = list(self._beyond(archive, limits, now)) if limits.any else []
            needed = set(archive.needed([each.id for each, _ in beyond])) if beyond else set()
            for old, why in beyond:
                if not self._closed and old.id not in needed and self._removed(archive, old, why):
                    removed.append(old.id)
        return removed

    def _removed(self, archive: Archive, old: Kept, why: str) -> bool:
        try:
            with disk_errors(self._trash):
                self._trash.mkdir(exist_ok=True)
            archive.remove(old.id, self._trash / f"{self._clock.ran_s:.0f}-{archive.kind}-{old.id}")
        except (JobNotFoundError, ScanStateError, CalibrationNotFoundError, CalibrationStateError):
            # Deleted by a request meanwhile, or in use.
            return False
        except StorageError as error:
            _log.warning("what is old could not be removed", kind=archive.kind, id=str(old.id), cause=str(error))
            return False
        _log.info("old one removed", kind=archive.kind, id=str(old.id), label=old.label, because=why)
        self._audit.note(f"slrig: {why}", "", "DELETE", f"/{archive.kind}/{old.id}", 204, "")
        return True

    def _empty_trash(self) -> None:
        """Remove what has lain in the trash for long enough: a folder's name begins with when it came, by `ran_s`."""
        ran_s = self._clock.ran_s
        for place in self._trash.iterdir() if self._trash.is_dir() else ():
            since, _, name = place.name.partition("-")
            if not since.isdecimal() or float(since) > ran_s:
                # Put there by a person, or by a clock that lost its state: its day begins now.
                place.rename(self._trash / f"{ran_s:.0f}-{name or place.name}")
            elif ran_s - float(since) > TRASH_S:
                remove(place)

    def _beyond(self, archive: Archive, limits: Limits, now: datetime) -> Iterator[tuple[Kept, str]]:
        """Jobs to remove, each with the reason: failed ones first, then the oldest. Pinned ones count, too."""
        kept = archive.kept()
        ended = _ends(kept)
        size_bytes = 0
        found = []
        for succeeded in (True, False):
            for count, each in enumerate((each for each in kept if each.succeeded is succeeded), 1):
                if limits.size_bytes is not None:
                    size_bytes += _size_bytes(archive.place(each.id))
                why = _why(limits, archive.kind, count, now - ended[each.id], size_bytes)
                if why is not None and not each.pinned and each.id not in self._read_s:
                    found.append((each, why))
        yield from reversed(found)


def _why(limits: Limits, kind: str, count: int, age: timedelta, size_bytes: int) -> str | None:
    if limits.count is not None and count > limits.count:
        return f"keep_{kind}s = {limits.count}"
    if limits.days is not None and age > timedelta(days=limits.days):
        return f"keep_{kind}s_days = {limits.days:g}"
    if limits.size_bytes is not None and size_bytes > limits.size_bytes:
        return f"keep_{kind}s_bytes = {limits.size_bytes}"
    return None


def _ends(kept: Sequence[Kept]) -> dict[UUID, datetime]:
    """End of each. A later job did not end before earlier ones were begun, even where a clock says so."""
    ends: dict[UUID, datetime] = {}
    latest = None
    for each in reversed(kept):
        latest = max(each.created_at, latest or each.created_at)
        ends[each.id] = max(each.ended_at, latest)
    return ends


def _size_bytes(folder: Path) -> int:
    return (
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        if folder.is_dir()
        else 0
    )
