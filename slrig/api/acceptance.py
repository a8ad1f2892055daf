"""/acceptance: open an acceptance test, measure its positions one by one or by script, and fetch its report."""

from __future__ import annotations

from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal
from uuid import UUID

from fastapi import APIRouter, Body, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from slrig.api.openapi import problems
from slrig.api.problems import fault_problem
from slrig.api.service import Serving
from slrig.scan.faults import fault_of
from slrig.sessions.acceptance.asking import plan_asked
from slrig.sessions.acceptance.desk import AcceptanceRecord, AcceptanceState
from slrig.sessions.acceptance.evaluation import Reading
from slrig.sessions.acceptance.plan import (
    USUAL_REPEATS,
)

router = APIRouter(prefix="/acceptance", tags=["acceptance"])

Length = Annotated[float, Field(gt=0, le=100_000)]
Uncertainty = Annotated[float, Field(ge=0, le=1000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class CertifiedBody(_Strict):
    """A certified value and its expanded uncertainty (k = 2), mm."""

    value_mm: Length
    uncertainty_mm: Uncertainty


class ArtefactsBody(_Strict):
    """The artefacts, as their certificates have them."""

    sphere: CertifiedBody = Field(description="diameter")
    bar: CertifiedBody = Field(description="distance of the balls' centres")
    plane_mm: tuple[Length, Length] = Field(description="length and width")
    sphere_form_mm: Uncertainty = Field(description="by how much the sphere itself is out of round")
    plane_form_mm: Uncertainty = Field(description="by how much the plane itself is out of flat")
    ball_mm: Length | None = Field(default=None, description="diameter of the bar's balls; absent, the sphere's")
    certificate: Annotated[str, Field(max_length=200)] = ""
    temperature_c: Annotated[float, Field(ge=-50, le=100)] | None = None


class LimitsBody(_Strict):
    """Limits in mm; absent ones are the usual: 1/10000 of the diagonal for spacing, 6.5 σ of a point for the others."""

    spacing_mm: Length | None = None
    form_mm: Length | None = None
    size_mm: Length | None = None
    flatness_mm: Length | None = None


class AcceptanceRequest(_Strict):
    """What to test with. Without artefacts: the exact ones of a rendered rig."""

    artefacts: ArtefactsBody | None = None
    volume_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = Field(
        default=None, description="least and greatest corner in the world; absent, the calibration's"
    )
    limits: LimitsBody = LimitsBody()
    repeats: Annotated[int, Field(ge=1, le=50)] = USUAL_REPEATS
    exposure_s: Annotated[float, Field(gt=0, le=60)] | None = None
    notes: Annotated[str, Field(max_length=1000)] = ""


class PositionRequest(_Strict):
    """What to measure: the next position, whose artefact stands there, or by script all that are left."""

    scripted: bool = False
    if_busy: Literal["reject", "queue"] = "reject"


class ReadingBody(BaseModel):
    """One capture."""

    position: str
    capture: int
    errors_mm: dict[str, float]
    limits_mm: dict[str, float]
    noise_mm: float
    points_used: int
    rejected_share: float


class StepBody(BaseModel):
    """One position: what a person is to do."""

    name: str
    artefact: str
    centre_mm: tuple[float, float, float]
    words: str


class AcceptanceBody(BaseModel):
    """An acceptance test, in the manner of VDI/VDE 2634-2; no conformity is claimed."""

    id: UUID
    created_at: datetime
    state: AcceptanceState
    captures: int
    captures_done: int
    next: StepBody | None = Field(description="the position to measure next; null when all are")
    positions: list[StepBody]
    readings: list[ReadingBody]
    decision: str | None = Field(description="passes, fails or undecided; null before the end")
    progress: dict[str, Any] | None
    error: dict[str, Any] | None = Field(description="why the last position was not measured; it may be measured again")
    files: dict[str, str]


@router.post("", status_code=201, responses=problems(422, 503))
def open_acceptance(
    service: Serving,
    response: Response,
    request: Annotated[AcceptanceRequest, Body(default_factory=AcceptanceRequest)],
) -> AcceptanceBody:
    """Open an acceptance test of the rig as it is calibrated now. Touches no device."""
    record = service.acceptance.open(partial(plan_asked, request))
    response.headers["Location"] = f"/acceptance/{record.id}"
    return _body(record)


@router.get("/{test_id}", responses=problems(404, 422))
def look_at_acceptance(service: Serving, test_id: UUID) -> AcceptanceBody:
    """Return a test: what to do next, what was measured, and what was decided."""
    return _body(service.acceptance.get(test_id))


@router.post("/{test_id}/position", status_code=202, responses=problems(404, 409, 422, 429, 502, 503))
def measure_position(
    service: Serving,
    test_id: UUID,
    request: Annotated[PositionRequest, Body(default_factory=PositionRequest)],
) -> AcceptanceBody:
    """Measure the next position, with its repeats; by script, all that are left. The answer comes at once."""
    wait = request.if_busy == "queue"
    return _body(service.acceptance.measure(test_id, wait=wait, scripted=request.scripted))


@router.post("/{test_id}/cancel", status_code=202, responses=problems(404, 422))
def cancel_acceptance(service: Serving, test_id: UUID) -> AcceptanceBody:
    """End a test early. May be repeated."""
    return _body(service.acceptance.cancel(test_id))


@router.get("/{test_id}/report.html", responses=problems(404, 409, 422))
def acceptance_page(service: Serving, test_id: UUID) -> FileResponse:
    """Return the report for people."""
    return FileResponse(service.acceptance.file(test_id, "report.html"), media_type="text/html; charset=utf-8")


@router.get("/{test_id}/report.json", responses=problems(404, 409, 422))
def acceptance_report(service: Serving, test_id: UUID) -> FileResponse:
    """Return the report for machines."""
    return FileResponse(service.acceptance.file(test_id, "report.json"), media_type="application/json")


def _body(record: AcceptanceRecord) -> AcceptanceBody:
    steps = [
        StepBody(name=step.name, artefact=step.artefact, centre_mm=tuple(step.centre_mm.tolist()), words=step.words)
        for step in record.plan.steps
    ]
    following = record.next_take
    ended = record.state is AcceptanceState.FINISHED
    names = ("report.html", "report.json") if ended else ()
    progress = record.progress
    return AcceptanceBody(
        id=record.id,
        created_at=record.created_at,
        state=record.state,
        captures=len(record.plan.takes),
        captures_done=len(record.readings),
        next=None if following is None else next(each for each in steps if each.name == following[0].name),
        positions=steps,
        readings=[_reading(each) for each in record.readings],
        decision=None if record.result is None else record.result.decision.value,
        progress=None if progress is None else dict(zip(("stage", "fraction", "detail"), progress, strict=True)),
        error=None if record.error is None else fault_problem(fault_of(record.error)),
        files={name: f"/acceptance/{record.id}/{name}" for name in names},
    )


def _reading(reading: Reading) -> ReadingBody:
    return ReadingBody(
        position=reading.step,
        capture=reading.take + 1,
        errors_mm={quantity.value: error for quantity, error in reading.errors_mm.items()},
        limits_mm={quantity.value: limit for quantity, limit in reading.limits_mm.items()},
        noise_mm=reading.noise_mm,
        points_used=reading.used,
        rejected_share=reading.rejected_share,
    )
