"""What is due: from a schedule and the present moment to runs. Pure; what it says is recorded by the store."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from slrig.schedule.records import RunState, ScheduleSpec

MOST_COUNTED = 10_000
"""Due times that a pause may leave behind are counted up to here."""


@dataclass(frozen=True, slots=True)
class DueRun:
    """A row to be made: one due time that runs, or one that stands for `count` that do not."""

    due: datetime
    state: RunState
    reason: str | None
    count: int
    deadline: datetime


@dataclass(frozen=True, slots=True)
class Due:
    """What one look at the clock gives: rows, old to new, and the due time to look out for next."""

    runs: tuple[DueRun, ...]
    next_due: datetime


def due_runs(order: ScheduleSpec, next_due: datetime, now: datetime) -> Due:
    """What became due since, and what is to be done about it.

    One due time within its grace runs. After a pause the newest is the one that counts: it runs if it is still within
    its grace, or once, late, if the order makes up for missed runs; the older ones are recorded in one row. A clock
    that was set back brings the next due time back with it: what has run has its row, and does not run again.
    """
    following = order.cron.after(now)
    if next_due > now:
        return Due((), min(next_due, following))
    newest = order.cron.newest(next_due, now)
    if newest is None:
        return Due((), following)
    grace = timedelta(seconds=order.grace_s)
    late = now - newest
    in_time = late <= grace
    runs = in_time or order.catch_up
    rows = []
    older = order.cron.count(next_due, newest, most=MOST_COUNTED) - 1
    if older > 0:
        rows.append(_older(next_due, newest, older, coalesced=runs))
    if not runs:
        reason = f"nobody was there from {_clock(order, newest)} until {_clock(order, now)}, longer than the grace"
        rows.append(DueRun(newest, RunState.MISSED, reason, 1, newest + grace))
    elif in_time:
        rows.append(DueRun(newest, RunState.WAITING, None, 1, newest + grace))
    else:
        reason = f"made up for: due at {_clock(order, newest)}, nobody was there until {_clock(order, now)}"
        rows.append(DueRun(newest, RunState.WAITING, reason, 1, now + grace))
    return Due(tuple(rows), following)


def _older(first: datetime, newest: datetime, count: int, *, coalesced: bool) -> DueRun:
    times = f"{count} due times" if count > 1 else "one due time"
    if count >= MOST_COUNTED - 1:
        times = f"{count} due times or more"
    if coalesced:
        return DueRun(first, RunState.COALESCED, f"{times} passed unattended; the newest stands for all", count, newest)
    return DueRun(first, RunState.MISSED, f"{times} passed unattended", count, newest)


def _clock(order: ScheduleSpec, moment: datetime) -> str:
    return order.cron.local(moment).isoformat(timespec="minutes")
