"""A stream of events ends, whatever the client names and whatever becomes of the scan."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from uuid import UUID

import pytest
from sse_starlette import ServerSentEvent

from slrig.api.events import OpenStreams, followed_job
from slrig.api.events import told as stream_of
from slrig.jobs.database import Database
from slrig.jobs.records import JobEvent, JobKind, JobProgress, JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json
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
    assert asyncio.run(told(stream_of(followed_job(store, scan.id), 1000, OpenStreams(1)))) == ["2", "3"]


@pytest.mark.parametrize("final", [True, False])
def test_stream_of_a_scan_that_is_deleted_ends(store: ActingStore, final: bool) -> None:
    scan = made(store)

    async def follow() -> list[str | None]:
        stream = stream_of(followed_job(store, scan.id), 0, OpenStreams(1))
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
