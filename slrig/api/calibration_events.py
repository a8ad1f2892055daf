"""/calibration/{id}/events: what happens to a calibration, as server-sent events that can be resumed."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from sse_starlette import EventSourceResponse, ServerSentEvent

from slrig.api.events import OpenStreams
from slrig.api.openapi import problems
from slrig.api.service import Serving
from slrig.errors import CalibrationNotFoundError
from slrig.scan.records import ScanEvent
from slrig.sessions.calibration.register import CalibrationRegister

_LAST_WORD_S = 2.0
"""How much longer than the work that it follows an event stream may live when the service ends."""

router = APIRouter(prefix="/calibration/{calibration_id}", tags=["calibration"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "`pose` events with the number and the new state of a pose; `progress` events with stage, "
        "fraction and detail; `state` events with the new state of the calibration. The stream ends when nothing is "
        "under way any more.",
        "content": {"text/event-stream": {"schema": {"type": "string"}}},
    },
    204: {"description": "nothing has happened since the event that was named, and nothing is under way"},
}


@router.get("/events", response_class=Response, responses={**_STREAM, **problems(404, 422, 429)})
async def follow_calibration(
    request: Request,
    service: Serving,
    calibration_id: UUID,
    last_event_id: Annotated[
        int, Header(ge=0, le=2**53, description="number of the last event that was seen; those after it follow")
    ] = 0,
) -> Response:
    """Follow a calibration while something is under way. What happened before, since the service began, comes first."""
    streams: OpenStreams = request.app.state.streams
    register = service.calibrations.register
    events, over = await run_in_threadpool(_look, register, calibration_id, last_event_id, refuse=True)
    if over and not events:
        return Response(status_code=204)
    streams.require_room()
    return EventSourceResponse(
        _told(register, calibration_id, last_event_id, streams),
        ping=service.settings.keepalive_s,
        sep="\n",
        shutdown_grace_period=service.settings.shutdown_s + _LAST_WORD_S,
    )


async def _told(
    register: CalibrationRegister, calibration_id: UUID, after: int, streams: OpenStreams
) -> AsyncIterator[ServerSentEvent]:
    loop = asyncio.get_running_loop()
    news = asyncio.Event()

    def wake() -> None:
        loop.call_soon_threadsafe(news.set)

    unwatch = register.watch(calibration_id, wake)
    with streams:
        try:
            # A client that names an event that has not come yet would never be told that it has.
            after = min(after, register.last_event(calibration_id))
            over = False
            while not over:
                news.clear()
                events, over = await run_in_threadpool(_look, register, calibration_id, after)
                for event in events:
                    after = event.number
                    yield ServerSentEvent(json.dumps(dict(event.data)), event=event.kind, id=str(after), sep="\n")
                if not over:
                    await news.wait()
        finally:
            unwatch()


def _look(
    register: CalibrationRegister, calibration_id: UUID, after: int, *, refuse: bool = False
) -> tuple[Sequence[ScanEvent], bool]:
    """The events after one, and whether no more will come for now: nothing is under way, or it was deleted."""
    try:
        # In this order: what ends between the two looks has its last event among those found.
        over = not register.get(calibration_id).under_way
        return register.events(calibration_id, after=after), over
    except CalibrationNotFoundError:
        if refuse:
            raise
        return (), True
