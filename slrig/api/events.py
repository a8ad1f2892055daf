"""What happens to jobs and to calibrations, as event streams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from slrig.api.openapi import problems
from slrig.api.problems import fault_problem
from slrig.api.service import Serving
from slrig.api.streams import Followed, LastEventId, event_stream, stream_answers
from slrig.calibrate.records import SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.errors import CalibrationNotFoundError, JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.records import JobEvent, JobState
from slrig.jobs.store import JobStore

router = APIRouter()

_SOLVES = {
    JobState.QUEUED: SessionState.OPEN,
    JobState.COMPUTING: SessionState.SOLVING,
    JobState.SUCCEEDED: SessionState.SOLVED,
    JobState.FAILED: SessionState.FAILED,
    JobState.INTERRUPTED: SessionState.FAILED,
}
"""What a calibration is while its newest solve is in a state."""

_JOB = stream_answers(
    "`progress` events with stage, fraction and detail; `state` events with the new state. The stream ends after the "
    "event of a final state.",
    "nothing has happened since the event that was named, and nothing more will",
)
_CALIBRATION = stream_answers(
    "`pose` events with the number and the new state of a pose; `progress` events with stage, fraction and detail, and "
    "the number of the pose; `state` events when a solve begins (`solving`) and ends (`solved`, `failed`). The stream "
    "ends when nothing is under way any more. Event numbers rise, with gaps.",
    "nothing has happened since the event that was named, and nothing is under way",
)


@router.get(
    "/scan/{scan_id}/events", tags=["scan"], response_class=Response, responses={**_JOB, **problems(404, 422, 429)}
)
async def follow_scan(request: Request, service: Serving, scan_id: UUID, last_event_id: LastEventId = 0) -> Response:
    """Follow a scan until it is over. Events that happened before come first."""
    return await _follow_job(request, service, service.store, scan_id, last_event_id)


@router.get(
    "/rig/verification/{verification_id}/events",
    tags=["health"],
    response_class=Response,
    responses={**_JOB, **problems(404, 422, 429)},
)
async def follow_verification(
    request: Request, service: Serving, verification_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a verification until it is over. Events that happened before come first."""
    return await _follow_job(request, service, service.verifications.jobs, verification_id, last_event_id)


@router.get(
    "/calibration/{calibration_id}/events",
    tags=["calibration"],
    response_class=Response,
    responses={**_CALIBRATION, **problems(404, 422, 429)},
)
async def follow_calibration(
    request: Request, service: Serving, calibration_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a calibration while something is under way. Events that happened before come first."""
    register = service.calibrations.register
    await run_in_threadpool(register.get, calibration_id)
    followed = Followed(
        partial(_look_at_calibration, register, calibration_id),
        partial(register.jobs.watch, calibration_id),
        partial(register.jobs.last_event_of, calibration_id),
        _data,
    )
    return await event_stream(request, service.settings, followed, last_event_id)


def _look_at_calibration(
    register: CalibrationRegister, calibration_id: UUID, after: int
) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: what ends between the two looks has its last event among those found.
        record = register.get(calibration_id)
    except CalibrationNotFoundError:
        return (), True
    numbers = {pose.id: pose.number for pose in record.poses}
    found = [
        _of_calibration(event, numbers.get(event.job)) for event in register.jobs.events_of(calibration_id, after=after)
    ]
    return found, not record.under_way


def _of_calibration(event: JobEvent, pose: int | None) -> JobEvent:
    """An event of a pose, or of a solve where `pose` is None, as one of the calibration."""
    if event.kind == "progress":
        return replace(event, data={**event.data, "pose": pose})
    if pose is not None:
        return replace(event, kind="pose", data={**event.data, "pose": pose})
    return replace(event, data={**event.data, "state": _SOLVES[event.data["state"]]})


async def _follow_job(request: Request, service: Serving, jobs: JobStore, job_id: UUID, after: int) -> Response:
    # One that is on no record is refused here; one that is deleted later only ends its stream.
    await run_in_threadpool(jobs.get, job_id)
    return await event_stream(request, service.settings, followed_job(jobs, job_id), after)


def followed_job(jobs: JobStore, job_id: UUID) -> Followed:
    """A job as it is followed until its state is final; it may be deleted meanwhile."""
    return Followed(
        partial(_look, jobs, job_id), partial(jobs.watch, job_id), partial(_last_event, jobs, job_id), _data
    )


def _last_event(jobs: JobStore, job_id: UUID) -> int:
    try:
        return jobs.last_event(job_id)
    except JobNotFoundError:
        return 0


def _look(jobs: JobStore, job_id: UUID, after: int) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: what ends between the two looks has its last event among those found.
        ended = jobs.get(job_id).state.final
        return jobs.events(job_id, after=after), ended
    except JobNotFoundError:
        return (), True


def _data(event: JobEvent) -> dict[str, Any]:
    data = dict(event.data)
    fault = data.get("error")
    if fault is not None:
        data["error"] = fault_problem(JobFailure(fault["code"], fault["message"]))
    return data
