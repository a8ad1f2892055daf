"""/preset: named options of scans."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from pydantic import BaseModel, Field

from slrig.api.openapi import problems
from slrig.api.schemas import filled
from slrig.api.service import Serving
from slrig.bundle import PresetDocument, PresetName
from slrig.scan.presets import PresetSource

router = APIRouter(prefix="/preset", tags=["scan"])

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


@router.get("", responses=problems())
def list_presets(service: Serving) -> PresetList:
    """List the presets: shipped ones, those of the rig file, and those kept here."""
    return PresetList(presets=[filled(PresetLine, each) for each in service.presets.listed()])


@router.get("/{name}", response_model_exclude_none=True, responses=problems(404))
def look_at_preset(service: Serving, name: Name) -> PresetDocument:
    """Return a preset as a document that another rig's service takes as it is."""
    return service.presets.get(name)


@router.put("/{name}", response_model_exclude_none=True, responses=problems(507))
def put_preset(service: Serving, name: Name, document: PresetDocument) -> PresetDocument:
    """Keep a preset by this name, in place of what had it."""
    service.presets.put(name, document)
    return document


@router.delete("/{name}", status_code=204, responses=problems(404))
def delete_preset(service: Serving, name: Name) -> None:
    """Delete a preset that was put. A shipped one, or the rig file's, of its name is seen again."""
    service.presets.delete(name)
