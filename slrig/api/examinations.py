"""/rig/doctor, /rig/latency, /rig/conformance: examinations of the rig, jobs in line with the scans; and /rig/job."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Body, Response
from pydantic import BaseModel, Field

from slrig.api.calibration_schemas import IfBusy
from slrig.api.idempotency import IdempotencyKey, started_once
from slrig.api.openapi import problems
from slrig.api.schemas import MOST_EXPOSURE_S, JobBody, ScanRequest, filled, scan_plan
from slrig.api.service import Service, Serving
from slrig.bundle import Strict
from slrig.capture import DEFAULT_SEARCH_S, DEFAULT_TRIALS
from slrig.conformance import ConformanceJob
from slrig.devices import Trigger
from slrig.doctor import DoctorJob, LatencyJob
from slrig.jobs.examinations import EXAMINATIONS, Examination, last_examination
from slrig.jobs.job import Job
from slrig.jobs.records import JobRecord

router = APIRouter(prefix="/rig", tags=["rig"])

SearchSeconds = Annotated[float, Field(ge=0.01, le=10, description="longest latency to search for, seconds")]


class ExaminationBody(JobBody):
    """An examination on record."""

    summary: dict[str, Any] | None = Field(description="what it found, as the command prints it with --json")
    links: dict[str, str]


class ExaminationRequest(Strict):
    """An examination of the rig as it stands, before a still object."""

    if_busy: IfBusy = Field(default="reject", description="while the rig is held: answer 409, or wait in line")


class DoctorRequest(ExaminationRequest):
    """An examination of light, timing, picture, response and flicker."""

    search_s: SearchSeconds = DEFAULT_SEARCH_S


class LatencyRequest(ExaminationRequest):
    """A measurement of how late the light is."""

    flashes: int = Field(default=DEFAULT_TRIALS, ge=8, le=1000, description="that each camera must see happen")
    search_s: SearchSeconds = DEFAULT_SEARCH_S
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None
    trigger: Annotated[Trigger, Field(strict=False)] | None = Field(
        default=None, description="how exposures are started. Default: free where a camera can"
    )


class Examinations(BaseModel):
    """The last examination of each kind; null where there was none."""

    doctor: Examination | None
    latency: Examination | None
    conformance: Examination | None


@router.get("/examinations")
def list_examinations(service: Serving) -> Examinations:
    """Return what each examination found last on this rig. Touches no device."""
    root, rig = service.folder.root, service.manager.rig.name
    return Examinations(**{name: last_examination(root, name, rig) for name in Examinations.model_fields})


@router.post("/doctor", status_code=202, responses=problems(409, 429, 502, 503, 507))
def examine_rig(
    service: Serving,
    response: Response,
    request: Annotated[DoctorRequest, Body(default_factory=DoctorRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Examine the rig for faults of light, timing, focus and flicker. The answer comes at once; look again later."""
    plan = scan_plan(ScanRequest(), service.scan_defaults)
    job = DoctorJob(plan.patterns, service.scan_defaults.exposure_s, request.search_s)
    return _started(service, response, job, request, idempotency_key)


@router.post("/latency", status_code=202, responses=problems(409, 429, 502, 503, 507))
def measure_rig_latency(
    service: Serving,
    response: Response,
    request: Annotated[LatencyRequest, Body(default_factory=LatencyRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Flash the projector, and measure how late its light is and how each camera's shutter rolls."""
    job = LatencyJob(request.flashes, request.search_s, request.exposure_s, request.trigger)
    return _started(service, response, job, request, idempotency_key)


@router.post("/conformance", status_code=202, responses=problems(409, 429, 502, 503, 507))
def check_conformance(
    service: Serving,
    response: Response,
    request: Annotated[ExaminationRequest, Body(default_factory=ExaminationRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Check that the rig's drivers keep their contract. The rig is closed and opened many times."""
    job = ConformanceJob(scan_plan(ScanRequest(), service.scan_defaults).patterns)
    return _started(service, response, job, request, idempotency_key)


@router.get("/job/{job_id}")
def look_at_rig_job(service: Serving, job_id: UUID) -> ExaminationBody:
    """Return an examination: its state, and what was found, or why nothing was."""
    return _body(service.store.get(job_id, *EXAMINATIONS))


@router.post("/job/{job_id}/cancel", status_code=202)
def cancel_rig_job(service: Serving, job_id: UUID) -> ExaminationBody:
    """Ask an examination to end early. May be repeated."""
    return _body(service.manager.cancel(service.store.get(job_id, *EXAMINATIONS).id))


def _started(
    service: Service, response: Response, job: Job, request: ExaminationRequest, key: str | None
) -> ExaminationBody:
    def start(key: str | None) -> UUID:
        return service.manager.submit(job, wait=request.if_busy == "queue", key=key)[0].id

    body = _body(started_once(service.keys, service.store, key, f"/rig/{job.kind}", request, start))
    response.headers["Location"] = body.links["self"]
    return body


def _body(record: JobRecord) -> ExaminationBody:
    here = f"{record.kind.path}/{record.id}"
    links = {"self": here, "events": f"{here}/events", "cancel": f"{here}/cancel", "last": "/rig/examinations"}
    return filled(ExaminationBody, record, error=record.fault, links=links)
