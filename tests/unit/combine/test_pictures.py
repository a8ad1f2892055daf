"""The model from six sides: which side is which, and at what scale."""

from __future__ import annotations

import cv2
import numpy as np
import trimesh

from slrig.combine.pictures import six_sides_png
from slrig.meshing.normals import vertex_normals
from slrig.model import Mesh

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
