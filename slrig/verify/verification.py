"""A calibration verified: one pose of the board, shot or recorded, read and judged against the calibration in use."""

from __future__ import annotations

import importlib
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import UUID, uuid4

import structlog

from slrig.calibrate.pose_shooting import RigLender
from slrig.calibrate.records import USUAL_PATTERNS
from slrig.calibrate.tools import CapturePose
from slrig.calibration.board import Board
from slrig.calibration.health.look import Look, health_of_scan
from slrig.calibration.health.verdict import Health, HealthState
from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    CalibrationNotFoundError,
    CalibrationStateError,
    PoseRefusedError,
    ScanCancelledError,
    UnsupportedByDeviceError,
)
from slrig.failure import JobFailure, disk_errors, failure_of
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Holder
from slrig.jobs.records import Clock, utc_now
from slrig.jobs.worker import Worker
from slrig.model import Calibration
from slrig.scan.acquisition import capture_bundle
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.verify.store import HealthStore, VerificationRecord

if TYPE_CHECKING:
    from slrig.calibrate.solving import ReadPose

_MOST_JOBS = 200
_STILL_PX = 0.3

_log = structlog.get_logger(__name__)


class JobState(StrEnum):
    """Where a verification stands. The last three are final."""

    QUEUED = "queued"
    SHOOTING = "shooting"
    READING = "reading"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """True when nothing more will happen."""
        return self in {JobState.DONE, JobState.FAILED, JobState.CANCELLED}


@dataclass(frozen=True, slots=True)
class VerificationJob:
    """A verification that was asked for. record : what came of it; fault : why nothing did."""

    id: UUID
    created_at: datetime
    board: Board
    position: int | None = None
    exposure_s: float | None = None
    state: JobState = JobState.QUEUED
    record: VerificationRecord | None = None
    fault: JobFailure | None = None


_READ, _LOOK = "slrig.calibrate.pose_reading:read_pose", "slrig.calibration.health.looking:look_at_board"


@dataclass(frozen=True, slots=True)
class VerificationTools:
    """The shot, the reading and the judgement. The mathematics is loaded when it is first used."""

    capture: CapturePose = capture_bundle
    read: Callable[[Path, Board, str], ReadPose] = field(default_factory=lambda: _later(_READ))
    look: Callable[[Sequence[Any], Board, Calibration], Look] = field(default_factory=lambda: _later(_LOOK))


def verification_tools(worker: Worker) -> VerificationTools:
    """Those of a service: the shot is taken here, the mathematics is the worker's."""
    return VerificationTools(read=worker.task(_READ, "reading of the board"), look=worker.task(_LOOK, "verification"))


def verify_bundle(
    folder: Path, board: Board, calibration: Calibration, /, *, tools: VerificationTools | None = None
) -> Look:
    """Judge a calibration by a recorded pose of the board.

    Raises
    ------
    PoseRefusedError
        The board is not to be seen, or moved while it was shot.
    CalibrationError
        The calibration is of other cameras.
    BundleError, PatternError
        The frames are no sound capture.
    """
    used = VerificationTools() if tools is None else tools
    pose = used.read(folder, board, folder.name)
    for name, figures in pose.figures.items():
        if figures.moved_px > _STILL_PX:
            message = (
                f"camera '{name}': the board moved by {figures.moved_px:.2f} px while it was shot, and more than "
                f"{_STILL_PX} px would be taken for a change of the rig; put it on a stand, and shoot it again"
            )
            raise PoseRefusedError(message)
    return used.look([pose.observation], board, calibration)


def require_healthy(health: Health, *, refuse_when_stale: bool) -> None:
    """Refuse a scan with a stale calibration, if the rig file says so.

    Raises
    ------
    CalibrationStateError
        The calibration is stale; the message says why, and what to do.
    """
    if refuse_when_stale and health.state is HealthState.STALE:
        message = (
            f"The calibration is stale, and this rig's file has scans refused then: {'; '.join(health.reasons)}. "
            f"What to do: {health.remedy or 'calibrate again'}. To scan all the same, set refuse_when_stale = false in "
            "the rig file."
        )
        raise CalibrationStateError(message)


