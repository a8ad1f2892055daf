"""Old scans removed by count, age and size, where the settings ask for it: never one that is pinned or in use."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from uuid import UUID

import structlog

from slrig.errors import JobNotFoundError, ScanStateError, StorageError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.records import Clock, JobKind, JobRecord, utc_now
from slrig.jobs.store import JobStore

LOOK_S = 3600.0
"""How often ages are looked at; counts and sizes are after each scan, too."""

READ_S = 900.0
"""How long after somebody asked for a file of a scan the scan counts as in use: 15 minutes carry a bundle of 2 GB over
a network of 20 Mbit/s."""

_END_S = 1.0
"""How long the end of the service waits for a removal under way; the next start completes one that is cut off."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class ScanLimits:
    """How much of scans is kept; None sets no limit. days : since a scan ended. size_bytes : of all their files."""

    count: int | None = None
    days: float | None = None
    size_bytes: int | None = None

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return (self.count, self.days, self.size_bytes) != (None, None, None)


class ScanRetention:
    """Removes scans beyond the limits, oldest first, on a thread of its own. Any thread may call.

    delete : removes a scan, or raises ScanStateError where it is in use.
    """

    def __init__(
        self,
        store: JobStore,
        folder: DataFolder,
        limits: ScanLimits,
        delete: Callable[[UUID], None],
        *,
        clock: Clock = utc_now,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._folder = folder
        self._limits = limits
        self._delete = delete
        self._clock = clock
        self._now_s = now_s
        self._read_s: dict[UUID, float] = {}
        self._due = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._keep_on, name="slrig-scan-retention", daemon=True)

    def start(self) -> None:
        """Look now, after each `look`, and every hour. Does nothing without limits."""
        if self._limits.any:
            self._due.set()
            self._thread.start()

    def look(self) -> None:
        """Have the limits looked at soon. Returns at once."""
        self._due.set()

    def reading(self, scan_id: UUID) -> None:
        """Take note that somebody asks for a file of a scan."""
        self._read_s[scan_id] = self._now_s()

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
                    _log.exception("old scans could not be looked for")

    def apply(self) -> Sequence[UUID]:
        """Remove what is beyond the limits, say so in the log, and return which."""
        self._read_s = {scan: at for scan, at in self._read_s.items() if self._now_s() - at < READ_S}
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
                _log.warning("an old scan could not be removed", scan=str(record.id), cause=str(error))
                continue
            removed.append(record.id)
            _log.info("old scan removed", scan=str(record.id), label=record.label, because=why)
        return removed

    def _beyond(self) -> Iterator[tuple[JobRecord, str]]:
        """The scans to remove, and why, oldest first. Those that are kept whatever they are count, too."""
        size_bytes = 0
        found = []
        for count, record in enumerate(self._store.finished(JobKind.SCAN), 1):
            if self._limits.size_bytes is not None:
                size_bytes += _size_bytes(self._folder.scan(record.id))
            why = self._why(record.finished_at or record.created_at, count, size_bytes)
            if why is not None and not record.pinned and record.id not in self._read_s:
                found.append((record, why))
        yield from reversed(found)

    def _why(self, ended: datetime, count: int, size_bytes: int) -> str | None:
        limits = self._limits
        if limits.count is not None and count > limits.count:
            return f"keep_scans = {limits.count}"
        if limits.days is not None and self._clock() - ended > timedelta(days=limits.days):
            return f"keep_scans_days = {limits.days:g}"
        if limits.size_bytes is not None and size_bytes > limits.size_bytes:
            return f"keep_scans_bytes = {limits.size_bytes}"
        return None


def _size_bytes(folder: Path) -> int:
    return (
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        if folder.is_dir()
        else 0
    )
