"""A vase on a plate with printed markers, rendered: they hold the turn that its shape leaves free."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from slrig.bundle.options import TurntableRecord, encode_turntable, read_poses
from slrig.cli.commands import app
from slrig.model import PlaneKind, TurntablePlane
from slrig.model_jobs.combining import read_mesh
from slrig.multiview.turntable import cut_view, turntable_poses
from tests.golden.test_turntable import AXIS as STAGE_AXIS
from tests.golden.test_turntable import VASE, scanned
from tests.turned_views import displacement_mm

pytestmark = pytest.mark.slow

ANGLES = (0.0, 25.0, 50.0)
AXIS_POINT, AXIS = STAGE_AXIS.point_mm, STAGE_AXIS.direction
PLATE = """
[[object]]
name = "plate"
shape = "board"
kind = "charuco"
columns = 5
rows = 5
square_mm = 18.0
marker_mm = 14.0
dictionary = "DICT_4X4_50"
margin_mm = 3.0
position_mm = [2.0, 30.0, 1.5]
rotation_deg = [-90.0, 0.0, 0.0]
"""


FROM_ABOVE: dict[str, dict[str, Any]] = {
    "head": {"samples_per_axis": 2},
    "projector": {"size_px": [448, 400], "principal_px": [223.5, 199.5], "position_mm": [105.0, -390.0, -440.0]},
    "camera": {"size_px": [384, 352], "principal_px": [191.5, 175.5], "position_mm": [-150.0, -400.0, -400.0]},
}


def modelled(folder: Path, name: str, *told: str) -> tuple[dict[str, Any], list[float], str]:
    """What `slrig model` reports, how far off each view is, rms mm, and what it prints. The plate is cut away."""
    output = folder / name
    plate = TurntablePlane(PlaneKind.PLATE, np.array([2.0, 30.0, 1.5]), np.array([0.0, -1.0, 0.0]), 0.01, 60.0, 1.2)
    (folder / "turntable.json").write_bytes(encode_turntable(TurntableRecord(planes=(plate,))))
    scans = [str(folder / "scans" / f"{angle:03.0f}") for angle in ANGLES]
    done = CliRunner().invoke(
        app, ["model", *scans, "--output", str(output), "--turntable", str(folder / "turntable.json"), *told]
    )
    assert done.exit_code == 0, done.output
    true = turntable_poses(AXIS_POINT, AXIS, np.deg2rad(ANGLES))
    found = read_poses(output / "poses.json").poses
    views = [cut_view(read_mesh(Path(scan) / "mesh.ply"), [plate]).mesh for scan in scans]
    off_mm = [displacement_mm(*each) for each in zip(views, found.values(), true, strict=True)]
    return json.loads((output / "report.json").read_bytes()), off_mm, done.stdout


def test_markers_hold_the_turn_of_a_vase_that_its_shape_leaves_free(tmp_path: Path) -> None:
    scanned(tmp_path, VASE + PLATE, ANGLES, FROM_ABOVE)
    # By an angle that is 1° and 2° wrong the vase stays wrong, and that it may is said.
    axis = ["--axis-point", *map(str, AXIS_POINT), "--axis-direction", *map(str, AXIS)]
    report, off_mm, told = modelled(tmp_path, "by-angle", "--angle", "26", *axis)
    assert [(each["view"], each["motion"]) for each in report["free"]] == [("025", "turn"), ("050", "turn")]
    assert "held as the start has it" in told
    assert off_mm[2] > 0.3
    assert report["markers"] is None

    report, off_mm, told = modelled(tmp_path, "by-markers", "--markers", "--dictionary", "DICT_4X4_50")
    sigma_mm = [view["sigma_mm"] for view in report["views"]]
    print(f"off by {np.round(off_mm, 4)} mm, stated {np.round(sigma_mm, 4)} mm")  # noqa: T201
    print(told)  # noqa: T201
    assert [(each["view"], each["motion"]) for each in report["free"]] == [("025", "turn"), ("050", "turn")]
    assert "held by the markers" in told
    assert max(off_mm) < 0.02
    for off, sigma in zip(off_mm[1:], sigma_mm[1:], strict=True):
        assert off < 3 * sigma < 0.1
    for view in report["markers"]:
        assert len(view["used"]) >= 3
        assert set(view["used"]) <= set(view["seen"])
        assert view["left_out"] == []
        assert 0.2 < view["rms_over_sigma"] < 1.5
