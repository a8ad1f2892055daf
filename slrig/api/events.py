"""Events of jobs and of calibrations, as server-sent events that can be resumed."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event

from slrig.api.problems import fault_problem, problems
from slrig.api.service import Service, Serving
from slrig.calibrate.store import CalibrationRegister, SessionState
from slrig.errors import CalibrationNotFoundError, JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.records import RIG_JOBS, JobEvent, JobKind, JobState
from slrig.jobs.store import EVERY_JOB, JobStore

_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
"""Headers of a stream: a proxy passes each event on at once, as nginx does by the second."""

_BATCH = 500
"""Most events of all jobs in one query."""

_MOST_QUERIES = 16
"""Most queries kept for later followers at the same position."""

_SOLVES = {
    JobState.QUEUED: SessionState.OPEN,
    JobState.COMPUTING: SessionState.SOLVING,
    JobState.SUCCEEDED: SessionState.SOLVED,
    JobState.FAILED: SessionState.FAILED,
    JobState.INTERRUPTED: SessionState.FAILED,
}
"""State of a calibration by the state of its newest solve."""

_LAST = Header(ge=0, le=2**53, description="number of the last event that was received; those after it follow")
LastEventId = Annotated[int, _LAST]

router = APIRouter()


async def _until_over() -> AsyncIterator[ExitStack]:
    with ExitStack() as held:
        yield held


Held = Annotated[ExitStack, Depends(_until_over)]
"""A handler's parameter: held until the answer is over, also where the client was gone before it began."""


@dataclass(frozen=True, slots=True)
class Followed:
    """Source of the events of a stream.

    query : the events after one, and whether no more will come, for now or because it was deleted; called on another
    thread. watch : calls back, from any thread, after each new event; returns the call that ends that. last : number of
    the newest event. most : most events of a query; None: all that there are.
    """

    query: Callable[[int], tuple[Sequence[JobEvent], bool]]
    watch: Callable[[Callable[[], None]], Callable[[], None]]
    last: Callable[[], int]
    most: int | None = None


_TEXT: dict[str, Any] = {"type": "string"}
_MOMENT: dict[str, Any] = {"type": "string", "format": "date-time"}
_FAULT: dict[str, Any] = {"anyOf": [{"$ref": "#/components/schemas/Problem"}, {"type": "null"}]}
_DATA: dict[str, dict[str, Any]] = {
    "progress": {"stage": _TEXT, "fraction": {"type": "number", "minimum": 0, "maximum": 1}, "detail": _TEXT},
    "captured": {"time": _MOMENT},
    "file": {"name": _TEXT},
    "state": {"time": _MOMENT, "error": _FAULT},
    "pose": {"time": _MOMENT, "error": _FAULT, "pose": {"type": "integer"}},
}
"""Data of an event, by its kind, in addition to the state of its job."""


def _event(kind: str, **more: dict[str, Any]) -> dict[str, Any]:
    data = {"state": _TEXT, **_DATA[kind], **more}
    required = [name for name in data if data[name] is not _FAULT]
    content = {"type": "object", "properties": data, "required": required}
    text = {"type": "string", "contentMediaType": "application/json", "contentSchema": content}
    return {
        "type": "object",
        "properties": {"id": {"type": "string", "pattern": "^[0-9]+$"}, "event": {"const": kind}, "data": text},
        "required": ["id", "event", "data"],
    }


def _answers(
    events: str, items: Sequence[dict[str, Any]], nothing: str | None = None
) -> dict[int | str, dict[str, Any]]:
    # As OpenAPI 3.2 has it, and as FastAPI writes it for its own streams.
    stream = {"schema": {"type": "string"}, "itemSchema": {"anyOf": items}}
    return {
        200: {"description": events, "content": {"text/event-stream": stream}},
        **({} if nothing is None else {204: {"description": nothing}}),
        **problems(429),
    }


class SharedQueries:
    """Queries of new events, shared by all followers at the same position: twenty cost the same as one.

    Lives on the event loop's thread.
    """

    def __init__(self, followed: Followed) -> None:
        self.last = followed.last
        self.most = followed.most
        self._followed = followed
        self._followers: set[asyncio.Event] = set()
        self._queries: dict[int, asyncio.Future[tuple[Sequence[JobEvent], bool]]] = {}
        self._unwatch: Callable[[], None] = lambda: None

    @property
    def unused(self) -> bool:
        """Whether it has no followers."""
        return not self._followers

    def join(self) -> asyncio.Event:
        """Begin to follow: what is returned is set after each new event."""
        if self.unused:
            loop = asyncio.get_running_loop()

            def wake() -> None:
                loop.call_soon_threadsafe(self._wake)

            self._unwatch = self._followed.watch(wake)
        news = asyncio.Event()
        self._followers.add(news)
        return news

    def leave(self, news: asyncio.Event) -> None:
        """End what `join` began."""
        self._followers.remove(news)
        if self.unused:
            self._unwatch()
            self._queries.clear()

    def _wake(self) -> None:
        # A query that has begun may lack the newest event: no other follower gets it.
        self._queries.clear()
        for news in self._followers:
            news.set()

    async def query(self, after: int) -> tuple[Sequence[JobEvent], bool]:
        """See `Followed.query`."""
        if after not in self._queries:
            if len(self._queries) >= _MOST_QUERIES:
                # Followers that catch up, each at a position of its own.
                self._queries.clear()
            self._queries[after] = asyncio.ensure_future(run_in_threadpool(self._followed.query, after))
        # A follower that leaves does not end it for others.
        return await asyncio.shield(self._queries[after])


