"""A scan on the rig: captured, reconstructed when the rig is free, put in its place, and ended in one final state
whatever happens.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import structlog

from slrig.bundle.health import write_health
from slrig.devices import Rig
from slrig.errors import ScanCancelledError, ScanInterruptedError, StorageError
from slrig.failure import disk_errors
from slrig.jobs.data_folder import DataFolder, missing_files
from slrig.jobs.endings import Ending, Endings, ending_by
from slrig.jobs.frame_feed import FrameFeed, FrameSink
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobRecord, JobState, utc_now
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.jobs.worker_process import Task
from slrig.rig.session import RigSession, driver_errors
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.records import KeptRecord, plan_from_json, report_summary, write_record

PIPELINE = "slrig.scan.reconstruct"
"""What the worker prepares for: the reconstruction of scans, whose kernels are compiled once on each machine."""

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_log = structlog.get_logger(__name__)


class Recorded(Protocol):
    """`slrig.scan.acquisition.Recording`, or what a test puts in its place."""

    def finish(self) -> None:
        """Bring the bundle to its place."""
        ...

    def discard(self) -> None:
        """Let it go."""
        ...


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
    after : called, on any thread, when a scan is over.
    """

    store: JobStore
    folder: DataFolder
    worker: Worker
    capture: CaptureFrames
    endings: Endings
    spare_bytes: int
    health: WatchesHealth | None = None
    after: Callable[[], None] = lambda: None


def scan_job(record: JobRecord, tools: ScanTools) -> Job:
    """The work with the rig that a scan on record asks for."""
    scan = _Scan(record, tools)
    holder = Holder(str(record.id), f"scan {record.id}", f"/scan/{record.id}")
    # Where the service was killed while it reconstructed, all that is needed lies there.
    work = None if record.state is JobState.COMPUTING else scan.capture
    job = Job(
        record.id, holder, record.created_at, work, scan.ended, scan.reconstruct, scan.clear_up, scan.concluded
    )  # fmt: skip
    series = scan.plan.series
    if series is not None:
        job.due_s = time.monotonic() + (series.due_at - utc_now()).total_seconds()
    return job


