"""What the page measures on a mesh, run by Node on a rendered scan, against the scene that was rendered."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.api.system import FOLDER
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import FloatArray
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.formats import encode_view_glb
from slrig.scan.plan import ScanPlan
from tests.e2e.conftest import write_rig
from tests.golden.test_bundles import reconstructed
from tests.npm import lacking

pytestmark = pytest.mark.slow

BALL_MM, BALL_RADIUS_MM = np.array((-38.0, -4.0, -6.0)), 20.0
PIPE_MM, PIPE_RADIUS_MM = np.array((34.0, 0.0, 0.0)), 22.0
PLATE_MM = np.array((0.0, 0.0, 40.0))
TURNED: FloatArray = Rotation.from_euler("xyz", (8.0, -12.0, 0.0), degrees=True).as_matrix()
EYE_MM = np.array((-20.0, -12.0, -560.0))
"""Between the camera and the projector: both see what is seen from here."""

SCENE = f"""
name = "gauges"
[[object]]
name = "ball"
shape = "sphere"
position_mm = {BALL_MM.tolist()}
radius_mm = {BALL_RADIUS_MM}
albedo = 0.8
[[object]]
name = "pipe"
shape = "turned"
position_mm = {PIPE_MM.tolist()}
rotation_deg = [8.0, -12.0, 0.0]
profile_mm = [[{PIPE_RADIUS_MM}, -45.0], [{PIPE_RADIUS_MM}, 0.0], [{PIPE_RADIUS_MM}, 45.0]]
albedo = 0.8
[[object]]
name = "plate"
shape = "plane"
position_mm = {PLATE_MM.tolist()}
rotation_deg = [8.0, -12.0, 0.0]
size_mm = [260.0, 200.0]
albedo = 0.7
"""


PATCH_MM = 12.0


def aimed(*towards: FloatArray) -> list[list[FloatArray]]:
    """Rays from the eye, each by two points."""
    return [[EYE_MM, each] for each in towards]


def on_plate(towards: FloatArray) -> FloatArray:
    """Where the ray from the eye to a point meets the plate."""
    ray, normal = towards - EYE_MM, TURNED[:, 2]
    return np.asarray(EYE_MM + ray * ((PLATE_MM - EYE_MM) @ normal) / (ray @ normal))


def on_ball(towards: FloatArray) -> FloatArray:
    return _nearer(EYE_MM - BALL_MM, towards - EYE_MM, BALL_RADIUS_MM, towards)


def on_pipe(towards: FloatArray) -> FloatArray:
    """The same for the pipe, whose axis is y of its own frame."""
    flat = np.eye(3) - np.outer(TURNED[:, 1], TURNED[:, 1])
    return _nearer(flat @ (EYE_MM - PIPE_MM), flat @ (towards - EYE_MM), PIPE_RADIUS_MM, towards)


def _nearer(start: FloatArray, ray: FloatArray, radius_mm: float, towards: FloatArray) -> FloatArray:
    half = start @ ray / (ray @ ray)
    share = -half - np.sqrt(half**2 - (start @ start - radius_mm**2) / (ray @ ray))
    return np.asarray(EYE_MM + share * (towards - EYE_MM))


def test_what_the_page_measures_lies_within_two_sigma_of_the_truth(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        lacking("needs Node 18 or newer, to run the page's modules: apt install nodejs")
    rig_file = write_rig(tmp_path / "rig", scene=SCENE)
    larger = {"[256, 192]": "[768, 576]", "[1100.0, 1101.0]": "[2200.0, 2202.0]",
              "[240, 192]": "[720, 576]", "[950.0, 951.0]": "[1900.0, 1902.0]"}  # fmt: skip
    text = rig_file.read_text()
    for small, large in larger.items():
        text = text.replace(small, large)
    rig_file.write_text(text)
    with open_rig(read_rig(rig_file)) as rig:
        capture_frames(rig, ScanPlan(), tmp_path / "bundle").finish()
    reconstructed(tmp_path / "bundle", tmp_path / "out")
    mesh = decode_mesh_ply((tmp_path / "out" / "mesh.ply").read_bytes())
    (tmp_path / "view.glb").write_bytes(encode_view_glb(mesh))

    plate = [PLATE_MM + TURNED @ np.array(each) for each in ((-70.0, 55.0, 0.0), (0.0, 62.0, 0.0), (-80.0, -50.0, 0.0))]
    seen = [on_plate(each) for each in plate]
    straight = np.linalg.norm(seen[0] - seen[1]), np.linalg.norm(seen[0] - seen[2])
    ball, pipe = on_ball(BALL_MM), on_pipe(PIPE_MM)
    # Seen at right angles to its axis, so that its section is a circle.
    before = [PIPE_MM + TURNED @ np.array((right, 0.0, -500.0)) for right in (-9.0, 9.0)]
    rays = [[each, each + 100.0 * TURNED[:, 2]] for each in before]
    asked = {
        "along the plate": ("distance", aimed(plate[0], plate[2]), straight[1]),
        "from the ball to the pipe": ("distance", aimed(BALL_MM, PIPE_MM), np.linalg.norm(ball - pipe)),
        "from the ball to the plate": ("plane", aimed(plate[0], BALL_MM), abs((ball - PLATE_MM) @ TURNED[:, 2])),
        "the ball": ("sphere", aimed(BALL_MM), BALL_RADIUS_MM),
        "the pipe": ("cylinder", aimed(PIPE_MM), PIPE_RADIUS_MM),
        "a section of the plate": ("section", aimed(plate[0], plate[1]), straight[0]),
        "a section of the pipe": ("section", rays, 2 * PIPE_RADIUS_MM * np.arcsin(9.0 / PIPE_RADIUS_MM)),
    }  # fmt: skip
    sent = {
        name: {"kind": kind, "rays": np.array(rays).tolist(), "patch_mm": PATCH_MM}
        for name, (kind, rays, _) in asked.items()
    }
    shutil.copytree(FOLDER, tmp_path / "page")
    (tmp_path / "page" / "package.json").write_text('{"type": "module"}')
    command = [node, str(Path(__file__).with_name("measuring.mjs")), str(tmp_path / "page"), str(tmp_path / "view.glb")]
    run = subprocess.run(command, input=json.dumps(sent), capture_output=True, text=True, check=False)  # noqa: S603
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    errors = {name: (found[name][0] - asked[name][2], found[name][1]) for name in asked}
    # The figures are of use, and what they say of themselves holds.
    assert all(0 < sigma_mm < 0.05 for _, sigma_mm in errors.values()), errors
    assert all(abs(error_mm) <= 2 * sigma_mm for error_mm, sigma_mm in errors.values()), errors
