"""Old jobs: removed by count, age and size; pinned ones, those being read and those under way are kept."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID

import pytest

from slrig.errors import StorageError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.retention import DOUBT_S, READ_S, JobRetention, Limits, SteadyClock
from slrig.jobs.store import JobStore
from slrig.scan.job import plan_json
from slrig.scan.plan import ScanPlan

NOON = datetime(2026, 11, 23, 12, tzinfo=UTC)


class Archive:
    """Scans of a data folder, each an hour younger than the one before, of 1000 bytes."""

    def __init__(self, root: Path) -> None:
        self.now, self.now_s = NOON, 0.0
        self.folder = DataFolder(root)
        self.store = JobStore(Database(self.folder.database), clock=lambda: self.now)
        self.steady = SteadyClock(root / "clock.json", clock=lambda: self.now, now_s=lambda: self.now_s)
        self.deleted: list[UUID] = []
        self.refuses: set[UUID] = set()

    def scan(self, state: JobState = JobState.SUCCEEDED) -> UUID:
        self.now += timedelta(hours=1)
        made = self.store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None).id
        if state.final:
            self.store.finish(made, state)
            self.folder.scan(made).mkdir()
            (self.folder.scan(made) / "mesh.ply").write_bytes(bytes(1000))
        return made

    def delete(self, scan: UUID) -> None:
        if scan in self.refuses:
            message = "read-only"
            raise StorageError(message)
        self.store.delete(scan)
        self.deleted.append(scan)

    def retention(self, limits: Limits, delete: Callable[[UUID], None] | None = None) -> JobRetention:
        return JobRetention(
            self.store, JobKind.SCAN, limits, self.folder.scan, delete or self.delete,
            clock=self.steady.now, now_s=lambda: self.now_s,
        )  # fmt: skip


@pytest.fixture
def archive(tmp_path: Path) -> Iterator[Archive]:
    found = Archive(tmp_path / "data")
    yield found
    found.store.database.close()
    found.folder.release()


@pytest.mark.parametrize(
    ("limits", "kept"),
    [
        (Limits(), 5),
        (Limits(count=2), 2),
        (Limits(days=2.5 / 24), 3),
        (Limits(size_bytes=3999), 3),
        (Limits(count=4, days=1.0, size_bytes=1000), 1),
    ],
)
def test_the_oldest_beyond_a_limit_are_removed(archive: Archive, limits: Limits, kept: int) -> None:
    made = [archive.scan() for _ in range(5)]
    assert list(archive.retention(limits).apply()) == made[: 5 - kept]
    assert archive.retention(limits).apply() == []


def test_a_scan_that_is_pinned_under_way_or_being_read_is_kept(archive: Archive) -> None:
    pinned, under_way, read, old, new = (
        archive.scan(), archive.scan(JobState.CAPTURING), archive.scan(), archive.scan(), archive.scan(),
    )  # fmt: skip
    archive.store.pin(pinned, pinned=True)
    retention = archive.retention(Limits(count=1))
    retention.reading(read)
    assert retention.apply() == [old]
    archive.now_s = READ_S
    assert retention.apply() == [read]
    archive.store.pin(pinned, pinned=False)
    assert retention.apply() == [pinned]
    assert {job.id for job in archive.store.page(before=None, limit=9)} == {under_way, new}


def test_those_that_failed_push_out_none_that_succeeded_and_go_first(archive: Archive) -> None:
    good = [archive.scan() for _ in range(2)]
    failed = [archive.scan(state) for state in (JobState.FAILED, JobState.CANCELLED, JobState.INTERRUPTED)]
    assert archive.retention(Limits(count=2)).apply() == failed[:1]
    assert archive.retention(Limits(size_bytes=2500)).apply() == failed[1:]
    assert archive.retention(Limits(size_bytes=1500)).apply() == good[:1]


EVERY_LIMIT = Limits(count=9, days=30.0, size_bytes=10**6)


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("years", [-10, 10])
def test_a_clock_that_jumps_removes_nothing(archive: Archive, years: int, *, restarts: bool) -> None:
    def look() -> None:
        if restarts:
            archive.steady = SteadyClock(archive.steady._file, clock=lambda: archive.now, now_s=lambda: archive.now_s)
        assert archive.retention(EVERY_LIMIT).apply() == []

    made = [archive.scan() for _ in range(3)]
    look()
    jump = timedelta(days=365 * years)
    archive.now += jump
    for _ in range(3):
        archive.now_s += 3600.0
        made.append(archive.scan())
        look()
    # It is set right: what was recorded meanwhile says wrong times.
    archive.now -= jump
    for _ in range(9):
        archive.now_s += 86400.0
        archive.now += timedelta(days=1)
        look()
    assert archive.store.finished(JobKind.SCAN)[0].id == made[-1]


def test_time_that_a_rig_was_off_counts_once_it_has_run_for_a_week(archive: Archive) -> None:
    old = archive.scan()
    assert archive.retention(EVERY_LIMIT).apply() == []
    archive.now += timedelta(days=60)
    archive.scan()
    day_s = 86400.0
    for _ in range(int(DOUBT_S / day_s) - 1):
        archive.now_s += day_s
        archive.now += timedelta(days=1)
        assert archive.retention(EVERY_LIMIT).apply() == []
    archive.now_s += 2 * day_s
    archive.now += timedelta(days=2)
    assert archive.retention(EVERY_LIMIT).apply() == [old]


def test_a_clock_that_stands_or_a_damaged_state_of_it_removes_nothing(archive: Archive) -> None:
    archive.scan()
    for _ in range(100):
        archive.now_s += 86400.0
        assert archive.retention(EVERY_LIMIT).apply() == []
    archive.steady._file.write_bytes(b"{")
    archive.steady = SteadyClock(archive.steady._file, clock=lambda: archive.now, now_s=lambda: archive.now_s)
    assert archive.retention(EVERY_LIMIT).apply() == []


def test_a_disk_that_refuses_one_keeps_that_one_only(archive: Archive) -> None:
    first, second, _ = archive.scan(), archive.scan(), archive.scan()
    archive.refuses = {first}
    assert archive.retention(Limits(count=1)).apply() == [second]


def test_it_looks_at_its_start_and_when_it_is_told_to(archive: Archive) -> None:
    removed = threading.Event()

    def delete(scan: UUID) -> None:
        archive.delete(scan)
        removed.set()

    first, second = archive.scan(), archive.scan()
    retention = archive.retention(Limits(count=1), delete)
    retention.start()
    assert removed.wait(30)
    removed.clear()
    archive.scan()
    retention.look()
    assert removed.wait(30)
    retention.close()
    assert archive.deleted == [first, second]
