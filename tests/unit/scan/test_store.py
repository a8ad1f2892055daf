"""The record of scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, text

from slrig.errors import IdempotencyError, ScanNotFoundError, StorageError
from slrig.failure import JobFailure, KeyInFlightError
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.records import ScanProgress, ScanState
from slrig.scan.store import ProgressRecorder, ScanStore
from slrig.scan.tables import Base
from tests.unit.scan.fakes import SetClock


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture
def store(tmp_path: Path, clock: SetClock) -> Iterator[ScanStore]:
    store = ScanStore(tmp_path / "slrig.sqlite", clock=clock)
    yield store
    store.close()


def test_scan_comes_back_as_it_was_recorded(store: ScanStore, clock: SetClock) -> None:
    plan = ScanPlan(patterns=PatternPlan(line_shift_period_px=12, rows=True), exposure_s=0.02)
    made = store.create(plan, rig="bench", label="cup")
    assert store.get(made.id) == made
    assert (made.plan, made.label, made.rig, made.state) == (plan, "cup", "bench", ScanState.QUEUED)
    assert made.created_at == clock.now


def test_life_of_a_scan_is_told_by_its_events_in_order(store: ScanStore, clock: SetClock) -> None:
    scan = store.create(ScanPlan(), rig="bench", label=None)
    clock.move(seconds=2)
    assert store.advance(scan.id, ScanState.CAPTURING) == clock.now
    store.progress(scan.id, ScanProgress("capture", 0.25, "frame 7 of 28"))
    clock.move(seconds=3)
    assert store.finish(scan.id, ScanState.FAILED, fault=JobFailure("BundleError", "Frame 3 is cut."))
    events = store.events(scan.id, after=0)
    assert [event.number for event in events] == [1, 2, 3, 4]
    assert [event.data["state"] for event in events] == ["queued", "capturing", "capturing", "failed"]
    assert store.events(scan.id, after=3) == events[3:]
    record = store.get(scan.id)
    assert record.fault == JobFailure("BundleError", "Frame 3 is cut.")
    assert record.started_at is not None
    assert record.finished_at is not None
    assert (record.finished_at - record.started_at).total_seconds() == 3


def test_first_final_state_stands(store: ScanStore) -> None:
    scan = store.create(ScanPlan(), rig="bench", label=None)
    assert store.finish(scan.id, ScanState.SUCCEEDED, summary={"points": 3})
    assert not store.finish(scan.id, ScanState.INTERRUPTED)
    assert store.get(scan.id).state is ScanState.SUCCEEDED
    assert store.get(scan.id).summary == {"points": 3}


def test_pages_run_from_new_to_old_without_overlap(store: ScanStore) -> None:
    made = [store.create(ScanPlan(), rig="bench", label=str(number)) for number in range(5)]
    first = store.page(before=None, limit=3)
    second = store.page(before=first[-1].number, limit=3)
    assert [scan.id for scan in (*first, *second)] == [scan.id for scan in reversed(made)]


def test_numbers_are_never_given_twice(store: ScanStore) -> None:
    gone = store.create(ScanPlan(), rig="bench", label=None)
    store.delete(gone.id)
    assert store.create(ScanPlan(), rig="bench", label=None).number > gone.number
    assert store.events(gone.id, after=0) == []
    with pytest.raises(ScanNotFoundError, match=str(gone.id)):
        store.get(gone.id)


def test_unknown_scan_is_refused_everywhere(store: ScanStore) -> None:
    unknown = uuid4()
    with pytest.raises(ScanNotFoundError):
        store.delete(unknown)
    with pytest.raises(ScanNotFoundError):
        store.advance(unknown, ScanState.CAPTURING)


def test_watcher_is_woken_by_its_scan_only_and_until_it_leaves(store: ScanStore) -> None:
    watched = store.create(ScanPlan(), rig="bench", label=None)
    other = store.create(ScanPlan(), rig="bench", label=None)
    calls: list[int] = []
    unwatch = store.watch(watched.id, lambda: calls.append(len(store.events(watched.id, after=0))))
    store.advance(other.id, ScanState.CAPTURING)
    store.advance(watched.id, ScanState.CAPTURING)
    assert calls == [2]
    unwatch()
    store.finish(watched.id, ScanState.CANCELLED)
    assert calls == [2]


def test_idempotency_key_leads_back_to_its_scan(store: ScanStore) -> None:
    assert store.reserve_key("k", "body") is None
    with pytest.raises(KeyInFlightError):
        store.reserve_key("k", "body")
    scan = store.create(ScanPlan(), rig="bench", label=None, key="k")
    assert store.reserve_key("k", "body") == scan.id
    with pytest.raises(IdempotencyError, match="another request body"):
        store.reserve_key("k", "other body")


def test_key_of_a_refused_request_is_free_again(store: ScanStore) -> None:
    store.reserve_key("k", "body")
    store.release_key("k")
    assert store.reserve_key("k", "other body") is None


def test_key_of_a_scan_is_not_released(store: ScanStore) -> None:
    store.reserve_key("k", "body")
    scan = store.create(ScanPlan(), rig="bench", label=None, key="k")
    store.release_key("k")
    store.release_keys()
    assert store.reserve_key("k", "body") == scan.id


def test_key_is_forgotten_after_a_day(store: ScanStore, clock: SetClock) -> None:
    store.reserve_key("k", "body")
    store.create(ScanPlan(), rig="bench", label=None, key="k")
    clock.move(hours=23, minutes=59)
    with pytest.raises(IdempotencyError):
        store.reserve_key("k", "other body")
    clock.move(minutes=2)
    assert store.reserve_key("k", "other body") is None


def test_migrations_give_the_tables_that_the_code_uses(tmp_path: Path) -> None:
    ScanStore(tmp_path / "slrig.sqlite").close()
    engine = create_engine(f"sqlite:///{tmp_path / 'slrig.sqlite'}")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        assert connection.execute(text("PRAGMA journal_mode")).scalar() == "wal"
    engine.dispose()


def test_record_that_is_no_database_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "slrig.sqlite").write_bytes(b"not a database, for certain" * 100)
    with pytest.raises(StorageError, match=r"slrig\.sqlite"):
        ScanStore(tmp_path / "slrig.sqlite")


def test_progress_is_recorded_by_stage_by_hundredths_and_while_a_stage_goes_on(store: ScanStore) -> None:
    scan = store.create(ScanPlan(), rig="bench", label=None)
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
