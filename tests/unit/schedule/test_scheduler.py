"""What becomes of due times: on time, late, busy, after weeks, with clocks that jump, and with two at one database."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from slrig.errors import (
    DeviceError,
    PoseRefusedError,
    ScanStateError,
    ScheduleError,
    ScheduleNotFoundError,
    SlrigError,
    UnsupportedByDeviceError,
    WorkerLostError,
)
from slrig.schedule.records import Cron, Order, RunState, TaskKind
from tests.unit.schedule.desk import START, Desk

NewDesk = Callable[..., Desk]


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


def test_a_run_on_time(desk: Desk) -> None:
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


def test_a_run_that_a_person_asks_for_waits_as_others_do_and_has_no_twin(desk: Desk) -> None:
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
    assert (len(desk.done), desk.run(daily).reason) == (2, "asked for by a person, not by the clock")
    with pytest.raises(ScheduleNotFoundError):
        desk.store.run_now(UUID(int=1), desk.now)


def test_a_run_within_its_grace_is_late_and_says_nothing(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(hours=1, minutes=50)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert desk.run(daily).reason is None


def test_a_run_later_than_its_grace_is_made_up_for_once(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(hours=4)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert "made up for" in str(desk.run(daily).reason)


def test_a_run_that_is_not_to_be_made_up_for_is_missed(desk: Desk) -> None:
    daily = desk.daily(catch_up=False)
    desk.look(hours=4)
    assert desk.rows(daily) == [("23 06:00", RunState.MISSED, 1)]
    assert desk.done == []
    assert desk.told == [(START + timedelta(hours=1), RunState.MISSED)]


def test_two_weeks_off_give_one_run_and_one_row_for_the_rest(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(days=14)
    assert desk.rows(daily) == [("23 06:00", RunState.COALESCED, 13), ("06 06:00", RunState.SUCCEEDED, 1)]
    assert len(desk.done) == 1
    strict = desk.daily(catch_up=False)
    desk.look(days=14)
    assert desk.rows(strict) == [("07 06:00", RunState.MISSED, 13), ("20 06:00", RunState.MISSED, 1)]


def test_every_minute_for_three_years_is_looked_over_at_once(desk: Desk) -> None:
    often = desk.daily(cron=Cron("* * * * *", "Europe/Berlin"))
    desk.look(days=1000)
    (older, state, count), newest = desk.rows(often)
    assert (older, state, count) == ("23 05:01", RunState.COALESCED, 9999)
    assert newest[1] is RunState.SUCCEEDED
    assert "or more" in str(desk.store.runs(often.id)[1].reason)


def test_a_restart_forgets_nothing(new_desk: NewDesk) -> None:
    first = new_desk()
    daily = first.daily()
    second = new_desk(now=START + timedelta(hours=1))
    second.look()
    third = new_desk(now=second.now)
    third.look()
    assert third.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert third.done == []


def test_a_busy_rig_is_tried_again_within_the_grace(desk: Desk) -> None:
    daily = desk.daily()
    desk.busy = "held by scan 7 since 05:59"
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.WAITING, 1)]
    assert desk.run(daily).reason == "rig busy: held by scan 7 since 05:59"
    desk.look(minutes=9)
    assert desk.run(daily).attempts == 1
    desk.look(minutes=1)
    assert desk.run(daily).attempts == 2
    desk.busy = None
    desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert (desk.run(daily).attempts, desk.run(daily).reason) == (3, "at try 3")


def test_a_rig_that_stays_busy_is_a_row_and_not_a_silence(desk: Desk) -> None:
    daily = desk.daily()
    desk.busy = "held by scan 7"
    for _ in range(14):
        desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", RunState.SKIPPED, 1)]
    assert desk.run(daily).reason == "rig busy: held by scan 7"
    assert desk.told == [(START + timedelta(hours=1), RunState.SKIPPED)]


def test_a_run_that_waited_while_nobody_looked_is_skipped(desk: Desk) -> None:
    daily = desk.daily()
    desk.busy = "held by scan 7"
    desk.look(hours=1)
    desk.busy = None
    desk.look(hours=3)
    assert desk.rows(daily) == [("23 06:00", RunState.SKIPPED, 1)]
    assert "held by scan 7" in str(desk.run(daily).reason)


def test_the_next_due_time_overtakes_one_that_waits(desk: Desk) -> None:
    often = desk.daily(cron=Cron("*/5 * * * *", "UTC"), retry_s=600.0)
    desk.busy = "held by scan 7"
    desk.look(minutes=5)
    desk.look(minutes=5)
    assert desk.rows(often) == [("23 05:05", RunState.COALESCED, 1), ("23 05:10", RunState.WAITING, 1)]


def test_two_schedules_at_one_time_run_one_after_the_other(desk: Desk) -> None:
    first, second = desk.daily(), desk.daily()
    desk.during = lambda: assert_none_else(desk)
    desk.look(hours=1)
    assert desk.rows(first) == desk.rows(second) == [("23 06:00", RunState.SUCCEEDED, 1)]


def assert_none_else(desk: Desk) -> None:
    """Within a run, another look starts nothing."""
    before = len(desk.done)
    desk.scheduler.tick()
    assert len(desk.done) == before


def test_a_failure_is_recorded_with_its_cause_and_the_schedule_goes_on(desk: Desk) -> None:
    daily = desk.daily()
    desk.fails = PoseRefusedError("no camera sees the board; uncover it")
    desk.look(hours=1)
    assert desk.run(daily).reason == "no camera sees the board; uncover it"
    desk.fails = RuntimeError("a defect")
    desk.look(days=1)
    assert "a defect" in str(desk.run(daily).reason)
    desk.fails = None
    desk.look(days=1)
    states = [state for _, state, _ in desk.rows(daily)]
    assert states == [RunState.FAILED, RunState.FAILED, RunState.SUCCEEDED]


@pytest.mark.parametrize("error", [DeviceError("camera 'left' is gone; plug it in"), WorkerLostError("out of memory")])
def test_what_may_pass_is_tried_again_within_the_grace(desk: Desk, error: SlrigError) -> None:
    daily = desk.daily()
    desk.fails = error
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.WAITING, 1)]
    assert desk.run(daily).reason == str(error)
    desk.fails = None
    desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]
    assert desk.run(daily).reason == "at try 2"


def test_a_device_that_stays_away_for_the_whole_grace_fails_the_run(desk: Desk) -> None:
    daily = desk.daily()
    desk.fails = DeviceError("camera 'left' is gone; plug it in")
    for _ in range(14):
        desk.look(minutes=10)
    assert desk.rows(daily) == [("23 06:00", RunState.FAILED, 1)]
    assert desk.run(daily).reason == "camera 'left' is gone; plug it in"
    assert desk.told == [(START + timedelta(hours=1), RunState.FAILED)]


def test_what_will_not_pass_is_not_tried_again(desk: Desk) -> None:
    daily = desk.daily()
    desk.fails = UnsupportedByDeviceError("this rig has no positioner")
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.FAILED, 1)]


def test_a_pause_is_made_up_for_once(desk: Desk) -> None:
    daily = desk.daily()
    desk.store.enable(daily.id, enabled=False)
    desk.look(days=3)
    assert desk.rows(daily) == []
    desk.store.enable(daily.id, enabled=True)
    desk.look()
    assert desk.rows(daily) == [("23 06:00", RunState.COALESCED, 2), ("25 06:00", RunState.SUCCEEDED, 1)]


def test_a_clock_that_is_set_back_runs_nothing_twice(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(hours=1)
    desk.look(hours=-2)
    assert desk.store.get(daily.id).next_due == START + timedelta(hours=25)
    desk.look(hours=2, minutes=1)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]


def test_a_clock_that_was_wrong_by_years_finds_its_way_back(desk: Desk) -> None:
    desk.now = START + timedelta(days=3650)
    daily = desk.daily()
    desk.now = START
    desk.look()
    assert desk.store.get(daily.id).next_due == START + timedelta(hours=1)
    desk.look(hours=1)
    assert desk.rows(daily) == [("23 06:00", RunState.SUCCEEDED, 1)]


def test_a_clock_that_jumps_ahead_is_a_pause(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(days=365)
    assert len(desk.done) == 1
    assert [row[1] for row in desk.rows(daily)] == [RunState.COALESCED, RunState.SUCCEEDED]


@pytest.mark.parametrize(
    ("night", "due"),
    [(datetime(2026, 3, 28, 12, tzinfo=UTC), "29 01:00"), (datetime(2026, 10, 24, 12, tzinfo=UTC), "25 00:30")],
)
def test_the_nights_when_clocks_change_have_one_run(new_desk: NewDesk, night: datetime, due: str) -> None:
    desk = new_desk(now=night)
    nightly = desk.daily(cron=Cron("30 2 * * *", "Europe/Berlin"))
    for _ in range(24 * 4):
        desk.look(minutes=15)
    assert desk.rows(nightly) == [(due, RunState.SUCCEEDED, 1)]


def test_two_at_one_database_start_a_run_once(new_desk: NewDesk) -> None:
    desks = new_desk(alone=False), new_desk(alone=False)
    daily = desks[0].daily()
    for day in range(20):
        for desk in desks if day % 2 else reversed(desks):
            desk.now = START + timedelta(days=day, hours=1)
            desk.look()
    assert [row[1] for row in desks[0].rows(daily)] == [RunState.SUCCEEDED] * 20
    assert len(desks[0].done) == len(desks[1].done) == 10


def test_while_one_runs_the_other_waits(new_desk: NewDesk) -> None:
    one, other = new_desk(alone=False), new_desk(alone=False)
    first, second = one.daily(), one.daily()
    other.now = START + timedelta(hours=1)
    one.during = other.look
    one.look(hours=1)
    assert other.done == []
    assert {one.rows(each)[0][1] for each in (first, second)} == {RunState.SUCCEEDED}


def test_a_run_of_a_dead_process_is_interrupted_when_it_is_silent_for_long(new_desk: NewDesk) -> None:
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


def test_a_service_that_starts_alone_ends_what_was_left(new_desk: NewDesk) -> None:
    one = new_desk()
    daily = one.daily()
    one.now += timedelta(hours=1)
    one.store.record_due(one.now)
    assert one.store.start(one.run(daily), one.now)
    other = new_desk(now=one.now)
    other.scheduler.start()
    other.scheduler.close()
    assert other.rows(daily) == [("23 06:00", RunState.INTERRUPTED, 1)]
    assert other.told == [(START + timedelta(hours=1), RunState.INTERRUPTED)]


def test_a_schedule_that_is_removed_is_gone_with_its_runs(desk: Desk) -> None:
    daily = desk.daily()
    desk.look(hours=1)
    desk.store.remove(daily.id)
    for gone in (desk.store.get, desk.store.remove, desk.store.runs):
        with pytest.raises(ScheduleNotFoundError, match="GET /schedule"):
            gone(daily.id)
    desk.look(days=2)
    assert len(desk.done) == 1


def test_an_order_lists_all_its_faults() -> None:
    with pytest.raises(ScheduleError, match=r"grace_s.*retry_s"):
        Order(Cron("0 6 * * *", "UTC"), TaskKind.VERIFICATION, grace_s=-1, retry_s=0)
