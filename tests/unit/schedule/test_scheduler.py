"""Due times and runs: cron text, on time, late, busy, after weeks, clocks that jump, two processes, and kills."""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy.orm import Session

from slrig.errors import (
    DeviceError,
    PoseRefusedError,
    RigBusyError,
    ScanStateError,
    ScheduleError,
    ScheduleNotFoundError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
    WorkerLostError,
)
from slrig.jobs.database import Database
from slrig.schedule.scheduler import CHECK_S, Scheduler
from slrig.schedule.store import Cron, RunState, Schedule, ScheduledRun, ScheduleSpec, ScheduleStore, TaskKind
from tests.samples import put_database
from tests.unit.jobs.tame_manager import PowerCut
from tests.unit.scan.fakes import WAIT_S

START = datetime(2026, 11, 23, 5, 0, tzinfo=UTC)
"""A Monday."""


class Desk:
    """One process's view of a database. `busy` : says who holds the rig, or None."""

    def __init__(self, database: Path, *, alone: bool = True, now: datetime = START) -> None:
        self.now = now
        self.busy: str | None = None
        self.fails: Exception | None = None
        self.done: list[tuple[Schedule, ScheduledRun]] = []
        self.told: list[tuple[datetime, RunState]] = []
        self.during: Callable[[], None] = lambda: None
        self.store = ScheduleStore(
            Database(put_database(database)),
            notice=lambda _session, _schedule, run: self.told.append((run.due, run.state)),
        )
        self.scheduler = Scheduler(
            self.store,
            self._work,
            clock=lambda: self.now,
            alone=alone,
            execute=lambda call: call(),
        )

    def _work(self, schedule: Schedule, run: ScheduledRun, /) -> Mapping[str, Any]:
        if self.busy is not None:
            raise RigBusyError(self.busy, holder=self.busy, since=START.isoformat())
        self.done.append((schedule, run))
        self.during()
        if self.fails is not None:
            raise self.fails
        return {"attempts": run.attempts}

    def daily(self, **more: Any) -> Schedule:
        """A schedule on record: 06:00 UTC, an hour of grace, tries every ten minutes."""
        order = {"cron": Cron("0 6 * * *", "UTC"), "task": TaskKind.VERIFICATION, "retry_s": 600.0, **more}
        return self.store.create(ScheduleSpec(**order), self.now)

    def look(self, **step: float) -> None:
        """Let time pass, then look at the clock."""
        self.now += timedelta(**step)
        self.scheduler.tick()

    def rows(self, schedule: Schedule) -> list[tuple[str, RunState, int]]:
        """Due time, state and count of each run, old to new."""
        runs = sorted(self.store.runs(schedule.id, limit=1000), key=lambda run: run.due)
        return [(run.due.strftime("%d %H:%M"), run.state, run.count) for run in runs]

    def run(self, schedule: Schedule) -> ScheduledRun:
        return self.store.runs(schedule.id, limit=1)[0]


BERLIN = "Europe/Berlin"

NewDesk = Callable[..., Desk]


def utc(*parts: int) -> datetime:
    return datetime(*parts, tzinfo=UTC)  # type: ignore[arg-type,misc]  # year, month, day and so on


@pytest.fixture
def new_desk(tmp_path: Path) -> Iterator[NewDesk]:
    desks: list[Desk] = []

    def made(**more: Any) -> Desk:
        desks.append(Desk(tmp_path / "slrig.sqlite", **more))
        return desks[-1]

    yield made
    for desk in desks:
        desk.store.database.close()


@pytest.fixture
def desk(new_desk: NewDesk) -> Desk:
    return new_desk()


