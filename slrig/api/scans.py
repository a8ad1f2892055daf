"""/scan: start, list, look at, cancel, delete."""

from __future__ import annotations

from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Body, Query, Response

from slrig.api.artefacts import ready_files
from slrig.api.idempotency import IdempotencyKey, started_once
from slrig.api.openapi import problems
from slrig.api.schemas import ScanBody, ScanPage, ScanRequest, scan_body, scan_plan
from slrig.api.service import Service, Serving
from slrig.jobs.records import JobRecord
from slrig.verify.verification import require_healthy

USUAL_PAGE = 50

router = APIRouter(prefix="/scan", tags=["scan"])


@router.post("", status_code=202, responses=problems(404, 409, 422, 429, 503, 507))
def start_scan(
    service: Serving,
    response: Response,
    request: Annotated[ScanRequest, Body(default_factory=ScanRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ScanBody:
    """Start a scan. The answer comes at once; follow `links.events` for the rest."""
    plan = scan_plan(request, service.scan_defaults)

    def start(key: str | None) -> JobRecord:
        health, _, _ = service.verifications.health()
        require_healthy(health, refuse_when_stale=service.refuse_when_stale)
        return service.runner.submit(plan, label=request.label, wait=request.if_busy == "queue", key=key)

    record = started_once(service.keys, service.store, idempotency_key, request, start)
    response.headers["Location"] = f"/scan/{record.id}"
    return scan_body(record, {})


@router.get("", responses=problems(422))
def list_scans(
    service: Serving,
    response: Response,
    cursor: Annotated[int | None, Query(ge=1, le=2**53, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = USUAL_PAGE,
) -> ScanPage:
    """List scans from new to old."""
    limit = min(limit, service.settings.page_limit)
    found = service.store.page(before=cursor, limit=limit + 1)
    shown = found[:limit]
    following = None
    if len(found) > limit:
        following = f"/scan?cursor={shown[-1].number}&limit={limit}"
        response.headers["Link"] = f'<{following}>; rel="next"'
    return ScanPage(scans=[scan_body(record, ready_files(service.folder, record)) for record in shown], next=following)


@router.get("/{scan_id}", responses=problems(404, 422))
def look_at_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Return a scan: its state, how far it is, and where its files are."""
    record = service.store.get(scan_id)
    return scan_body(record, ready_files(service.folder, record))


@router.post("/{scan_id}/cancel", status_code=202, responses=problems(404, 422))
def cancel_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Ask a scan to stop between two frames. May be repeated; a scan that has finished stays as it is."""
    record = service.runner.cancel(scan_id)
    return scan_body(record, ready_files(service.folder, record))


@router.put("/{scan_id}/pin", responses=problems(404, 422))
def pin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Keep a scan, whatever the settings say of old ones. DELETE lets it go the way of the others again."""
    return _pinned(service, scan_id, pinned=True)


@router.delete("/{scan_id}/pin", responses=problems(404, 422))
def unpin_scan(service: Serving, scan_id: UUID) -> ScanBody:
    """Let a scan be removed when it is old, where the settings ask for that."""
    return _pinned(service, scan_id, pinned=False)


def _pinned(service: Service, scan_id: UUID, *, pinned: bool) -> ScanBody:
    record = service.store.pin(scan_id, pinned=pinned)
    return scan_body(record, ready_files(service.folder, record))


@router.delete("/{scan_id}", status_code=204, responses=problems(404, 409, 422))
def delete_scan(service: Serving, scan_id: UUID) -> None:
    """Delete a finished scan with all its files."""
    service.runner.delete(scan_id)
