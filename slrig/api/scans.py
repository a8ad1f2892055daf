"""/scan: start, list, get, cancel, pin, delete; /exposure and /preset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Body, Path, Query, Response
from pydantic import BaseModel, Field

from slrig.api.files import ready_files
from slrig.api.hand_eye import rig_in_base
from slrig.api.problems import problems
from slrig.api.schemas import (
    ListedScan,
    NewName,
    PatternRequest,
    ScanBody,
    ScanPage,
    ScanRequest,
    ScanSeries,
    UncalibratedRequest,
    filled,
    listed_links,
    scan_body,
    scan_plan,
    scan_unit,
)
from slrig.api.service import Cursor, IdempotencyKey, PageLength, Service, Serving, paged, started_once
from slrig.bundle import AwareMoment, PresetDocument, PresetName, SafeText, Strict
from slrig.calibrate.verification import require_healthy
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.model import MAX_MASK_CHARACTERS, MeshAxes
from slrig.scan.exposure import proposed_exposures
from slrig.scan.formats import PREVIEW, THUMBNAIL
from slrig.scan.job import cancel_series as _cancel_series
from slrig.scan.job import scans_of, series, with_guess
from slrig.scan.plan import PresetSource

MOST_SCAN_BYTES = 4 * MAX_MASK_CHARACTERS
"""Longest request: masks of four cameras as long as any may be, or shorter ones of more."""

router = APIRouter(prefix="/scan", tags=["scan"])


@router.post("", status_code=202, responses=problems(404, 409, 429, 503, 507))
def start_scan(
    service: Serving,
    response: Response,
    request: Annotated[ScanRequest, Body(default_factory=ScanRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ScanBody:
    """Start a scan. The answer comes at once; follow `links.events` for the rest."""
    preset = None if request.preset is None else service.presets.get(request.preset)
    in_robots_axes = request.reconstruction.mesh_axes is MeshAxes.ROBOT
    in_base = rig_in_base(service, request.robot_pose, needed=in_robots_axes)
    plan = scan_plan(request, service.scan_defaults, preset, in_base)
    plan = replace(plan, turn_deg=request.turn_deg, turned_by=request.turned_by)

    def start(key: str | None) -> UUID:
        health, _, _ = service.health.health()
        require_healthy(health, refuse_when_stale=service.refuse_when_stale)
        jobs = scans_of(plan, repeat=request.repeat, every_s=request.every_s or 0.0)
        return service.manager.submit(*jobs, label=request.label, wait=request.if_busy == "queue", key=key)[0].id

    record = started_once(service.keys, service.store, idempotency_key, "/scan", request, start)
    response.headers["Location"] = f"/scan/{record.id}"
    return scan_body(record, {})


class ScanQuery(BaseModel):
    """Which scans a page is to have: of all that are on record, or of those that are as it says."""

    name: Annotated[SafeText, Field(max_length=200)] | None = Field(
        default=None, description="part of the name, upper or lower case, or the start of the id"
    )
    state: list[JobState] = Field(default=[], description="one of these; may be repeated")
    since: AwareMoment | None = Field(default=None, description="created at this moment or later")
    until: AwareMoment | None = Field(default=None, description="created before this moment")
    rig: Annotated[SafeText, Field(max_length=200)] | None = Field(
        default=None, description="name of the rig that scanned"
    )
    preset: Annotated[SafeText, Field(max_length=200)] | None = Field(
        default=None, description="name of the requested preset"
    )
    cursor: Cursor = None
    limit: PageLength = 50


@router.get("")
def list_scans(
    service: Serving,
    response: Response,
    query: Annotated[ScanQuery, Query()],
) -> ScanPage:
    """List scans from new to old, all of them or those that match."""
    wanted = {name: value for name, value in query if name not in {"cursor", "limit", "state"}}

    def found(most: int) -> Sequence[JobRecord]:
        return service.store.page(JobKind.SCAN, before=query.cursor, limit=most, states=query.state, **wanted)

    kept = query.model_dump(mode="json", exclude_unset=True, exclude={"cursor", "limit"})
    shown, following = paged(found, query.limit, "/scan", service, response, kept)
    return ScanPage(scans=[_listed(service, record) for record in shown], next=following)


@router.get("/{scan_id}")
def look_at_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Return a scan: its state, its progress, and links to its files."""
    return _body(service, service.store.get(scan_id, JobKind.SCAN))


