"""Objects scanned from eight sides by a camera whose place nobody knows, with truth; one of them can be turned.

Parts that overlap are not united: a ray meets the outermost one first, and nothing sees the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray, Mesh
from tests.turned_views import Radius, vase
from tests.unit.multiview.known_views import DISTANCE_MM, Noise, View, star, views_of

_NOISE = Noise(0.010, 0.004, 4.0)
_PIXEL_MM = 0.8


def seen_around(shape: trimesh.Trimesh, elevation_deg: float = 25.0, *, seed: int = 0, views: int = 8) -> list[View]:
    """Views from a ring of directions, each in the frame of a camera at the origin that rolled at will."""
    angles = 2 * np.pi * np.arange(views) / views
    up = np.deg2rad(elevation_deg)
    ring = np.stack([np.cos(up) * np.cos(angles), np.cos(up) * np.sin(angles), np.full(views, np.sin(up))], axis=1)
    return seen_from(shape, ring, seed=seed)


def seen_from(shape: trimesh.Trimesh, directions: FloatArray, *, seed: int = 0) -> list[View]:
    """Views from unit directions (N, 3), each in the frame of a camera at the origin that rolled at will."""
    random = np.random.default_rng(seed)
    views = []
    for direction, view in zip(directions, views_of(shape, directions, _PIXEL_MM, _NOISE, seed), strict=True):
        towards = Rotation.align_vectors([-direction], [[0, 0, 1]])[0]
        camera = np.eye(4)
        camera[:3, :3] = (towards * Rotation.from_euler("z", random.uniform(0, 2 * np.pi))).as_matrix()
        camera[:3, 3] = DISTANCE_MM * direction
        views.append(View(moved_mesh(view.mesh, np.linalg.inv(camera) @ view.pose), camera, view.seen_mm))
    return views


def moved_mesh(mesh: Mesh, pose: FloatArray) -> Mesh:
    """A mesh where a pose (4, 4) takes it."""
    points = mesh.vertices_mm @ pose[:3, :3].T + pose[:3, 3]
    normals = (mesh.normals @ pose[:3, :3].T).astype(np.float32)
    return replace(mesh, vertices_mm=points.astype(np.float32), normals=normals)


def _round(radius: Radius) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=1.0)
    return trimesh.Trimesh(ball.vertices * radius(np.asarray(ball.vertices))[:, None], ball.faces, process=False)


def _ellipsoid(middle: Sequence[float], radii: Sequence[float]) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    return trimesh.Trimesh(ball.vertices * radii + middle, ball.faces, process=False)


def _box(middle: Sequence[float], size: Sequence[float], turn_deg: float = 0.0) -> trimesh.Trimesh:
    box = trimesh.creation.box(size)
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return trimesh.Trimesh(box.vertices @ turn.T + middle, box.faces)


def _post(middle: Sequence[float], radius: float, height: float, axis: Sequence[float] = (0, 0, 1)) -> trimesh.Trimesh:
    post = trimesh.creation.cylinder(radius, height, sections=96)
    turn = Rotation.align_vectors([axis], [[0, 0, 1]])[0].as_matrix()
    return trimesh.Trimesh(post.vertices @ turn.T + middle, post.faces)


def _together(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, counts, strict=True)])
    return trimesh.Trimesh(vertices, faces, process=False)


def figure() -> trimesh.Trimesh:
    """A seated figure: body, head with a nose and two ears, an arm and a plinth."""
    return _together([
        _ellipsoid((0, 0, -8), (24, 20, 28)), _ellipsoid((3, -2, 28), (15, 17, 16)),
        _ellipsoid((4, -19, 27), (4, 6, 5)), _ellipsoid((-8, -6, 40), (4, 5, 6)), _ellipsoid((15, -3, 39), (3, 4, 5)),
        _ellipsoid((22, -6, -4), (6, 9, 16)), _ellipsoid((-20, -12, -14), (7, 12, 7)), _box((0, 0, -34), (60, 50, 12)),
    ])  # fmt: skip


def flange() -> trimesh.Trimesh:
    """A mechanical part with a pattern that repeats: six bolt heads on a disc, a hub and one key."""
    around = np.deg2rad(60.0 * np.arange(6))
    bolts = [_post((27 * np.cos(a), 27 * np.sin(a), 4), 5, 14) for a in around]
    ribs = [_box((20 * np.cos(a), 20 * np.sin(a), 8), (14, 3, 12), np.rad2deg(a)) for a in around[[0, 1, 3]]]
    rim = [_box((36 * np.cos(a), 36 * np.sin(a), 0), (8, 9 + 4 * k, 6), np.rad2deg(a))
           for k, a in enumerate(np.deg2rad([20, 75, 165, 230, 290]))]  # fmt: skip
    return _together([_post((0, 0, 0), 36, 10), _post((0, 0, 14), 12, 22), *bolts, *ribs, *rim])


def bossed_box() -> trimesh.Trimesh:
    """A box with a round boss, a step and a rib where they are of use to somebody."""
    return _together([
        _box((0, 0, 0), (60, 44, 36)), _post((12, 6, 20), 9, 14), _box((-20, -8, 20), (10, 20, 8)),
        _post((-14, -23, 2), 7, 8, (0, 1, 0)), _box((16, 23, -6), (24, 6, 8)), _box((31, -8, 4), (6, 12, 20)),
        _post((-31, 10, -4), 6, 8, (1, 0, 0)),
    ])  # fmt: skip


OBJECTS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "bumpy ball": lambda: star(34.0),
    "figure": figure,
    "vase": lambda: _round(vase),
    "flange": flange,
    "bossed box": bossed_box,
}
SYMMETRIC = "vase"
