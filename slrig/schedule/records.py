"""What is on record about schedules and their runs: frozen values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

from slrig.errors import ScheduleError
from slrig.schedule.cron import Cron

MOST_GRACE_S = 7 * 24 * 3600.0
LEAST_RETRY_S = 1.0


class TaskKind(StrEnum):
    """What a schedule does with the rig.

    VERIFICATION looks whether the calibration still holds; CALIBRATION shoots every pose of a positioner and solves;
    ACCEPTANCE measures the prescribed artefacts.
    """

    VERIFICATION = "verification"
    CALIBRATION = "calibration"
    ACCEPTANCE = "acceptance"


@dataclass(frozen=True, slots=True)
class Order:
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
    order: Order
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
class Run:
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
