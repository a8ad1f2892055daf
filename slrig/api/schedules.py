"""/schedule: work for the rig at set times."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Body, Query, Response

from slrig.api.openapi import problems
from slrig.api.schedule_schemas import (
    RunPage,
    ScheduleBody,
    ScheduleList,
    ScheduleRequest,
    run_body,
    schedule_body,
)
from slrig.api.service import Serving

USUAL_PAGE = 50

router = APIRouter(prefix="/schedule", tags=["schedule"])


@router.post("", status_code=201, responses=problems(422, 507))
def add_schedule(service: Serving, response: Response, request: Annotated[ScheduleRequest, Body()]) -> ScheduleBody:
    """Put a schedule on record. The answer shows when it is due next. One that could only fail is refused."""
    now = _now()
    order = request.order()
    service.tasks.check(order)
    schedule = service.schedules.create(order, now)
    service.scheduler.wake()
    response.headers["Location"] = f"/schedule/{schedule.id}"
    return schedule_body(schedule, now)


@router.get("")
def list_schedules(service: Serving) -> ScheduleList:
    """List schedules, oldest first."""
    now = _now()
    return ScheduleList(schedules=[schedule_body(each, now) for each in service.schedules.all()])


@router.get("/{schedule_id}", responses=problems(404, 422))
def look_at_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Return a schedule."""
    return schedule_body(service.schedules.get(schedule_id), _now())


@router.get("/{schedule_id}/runs", responses=problems(404, 422))
def list_runs(
    service: Serving,
    response: Response,
    schedule_id: UUID,
    cursor: Annotated[int | None, Query(ge=1, le=2**53, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = USUAL_PAGE,
) -> RunPage:
    """List what became of a schedule's due times, from new to old."""
    limit = min(limit, service.settings.page_limit)
    schedule = service.schedules.get(schedule_id)
    found = service.schedules.runs(schedule_id, before=cursor, limit=limit + 1)
    shown = found[:limit]
    following = None
    if len(found) > limit:
        following = f"/schedule/{schedule_id}/runs?cursor={shown[-1].number}&limit={limit}"
        response.headers["Link"] = f'<{following}>; rel="next"'
    return RunPage(runs=[run_body(run, schedule.order.cron) for run in shown], next=following)


@router.post("/{schedule_id}/pause", responses=problems(404, 422))
def pause_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Let nothing become due until it is resumed. A run under way goes on. May be repeated."""
    return schedule_body(service.schedules.enable(schedule_id, enabled=False), _now())


@router.post("/{schedule_id}/resume", responses=problems(404, 422))
def resume_schedule(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Go on after a pause; `catch_up` says whether what was missed is made up for, once. May be repeated."""
    schedule = service.schedules.enable(schedule_id, enabled=True)
    service.scheduler.wake()
    return schedule_body(schedule, _now())


@router.post("/{schedule_id}/cancel", status_code=202, responses=problems(404, 409, 422))
def cancel_run(service: Serving, schedule_id: UUID) -> ScheduleBody:
    """Ask the run that is under way to end early; the schedule stays as it is. May be repeated while it is."""
    schedule = service.schedules.get(schedule_id)
    service.tasks.cancel(schedule)
    return schedule_body(schedule, _now())


@router.delete("/{schedule_id}", status_code=204, responses=problems(404, 422))
def remove_schedule(service: Serving, schedule_id: UUID) -> None:
    """Forget a schedule and its runs."""
    service.schedules.remove(schedule_id)


def _now() -> datetime:
    return datetime.now(UTC)
