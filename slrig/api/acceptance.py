"""/acceptance: open an acceptance test, measure its positions one by one or by script, and fetch its report."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from fastapi import APIRouter, Body, Query, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field

from slrig.accept.plan import AcceptanceRequest, Quantity
from slrig.accept.store import HTML, JSON, AcceptanceRecord, AcceptanceState
from slrig.api.problems import file_of, problems
from slrig.api.schemas import AnyFault, filled
from slrig.api.service import IdempotencyKey, Serving, once, started_once
from slrig.bundle import Strict
from slrig.calibration import Decision

router = APIRouter(prefix="/acceptance", tags=["acceptance"])


class PositionRequest(Strict):
    """Measurement of the next position, with its artefact in place, or by script of all that are left."""

    scripted: bool = False
    if_busy: Literal["reject", "queue"] = "reject"


class ReadingBody(BaseModel):
    """One capture."""

    position: str
    capture: int
    errors_mm: dict[str, float]
    noise_mm: float
    points_used: int
    rejected_share: float


class StepBody(BaseModel):
    """One position: what a person is to do."""

    name: str
    artefact: str
    centre_mm: tuple[float, float, float]
    words: str


class AcceptanceSummary(BaseModel):
    """An acceptance test in a list."""

    id: UUID
    created_at: datetime
    rig: str
    calibration: str = Field(description="id of the calibration that it is done with")
    state: AcceptanceState
    captures: int
    captures_done: int
    decision: Decision | None = Field(description="null before the end")
    files: dict[str, str]


class AcceptanceList(BaseModel):
    """Acceptance tests, newest first."""

    tests: list[AcceptanceSummary]


class AcceptanceBody(AcceptanceSummary):
    """An acceptance test, in the manner of VDI/VDE 2634-2; no conformity is claimed."""

    next: StepBody | None = Field(description="the position to measure next; null when all are")
    positions: list[StepBody]
    limits_mm: dict[str, float] = Field(description="greatest permissible error of each quantity")
    readings: list[ReadingBody]
    progress: dict[str, Any] | None
    error: AnyFault = Field(description="why the last position was not measured; it may be measured again")


@router.post("", status_code=201, responses=problems(404, 409, 503, 507))
def open_acceptance(
    service: Serving,
    response: Response,
    request: Annotated[AcceptanceRequest, Body(default_factory=AcceptanceRequest)],
    idempotency_key: IdempotencyKey = None,
) -> AcceptanceBody:
    """Open an acceptance test of the rig as it is calibrated now. Touches no device."""

    def start(key: str | None) -> UUID:
        made = service.acceptance.open(request.plan).id
        if key is not None:
            service.keys.tie(key, made)
        return made

    record = service.acceptance.get(once(service.keys, idempotency_key, "/acceptance", request, start))
    response.headers["Location"] = f"/acceptance/{record.id}"
    # As it was when it was opened, so that a repeated request gets the same answer.
    opened = replace(record, state=AcceptanceState.OPEN, readings=(), fault=None, progress=None, decision=None)
    return _body(opened)


@router.get("")
def list_acceptance(service: Serving, limit: Annotated[int, Query(ge=1, le=200)] = 50) -> AcceptanceList:
    """List acceptance tests, newest first."""
    return AcceptanceList(tests=[_summary(each) for each in service.acceptance.latest()[:limit]])


@router.get("/{test_id}")
def look_at_acceptance(service: Serving, test_id: UUID) -> AcceptanceBody:
    """Return a test: the next step, the measurements, and the decision."""
    return _body(service.acceptance.get(test_id))


@router.post("/{test_id}/position", status_code=202, responses=problems(409, 429, 502, 503, 507))
def measure_position(
    service: Serving,
    test_id: UUID,
    request: Annotated[PositionRequest, Body(default_factory=PositionRequest)],
    idempotency_key: IdempotencyKey = None,
) -> AcceptanceBody:
    """Measure the next position, with its repeats; by script, all that are left. The answer comes at once."""
    tests, wait = service.acceptance, request.if_busy == "queue"

    def start(key: str | None) -> UUID:
        return tests.measure(test_id, wait=wait, scripted=request.scripted, key=key).id

    started_once(service.keys, service.store, idempotency_key, f"/acceptance/{test_id}/position", request, start)
    return _body(tests.get(test_id))


@router.post("/{test_id}/cancel", status_code=202, responses=problems(507))
def cancel_acceptance(service: Serving, test_id: UUID) -> AcceptanceBody:
    """End a test early. May be repeated."""
    return _body(service.acceptance.cancel(test_id))


@router.delete("/{test_id}", status_code=204, responses=problems(409, 507))
def delete_acceptance(service: Serving, test_id: UUID) -> None:
    """Delete a test with all its files. One that is being measured is refused."""
    service.acceptance.delete(test_id)


@router.get("/{test_id}/report.html", response_class=Response, responses=file_of("text/html", 409))
def acceptance_page(service: Serving, test_id: UUID) -> FileResponse:
    """Return the report for people."""
    return FileResponse(service.acceptance.file(test_id, HTML), media_type="text/html; charset=utf-8")


@router.get("/{test_id}/report.json", response_class=Response, responses=file_of("application/json", 409))
def acceptance_report(service: Serving, test_id: UUID) -> FileResponse:
    """Return the report for machines."""
    return FileResponse(service.acceptance.file(test_id, JSON), media_type="application/json")


def _summary(record: AcceptanceRecord) -> AcceptanceSummary:
    names = (HTML, JSON) if record.state is AcceptanceState.FINISHED else ()
    return filled(
        AcceptanceSummary,
        record,
        captures=len(record.plan.takes),
        captures_done=len(record.readings),
        files={name: f"/acceptance/{record.id}/{name}" for name in names},
    )


def _body(record: AcceptanceRecord) -> AcceptanceBody:
    steps = [filled(StepBody, step, centre_mm=tuple(step.centre_mm.tolist())) for step in record.plan.steps]
    following = record.next_take
    return filled(
        AcceptanceBody,
        _summary(record),
        next=None if following is None else next(each for each in steps if each.name == following[0].name),
        positions=steps,
        limits_mm={quantity.value: record.plan.limits.limit_mm(quantity) for quantity in Quantity},
        readings=[
            filled(ReadingBody, each, position=each.step, capture=each.take + 1, points_used=each.used)
            for each in record.readings
        ],
        progress=None if record.progress is None else record.progress.as_json(),
        error=record.fault,
    )
