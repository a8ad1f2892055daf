"""The record of scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from slrig.errors import IdempotencyError, JobNotFoundError, KeyInFlightError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobProgress, JobState
from slrig.jobs.store import JobStore, ProgressRecorder
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


def test_idempotency_key_leads_back_to_its_scan(store: JobStore) -> None:
    assert store.reserve_key("k", "body") is None
    with pytest.raises(KeyInFlightError):
        store.reserve_key("k", "body")
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None, key="k")
    assert store.reserve_key("k", "body") == scan.id
    with pytest.raises(IdempotencyError, match="another request body"):
        store.reserve_key("k", "other body")


def test_key_of_a_refused_request_is_free_again(store: JobStore) -> None:
    store.reserve_key("k", "body")
    store.release_key("k")
    assert store.reserve_key("k", "other body") is None


def test_key_of_a_scan_is_not_released(store: JobStore) -> None:
    store.reserve_key("k", "body")
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None, key="k")
    store.release_key("k")
    store.release_keys()
    assert store.reserve_key("k", "body") == scan.id


def test_key_is_forgotten_after_a_day(store: JobStore, clock: SetClock) -> None:
    store.reserve_key("k", "body")
    store.create(plan_json(ScanPlan()), rig="bench", label=None, key="k")
    clock.move(hours=23, minutes=59)
    with pytest.raises(IdempotencyError):
        store.reserve_key("k", "other body")
    clock.move(minutes=2)
    assert store.reserve_key("k", "other body") is None


def test_progress_is_recorded_by_stage_by_hundredths_and_while_a_stage_goes_on(store: JobStore) -> None:
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None)
    now_s = [0.0]
    record = ProgressRecorder(store, scan.id, hidden="secret/", now_s=lambda: now_s[0])
    for at_s, stage, fraction, detail in (
        (0.0, "preparing kernels", 0.0, "0 of 56"),
        (0.5, "preparing kernels", 0.0, "1 of 56"),  # too soon to be told
        (2.5, "preparing kernels", 0.0, "9 of 56"),
        (9.0, "preparing kernels", 0.0, "9 of 56"),  # nothing new
        (9.1, "decode", 0.001, "secret/a"),
        (9.2, "decode", 0.5, ""),
    ):
        now_s[0] = at_s
        record(stage, fraction, detail)
    events = [event.data for event in store.events(scan.id, after=0) if event.kind == "progress"]
    assert [(each["stage"], each["detail"]) for each in events] == [
        ("preparing kernels", "0 of 56"),
        ("preparing kernels", "9 of 56"),
        ("decode", "a"),
        ("decode", ""),
    ]
