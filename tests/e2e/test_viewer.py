"""The GLB opened in viewers that other people wrote: F3D, and three.js in a browser."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Mesh
from slrig.scan.mesh_formats import encode_mesh_glb
from slrig.scan.view_format import encode_coarse_glb, encode_view_glb
from tests.e2e.viewers.f3d import SIZE_PX, f3d_picture
from tests.e2e.viewers.three_js import three_js
from tests.npm import npm_package
from tests.unit.scan.test_mesh_formats import half_ball

pytestmark = pytest.mark.slow

WIDTH_PX, HEIGHT_PX = SIZE_PX
VIEW_ANGLE_DEG = 30.0
# The dome of radius 50 mm about (3, -4, 500) mm looks along -z, towards the camera that scanned it.
EYE_MM = np.array([3.0, -4.0, 200.0])
CENTRE_MM = np.array([3.0, -4.0, 500.0])
# Camera axes in mm (x right, y down, z away) to glTF's in m (x right, y up, z towards the viewer).
TO_GLTF = np.array([0.001, -0.001, -0.001])


def two_shades() -> Mesh:
    """The dome as a camera sees it: dark on the left and bright on the right, its lower right quarter missing."""
    mesh = half_ball(60, 160)
    right, low = (mesh.vertices_mm - CENTRE_MM)[:, :2].T > 0
    missing = (right & low)[mesh.faces].all(axis=1)
    shade = np.where(right, 230, 60).astype(np.uint8)
    return replace(mesh, colour=np.repeat(shade[:, None], 3, axis=1), faces=mesh.faces[~missing])


def assert_upright_and_from_the_front(shown: NDArray[np.uint8]) -> None:
    """The picture shows `two_shades` as the camera that scanned it did."""
    opaque, light = shown[..., 3] > 127, shown[..., :3].mean(axis=2)
    rows, columns = np.nonzero(opaque)
    top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
    # The whole of it is shown, in the middle, as large as can be looked at.
    assert 0 < top < bottom < shown.shape[0]
    assert 0 < left < right < shown.shape[1]
    assert bottom - top > shown.shape[0] / 4
    middle, centre = (top + bottom) // 2, (left + right) // 2
    quarters = {
        "upper left": np.s_[top : middle - 3, left : centre - 3],
        "upper right": np.s_[top : middle - 3, centre + 3 : right],
        "lower left": np.s_[middle + 3 : bottom, left : centre - 3],
        "lower right": np.s_[middle + 3 : bottom, centre + 3 : right],
    }
    covered = {name: opaque[quarter].mean() for name, quarter in quarters.items()}
    shade = {name: light[quarter][opaque[quarter]].mean() for name, quarter in quarters.items() if covered[name] > 0.5}
    assert covered.pop("lower right") < 0.05
    assert min(covered.values()) > 0.65, covered
    assert max(shade["upper left"], shade["lower left"]) < 0.7 * shade["upper right"], shade


def test_f3d_by_itself_shows_the_side_that_was_scanned_upright(tmp_path: Path) -> None:
    (tmp_path / "mesh.glb").write_bytes(encode_mesh_glb(two_shades()))
    assert_upright_and_from_the_front(f3d_picture(tmp_path / "mesh.glb", tmp_path))


@pytest.mark.parametrize("encode", [encode_mesh_glb, encode_view_glb])
def test_three_js_by_itself_shows_the_side_that_was_scanned_upright_and_in_metres(
    tmp_path: Path, encode: Callable[[Mesh], bytes]
) -> None:
    mesh = two_shades()
    shown = three_js(encode(mesh), tmp_path)
    assert_upright_and_from_the_front(shown.picture)
    placed_m = mesh.vertices_mm[np.unique(mesh.faces)] * TO_GLTF
    np.testing.assert_allclose(shown.least_m, placed_m.min(axis=0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(shown.most_m, placed_m.max(axis=0), rtol=0, atol=1e-6)


# Tells what Khronos' own validator finds in the files it is given.
VALIDATE = """
const validator = require(process.argv[1]), {readFileSync} = require("fs");
Promise.all(process.argv.slice(2).map((path) => validator.validateBytes(new Uint8Array(readFileSync(path)))))
  .then((reports) => console.log(JSON.stringify(reports.map(({issues}) => issues))));
"""


def test_the_validator_of_the_format_finds_nothing_to_say(tmp_path: Path) -> None:
    package = npm_package("gltf-validator@2.0.0-dev.3.10", "to validate a GLB")
    mesh = two_shades()
    meshes = [mesh, half_ball(200, 200), replace(mesh, faces=mesh.faces[:1]), replace(mesh, faces=mesh.faces[:0])]
    encoders = (encode_mesh_glb, encode_view_glb, encode_coarse_glb)
    paths = [str(tmp_path / f"{each}.glb") for each in range(len(meshes) * len(encoders))]
    for path, (encode, shape) in zip(paths, product(encoders, meshes), strict=True):
        Path(path).write_bytes(encode(shape))
    command = ["node", "-e", VALIDATE, str(package), *paths]
    told = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)  # noqa: S603
    assert [issues["messages"] for issues in told] == [[]] * len(paths)


def from_the_eye(mesh: Mesh, folder: Path) -> NDArray[np.uint8]:
    """The mesh in F3D, seen from EYE_MM; (H, W, 4) uint8."""
    folder.mkdir()
    (folder / "mesh.glb").write_bytes(encode_mesh_glb(mesh))
    places = {"--camera-position": EYE_MM * TO_GLTF, "--camera-focal-point": CENTRE_MM * TO_GLTF}
    seen_from = [f"{option}={','.join(f'{value:.6f}' for value in place)}" for option, place in places.items()]
    return f3d_picture(folder / "mesh.glb", folder, *seen_from, f"--camera-view-angle={VIEW_ANGLE_DEG}")


def test_the_mesh_is_seen_in_metres(tmp_path: Path) -> None:
    opaque = from_the_eye(half_ball(60, 160), tmp_path / "front")[..., 3] > 127
    # Its rim, 49.9 mm from the axis and 3.5 mm before the centre, and the hole in its middle, 9.9 mm and 49 mm.
    focal_px = HEIGHT_PX / 2 / math.tan(math.radians(VIEW_ANGLE_DEG / 2))
    depth_mm = CENTRE_MM[2] - EYE_MM[2]
    outer, inner = (focal_px * 50 * math.sin(a) / (depth_mm - 50 * math.cos(a)) for a in (1.5, 0.2))
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    radius = np.hypot(columns - (WIDTH_PX - 1) / 2, rows - (HEIGHT_PX - 1) / 2)
    assert opaque[(radius > inner + 3) & (radius < outer - 3)].all()
    assert not opaque[(radius < inner - 3) | (radius > outer + 3)].any()


def test_the_shade_is_that_of_the_stored_normals(tmp_path: Path) -> None:
    mesh = half_ball(60, 160)
    mesh = replace(mesh, colour=np.full_like(mesh.colour, 200))
    shown = from_the_eye(mesh, tmp_path / "front")
    turned = from_the_eye(replace(mesh, normals=-mesh.normals), tmp_path / "turned")
    light = shown[HEIGHT_PX // 2, :, :3].astype(float).mean(axis=1)
    opaque = shown[HEIGHT_PX // 2, :, 3] == 255
    across = light[opaque]
    # The light comes from the eye: bright where the surface faces it, dark at the rim.
    assert across.max() > 1.5 * across[[1, -2]].mean()
    # The normals are those of the file: turned ones give another picture.
    assert not np.array_equal(shown, turned)
