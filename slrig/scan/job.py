"""Scans as jobs: captured with the rig, reconstructed in the worker, alone or as a series; how long they are kept."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self
from uuid import UUID, uuid4

from pydantic import TypeAdapter

from slrig.disk import storage_errors
from slrig.errors import ConfigError, JobNotFoundError, NotCalibratedError, setting
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.records import JobKind, JobRecord, utc_now
from slrig.model import Region
from slrig.rig.session import RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import MESH, REPORT, report_summary
from slrig.scan.plan import RigGuess, ScanPlan, check_plan, series_of

if TYPE_CHECKING:
    # The worker, which loads this for its first scan, has no database.
    from slrig.jobs.manager import JobManager
    from slrig.jobs.store import JobStore

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


_NOT_CALIBRATED = (
    "This rig is not calibrated, and without a calibration a scan has no millimetres. Nothing was captured. Calibrate "
    "it (slrig calibrate run; POST /calibration; Calibrate on the page), or import a calibration of it and activate "
    "that (slrig calibrate import; POST /calibration/import). For a first shape without a board, scan with "
    f"{setting('uncalibrated')}."
)

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
    def from_plan(cls, record: JobRecord) -> Self:
        """See `Job`."""
        return cls(plan_from_json(record.plan))

    def check(self, rig: RigSession) -> int:
        """See `Job`. Frames are counted once as captured, and once for meshes and the zipped bundle of a client.

        Raises PatternError, UnsupportedByDeviceError, CalibrationError; NotCalibratedError, so that nothing is shot
        that cannot be reconstructed.
        """
        rig.refuse_misfit()
        if rig.facts is None:
            return 0
        if self.plan.reconstruction.uncalibrated is not None:
            return 2 * check_plan(self.plan, rig.facts)
        if rig.calibration is None:
            raise NotCalibratedError(_NOT_CALIBRATED)
        return 2 * check_plan(self.plan, rig.facts, rig.calibration)

    def capture(self, rig: RigSession, run: JobRun) -> Recording:
        """Record a bundle, and show its frames to the worker meanwhile, if their devices are calibrated."""
        if self.plan.reconstruction.uncalibrated is not None:
            # A calibration of some of the cameras would be in use for all.
            return capture_frames(replace(rig.open_whole(), calibration=None), self.plan, run.recording, run)
        return capture_frames(
            rig.open(), self.plan, run.recording, run, frames=run.frames, health=rig.health(), may_lose=True
        )

    def compute(self, run: JobRun) -> Outcome:
        """Reconstruct the bundle."""
        with storage_errors(run.result):
            shutil.rmtree(run.result, ignore_errors=True)
            run.result.mkdir()
        report = run.pipeline.reconstruct_into(
            run.bundle, run.result, run, plan=self.plan.reconstruction, live=run.live, judged=run.evidence,
            where=run.where,
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


def with_guess(record: JobRecord, guess: RigGuess) -> ScanJob:
    """A scan of a rig without a calibration, by another guess. Raises ConfigError: the rig was calibrated."""
    plan = ScanJob.from_plan(record).plan
    if plan.reconstruction.uncalibrated is None:
        message = (
            f"{setting('uncalibrated')}: expected a scan that was made without a calibration, found one that used the "
            "rig's; leave it out, or scan again with it"
        )
        raise ConfigError(message)
    return ScanJob(replace(plan, reconstruction=replace(plan.reconstruction, uncalibrated=guess)))


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
