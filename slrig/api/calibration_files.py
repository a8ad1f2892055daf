"""The files of a calibration: itself in three forms, its report, pictures of its poses and of what they cover."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Response
from fastapi.responses import FileResponse

from slrig.api.openapi import problems
from slrig.api.service import Serving
from slrig.bundle.description import CAMERA_NAME
from slrig.calibrate.calibrating import EXPORTS
from slrig.calibrate.pose_answering import picture_name
from slrig.calibrate.store import REPORT
from slrig.errors import ArtefactNotReadyError, CameraNotFoundError

MEDIA_TYPES = {
    "calibration.json": "application/json",
    "calibration.yml": "application/yaml",
    "calibration.xml": "application/xml",
}

router = APIRouter(prefix="/calibration/{calibration_id}", tags=["calibration"])


def _content(media_type: str) -> dict[int | str, dict[str, Any]]:
    content = {media_type: {"schema": {"type": "string", "format": "binary"}}}
    return {200: {"description": "the file", "content": content}}


def _serve(name: str, media_type: str) -> Callable[..., Response]:
    def fetch(service: Serving, calibration_id: UUID) -> Response:
        content = service.calibrations.exported(calibration_id, name)
        # Another solve of the same session gives another file.
        headers = {"Content-Disposition": f'inline; filename="{name}"', "Cache-Control": "no-store"}
        return Response(content, media_type=media_type, headers=headers)

    fetch.__doc__ = f"Return what the last solve gave, as {name}."
    return fetch


for _name in EXPORTS:
    router.add_api_route(
        f"/{_name}",
        _serve(_name, MEDIA_TYPES[_name]),
        methods=["GET"],
        response_class=Response,
        responses={**_content(MEDIA_TYPES[_name]), **problems(404, 409, 422, 507)},
        operation_id=f"fetch_{_name.replace('.', '_')}",
        summary=f"Fetch {_name}",
    )


@router.get(f"/{REPORT}", response_class=Response, responses={**_content("text/html"), **problems(404, 409, 422)})
def fetch_calibration_report(service: Serving, calibration_id: UUID) -> Response:
    """Return the report of the last solve: one page that holds everything that it shows and runs no script."""
    path = service.calibrations.file(calibration_id, REPORT)
    # It asks nobody for anything, and nothing in it may.
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    headers = {"Cache-Control": "no-store", "Content-Security-Policy": policy}
    return FileResponse(path, media_type="text/html", headers=headers)


@router.get(
    "/pose/{number}/picture.png",
    response_class=Response,
    responses={**_content("image/png"), **problems(404, 409, 422)},
)
def fetch_pose_picture(
    service: Serving,
    calibration_id: UUID,
    number: int,
    camera: Annotated[str | None, Query(pattern=CAMERA_NAME, description="Default: the first one")] = None,
) -> Response:
    """Return what a camera saw of a pose: its white frame, with the corners that were found. Refused poses have it."""
    calibrations = service.calibrations
    pose = calibrations.register.pose(calibration_id, number)
    cameras = calibrations.register.get(calibration_id).cameras
    chosen = next(iter(cameras), "") if camera is None else camera
    path = calibrations.store.pose(calibration_id, number) / picture_name(chosen)
    if cameras and chosen not in cameras:
        message = f"Calibration {calibration_id} has no camera '{chosen}'; it has {', '.join(cameras)}."
        raise CameraNotFoundError(message)
    if not path.is_file():
        message = f"{pose.name} of calibration {calibration_id} is {pose.state} and has no picture."
        raise ArtefactNotReadyError(message)
    return FileResponse(path, media_type="image/png", headers={"Cache-Control": "private, no-cache"})


@router.get("/coverage.png", response_class=Response, responses={**_content("image/png"), **problems(404, 409, 422)})
def fetch_coverage_picture(
    service: Serving,
    calibration_id: UUID,
    device: Annotated[
        str | None, Query(pattern=CAMERA_NAME, description="a camera, or projector. Default: the first camera")
    ] = None,
) -> Response:
    """Return a picture of what a device has seen of the board so far, and of where the board should go next."""
    content = service.calibrations.coverage_picture(calibration_id, device)
    return Response(content, media_type="image/png", headers={"Cache-Control": "no-store"})
