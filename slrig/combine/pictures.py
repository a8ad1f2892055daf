"""A picture of a model for people: shaded, from six sides."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slrig.meshing import used_vertices
from slrig.model import FloatArray, Mesh, Pinhole, Size
from slrig.scan.pictures import captioned, draw_scale, encode_png, side_by_side
from slrig.scan.shading import Picture, shaded

_PANEL = Size(400, 400)
_FILL = 0.9
_DISTANCE = 50.0  # half diagonals of the object: what is nearer is drawn at most 2 % larger

# From the model's frame, y down and z away from who looks from the front, into that of a camera: its axes as rows.
_SIDES: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "top": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "bottom": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


def six_sides_png(mesh: Mesh) -> bytes:
    """The mesh from six sides at one scale, which a bar gives, as PNG. The front is what the first view's camera saw.

    Backs of triangles are red: they are seen through what is open. The mesh has a triangle.
    """
    points = mesh.vertices_mm[used_vertices(mesh.faces, len(mesh.vertices_mm))].astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    distance_mm = _DISTANCE * max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    px_per_mm = _FILL * _PANEL.width_px / max(float((high - low).max()), 1e-6)
    panels = [_panel(mesh, name, (low + high) / 2, distance_mm, px_per_mm) for name in _SIDES]
    page = np.concatenate([side_by_side(panels[:3]), side_by_side(panels[3:])])
    return encode_png(page)


def _panel(mesh: Mesh, side: str, middle_mm: FloatArray, distance_mm: float, px_per_mm: float) -> Picture:
    turn = np.array(_SIDES[side], dtype=np.float64)
    centre = (np.array(_PANEL.shape[::-1]) - 1) / 2
    focal_px = px_per_mm * distance_mm
    camera = Pinhole(
        size=_PANEL,
        matrix=np.array(((focal_px, 0.0, centre[0]), (0.0, focal_px, centre[1]), (0.0, 0.0, 1.0))),
        distortion=np.zeros(5),
        rotation=turn,
        translation_mm=np.array((0.0, 0.0, distance_mm)) - turn @ middle_mm,
    )
    panel = shaded(mesh, camera)
    draw_scale(panel, _PANEL, px_per_mm)
    return captioned(panel, side, "backs are red" if side == "front" else "")
