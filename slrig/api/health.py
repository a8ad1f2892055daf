"""/rig/health and /rig/verification: whether the calibration still holds, its history, and a look at it now."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Body, Query, Response
from pydantic import BaseModel, Field

from slrig.api.calibration_schemas import BoardRequest, IfBusy
from slrig.api.idempotency import IdempotencyKey, started_once
from slrig.api.openapi import file_of, problems
from slrig.api.schemas import MOST_EXPOSURE_S, AnyFault, filled
from slrig.api.service import Service, Serving
from slrig.bundle import AwareMoment, Strict
from slrig.calibrate.trend import health_svg
from slrig.calibrate.verification import VerificationJob
from slrig.calibration import Board
from slrig.calibration.health import THRESHOLDS, DriftEstimate, HealthState, PairFigures, Thresholds
from slrig.errors import CalibrationError
from slrig.jobs.records import JobKind, JobRecord, JobState, utc_now

router = APIRouter(prefix="/rig", tags=["health"])


class VerificationFigures(BaseModel):
    """What one verification found."""

    id: UUID
    at: datetime
    calibration: str
    kind: str = Field(description="board or scan")
    state: HealthState
    reasons: list[str]
    remedy: str | None
    pairs: list[PairFigures]
    scale_percent: float | None
    scale_sigma_percent: float | None
    scale_mm: float | None
    expected_mm: float | None
    stated_mm: float | None
    drift_mm: float | None
    drifts: list[DriftEstimate]
    open: str | None = Field(description="what the geometry leaves open")
    unseen: list[str] = Field(description="devices that took no part, of which nothing was learned")


class HealthBody(BaseModel):
    """The health of the calibration in use."""

    state: HealthState
    reasons: list[str]
    remedy: str | None
    calibration: str | None
    calibration_age_s: float | None
    refuses_scans_when_stale: bool
    thresholds: Thresholds
    latest: VerificationFigures | None
    links: dict[str, str]


class HealthPage(BaseModel):
    """Verifications, newest first."""

    verifications: list[VerificationFigures]


class VerificationRequest(Strict):
    """A verification. An empty request shoots the board of the calibration in use, where it is."""

    board: BoardRequest | None = Field(default=None, description="Default: that of the active calibration")
    position: Annotated[int, Field(ge=0, le=10_000)] | None = Field(
        default=None, description="of the positioner, by its number from 0. Default: the board stays where it is"
    )
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None
    if_busy: IfBusy = Field(default="reject", description="while the rig is held: answer 409, or wait in line")


class VerificationBody(BaseModel):
    """A verification that was asked for."""

    id: UUID
    state: JobState
    created_at: datetime
    found: VerificationFigures | None
    error: AnyFault
    links: dict[str, str]


@router.get("/health")
def look_at_health(service: Serving) -> HealthBody:
    """Return whether the calibration in use still holds, why, and what to do. Touches no device."""
    health, latest, calibration = service.health.health()
    solved = None if calibration is None else calibration.solved
    age_s = None if solved is None else (utc_now() - datetime.fromisoformat(solved.solved_at)).total_seconds()
    return filled(
        HealthBody,
        health,
        calibration=None if calibration is None else calibration.solve_id,
        calibration_age_s=age_s,
        refuses_scans_when_stale=service.refuse_when_stale,
        thresholds=THRESHOLDS,
        latest=None if latest is None else VerificationFigures.model_validate(latest.document()),
        links={"history": "/rig/health/history", "plot": "/rig/health.svg", "verify": "/rig/verification"},
    )


@router.get("/health/history")
def list_health(
    service: Serving,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    since: Annotated[AwareMoment | None, Query(description="ISO 8601, with its offset from UTC")] = None,
) -> HealthPage:
    """List verifications, newest first."""
    found = service.health.store.history(limit=limit, since=since)
    return HealthPage(verifications=[VerificationFigures.model_validate(record.document()) for record in found])


@router.get(
    "/health.svg",
    response_class=Response,
    responses=file_of("image/svg+xml"),
)
def plot_health(service: Serving, limit: Annotated[int, Query(ge=1, le=2000)] = 500) -> Response:
    """Draw the newest verifications over time."""
    records = service.health.store.history(limit=limit)
    return Response(health_svg(records[::-1]), media_type="image/svg+xml")


@router.post("/verification", status_code=202, responses=problems(409, 429, 502, 503, 507))
def verify_rig(
    service: Serving,
    response: Response,
    request: Annotated[VerificationRequest, Body(default_factory=VerificationRequest)],
    idempotency_key: IdempotencyKey = None,
) -> VerificationBody:
    """Shoot the board and judge the calibration in use by it. The answer comes at once; look again later."""
    board = _board_in_use(service) if request.board is None else request.board.board()

    def start(key: str | None) -> UUID:
        job = VerificationJob(board, request.position, request.exposure_s)
        return service.manager.submit(job, wait=request.if_busy == "queue", key=key)[0].id

    body = _body(started_once(service.keys, service.store, idempotency_key, "/rig/verification", request, start))
    response.headers["Location"] = body.links["self"]
    return body


@router.get("/verification/{verification_id}")
def look_at_verification(service: Serving, verification_id: UUID) -> VerificationBody:
    """Return a verification: its state, and what was found, or why nothing was."""
    return _body(service.store.get(verification_id, JobKind.VERIFICATION))


@router.post("/verification/{verification_id}/cancel", status_code=202)
def cancel_verification(service: Serving, verification_id: UUID) -> VerificationBody:
    """Ask a verification to end early. May be repeated."""
    return _body(service.manager.cancel(service.store.get(verification_id, JobKind.VERIFICATION).id))


def _board_in_use(service: Service) -> Board:
    """The board of the active calibration. Raises CalibrationError where there is none."""
    active = service.calibrations.active
    board = None if active is None else service.calibrations.register.get(active).board
    if board is None:
        message = (
            "board: the calibration in use was imported or is the rig's own, and its board is not known here; send "
            '"board" with the kind, corners and square_mm of the one that is in view'
        )
        raise CalibrationError(message)
    return board


def _body(job: JobRecord) -> VerificationBody:
    here = f"/rig/verification/{job.id}"
    links = {"self": here, "events": f"{here}/events", "cancel": f"{here}/cancel", "health": "/rig/health"}
    return filled(VerificationBody, job, found=job.summary, error=job.fault, links=links)