@pytest.mark.parametrize(
    ("text", "zone", "after", "due"),
    [
        # Zero is Sunday, and names are days.
        ("0 6 * * 1", "UTC", utc(2026, 11, 22), [utc(2026, 11, 23, 6)]),
        ("0 6 * * mon", "UTC", utc(2026, 11, 22), [utc(2026, 11, 23, 6)]),
        ("0 6 * * 0", "UTC", utc(2026, 11, 20), [utc(2026, 11, 22, 6)]),
        # A time is that of clocks in its zone.
        ("30 6 * * *", BERLIN, utc(2026, 1, 10), [utc(2026, 1, 10, 5, 30)]),
        ("30 6 * * *", BERLIN, utc(2026, 7, 10), [utc(2026, 7, 10, 4, 30)]),
        # 2026-10-25: 03:00 becomes 02:00, and 02:30 happens twice but is due once.
        ("30 2 * * *", BERLIN, utc(2026, 10, 24, 12), [utc(2026, 10, 25, 0, 30), utc(2026, 10, 26, 1, 30)]),
        # Every hour that passes.
        ("0 * * * *", BERLIN, utc(2026, 10, 24, 23, 30), [utc(2026, 10, 25, hour) for hour in range(4)]),
        # 2026-03-29: 02:00 becomes 03:00, and 02:30 does not happen: it is due right after the gap.
        ("30 2 * * *", BERLIN, utc(2026, 3, 28, 12), [utc(2026, 3, 29, 1, 0), utc(2026, 3, 30, 0, 30)]),
    ],
)
def test_cron_gives_due_times_in_its_time_zone(text: str, zone: str, after: datetime, due: list[datetime]) -> None:
    cron = Cron(text, zone)
    assert cron.upcoming(after, len(due)) == tuple(due)
    assert cron.after(after) == due[0]
    assert Cron("30 6 * * *", BERLIN).local(utc(2026, 7, 10, 4, 30)).strftime("%H:%M %z") == "06:30 +0200"


def test_newest_and_count_include_both_ends() -> None:
    cron = Cron("0 6 * * *", "UTC")
    first, last = utc(2026, 11, 1, 6), utc(2026, 11, 22, 6)
    assert cron.newest(first, last) == last
    assert cron.newest(first, last - timedelta(seconds=1)) == utc(2026, 11, 21, 6)
    assert cron.newest(first + timedelta(seconds=1), first + timedelta(hours=1)) is None
    assert cron.count(first, last, most=100) == 22
    assert cron.count(first, last, most=5) == 5
    # Ten years of minutes are not gone through one by one.
    minutes = Cron("* * * * *", BERLIN)
    assert minutes.newest(utc(2016, 1, 1), utc(2026, 11, 22, 5, 55, 16)) == utc(2026, 11, 22, 5, 55)


@pytest.mark.parametrize(
    ("text", "zone", "words"),
    [
        ("0 6 * *", BERLIN, "five fields"),
        ("0 0 6 * * *", BERLIN, "five fields"),
        ("61 6 * * *", BERLIN, "Bad minute"),
        ("0 6 31 2 *", BERLIN, "Bad day-of-month"),
        ("daily", BERLIN, "06:30 on working days"),
        ("0 6 * * *", "Europe/Atlantis", "IANA"),
        ("0 6 * * *", "../../etc/passwd", "IANA"),
        ("0 6 * * *", "", "IANA"),
    ],
)
def test_invalid_cron_text_or_zone_is_refused(text: str, zone: str, words: str) -> None:
    with pytest.raises(ScheduleError, match=words):
        Cron(text, zone)


def test_order_lists_all_its_faults() -> None:
    with pytest.raises(ScheduleError, match=r"grace_s.*retry_s"):
        ScheduleSpec(Cron("0 6 * * *", "UTC"), TaskKind.VERIFICATION, grace_s=-1, retry_s=0)


def test_schedule_is_read_back_as_recorded(desk: Desk) -> None:
    made = desk.daily(label="nightly", options={"board": "wall"}, grace_s=60.0, enabled=False)
    assert desk.store.get(made.id) == made
    assert desk.store.all() == [made]


