"""Scans as jobs: captured with the rig, reconstructed in the worker, alone or as a series; how long they are kept."""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar, Self
from uuid import UUID, uuid4

import structlog
from pydantic import TypeAdapter

from slrig.disk import storage_errors
from slrig.errors import JobNotFoundError, ScanStateError, StorageError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.manager import JobManager
from slrig.jobs.records import STAGES_S, Clock, JobKind, JobRecord, utc_now
from slrig.jobs.store import JobStore
from slrig.model import Region
from slrig.rig.session import RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import MESH, REPORT
from slrig.scan.plan import ScanPlan, check_plan, series_of

_plan_adapter = TypeAdapter(ScanPlan)


def plan_json(plan: ScanPlan) -> dict[str, Any]:
    """The plan as JSON values.

    >>> plan_from_json(plan_json(ScanPlan(exposure_s=0.02))).exposure_s
    0.02
    """
    document: dict[str, Any] = _plan_adapter.dump_python(plan, mode="json")
    return document


def plan_from_json(document: Mapping[str, Any]) -> ScanPlan:
    """The inverse of `plan_json`."""
    return _plan_adapter.validate_python(document)


def report_summary(report: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a report that is worth a row in a list: its plain values, and the whole of "truth", "mesh",
    "notes", "turntable" (its angle), "computed", and the seconds of each stage of the work.

    >>> report_summary({"method": "Gray-only", "stages": {"decode": 0.1}, "truth": {"rms_mm": float("nan")}})
    {'method': 'Gray-only', 'truth': {'rms_mm': None}}
    """
    return {
        name: _finite(value)
        for name, value in report.items()
        if name in {"truth", "mesh", "notes", "turntable", "computed", STAGES_S}
        or value is None
        or isinstance(value, (bool, int, float, str))
    }


def _finite(value: Any) -> Any:
    """The value with null for every number that JSON has no form for."""
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


PIPELINE = "slrig.scan.reconstruct"
"""What the worker prepares for: the reconstruction of scans, whose kernels are compiled once on each machine."""


@dataclass(frozen=True, slots=True)
class ScanJob(Job):
    """One scan."""

    kind: ClassVar[JobKind] = JobKind.SCAN
    feeds: ClassVar[bool] = True
    keeps_bundle: ClassVar[bool] = True
    movable: ClassVar[bool] = True
    promises: ClassVar[tuple[str, ...]] = (MESH, REPORT)
    noun: ClassVar[str] = "reconstruction"
    remedy: ClassVar[str] = "The bundle is kept: download bundle.zip and run `slrig reconstruct` on it, or scan again."

    plan: ScanPlan

    @property
    def parent(self) -> UUID | None:
        """Its series, or the model that it is a view of."""
        return None if self.plan.series is None else self.plan.series.id

    @property
    def capture_share(self) -> float:
        """See `Job`."""
        return 0.5

    @property
    def region(self) -> Region | None:
        """See `Job`."""
        return self.plan.reconstruction.region

    @property
    def due_in_s(self) -> float:
        """See `Job`."""
        return 0.0 if self.plan.series is None else (self.plan.series.due_at - utc_now()).total_seconds()

    def document(self) -> dict[str, Any]:
        """See `Job`."""
        return plan_json(self.plan)

    @classmethod
    def from_record(cls, record: JobRecord) -> Self:
        """See `Job`."""
        return cls(plan_from_json(record.plan))

    def check(self, rig: RigSession) -> int:
        """See `Job`. Frames are counted once as captured, and once for meshes and the zipped bundle of a client.

        Raises PatternError, UnsupportedByDeviceError, CalibrationError.
        """
        rig.refuse_misfit()
        return 0 if rig.facts is None else 2 * check_plan(self.plan, rig.facts, rig.calibration)

    def capture(self, rig: RigSession, run: JobRun) -> Recording:
        """Record a bundle, and show its frames to the worker meanwhile."""
        return capture_frames(
            rig.open(), self.plan, run.recording,
            progress=run.report, cancelled=run.cancelled, frames=run.frames, health=rig.health(),
        )  # fmt: skip

    def compute(self, run: JobRun) -> Outcome:
        """Reconstruct the bundle."""
        with storage_errors(run.result):
            shutil.rmtree(run.result, ignore_errors=True)
            run.result.mkdir()
        report = run.pipeline.reconstruct_into(
            run.bundle, run.result, plan=self.plan.reconstruction, progress=run.report, cancelled=run.cancelled,
            made=run.file_ready, live=run.live, judged=run.evidence, where=run.where,
        )  # fmt: skip
        return Outcome(report_summary(report))

    def place(self, data: DataFolder, job_id: UUID) -> Path:
        """See `Job`."""
        return data.scan(job_id)

    @classmethod
    def places(cls, data: DataFolder) -> Iterable[Path]:
        """See `Job`."""
        return sorted(data.scans.iterdir())


def scans_of(plan: ScanPlan, *, repeat: int = 1, every_s: float = 0.0) -> list[ScanJob]:
    """So many scans, one every `every_s`: a series, unless it is one."""
    if repeat == 1:
        return [ScanJob(plan)]
    return [ScanJob(each) for each in series_of(plan, uuid4(), count=repeat, every_s=every_s, begins_at=utc_now())]


def series(store: JobStore, series_id: UUID) -> Sequence[JobRecord]:
    """The scans of a series that are on record, in their order. Raises JobNotFoundError: there are none."""
    scans = [record for record in store.of(series_id) if record.kind is JobKind.SCAN]
    if not scans:
        message = f"No series {series_id} is on record here. GET /scan lists scans, and the series of each."
        raise JobNotFoundError(message)
    return scans


def cancel_series(manager: JobManager, series_id: UUID) -> Sequence[JobRecord]:
    """Ask all scans of a series to stop. Raises JobNotFoundError: there is none of that id."""
    # The last first: no other one begins meanwhile.
    return [manager.cancel(scan.id) for scan in reversed(series(manager.store, series_id))][::-1]


def cloud_bytes(place: Path, form: str, camera: str | None) -> bytes:
    """One of the files that are made of a finished scan on request, made in the worker."""
    # Late: the service knows what it offers, and computes nothing.
    from slrig.scan.clouds import cloud_file

    return cloud_file(place, form, camera)


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
