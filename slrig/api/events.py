"""/scan/{id}/events and /rig/verification/{id}/events: what happens to a job."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from slrig.api.openapi import problems
from slrig.api.problems import fault_problem
from slrig.api.service import Serving
from slrig.api.streams import Followed, LastEventId, event_stream, stream_answers
from slrig.errors import JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.records import JobEvent
from slrig.jobs.store import JobStore

router = APIRouter()

_STREAM = stream_answers(
    "`progress` events with stage, fraction and detail; `state` events with the new state. The stream ends after the "
    "event of a final state.",
    "nothing has happened since the event that was named, and nothing more will",
)


@router.get(
    "/rig/verification/{verification_id}/events",
    tags=["health"],
    response_class=Response,
    responses={**_STREAM, **problems(404, 422, 429)},
)
async def follow_verification(
    request: Request, service: Serving, verification_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a verification until it is over. Events that happened before come first."""
    jobs = service.verifications.jobs
    await run_in_threadpool(jobs.get, verification_id)
    return await event_stream(request, service.settings, followed_job(jobs, verification_id), last_event_id)


@router.get(
    "/scan/{scan_id}/events",
    tags=["scan"],
    response_class=Response,
    responses={**_STREAM, **problems(404, 422, 429)},
)
async def follow_scan(request: Request, service: Serving, scan_id: UUID, last_event_id: LastEventId = 0) -> Response:
    """Follow a scan until it is over. Events that happened before come first."""
    # One that is on no record is refused here; one that is deleted later only ends its stream.
    await run_in_threadpool(service.store.get, scan_id)
    return await event_stream(request, service.settings, followed_job(service.store, scan_id), last_event_id)


def followed_job(store: JobStore, job_id: UUID) -> Followed:
    """A job as it is followed."""
    return Followed(
        partial(_look, store, job_id), partial(store.watch, job_id), partial(_last_event, store, job_id), _data
    )


def _last_event(store: JobStore, job_id: UUID) -> int:
    try:
        return store.last_event(job_id)
    except JobNotFoundError:
        return 0


def _look(store: JobStore, job_id: UUID, after: int) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: what ends between the two looks has its last event among those found.
        over = store.get(job_id).state.final
        return store.events(job_id, after=after), over
    except JobNotFoundError:
        return (), True


def _data(event: JobEvent) -> dict[str, Any]:
    data = dict(event.data)
    fault = data.get("error")
    if fault is not None:
        data["error"] = fault_problem(JobFailure(fault["code"], fault["message"]))
    return data
