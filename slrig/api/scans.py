"""/scan: start, list, look at, cancel, delete."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Body, Response

from slrig.api.artefacts import ready_files
from slrig.api.idempotency import IdempotencyKey, started_once
from slrig.api.openapi import problems
from slrig.api.schemas import ScanBody, ScanPage, ScanRequest, ScanSeries, scan_body, scan_plan
from slrig.api.service import Cursor, PageLength, Service, Serving, paged
from slrig.calibrate.verification import require_healthy
from slrig.jobs.records import JobKind, JobRecord
from slrig.model import MAX_MASK_CHARACTERS
from slrig.scan.job import cancel_series as _cancel_series
from slrig.scan.job import scans_of, series

MOST_SCAN_BYTES = 4 * MAX_MASK_CHARACTERS
"""Of a request: masks of four cameras as long as any may be, or of more as they are."""

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
    plan = scan_plan(request, service.scan_defaults, preset)
    plan = replace(plan, turn_deg=request.turn_deg, turned_by=request.turned_by)

    def start(key: str | None) -> UUID:
        health, _, _ = service.health.health()
        require_healthy(health, refuse_when_stale=service.refuse_when_stale)
        jobs = scans_of(plan, repeat=request.repeat, every_s=request.every_s or 0.0)
        return service.manager.submit(*jobs, label=request.label, wait=request.if_busy == "queue", key=key)[0].id

    record = started_once(service.keys, service.store, idempotency_key, "/scan", request, start)
    response.headers["Location"] = f"/scan/{record.id}"
    return scan_body(record, {})


@router.get("")
def list_scans(
    service: Serving,
    response: Response,
    cursor: Cursor = None,
    limit: PageLength = 50,
) -> ScanPage:
    """List scans from new to old."""
    store = service.store

    def found(most: int) -> Sequence[JobRecord]:
        return store.page(JobKind.SCAN, before=cursor, limit=most)

    shown, following = paged(found, limit, "/scan", service, response)
    return ScanPage(scans=[_body(service, record) for record in shown], next=following)


@router.get("/{scan_id}")
def look_at_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Return a scan: its state, how far it is, and where its files are."""
    return _body(service, service.store.get(scan_id, JobKind.SCAN))


@router.post("/{scan_id}/cancel", status_code=202)
def cancel_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Ask a scan to stop between two frames. May be repeated; a scan that has finished stays as it is."""
    return _body(service, service.manager.cancel(service.store.get(scan_id, JobKind.SCAN).id))


@router.get("/series/{series_id}")
def look_at_series(service: Serving, series_id: UUID) -> ScanSeries:
    """Return the scans of a series. One that is not due yet is queued; `plan.series` says when it is."""
    return ScanSeries(scans=[_body(service, record) for record in series(service.store, series_id)])


@router.post("/series/{series_id}/cancel", status_code=202)
def cancel_series(service: Serving, series_id: UUID) -> ScanSeries:
    """Ask all scans of a series to stop. May be repeated; those that have finished stay as they are."""
    return ScanSeries(scans=[_body(service, record) for record in _cancel_series(service.manager, series_id)])


@router.put("/{scan_id}/pin")
def pin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Keep a scan, whatever the settings say of old ones. DELETE lets it go the way of the others again."""
    return _body(service, service.store.pin(scan_id, JobKind.SCAN, pinned=True))


@router.delete("/{scan_id}/pin")
def unpin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Let a scan be removed when it is old, where the settings ask for that."""
    return _body(service, service.store.pin(scan_id, JobKind.SCAN, pinned=False))


@router.delete("/{scan_id}", status_code=204, responses=problems(409))
def delete_scan(service: Serving, scan_id: UUID) -> None:
    """Delete a finished scan with all its files."""
    service.delete_scan(scan_id)


def _body(service: Service, record: JobRecord) -> ScanBody:
    return scan_body(record, ready_files(service.folder, record))
