"""/exposure: which exposures the object before the rig needs."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body
from pydantic import BaseModel, Field

from slrig.api.openapi import problems
from slrig.api.schemas import PatternRequest, ScanRequest, filled, scan_plan
from slrig.api.service import Serving
from slrig.bundle import PresetName, Strict
from slrig.scan.exposure_look import proposed_exposures

router = APIRouter(prefix="/exposure", tags=["scan"])

_SAME = ("preset", "patterns", "coloured_light")  # as in the scan that is going to be asked for


class ExposureRequest(Strict):
    """What the scan is going to be like, as far as it is known."""

    budget_s: Annotated[float, Field(gt=0, le=3600)] | None = Field(
        default=None, description="the most that capture may take, seconds. Default: as long as the object needs"
    )
    preset: PresetName | None = Field(default=None, description="as in POST /scan; its exposures do not count")
    patterns: PatternRequest = Field(default_factory=PatternRequest)
    coloured_light: bool | None = Field(default=None, description="as in POST /scan: it takes more frames")


class CoverBody(BaseModel):
    """One exposure, and shares of the lit pixels."""

    exposure_s: float
    well: float = Field(description="white stands well out of black")
    decoded: float = Field(description="clear enough to be decoded, those among them")
    too_dark: float
    saturated: float


class ExposureBody(BaseModel):
    """A proposal."""

    scan: dict[str, Any] = Field(description="the body of POST /scan that asks for it; keys may be added")
    exposures: list[CoverBody] = Field(description="those proposed")
    others: list[CoverBody] = Field(description="the others that were considered")
    completeness: float = Field(description="share of the lit pixels that they decode together")
    well: float = Field(description="share that stands well out of black in one of them at least")
    too_dark: float = Field(description="share that remains too dark")
    saturated: float = Field(description="share that remains saturated")
    lit: float = Field(description="share of the cameras' pixels that the projector lights")
    seconds: float = Field(description="that capture would take")
    notes: list[str] = Field(description="what remains uncovered, and what to do about it")


@router.post("", responses=problems(404, 409, 502, 503, 504))
def propose_exposures(
    service: Serving, request: Annotated[ExposureRequest, Body(default_factory=ExposureRequest)]
) -> ExposureBody:
    """Look at the object under white and black light for some seconds, and propose exposures for a scan of it."""
    preset = None if request.preset is None else service.presets.get(request.preset)
    asked = ScanRequest(**{key: getattr(request, key) for key in _SAME})
    plan = scan_plan(asked, service.scan_defaults, preset)
    found = proposed_exposures(service.manager, plan, budget_s=request.budget_s)
    times_s = [each.exposure_s for each in found.exposures]
    exposing: dict[str, Any] = {"exposure_s": times_s[0]} if len(times_s) == 1 else {"exposures_s": times_s}
    same = request.model_dump(exclude_unset=True, include=set(_SAME))
    return filled(ExposureBody, found, scan={**same, **exposing})
