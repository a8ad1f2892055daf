"""The GLB opened in a viewer that other people wrote: F3D, which reads it through VTK, on a virtual display."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Mesh
from slrig.scan.mesh_formats import encode_mesh_glb
from tests.unit.scan.test_mesh_formats import half_ball

pytestmark = pytest.mark.slow

WIDTH_PX, HEIGHT_PX = 480, 360
VIEW_ANGLE_DEG = 30.0
# The dome of radius 50 mm about (3, -4, 500) mm looks along -z, towards the device that scanned it.
EYE_MM = np.array([3.0, -4.0, 200.0])
CENTRE_MM = np.array([3.0, -4.0, 500.0])


def viewer() -> list[str]:
    missing = [name for name in ("f3d", "xvfb-run") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"{' and '.join(missing)} not installed; Debian: apt-get install f3d xvfb xauth")
    return ["xvfb-run", "--auto-servernum", "f3d"]


def picture(mesh: Mesh, folder: Path, *, eye_mm: NDArray[np.float64] = EYE_MM) -> NDArray[np.uint8]:
    """(H, W, 4) uint8: blue, green, red and opacity of the mesh seen from a point, rows rising with y."""
    folder.mkdir()
    (folder / "mesh.glb").write_bytes(encode_mesh_glb(mesh))
    places = {"--camera-position": eye_mm / 1000, "--camera-focal-point": CENTRE_MM / 1000}
    seen_from = [f"{option}={','.join(f'{value:.6f}' for value in place)}" for option, place in places.items()]
    result = subprocess.run(  # noqa: S603 - a viewer from the system's own packages
        [
            *viewer(), str(folder / "mesh.glb"), f"--output={folder / 'picture.png'}", "--no-background",
            f"--resolution={WIDTH_PX},{HEIGHT_PX}", *seen_from, "--camera-view-up=0,-1,0",
            f"--camera-view-angle={VIEW_ANGLE_DEG}",
        ],
        env={**os.environ, "HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1"},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    found = cv2.imread(str(folder / "picture.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None, result.stdout + result.stderr
    assert found.shape == (HEIGHT_PX, WIDTH_PX, 4)
    return np.asarray(found, dtype=np.uint8)


def two_shades() -> Mesh:
    """The dome, dark where x is below its centre and bright where it is above."""
    mesh = half_ball(60, 160)
    bright = mesh.vertices_mm[:, 0] > CENTRE_MM[0]
    return replace(mesh, grey=np.where(bright, 230, 60).astype(np.uint8))


def test_the_mesh_is_seen_in_metres_in_its_shades_and_from_the_side_that_was_scanned(tmp_path: Path) -> None:
    shown = picture(two_shades(), tmp_path / "front")
    opaque = shown[..., 3] > 127
    # Its rim, 49.9 mm from the axis and 3.5 mm before the centre, and the hole in its middle, 9.9 mm and 49 mm.
    focal_px = HEIGHT_PX / 2 / math.tan(math.radians(VIEW_ANGLE_DEG / 2))
    depth_mm = CENTRE_MM[2] - EYE_MM[2]
    outer, inner = (focal_px * 50 * math.sin(a) / (depth_mm - 50 * math.cos(a)) for a in (1.5, 0.2))
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    radius = np.hypot(columns - (WIDTH_PX - 1) / 2, rows - (HEIGHT_PX - 1) / 2)
    assert opaque[(radius > inner + 3) & (radius < outer - 3)].all()
    assert not opaque[(radius < inner - 3) | (radius > outer + 3)].any()
    # Rows rise with y and the eye looks along +z, so x rises to the right, as in a camera's image.
    light = shown[..., :3].mean(axis=2)
    ring = (radius > inner + 5) & (radius < 0.8 * outer)
    left, right = (light[ring & side].mean() for side in (columns < WIDTH_PX / 2 - 5, columns > WIDTH_PX / 2 + 5))
    assert 20 < left < 0.7 * right
    assert right < 250


def test_the_shade_is_that_of_the_stored_normals(tmp_path: Path) -> None:
    mesh = half_ball(60, 160)
    shown = picture(replace(mesh, grey=np.full_like(mesh.grey, 200)), tmp_path / "front")
    turned = picture(replace(mesh, grey=np.full_like(mesh.grey, 200), normals=-mesh.normals), tmp_path / "turned")
    light = shown[HEIGHT_PX // 2, :, :3].astype(float).mean(axis=1)
    opaque = shown[HEIGHT_PX // 2, :, 3] == 255
    across = light[opaque]
    # The light comes from the eye: bright where the surface faces it, dark at the rim.
    assert across.max() > 1.5 * across[[1, -2]].mean()
    # The normals are those of the file: turned ones give another picture.
    assert not np.array_equal(shown, turned)
