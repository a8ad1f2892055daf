"""A scan on the rig: captured, reconstructed, put in its place, and ended in one final state whatever happens."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import structlog

from slrig.bundle.health import write_health
from slrig.devices import Rig
from slrig.errors import ScanCancelledError, ScanInterruptedError, SlrigError, StorageError
from slrig.failure import UNEXPECTED, JobFailure, disk_errors, failure_of, interruption
from slrig.jobs.channel import Task
from slrig.jobs.data_folder import DataFolder, missing_files, sync_tree
from slrig.jobs.endings import Ending, Endings
from slrig.jobs.frame_feed import FrameFeed, FrameSink
from slrig.jobs.job import Holder
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.rig.session import RigSession, driver_errors
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.records import KeptRecord, plan_from_json, report_summary, write_record

PIPELINE = "slrig.scan.reconstruct"
"""What the worker prepares for: the reconstruction of scans, whose kernels are compiled once on each machine."""

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_log = structlog.get_logger(__name__)


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
class ScanTools:
    """What every scan is made with.

    spare_bytes : left free on the disk. ending : tells that the service ends. health : who knows whether the
    calibration still holds, if anybody does. after : called when a scan is over.
    """

    store: JobStore
    folder: DataFolder
    worker: Worker
    capture: CaptureBundle
    endings: Endings
    spare_bytes: int
    ending: Callable[[], bool]
    health: Callable[[], WatchesHealth | None] = lambda: None
    after: Callable[[], None] = lambda: None


class ScanJob:
    """One scan that waits or is under way. Implements `slrig.jobs.job.Job`."""

    def __init__(self, record: JobRecord, tools: ScanTools) -> None:
        self._record = record
        self.id = record.id
        self.holder = Holder(str(record.id), f"scan {record.id}", f"/scan/{record.id}")
        self.since = record.created_at
        self.stop = threading.Event()
        self._plan = plan_from_json(record.plan)
        self._tools = tools
        self._begun = False
        self._captured = False
        self._ending: Ending | None = Ending(record.id, JobState.FAILED, failure_of(RuntimeError()))

    def run(self, held: RigSession) -> None:
        """See `Job`."""
        self._begun = True
        self._tools.endings.settle()
        self._ending = self._ended(held)

    def clear_up(self) -> None:
        """See `Job`."""
        if self._ending is not None and self._ending.state is not JobState.SUCCEEDED:
            self._keep_evidence(self._ending.state)
        self._tools.worker.start()

    def conclude(self) -> None:
        """See `Job`."""
        if self._ending is not None:
            self._tools.endings.add(self._ending)

    def cut_off(self, error: SlrigError) -> None:
        """See `Job`."""
        state = JobState.FAILED
        if isinstance(error, ScanInterruptedError) and self._goes_on:
            return
        if isinstance(error, ScanInterruptedError):
            state = JobState.INTERRUPTED
        elif isinstance(error, ScanCancelledError) or self.stop.is_set():
            state = JobState.CANCELLED
        self._tools.endings.add(Ending(self.id, state, failure_of(error)))

    def settle(self) -> None:
        """See `Job`."""
        self._tools.endings.settle()
        self._tools.after()

    @property
    def _goes_on(self) -> bool:
        """Whether the next start of the service takes the scan up, as `slrig.scan.sweep` does."""
        return not self._begun or self._captured

    def _ended(self, held: RigSession) -> Ending | None:
        """How it ended; None where the service ends first and the next one goes on with it."""
        log = _log.bind(scan=str(self.id))
        state, summary, fault = JobState.FAILED, None, None
        try:
            summary = self._walk(held)
            state = JobState.SUCCEEDED
        except Exception as error:
            fault = self._told(error)
            if self._tools.ending() and self._captured:
                log.info("a scan is left to the next start of the service")
                return None
            if self._tools.ending():
                state, fault = JobState.INTERRUPTED, failure_of(interruption())
            elif isinstance(error, ScanCancelledError):
                state = JobState.CANCELLED
            elif fault.code == UNEXPECTED:
                log.exception("scan failed", code=fault.code)
            else:
                log.warning("scan failed", code=fault.code, cause=fault.message)
        return Ending(self.id, state, fault, summary)

    def _told(self, error: Exception) -> JobFailure:
        # The staging folder is gone when the message is read: what it names is then the scan's own bundle.
        fault = failure_of(error)
        return JobFailure(fault.code, fault.message.replace(f"{self._tools.folder.staging(self.id)}/", ""))

    def _walk(self, held: RigSession) -> Mapping[str, Any]:
        tools = self._tools
        progress = ProgressRecorder(tools.store, self.id, hidden=f"{tools.folder.staging(self.id)}/")
        if self._record.state is JobState.COMPUTING:
            # The service was killed in the middle of it: all that is needed lies there.
            return self._reconstructed(tools.folder.clear_results(self.id), progress, None)
        self.since = tools.store.advance(self.id, JobState.CAPTURING)
        rig = held.open()
        held.refuse_misfit()
        if held.facts is not None:
            frame_bytes = check_plan(self._plan, held.facts, rig.calibration)
            tools.folder.require_space(2 * frame_bytes + tools.spare_bytes)
        staged = tools.folder.stage(self.id)
        bundle = staged / "bundle"
        progress.span(0.0, CAPTURE_SHARE)
        feed = tools.worker.feed()
        try:
            with driver_errors(held.name):
                tools.capture(rig, self._plan, bundle, progress=progress, cancelled=self.stop.is_set, frames=feed)
        except Exception as error:
            feed.abandon()
            held.doubt(error)
            raise
        held.darken()
        health = tools.health()
        with disk_errors(staged):
            if health is not None and (stamp := health.stamp()) is not None:
                write_health(bundle, stamp)
            sync_tree(bundle)
        if self.stop.is_set():
            feed.abandon()
            message = "The scan was cancelled."
            raise ScanCancelledError(message)
        return self._reconstructed(staged, progress, feed)

    def _reconstructed(self, staged: Path, progress: ProgressRecorder, feed: FrameFeed | None) -> Mapping[str, Any]:
        """Make the mesh of the bundle in staging, put the scan in its place, and return the summary of its report."""
        tools, bundle = self._tools, staged / "bundle"
        self._captured = self._reconstructing()
        progress.span(CAPTURE_SHARE, 1.0)
        call = reconstruction(tools.worker.module, bundle, staged / "result", self._plan.reconstruction)
        report: Mapping[str, Any] = tools.worker.run(call, progress=progress, cancelled=self.stop.is_set, feed=feed)
        _require_promised(staged / "result")
        record = self._record
        write_record(staged, KeptRecord(self.id, record.rig, record.label, self._plan, record.created_at, self.since))
        tools.folder.commit(self.id)
        if (health := tools.health()) is not None:
            _noted(health, report)
        return report_summary(report)

    def _reconstructing(self) -> bool:
        """Record that the bundle is whole, and return whether that is on record; the scan goes on without."""
        try:
            self._tools.store.advance(self.id, JobState.COMPUTING)
        except StorageError as error:
            _log.warning("that a scan is reconstructed could not be recorded", scan=str(self.id), cause=str(error))
            return False
        return True

    def _keep_evidence(self, state: JobState) -> None:
        """Keep the bundle of a scan that failed, if it has one, so that its cause can be found; clear away all else."""
        folder = self._tools.folder
        try:
            if state is not JobState.CANCELLED and (folder.staging(self.id) / "bundle").is_dir():
                folder.keep_bundle(self.id)
        except Exception:  # noqa: BLE001 - see below
            # The scan's own fault is the one to tell; without its bundle it is told all the same.
            _log.exception("the bundle of a failed scan could not be kept", scan=str(self.id))
        folder.discard(self.id)


def reconstruction(pipeline: str, bundle: Path, output: Path, plan: ReconstructionPlan) -> Task:
    """The worker's job of reconstructing a bundle. pipeline : `Worker.module`."""
    return Task(
        f"{pipeline}:reconstruct_bundle",
        (bundle, output),
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


def _noted(health: WatchesHealth, report: Mapping[str, Any]) -> None:
    """Tell what a scan says of its calibration. The scan stands, whatever becomes of that."""
    try:
        health.note(report)
    except Exception:  # noqa: BLE001 - see above
        _log.exception("what a scan says of its calibration could not be noted")
