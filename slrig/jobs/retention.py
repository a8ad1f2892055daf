"""Old jobs: which of a kind are removed, and when, where the settings set limits."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from uuid import UUID

import structlog
from pydantic import BaseModel, ValidationError

from slrig.bundle import write_file
from slrig.errors import JobNotFoundError, ScanStateError, StorageError
from slrig.jobs.records import Clock, JobKind, JobRecord, JobState, utc_now
from slrig.jobs.store import JobStore

CLOCK = "clock.json"
"""In the data folder: the state of a `SteadyClock`."""

LOOK_S = 3600.0
"""How often ages are looked at; counts and sizes are after each job, too."""

READ_S = 900.0
"""How long after somebody asked for a file of a job it counts as in use: 15 minutes carry a bundle of 2 GB over a
network of 20 Mbit/s."""

MAX_JUMP = timedelta(days=1)
"""By so much the system's clock may differ from where it was, and the time since, before it is doubted."""

DOUBT_S = 7 * 86400.0
"""How long the service has to run before it believes a clock that jumped by more."""

_END_S = 1.0
"""How long the end of the service waits for a removal under way; the next start completes one that is cut off."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Limits:
    """How many jobs of a kind are kept; None sets no limit. days : since a job ended. size_bytes : of all files."""

    count: int | None = None
    days: float | None = None
    size_bytes: int | None = None

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return (self.count, self.days, self.size_bytes) != (None, None, None)


class _ClockState(BaseModel, extra="forbid"):
    """What is kept of a `SteadyClock`: the time that it believes, and for how long the system's has differed."""

    time: datetime
    doubt_s: float


class SteadyClock:
    """A clock for what cannot be undone: one wrong reading of the system's clock does not move it.

    It follows the system's clock. Where that jumps by more than `MAX_JUMP`, while the service runs or between two
    runs, it goes on from where it was by the monotonic clock, until the service has run for `DOUBT_S` with the new
    time. file : keeps its state over restarts. first : the time to begin with where there is no such file.
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
        try:
            self._state = _ClockState.model_validate_json(file.read_bytes())
        except (OSError, ValidationError):
            self._state = _ClockState(time=first or clock(), doubt_s=0.0)

    def now(self) -> datetime:
        """The time, never later than the system's. Raises StorageError."""
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
        self._state = _ClockState(time=wall if believed else expected, doubt_s=0.0 if believed else doubt_s)
        write_file(self._file, self._state.model_dump_json().encode())
        return min(wall, self._state.time)


class JobRetention:
    """Removes jobs of a kind beyond the limits, on a thread of its own. Any thread may call.

    Only jobs that succeeded count; those that failed have a count of their own, and go first. Pinned ones, and those
    whose files somebody reads, stay.

    place : where the files of a job lie. delete : removes a job, or raises ScanStateError where it is in use.
    clock : for ages; see `SteadyClock`.
    """

    def __init__(
        self,
        store: JobStore,
        kind: JobKind,
        limits: Limits,
        place: Callable[[UUID], Path],
        delete: Callable[[UUID], None],
        *,
        clock: Clock = utc_now,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._kind = kind
        self._limits = limits
        self._place = place
        self._delete = delete
        self._clock = clock
        self._now_s = now_s
        self._read_s: dict[UUID, float] = {}
        self._due = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._keep_on, name=f"slrig-{kind}-retention", daemon=True)

    def start(self) -> None:
        """Look now, after each `look`, and every hour. Does nothing without limits."""
        if self._limits.any:
            self._due.set()
            self._thread.start()

    def look(self) -> None:
        """Have the limits looked at soon. Returns at once."""
        self._due.set()

    def reading(self, job_id: UUID) -> None:
        """Take note that somebody asks for a file of a job."""
        self._read_s[job_id] = self._now_s()

    def close(self) -> None:
        """Look no more. Idempotent."""
        self._closed = True
        self._due.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    def _keep_on(self) -> None:
        while not self._closed:
            self._due.wait(LOOK_S)
            self._due.clear()
            if not self._closed:
                try:
                    self.apply()
                except Exception:  # noqa: BLE001 - a disk that refuses now may answer in an hour
                    _log.exception("old jobs could not be looked for", kind=str(self._kind))

    def apply(self) -> Sequence[UUID]:
        """Remove what is beyond the limits, say so in the log, and return which."""
        self._read_s = {job: at for job, at in self._read_s.items() if self._now_s() - at < READ_S}
        removed = []
        for record, why in list(self._beyond()):
            if self._closed:
                break
            try:
                self._delete(record.id)
            except (JobNotFoundError, ScanStateError):
                # Deleted by somebody meanwhile.
                continue
            except StorageError as error:
                _log.warning("an old job could not be removed", job=str(record.id), cause=str(error))
                continue
            removed.append(record.id)
            _log.info("old job removed", kind=str(self._kind), job=str(record.id), label=record.label, because=why)
        return removed

    def _beyond(self) -> Iterator[tuple[JobRecord, str]]:
        """The jobs to remove, and why: first those that failed, oldest first. Those that are kept whatever they are
        count, too.
        """
        finished = self._store.finished(self._kind)
        ended = _ends(finished)
        now = self._clock() if self._limits.days is not None else None
        size_bytes = 0
        found = []
        for succeeded in (True, False):
            records = [each for each in finished if (each.state is JobState.SUCCEEDED) is succeeded]
            for count, record in enumerate(records, 1):
                if self._limits.size_bytes is not None:
                    size_bytes += _size_bytes(self._place(record.id))
                why = self._why(count, None if now is None else now - ended[record.id], size_bytes)
                if why is not None and not record.pinned and record.id not in self._read_s:
                    found.append((record, why))
        yield from reversed(found)

    def _why(self, count: int, age: timedelta | None, size_bytes: int) -> str | None:
        limits, setting = self._limits, f"keep_{self._kind}s"
        if limits.count is not None and count > limits.count:
            return f"{setting} = {limits.count}"
        if limits.days is not None and age is not None and age > timedelta(days=limits.days):
            return f"{setting}_days = {limits.days:g}"
        if limits.size_bytes is not None and size_bytes > limits.size_bytes:
            return f"{setting}_bytes = {limits.size_bytes}"
        return None


def _ends(finished: Sequence[JobRecord]) -> dict[UUID, datetime]:
    """When jobs ended. A job that was begun later did not end before earlier ones were begun, whatever a clock said."""
    ends: dict[UUID, datetime] = {}
    latest = None
    for record in reversed(finished):
        latest = max(record.created_at, latest or record.created_at)
        ends[record.id] = max(record.finished_at or record.created_at, latest)
    return ends


def _size_bytes(folder: Path) -> int:
    return (
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        if folder.is_dir()
        else 0
    )
