"""What is on record of jobs: their states and events, progress, the keys of requests, what took how long."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, text

from slrig.errors import IdempotencyError, JobNotFoundError, KeyInFlightError, StorageError
from slrig.failure import JobFailure
from slrig.jobs import records as module
from slrig.jobs.database import Base, Database, sqlite_engine
from slrig.jobs.job import ProgressRecorder
from slrig.jobs.records import UNREADABLE, JobKind, JobProgress, JobRecord, JobState, Stage, stages_of
from slrig.jobs.store import KEPT_PROGRESS, JobStore, RequestKeys
from slrig.scan.job import plan_from_json, plan_json
from slrig.scan.plan import PatternPlan, PresetUse, ScanPlan
from tests.core import parametrize_core
from tests.unit.scan.fakes import SetClock

NOON = SetClock().now


def hours_on(hours: int) -> datetime:
    """A moment after noon, by the clocks of another place."""
    return (NOON + timedelta(hours=hours)).astimezone(timezone(timedelta(hours=-5)))


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture
def store(tmp_path: Path, clock: SetClock) -> Iterator[JobStore]:
    store = JobStore(Database(tmp_path / "slrig.sqlite"), clock=clock)
    yield store
    store.database.close()


@pytest.fixture
def keys(store: JobStore, clock: SetClock) -> RequestKeys:
    return RequestKeys(store.database, clock=clock)


def test_scan_comes_back_as_it_was_recorded(store: JobStore, clock: SetClock) -> None:
    plan = ScanPlan(patterns=PatternPlan(line_shift_period_px=12, rows=True), exposure_s=0.02)
    made = store.create(plan_json(plan), kind=JobKind.SCAN, rig="bench", label="cup")
    assert store.get(made.id) == made
    assert (plan_from_json(made.plan), made.label, made.rig, made.state) == (plan, "cup", "bench", JobState.QUEUED)
    assert made.created_at == clock.now


def test_progress_of_jobs_long_over_is_forgotten(store: JobStore) -> None:
    made = [store.create({}, kind=JobKind.SCAN, rig="bench", label=None).id for _ in range(KEPT_PROGRESS + 2)]
    for job in made:
        store.progress(job, JobProgress("capture", 0.25, ""))
        store.finish(job, JobState.SUCCEEDED)
    kinds = [[event.kind for event in store.events(job, after=0)] for job in made]
    assert kinds == [["state", "state"]] * 2 + [["state", "progress", "state"]] * KEPT_PROGRESS


def test_life_of_a_scan_is_told_by_its_events_in_order(store: JobStore, clock: SetClock) -> None:
    scan = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None)
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
    scan = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None)
    assert store.finish(scan.id, JobState.SUCCEEDED, summary={"points": 3})
    assert not store.finish(scan.id, JobState.INTERRUPTED)
    assert store.get(scan.id).state is JobState.SUCCEEDED
    assert store.get(scan.id).summary == {"points": 3}


def test_pages_run_from_new_to_old_without_overlap(store: JobStore) -> None:
    made = store.create_all([plan_json(ScanPlan())] * 5, kind=JobKind.SCAN, rig="bench")
    first = store.page(before=None, limit=3)
    second = store.page(before=first[-1].number, limit=3)
    assert [scan.id for scan in (*first, *second)] == [scan.id for scan in reversed(made)]


def asked(preset: str) -> dict[str, object]:
    return plan_json(ScanPlan(preset=PresetUse(preset, 1, "0" * 64)))


@parametrize_core(
    ("wanted", "found"),
    [
        ({"name": "GRÖSSE_"}, [1]), ({"name": "LATE-00"}, [2, 0]), ({"name": "%"}, []), ({"name": "ID"}, [2]),
        ({"states": [JobState.FAILED, JobState.CAPTURING]}, [2, 0]), ({"rig": "hall"}, [3]), ({"preset": "shiny"}, [1]),
        ({"since": hours_on(1), "until": hours_on(3)}, [2, 1]), ({"name": "0", "preset": "dark", "until": NOON}, []),
    ],
    ids=str, core=[0, 2, 4, 6],)  # fmt: skip
def test_pages_have_what_is_asked_for(
    store: JobStore, clock: SetClock, wanted: dict[str, Any], found: list[int]
) -> None:
    ids = []
    labels = ["plate-007", "Größe_10", "plate-008", None]
    for label, plan, rig in zip(labels, [{}, asked("shiny"), asked("dark"), {}], [*["bench"] * 3, "hall"], strict=True):
        ids.append(store.create(plan, kind=JobKind.SCAN, rig=rig, label=label).id)
        clock.move(seconds=3600)
    store.advance(ids[0], JobState.CAPTURING)
    store.finish(ids[2], JobState.FAILED)
    # A plan that is damaged is of no preset.
    store.database.close()
    with sqlite3.connect(store.database.path) as file:
        file.execute("UPDATE job SET plan = '{' WHERE id = ?", (str(ids[3]),))
    if wanted.get("name") == "ID":
        wanted = {"name": str(ids[2])[:8].upper()}
    page = store.page(JobKind.SCAN, before=None, limit=10, **wanted)
    assert [ids.index(record.id) for record in page] == found


def test_numbers_are_never_given_twice(store: JobStore) -> None:
    gone = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None)
    store.delete(gone.id)
    assert store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None).number > gone.number
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
    watched = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None)
    other = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None)
    calls: list[int] = []
    unwatch = store.watch(watched.id, lambda: calls.append(len(store.events(watched.id, after=0))))
    store.advance(other.id, JobState.CAPTURING)
    store.advance(watched.id, JobState.CAPTURING)
    assert calls == [2]
    unwatch()
    store.finish(watched.id, JobState.CANCELLED)
    assert calls == [2]


def test_jobs_of_one_parent_are_listed_and_followed_together(tmp_path: Path, clock: SetClock) -> None:
    jobs = JobStore(Database(tmp_path / "poses.sqlite"), clock=clock)
    session, other = uuid4(), uuid4()
    woken: list[str] = []
    unwatch = jobs.watch(session, lambda: woken.append("session"))
    first = jobs.create({"number": 1}, kind=JobKind.POSE, rig="bench", label=None, parent=session)
    alone = jobs.create({"number": 1}, kind=JobKind.POSE, rig="bench", label=None, parent=other)
    solve = jobs.create({"number": 1}, kind=JobKind.SOLVE, rig="bench", label=None, parent=session)
    jobs.finish(first.id, JobState.SUCCEEDED, summary={"answer": {}})
    assert jobs.of(session) == [jobs.get(first.id), jobs.get(solve.id)]
    assert [job.id for job in jobs.by_parent()[other]] == [alone.id]
    events = jobs.events_of(session, after=0)
    assert [(event.job, event.data["state"]) for event in events] == [
        (first.id, "queued"), (solve.id, "queued"), (first.id, "succeeded"),
    ]  # fmt: skip
    assert jobs.events_of(session, after=events[1].number) == events[2:]
    assert jobs.last_event_of(session) == events[-1].number
    assert jobs.last_event_of(uuid4()) == 0
    assert len(woken) == 3
    jobs.delete_of(session)
    assert (jobs.of(session), jobs.events_of(session, after=0)) == ([], [])
    assert jobs.get(alone.id).parent == other
    unwatch()
    jobs.database.close()


def test_progress_is_recorded_by_stage_by_hundredths_and_while_a_stage_goes_on(store: JobStore) -> None:
    scan = store.create({}, kind=JobKind.SCAN, rig="bench", label=None)
    now_s = [0.0]
    record = ProgressRecorder(store, scan.id, hidden="secret/", now_s=lambda: now_s[0])
    for at_s, stage, fraction, detail in (
        (0.0, "preparing kernels", 0.0, "0 of 56"),
        (0.5, "preparing kernels", 0.0, "1 of 56"),  # too soon to be told
        (2.5, "preparing kernels", 0.0, "9 of 56"),
        (9.0, "preparing kernels", 0.0, "9 of 56"),  # nothing new
        (9.1, "decode", 0.001, "secret/a"),
        (9.15, "decode", 0.2, "too soon after the last"),
        (9.3, "decode", 0.5, ""),
        (9.31, "decode", 1.0, "the end"),
    ):
        now_s[0] = at_s
        record(stage, fraction, detail)
    events = [event.data for event in store.events(scan.id, after=0) if event.kind == "progress"]
    assert [(each["stage"], each["detail"]) for each in events] == [
        ("preparing kernels", "0 of 56"),
        ("preparing kernels", "9 of 56"),
        ("decode", "a"),
        ("decode", ""),
        ("decode", "the end"),
    ]


def test_an_attempt_counts_once_the_worker_has_begun(store: JobStore) -> None:
    scan = store.create({}, kind=JobKind.SCAN, rig="bench", label=None)
    captured = ProgressRecorder(store, scan.id, hidden="secret/")
    captured("capturing", 0.5, "")
    for attempt in (1, 2):
        computed = ProgressRecorder(store, scan.id, hidden="secret/", attempt=True)
        for stage in ("waiting for the worker", "waiting for the pool"):
            computed(stage, 0.0, "")
        assert store.attempts(scan.id) == attempt - 1
        for fraction in (0.0, 0.5):
            computed("decode", fraction, "")
        assert store.attempts(scan.id) == attempt
    # Computed anew, it has all its attempts.
    store.finish(scan.id, JobState.SUCCEEDED)
    store.advance(scan.id, JobState.COMPUTING)
    assert store.attempts(scan.id) == 0


def spans(stages: Iterator[Stage]) -> list[tuple[str, float, float, str | None]]:
    return [(stage.name, (stage.begin - NOON).total_seconds(), stage.seconds, stage.inside) for stage in stages]


def test_job_that_ends_is_told_with_its_stages(store: JobStore, clock: SetClock) -> None:
    told: list[JobRecord] = []
    store.after_end = told.append
    job = store.create({}, kind=JobKind.SCAN, rig="bench", label=None).id
    clock.move(seconds=2)
    store.advance(job, JobState.CAPTURING)
    clock.move(seconds=5)
    store.progress(job, JobProgress("capture", 0.5, ""))
    store.advance(job, JobState.COMPUTING)
    clock.move(seconds=10)
    assert told == []
    assert store.finish(job, JobState.SUCCEEDED, summary={"stages_s": {"decode": 3.0, "mesh": 6.5}})
    assert not store.finish(job, JobState.FAILED)
    (record,) = told
    assert record == store.get(job)
    assert spans(stages_of(record, store.events(job, after=0))) == [
        ("queued", 0, 2, None),
        ("capturing", 2, 5, None),
        ("computing", 7, 10, None),
        ("decode", 7, 3, "computing"),
        ("mesh", 10, 6.5, "computing"),
    ]


def test_job_that_never_began_only_waited(store: JobStore, clock: SetClock) -> None:
    job = store.create({}, kind=JobKind.SCAN, rig="bench", label=None).id
    clock.move(seconds=4)
    store.finish(job, JobState.CANCELLED)
    assert spans(stages_of(store.get(job), store.events(job, after=0))) == [("queued", 0, 4, None)]


def test_idempotency_key_leads_back_to_its_scan(store: JobStore, keys: RequestKeys) -> None:
    assert keys.reserve("k", "body") is None
    with pytest.raises(KeyInFlightError):
        keys.reserve("k", "body")
    scan = store.create({}, kind=JobKind.SCAN, rig="bench", label=None, key="k")
    assert keys.reserve("k", "body") == scan.id
    with pytest.raises(IdempotencyError, match="another request body"):
        keys.reserve("k", "other body")


def test_key_of_a_refused_request_is_free_again(keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    keys.release("k")
    assert keys.reserve("k", "other body") is None


def test_key_of_a_scan_is_not_released(store: JobStore, keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    scan = store.create({}, kind=JobKind.SCAN, rig="bench", label=None, key="k")
    keys.release("k")
    keys.release_all()
    assert keys.reserve("k", "body") == scan.id


def test_key_is_forgotten_after_a_day(store: JobStore, keys: RequestKeys, clock: SetClock) -> None:
    keys.reserve("k", "body")
    store.create({}, kind=JobKind.SCAN, rig="bench", label=None, key="k")
    clock.move(hours=23, minutes=59)
    with pytest.raises(IdempotencyError):
        keys.reserve("k", "other body")
    clock.move(minutes=2)
    assert keys.reserve("k", "other body") is None


def test_key_leads_back_to_what_is_no_job(keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    keys.tie("k", made := uuid4())
    keys.release("k")
    assert keys.reserve("k", "body") == made


def test_two_states_of_one_version_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for code in ("", "", "one = 1"):
        (tmp_path / "kernel.py").write_text(code)
        monkeypatch.setattr(module, "_PACKAGE", tmp_path)
        module.versions.cache_clear()
        found.append(dict(module.versions()))
    module.versions.cache_clear()
    assert found[0] == found[1] != found[2]
    assert found[0]["numba"] == version("numba")


# The file that all of it lies in: its tables, and the files that it refuses


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "slrig.sqlite"


def test_migrations_give_the_tables_that_the_code_uses(path: Path) -> None:
    for _ in range(2):
        Database(path).close()
    engine = create_engine(f"sqlite:///{path}")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        assert connection.execute(text("PRAGMA journal_mode")).scalar() == "wal"
    engine.dispose()


@pytest.mark.parametrize(("version", "undone"), [
    ("records2", ["DROP TABLE notice", "ALTER TABLE job DROP COLUMN requested_by", "DROP TABLE audit"]),
    ("records4", ["ALTER TABLE notice DROP COLUMN receiver"]),
])  # fmt: skip
def test_tables_of_an_earlier_version_become_todays_and_keep_their_rows(
    path: Path, version: str, undone: Sequence[str]
) -> None:
    database = Database(path)
    kept = JobStore(database).create({}, kind=JobKind.SCAN, rig="bench", label="kept").id
    database.close()
    with sqlite3.connect(path) as file:
        for statement in (*undone, "DROP TABLE job_copy", "ALTER TABLE job DROP COLUMN attempts"):
            file.execute(statement)
        file.execute("UPDATE alembic_version SET version_num = ?", [version])
    file.close()
    database = Database(path)
    assert [record.id for record in JobStore(database).page(before=None, limit=10)] == [kept]
    database.close()
    engine = create_engine(f"sqlite:///{path}")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
    engine.dispose()


def test_what_a_power_cut_may_undo_is_not_brought_to_disk_by_itself(path: Path) -> None:
    database, found = Database(path), []
    for passing in (False, True, False):
        with database.changing(passing=passing) as session:
            found.append(session.scalar(text("PRAGMA synchronous")))
    database.close()
    assert found == [2, 1, 2]  # FULL, NORMAL


def test_programs_that_open_a_new_file_together_wait_for_one_another(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with sqlite3.connect(path) as other:
        other.execute("CREATE TABLE other_program (number INTEGER)")
    other.execute("BEGIN IMMEDIATE")
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        other.rollback()

    monkeypatch.setattr("slrig.jobs.database.time.sleep", wait)
    engine = sqlite_engine(path)
    with engine.connect() as connection:
        assert connection.execute(text("PRAGMA journal_mode")).scalar() == "wal"
    engine.dispose()
    other.close()
    assert len(waits) == 1


def spoilt(path: Path, damage: str) -> None:
    """Damage a database of 200 jobs."""
    content = bytearray(path.read_bytes())
    match damage:
        case "garbage":
            content = bytearray(b"not a database, for certain" * 100)
        case "head":
            content[:32] = bytes(32)
        case "a page":
            content[30 * 4096 : 31 * 4096] = bytes(range(256)) * 16
        case "cut":
            del content[36 * 4096 :]
        case "emptied":
            content.clear()
        case _:
            path.unlink()
            path.mkdir()
            return
    path.write_bytes(content)


@parametrize_core("damage", ["a page", "emptied", "garbage", "head", "cut", "a folder"])
def test_a_damaged_database_is_put_aside_and_its_readable_rows_taken_over(path: Path, damage: str) -> None:
    before = Database(path)
    made = JobStore(before).create_all([{"number": i} for i in range(200)], kind=JobKind.SCAN, rig="bench")
    before.close()
    spoilt(path, damage)
    database = Database(path, aside=path.parent / ".orphans")
    store = JobStore(database)
    found = {record.id for record in store.unfinished()}
    assert found <= {record.id for record in made}
    assert len(found) >= (60 if damage in {"a page", "cut"} else 0)
    store.create({}, kind=JobKind.SCAN, rig="bench")
    database.close()
    # An empty file is a new database.
    assert len(list((path.parent / ".orphans").glob("*"))) == (0 if damage == "emptied" else 1)
    Database(path).close()


@parametrize_core(
    "changed",
    [
        {"plan": "{", "created_at": "yesterday"}, {"summary": "[1]"}, {"state": "what"}, {"plan": b"\xff\xfe"},
        {"fraction": "half"}, {"finished_at": 7}, {"plan": "[" * 100_000}, {"parent": "nobody"},
    ],
    ids=lambda changed: "+".join(changed), core=[0, 3, 6],)  # fmt: skip
def test_a_row_that_cannot_be_read_is_a_failed_job_beside_the_others(
    path: Path, changed: dict[str, object], clock: SetClock
) -> None:
    store = JobStore(Database(path), clock=clock)
    first, bad, last = store.create_all([{}] * 3, kind=JobKind.SCAN, rig="bench", label="part")
    file = sqlite3.connect(path)
    for column, value in changed.items():
        file.execute(f"UPDATE job SET {column} = ? WHERE id = ?", (value, str(bad.id)))  # noqa: S608
    file.commit()
    for _ in range(2):
        # While the service runs, and after its next start.
        listed = store.page(before=None, limit=10)
        assert [record.id for record in listed] == [last.id, bad.id, first.id]
        assert [record.fault == UNREADABLE for record in listed] == [False, True, False]
        assert (listed[1].state, listed[1].plan, listed[1].label) == (JobState.FAILED, {}, "part")
        assert store.states()[first.id] is JobState.QUEUED
        assert [record.id for record in store.unreadable()] == [bad.id]
    assert store.damaged() == {JobKind.SCAN: 1}
    assert [record.id for record in store.unfinished()] == [first.id, last.id]
    store.delete(bad.id)
    assert [record.id for record in store.page(before=None, limit=10)] == [last.id, first.id]
    file.execute("UPDATE job SET id = 'x' WHERE id = ?", (str(last.id),))
    file.commit()
    file.close()
    store.unreadable()
    assert [record.id for record in store.page(before=None, limit=10)] == [first.id]
    store.database.close()


@pytest.mark.parametrize("version", ["0001", "records99"])
def test_records_of_another_version_are_refused_and_left_as_they_are(path: Path, version: str) -> None:
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)")
        file.execute("INSERT INTO alembic_version VALUES (?)", [version])
    file.close()
    with pytest.raises(StorageError, match=rf"of version {version}.*Move that file out of the data folder.*--data"):
        Database(path)
    with sqlite3.connect(path) as file:
        assert file.execute("SELECT name FROM sqlite_master").fetchall() == [("alembic_version",)]
    file.close()