def test_run_on_time(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(minutes=59, seconds=59)
    assert desk.rows(daily) == []
    desk.look(seconds=1)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    run = desk.run(daily)
    assert (run.reason, run.started_at, run.attempts) == (None, desk.now, 1)
    desk.look(minutes=1)
    assert len(desk.done) == 1
    assert desk.store.get(daily.id).next_due == START + timedelta(hours=25)


@pytest.mark.parametrize(
    ("order", "hours", "rows", "reason"),
    [
        # Within its grace a late run says nothing of it.
        ({}, 1.9, [("23 06:00", RunState.SUCCEEDED, 1)], "None"),
        ({}, 4, [("23 06:00", RunState.SUCCEEDED, 1)], "made up for"),
        ({"catch_up": False}, 4, [("23 06:00", RunState.MISSED, 1)], "the schedule was off"),
        ({}, 14 * 24, [("23 06:00", RunState.COALESCED, 13), ("06 06:00", RunState.SUCCEEDED, 1)], "made up for"),
        (
            {"catch_up": False},
            14 * 24,
            [("23 06:00", RunState.MISSED, 13), ("06 06:00", RunState.MISSED, 1)],
            "the schedule was off",
        ),
        # Three years of minutes: counted up to a limit.
        (
            {"cron": Cron("* * * * *", BERLIN)},
            1000 * 24,
            [("23 05:01", RunState.COALESCED, 9999), ("19 05:00", RunState.SUCCEEDED, 1)],
            "None",
        ),
    ],
)
def test_what_becomes_of_late_due_times(
    desk: Desk, order: dict[str, Any], hours: float, rows: list[tuple[str, RunState, int]], reason: str
) -> None:
    schedule = desk.daily(**order)
    desk.look(hours=hours)
    assert desk.rows(schedule) == rows
    assert reason in str(desk.run(schedule).reason)
    assert len(desk.done) == sum(state is RunState.SUCCEEDED for _, state, _ in rows)
    assert [state for _, state in desk.told] == [state for _, state, _ in rows]
    if rows[0][2] == 9999:
        assert "or more" in str(desk.store.runs(schedule.id)[1].reason)


def test_run_that_a_person_asks_for_waits_as_others_do_and_has_no_twin(desk: Desk) -> None:
    daily = desk.daily(enabled=False)
    desk.busy = "a scan"
    asked = desk.store.run_now(daily.id, desk.now)
    desk.look(seconds=1)
    assert (desk.run(daily).state, desk.run(daily).reason) == (RunState.WAITING, "rig busy: a scan")
    with pytest.raises(ScanStateError, match="has a run that is waiting already"):
        desk.store.run_now(daily.id, desk.now)
    desk.busy = None
    desk.look(minutes=10)
    run = desk.run(daily)
    assert (run.number, run.state, run.due) == (asked.number, RunState.SUCCEEDED, START)
    # The order's own times are as they were.
    assert desk.store.get(daily.id).next_due == daily.next_due
    desk.store.run_now(daily.id, desk.now)
    desk.look(seconds=1)
    assert (len(desk.done), desk.run(daily).reason) == (2, "requested by a person, not by the clock")
    with pytest.raises(ScheduleNotFoundError):
        desk.store.run_now(UUID(int=1), desk.now)


@pytest.mark.parametrize(
    ("busy", "error", "reason"),
    [
        ("held by scan 7", None, "rig busy: held by scan 7"),
        (None, DeviceError("camera 'left' is gone; plug it in"), "camera 'left' is gone; plug it in"),
        (None, WorkerLostError("out of memory"), "out of memory"),
    ],
)
def test_what_may_pass_is_tried_again_within_the_grace(
    desk: Desk, busy: str | None, error: SlrigError | None, reason: str
) -> None:
    daily = desk.daily()
    desk.busy, desk.fails = busy, error
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.WAITING, 1)]
    assert desk.run(daily).reason == reason
    desk.look(minutes=9)
    assert desk.run(daily).attempts == 1
    desk.look(minutes=1)
    assert desk.run(daily).attempts == 2
    desk.busy = desk.fails = None
    desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert (desk.run(daily).attempts, desk.run(daily).reason) == (3, "at try 3")


@pytest.mark.parametrize(
    ("busy", "error", "state"),
    [("held by scan 7", None, RunState.SKIPPED), (None, DeviceError("camera 'left' is gone"), RunState.FAILED)],
)
def test_what_lasts_for_the_whole_grace_ends_the_run(
    desk: Desk, busy: str | None, error: SlrigError | None, state: RunState
) -> None:
    daily = desk.daily()
    desk.busy, desk.fails = busy, error
    desk.look(minutes=50)
    for _ in range(8):
        desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", state, 1)]
    assert desk.run(daily).reason == (f"rig busy: {busy}" if busy else str(error))
    assert desk.told == [(START + timedelta(hours=1), state)]


def test_run_that_waited_while_the_service_was_off_is_skipped(desk: Desk) -> None:
    daily = desk.daily()
    desk.busy = "held by scan 7"
    desk.look(hours=1)
    desk.busy = None
    desk.look(hours=3)
    assert desk.rows(daily) == [("23 06:00", RunState.SKIPPED, 1)]
    assert "held by scan 7" in str(desk.run(daily).reason)


def test_next_due_time_overtakes_a_waiting_run(desk: Desk) -> None:
    often = desk.daily(cron=Cron("*/5 * * * *", "UTC"), retry_s=600.0)
    desk.busy = "held by scan 7"
    desk.look(minutes=5)
    desk.look(minutes=5)
    assert desk.rows(often) == [("23 05:05", RunState.COALESCED, 1), ("23 05:10", RunState.WAITING, 1)]


