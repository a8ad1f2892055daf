"""Calibrations at the start of the service: poses and solves brought together again with their files."""

from __future__ import annotations

from uuid import UUID, uuid4

import structlog

from slrig.calibrate.pose_answering import outcome_of
from slrig.calibrate.pose_shooting import PoseDesk
from slrig.calibrate.records import SessionRecord
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solves import SolveDesk
from slrig.calibrate.store import READING
from slrig.errors import StorageError
from slrig.failure import failure_of
from slrig.jobs.records import JobKind, JobRecord, JobState

_log = structlog.get_logger(__name__)


def sweep_calibrations(register: CalibrationRegister, poses: PoseDesk, solves: SolveDesk) -> None:
    """Settle what the last run left open, or have it go on. Before the rig is used.

    - A pose that waited is shot; one whose frames are there is read; one that has its answer gets it; one that had the
      rig, and a solve, was interrupted. See `PoseDesk.take_up`, `SolveDesk.take_up`.
    - A pose that was accepted and has no files is recorded as failed.
    - A pose in its place without a record, as beside a database that was lost, is on record again, as it says itself.
    - Jobs of a calibration that is gone are forgotten.
    """
    records = register.all()
    by_session = register.jobs.of()
    for session_id in by_session.keys() - {record.id for record in records}:
        register.jobs.delete_of(session_id)
    for record in records:
        jobs = by_session.get(record.id, [])
        for job in jobs:
            if job.kind is JobKind.SOLVE:
                if not job.state.final:
                    solves.take_up(record.id, job)
            else:
                _settle_pose(register, poses, record.id, job)
        known = {job.plan["number"] for job in jobs if job.kind is JobKind.POSE}
        for number in register.store.pose_numbers(record.id):
            if number not in known:
                _restore(register, record, number)


def _settle_pose(register: CalibrationRegister, poses: PoseDesk, session_id: UUID, job: JobRecord) -> None:
    store, number = register.store, job.plan["number"]
    if not job.state.final and (answer := store.answer(session_id, number)) is not None:
        outcome = outcome_of(answer)
        state = JobState.SUCCEEDED if outcome.fault is None else JobState.FAILED
        register.jobs.finish(job.id, state, fault=outcome.fault, summary=outcome.summary)
    elif not job.state.final:
        poses.take_up(session_id, job)
    elif job.state is JobState.SUCCEEDED and not (store.pose(session_id, number) / READING).is_file():
        message = f"The files of pose {number} are gone from {store.pose(session_id, number)}. Shoot it again."
        register.jobs.lose_files(job.id, failure_of(StorageError(message)))


def _restore(register: CalibrationRegister, record: SessionRecord, number: int) -> None:
    """Put a pose on record again, or remove what is none."""
    answer = register.store.answer(record.id, number)
    if answer is None:
        register.store.discard_pose(record.id, number)
        return
    outcome = outcome_of(answer)
    register.jobs.restore(
        uuid4(),
        answer["pose"],
        outcome.summary or {},
        rig=record.rig,
        label=None,
        created_at=record.created_at,
        started_at=record.created_at,
        fault=outcome.fault,
        parent=record.id,
    )
    _log.warning("left by the last run", calibration=str(record.id), pose=number, found="recovered")