@router.patch("/{scan_id}", responses=problems(507))
def rename_scan(service: Serving, scan_id: UUID, request: NewName) -> ScanBody:
    """Give a scan another name."""
    return _body(service, service.rename(scan_id, JobKind.SCAN, request.label))


@router.post("/{scan_id}/cancel", status_code=202)
def cancel_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Request a scan to stop between two frames. May be repeated; a scan that has finished stays as it is."""
    return _body(service, service.manager.cancel(service.store.get(scan_id, JobKind.SCAN).id))


@router.get("/series/{series_id}")
def look_at_series(service: Serving, series_id: UUID) -> ScanSeries:
    """Return the scans of a series. One that is not due yet is queued; `plan.series` says when it is."""
    return ScanSeries(scans=[_body(service, record) for record in series(service.store, series_id)])


@router.post("/series/{series_id}/cancel", status_code=202)
def cancel_series(service: Serving, series_id: UUID) -> ScanSeries:
    """Request all scans of a series to stop. May be repeated; those that have finished stay as they are."""
    return ScanSeries(scans=[_body(service, record) for record in _cancel_series(service.manager, series_id)])


class ReconstructAgain(Strict):
    """Changes of a scan's plan for a further reconstruction."""

    uncalibrated: UncalibratedRequest | None = Field(
        default=None,
        description="of a scan that was requested with guesses: replaces these, as for another baseline. Default: no "
        "change",
    )


@router.post("/{scan_id}/reconstruct", status_code=202, responses=problems(409, 410, 422, 503, 507))
def reconstruct_scan(
    service: Serving, scan_id: UUID, request: Annotated[ReconstructAgain, Body(default_factory=ReconstructAgain)]
) -> ScanBody:
    """Make mesh and files of a finished scan again from its bundle, as after a failure, damage or an update. Its files
    stay until then. Follow `links.events` for the rest.
    """
    record = service.store.get(scan_id, JobKind.SCAN)
    instead = None if request.uncalibrated is None else with_guess(record, request.uncalibrated.guess())
    with service.models.unused(scan_id):
        return _body(service, service.manager.compute_again(scan_id, instead))


@router.put("/{scan_id}/pin")
def pin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Keep a scan, also where the settings remove old ones. DELETE ends that."""
    return _body(service, service.store.pin(scan_id, JobKind.SCAN, pinned=True))


@router.delete("/{scan_id}/pin")
def unpin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Allow the removal of a scan when it is old, where the settings say so."""
    return _body(service, service.store.pin(scan_id, JobKind.SCAN, pinned=False))


@router.delete("/{scan_id}", status_code=204, responses=problems(409))
def delete_scan(service: Serving, scan_id: UUID) -> None:
    """Delete a finished scan with all its files."""
    service.delete_scan(scan_id)


def _listed(service: Service, record: JobRecord) -> ListedScan:
    mesh = (record.summary or {}).get("mesh") or {}
    return filled(
        ListedScan,
        record,
        error=record.fault,
        triangles=(mesh.get("figures") or {}).get("triangles"),
        sigma_mm=(mesh.get("sigma_mm") or {}).get("p50"),
        turn_deg=record.plan.get("turn_deg"),
        preset=(record.plan.get("preset") or {}).get("name"),
        unit=scan_unit(record),
        links=listed_links(record, service.folder.scan(record.id) / PREVIEW, THUMBNAIL),
    )


def _body(service: Service, record: JobRecord) -> ScanBody:
    return scan_body(record, ready_files(service.folder, record))


exposure_router = APIRouter(prefix="/exposure", tags=["scan"])

