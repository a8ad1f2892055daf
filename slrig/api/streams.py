"""What happens to a piece of work, as server-sent events that can be resumed: of a scan, of a calibration."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.exceptions import HTTPException

from slrig.config import ServiceSettings
from slrig.jobs.records import JobEvent

_LAST_WORD_S = 2.0
"""How much longer than the work that it follows an event stream may live when the service ends."""

LastEventId = Annotated[
    int, Header(ge=0, le=2**53, description="number of the last event that was seen; those after it follow")
]


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


@dataclass(frozen=True, slots=True)
class Followed:
    """What is followed.

    look : the events after one, and whether no more will come, for now or because it was deleted; asked on another
    thread. watch : has a call made, from any thread, after each new event; returns the call that ends that. last :
    number of the newest event. data : an event's data as it is sent.
    """

    look: Callable[[int], tuple[Sequence[JobEvent], bool]]
    watch: Callable[[Callable[[], None]], Callable[[], None]]
    last: Callable[[], int]
    data: Callable[[JobEvent], Mapping[str, Any]] = lambda event: event.data


def stream_answers(events: str, nothing: str) -> dict[int | str, dict[str, Any]]:
    """What the description of the API says of an event stream: what it tells, and what a 204 means."""
    return {
        200: {"description": events, "content": {"text/event-stream": {"schema": {"type": "string"}}}},
        204: {"description": nothing},
    }


async def event_stream(request: Request, settings: ServiceSettings, followed: Followed, after: int) -> Response:
    """The events after one, and those that follow until no more will come. Raises HTTPException 429."""
    streams: OpenStreams = request.app.state.streams
    events, over = await run_in_threadpool(followed.look, after)
    if over and not events:
        # An EventSource that reconnects after the last event is told by 204 to stop trying.
        return Response(status_code=204)
    streams.require_room()
    return EventSourceResponse(
        told(followed, after, streams),
        ping=settings.keepalive_s,
        sep="\n",
        # At the end of the service all work ends, and its stream by that; without this the stream would end first.
        shutdown_grace_period=settings.shutdown_s + _LAST_WORD_S,
    )


async def told(followed: Followed, after: int, streams: OpenStreams) -> AsyncIterator[ServerSentEvent]:
    """Each event after one, as it comes, until no more will."""
    loop = asyncio.get_running_loop()
    news = asyncio.Event()

    def wake() -> None:
        loop.call_soon_threadsafe(news.set)

    unwatch = followed.watch(wake)
    with streams:
        try:
            # A client that names an event that has not come yet would never be told that it has.
            after = min(after, await run_in_threadpool(followed.last))
            over = False
            while not over:
                news.clear()
                events, over = await run_in_threadpool(followed.look, after)
                for event in events:
                    after = event.number
                    yield ServerSentEvent(
                        json.dumps(dict(followed.data(event))), event=event.kind, id=str(after), sep="\n"
                    )
                if not over:
                    await news.wait()
        finally:
            unwatch()
