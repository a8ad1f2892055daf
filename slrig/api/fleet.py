"""/fleet: the rigs that share a catalogue with this one."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.exceptions import HTTPException

from slrig.api.openapi import problems
from slrig.api.service import Serving
from slrig.catalogue.fleet import Fleet

router = APIRouter(tags=["system"])


@router.get("/fleet", responses=problems(404, 503, 507))
def look_at_fleet(service: Serving) -> Fleet:
    """List the rigs that share a catalogue with this one: how each is, its health, its last scan and its backlog.

    A catalogue that is away is not waited for: 503 says since when it was tried, and the rig scans on.
    """
    if service.copier is None:
        detail = (
            "This service shares no catalogue with others. Name one in its settings: catalogue = "
            '"postgresql://HOST:PORT/DATABASE" and catalogue_login_file, a file with USER:PASSWORD and mode 0600.'
        )
        raise HTTPException(404, detail)
    return service.copier.fleet()