class _Scan:
    """One scan that waits or is under way."""

    def __init__(self, record: JobRecord, tools: ScanTools) -> None:
        self._record = record
        self._id = record.id
        self.plan = plan_from_json(record.plan)
        self._tools = tools
        self._job: Job | None = None
        self._feed: FrameFeed | None = None
        self._recording: Recorded | None = None
        self._stamp: Mapping[str, Any] | None = None
        self._captured = self._worked = False
        self._summary: Mapping[str, Any] | None = None

    def clear_up(self, error: Exception | None) -> None:
        """Keep the bundle of a scan that failed, if it has one, so that its cause can be found; clear away all else."""
        self._worked = True
        folder = self._tools.folder
        if error is not None and not self._goes_on(error):
            try:
                if self._recording is not None:
                    self._recording.discard()
                elif not isinstance(error, ScanCancelledError):
                    folder.keep_bundle(self._id)
            except Exception:  # noqa: BLE001 - see below
                # The scan's own fault is the one to tell; without its bundle it is told all the same.
                _log.exception("the bundle of a failed scan could not be kept", scan=str(self._id))
            folder.discard(self._id)
        self._tools.worker.start()

    def concluded(self, error: Exception | None) -> None:
        """See `Job`."""
        if error is None:
            self._tools.endings.add(Ending(self._id, JobState.SUCCEEDED, None, self._summary))
        elif self._goes_on(error):
            _log.info("a scan is left to the next start of the service", scan=str(self._id))
        else:
            ending = ending_by(error, self._id, hidden=self._tools.folder.hidden(self._id))
            if (
                ending.state is JobState.FAILED
                and not self._worked
                and self._job is not None
                and self._job.stop.is_set()
            ):
                # It was to end, and its driver hangs.
                ending = replace(ending, state=JobState.CANCELLED)
            self._tools.endings.add(ending)

    def ended(self, _error: Exception | None) -> None:
        """See `Job`."""
        self._tools.endings.settle()
        self._tools.after()

    def _goes_on(self, error: Exception) -> bool:
        """Whether the next start of the service takes the scan up, as `slrig.scan.sweep` does."""
        return isinstance(error, ScanInterruptedError) and (self._job is None or self._captured)

    def capture(self, held: RigSession, job: Job) -> None:
        """Record a bundle in staging, and send its frames to the worker meanwhile. See `Job.work`."""
        self._job = job
        tools = self._tools
        tools.endings.settle()
        job.since = tools.store.advance(self._id, JobState.CAPTURING)
        rig = held.open()
        held.refuse_misfit()
        if held.facts is not None:
            frame_bytes = check_plan(self.plan, held.facts, rig.calibration)
            tools.folder.require_space(2 * frame_bytes + tools.spare_bytes)
        tools.folder.stage(self._id)
        feed = self._feed = tools.worker.feed()
        progress = self._progress(0.0, CAPTURE_SHARE)
        try:
            with driver_errors(held.name):
                self._recording = tools.capture(
                    rig, self.plan, tools.folder.recording(self._id),
                    progress=progress, cancelled=job.stop.is_set, frames=feed,
                )  # fmt: skip
        except Exception as error:
            feed.abandon()
            held.doubt(error)
            raise
        held.darken()
        self._stamp = None if tools.health is None else tools.health.stamp()
        if job.stop.is_set():
            feed.abandon()
            message = "The scan was cancelled."
            raise ScanCancelledError(message)

    def reconstruct(self, job: Job) -> None:
        """Make the mesh of the bundle in staging, and put the scan in its place. See `Job.compute`."""
        self._job, tools = job, self._tools
        if self._recording is not None:
            self._progress(CAPTURE_SHARE, 1.0).captured()
        self._keep_recording()
        self._captured = self._on_record_as_computing()
        staged = tools.folder.clear_results(self._id)
        bundle, result = staged / "bundle", tools.folder.stage_result(self._id)
        call = reconstruction(tools.worker.module, bundle, result, self.plan.reconstruction)
        progress = self._progress(CAPTURE_SHARE, 1.0)
        feed, self._feed = self._feed, None
        report: Mapping[str, Any] = tools.worker.run(
            call, progress=progress, cancelled=job.stop.is_set, made=progress.file_made, feed=feed
        )
        _require_promised(result)
        record = self._record
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
        self._summary = report_summary(report)

    def _on_record_as_computing(self) -> bool:
        """Record that all is there to compute with, whatever ends the service; return whether that could be done."""
        try:
            self._tools.store.advance(self._id, JobState.COMPUTING)
        except StorageError as error:
            _log.warning("that a scan is reconstructed could not be recorded", scan=str(self._id), cause=str(error))
            return False
        return True

    def _keep_recording(self) -> None:
        """Make what was captured, if it was in this run of the service, the scan's bundle."""
        recording, self._recording = self._recording, None
        if recording is None:
            return
        folder = self._tools.folder
        try:
            recording.finish()
            if self._stamp is not None:
                with disk_errors(folder.recording(self._id)):
                    write_health(folder.recording(self._id), self._stamp)
            folder.keep_recording(self._id)
        except Exception:
            if self._feed is not None:
                self._feed.abandon()
            raise

    def _progress(self, start: float, end: float) -> ProgressRecorder:
        return ProgressRecorder(
            self._tools.store, self._id, hidden=self._tools.folder.hidden(self._id), span=(start, end)
        )


def reconstruction(pipeline: str, bundle: Path, folder: Path, plan: ReconstructionPlan) -> Task:
    """The worker's job of reconstructing a bundle into a folder that is there. pipeline : `Worker.module`."""
    return Task(
        f"{pipeline}:reconstruct_into",
        (bundle, folder),
        {"plan": plan},
        what="reconstruction",
        remedy="The bundle is kept: download bundle.zip and run `slrig reconstruct` on it, or scan again.",
    )


def _require_promised(result: Path) -> None:
    """Raise StorageError unless the files are there without which no scan has succeeded."""
    missing = missing_files(result)
    if missing:
        message = (
            f"The reconstruction ended, and {' and '.join(missing)} is not on the disk. Check the disk; scan again."
        )
        raise StorageError(message)