_SAME = ("preset", "patterns", "coloured_light")  # as in the scan to come


class ExposureRequest(Strict):
    """Options of the scan to come, as far as they are known."""

    budget_s: Annotated[float, Field(gt=0, le=3600)] | None = Field(
        default=None, description="the most that capture may take, seconds. Default: as long as the object needs"
    )
    preset: PresetName | None = Field(default=None, description="as in POST /scan; its exposures do not count")
    patterns: PatternRequest = Field(default_factory=PatternRequest)
    coloured_light: bool | None = Field(default=None, description="as in POST /scan: it takes more frames")


class CoverBody(BaseModel):
    """One exposure, and shares of the lit pixels."""

    exposure_s: float
    well: float = Field(description="white is clearly brighter than black")
    decoded: float = Field(description="clear enough to be decoded, those among them")
    too_dark: float
    saturated: float


class ExposureBody(BaseModel):
    """A proposal."""

    scan: dict[str, Any] = Field(description="the body of POST /scan for it; keys may be added")
    exposures: list[CoverBody] = Field(description="those proposed")
    others: list[CoverBody] = Field(description="the others that were considered")
    completeness: float = Field(description="share of the lit pixels that they decode together")
    well: float = Field(description="share that is clearly brighter in white than in black in one of them at least")
    too_dark: float = Field(description="share that remains too dark")
    saturated: float = Field(description="share that remains saturated")
    lit: float = Field(description="share of the cameras' pixels that the projector lights")
    seconds: float = Field(description="that capture would take")
    notes: list[str] = Field(description="what remains uncovered, and what to do about it")


@exposure_router.post("", responses=problems(404, 409, 502, 503, 504))
def propose_exposures(
    service: Serving, request: Annotated[ExposureRequest, Body(default_factory=ExposureRequest)]
) -> ExposureBody:
    """Measure the object under white and black light for some seconds, and propose exposures for a scan of it."""
    preset = None if request.preset is None else service.presets.get(request.preset)
    wanted = ScanRequest(**{key: getattr(request, key) for key in _SAME})
    plan = scan_plan(wanted, service.scan_defaults, preset)
    found = proposed_exposures(service.manager, plan, budget_s=request.budget_s)
    times_s = [each.exposure_s for each in found.exposures]
    exposing: dict[str, Any] = {"exposure_s": times_s[0]} if len(times_s) == 1 else {"exposures_s": times_s}
    same = request.model_dump(exclude_unset=True, include=set(_SAME))
    return filled(ExposureBody, found, scan={**same, **exposing})


preset_router = APIRouter(prefix="/preset", tags=["scan"])

Name = Annotated[PresetName, Path(description="what a request of a scan calls it")]


class PresetLine(BaseModel):
    """A preset by its name."""

    name: str
    source: PresetSource
    description: str | None
    digest: str | None
    fault: str | None = Field(description="what is wrong with its file; it cannot be used then")


class PresetList(BaseModel):
    """All presets, by name."""

    presets: list[PresetLine]


@preset_router.get("", responses=problems())
def list_presets(service: Serving) -> PresetList:
    """List the presets: shipped ones, those of the rig file, and those kept here."""
    return PresetList(presets=[filled(PresetLine, each) for each in service.presets.listed()])


@preset_router.get("/{name}", response_model_exclude_none=True, responses=problems(404))
def look_at_preset(service: Serving, name: Name) -> PresetDocument:
    """Return a preset as a document that another rig's service takes as it is."""
    return service.presets.get(name)


@preset_router.put("/{name}", response_model_exclude_none=True, responses=problems(507))
def put_preset(service: Serving, name: Name, document: PresetDocument) -> PresetDocument:
    """Keep a preset by this name, in place of what had it."""
    service.presets.put(name, document)
    return document


@preset_router.delete("/{name}", status_code=204, responses=problems(404))
def delete_preset(service: Serving, name: Name) -> None:
    """Delete a stored preset. A shipped one, or the rig file's, of its name is listed again."""
    service.presets.delete(name)
