"""/rig/file, /rig/settings, /rig/reopen: the rig file, what examinations propose for it, and how it is changed.

A change is tried before it is written: the rig is opened by it, and opened as before where that fails.
"""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tomlkit
from fastapi import APIRouter, Body
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field

from slrig.api.problems import problems
from slrig.api.service import Service, Serving
from slrig.bundle import CameraName, ExposureSeconds, Strict, read_text, write_file
from slrig.config import MAX_CONFIG_BYTES, Gain, RigConfig, rig_of
from slrig.discovery import open_rig
from slrig.doctor import (
    Diagnosis,
    last_examination,
    latency_from_document,
    put_value,
    with_diagnosis,
    with_synchronisation,
)
from slrig.errors import ConfigError, RigFileChangedError, SlrigError, StorageError
from slrig.jobs.listener import Listener
from slrig.jobs.records import Holder, JobKind
from slrig.rig.session import RigSession

HEAD = "head"
"""The name of the settings of an instrument that is projector and cameras."""

_HOLDER = Holder("rig file", "a change of the rig file, which takes seconds", None)
_PROPOSALS: Mapping[JobKind, Callable[[str, dict[str, Any]], str]] = {
    JobKind.DOCTOR: lambda text, found: with_diagnosis(text, Diagnosis.from_document(found)),
    JobKind.LATENCY: lambda text, found: with_synchronisation(text, latency_from_document(found)[0]),
}

router = APIRouter(prefix="/rig", tags=["rig"])


class CameraSettingsEntry(Strict):
    """Settings of a camera where a scan says nothing else."""

    exposure_s: ExposureSeconds | None = Field(default=None, description="null: 1/60 s, or the nearest that it can")
    gain: Gain = 1.0


class RigSettings(Strict):
    """Settings of an open rig that may be changed without knowing its file."""

    cameras: dict[CameraName, CameraSettingsEntry] = Field(
        description=f'by name; those of a head, which holds for all its cameras, as "{HEAD}"'
    )
    tolerance_mm: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=None, description="largest error of 95 % of the points; null: not said"
    )
    refuse_when_stale: bool = Field(default=False, description="refuse scans while the calibration is stale")


class Proposal(BaseModel):
    """The rig file with what an examination measured. difference : lines of a unified diff."""

    kind: JobKind
    text: str
    difference: list[str]


class RigFileBody(BaseModel):
    """The rig file as it lies there now."""

    path: str
    text: str
    version: str = Field(description="of the text; a change must name it, so that it overwrites no newer one")
    refused: str | None = Field(description="why the service cannot change it; null where it can")
    fault: str | None = Field(description="why the rig cannot be opened by it")
    settings: RigSettings | None = Field(description="null where it has a fault")
    proposals: list[Proposal] = Field(description="of the last examinations that measured something else than it says")


class RigFileRequest(Strict):
    """Another text of the rig file."""

    text: Annotated[str, Field(max_length=MAX_CONFIG_BYTES)]
    version: str = Field(description="of the one that it takes the place of")


class SettingsRequest(RigSettings):
    """Settings for the rig file; its comments stay."""

    version: str = Field(description="of the one that is changed")


@router.get("/file")
def read_rig_file(service: Serving) -> RigFileBody:
    """Return the rig file, and the changes that the last examinations propose. Touches no device."""
    path = service.rig.path
    text = read_text(path, MAX_CONFIG_BYTES, ConfigError)
    settings, proposals, fault = None, [], None
    try:
        settings = _settings(rig_of(text, path))
        proposals = list(_proposals(service, text))
    except ConfigError as error:
        fault = str(error)
    return RigFileBody(
        path=str(path), text=text, version=_version(text), refused=_refused(path), fault=fault, settings=settings,
        proposals=proposals,
    )  # fmt: skip


@router.put("/file", responses=problems(409, 429, 502, 503, 507))
def replace_rig_file(service: Serving, request: Annotated[RigFileRequest, Body()]) -> RigFileBody:
    """Open the rig by another text of its file, and keep that. The old file is next to it with the ending .bak. A rig
    that cannot be opened so is opened as before, and nothing is written.
    """
    _change(service, request.text, version=request.version)
    return read_rig_file(service)


@router.put("/settings", responses=problems(409, 429, 502, 503, 507))
def change_settings(service: Serving, request: Annotated[SettingsRequest, Body()]) -> RigFileBody:
    """Change exposures, gains and requirements on scans in the rig file, and reopen the rig: see PUT /rig/file."""
    text = read_text(service.rig.path, MAX_CONFIG_BYTES, ConfigError)
    _require_settings(service, rig_of(text, service.rig.path), request)
    _change(service, _with_settings(text, request), version=request.version)
    return read_rig_file(service)


@router.post("/reopen", status_code=204, responses=problems(409, 429, 502, 503))
def reopen_rig(service: Serving) -> None:
    """Close every device and open the rig again, by its file as it lies there now: after a cable came out, or an
    editor changed the file. GET /rig has the rest.
    """
    _change(service, read_text(service.rig.path, MAX_CONFIG_BYTES, ConfigError), version=None)


