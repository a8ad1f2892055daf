"""/scan: start, list, look at, cancel, delete."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Body, Header, Query, Response

from slrig.api.artefacts import ready_files
from slrig.api.openapi import problems
from slrig.api.schemas import ScanBody, ScanPage, ScanRequest, fingerprint, scan_body, scan_plan
from slrig.api.service import Service, Serving
from slrig.jobs.records import JobProgress, JobRecord, JobState
from slrig.verify.verification import require_healthy

USUAL_PAGE = 50

router = APIRouter(prefix="/scan", tags=["scan"])


@router.post("", status_code=202, responses=problems(404, 409, 422, 429, 503, 507))
def start_scan(
    service: Serving,
    response: Response,
    request: Annotated[ScanRequest, Body(default_factory=ScanRequest)],
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            description="makes a repeat of this request return the first one's scan instead of starting another; "
            "kept for a day",
        ),
    ] = None,
) -> ScanBody:
    """Start a scan. The answer comes at once; follow `links.events` for the rest."""
    record = _first_answer(_started(service, request, idempotency_key))
    response.headers["Location"] = f"/scan/{record.id}"
    return scan_body(record, {})


def _started(service: Service, request: ScanRequest, key: str | None) -> JobRecord:
    plan = scan_plan(request, service.scan_defaults)
    wait = request.if_busy == "queue"
    if key is None:
        _require_healthy(service)
        return service.runner.submit(plan, label=request.label, wait=wait)
    earlier = service.store.reserve_key(key, fingerprint(request))
    if earlier is not None:
        return service.store.get(earlier)
    try:
        _require_healthy(service)
        return service.runner.submit(plan, label=request.label, wait=wait, key=key)
    finally:
        # Does nothing when the key has its scan; a refused request may be tried again with the same key.
        service.store.release_key(key)


def _require_healthy(service: Service) -> None:
    health, _, _ = service.verifications.health()
    require_healthy(health, refuse_when_stale=service.refuse_when_stale)


def _first_answer(record: JobRecord) -> JobRecord:
    """The record as it was when the scan was made, so that a repeated request gets the same answer."""
    return replace(
        record,
        state=JobState.QUEUED,
        started_at=None,
        finished_at=None,
        progress=JobProgress("waiting", 0.0, ""),
        fault=None,
        summary=None,
    )


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


@router.delete("/{scan_id}", status_code=204, responses=problems(404, 409, 422))
def delete_scan(service: Serving, scan_id: UUID) -> None:
    """Delete a finished scan with all its files."""
    service.runner.delete(scan_id)