_EVERYTHING = _answers(
    "the events of scans, verifications, poses, solves, positions and models, as the streams of their own have them, "
    "each with `job`: its `id`, `kind` and `label`, the `series`, `calibration` or `acceptance` that it belongs to, "
    "and `links`. Event numbers rise, with gaps. Without a number to begin after, the stream begins with what comes "
    "from now on, and says first after which number that is. It ends with the service.",
    [
        *(_event(kind, job={"type": "object"}) for kind in ("progress", "captured", "file", "state")),
        {"type": "object", "properties": {"id": _TEXT}, "required": ["id"], "not": {"required": ["data"]}},
    ],
)
_JOB = _answers(
    "`progress` events with stage, fraction and detail; `captured` when the rig is free of the job: its "
    "frames are written to disk and reconstructed then; `file` events with the name of a file that can be fetched from "
    "then on; `state` events with the new state. The stream ends after the event of a final state. Jobs that are "
    "long over have no `progress`.",
    [_event(kind) for kind in ("progress", "captured", "file", "state")],
    "nothing has happened since the event that was named, and nothing more will",
)
_CALIBRATION = _answers(
    "`pose` events with the number and the new state of a pose; `progress` events with stage, fraction and detail, and "
    "the number of the pose; `captured` when the rig is free of a pose, and the board may be moved; `state` events "
    "when a solve begins (`solving`) and ends (`solved`, `failed`). The stream ends when nothing is under way any "
    "more. Event numbers rise, with gaps.",
    [
        *(_event(kind, pose={"type": ["integer", "null"]}) for kind in ("progress", "captured")),
        _event("pose"),
        _event("state"),
    ],
    "nothing has happened since the event that was named, and nothing is under way",
)


@router.get("/scan/{scan_id}/events", tags=["scan"], response_class=Response, responses=_JOB)
async def follow_scan(held: Held, service: Serving, scan_id: UUID, last_event_id: LastEventId = 0) -> Response:
    """Follow a scan until it is over. Events that happened before come first."""
    return await _follow_job(held, service, JobKind.SCAN, scan_id, last_event_id)


