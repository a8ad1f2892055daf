"""/audit: who did what."""

from __future__ import annotations

from fastapi import APIRouter, Response
from pydantic import BaseModel

from slrig.api.service import Cursor, PageLength, Serving, paged
from slrig.jobs.audit import AuditEntry

router = APIRouter(tags=["system"])


class AuditPage(BaseModel):
    """Entries from new to old. `next` asks for the page after this one, null on the last."""

    entries: list[AuditEntry]
    next: str | None


@router.get("/audit")
def list_audit(service: Serving, response: Response, cursor: Cursor = None, limit: PageLength = 50) -> AuditPage:
    """List who did what, from new to old: every request that writes, and every one that was refused for its key's scope
    or number. Names are those of keys.
    """
    shown, following = paged(
        lambda most: service.audit.page(before=cursor, limit=most), limit, "/audit", service, response
    )
    return AuditPage(entries=list(shown), next=following)
