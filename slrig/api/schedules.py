"""/schedule: work for the rig at set times."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Body, Response
from pydantic import BaseModel, Field

from slrig.api.problems import problems
from slrig.api.schemas import filled
from slrig.api.service import Cursor, PageLength, Serving, paged
from slrig.bundle import FreeText, Strict
from slrig.jobs.records import utc_now
from slrig.schedule.store import LEAST_RETRY_S, MOST_GRACE_S, Cron, Schedule, ScheduledRun, ScheduleSpec, TaskKind

router = APIRouter(prefix="/schedule", tags=["schedule"])

_UPCOMING = 5
"""Number of next due times that are shown."""


class ScheduleRequest(Strict):
    """A schedule: when, what, and how late it may be."""

    cron: Annotated[str, Field(min_length=9, max_length=200)] = Field(
        description="minute, hour, day of month, month, day of week, as Debian's cron reads them: "
        "'30 6 * * mon-fri' is 06:30 on working days"
    )
    time_zone: Annotated[str, Field(min_length=1, max_length=64)] = Field(
        default="UTC", description="time zone of the clock: a name of the IANA database, such as Europe/Berlin"
    )
    task: Annotated[TaskKind, Field(strict=False)] = Field(
        description="verification: does the calibration still hold; calibration: every pose of a positioner, then a "
        "solve; acceptance: the prescribed artefacts; scan: one scan"
    )
    options: dict[str, Any] = Field(default_factory=dict, description="of the task, as its own request has them")
    label: FreeText | None = None
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

    def order(self) -> ScheduleSpec:
        """The requested schedule. Raises ScheduleError."""
        given = {name: value for name, value in self if name not in {"cron", "time_zone"}}
        return ScheduleSpec(Cron(self.cron, self.time_zone), **given)


class ScheduleLinks(BaseModel):
    """Links of a schedule."""

    self: str
    runs: str
    run: str
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


class RunPage(BaseModel):
    """Runs from new to old, each due as clocks in the schedule's time zone show it. `next` is the path of
    the next page, null on the last.
    """

    runs: list[ScheduledRun]
    next: str | None


def _body(schedule: Schedule) -> ScheduleBody:
    order, here = schedule.order, f"/schedule/{schedule.id}"
    return filled(
        ScheduleBody,
        order,
        id=schedule.id,
        cron=order.cron.text,
        time_zone=order.cron.time_zone,
        created_at=schedule.created_at,
        upcoming=[order.cron.local(due) for due in order.cron.upcoming(utc_now(), _UPCOMING)],
        links=ScheduleLinks(
            self=here, runs=f"{here}/runs", run=f"{here}/run", pause=f"{here}/pause", resume=f"{here}/resume"
        ),
    )


@router.post("", status_code=201, responses=problems(507))
def add_schedule(service: Serving, response: Response, request: Annotated[ScheduleRequest, Body()]) -> ScheduleBody:
    """Put a schedule on record. The answer shows when it is due next. One that could only fail is refused."""
    order = request.order()
    service.tasks.check(order)
    schedule = service.schedules.create(order, utc_now())
    service.scheduler.wake()
    response.headers["Location"] = f"/schedule/{schedule.id}"
    return _body(schedule)


@router.get("")
def list_schedules(service: Serving) -> ScheduleList:
    """List schedules, oldest first."""
    return ScheduleList(schedules=[_body(each) for each in service.schedules.all()])


@router.get("/{schedule_id}")
def look_at_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Return a schedule."""
    return _body(service.schedules.get(schedule_id))


@router.get("/{schedule_id}/runs")
def list_runs(
    service: Serving,
    response: Response,
    schedule_id: UUID,
    cursor: Cursor = None,
    limit: PageLength = 50,
) -> RunPage:
    """List what became of a schedule's due times, from new to old."""
    schedules, cron = service.schedules, service.schedules.get(schedule_id).order.cron
    shown, following = paged(
        lambda most: schedules.runs(schedule_id, before=cursor, limit=most),
        limit,
        f"/schedule/{schedule_id}/runs",
        service,
        response,
    )
    return RunPage(runs=[replace(run, due=cron.local(run.due)) for run in shown], next=following)


@router.post("/{schedule_id}/run", status_code=202, responses=problems(409))
def run_now(service: Serving, schedule_id: UUID) -> ScheduledRun:
    """Do what a schedule does now, once, though it is not due, or paused. It waits for the rig as every run does, and
    is listed with the others. The answer comes at once.
    """
    cron = service.schedules.get(schedule_id).order.cron
    run = service.schedules.run_now(schedule_id, utc_now())
    service.scheduler.wake()
    return replace(run, due=cron.local(run.due))


@router.post("/{schedule_id}/pause")
def pause_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Pause a schedule until it is resumed. A run under way goes on. May be repeated."""
    return _body(service.schedules.enable(schedule_id, enabled=False))


@router.post("/{schedule_id}/resume")
def resume_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Go on after a pause; `catch_up` says whether what was missed is made up for, once. May be repeated."""
    schedule = service.schedules.enable(schedule_id, enabled=True)
    service.scheduler.wake()
    return _body(schedule)


@router.post("/{schedule_id}/cancel", status_code=202, responses=problems(409))
def cancel_run(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Request the early end of the run under way; the schedule stays as it is. May be repeated while it is."""
    schedule = service.schedules.get(schedule_id)
    service.tasks.cancel(schedule)
    return _body(schedule)


@router.delete("/{schedule_id}", status_code=204)
def remove_schedule(service: Serving, schedule_id: UUID) -> None:
    """Forget a schedule and its runs."""
    service.schedules.remove(schedule_id)