def test_two_schedules_due_at_once_run_one_after_the_other(desk: Desk) -> None:
    first, second = desk.daily(), desk.daily()
    under_way = []

    def look_again() -> None:
        under_way.append(len(desk.done))
        desk.scheduler.tick()
        assert len(desk.done) == under_way[-1]

    desk.during = look_again
    desk.look(hours=1)
    assert under_way == [1, 2]
    assert desk.rows(first) == desk.rows(second) == [("23 06:00", RunState.SUCCEEDED, 1)]


def test_failure_is_recorded_with_its_cause_and_the_schedule_goes_on(desk: Desk) -> None:
    daily = desk.daily()
    errors = [
        PoseRefusedError("no camera sees the board; uncover it"),
        UnsupportedByDeviceError("this rig has no positioner"),
        RuntimeError("a defect"),
    ]
    desk.now += timedelta(hours=1)
    for error in errors:
        desk.fails = error
        desk.look()
        assert str(error) in str(desk.run(daily).reason)
        desk.now += timedelta(days=1)
    desk.fails = None
    desk.look()
    assert [state for _, state, _ in desk.rows(daily)] == [RunState.FAILED] * 3 + [RunState.SUCCEEDED]


def test_pause_is_made_up_for_once(desk: Desk) -> None:
    daily = desk.daily()
    desk.store.enable(daily.id, enabled=False)
    desk.look(days=3)
    assert desk.rows(daily) == []
    desk.store.enable(daily.id, enabled=True)
    desk.look()
    assert desk.rows(daily) == [("23 06:00", RunState.COALESCED, 2), ("25 06:00", RunState.SUCCEEDED, 1)]


def test_clock_that_is_set_back_runs_nothing_twice(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(hours=1)
    desk.look(hours=-2)
    assert desk.store.get(daily.id).next_due == START + timedelta(hours=25)
    desk.look(hours=2, minutes=1)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]


def test_clock_that_was_wrong_by_years_is_followed_when_it_is_right_again(desk: Desk) -> None:
    desk.now = START + timedelta(days=3650)
    daily = desk.daily()
    desk.now = START
    desk.look()
    assert desk.store.get(daily.id).next_due == START + timedelta(hours=1)
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]


def test_two_processes_on_one_database_start_a_run_once(new_desk: NewDesk) -> None:
    desks = new_desk(alone=False), new_desk(alone=False)
    daily = desks[0].daily()
    for day in range(4):
        for desk in desks if day % 2 else reversed(desks):
            desk.now = START + timedelta(days=day, hours=1)
            desk.look()
    assert [row[1] for row in desks[0].rows(daily)] == [RunState.SUCCEEDED] * 4
    assert len(desks[0].done) == len(desks[1].done) == 2


def test_while_one_process_runs_the_other_waits(new_desk: NewDesk) -> None:
    one, other = new_desk(alone=False), new_desk(alone=False)
    first, second = one.daily(), one.daily()
    other.now = START + timedelta(hours=1)
    one.during = other.look
    one.look(hours=1)
    assert other.done == []
    assert {one.rows(each)[0][1] for each in (first, second)} == {RunState.SUCCEEDED}


def test_run_of_a_dead_process_is_interrupted_when_it_is_silent_for_long(new_desk: NewDesk) -> None:
    one, other = new_desk(alone=False), new_desk(alone=False)
    daily = one.daily()
    one.now += timedelta(hours=1)
    one.store.record_due(one.now)
    assert one.store.start(one.run(daily), one.now)
    other.now = one.now
    other.look(seconds=30)
    assert other.rows(daily) == [("23 06:00", RunState.RUNNING, 1)]
    one.store.beat(other.now)
    other.look(seconds=45)
    assert other.rows(daily) == [("23 06:00", RunState.RUNNING, 1)]
    other.look(seconds=30)
    assert other.rows(daily) == [("23 06:00", RunState.INTERRUPTED, 1)]
    other.look(days=1)
    assert other.rows(daily)[1:] == [("24 06:00", RunState.SUCCEEDED, 1)]


