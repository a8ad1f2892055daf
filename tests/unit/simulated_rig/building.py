"""Small rendered rigs for the tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simulated_rig.device import SimulatedHead, open_simulated_head
from simulated_rig.scene import PrintedBoard, Triple, rotation_matrix
from slrig.devices import Trigger
from slrig.model import Axis, Black, FloatArray, Frame, LineShift, Pattern, PatternSequence, Pixels, Size, White

FACING_PLATE = """
[[object]]
shape = "plane"
size_mm = [400.0, 400.0]
albedo = 0.8
"""


def head_options(
    *,
    camera: Mapping[str, Any] | None = None,
    projector: Mapping[str, Any] | None = None,
    **head: Any,
) -> dict[str, Any]:
    """Options of a rig with a 64 x 48 camera and a 80 x 60 projector, 500 mm before the origin, without blur."""
    eye = {
        "name": "eye",
        "size_px": [64, 48],
        "focal_px": [400.0, 400.0],
        "position_mm": [-60.0, 0.0, -500.0],
        "target_mm": [0.0, 0.0, 0.0],
        "exposure_s": 0.01,
        "saturation_s": 0.02,
    }
    lamp = {
        "size_px": [80, 60],
        "focal_px": [400.0, 400.0],
        "position_mm": [60.0, 0.0, -500.0],
        "target_mm": [0.0, 0.0, 0.0],
    }
    cameras = head.pop("cameras", None) or [eye | dict(camera or {})]
    return {"scene": "scene.toml", "projector": lamp | dict(projector or {}), "camera": cameras, **head}


def small_head(folder: Path, scene: str = FACING_PLATE, **options: Any) -> SimulatedHead:
    """Open a rig of `head_options` before `scene`, whose file is written into `folder`."""
    (folder / "scene.toml").write_text(scene)
    return open_simulated_head(head_options(**options), folder)


def coarser(head: Mapping[str, Any], times: int) -> dict[str, Any]:
    """Options of a head whose devices see the same with so many times fewer pixels each way."""

    def device(table: Mapping[str, Any]) -> dict[str, Any]:
        lengths = {key: [value / times for value in table[key]] for key in ("focal_px", "principal_px") if key in table}
        return {**table, **lengths, "size_px": [length // times for length in table["size_px"]]}

    return {**head, "projector": device(head["projector"]), "camera": [device(each) for each in head["camera"]]}


def line_profile(size: Size, shift: int, *, period: int = 8) -> Pixels:
    """(1, Wp) uint8: every `period`-th column lit."""
    columns = np.arange(size.width_px)
    return np.where((columns - shift) % period == 0, 255, 0).astype(np.uint8)[None]


def white_black_lines(size: Size, *, lines: int = 8) -> PatternSequence:
    """White, black, and `lines` line-shift patterns of period 8."""
    patterns: list[Pattern] = [White(), Black()]
    profiles: list[Pixels] = [np.full((1, 1), 255, np.uint8), np.zeros((1, 1), np.uint8)]
    for shift in range(lines):
        patterns.append(LineShift(Axis.COLUMN, shift, 8))
        profiles.append(line_profile(size, shift))
    return PatternSequence(size, tuple(patterns), tuple(profiles))


def taken(head: SimulatedHead, index: int, camera: str = "eye") -> Frame:
    """One frame of one pattern, by software trigger, as a capture takes it; the camera is armed."""
    eye, shown = head.cameras[camera], head.projector.show(index)
    eye.trigger()
    return eye.read(shown.t_visible_ns + shown.t_err_ns, 1.0)


def frames_of(
    head: SimulatedHead, *indices: int, sequence: PatternSequence | None = None, camera: str = "eye"
) -> list[Frame]:
    """Frames of patterns of a sequence, which is loaded first: white, black and lines unless it is given."""
    head.projector.load(sequence or white_black_lines(head.projector.info.size))
    head.cameras[camera].arm(len(indices), Trigger.SOFTWARE)
    found = [taken(head, index, camera) for index in indices]
    head.cameras[camera].disarm()
    return found


def corners_in_world_mm(board: PrintedBoard, position_mm: Triple, rotation_deg: Triple) -> FloatArray:
    """(n, 3) float64: the print's corners in the world, of a board in a pose."""
    return np.asarray(board.corners_mm @ rotation_matrix(rotation_deg).T + position_mm, np.float64)
