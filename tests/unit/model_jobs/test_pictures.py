"""The model from six sides: which side is which, and at what scale."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from slrig.calibration.printing import marker_dictionary
from slrig.errors import BundleError
from slrig.meshing.surface import vertex_normals
from slrig.model import FloatArray, Mesh, Pinhole, Size
from slrig.model_jobs.combining import bundle_of, markers_in_view, six_sides_png

PANEL_PX, GAP_PX, ROW_PX = 400, 10, 444
SIDES = ("front", "right", "back", "left", "top", "bottom")


def of(solid: trimesh.Trimesh) -> Mesh:
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces, np.int32)
    count = len(vertices)
    return Mesh(
        vertices.astype(np.float32), faces, vertex_normals(vertices, faces), np.full((count, 3), 128, np.uint8),
        np.zeros(count, np.uint8), np.full(count, 0.01, np.float32), np.full(count, -1, np.int32),
    )  # fmt: skip


def shown(mesh: Mesh) -> np.ndarray:
    page = cv2.imdecode(np.frombuffer(six_sides_png(mesh), np.uint8), cv2.IMREAD_COLOR)
    assert page is not None
    return np.asarray(page, dtype=int)


def shapes(mesh: Mesh) -> dict[str, np.ndarray]:
    """Where each panel shows the surface, without the row of the bar."""
    page = shown(mesh)
    found = {}
    for number, side in enumerate(SIDES):
        top, left = GAP_PX + ROW_PX * (number // 3), GAP_PX + (PANEL_PX + GAP_PX) * (number % 3)
        panel = page[top : top + PANEL_PX, left : left + PANEL_PX]
        found[side] = (np.abs(panel - panel[0, 0]).sum(axis=2) > 0)[: PANEL_PX - 40]
    return found


def test_each_side_shows_what_lies_there_at_one_scale() -> None:
    # A beam of 60 x 20 x 10 mm along x, and a knob to the right (+x), above (-y) and behind (+z), far from the origin.
    knob = trimesh.creation.box((4, 4, 4), trimesh.transformations.translation_matrix((28, -12, 7)))
    beam = trimesh.creation.box((60, 20, 10))
    both = trimesh.util.concatenate([beam, knob])
    both.apply_translation((300, -200, 900))
    seen = shapes(of(both))

    def extent(side: str) -> tuple[int, int]:
        rows, columns = np.nonzero(seen[side])
        return int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1

    px_per_mm = 0.9 * PANEL_PX / 60  # the beam is the longest
    for side, wide, high in (("front", 60, 24), ("back", 60, 24), ("right", 14, 24), ("left", 14, 24), ("top", 60, 14)):
        assert np.abs(np.array(extent(side)) / px_per_mm - (wide, high)).max() < 0.02 * 60, side
    middle = PANEL_PX // 2
    for side, to_the_right, rows in (
        ("front", True, slice(0, middle - 60)), ("back", False, slice(0, middle - 60)),  # the knob is above
        ("right", True, slice(0, middle - 60)), ("left", False, slice(0, middle - 60)),  # and behind
        ("top", True, slice(0, middle - 25)), ("bottom", True, slice(middle + 25, None)),
    ):  # fmt: skip
        columns = np.nonzero(seen[side][rows])[1]
        assert len(columns) > 0, side
        assert bool(columns.mean() > middle) is to_the_right, side


def test_open_surface_is_red_from_behind() -> None:
    ball = trimesh.creation.icosphere(4, 10.0)
    lid = ball.triangles_center[:, 1] < -6.0  # above
    page = shown(of(trimesh.Trimesh(ball.vertices, ball.faces[~lid], process=False)))
    red = page[:, :, 2] > page[:, :, 1] + 15
    middles = {
        side: red[GAP_PX + ROW_PX * (n // 3) + 200, GAP_PX + (PANEL_PX + GAP_PX) * (n % 3) + 200]
        for n, side in enumerate(SIDES)
    }
    assert [side for side, is_red in middles.items() if is_red] == ["top"]


# ---- Corners of a painted marker, whose places are exactly known, put on a mesh of the plane that it is painted on


MIDDLE, SIDE_MM = np.array([3.0, -2.0, 400.0]), 14.0
TILT = cv2.Rodrigues(np.array([0.7, 0.1, 0.2]))[0]
CAMERA = Pinhole(
    Size(200, 160), np.array([[1200.0, 0, 99.5], [0, 1200.0, 79.5], [0, 0, 1]]), np.zeros(5), np.eye(3), np.zeros(3)
)


def painted() -> FloatArray:
    """(160, 200): marker 7 on paper, each pixel the mean of 64 points in it."""
    cells = cv2.aruco.generateImageMarker(marker_dictionary("DICT_4X4_50"), 7, 6) > 0
    fine = (np.arange(200 * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid((fine - 99.5) / 1200, (fine[: 160 * 8] - 79.5) / 1200)
    ways = np.stack([x, y, np.ones_like(x)], axis=-1)
    on = ways * ((MIDDLE @ TILT[:, 2]) / (ways @ TILT[:, 2]))[..., None] - MIDDLE
    column, row = (np.floor(on @ TILT[:, k] / SIDE_MM * 6 + 3).astype(int) for k in (0, 1))
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < 6)
    light = np.where(inside, cells[np.clip(row, 0, 5), np.clip(column, 0, 5)], True)
    return np.asarray(np.where(light, 0.8, 0.05).reshape(160, 8, 200, 8).mean(axis=(1, 3)))


def test_corners_of_a_marker_lie_where_they_were_painted_within_what_is_stated() -> None:
    random = np.random.default_rng(1)
    image = cv2.GaussianBlur(painted(), (0, 0), 0.6) + random.normal(0, 0.005, (160, 200))
    u, v = np.meshgrid(np.arange(-15, 15, 0.3), np.arange(-15, 15, 0.3))
    flat = np.stack([u.ravel(), v.ravel(), random.normal(0, 0.02, u.size)], axis=1)
    points = (flat @ TILT.T + MIDDLE).astype(np.float32)
    nothing = np.zeros(len(points))
    mesh = Mesh(
        points, np.zeros((0, 3), np.int32), np.zeros_like(points), np.zeros((len(points), 3), np.uint8),
        nothing.astype(np.uint8), nothing.astype(np.float32), nothing.astype(np.int32),
    )  # fmt: skip
    found = dict(markers_in_view(np.round(image * 65535).clip(0, 65535).astype(np.uint16), CAMERA, 65535, mesh,
                                "DICT_4X4_50"))  # fmt: skip
    assert list(found) == [7]
    square = SIDE_MM / 2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    off = found[7].corners_mm - (square @ TILT.T + MIDDLE)
    assert np.abs(off).max() < 0.05
    assert 0.002 < found[7].sigma_mm.max() < 0.03
    assert np.sqrt(np.mean((off / found[7].sigma_mm[:, None]) ** 2)) < 2.5


def test_frames_are_found_next_to_the_mesh_made_of_them(tmp_path: Path) -> None:
    for mesh, bundle in (("a/mesh.ply", "a/bundle"), ("view-3/mesh.ply", "bundle-3"), ("b/mesh.ply", "b")):
        (tmp_path / bundle).mkdir(parents=True)
        (tmp_path / bundle / "bundle.json").write_text("{}")
        assert bundle_of(tmp_path / mesh) == tmp_path / bundle
    for lost in ("c/mesh.ply", "a/front.ply", "view-4/mesh.ply"):
        with pytest.raises(BundleError, match="expected the frames that it was made of"):
            bundle_of(tmp_path / lost)
