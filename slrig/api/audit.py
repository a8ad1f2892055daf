"""/audit: who did what."""

from __future__ import annotations

from datetime import datetime

from fastapi import APIRouter, Response
from pydantic import BaseModel

from slrig.api.schemas import filled
from slrig.api.service import Cursor, PageLength, Serving, paged

router = APIRouter(tags=["system"])


class AuditEntryBody(BaseModel):
    """One request that changed something, or tried to. `made` is the path of what it made."""

    at: datetime
    who: str
    address: str
    method: str
    path: str
    status: int
    made: str


class AuditPage(BaseModel):
    """Entries from new to old. `next` asks for the page after this one, null on the last."""

    entries: list[AuditEntryBody]
    next: str | None


@router.get("/audit")
def list_audit(service: Serving, response: Response, cursor: Cursor = None, limit: PageLength = 50) -> AuditPage:
    """List who did what, from new to old: every request that writes, and every one that was refused for its key's scope
    or number. Names are those of keys.
    """
    shown, following = paged(
        lambda most: service.audit.page(before=cursor, limit=most), limit, "/audit", service, response
    )
    return AuditPage(entries=[filled(AuditEntryBody, entry) for entry in shown], next=following)
