"""What happens to jobs and to calibrations, as event streams."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from slrig.api.openapi import problems
from slrig.api.problems import fault_problem
from slrig.api.service import Serving
from slrig.api.streams import Followed, LastEventId, event_stream, stream_answers
from slrig.errors import CalibrationNotFoundError, JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.records import JobEvent
from slrig.jobs.store import JobStore

router = APIRouter()

_JOB = stream_answers(
    "`progress` events with stage, fraction and detail; `state` events with the new state. The stream ends after the "
    "event of a final state.",
    "nothing has happened since the event that was named, and nothing more will",
)
_CALIBRATION = stream_answers(
    "`pose` events with the number and the new state of a pose; `progress` events with stage, fraction and detail; "
    "`state` events with the new state of the calibration. The stream ends when nothing is under way any more.",
    "nothing has happened since the event that was named, and nothing is under way",
)


class EventLog(Protocol):
    """What has events: a store of jobs, or the register of calibrations."""

    def events(self, of: UUID, /, *, after: int) -> Sequence[JobEvent]:
        """Those after the one of a number."""
        ...

    def last_event(self, of: UUID, /) -> int:
        """The number of the newest."""
        ...

    def watch(self, of: UUID, wake: Callable[[], None], /) -> Callable[[], None]:
        """Have `wake` called after each new one. Returns the call that ends that."""
        ...


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
    """Follow a calibration while something is under way. What happened before, since the service began, comes first."""
    register = service.calibrations.register
    await run_in_threadpool(register.get, calibration_id)
    over = lambda: not register.get(calibration_id).under_way  # noqa: E731 - asked again and again
    return await event_stream(request, service.settings, followed(register, calibration_id, over), last_event_id)


async def _follow_job(request: Request, service: Serving, jobs: JobStore, job_id: UUID, after: int) -> Response:
    # One that is on no record is refused here; one that is deleted later only ends its stream.
    await run_in_threadpool(jobs.get, job_id)
    return await event_stream(request, service.settings, followed_job(jobs, job_id), after)


def followed_job(jobs: JobStore, job_id: UUID) -> Followed:
    """A job as it is followed: until its state is final."""
    return followed(jobs, job_id, lambda: jobs.get(job_id).state.final)


def followed(log: EventLog, of: UUID, over: Callable[[], bool]) -> Followed:
    """What a log has of one thing, as it is followed; it may be deleted meanwhile. over : whether no more will come."""
    return Followed(partial(_look, log, of, over), partial(log.watch, of), partial(_last_event, log, of), _data)


def _last_event(log: EventLog, of: UUID) -> int:
    try:
        return log.last_event(of)
    except JobNotFoundError:
        return 0


def _look(log: EventLog, of: UUID, over: Callable[[], bool], after: int) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: what ends between the two looks has its last event among those found.
        ended = over()
        return log.events(of, after=after), ended
    except (JobNotFoundError, CalibrationNotFoundError):
        return (), True


def _data(event: JobEvent) -> dict[str, Any]:
    data = dict(event.data)
    fault = data.get("error")
    if fault is not None:
        data["error"] = fault_problem(JobFailure(fault["code"], fault["message"]))
    return data
