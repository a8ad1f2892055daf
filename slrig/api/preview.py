"""/preview/{camera}: what a camera sees while the rig is idle, as a stream of JPEG pictures."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from starlette.responses import StreamingResponse

from slrig.api.openapi import problems
from slrig.api.service import Serving
from slrig.api.streams import OpenStreams
from slrig.errors import SlrigError
from slrig.rig.preview import Light, Watch

BOUNDARY = "picture"
WIDEST_PX = 1280
_QUALITY = 80
_LOOK_S = 0.5
"""How long one look for a picture holds a thread; then the client is asked whether it is still there."""

router = APIRouter(prefix="/preview", tags=["rig"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": f"JPEG pictures, each a part of a multipart body (boundary `{BOUNDARY}`), 8 bits of grey, at "
        f"most {WIDEST_PX} px wide and 15 a second. While a scan holds the rig no pictures come; afterwards they go "
        "on. The stream ends when the camera fails.",
        "content": {f"multipart/x-mixed-replace; boundary={BOUNDARY}": {"schema": {"type": "string"}}},
    }
}


@router.get("/{camera}", response_class=Response, responses={**_STREAM, **problems(404, 409, 422, 429, 502, 503)})
async def look_through_camera(
    request: Request,
    service: Serving,
    camera: Annotated[str, Path(max_length=64, description="name of a camera of the rig")],
    light: Annotated[Light, Query(description="what the projector does meanwhile: dark, or all white")] = Light.OFF,
) -> Response:
    """Look through a camera while nobody scans: an `img` element shows it. A scan that comes goes first."""
    streams: OpenStreams = request.app.state.streams
    streams.require_room()
    watch = await run_in_threadpool(service.runner.watch, camera, light)
    return StreamingResponse(
        _parts(watch, streams),
        media_type=f"multipart/x-mixed-replace; boundary={BOUNDARY}",
        headers={"Cache-Control": "no-store"},
    )


async def _parts(watch: Watch, streams: OpenStreams) -> AsyncIterator[bytes]:
    number = 0
    with streams, watch:
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
            jpeg = await run_in_threadpool(encoded, picture.image)
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            yield head.encode() + jpeg + b"\r\n"


def encoded(image: NDArray[np.uint8]) -> bytes:
    """A JPEG of an image (H, W) uint8, at most `WIDEST_PX` wide."""
    height, width = image.shape
    if width > WIDEST_PX:
        image = np.asarray(
            cv2.resize(image, (WIDEST_PX, max(round(height * WIDEST_PX / width), 1)), interpolation=cv2.INTER_AREA)
        )
    made, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not made:
        message = f"a picture of {width} x {height} could not be encoded as JPEG"
        raise ValueError(message)
    return jpeg.tobytes()
