"""/live: depth while the rig is idle, to aim by."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Body, Query, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field
from starlette.responses import StreamingResponse

from slrig.api.events import Held
from slrig.api.problems import problems
from slrig.api.schemas import ReconstructionRequest, ScanRequest, filled, scan_plan
from slrig.api.service import Serving
from slrig.bundle import PresetName, RegionTable, Strict
from slrig.errors import SlrigError
from slrig.live.room import LiveOptions, LiveStatus, Viewer
from slrig.live.stream import message
from slrig.rig.preview import LONGEST_S

_WAIT_S = 0.5
"""Longest wait for a message; then the connection to the client is checked."""
_STEP = 3
_TYPE = "application/octet-stream"

router = APIRouter(prefix="/live", tags=["rig"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Messages, each a head of eight bytes (two little-endian uint32: lengths of a JSON text and "
        "of the bytes after it), the text, the bytes. `kind` is `geometry` first (deflated float32 (height, "
        "width, 2), x/z and y/z of each pixel; `part_px`, left, top, right and bottom of what is decoded of the "
        "camera's image), then `depth` (deflated planes of one byte a pixel: low and high bytes of the "
        "differences along each row of q, modulo 65536; a code of σ; `state`; grey), `wait` when none comes and "
        "`end`, each with its `reason`. Depth along the camera's axis: near_mm + (q − 1) unit_mm, none where q is "
        "0; σ: 0.0001 mm · 1.05^(code − 1), none where it is 0; state: 0 measured, 1 moved, 2 saturated, 3 dark, "
        "4 unclear, 5 unseen, 6 outside the region.",
        "content": {_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}


class LiveRequest(Strict):
    """Live depth of one camera."""

    camera: str | None = Field(default=None, max_length=64, description="default: the first of the rig")
    step: int | None = Field(
        default=None,
        ge=1,
        le=16,
        description="at least, pixels from one decoded point to the next. Default: 1, up to 1.5 Mpx. Decoded is "
        "what viewers watch",
    )
    exposure_s: float | None = Field(default=None, gt=0, le=LONGEST_S, description="default: the rig file's")
    preset: PresetName | None = Field(default=None, description="whose region counts, as for a scan by it")
    region: RegionTable | None = Field(
        default=None,
        description="what of the scene is decoded, as in a scan's `reconstruction`; default: the preset's or the rig "
        "file's, {} for everything. Pixels outside of it have no depth",
    )


class LiveBody(BaseModel):
    """Live depth as it is."""

    camera: str
    step: int
    patterns: int = Field(description="of one cycle")
    viewers: int
    playing: bool = Field(description="false while a job holds the rig; it goes on afterwards")
    depth_per_s: float | None
    facts: dict[str, Any] | None = Field(description="of the newest depth image")
    links: dict[str, str]


@router.get("", responses=problems(409))
def look_at_live(service: Serving) -> LiveBody:
    """Return the state of live depth."""
    return _body(service.manager.live.status())


@router.post("", status_code=201, responses=problems(404, 409, 502, 503))
def start_live(service: Serving, request: Annotated[LiveRequest, Body(default_factory=LiveRequest)]) -> LiveBody:
    """Begin live depth: the rig repeats a short sequence while it is idle. Unwatched for 10 s, it ends."""
    camera = request.camera
    if camera is None:
        facts = service.manager.rig.facts
        camera = next(iter(facts.cameras), "") if facts is not None else ""
    preset = None if request.preset is None else service.presets.get(request.preset)
    scan = ScanRequest(preset=request.preset, reconstruction=ReconstructionRequest(region=request.region))
    region = scan_plan(scan, service.scan_defaults, preset).reconstruction.region
    return _body(service.manager.go_live(LiveOptions(camera, request.step, request.exposure_s, region)))


@router.delete("", status_code=204)
def end_live(service: Serving) -> None:
    """End live depth, if there is any. The projector is dark when the exposure under way is over."""
    service.manager.live.end()


@router.get("/depth", response_class=Response, responses={**_STREAM, **problems(409, 429)})
async def watch_live(
    held: Held,
    service: Serving,
    step: Annotated[int, Query(ge=1, le=64, description="pixels of the camera from one point to the next")] = _STEP,
) -> Response:
    """Watch live depth. Who reads slowly misses images, and always gets the newest one."""
    held.enter_context(service.streams.take())
    loop, news = asyncio.get_running_loop(), asyncio.Event()

    def notify() -> None:
        # The loop of a service that ends may be gone before its viewers are.
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(news.set)

    viewer = await run_in_threadpool(service.manager.live.watch, step, notify)
    return StreamingResponse(_messages(viewer, news), media_type=_TYPE, headers={"Cache-Control": "no-store"})


async def _messages(viewer: Viewer, news: asyncio.Event) -> AsyncIterator[bytes]:
    number = -1
    with viewer:
        while True:
            news.clear()
            try:
                came = viewer.message(number)
            except SlrigError as error:
                yield message({"kind": "end", "code": error.code, "reason": str(error)}, b"")
                return
            if came is not None:
                number, made = came
                yield made
                continue
            try:
                async with asyncio.timeout(_WAIT_S):
                    await news.wait()
            except TimeoutError:
                # It reveals clients that have gone.
                yield message({"kind": "wait", "reason": viewer.waits_for}, b"")


def _body(status: LiveStatus) -> LiveBody:
    return filled(LiveBody, status, camera=status.options.camera, links={"self": "/live", "depth": "/live/depth"})
