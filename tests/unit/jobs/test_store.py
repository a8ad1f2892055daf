"""The record of scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from slrig.errors import JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobProgress, JobState
from slrig.jobs.store import JobStore
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.records import plan_from_json, plan_json
from tests.unit.scan.fakes import SetClock


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture
def store(tmp_path: Path, clock: SetClock) -> Iterator[JobStore]:
    store = JobStore(Database(tmp_path / "slrig.sqlite"), JobKind.SCAN, clock=clock)
    yield store
    store.database.close()


def test_scan_comes_back_as_it_was_recorded(store: JobStore, clock: SetClock) -> None:
    plan = ScanPlan(patterns=PatternPlan(line_shift_period_px=12, rows=True), exposure_s=0.02)
    made = store.create(plan_json(plan), rig="bench", label="cup")
    assert store.get(made.id) == made
    assert (plan_from_json(made.plan), made.label, made.rig, made.state) == (plan, "cup", "bench", JobState.QUEUED)
    assert made.created_at == clock.now


def test_life_of_a_scan_is_told_by_its_events_in_order(store: JobStore, clock: SetClock) -> None:
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    clock.move(seconds=2)
    assert store.advance(scan.id, JobState.CAPTURING) == clock.now
    store.progress(scan.id, JobProgress("capture", 0.25, "frame 7 of 28"))
    clock.move(seconds=3)
    assert store.finish(scan.id, JobState.FAILED, fault=JobFailure("bundle", "Frame 3 is cut."))
    events = store.events(scan.id, after=0)
    assert [event.number for event in events] == [1, 2, 3, 4]
    assert [event.data["state"] for event in events] == ["queued", "capturing", "capturing", "failed"]
    assert store.events(scan.id, after=3) == events[3:]
    record = store.get(scan.id)
    assert record.fault == JobFailure("bundle", "Frame 3 is cut.")
    assert record.started_at is not None
    assert record.finished_at is not None
    assert (record.finished_at - record.started_at).total_seconds() == 3


def test_first_final_state_stands(store: JobStore) -> None:
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    assert store.finish(scan.id, JobState.SUCCEEDED, summary={"points": 3})
    assert not store.finish(scan.id, JobState.INTERRUPTED)
    assert store.get(scan.id).state is JobState.SUCCEEDED
    assert store.get(scan.id).summary == {"points": 3}


def test_pages_run_from_new_to_old_without_overlap(store: JobStore) -> None:
    made = [store.create(plan_json(ScanPlan()), rig="bench", label=str(number)) for number in range(5)]
    first = store.page(before=None, limit=3)
    second = store.page(before=first[-1].number, limit=3)
    assert [scan.id for scan in (*first, *second)] == [scan.id for scan in reversed(made)]


def test_numbers_are_never_given_twice(store: JobStore) -> None:
    gone = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    store.delete(gone.id)
    assert store.create(plan_json(ScanPlan()), rig="bench", label=None).number > gone.number
    assert store.events(gone.id, after=0) == []
    with pytest.raises(JobNotFoundError, match=str(gone.id)):
        store.get(gone.id)


def test_unknown_scan_is_refused_everywhere(store: JobStore) -> None:
    unknown = uuid4()
    with pytest.raises(JobNotFoundError):
        store.delete(unknown)
    with pytest.raises(JobNotFoundError):
        store.advance(unknown, JobState.CAPTURING)


def test_watcher_is_woken_by_its_scan_only_and_until_it_leaves(store: JobStore) -> None:
    watched = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    other = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    calls: list[int] = []
    unwatch = store.watch(watched.id, lambda: calls.append(len(store.events(watched.id, after=0))))
    store.advance(other.id, JobState.CAPTURING)
    store.advance(watched.id, JobState.CAPTURING)
    assert calls == [2]
    unwatch()
    store.finish(watched.id, JobState.CANCELLED)
    assert calls == [2]


def test_jobs_of_one_parent_are_listed_and_followed_together(tmp_path: Path, clock: SetClock) -> None:
    jobs = JobStore(Database(tmp_path / "poses.sqlite"), JobKind.POSE, JobKind.SOLVE, clock=clock)
    session, other = uuid4(), uuid4()
    woken: list[str] = []
    unwatch = jobs.watch(session, lambda: woken.append("session"))
    first = jobs.create({"number": 1}, rig="bench", label=None, parent=session)
    alone = jobs.create({"number": 1}, rig="bench", label=None, parent=other)
    solve = jobs.create({"number": 1}, rig="bench", label=None, kind=JobKind.SOLVE, parent=session)
    jobs.finish(first.id, JobState.SUCCEEDED, summary={"answer": {}})
    assert jobs.of(session) == {session: [jobs.get(first.id), jobs.get(solve.id)]}
    assert [job.id for job in jobs.of()[other]] == [alone.id]
    events = jobs.events_of(session, after=0)
    assert [(event.job, event.data["state"]) for event in events] == [
        (first.id, "queued"), (solve.id, "queued"), (first.id, "succeeded"),
    ]  # fmt: skip
    assert jobs.events_of(session, after=events[1].number) == events[2:]
    assert jobs.last_event_of(session) == events[-1].number
    assert jobs.last_event_of(uuid4()) == 0
    assert len(woken) == 3
    jobs.delete_of(session)
    assert (jobs.of(session), jobs.events_of(session, after=0)) == ({}, [])
    assert jobs.get(alone.id).parent == other
    unwatch()
    jobs.database.close()
