"""Verifications as jobs: the board shot with the rig, then read and judged in the worker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from uuid import UUID, uuid4

from pydantic import TypeAdapter

from slrig.calibrate.records import USUAL_PATTERNS
from slrig.calibration import Board
from slrig.calibration.health import Health, HealthState, verification_from_scan
from slrig.errors import CalibrationError, CalibrationStateError, UnsupportedByDeviceError
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import Clock, JobRecord, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, Recorded, RigJobs
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.verify.store import HealthStore, VerificationRecord
from slrig.verify.verification import VerificationTools, health_stamp, verify_bundle

_KEPT = 1000
"""Verifications whose job stays on record. What they found is kept longer, by `HealthStore`."""

_UNCALIBRATED = (
    "The rig has no calibration that could be verified. Calibrate it (POST /calibration), activate the result, then "
    "verify that."
)


@dataclass(frozen=True, slots=True)
class VerificationPlan:
    """What is shot. position : of the positioner, by its number; None leaves the board where it is."""

    board: Board
    position: int | None = None
    exposure_s: float | None = None

    @property
    def scan(self) -> ScanPlan:
        """The patterns of one pose."""
        return ScanPlan(patterns=USUAL_PATTERNS, exposure_s=self.exposure_s)


_plan_adapter = TypeAdapter(VerificationPlan)


class VerificationDesk:
    """Shoots verifications in line with the scans, and puts on record what they find. Any thread may call.

    A job's summary is `VerificationRecord.document` of what was found.
    """

    def __init__(
        self,
        folder: DataFolder,
        queue: JobQueue,
        store: HealthStore,
        jobs: JobStore,
        *,
        tools: VerificationTools | None = None,
        clock: Clock = utc_now,
        spare_bytes: int = 0,
    ) -> None:
        self.store = store
        self.jobs = jobs
        self._folder = folder
        self._queue = queue
        self._tools = VerificationTools() if tools is None else tools
        self._clock = clock
        self._spare_bytes = spare_bytes
        self._work = RigJobs(jobs, queue, folder)

    def take_up(self) -> None:
        """Go on with what waited when the service ended; what had the rig then was interrupted."""
        for record in self.jobs.unfinished():
            plan = _plan_adapter.validate_python(record.plan)
            self._work.take_up(record, self._parts(record.id, plan), holder=_holder(record.id))

    def shoot(
        self,
        board: Board,
        *,
        position: int | None = None,
        exposure_s: float | None = None,
        wait: bool = False,
        key: str | None = None,
        holder: Holder | None = None,
    ) -> JobRecord:
        """Have the board shot, where the positioner takes it if asked, and the calibration judged. Returns at once.

        wait : stand in line while the rig is held. key : the idempotency key of the request, reserved.
        holder : whom a refusal names meanwhile; None the verification.

        Raises CalibrationStateError if the rig has no calibration; UnsupportedByDeviceError if it has no positioner, or
        not that position; StorageError, RigBusyError, QueueFullError, DeviceError as a scan.
        """
        rig, plan = self._queue.rig, VerificationPlan(board, position, exposure_s)
        if rig.facts is not None:
            if rig.active is None and rig.facts.calibration is None:
                raise CalibrationStateError(_UNCALIBRATED)
            if position is not None and not 0 <= position < len(rig.facts.positions):
                message = f"position: found {position}, this rig has {len(rig.facts.positions)} of them"
                raise UnsupportedByDeviceError(message)
            self._folder.require_space(check_plan(plan.scan, rig.facts) + self._spare_bytes)
        job_id = uuid4()
        document = _plan_adapter.dump_python(plan, mode="json")
        record = partial(self.jobs.create, document, rig=rig.name, label=None, key=key, job_id=job_id)
        parts = self._parts(job_id, plan)
        self._work.submit(job_id, parts, holder=holder or _holder(job_id), wait=wait, record=record)
        self.jobs.prune(_KEPT)
        return self.jobs.get(job_id)

    def cancel(self, job_id: UUID) -> JobRecord:
        """Ask a verification to end early. Returns at once; one that is over stays so. Raises JobNotFoundError."""
        self._work.cancel(job_id)
        return self.jobs.get(job_id)

    def health(self) -> tuple[Health, VerificationRecord | None, Calibration | None]:
        """The health of the calibration in use, the verification that it rests on, and that calibration."""
        active, facts = self._queue.rig.active, self._queue.rig.facts
        calibration = active.calibration if active is not None else None if facts is None else facts.calibration
        if calibration is None:
            unknown = Health(HealthState.UNKNOWN, ("the rig has no calibration, or is not open yet",), "calibrate it")
            return unknown, None, None
        found = self.store.since_calibration(calibration.solve_id, limit=1)
        return self.store.health_of(calibration.solve_id), found[-1] if found else None, calibration

    def stamp(self) -> dict[str, Any] | None:
        """See `slrig.scan.job.WatchesHealth`."""
        health, latest, _ = self.health()
        return None if latest is None else health_stamp(health, latest)

    def note(self, report: Mapping[str, Any]) -> None:
        """See `slrig.scan.job.WatchesHealth`."""
        _, _, calibration = self.health()
        found = verification_from_scan(report["redundancy"].get("residual_px") or ())
        if found is not None and calibration is not None:
            self.store.add(found, calibration=calibration.solve_id, at=self._clock())

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent."""
        self._work.close()

    def _parts(self, job_id: UUID, plan: VerificationPlan) -> Parts:
        """The two parts of a verification."""
        calibration: Calibration | None = None

        def capture(held: RigSession, job: Job, progress: ProgressRecorder) -> Recorded:
            """Move the board if asked, and record a bundle."""
            nonlocal calibration
            rig = held.open()
            if rig.calibration is None:
                raise CalibrationStateError(_UNCALIBRATED)
            calibration = rig.calibration
            if plan.position is not None and rig.positioner is not None:
                rig.positioner.move(plan.position)
            # A verification must not use what a rendered rig knows of its scene.
            bare, folder = replace(rig, calibration=None, head=None), self._folder.recording(job_id)
            return self._tools.capture(bare, plan.scan, folder, progress=progress, cancelled=job.stop.is_set)

        def compute(*_: object) -> Outcome:
            """Read the board, and judge the calibration by it."""
            if calibration is None:
                raise CalibrationError(_UNCALIBRATED)
            bundle = self._folder.staging(job_id) / BUNDLE
            found = verify_bundle(bundle, plan.board, calibration, tools=self._tools)
            return Outcome(self.store.add(found, calibration=calibration.solve_id, at=self._clock()).document())

        return Parts(compute, capture)


def _holder(job_id: UUID) -> Holder:
    words = f"verification {job_id}"
    return Holder(words, words, f"/rig/verification/{job_id}")