def _change(service: Service, text: str, *, version: str | None) -> None:
    """Open the rig by a text, and have it take the place of the file of that version; None: it is the file's own."""
    path = service.rig.path
    if version is not None and (why := _refused(path)) is not None:
        raise StorageError(why)
    config = rig_of(text, path)
    if config.name != service.rig.name:
        message = (
            f"name: expected '{service.rig.name}', the rig of this data folder, found '{config.name}'. For "
            "another rig, start a service with a data folder of its own."
        )
        raise ConfigError(message)

    def kept() -> None:
        if version is not None:
            _replace(path, text, version=version)

    def use(rig: RigSession, _listener: Listener) -> None:
        try:
            rig.reopen(partial(open_rig, config), kept)
        except SlrigError as error:
            if version is None or isinstance(error, RigFileChangedError | StorageError):
                raise
            message = f"The rig cannot be opened so, and the file is as it was: {error}"
            raise ConfigError(message) from error
        service.use(config)

    service.manager.lend(_HOLDER, use)


def _replace(path: Path, text: str, *, version: str) -> None:
    old = read_text(path, MAX_CONFIG_BYTES, ConfigError)
    if _version(old) != version:
        message = f"{path} was changed meanwhile, and stays so. Read it again, then change it."
        raise RigFileChangedError(message)
    mode = path.stat().st_mode
    for place, content in ((path.with_name(f"{path.name}.bak"), old), (path, text)):
        write_file(place, content.encode())
        # The group of a service may read its rig file.
        place.chmod(mode)


def _version(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _refused(path: Path) -> str | None:
    """Why the service cannot replace the rig file; None where it can."""
    without = next((each for each in (path, path.parent) if not os.access(each, os.W_OK)), None)
    return None if without is None else f"The service's user may not write {without}. Change {path} there, and reopen."


def _proposals(service: Service, text: str) -> Iterator[Proposal]:
    for kind, proposed in _PROPOSALS.items():
        last = last_examination(service.folder.root, kind, service.rig.name)
        if last is None:
            continue
        new = proposed(text, last.found)
        if new != text:
            lines = difflib.unified_diff(text.splitlines(), new.splitlines(), n=2, lineterm="")
            yield Proposal(kind=kind, text=new, difference=list(lines)[2:])


def _settings(config: RigConfig) -> RigSettings:
    tables = {HEAD: config.head} if config.head is not None else {each.name: each for each in config.cameras}
    return RigSettings(
        cameras={
            # One of [scan] goes before those of the cameras.
            name: CameraSettingsEntry(exposure_s=config.scan.exposure_s or table.exposure_s, gain=table.gain)
            for name, table in tables.items()
        },
        tolerance_mm=config.tolerance_mm,
        refuse_when_stale=config.refuse_when_stale,
    )


def _require_settings(service: Service, config: RigConfig, wanted: RigSettings) -> None:
    """Raise RequestValidationError unless the settings are of this rig's cameras, and those can do them."""
    known, faults = _settings(config).cameras, []
    facts = service.manager.rig.facts
    for name, entry in wanted.cameras.items():
        if name not in known:
            faults.append(_fault(name, (), f"expected one of {', '.join(known)}; there is no such camera", name))
            continue
        for camera, info in {} if facts is None else facts.cameras.items():
            if name not in {HEAD, camera}:
                continue
            shortest_s, longest_s = info.exposure_range_s
            if entry.exposure_s is not None and not shortest_s <= entry.exposure_s <= longest_s:
                message = f"expected {shortest_s:g} to {longest_s:g} s, which camera {camera} can"
                faults.append(_fault(name, ("exposure_s",), message, entry.exposure_s))
            least, most = info.gain_range
            if not least <= entry.gain <= most:
                faults.append(
                    _fault(name, ("gain",), f"expected {least:g} to {most:g}, which camera {camera} can", entry.gain)
                )
    if faults:
        raise RequestValidationError(faults)


def _fault(name: str, key: tuple[str, ...], message: str, found: object) -> dict[str, Any]:
    return {"type": "value_error", "loc": ("body", "cameras", name, *key), "msg": message, "input": found}


def _with_settings(text: str, wanted: RigSettings) -> str:
    tables: Any = tomlkit.parse(text)
    was = _settings(rig_of(text, Path("rig.toml")))
    if any(was.cameras[name].exposure_s != each.exposure_s for name, each in wanted.cameras.items()):
        put_value(tables.get("scan", {}), "exposure_s", None)
    for name, entry in wanted.cameras.items():
        table = tables["head"] if "head" in tables else next(each for each in tables["camera"] if each["name"] == name)
        put_value(table, "exposure_s", entry.exposure_s)
        if table.get("gain", 1.0) != entry.gain:
            put_value(table, "gain", entry.gain)
    for key, option, value, usual in (
        ("accuracy", "tolerance_mm", wanted.tolerance_mm, None),
        ("verification", "refuse_when_stale", wanted.refuse_when_stale, False),
    ):
        if tables.get(key, {}).get(option, usual) != value:
            table = tables.setdefault(key, tomlkit.table())
            put_value(table, option, value)
    return tomlkit.dumps(tables)