class Wanted(threading.Event):
    """What the loop waits for. waits : the limits of each wait, s."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: queue.Queue[float | None] = queue.Queue()

    def wait(self, timeout: float | None = None) -> bool:
        self.waits.put(timeout)
        return super().wait(WAIT_S)


def test_loop_ends_what_was_left_and_waits_for_the_next_due_time(new_desk: NewDesk) -> None:
    one = new_desk()
    daily = one.daily()
    one.now += timedelta(hours=1)
    one.store.record_due(one.now)
    assert one.store.start(one.run(daily), one.now)
    other = new_desk(now=one.now)
    wanted = other.scheduler._wanted = Wanted()
    other.scheduler.start()
    assert wanted.waits.get(timeout=WAIT_S) == CHECK_S
    assert other.rows(daily) == [("23 06:00", RunState.INTERRUPTED, 1)]
    assert other.told == [(START + timedelta(hours=1), RunState.INTERRUPTED)]
    for seconds, wait_s in ((24 * 3600 - 4, 4.0), (4, CHECK_S)):
        other.now += timedelta(seconds=seconds)
        other.scheduler.wake()
        assert wanted.waits.get(timeout=WAIT_S) == wait_s
    assert len(other.done) == 1
    other.scheduler.close()


class Cut:
    """Cuts the power at the so-manieth change of a database: just before it is kept, or just after."""

    def __init__(self, database: Database, number: int, *, kept: bool) -> None:
        self.left, self._kept, self._changing = number, kept, database.changing
        database.changing = self.changing  # type: ignore[method-assign]

    @contextmanager
    def changing(self, *, passing: bool = False) -> Iterator[Session]:
        self.left -= 1
        with self._changing(passing=passing) as session:
            yield session
            if self.left == 0 and not self._kept:
                raise PowerCut
        if self.left == 0:
            raise PowerCut


@pytest.mark.parametrize("kept", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_cut_at_any_change_leaves_one_row_for_each_due_time_and_begins_no_run_twice(
    new_desk: NewDesk, *, kept: bool
) -> None:
    desk = new_desk()
    often = desk.daily(cron=Cron("*/5 * * * *", "UTC"), grace_s=600.0, retry_s=30.0)
    begun: Counter[int] = Counter()
    for number in count(1):
        desk = new_desk(now=desk.now)
        cut = Cut(desk.store.database, number, kept=kept)
        try:
            desk.store.interrupt_lost(desk.now, alone=True)
            desk.busy = "held by scan 7"
            desk.look(minutes=5)
            desk.busy = None
            desk.look(seconds=30)
        except PowerCut:
            pass
        begun.update(run.number for _, run in desk.done)
        if cut.left > 0:
            break
    assert number > 12, "two looks make as many changes"
    desk = new_desk(now=desk.now)
    desk.store.interrupt_lost(desk.now, alone=True)
    desk.store.record_due(desk.now)
    runs = desk.store.runs(often.id, limit=1000)
    assert sum(run.count for run in runs) == often.order.cron.count(START + timedelta(seconds=1), desk.now, most=1000)
    states = Counter(run.state for run in runs)
    assert states[RunState.RUNNING] == 0
    assert states[RunState.INTERRUPTED] > 0
    assert set(begun.values()) == {1}, "a run began twice"
    for run in runs:
        assert begun[run.number] == 1 or run.state is not RunState.SUCCEEDED


def test_run_whose_end_the_disk_refused_is_over_at_the_next_look(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = desk.daily()

    def refuse(*_: Any, **__: Any) -> None:
        raise StorageError("the disk is full")

    with monkeypatch.context() as full:
        full.setattr(desk.store, "finish", refuse)
        desk.look(hours=1)
    assert desk.run(schedule).state is RunState.RUNNING
    desk.look(seconds=10)
    assert desk.rows(schedule) == [("23 06:00", RunState.INTERRUPTED, 1)]
    assert desk.run(schedule).reason == "it ended, and how could not be put on record"
    assert [state for _, state in desk.told] == [RunState.INTERRUPTED]
    desk.look(days=1)
    assert desk.rows(schedule)[-1] == ("24 06:00", RunState.SUCCEEDED, 1)


@pytest.mark.parametrize("during", [False, True])
def test_removed_schedule_is_gone_with_its_runs(desk: Desk, *, during: bool) -> None:
    daily = desk.daily()
    if during:
        desk.during = lambda: desk.store.remove(daily.id)
    desk.look(hours=1)
    if not during:
        desk.store.remove(daily.id)
    for gone in (desk.store.get, desk.store.remove, desk.store.runs):
        with pytest.raises(ScheduleNotFoundError, match="GET /schedule"):
            gone(daily.id)
    desk.look(days=2)
    assert len(desk.done) == 1
