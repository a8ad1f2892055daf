"""Cron text, time zones and daylight saving."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import pairwise

import pytest

from slrig.errors import ScheduleError
from slrig.schedule.records import Cron

BERLIN = "Europe/Berlin"


def utc(*parts: int) -> datetime:
    return datetime(*parts, tzinfo=UTC)  # type: ignore[arg-type,misc]  # year, month, day and so on


def test_zero_is_sunday_and_names_are_days() -> None:
    monday = Cron("0 6 * * 1", "UTC").after(utc(2026, 11, 22))
    assert monday == utc(2026, 11, 23, 6) == Cron("0 6 * * mon", "UTC").after(utc(2026, 11, 22))
    assert monday.weekday() == 0
    assert Cron("0 6 * * 0", "UTC").after(utc(2026, 11, 20)) == utc(2026, 11, 22, 6)


def test_a_time_is_that_of_clocks_in_its_zone() -> None:
    cron = Cron("30 6 * * *", BERLIN)
    assert cron.after(utc(2026, 1, 10)) == utc(2026, 1, 10, 5, 30)
    assert cron.after(utc(2026, 7, 10)) == utc(2026, 7, 10, 4, 30)
    assert cron.local(utc(2026, 7, 10, 4, 30)).strftime("%H:%M %z") == "06:30 +0200"


def test_a_time_that_the_clocks_repeat_comes_once() -> None:
    # 2026-10-25: 03:00 becomes 02:00, and 02:30 is twice.
    found = Cron("30 2 * * *", BERLIN).upcoming(utc(2026, 10, 24, 12), 3)
    assert found == (utc(2026, 10, 25, 0, 30), utc(2026, 10, 26, 1, 30), utc(2026, 10, 27, 1, 30))


def test_a_time_that_the_clocks_skip_comes_right_after_the_gap() -> None:
    # 2026-03-29: 02:00 becomes 03:00, and 02:30 is not there.
    found = Cron("30 2 * * *", BERLIN).upcoming(utc(2026, 3, 28, 12), 2)
    assert found[0] == utc(2026, 3, 29, 1, 0)
    assert found[1] == utc(2026, 3, 30, 0, 30)


def test_every_hour_follows_the_hours_that_pass() -> None:
    found = Cron("0 * * * *", BERLIN).upcoming(utc(2026, 10, 24, 23, 30), 5)
    assert [later - earlier for earlier, later in pairwise(found)] == [timedelta(hours=1)] * 4


def test_newest_and_count_look_at_both_ends() -> None:
    cron = Cron("0 6 * * *", "UTC")
    first, last = utc(2026, 11, 1, 6), utc(2026, 11, 22, 6)
    assert cron.newest(first, last) == last
    assert cron.newest(first, last - timedelta(seconds=1)) == utc(2026, 11, 21, 6)
    assert cron.newest(first + timedelta(seconds=1), first + timedelta(hours=1)) is None
    assert cron.count(first, last, most=100) == 22
    assert cron.count(first, last, most=5) == 5


def test_the_newest_after_years_of_minutes_is_found_at_once() -> None:
    cron = Cron("* * * * *", BERLIN)
    assert cron.newest(utc(2016, 1, 1), utc(2026, 11, 22, 5, 55, 16)) == utc(2026, 11, 22, 5, 55)


@pytest.mark.parametrize(
    ("text", "zone", "told"),
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
def test_what_is_no_schedule_is_refused_in_words(text: str, zone: str, told: str) -> None:
    with pytest.raises(ScheduleError, match=told):
        Cron(text, zone)
