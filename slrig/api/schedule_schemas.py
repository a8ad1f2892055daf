"""What requests about schedules may say and what their answers hold."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from pydantic import BaseModel, Field

from slrig.api.schemas import filled
from slrig.bundle.faults import Strict
from slrig.schedule.records import LEAST_RETRY_S, MOST_GRACE_S, Cron, Order, Run, RunState, Schedule, TaskKind

UPCOMING = 5
"""How many of the next due times are shown."""


class ScheduleRequest(Strict):
    """A schedule: when, what, and how late it may be."""

    cron: Annotated[str, Field(min_length=9, max_length=200)] = Field(
        description="minute, hour, day of month, month, day of week, as Debian's cron reads them: "
        "'30 6 * * mon-fri' is 06:30 on working days"
    )
    time_zone: Annotated[str, Field(min_length=1, max_length=64)] = Field(
        default="UTC", description="whose clocks: a name of the IANA database, such as Europe/Berlin"
    )
    task: Annotated[TaskKind, Field(strict=False)] = Field(
        description="verification: does the calibration still hold; calibration: every pose of a positioner, then a "
        "solve; acceptance: the prescribed artefacts"
    )
    options: dict[str, Any] = Field(default_factory=dict, description="of the task, as its own request has them")
    label: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    grace_s: Annotated[float, Field(ge=0, le=MOST_GRACE_S)] = Field(
        default=3600.0, description="how long after its time a run may still start, a busy rig included"
    )
    retry_s: Annotated[float, Field(ge=LEAST_RETRY_S, le=MOST_GRACE_S)] = Field(
        default=60.0, description="how often a run that found the rig busy, or a device that failed, tries again"
    )
    catch_up: bool = Field(
        default=True,
        description="after a pause longer than the grace, make up for the newest of the runs that were missed, once",
    )
    enabled: bool = True

    def order(self) -> Order:
        """What is asked for. Raises ScheduleError."""
        asked = {name: value for name, value in self if name not in {"cron", "time_zone"}}
        return Order(Cron(self.cron, self.time_zone), **asked)


class ScheduleLinks(BaseModel):
    """Where to go from here."""

    self: str
    runs: str
    pause: str
    resume: str


class ScheduleBody(BaseModel):
    """A schedule on record."""

    id: UUID
    cron: str
    time_zone: str
    task: TaskKind
    options: dict[str, Any]
    label: str | None
    grace_s: float
    retry_s: float
    catch_up: bool
    enabled: bool
    created_at: datetime
    upcoming: list[datetime] = Field(
        description="the next five due times, as clocks in its time zone show them; those of a paused schedule once "
        "it is resumed"
    )
    links: ScheduleLinks


class ScheduleList(BaseModel):
    """Every schedule, oldest first."""

    schedules: list[ScheduleBody]


class RunBody(BaseModel):
    """One due time, and what became of it."""

    number: int
    due: datetime = Field(description="as clocks in the schedule's time zone show it")
    state: RunState
    reason: str | None = Field(description="in words, where it did not simply succeed")
    count: int = Field(description="how many due times this row stands for")
    attempts: int
    next_attempt: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    result: dict[str, Any] | None


class RunPage(BaseModel):
    """Runs from new to old. `next` asks for the page after this one, null on the last."""

    runs: list[RunBody]
    next: str | None


def schedule_body(schedule: Schedule, now: datetime) -> ScheduleBody:
    """A record as an answer."""
    order, here = schedule.order, f"/schedule/{schedule.id}"
    return filled(
        ScheduleBody,
        order,
        id=schedule.id,
        cron=order.cron.text,
        time_zone=order.cron.time_zone,
        created_at=schedule.created_at,
        upcoming=[order.cron.local(due) for due in order.cron.upcoming(now, UPCOMING)],
        links=ScheduleLinks(self=here, runs=f"{here}/runs", pause=f"{here}/pause", resume=f"{here}/resume"),
    )


def run_body(run: Run, cron: Cron) -> RunBody:
    """A record as an answer; cron : of its schedule."""
    return filled(RunBody, run, due=cron.local(run.due))
