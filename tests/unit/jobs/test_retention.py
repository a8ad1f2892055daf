"""Old jobs: removed by count, age and size; pinned ones, those being read and those under way are kept."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import cast
from uuid import UUID

import pytest

from slrig.api.server import KINDS
from slrig.errors import StorageError
from slrig.jobs.data_folder import DataFolder, write_entries
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobState, write_record
from slrig.jobs.resume import resume
from slrig.jobs.retention import (
    CLOCK,
    DOUBT_S,
    READ_S,
    TRASH,
    TRASH_S,
    Archive,
    JobArchive,
    Limits,
    Retention,
    SteadyClock,
)
from slrig.jobs.store import Audit, JobStore, Outbox, RequestKeys
from slrig.rig.session import RigSession
from slrig.scan.job import plan_json
from slrig.scan.plan import ScanPlan
from tests.core import parametrize_core
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import never

NOON = datetime(2026, 11, 23, 12, tzinfo=UTC)


class Scans:
    """Scans of a data folder, each an hour younger than the one before, of 1000 bytes: an `Archive`."""

    def __init__(self, root: Path) -> None:
        self.now, self.now_s = NOON, 0.0
        self.folder = DataFolder(root)
        self.store = JobStore(Database(self.folder.database), clock=lambda: self.now)
        rig, worker = RigSession("bench", never), TameCompute(PIPELINE)
        self.manager = JobManager(self.store, self.folder, rig, worker, *KINDS)
        self.jobs = JobArchive(self.manager, JobKind.SCAN, self.folder.scans)
        self.kind, self.kept, self.needed, self.place = "scan", self.jobs.kept, self.jobs.needed, self.jobs.place
        self.audit = Audit(self.store.database, clock=lambda: self.now)
        self.refuses: set[UUID] = set()
        self.removed = threading.Event()
        self.restart()

    def restart(self) -> None:
        """Begin with the clock's state as it is on disk."""
        self.steady = SteadyClock(self.folder.root / CLOCK, clock=lambda: self.now, now_s=lambda: self.now_s)

    def scan(self, state: JobState = JobState.SUCCEEDED) -> UUID:
        self.now += timedelta(hours=1)
        made = self.store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None).id
        if state.final:
            self.store.finish(made, state)
            self.folder.scan(made).mkdir()
            (self.folder.scan(made) / "mesh.ply").write_bytes(bytes(998))
            (self.folder.scan(made) / "report.json").write_bytes(b"{}")
        return made

    def remove(self, item: UUID, trash: Path) -> None:
        if item in self.refuses:
            message = "read-only"
            raise StorageError(message)
        self.jobs.remove(item, trash)
        self.removed.set()

    def retention(self, limits: Limits) -> Retention:
        archives = [(cast("Archive", self), limits)]
        return Retention(self.folder.root, archives, self.audit, self.steady, now_s=lambda: self.now_s)


@pytest.fixture
def archive(tmp_path: Path) -> Iterator[Scans]:
    found = Scans(tmp_path / "data")
    yield found
    found.store.database.close()
    found.folder.release()


@parametrize_core(
    ("limits", "kept"),
    [
        (Limits(), 5),
        (Limits(count=2), 2),
        (Limits(days=2.5 / 24), 3),
        (Limits(size_bytes=3999), 3),
        (Limits(count=4, days=1.0, size_bytes=1000), 1),
    ],
    core=[1, 3, 4],
)
def test_the_oldest_beyond_a_limit_are_removed(archive: Scans, limits: Limits, kept: int) -> None:
    made = [archive.scan() for _ in range(5)]
    assert list(archive.retention(limits).apply()) == made[: 5 - kept]
    assert archive.retention(limits).apply() == []


def test_a_scan_that_is_pinned_under_way_or_being_read_is_kept(archive: Scans) -> None:
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


def test_those_that_failed_push_out_none_that_succeeded_and_go_first(archive: Scans) -> None:
    good = [archive.scan() for _ in range(2)]
    failed = [archive.scan(state) for state in (JobState.FAILED, JobState.CANCELLED, JobState.INTERRUPTED)]
    assert archive.retention(Limits(count=2)).apply() == failed[:1]
    assert archive.retention(Limits(size_bytes=2500)).apply() == failed[1:]
    assert archive.retention(Limits(size_bytes=1500)).apply() == good[:1]


EVERY_LIMIT = Limits(count=9, days=30.0, size_bytes=10**6)


