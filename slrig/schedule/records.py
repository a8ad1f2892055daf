"""What is on record about schedules and their runs, frozen values, and when a schedule is due.

The rules of cron text, daylight saving among them, are Debian cron's, by cronsim.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from itertools import islice, takewhile
from typing import Any
from uuid import UUID
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError

from slrig.errors import ScheduleError

MOST_GRACE_S = 7 * 24 * 3600.0
LEAST_RETRY_S = 1.0

_EXAMPLE = "'30 6 * * mon-fri' is 06:30 on working days"
_FIRST_REACH = timedelta(hours=2)


@dataclass(frozen=True, slots=True)
class Cron:
    """When a schedule is due.

    A time that the clocks skip in spring is due right after the gap; one that they repeat in autumn is due once. Times
    that come every hour or more often follow the hours that really pass.

    Raises
    ------
    ScheduleError
        The text is no cron expression, it never comes, or there is no such time zone.
    """

    text: str
    time_zone: str

    def __post_init__(self) -> None:
        try:
            ZoneInfo(self.time_zone)
        except (KeyError, ValueError, OSError) as error:
            message = (
                f"time_zone: expected a name of the IANA database ('Europe/Berlin', 'UTC'), found {self.time_zone!r}"
            )
            raise ScheduleError(message) from error
        if len(self.text.split()) != 5:
            message = (
                f"cron: expected five fields (minute, hour, day of month, month, day of week), found {self.text!r}; "
                f"{_EXAMPLE}"
            )
            raise ScheduleError(message)
        try:
            never = next(self._moments(datetime(2024, 1, 1, tzinfo=UTC)), None) is None
        except CronSimError as error:
            message = f"cron: {error}, found {self.text!r}; {_EXAMPLE}"
            raise ScheduleError(message) from error
        if never:
            message = f"cron: {self.text!r} never comes; {_EXAMPLE}"
            raise ScheduleError(message)

    def after(self, moment: datetime) -> datetime:
        """The first due time later than `moment`, UTC."""
        return next(self._moments(moment))

    def upcoming(self, moment: datetime, count: int) -> tuple[datetime, ...]:
        """The next `count` due times later than `moment`, UTC."""
        return tuple(islice(self._moments(moment), count))

    def newest(self, first: datetime, last: datetime) -> datetime | None:
        """The last due time from `first` to `last`, both included, UTC; None if there is none."""
        reach = _FIRST_REACH
        # From the end backwards, in longer and longer stretches: after a long pause only the newest is wanted.
        while True:
            start = max(first, last - reach)
            found = deque(self._from(start, last), maxlen=1)
            if found or start == first:
                return found[0] if found else None
            reach *= 8

    def count(self, first: datetime, last: datetime, *, most: int) -> int:
        """How many due times lie from `first` to `last`, both included; `most` stands for that many or more."""
        return sum(1 for _ in islice(self._from(first, last), most))

    def _from(self, first: datetime, last: datetime) -> Iterator[datetime]:
        return takewhile(lambda due: due <= last, self._moments(first - timedelta(seconds=1)))

    def local(self, moment: datetime) -> datetime:
        """A moment as clocks in the schedule's time zone show it."""
        return moment.astimezone(ZoneInfo(self.time_zone))

    def _moments(self, moment: datetime) -> Iterator[datetime]:
        for due in CronSim(self.text, moment.astimezone(ZoneInfo(self.time_zone))):
            yield due.astimezone(UTC)


class TaskKind(StrEnum):
    """What a schedule does with the rig.

    VERIFICATION looks whether the calibration still holds; CALIBRATION shoots every pose of a positioner and solves;
    ACCEPTANCE measures the prescribed artefacts.
    """

    VERIFICATION = "verification"
    CALIBRATION = "calibration"
    ACCEPTANCE = "acceptance"


@dataclass(frozen=True, slots=True)
class ScheduleSpec:
    """What a person asks for: when, what, and how late it may be.

    grace_s : how long after its time a run may still start, a busy rig's included. retry_s : a run that finds the rig
    busy, or a device that fails, tries again so often. catch_up : after a pause longer than the grace (the service was
    off, the schedule was paused) the newest of the runs that were missed is made up for, once; otherwise it is recorded
    as missed. options : of the task, checked by whoever does it.

    Raises
    ------
    ScheduleError
        A number is out of its range: all faults in one message.
    """

    cron: Cron
    task: TaskKind
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str | None = None
    grace_s: float = 3600.0
    retry_s: float = 60.0
    catch_up: bool = True
    enabled: bool = True

    def __post_init__(self) -> None:
        faults = []
        if not 0 <= self.grace_s <= MOST_GRACE_S:
            faults.append(f"grace_s: expected 0 to {MOST_GRACE_S:g} s, found {self.grace_s:g}")
        if not LEAST_RETRY_S <= self.retry_s < math.inf:
            faults.append(f"retry_s: expected {LEAST_RETRY_S:g} s or more, found {self.retry_s:g}")
        if faults:
            message = "; ".join(faults) + "; an hour of grace and a minute between tries are usual"
            raise ScheduleError(message)


@dataclass(frozen=True, slots=True)
class Schedule:
    """An order on record. `next_due` is the time that no run has been recorded for yet."""

    id: UUID
    order: ScheduleSpec
    created_at: datetime
    next_due: datetime


class RunState(StrEnum):
    """What became of a due time.

    WAITING for the rig, and RUNNING, are under way. SUCCEEDED and FAILED ran. SKIPPED found the rig busy, or the
    schedule in the way of itself, for the whole of its grace. MISSED was due while nobody was there, and is not made up
    for; COALESCED stands for older ones whose place the newest took. INTERRUPTED was cut off in the middle.
    """

    WAITING = "waiting"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    SKIPPED = "skipped"
    MISSED = "missed"
    COALESCED = "coalesced"
    INTERRUPTED = "interrupted"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the run."""
        return self not in {RunState.WAITING, RunState.RUNNING}


@dataclass(frozen=True, slots=True)
class ScheduledRun:
    """One due time of one schedule, and what became of it.

    count : how many due times the row stands for, 1 but for missed and coalesced ones. deadline : the latest start.
    attempts : how often the rig was asked for. reason : in words, where the run did not simply succeed.
    result : what the task tells.
    """

    number: int
    schedule: UUID
    due: datetime
    state: RunState
    reason: str | None
    count: int
    attempts: int
    deadline: datetime
    next_attempt: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    result: Mapping[str, Any] | None
