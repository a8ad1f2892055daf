"""/rig, /device and /preview: the rig as it is held, what else is plugged in, and what a camera sees meanwhile."""

from __future__ import annotations

from collections.abc import AsyncIterator
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

import cv2
import numpy as np
from fastapi import APIRouter, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel
from starlette.responses import StreamingResponse

from slrig.api.events import StreamPlace
from slrig.api.openapi import problems
from slrig.api.schemas import CalibrationInUse, CameraBody, ProjectorBody, RigBody, filled
from slrig.api.service import Serving
from slrig.devices import CameraInfo, FoundDevice
from slrig.discovery import InstalledDriver, MissingLibrary, OtherSystem, discover_devices, installed_drivers
from slrig.errors import SlrigError
from slrig.jobs.manager import RigStatus
from slrig.jobs.records import utc_now
from slrig.rig.preview import Light, Watch
from slrig.rig.settings import SettingsInUse

_BOUNDARY = "picture"
_WIDEST_PX = 1280
_QUALITY = 80
_SATURATED = 254
_TOO_DARK = 12
"""Grey levels of 255 in white light: four times the contrast below which a scan takes a pixel for unlit."""
_RED, _BLUE = (32, 32, 224), (224, 80, 32)
_LOOK_S = 0.5
"""How long one look for a picture holds a thread; then the client is asked whether it is still there."""

router = APIRouter(tags=["rig"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": f"JPEG pictures, each a part of a multipart body (boundary `{_BOUNDARY}`), 8 bits of grey, at "
        f"most {_WIDEST_PX} px wide and 15 a second. While a scan holds the rig no pictures come; afterwards they go "
        "on. The stream ends when the camera fails.",
        "content": {f"multipart/x-mixed-replace; boundary={_BOUNDARY}": {"schema": {"type": "string"}}},
    }
}


@router.get("/rig")
def look_at_rig(service: Serving) -> RigBody:
    """Return the rig: its devices, who holds it, and how many scans wait. Touches no device."""
    status = service.manager.status()
    facts, settings = status.facts, service.manager.rig.settings
    return filled(
        RigBody,
        status,
        name=status.rig,
        open=facts is not None and status.fault is None,
        error=status.fault,
        calibrated=None if facts is None else (status.active is not None or facts.calibration is not None),
        calibration=_in_use(status),
        positions=[] if facts is None else facts.positions,
        turntable=facts is not None and facts.turntable,
        cameras=[] if facts is None else [_camera(*each, settings.get(each[0])) for each in facts.cameras.items()],
        projector=None if facts is None else filled(ProjectorBody, facts.projector, size_px=facts.projector.size),
        scan_defaults=service.scan_defaults.model_dump(exclude_none=True),
        fleet=service.copier is not None,
    )


class DeviceList(BaseModel):
    """What is installed, what is plugged in, and what is missing."""

    drivers: tuple[InstalledDriver, ...]
    devices: tuple[FoundDevice, ...]
    missing: tuple[MissingLibrary, ...]
    elsewhere: tuple[OtherSystem, ...]
    faults: list[str]


@router.get("/device")
def list_devices() -> DeviceList:
    """Return the drivers that are installed, the devices that are plugged in, and the libraries that are missing."""
    found = discover_devices()
    return filled(DeviceList, found, drivers=installed_drivers(), faults=[str(fault) for fault in found.faults])


def _in_use(status: RigStatus) -> CalibrationInUse | None:
    active, facts = status.active, status.facts
    calibration = active.calibration if active is not None else None if facts is None else facts.calibration
    if calibration is None:
        return None
    solved = calibration.solved
    solved_at = None if solved is None else datetime.fromisoformat(solved.solved_at)
    return CalibrationInUse(
        source="rig" if active is None else "session",
        id=None if active is None else UUID(active.name),
        solve=None if solved is None else solved.id,
        solved_at=solved_at,
        age_s=None if solved_at is None else round((utc_now() - solved_at).total_seconds(), 1),
        expected_error_mm=None if solved is None else solved.expected_error_mm,
        error=status.misfit,
    )


def _camera(name: str, camera: CameraInfo, settings: SettingsInUse | None) -> CameraBody:
    form, applied = camera.format, None if settings is None else settings.applied
    return filled(
        CameraBody,
        camera,
        name=name,
        size_px=form.size,
        bit_depth=form.bit_depth,
        triggers=sorted(camera.triggers),
        exposure_s=None if applied is None else applied.exposure_s,
        gain=None if applied is None else applied.gain,
        notes=[*camera.notes, *(() if settings is None else settings.words)],
    )


@router.get("/preview/{camera}", response_class=Response, responses={**_STREAM, **problems(409, 429, 502, 503)})
async def look_through_camera(
    place: StreamPlace,
    service: Serving,
    camera: Annotated[str, Path(max_length=64, description="name of a camera of the rig")],
    light: Annotated[Light, Query(description="what the projector does meanwhile: dark, or all white")] = Light.OFF,
    marks: Annotated[
        bool, Query(description="saturated pixels in red, and in white light in blue those that are too dark")
    ] = False,
) -> Response:
    """Look through a camera while nobody scans: an `img` element shows it. A scan that comes goes first."""
    place.take()
    watch = await run_in_threadpool(service.manager.watch, camera, light)
    return StreamingResponse(
        _parts(watch, marked=marks),
        media_type=f"multipart/x-mixed-replace; boundary={_BOUNDARY}",
        headers={"Cache-Control": "no-store"},
    )


async def _parts(watch: Watch, *, marked: bool) -> AsyncIterator[bytes]:
    number = 0
    with watch:
        while True:
            try:
                picture = await run_in_threadpool(watch.picture, number, _LOOK_S)
            except SlrigError:
                # The answer has begun: all that is left is to end it. `/rig` tells why.
                return
            if picture is None:
                # An empty line between parts: whoever has gone is noticed by it.
                yield b"\r\n"
                continue
            number = picture.number
            shown = marked_picture(picture.image, lit=watch.light is Light.WHITE) if marked else picture.image
            jpeg = await run_in_threadpool(encoded, shown)
            head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            yield head.encode() + jpeg + b"\r\n"


def marked_picture(image: NDArray[np.uint8], *, lit: bool) -> NDArray[np.uint8]:
    """A grey image (H, W) as (H, W, 3), blue, green, red: saturated pixels are red, and too dark ones, if lit, blue."""
    picture = np.repeat(image[:, :, None], 3, axis=2)
    picture[image >= _SATURATED] = _RED
    if lit:
        picture[image < _TOO_DARK] = _BLUE
    return picture


def encoded(image: NDArray[np.uint8]) -> bytes:
    """A JPEG of an image (H, W) or (H, W, 3) uint8, at most `_WIDEST_PX` wide."""
    height, width = image.shape[:2]
    if width > _WIDEST_PX:
        image = np.asarray(
            cv2.resize(image, (_WIDEST_PX, max(round(height * _WIDEST_PX / width), 1)), interpolation=cv2.INTER_AREA)
        )
    made, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not made:
        message = f"a picture of {width} x {height} could not be encoded as JPEG"
        raise ValueError(message)
    return jpeg.tobytes()
