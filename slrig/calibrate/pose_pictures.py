"""Pictures for the person who holds the board, as PNG: a pose with the corners found in it, and what is covered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_description, read_pages
from slrig.calibrate.records import Setting
from slrig.calibrate.solving import ReadPose
from slrig.calibration import PROJECTOR, Board, PoseObservation
from slrig.calibration.poses import coverage, draw_coverage, draw_pose, projector_view
from slrig.errors import BundleError
from slrig.model import FloatArray, Pixels, Size, White

_MOST_LIGHT_SHOWN = 400


def pose_png(bundle: Path, camera: str, reading: ReadPose | None, board: Board) -> bytes:
    """Return what a camera saw of a pose: its white frame, and the corners if any were found. Raises BundleError."""
    view = None if reading is None else reading.observation.views.get(camera)
    return _png(draw_pose(white_frame(bundle, camera), view, board))


def white_frame(bundle: Path, camera: str) -> Pixels:
    """(H, W) or (H, W, 3) uint8: the first frame of a camera in which all is lit. Raises BundleError."""
    description = read_description(bundle)
    whites = {index for index, pattern in enumerate(description.pattern_list()) if isinstance(pattern, White)}
    for frame in description.frames:
        if frame.camera == camera and frame.pattern in whites:
            form = description.camera_formats()[camera]
            image = read_pages(bundle / frame.file, [frame.page], form)[frame.page]
            scaled = image if form.full_scale == 255 else image.astype(np.float32) * (255 / form.full_scale)
            return np.asarray(scaled, dtype=np.uint8)
    message = f"{bundle}: camera '{camera}' has no white frame; shoot the pose again"
    raise BundleError(message)


def coverage_png(setting: Setting, device: str, poses: Sequence[ReadPose], next_move: Mapping[str, Any]) -> bytes:
    """Return what a device has seen of the board, or lit, and where the board goes next.

    next_move : as a session keeps it (`slrig.calibrate.pose_judging`).
    """
    size = setting.sizes[device]
    observations = [each.observation for each in poses]
    covered = coverage(observations, setting.board, setting.sizes)
    outline = next_move.get("outline_px") if next_move.get("camera") == device else None
    outline_px = np.asarray(outline, dtype=np.float64) if outline else None
    points = [_points_px(each, device, size) for each in observations]
    return _png(draw_coverage(covered.devices[device], points, size, outline_px=outline_px))


def _points_px(pose: PoseObservation, device: str, size: Size) -> FloatArray:
    """(n, 2) float64: the corners that a camera saw, or some of the pixels by which the projector lit the board."""
    if device == PROJECTOR:
        lit = projector_view(pose, size).positions_px
        return lit[:: max(len(lit) // _MOST_LIGHT_SHOWN, 1)]
    view = pose.views.get(device)
    return np.zeros((0, 2)) if view is None else view.points_px


def _png(picture: NDArray[np.uint8]) -> bytes:
    """The PNG of (H, W, 3) uint8: red, green, blue."""
    made, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if not made:
        message = f"a picture of {picture.shape} could not be encoded as PNG"
        raise ValueError(message)
    return data.tobytes()
