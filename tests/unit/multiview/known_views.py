"""Views of surfaces that are known, made without anything of the method: rays, a grid of hits, noise, triangles.

Each view sees the object in perspective from its own side. Its frame is turned against the model's, and its pose is
exact. σ rises with the angle of incidence, and a slow error is common to neighbouring points, another one in each view.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from simulated_rig.transport import build_caster
from slrig.meshing.surface import vertex_normals
from slrig.meshing.topology import used_vertices
from slrig.model import FloatArray, Mesh
from tests.unit.meshing.plain import grid_faces

DISTANCE_MM = 400.0
_DEPTH_STEP = 6.0  # an edge longer than so many pixels joins a front to what is behind it
_STEEPEST = 0.2  # cosine of incidence: flatter surface gives no point


class Noise(NamedTuple):
    """sigma_mm : of a point seen straight on; slow_mm : rms of the error that neighbours have in common."""

    sigma_mm: float = 0.010
    slow_mm: float = 0.004
    slow_length_mm: float = 15.0


USUAL = Noise()


class View(NamedTuple):
    """A view, its pose, and what it saw without noise: points (n, 3) in the model's frame."""

    mesh: Mesh
    pose: FloatArray
    seen_mm: FloatArray


def star(radius_mm: float = 10.0, subdivisions: int = 6) -> trimesh.Trimesh:
    """A ball with bumps and hollows, fine enough that its own triangles do not show."""
    ball = trimesh.creation.icosphere(subdivisions, 1.0)
    u = ball.vertices
    bumps = 0.10 * np.sin(5 * u[:, 0] + 1) * np.cos(4 * u[:, 1]) + 0.06 * np.sin(9 * u[:, 2] + 2 * u[:, 0])
    return trimesh.Trimesh(radius_mm * u * (1 + bumps)[:, None], ball.faces, process=False)


def plate_on_box(thickness_mm: float = 0.8) -> trimesh.Trimesh:
    """A box with sharp edges that a thin plate stands on, in one piece."""
    outline = [(-8, -5), (8, -5), (8, 0), (thickness_mm, 0), (thickness_mm, 8), (0, 8), (0, 0), (-8, 0)]
    prism = trimesh.creation.extrude_triangulation(*_triangulated(np.array(outline, float)), 12.0)
    return trimesh.Trimesh(prism.vertices - (0, 0, 6), prism.faces)


def torus() -> trimesh.Trimesh:
    """A ring whose hole is seen through from some sides only."""
    return trimesh.creation.torus(8.0, 3.0, major_sections=300, minor_sections=150)


def around(count: int) -> FloatArray:
    """(count, 3) float64, unit: directions spread evenly over the sphere (Fibonacci)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def views_of(
    truth: trimesh.Trimesh,
    directions: FloatArray,
    pixel_mm: float,
    noise: Noise = USUAL,
    seed: int = 0,
) -> list[View]:
    """One view from each direction; pixel_mm is what a pixel spans at the object's middle."""
    random = np.random.default_rng(seed)
    return [_view(truth, direction, pixel_mm, noise, random) for direction in directions]


