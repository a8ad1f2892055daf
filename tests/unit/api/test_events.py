"""A stream of events ends, whatever the client names and whatever becomes of the scan."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, MutableMapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sse_starlette import ServerSentEvent

from slrig.api.events import OpenStreams, followed_job
from slrig.api.events import told as stream_of
from slrig.jobs.database import Database
from slrig.jobs.records import JobEvent, JobKind, JobProgress, JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json
from tests.unit.api.conftest import KEY, ServedBench
from tests.unit.scan.fakes import WAIT_S


class ActingStore(JobStore):
    """Does something of its own before the next look at a scan's events, on the thread that looks."""

    act: Callable[[], None] | None = None

    def events(self, job_id: UUID, *, after: int) -> Sequence[JobEvent]:
        act, self.act = self.act, None
        if act is not None:
            act()
        return super().events(job_id, after=after)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[ActingStore]:
    store = ActingStore(Database(tmp_path / "slrig.sqlite"), JobKind.SCAN)
    yield store
    store.database.close()


def made(store: JobStore) -> JobRecord:
    return store.create(plan_json(ScanPlan()), rig="bench", label=None)


async def told(stream: AsyncIterator[ServerSentEvent]) -> list[str | None]:
    """The ids of all that a stream still tells before its end, which must come."""
    async with asyncio.timeout(WAIT_S):
        return [event.id async for event in stream]


def test_stream_ahead_of_its_scan_is_told_what_comes_next(store: ActingStore) -> None:
    scan = made(store)

    def go_on() -> None:
        store.progress(scan.id, JobProgress("capture", 0.5, ""))
        store.finish(scan.id, JobState.SUCCEEDED)

    store.act = go_on
    assert asyncio.run(told(stream_of(OpenStreams(1), scan.id, followed_job(store, scan.id), 1000))) == ["2", "3"]


def test_twenty_who_follow_a_scan_see_all_of_it_and_cost_little_more_than_one(store: ActingStore) -> None:
    scan, streams, looks = made(store), OpenStreams(99), 0
    followed = followed_job(store, scan.id)

    def counted(after: int) -> tuple[Sequence[JobEvent], bool]:
        nonlocal looks
        looks += 1
        return followed.look(after)

    async def follow() -> list[list[str | None]]:
        everyone = [
            asyncio.ensure_future(told(stream_of(streams, scan.id, replace(followed, look=counted), 0)))
            for _ in range(20)
        ]
        for step in range(10):
            await asyncio.to_thread(store.progress, scan.id, JobProgress("capture", step / 10, ""))
        await asyncio.to_thread(store.finish, scan.id, JobState.SUCCEEDED)
        return await asyncio.gather(*everyone)

    everything = [str(number) for number in range(1, 13)]
    assert asyncio.run(follow()) == 20 * [everything]
    # Each alone would look for each event, 240 times in all.
    assert looks <= 48
    assert streams.followed == {}


@pytest.mark.parametrize("final", [True, False])
def test_stream_of_a_scan_that_is_deleted_ends(store: ActingStore, final: bool) -> None:
    scan = made(store)

    async def follow() -> list[str | None]:
        stream = stream_of(OpenStreams(1), scan.id, followed_job(store, scan.id), 0)
        assert (await anext(stream)).id == "1"
        if final:
            # It is woken by the last event, and finds it gone.
            store.act = lambda: store.delete(scan.id)
            store.finish(scan.id, JobState.SUCCEEDED)
        else:
            store.delete(scan.id)
        return await told(stream)

    assert asyncio.run(follow()) == []


def test_stream_that_waits_is_woken_by_the_deletion(store: ActingStore) -> None:
    scan = made(store)
    woken: list[bool] = []
    unwatch = store.watch(scan.id, lambda: woken.append(True))
    store.delete(scan.id)
    unwatch()
    assert woken == [True]


def asked(app: FastAPI, path: str, gone: asyncio.Event) -> Awaitable[int]:
    """The status of an answer to a client that stays until `gone` is set."""
    status: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "path": path,
        "raw_path": path.encode(), "query_string": b"", "root_path": "", "scheme": "http", "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 80), "headers": [(b"host", b"127.0.0.1"), (b"x-api-key", KEY.encode())],
    }  # fmt: skip

    async def receive() -> dict[str, str]:
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            status.set_result(message["status"])

    async def whole() -> int:
        await app(scope, receive, send)
        return await status

    return asyncio.ensure_future(whole())


@pytest.mark.parametrize("path", ["of a scan", "/events"])
def test_no_more_streams_are_open_at_once_than_may(client: TestClient, served: ServedBench, path: str) -> None:
    path = served.held(client)["links"]["events"] if path == "of a scan" else path
    gone = asyncio.Event()

    async def burst(count: int) -> list[int]:
        answers = [asyncio.ensure_future(asked(served.app, path, gone)) for _ in range(count)]
        # All but those that stay open are answered; these end when their clients go.
        refused, waiting = [], answers
        while len(waiting) > 1:
            done, pending = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED, timeout=WAIT_S)
            assert done, "more streams are open than may"
            refused += [answer.result() for answer in done]
            waiting = list(pending)
        assert served.app.state.streams.count == 1
        gone.set()
        return [*refused, *await asyncio.gather(*waiting)]

    assert sorted(asyncio.run(burst(12))) == [200, *[429] * 11]
    assert served.app.state.streams.count == 0


def test_client_that_is_gone_before_its_stream_begins_keeps_no_place(client: TestClient, served: ServedBench) -> None:
    path = served.held(client)["links"]["events"]

    async def leave_at_once() -> None:
        gone = asyncio.Event()
        gone.set()
        async with asyncio.timeout(WAIT_S):
            await asked(served.app, path, gone)

    asyncio.run(leave_at_once())
    assert served.app.state.streams.count == 0