@pytest.mark.parametrize("restarts", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("years", [-10, 10])
def test_a_clock_that_jumps_removes_nothing(archive: Scans, years: int, *, restarts: bool) -> None:
    def look() -> None:
        if restarts:
            archive.restart()
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


@parametrize_core("years", [-10, 10])
def test_notices_and_keys_of_requests_outlive_a_clock_that_jumps(archive: Scans, years: int) -> None:
    clock, scan = archive.steady.now, archive.scan()
    outbox = Outbox(archive.store.database, wanted={"webhook": ["job.ended"]}, clock=clock)
    keys = RequestKeys(archive.store.database, clock=clock)
    keys.reserve("mine", "fingerprint")
    keys.tie("mine", scan)
    with archive.store.database.changing() as session:
        outbox.ended(session, archive.store.get(scan))
    for _ in range(2):
        archive.now += timedelta(days=365 * years)
        assert outbox.oldest("webhook") is not None
        assert keys.reserve("mine", "fingerprint") == scan
        years = -years


def test_time_that_a_rig_was_off_counts_once_it_has_run_for_a_week(archive: Scans) -> None:
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


def test_a_clock_that_stands_or_a_damaged_state_of_it_removes_nothing(archive: Scans) -> None:
    archive.scan()
    for _ in range(100):
        archive.now_s += 86400.0
        assert archive.retention(EVERY_LIMIT).apply() == []
    (archive.folder.root / CLOCK).write_bytes(b"{")
    archive.restart()
    assert archive.retention(EVERY_LIMIT).apply() == []


def test_a_disk_that_refuses_one_keeps_that_one_only(archive: Scans) -> None:
    first, second, _ = archive.scan(), archive.scan(), archive.scan()
    archive.refuses = {first}
    assert archive.retention(Limits(count=1)).apply() == [second]


def test_it_looks_at_its_start_and_when_it_is_told_to(archive: Scans) -> None:
    made = [archive.scan() for _ in range(2)]
    retention = archive.retention(Limits(count=1))
    retention.start()
    assert archive.removed.wait(30)
    archive.removed.clear()
    made.append(archive.scan())
    retention.check("scan")
    assert archive.removed.wait(30)
    retention.close()
    assert [each.id for each in archive.store.finished()] == made[2:]


def test_what_is_removed_lies_in_the_trash_for_a_day_of_the_service_and_comes_back_by_hand(archive: Scans) -> None:
    first, second, last = (archive.scan() for _ in range(3))
    for scan in (first, second):
        write_record(archive.folder.scan(scan), archive.store.get(scan))
        write_entries(archive.folder.scan(scan))
    retention = archive.retention(Limits(count=1))
    assert retention.apply() == [first, second]
    assert [(each.who, each.method, each.path, each.status) for each in archive.audit.page(before=None, limit=9)] == [
        ("slrig: keep_scans = 1", "DELETE", f"/scan/{scan}", 204) for scan in (second, first)
    ]
    trash = archive.folder.root / TRASH
    # A system clock that jumps is no day of the service, nor is one that it was off.
    archive.now += timedelta(days=3650)
    archive.restart()
    assert archive.retention(Limits(count=1)).apply() == []
    assert sorted(place.name.split("-", 2)[2] for place in trash.iterdir()) == sorted(map(str, (first, second)))
    (place,) = trash.glob(f"*-scan-{first}")
    place.rename(archive.folder.scan(first))
    resume(archive.manager)
    back = archive.store.get(first)
    assert (back.state, back.pinned) == (JobState.SUCCEEDED, True)
    (trash / "somebody's").mkdir()
    for seconds, left in ((TRASH_S / 2, 2), (TRASH_S / 2 + 1, 1), (TRASH_S / 2, 0)):
        archive.now_s += seconds
        assert archive.retention(Limits(count=9)).apply() == []
        assert len(list(trash.iterdir())) == left
    assert {each.id for each in archive.store.finished()} == {first, last}


def test_trash_of_a_clock_whose_state_was_lost_is_kept_for_a_day_more(archive: Scans) -> None:
    archive.scan(), archive.scan()
    archive.now_s += 10 * TRASH_S
    archive.retention(Limits(count=1)).apply()
    (archive.folder.root / CLOCK).unlink()
    archive.restart()
    for seconds, left in ((0.0, 1), (TRASH_S - 1, 1), (2.0, 0)):
        archive.now_s += seconds
        archive.retention(Limits(count=9)).apply()
        assert len(list((archive.folder.root / TRASH).iterdir())) == left