def _triangulated(outline: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    # Two boxes of the outline: the long one, and the plate on it.
    return outline, np.array([(0, 1, 2), (0, 2, 3), (0, 3, 6), (0, 6, 7), (6, 3, 4), (6, 4, 5)])


def _view(truth: trimesh.Trimesh, direction: FloatArray, pixel_mm: float, noise: Noise, random: Any) -> View:
    vertices, eye = np.asarray(truth.vertices, float), DISTANCE_MM * direction
    right = np.cross(direction, (0.3, 0.1, 1.0))
    right /= np.linalg.norm(right)
    half = np.ceil(np.linalg.norm(vertices, axis=1).max() * 1.05 / pixel_mm) * pixel_mm
    steps = np.arange(-half, half + pixel_mm / 2, pixel_mm)
    rays = (
        -eye
        + steps[:, None, None] * np.cross(direction, right)
        + (steps[None, :, None] + random.uniform(0, pixel_mm)) * right
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    faces = np.asarray(truth.faces, np.int32)
    hit = build_caster(vertices, faces).first_hit(eye, rays)
    normals = np.asarray(truth.face_normals)[hit]
    # Where the ray meets the plane of the triangle, in double precision.
    corner = vertices[faces[hit, 0]]
    points = eye + rays * (((corner - eye) * normals).sum(1) / (rays * normals).sum(1))[:, None]
    cosine = -(rays * normals).sum(1)
    found = (hit >= 0) & (cosine > _STEEPEST)
    points[~found] = np.nan
    sigma = noise.sigma_mm / np.sqrt(np.where(found, cosine, 1.0))
    off = sigma * random.normal(size=len(points)) + noise.slow_mm * _slow(points, noise.slow_length_mm, random)
    measured = points + off[:, None] * normals
    faces = _grid_faces(measured, len(steps), _DEPTH_STEP * pixel_mm)
    used = used_vertices(faces, len(points))
    numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
    turn = Rotation.random(rng=random).as_matrix()
    shift = random.uniform(-50, 50, 3)
    vertices = (measured[used] - shift) @ turn  # x_model = R x_view + t
    faces = numbers[faces]
    colour, mark = _painted(points[used], random)
    mesh = Mesh(
        vertices.astype(np.float32), faces, vertex_normals(vertices, faces), colour, mark,
        sigma[used].astype(np.float32), np.zeros(len(vertices), np.int32),
    )  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return View(mesh, pose, points[used])


def _slow(points: FloatArray, length_mm: float, random: Any) -> FloatArray:
    """(n,) float64: a smooth random field of rms 1, a sum of waves."""
    waves = random.normal(size=(24, 3)) / length_mm
    phases = random.uniform(0, 2 * np.pi, 24)
    return np.asarray(np.sqrt(2 / 24) * np.cos(np.nan_to_num(points) @ waves.T + phases).sum(axis=1))


def _grid_faces(points: FloatArray, columns: int, longest_mm: float) -> NDArray[np.int32]:
    faces = grid_faces(len(points) // columns, columns)
    edges = points[faces] - points[np.roll(faces, 1, axis=1)]
    # NaN is not below.
    return np.ascontiguousarray(faces[(np.linalg.norm(edges, axis=2) < longest_mm).all(axis=1)])


def _painted(points: FloatArray, random: Any) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Stripes of two colours, and here and there a saturated vertex that is white."""
    stripes = np.where((points[:, :1] % 4 < 2), (180, 60, 40), (40, 90, 160)).astype(np.uint8)
    saturated = random.uniform(size=len(points)) < 0.1
    stripes[saturated] = 255
    return stripes, saturated.astype(np.uint8)


def vase() -> trimesh.Trimesh:
    """A solid of revolution with a neck and a foot, 20 mm high."""
    z = np.linspace(-10, 10, 241)
    outer = 6.0 + 1.8 * np.sin(0.35 * z + 0.6) + 0.5 * np.sin(0.9 * z)
    return trimesh.creation.revolve(np.stack([[0.0, *outer, 0.0], [-10, *z, 10]], axis=1), sections=720)


def relief() -> trimesh.Trimesh:
    """A coin of 24 mm with letters' worth of soft and steep waves on both faces, 3 mm thick."""
    disc = trimesh.creation.revolve(
        np.stack([[*np.linspace(0, 12, 161), *np.linspace(12, 0, 161)], np.repeat([-1.5, 1.5], 161)], axis=1),
        sections=720,
    )
    vertices = np.array(disc.vertices)
    x, y = vertices[:, 0], vertices[:, 1]
    fade = np.clip((11.5 - np.hypot(x, y)) / 1.5, 0, 1)
    waves = 0.5 * np.tanh(2 * np.sin(1.1 * x + 0.4 * y)) + 0.25 * np.cos(0.9 * y - 0.5 * x)
    vertices[:, 2] += np.sign(vertices[:, 2]) * fade * waves
    return trimesh.Trimesh(vertices, disc.faces, process=False)


def flange() -> trimesh.Trimesh:
    """A mechanical part: a stepped flange with sharp edges and a bore."""
    corners = np.array([(3, -6), (10, -6), (10, -2), (6, -2), (6, 6), (3, 6), (3, -6)], float)
    return trimesh.creation.revolve(corners, sections=360)
