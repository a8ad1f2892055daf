"""Verifications as jobs: the board shot with the rig, then read and judged in the worker."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import structlog
from pydantic import TypeAdapter

from slrig.calibrate.pose_shooting import RigQueue
from slrig.calibrate.records import USUAL_PATTERNS
from slrig.calibration.board import Board
from slrig.calibration.health.look import Look, health_of_scan
from slrig.calibration.health.verdict import Health, HealthState
from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    CalibrationStateError,
    ScanCancelledError,
    ScanInterruptedError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.failure import disk_errors, failure_of, interruption
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.endings import Ending, Endings
from slrig.jobs.job import Holder
from slrig.jobs.records import Clock, JobRecord, JobState, utc_now
from slrig.jobs.store import JobStore
from slrig.model import Calibration
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

_log = structlog.get_logger(__name__)


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
        queue: RigQueue,
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
        self._endings = Endings(jobs)
        self._work_ids: dict[UUID, UUID] = {}

    def take_up(self) -> None:
        """Submit again those that waited when the service was killed; what had the rig then was interrupted."""
        for record in self.jobs.unfinished():
            if record.state is not JobState.QUEUED:
                self.jobs.finish(record.id, JobState.INTERRUPTED, fault=failure_of(interruption()))
                continue
            try:
                self._submit(record.id, _plan_adapter.validate_python(record.plan), wait=True)
            except SlrigError as error:
                self.jobs.finish(record.id, JobState.INTERRUPTED, fault=failure_of(error))

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
        plan = VerificationPlan(board, position, exposure_s)
        if status.facts is not None:
            if status.active is None and status.facts.calibration is None:
                raise CalibrationStateError(_UNCALIBRATED)
            if position is not None and not 0 <= position < len(status.facts.positions):
                message = f"position: found {position}, this rig has {len(status.facts.positions)} of them"
                raise UnsupportedByDeviceError(message)
            self._folder.require_space(check_plan(plan.scan, status.facts) + self._spare_bytes)
        job_id = uuid4()
        document = _plan_adapter.dump_python(plan, mode="json")
        record = partial(self.jobs.create, document, rig=status.rig, label=None, key=key, job_id=job_id)
        self._submit(job_id, plan, wait=wait, record=record, holder=holder)
        self.jobs.prune(_KEPT)
        return self.jobs.get(job_id)

    def _submit(
        self,
        job_id: UUID,
        plan: VerificationPlan,
        *,
        wait: bool,
        record: Callable[[], object] = lambda: None,
        holder: Holder | None = None,
    ) -> None:
        calibrations: list[Calibration] = []
        words = f"verification {job_id}"

        def begun(work_id: UUID) -> None:
            record()
            self._work_ids[job_id] = work_id

        self._queue.submit_work(
            lambda rig, cancelled: self._shoot(job_id, plan, rig, cancelled, calibrations),
            holder=holder or Holder(words, words, f"/rig/verification/{job_id}"),
            wait=wait,
            ended=lambda error: self._shot(job_id, plan, calibrations, error),
            begun=begun,
        )

    def cancel(self, job_id: UUID) -> JobRecord:
        """Ask a verification to end early. Returns at once; one that is over stays so. Raises JobNotFoundError."""
        found = self.jobs.get(job_id)
        work_id = self._work_ids.get(job_id)
        if work_id is not None and not found.state.final:
            self._queue.cancel_work(work_id)
        return self.jobs.get(job_id)

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
        """See `slrig.scan.job.WatchesHealth`."""
        health, latest, _ = self.health()
        return None if latest is None else health_stamp(health, latest)

    def note(self, report: Mapping[str, Any]) -> None:
        """See `slrig.scan.job.WatchesHealth`."""
        _, _, calibration = self.health()
        look = health_of_scan(report["redundancy"].get("residual_px") or ())
        if look is not None and calibration is not None:
            self.note_scan(look, calibration)

    def note_scan(self, look: Look, calibration: Calibration) -> VerificationRecord:
        """Put on record what a scan's own redundancy says of the calibration that it was measured by."""
        return self.store.add(look, calibration=calibration.solve_id, at=self._clock())

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent."""
        self._endings.close()

    def _shoot(
        self,
        job_id: UUID,
        plan: VerificationPlan,
        rig: Rig,
        cancelled: Callable[[], bool],
        found: list[Calibration],
    ) -> None:
        """On the rig's thread: move the board if asked, and record a bundle."""
        self.jobs.advance(job_id, JobState.CAPTURING)
        if rig.calibration is None:
            raise CalibrationStateError(_UNCALIBRATED)
        found.append(rig.calibration)
        if plan.position is not None and rig.positioner is not None:
            rig.positioner.move(plan.position)
        staged = self._folder.stage(job_id)
        # A verification must not use what a rendered rig knows of its scene.
        bare = replace(rig, calibration=None, head=None)
        with disk_errors(staged):
            self._tools.capture(bare, plan.scan, staged / "bundle", progress=lambda *_: None, cancelled=cancelled)

    def _shot(self, job_id: UUID, plan: VerificationPlan, found: list[Calibration], error: Exception | None) -> None:
        """The rig is free: read and judge on a thread of its own, or tell why there is nothing to be read."""
        self._work_ids.pop(job_id, None)
        if error is not None or not found:
            self._fail(job_id, error or CalibrationError(_UNCALIBRATED))
            return
        # A daemon, so that a reading under way never holds up the end of the service.
        threading.Thread(
            target=self._judge, args=(job_id, plan.board, found[0]), name="slrig-verification", daemon=True
        ).start()

    def _judge(self, job_id: UUID, board: Board, calibration: Calibration) -> None:
        try:
            self.jobs.advance(job_id, JobState.COMPUTING)
        except StorageError as error:
            # That record is for whoever looks on.
            _log.warning("that a verification is judged could not be recorded", job=str(job_id), cause=str(error))
        try:
            bundle: Path = self._folder.staging(job_id) / "bundle"
            look = verify_bundle(bundle, board, calibration, tools=self._tools)
            record = self.store.add(look, calibration=calibration.solve_id, at=self._clock())
        except Exception as error:  # noqa: BLE001 - whatever happens, whoever waits has to be told
            self._fail(job_id, error)
        else:
            self._end(Ending(job_id, JobState.SUCCEEDED, None, record.document()))

    def _fail(self, job_id: UUID, error: Exception) -> None:
        state = JobState.FAILED
        if isinstance(error, ScanCancelledError):
            state = JobState.CANCELLED
        elif isinstance(error, ScanInterruptedError):
            if self.jobs.get(job_id).state is JobState.QUEUED:
                # The next start of the service takes it up.
                return
            state = JobState.INTERRUPTED
        else:
            _log.warning("a verification failed", job=str(job_id), cause=str(error))
        self._end(Ending(job_id, state, failure_of(error)))

    def _end(self, ending: Ending) -> None:
        shutil.rmtree(self._folder.staging(ending.id), ignore_errors=True)
        self._endings.add(ending)
        self._endings.settle()