@router.get("/rig/verification/{verification_id}/events", tags=["health"], response_class=Response, responses=_JOB)
async def follow_verification(
    held: Held, service: Serving, verification_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a verification until it is over. Events that happened before come first."""
    return await _follow_job(held, service, JobKind.VERIFICATION, verification_id, last_event_id)


@router.get("/rig/job/{job_id}/events", tags=["rig"], response_class=Response, responses=_JOB)
async def follow_rig_job(held: Held, service: Serving, job_id: UUID, last_event_id: LastEventId = 0) -> Response:
    """Follow an examination of the rig until it is over. Events that happened before come first."""
    return await _follow_job(held, service, None, job_id, last_event_id)


@router.get("/model/{model_id}/events", tags=["model"], response_class=Response, responses=_JOB)
async def follow_model(held: Held, service: Serving, model_id: UUID, last_event_id: LastEventId = 0) -> Response:
    """Follow a model until it is over. Events that happened before come first."""
    return await _follow_job(held, service, JobKind.MODEL, model_id, last_event_id)


@router.get(
    "/calibration/{calibration_id}/events", tags=["calibration"], response_class=Response, responses=_CALIBRATION
)
async def follow_calibration(
    held: Held, service: Serving, calibration_id: UUID, last_event_id: LastEventId = 0
) -> Response:
    """Follow a calibration while something is under way. Events that happened before come first."""
    register = service.calibrations.register
    await run_in_threadpool(register.get, calibration_id)
    followed = Followed(
        partial(_query_calibration, register, calibration_id),
        partial(service.store.watch, calibration_id),
        partial(service.store.last_event_of, calibration_id),
    )
    return await _stream(held, service, calibration_id, followed, last_event_id)


@router.get("/events", tags=["system"], response_class=Response, responses=_EVERYTHING)
async def follow_everything(
    held: Held,
    service: Serving,
    last_event_id: Annotated[int | None, _LAST] = None,
    after: Annotated[
        int | None, Query(ge=0, le=2**53, description="as Last-Event-ID: 0 begins with the oldest on record")
    ] = None,
) -> Response:
    """Follow all jobs of every kind. `Last-Event-ID` comes before `after`."""
    followed = followed_feed(service.store, _BATCH)
    begin = after if last_event_id is None else last_event_id
    if begin is not None:
        return _opened(held, service, EVERY_JOB, followed, begin)
    now = await run_in_threadpool(followed.last)
    return _opened(held, service, EVERY_JOB, followed, now, begins=now)


async def _follow_job(held: ExitStack, service: Service, kind: JobKind | None, job_id: UUID, after: int) -> Response:
    # One that is on no record is refused here; one that is deleted later only ends its stream.
    await run_in_threadpool(service.store.get, job_id, *(RIG_JOBS if kind is None else (kind,)))
    return await _stream(held, service, job_id, followed_job(service.store, job_id), after)


def followed_feed(jobs: JobStore, most: int) -> Followed:
    """All jobs as they are followed until the service ends, in queries of so many events."""

    def query(after: int) -> tuple[Sequence[JobEvent], bool]:
        # In this order: what ends the service has its last event among those found.
        ended = jobs.ended
        found = jobs.events_of_all(after=after, limit=most)
        return found, ended and len(found) < most

    return Followed(query, partial(jobs.watch, EVERY_JOB), jobs.last_event_of_all, most)


def followed_job(jobs: JobStore, job_id: UUID) -> Followed:
    """A job as it is followed until its state is final; it may be deleted meanwhile."""

    def query(after: int) -> tuple[Sequence[JobEvent], bool]:
        try:
            # In this order: a job that ends between the two queries has its last event among those found.
            ended = jobs.get(job_id).state.final
            return jobs.events(job_id, after=after), ended
        except JobNotFoundError:
            return (), True

    def last() -> int:
        try:
            return jobs.last_event(job_id)
        except JobNotFoundError:
            return 0

    return Followed(query, partial(jobs.watch, job_id), last)


def _query_calibration(
    register: CalibrationRegister, calibration_id: UUID, after: int
) -> tuple[Sequence[JobEvent], bool]:
    try:
        # In this order: a solve that ends between the two queries has its last event among those found.
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
    if event.kind in {"progress", "captured"}:
        return replace(event, data={**event.data, "pose": pose})
    if pose is not None:
        return replace(event, kind="pose", data={**event.data, "pose": pose})
    return replace(event, data={**event.data, "state": _SOLVES[event.data["state"]]})


async def _stream(held: ExitStack, service: Service, key: UUID, followed: Followed, after: int) -> Response:
    """The events after one, and those that follow until no more will come. Raises HTTPException 429."""
    events, over = await run_in_threadpool(followed.query, after)
    if over and not events:
        # 204 stops an EventSource that reconnects after the last event.
        return Response(status_code=204)
    return _opened(held, service, key, followed, after)


def _opened(
    held: ExitStack, service: Service, key: UUID, followed: Followed, after: int, *, begins: int | None = None
) -> Response:
    """A stream of the events after one. See `event_stream`. Raises HTTPException 429."""
    held.enter_context(service.streams.take())
    keepalive_s = service.settings.keepalive_s
    stream = event_stream(service.followed, key, followed, after, begins=begins, keepalive_s=keepalive_s)
    return EventSourceResponse(stream, headers=_HEADERS)


async def event_stream(
    shared_queries: dict[UUID, SharedQueries],
    key: UUID,
    followed: Followed,
    after: int,
    *,
    begins: int | None = None,
    keepalive_s: float,
) -> AsyncIterator[bytes]:
    """Each event after one, as it comes, until no more will. key : the same for all who follow the same.

    begins : a number to say first, so that a client that lost the connection before the first event can go on.
    keepalive_s : after so much silence a comment is sent.
    """
    shared = shared_queries.setdefault(key, SharedQueries(followed))
    news = shared.join()
    try:
        # A client that names a future event would never receive it.
        after = min(after, await run_in_threadpool(shared.last))
        over = False
        if begins is not None:
            yield format_sse_event(id=str(begins))
        while not over:
            news.clear()
            events, over = await shared.query(after)
            for event in events:
                after = event.number
                yield format_sse_event(data_str=json.dumps(_data(event)), event=event.kind, id=str(after))
            while not (over or news.is_set()) and (shared.most is None or len(events) < shared.most):
                try:
                    async with asyncio.timeout(keepalive_s):
                        await news.wait()
                except TimeoutError:
                    yield KEEPALIVE_COMMENT
    finally:
        shared.leave(news)
        if shared.unused:
            shared_queries.pop(key, None)


def _data(event: JobEvent) -> dict[str, Any]:
    """Data sent of an event: a fault as a problem."""
    fault = event.data.get("error")
    return dict(event.data) if fault is None else {**event.data, "error": fault_problem(JobFailure(**fault))}
