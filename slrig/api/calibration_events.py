"""/calibration/{id}/events: what happens to a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from slrig.api.openapi import problems
from slrig.api.service import Serving
from slrig.api.streams import Followed, LastEventId, event_stream, stream_answers
from slrig.calibrate.register import CalibrationRegister
from slrig.errors import CalibrationNotFoundError
from slrig.jobs.records import JobEvent

router = APIRouter(prefix="/calibration/{calibration_id}", tags=["calibration"])

_STREAM = stream_answers(
    "`pose` events with the number and the new state of a pose; `progress` events with stage, fraction and detail; "
    "`state` events with the new state of the calibration. The stream ends when nothing is under way any more.",
    "nothing has happened since the event that was named, and nothing is under way",
)


@router.get("/events", response_class=Response, responses={**_STREAM, **problems(404, 422, 429)})
async def follow_calibration(
    request: Request, service: Serving, calibration_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a calibration while something is under way. What happened before, since the service began, comes first."""
    register = service.calibrations.register
    # One that is on no record is refused here; one that is deleted later only ends its stream.
    await run_in_threadpool(register.get, calibration_id)
    followed = Followed(
        partial(_look, register, calibration_id),
        partial(register.watch, calibration_id),
        partial(register.last_event, calibration_id),
    )
    return await event_stream(request, service.settings, followed, last_event_id)


def _look(register: CalibrationRegister, calibration_id: UUID, after: int) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: what ends between the two looks has its last event among those found.
        over = not register.get(calibration_id).under_way
        return register.events(calibration_id, after=after), over
    except CalibrationNotFoundError:
        return (), True
