"""The stream of the events of all jobs: whole, in order, in pieces of a bounded size, and one look for all."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from sse_starlette import ServerSentEvent

from slrig.api.events import Followed, OpenStreams, followed_feed, told
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.feed import JobFeed
from slrig.jobs.records import JobKind, JobProgress, JobState
from slrig.jobs.store import EVERY_JOB, JobStore
from tests.unit.scan.fakes import WAIT_S


class Jobs:
    """Scans and poses of one database, and the feed of both. `looks` : what was looked up, after which number."""

    def __init__(self, folder: Path) -> None:
        database = Database(folder / "slrig.sqlite")
        self.scans = JobStore(database, JobKind.SCAN)
        self.poses = JobStore(database, JobKind.POSE, JobKind.SOLVE)
        self.feed = JobFeed(self.scans, self.poses)
        self.streams = OpenStreams(99)
        self.looks: list[int] = []

    def followed(self, *, most: int = 500) -> Followed:
        whole = followed_feed(self.feed, most)

        def look(after: int) -> Any:
            self.looks.append(after)
            found = whole.look(after)
            assert len(found[0]) <= most
            return found

        return Followed(look, whole.watch, whole.last, most)

    def scan(self, steps: int = 0) -> UUID:
        job = self.scans.create({}, rig="bench", label=None)
        for step in range(steps):
            self.scans.progress(job.id, JobProgress("capture", step / 1000, ""))
        return job.id

    def follow(self, after: int = 0, *, most: int = 500) -> AsyncGenerator[ServerSentEvent]:
        stream = told(self.streams, EVERY_JOB, self.followed(most=most), after)
        assert isinstance(stream, AsyncGenerator)
        return stream


@pytest.fixture
def jobs(tmp_path: Path) -> Iterator[Jobs]:
    made = Jobs(tmp_path)
    yield made
    made.scans.database.close()


async def some(stream: AsyncIterator[ServerSentEvent], count: int) -> list[dict[str, Any]]:
    """So many events that come next, with their number and kind."""
    async with asyncio.timeout(WAIT_S):
        found = [await anext(stream) for _ in range(count)]
    return [{"number": int(each.id or 0), "event": each.event, **json.loads(each.data or "")} for each in found]


def test_event_of_any_job_wakes_those_who_follow_all(jobs: Jobs) -> None:
    async def follow() -> None:
        stream, calibration = jobs.follow(), uuid4()
        waiting = asyncio.ensure_future(some(stream, 1))
        await asyncio.sleep(0.05)
        scan = await asyncio.to_thread(jobs.scan)
        (first,) = await waiting
        assert (first["number"], first["job"]["id"], first["state"]) == (1, str(scan), "queued")
        waiting = asyncio.ensure_future(some(stream, 2))
        await asyncio.sleep(0.05)
        pose = await asyncio.to_thread(jobs.poses.create, {"number": 4}, rig="bench", label=None, parent=calibration)
        fault = JobFailure("pose-refused", "no board")
        await asyncio.to_thread(jobs.poses.finish, pose.id, JobState.FAILED, fault=fault)
        queued, failed = await waiting
        assert (queued["number"], queued["event"], failed["number"]) == (2, "state", 3)
        assert failed["job"] == {
            "id": str(pose.id),
            "kind": "pose",
            "label": None,
            "calibration": str(calibration),
            "links": {
                "self": f"/calibration/{calibration}/pose/4",
                "events": f"/calibration/{calibration}/events",
                "calibration": f"/calibration/{calibration}",
            },
        }
        # As everywhere, a fault is the problem that it is.
        assert (failed["error"]["type"], failed["error"]["detail"]) == ("/problems/pose-refused", "no board")

    asyncio.run(follow())


def test_much_that_happened_comes_in_pieces_and_whole(jobs: Jobs) -> None:
    jobs.scan(steps=39)

    async def follow() -> None:
        found = await some(jobs.follow(most=7), 40)
        assert [each["number"] for each in found] == list(range(1, 41))

    asyncio.run(follow())
    assert jobs.looks[:6] == [0, 7, 14, 21, 28, 35]


def test_piece_that_is_full_to_the_last_event_ends_in_waiting(jobs: Jobs) -> None:
    jobs.scan(steps=6)

    async def follow() -> None:
        stream = jobs.follow(most=7)
        assert len(await some(stream, 7)) == 7
        waiting = asyncio.ensure_future(some(stream, 1))
        await asyncio.sleep(0.2)
        assert (jobs.looks, waiting.done()) == ([0, 7], False), "it looks again and again"
        await asyncio.to_thread(jobs.scan)
        assert (await waiting)[0]["number"] == 8

    asyncio.run(follow())


def test_twenty_who_follow_all_jobs_cost_little_more_than_one_and_keep_little(jobs: Jobs) -> None:
    jobs.scan(steps=199)

    async def follow() -> None:
        # Each begins somewhere else: nobody's look is another's.
        late = [jobs.follow(start, most=2) for start in range(20)]
        await asyncio.gather(*(some(stream, 200 - start) for start, stream in enumerate(late)))
        assert len(jobs.streams.followed[EVERY_JOB]._looks) <= 16
        for stream in late:
            await stream.aclose()
        jobs.looks.clear()
        streams = [jobs.follow(200, most=500) for _ in range(20)]
        everyone = [asyncio.ensure_future(some(stream, 10)) for stream in streams]
        await asyncio.sleep(0.05)
        await asyncio.to_thread(jobs.scan, steps=9)
        found = await asyncio.gather(*everyone)
        assert all([each["number"] for each in one] == list(range(201, 211)) for one in found)

    asyncio.run(follow())
    # Each alone would look for each event, 200 times in all.
    assert len(jobs.looks) <= 44


def test_end_of_the_service_ends_the_stream_after_the_last_event(jobs: Jobs) -> None:
    scan = jobs.scan()

    async def follow() -> None:
        stream = jobs.follow(1)
        waiting = asyncio.ensure_future(some(stream, 1))
        await asyncio.sleep(0.05)
        await asyncio.to_thread(jobs.scans.finish, scan, JobState.INTERRUPTED)
        jobs.feed.end()
        assert (await waiting)[0]["state"] == "interrupted"
        async with asyncio.timeout(WAIT_S):
            assert [event async for event in stream] == []

    asyncio.run(follow())
    assert jobs.streams.followed == {}


def test_events_of_a_deleted_job_are_gone_and_others_go_on(jobs: Jobs) -> None:
    first, second = jobs.scan(steps=2), jobs.scan()
    jobs.scans.delete(first)

    async def follow() -> None:
        stream = jobs.follow()
        assert [each["number"] for each in await some(stream, 1)] == [4]
        waiting = asyncio.ensure_future(some(stream, 1))
        await asyncio.sleep(0.05)
        await asyncio.to_thread(jobs.scans.delete, second)
        await asyncio.to_thread(jobs.scan)
        # A number that was used is never used again.
        assert (await waiting)[0]["number"] == 5

    asyncio.run(follow())


def test_client_that_names_nothing_is_told_where_it_begins(jobs: Jobs) -> None:
    jobs.scan(steps=4)

    async def follow() -> None:
        stream = told(jobs.streams, EVERY_JOB, jobs.followed(), 5, begins=5)
        async with asyncio.timeout(WAIT_S):
            assert (await anext(stream)).encode() == b"id: 5\n\n"
        await asyncio.to_thread(jobs.scan)
        assert [each["number"] for each in await some(stream, 1)] == [6]

    asyncio.run(follow())


def test_number_that_is_none_is_refused(client: TestClient) -> None:
    for path, headers in (("/events?after=-1", {}), ("/events?after=x", {}), ("/events", {"Last-Event-ID": "x"})):
        assert client.get(path, headers=headers).status_code == 422
