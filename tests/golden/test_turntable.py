"""A rendered turntable: its axis from a board, plate and wall from an empty scan, and views that are cut by them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from simulated_rig.device import open_simulated_head
from slrig.bundle import write_calibration
from slrig.bundle.options import read_turntable
from slrig.calibrate.job import AxisJob
from slrig.calibration import Board, BoardKind
from slrig.cli import local
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.devices import CameraSettings, Rig, Turntable
from slrig.examples import EXAMPLES
from slrig.jobs.listener import SILENT
from slrig.model import MeasuredAxis, PlaneKind, RotationAxis
from slrig.model_jobs.combining import read_mesh
from slrig.multiview.registration import register_views
from slrig.multiview.turntable import cut_view, find_turntable_planes, turntable_poses
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.golden.test_bundles import reconstructed
from tests.rendered_boards import board_head, board_options, board_rig, board_scene
from tests.turned_views import displacement_mm

pytestmark = pytest.mark.slow

BOARD_ANGLES = (-50.0, -30.0, -10.0, 10.0, 30.0, 50.0)
BOARD = ["--board", "charuco", "--corners", "6x4", "--square-mm", "26", "--marker-mm", "20"]
BOARD += ["--dictionary", "DICT_4X4_50"]
VIEW_ANGLES = (0.0, 12.0, 24.0)


def axis_of(point_mm: Sequence[float], direction: Sequence[float]) -> RotationAxis:
    return RotationAxis(np.array(point_mm), np.array(direction) / np.linalg.norm(direction))


def recorded(rig: Rig, angle_deg: float, bundle: Path, *, rows: bool) -> Path:
    """A bundle of what stands on the table, turned."""
    assert isinstance(rig.positioner, Turntable)
    rig.positioner.turn(angle_deg)
    plan = ScanPlan(patterns=PatternPlan(rows=rows))
    capture_frames(rig, plan, bundle).finish()
    return bundle


def test_the_axis_is_found_from_a_board_at_six_angles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axis = axis_of([3.0, 0.0, 12.0], [0.03, -1.0, -0.05])
    table = {"point_mm": axis.point_mm.tolist(), "direction": axis.direction.tolist(), "objects": ["board"]}
    options = board_options(cameras=2, carries_calibration=True, turntable=table)
    del options["poses"]
    head = board_head(tmp_path / "rig", options, board_scene(more="rotation_deg = [20.0, 0.0, 0.0]"))
    assert head.calibration is not None
    write_calibration(tmp_path / "calibration.json", head.calibration)
    with board_rig(head, options) as rig:
        for number, angle in enumerate(BOARD_ANGLES):
            recorded(rig, angle, tmp_path / "poses" / f"pose_{number}", rows=True)
    done = CliRunner().invoke(
        app,
        [
            "turntable", "axis", str(tmp_path / "poses"), *BOARD, "--calibration", str(tmp_path / "calibration.json"),
            "--angle", "20", "--output", str(tmp_path / "turntable.json"),
        ],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    print(done.stdout)  # noqa: T201
    found = read_turntable(tmp_path / "turntable.json").axis
    assert found is not None
    is_the_axis(found, axis)
    # The same as a job, which turns the table itself.
    head = board_head(tmp_path / "again", options, board_scene(more="rotation_deg = [20.0, 0.0, 0.0]"))
    with board_rig(head, options) as rig:
        monkeypatch.setattr(local, "open_rig", lambda _config: rig)
        board = Board(BoardKind.CHARUCO, 6, 4, 26.0, 20.0, "DICT_4X4_50")
        record = local.run_job(read_rig(EXAMPLES / "rigs" / "plane.toml"), AxisJob(board), SILENT)
    shot = (record.summary or {})["axis"]
    again = MeasuredAxis(*(np.array(shot[name]) for name in ("point_mm", "direction", "covariance")))
    is_the_axis(again, axis)


def is_the_axis(found: MeasuredAxis, axis: RotationAxis) -> None:
    """Within its own uncertainty, and that of this scene."""
    across = np.linalg.svd(found.direction[None])[2][1:]
    along = found.direction @ (found.point_mm - axis.point_mm) / (found.direction @ axis.direction)
    off_mm = np.linalg.norm(across @ (found.point_mm - axis.point_mm - along * axis.direction))
    off_rad = np.arccos(min(1.0, float(found.direction @ axis.direction)))
    assert off_mm < 0.03
    assert off_mm < 3 * found.point_sigma_mm < 0.1
    assert off_rad < 3 * found.direction_sigma_rad < np.deg2rad(0.05)


VASE = """
[[object]]
name = "vase"
shape = "turned"
position_mm = [2.0, 6.0, 1.5]
profile_mm = [[15.0, -24.0], [17.5, -16.0], [16.0, -6.0], [11.5, 6.0], [8.5, 15.0], [10.0, 20.0]]
albedo = 0.85
"""
STAGE = """
[[object]]
name = "plate"
shape = "plane"
position_mm = [2.0, 26.0, 1.5]
rotation_deg = [-90.0, 0.0, 0.0]
size_mm = [90.0, 90.0]
albedo = 0.5