def health_stamp(health: Health, latest: VerificationRecord | None) -> dict[str, Any]:
    """The section `health` of a scan's report: what the rig's health was when it was scanned."""
    return {
        "state": str(health.state),
        "reasons": list(health.reasons),
        "verified_at": None if latest is None else latest.at.isoformat(timespec="seconds"),
        "verification": None if latest is None else str(latest.id),
        "expected_error_mm": None if latest is None else latest.look.expected_mm,
    }


class VerificationDesk:
    """Shoots verifications in line with the scans, and puts on record what they find. Any thread may call."""

    def __init__(
        self,
        folder: DataFolder,
        queue: RigLender,
        store: HealthStore,
        *,
        tools: VerificationTools | None = None,
        clock: Clock = utc_now,
        spare_bytes: int = 0,
    ) -> None:
        self.store = store
        self._folder = folder
        self._queue = queue
        self._tools = VerificationTools() if tools is None else tools
        self._clock = clock
        self._spare_bytes = spare_bytes
        self._lock = threading.Lock()
        self._jobs: OrderedDict[UUID, VerificationJob] = OrderedDict()
        self._work_ids: dict[UUID, UUID] = {}

    def shoot(
        self,
        board: Board,
        *,
        position: int | None = None,
        exposure_s: float | None = None,
        wait: bool = False,
        ended: Callable[[VerificationJob], None] = lambda _: None,
    ) -> VerificationJob:
        """Have the board shot, where the positioner takes it if asked, and the calibration judged. Returns at once.

        wait : stand in line while the rig is held. ended : told once, on another thread, when it is over.

        Raises
        ------
        CalibrationStateError
            The rig has no calibration.
        UnsupportedByDeviceError
            The rig has no positioner, or not that position.
        StorageError, RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        status = self._queue.status()
        plan = ScanPlan(patterns=USUAL_PATTERNS, exposure_s=exposure_s)
        if status.facts is not None:
            if status.active is None and status.facts.calibration is None:
                raise CalibrationStateError(_UNCALIBRATED)
            if position is not None and not 0 <= position < len(status.facts.positions):
                message = f"position: found {position}, this rig has {len(status.facts.positions)} of them"
                raise UnsupportedByDeviceError(message)
            self._folder.require_space(check_plan(plan, status.facts) + self._spare_bytes)
        job = VerificationJob(uuid4(), self._clock(), board, position, exposure_s)
        calibrations: list[Calibration] = []

        def begun(work_id: UUID) -> None:
            with self._lock:
                self._work_ids[job.id] = work_id
                self._jobs[job.id] = job
                while len(self._jobs) > _MOST_JOBS:
                    self._jobs.popitem(last=False)

        self._queue.submit_work(
            lambda rig, cancelled: self._shoot(job, plan, rig, cancelled, calibrations),
            holder=Holder(f"verification {job.id}", f"verification {job.id}", f"/rig/verification/{job.id}"),
            wait=wait,
            ended=lambda error: self._shot(job, calibrations, error, ended),
            begun=begun,
        )
        return job

    def job(self, job_id: UUID) -> VerificationJob:
        """Where a verification stands. Raises CalibrationNotFoundError."""
        with self._lock:
            found = self._jobs.get(job_id)
        if found is None:
            message = f"No verification {job_id} is under way or was lately. GET /rig/health/history lists past ones."
            raise CalibrationNotFoundError(message)
        return found

    def cancel(self, job_id: UUID) -> VerificationJob:
        """Ask a verification to end early. Returns at once; one that is over stays so."""
        found = self.job(job_id)
        work_id = self._work_ids.get(job_id)
        if work_id is not None and not found.state.final:
            self._queue.cancel_work(work_id)
        return self.job(job_id)

    def health(self) -> tuple[Health, VerificationRecord | None, Calibration | None]:
        """The health of the calibration in use, the verification that it rests on, and that calibration."""
        status = self._queue.status()
        active = status.active.calibration if status.active is not None else None
        calibration = active or (None if status.facts is None else status.facts.calibration)
        if calibration is None:
            unknown = Health(HealthState.UNKNOWN, ("the rig has no calibration, or is not open yet",), "calibrate it")
            return unknown, None, None
        found = self.store.since_calibration(calibration.solve_id, limit=1)
        return self.store.health_of(calibration.solve_id), found[-1] if found else None, calibration

    def stamp(self) -> dict[str, Any] | None:
        """See `slrig.jobs.job.WatchesHealth`."""
        health, latest, _ = self.health()
        return None if latest is None else health_stamp(health, latest)

    def note(self, report: Mapping[str, Any]) -> None:
        """See `slrig.jobs.job.WatchesHealth`."""
        _, _, calibration = self.health()
        look = health_of_scan(report["redundancy"].get("residual_px") or ())
        if look is not None and calibration is not None:
            self.note_scan(look, calibration)

    def note_scan(self, look: Look, calibration: Calibration) -> VerificationRecord:
        """Put on record what a scan's own redundancy says of the calibration that it was measured by."""
        return self.store.add(look, calibration=calibration.solve_id, at=self._clock())

    def _staged(self, job: VerificationJob) -> Path:
        return self._folder.incoming / f"verification-{job.id}"

    def _shoot(
        self, job: VerificationJob, plan: ScanPlan, rig: Rig, cancelled: Callable[[], bool], found: list[Calibration]
    ) -> None:
        """On the rig's thread: move the board if asked, and record a bundle."""
        self._change(job.id, state=JobState.SHOOTING)
        if rig.calibration is None:
            raise CalibrationStateError(_UNCALIBRATED)
        found.append(rig.calibration)
        if job.position is not None and rig.positioner is not None:
            rig.positioner.move(job.position)
        with disk_errors(self._staged(job)):
            self._staged(job).mkdir()
        # What a rendered rig knows of its scene is no business of a verification's.
        bare = replace(rig, calibration=None, head=None)
        self._tools.capture(bare, plan, self._staged(job) / "bundle", progress=lambda *_: None, cancelled=cancelled)

    def _shot(
        self,
        job: VerificationJob,
        found: list[Calibration],
        error: Exception | None,
        ended: Callable[[VerificationJob], None],
    ) -> None:
        """The rig is free: read and judge on a thread of its own, or tell why there is nothing to be read."""
        self._work_ids.pop(job.id, None)
        if error is not None or not found:
            self._finish(job, ended, error=error or CalibrationError(_UNCALIBRATED))
            return
        self._change(job.id, state=JobState.READING)
        # A daemon, so that a reading under way never holds up the end of the service.
        threading.Thread(
            target=self._judge, args=(job, found[0], ended), name="slrig-verification", daemon=True
        ).start()

    def _judge(self, job: VerificationJob, calibration: Calibration, ended: Callable[[VerificationJob], None]) -> None:
        try:
            look = verify_bundle(self._staged(job) / "bundle", job.board, calibration, tools=self._tools)
            record = self.store.add(look, calibration=calibration.solve_id, at=self._clock())
        except Exception as error:  # noqa: BLE001 - whatever happens, whoever waits has to be told
            self._finish(job, ended, error=error)
        else:
            self._finish(job, ended, record=record)

    def _finish(
        self,
        job: VerificationJob,
        ended: Callable[[VerificationJob], None],
        *,
        error: Exception | None = None,
        record: VerificationRecord | None = None,
    ) -> None:
        shutil.rmtree(self._staged(job), ignore_errors=True)
        if error is None:
            over = self._change(job.id, state=JobState.DONE, record=record)
        elif isinstance(error, ScanCancelledError):
            over = self._change(job.id, state=JobState.CANCELLED, fault=failure_of(error))
        else:
            _log.warning("a verification failed", verification=str(job.id), cause=str(error))
            over = self._change(job.id, state=JobState.FAILED, fault=failure_of(error))
        ended(over)

    def _change(self, job_id: UUID, **changes: Any) -> VerificationJob:
        with self._lock:
            self._jobs[job_id] = replace(self._jobs[job_id], **changes)
            return self._jobs[job_id]


_UNCALIBRATED = (
    "The rig has no calibration that could be verified. Calibrate it (POST /calibration), activate the result, then "
    "verify that."
)


def _later(name: str) -> Callable[..., Any]:
    module, function = name.split(":")

    def call(*given: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(module), function)(*given, **options)

    return call
