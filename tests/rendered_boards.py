"""Small rendered rigs with a calibration board, and captures of it: one bundle per pose."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from simulated_rig.device import SimulatedHead, open_simulated_head
from slrig.devices import CameraSettings, Rig
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan

BOARDS: Mapping[str, str] = {
    "charuco": """kind = "charuco"
columns = 6
rows = 4
square_mm = 26.0
marker_mm = 20.0
dictionary = "DICT_4X4_50"
""",
    "chessboard": 'kind = "chessboard"\ncolumns = 8\nrows = 5\nsquare_mm = 20.0',
    "circles": 'kind = "circles"\ncolumns = 4\nrows = 9\nsquare_mm = 15.0\ncircle_mm = 15.0',
}
"""What the boards of `scene` are, by name: the tables that a scene file and a Board share."""

_SCENE = """
[[object]]
name = "board"
shape = "board"
margin_mm = 8.0
{board}
{more}
[[object]]
name = "wall"
shape = "plane"
size_mm = [900.0, 800.0]
position_mm = [0.0, 0.0, 260.0]
albedo = 0.35
texture = {{ kind = "noise", contrast = 0.3, scale_mm = 40.0 }}
"""

_HEAD = """
scene = "scene.toml"
seed = 6
samples_per_axis = 2
ambient = 0.01
carries_calibration = false
workers = 1

[poses]
count = 20
tilt_deg = [15.0, 40.0]
depth_mm = [-60.0, 80.0]
edge_px = 3.0

[projector]
size_px = [320, 200]
focal_px = [390.0, 390.4]
principal_px = [159.0, 226.1]
distortion = [-0.035, 0.022, 0.0003, -0.0002, 0.0]
position_mm = [120.0, 190.0, -585.0]
target_mm = [10.0, 190.0, 0.0]
blur_px = 0.6
gamma = 1.8

[[camera]]
name = "left"
size_px = [320, 256]
focal_px = [475.0, 475.5]
principal_px = [160.6, 126.1]
distortion = [-0.11, 0.15, -0.0003, 0.0005, 0.0]
position_mm = [-110.0, -10.0, -575.0]
target_mm = [0.0, 0.0, 0.0]
saturation_s = 0.02
blur_px = 0.6

[[camera]]
name = "right"
size_px = [320, 256]
focal_px = [472.0, 472.3]
principal_px = [157.7, 129.0]
distortion = [-0.09, 0.11, 0.0002, -0.0004, 0.0]
position_mm = [40.0, -40.0, -590.0]
target_mm = [0.0, 0.0, 0.0]
saturation_s = 0.02
blur_px = 0.6
"""


def board_scene(kind: str = "charuco", *, more: str = "") -> str:
    """The text of a scene file: a board of BOARDS before a wall. more : further lines of the board's table."""
    return _SCENE.format(board=BOARDS[kind], more=more)


def board_options(*, cameras: int = 1, **head: Any) -> dict[str, Any]:
    """Options of a head with one or two 320 x 256 cameras and a lens-shifted 320 x 200 projector, and 20 poses."""
    options = tomllib.loads(_HEAD)
    options["camera"] = options["camera"][:cameras]
    return options | copy.deepcopy(head)


def board_head(folder: Path, options: Mapping[str, Any], scene: str | None = None) -> SimulatedHead:
    """Open a head of `board_options` before a scene, whose file is written into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene if scene is not None else board_scene(), encoding="utf-8")
    return open_simulated_head(options, folder)


def board_rig(head: SimulatedHead, options: Mapping[str, Any]) -> Rig:
    """Make a rig of a head, as discovery would."""
    settings = {each["name"]: CameraSettings(each.get("exposure_s", 0.0167)) for each in options["camera"]}
    return Rig(
        "rendered boards",
        head.cameras,
        head.projector,
        settings,
        head.calibration,
        head,
        clock=head.clock,
        positioner=head.positioner,
    )


def rendered_poses(
    folder: Path,
    options: Mapping[str, Any] | None = None,
    *,
    scene: str | None = None,
    poses: Sequence[int] | None = None,
) -> list[Path]:
    """Capture poses of a head's script, all unless listed, and return their bundles: folder / pose_00, pose_01, ….

    White, black, Gray code and line shift on both axes, by every camera; truth of each pose beside its frames.
    """
    options = board_options() if options is None else options
    head = board_head(folder, options, scene)
    bundles: list[Path] = []
    with board_rig(head, options) as rig:
        assert rig.positioner is not None
        for number, index in enumerate(range(len(rig.positioner.poses)) if poses is None else poses):
            rig.positioner.move(index)
            bundle = folder / f"pose_{number:02d}"
            plan = ScanPlan(patterns=PatternPlan(rows=True))
            capture_frames(rig, plan, bundle).finish()
            bundles.append(bundle)
    return bundles