[[object]]
name = "wall"
shape = "plane"
position_mm = [0.0, 0.0, 52.0]
size_mm = [400.0, 400.0]
albedo = 0.4
"""
AXIS = axis_of([2.0, 0.0, 1.5], [0.0, -1.0, 0.0])


HIGHER = {
    "projector": {"position_mm": [105.0, -260.0, -540.0]},
    "camera": {"position_mm": [-150.0, -262.0, -500.0]},
}
"""Where the devices of the turntable's rig stand to look down on it."""


def scanned(
    folder: Path, scene: str, angles_deg: Sequence[float], devices: Mapping[str, Mapping[str, Any]] = HIGHER
) -> list[Path]:
    """Scans of a scene whose wall stands still, by the rig of the figure on a turntable; each has its bundle in it."""
    folder.mkdir(exist_ok=True)
    (folder / "scene.toml").write_text(scene)
    options: dict[str, Any] = tomllib.loads((EXAMPLES / "rigs" / "turntable.toml").read_text())["head"]
    del options["driver"]
    options |= {"scene": "scene.toml", **devices.get("head", {})}
    turned = [each["name"] for each in tomllib.loads(scene)["object"] if each["name"] != "wall"]
    options["turntable"] |= {
        "point_mm": AXIS.point_mm.tolist(), "direction": AXIS.direction.tolist(), "objects": turned
    }  # fmt: skip
    options["projector"] |= devices["projector"]
    options["camera"][0] |= devices["camera"]
    head, scans = open_simulated_head(options, folder), []
    settings = {"left": CameraSettings(0.0167)}
    with Rig(
        "from above", head.cameras, head.projector, settings, head.calibration, head, clock=head.clock,
        positioner=head.positioner,
    ) as rig:  # fmt: skip
        for angle in angles_deg:
            bundle, scan = recorded(rig, angle, folder / "bundle", rows=False), folder / "scans" / f"{angle:03.0f}"
            reconstructed(bundle, scan)
            bundle.rename(scan / "bundle")
            scans.append(scan)
    return scans


def test_plate_and_wall_are_found_and_a_vase_alone_is_left_where_the_stage_put_it(tmp_path: Path) -> None:
    (empty,) = scanned(tmp_path / "empty", STAGE, [0.0])
    planes = find_turntable_planes(read_mesh(empty / "mesh.ply"), AXIS)
    for plane, kind, normal, at in zip(
        planes, (PlaneKind.PLATE, PlaneKind.BACKDROP), ([0, -1, 0], [0, 0, -1]), ([0, 26, 0], [0, 0, 52]), strict=True
    ):
        assert plane.kind is kind
        assert np.arccos(min(1.0, float(plane.normal @ normal))) < 1e-4
        assert abs((plane.point_mm - at) @ normal) < 0.002
        assert plane.sigma_mm < 0.015
    scans = scanned(tmp_path / "views", VASE + STAGE, VIEW_ANGLES)
    true = turntable_poses(AXIS.point_mm, AXIS.direction, np.deg2rad(VIEW_ANGLES))
    cuts = [cut_view(read_mesh(scan / "mesh.ply"), planes).mesh for scan in scans]
    # The vase alone is left, but for the margin above the plate.
    for mesh in cuts:
        assert mesh.vertices_mm[:, 1].max() < 26 - 1.0
        assert np.linalg.norm((mesh.vertices_mm - AXIS.point_mm)[:, [0, 2]], axis=1).max() < 18

    found = register_views(cuts, true).poses
    off_mm = [displacement_mm(*each) for each in zip(cuts, found, true, strict=True)]
    print(f"off by {np.round(off_mm, 4)} mm")  # noqa: T201
    assert max(off_mm) < 0.01
