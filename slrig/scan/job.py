"""A scan on the rig: captured, reconstructed when the rig is free, put in its place, and ended in one final state
whatever happens.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import structlog

from slrig.bundle import write_health
from slrig.capture import EvidenceSummary
from slrig.devices import Rig
from slrig.errors import StorageError
from slrig.failure import disk_errors
from slrig.jobs.compute import Compute
from slrig.jobs.data_folder import BUNDLE, DataFolder, missing_files
from slrig.jobs.frame_feed import FrameFeed, FrameSink
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobRecord, JobState, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, Recorded, RigJobs
from slrig.jobs.worker_process import Task
from slrig.rig.session import RigSession
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.records import KeptRecord, plan_from_json, report_summary, write_record

PIPELINE = "slrig.scan.reconstruct"
"""What the worker prepares for: the reconstruction of scans, whose kernels are compiled once on each machine."""

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_log = structlog.get_logger(__name__)


class CaptureFrames(Protocol):
    """`slrig.scan.acquisition.capture_frames`, or what a test puts in its place."""

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
    ) -> Recorded:
        """Play the patterns, record a bundle for `folder`, and show each frame to `frames`."""
        ...


class WatchesHealth(Protocol):
    """What knows the health of the rig's calibration, and learns from scans."""

    def stamp(self) -> Mapping[str, Any] | None:
        """The health now, as a scan's report has it; None where nothing was verified yet."""
        ...

    def note(self, report: Mapping[str, Any]) -> None:
        """Take note of what a finished scan's report says of the calibration."""
        ...


@dataclass(slots=True)
class ScanTools:
    """What every scan is made with.

    spare_bytes : left free on the disk. health : who knows whether the calibration still holds, if anybody does.
    """

    folder: DataFolder
    worker: Compute
    capture: CaptureFrames
    spare_bytes: int
    health: WatchesHealth | None = None


def scan_job(record: JobRecord, tools: ScanTools, jobs: RigJobs) -> Job:
    """The work with the rig that a scan on record asks for."""
    scan = _Scan(record, tools)
    parts = Parts(
        scan.reconstruct,
        # Where the service was killed while it reconstructed, all that is needed lies there.
        None if record.state is JobState.COMPUTING else scan.capture,
        failed=scan.failed,
        # So that the cause can be found.
        salvage=tools.folder.keep_bundle,
        capture_share=CAPTURE_SHARE,
    )
    job = jobs.job(record.id, parts, Holder(str(record.id), f"scan {record.id}", f"/scan/{record.id}"))
    job.since = record.created_at
    series = scan.plan.series
    if series is not None:
        job.due_s = time.monotonic() + (series.due_at - utc_now()).total_seconds()
    return job


@dataclass(frozen=True, slots=True)
class _Stamped:
    """A recording whose bundle tells what the health of the rig's calibration was: see `Recorded`."""

    recording: Recorded
    folder: Path
    health: Mapping[str, Any]

    def finish(self) -> None:
        self.recording.finish()
        with disk_errors(self.folder):
            write_health(self.folder, self.health)

    def discard(self) -> None:
        self.recording.discard()


class _Scan:
    """One scan that waits or is under way."""

    def __init__(self, record: JobRecord, tools: ScanTools) -> None:
        self._record = record
        self._id = record.id
        self.plan = plan_from_json(record.plan)
        self._tools = tools
        self._feed: FrameFeed | None = None

    def capture(self, held: RigSession, job: Job, progress: ProgressRecorder) -> Recorded:
        """Record a bundle, and send its frames to the worker meanwhile. See `Parts`."""
        tools = self._tools
        rig = held.open()
        held.refuse_misfit()
        if held.facts is not None:
            frame_bytes = check_plan(self.plan, held.facts, rig.calibration)
            tools.folder.require_space(2 * frame_bytes + tools.spare_bytes)
        stamp = None if tools.health is None else tools.health.stamp()
        self._feed, folder = tools.worker.feed(self.plan.reconstruction.region), tools.folder.recording(self._id)
        recording = tools.capture(
            rig, self.plan, folder, progress=progress, cancelled=job.stop.is_set, frames=self._feed
        )
        return recording if stamp is None else _Stamped(recording, folder, stamp)

    def failed(self, _: Exception) -> None:
        """Have the worker forget the frames, and be ready for the next scan. See `Parts`."""
        if self._feed is not None:
            self._feed.abandon()
        self._tools.worker.start()

    def reconstruct(self, job: Job, progress: ProgressRecorder) -> Outcome:
        """Make the mesh of the bundle in staging, and put the scan in its place. See `Parts`."""
        tools, record = self._tools, self._record
        staged = tools.folder.clear_results(self._id)
        result = tools.folder.stage_result(self._id)
        judged = None if self._feed is None else self._feed.evidence
        call = reconstruction(tools.worker.module, staged / BUNDLE, result, self.plan.reconstruction, judged)
        report: Mapping[str, Any] = tools.worker.run(
            call, progress=progress, cancelled=job.stop.is_set, made=progress.file_made, feed=self._feed
        )
        _require_promised(result)
        write_record(
            staged,
            KeptRecord(
                self._id, record.rig, record.label, self.plan, record.created_at, job.since, record.requested_by
            ),
        )
        tools.folder.commit(self._id)
        if tools.health is not None:
            try:
                tools.health.note(report)
            except Exception:  # noqa: BLE001 - the scan stands, whatever becomes of that
                _log.exception("what a scan says of its calibration could not be noted")
        return Outcome(report_summary(report))


def reconstruction(
    pipeline: str, bundle: Path, folder: Path, plan: ReconstructionPlan, judged: EvidenceSummary | None = None
) -> Task:
    """The worker's job of reconstructing a bundle into a folder that is there. pipeline : `Compute.module`.

    judged : what the frames proved as they were captured, where this process has captured them.
    """
    return Task(
        f"{pipeline}:reconstruct_into",
        (bundle, folder),
        {"plan": plan, "judged": judged},
        what="reconstruction",
        remedy="The bundle is kept: download bundle.zip and run `slrig reconstruct` on it, or scan again.",
        movable=True,
    )


def _require_promised(result: Path) -> None:
    """Raise StorageError unless the files are there without which no scan has succeeded."""
    missing = missing_files(result)
    if missing:
        message = (
            f"The reconstruction ended, and {' and '.join(missing)} is not on the disk. Check the disk; scan again."
        )
        raise StorageError(message)
