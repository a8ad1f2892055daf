"""/scan/{id}/events: what happens to a scan, as server-sent events that can be resumed."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.exceptions import HTTPException

from slrig.api.openapi import problems
from slrig.api.problems import fault_problem
from slrig.api.service import Serving
from slrig.errors import ScanNotFoundError
from slrig.scan.faults import ScanFault
from slrig.scan.records import ScanEvent
from slrig.scan.store import ScanStore

_LAST_WORD_S = 2.0
"""How much longer than its scan an event stream may live when the service ends."""

router = APIRouter(prefix="/scan", tags=["scan"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "`progress` events with stage, fraction and detail; `state` events with the new state. The "
        "stream ends after the event of a final state.",
        "content": {"text/event-stream": {"schema": {"type": "string"}}},
    },
    204: {"description": "nothing has happened since the event that was named, and nothing more will"},
}


class OpenStreams:
    """How many event streams are open. Lives on the event loop's thread."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._count = 0

    def require_room(self) -> None:
        """Raise HTTPException 429 when as many streams are open as may."""
        if self._count >= self._limit:
            detail = (
                f"{self._count} event streams are open, as many as may. Close one, or ask for GET /scan/ID instead."
            )
            raise HTTPException(429, detail, headers={"Retry-After": "5"})

    def __enter__(self) -> None:
        self._count += 1

    def __exit__(self, *_: object) -> None:
        self._count -= 1


@router.get("/{scan_id}/events", response_class=Response, responses={**_STREAM, **problems(404, 422, 429)})
async def follow_scan(
    request: Request,
    service: Serving,
    scan_id: UUID,
    last_event_id: Annotated[
        int, Header(ge=0, le=2**53, description="number of the last event that was seen; those after it follow")
    ] = 0,
) -> Response:
    """Follow a scan until it is over. Events that happened before come first."""
    streams: OpenStreams = request.app.state.streams
    record = await run_in_threadpool(service.store.get, scan_id)
    if record.state.final and not await run_in_threadpool(service.store.events, scan_id, after=last_event_id):
        # An EventSource that reconnects after the last event is told by 204 to stop trying.
        return Response(status_code=204)
    streams.require_room()
    return EventSourceResponse(
        _told(service.store, scan_id, last_event_id, streams),
        ping=service.settings.keepalive_s,
        sep="\n",
        # At the end of the service every scan ends, and its stream by that; without this the stream would end first.
        shutdown_grace_period=service.settings.shutdown_s + _LAST_WORD_S,
    )


async def _told(store: ScanStore, scan_id: UUID, after: int, streams: OpenStreams) -> AsyncIterator[ServerSentEvent]:
    loop = asyncio.get_running_loop()
    news = asyncio.Event()

    def wake() -> None:
        loop.call_soon_threadsafe(news.set)

    unwatch = store.watch(scan_id, wake)
    with streams:
        try:
            # A client that names an event that has not come yet would never be told that it has.
            after = min(after, await run_in_threadpool(_last_event, store, scan_id))
            over = False
            while not over:
                news.clear()
                events, over = await run_in_threadpool(_look, store, scan_id, after)
                for event in events:
                    after = event.number
                    yield ServerSentEvent(json.dumps(_data(event)), event=event.kind, id=str(event.number), sep="\n")
                    if event.last:
                        return
                if not over:
                    await news.wait()
        finally:
            unwatch()


def _last_event(store: ScanStore, scan_id: UUID) -> int:
    try:
        return store.last_event(scan_id)
    except ScanNotFoundError:
        return 0


def _look(store: ScanStore, scan_id: UUID, after: int) -> tuple[Sequence[ScanEvent], bool]:
    """The events after one, and whether no more will come: the scan is over, or deleted."""
    try:
        # In this order: what ends between the two looks has its last event among those found.
        over = store.get(scan_id).state.final
        return store.events(scan_id, after=after), over
    except ScanNotFoundError:
        return (), True


def _data(event: ScanEvent) -> dict[str, Any]:
    data = dict(event.data)
    fault = data.get("error")
    if fault is not None:
        data["error"] = fault_problem(ScanFault(fault["kind"], fault["message"]))
    return data
