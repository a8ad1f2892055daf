"""Views of a known object on a turntable, made without any reconstruction: analytic surface, rays, noise, true poses.

A camera's rays meet the surface |x| = r(x / |x|); every view has a grid of its own on it, white noise along the normal
as `sigma_mm` states, and an error that varies slowly over the view, which nothing states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from slrig.meshing.surface import vertex_normals
from slrig.model import FloatArray, IntArray, Mesh
from slrig.multiview.turntable import turntable_poses
from tests.unit.meshing.plain import grid_faces, mesh_of

Radius = Callable[[FloatArray], FloatArray]
"""From unit directions (n, 3) to the distance of the surface from the object's middle, mm."""

AXIS = np.array([0.03, -0.94, -0.34]) / np.linalg.norm([0.03, -0.94, -0.34])
MIDDLE_MM = np.array([4.0, 5.0, 12.0])
"""Of the object as the first view sees it; the turntable's axis is `AXIS` through a point beside it."""
AXIS_POINT_MM = MIDDLE_MM + np.array([3.0, 40.0, -2.0])
_UP = Rotation.align_vectors([AXIS, [1.0, 0.0, 0.03]], [[0, 0, 1], [1, 0, 0]], weights=[1e6, 1])[0]
_DISTANCE_MM = 500.0


def bumpy(directions: FloatArray) -> FloatArray:
    """An ellipsoid of 60 x 72 x 88 mm with forty bumps and dents of up to 8 mm: no turn maps it on itself."""
    random = np.random.default_rng(11)
    peaks = random.normal(size=(40, 3))
    peaks /= np.linalg.norm(peaks, axis=1)[:, None]
    heights, sharpness = random.uniform(-4.0, 8.0, 40), random.uniform(15, 90, 40)
    plain = 1 / np.sqrt((directions**2 / np.array([30.0, 36.0, 44.0]) ** 2).sum(axis=1))
    return np.asarray(plain + np.exp(sharpness * (directions @ peaks.T - 1)) @ heights)


def vase(directions: FloatArray) -> FloatArray:
    """Rotationally symmetric about z, with a wavy profile."""
    z = directions[:, 2]
    return np.asarray(1 / np.sqrt((1 - z**2) / 28.0**2 + z**2 / 46.0**2) + 2.0 * np.sin(7 * z))


@dataclass(frozen=True, slots=True)
class Turned:
    """Views without an error, each in the frame of its camera; poses (4, 4) take them into that of the first."""

    exact: list[Mesh]
    poses: list[FloatArray]

    def noisy(self, seed: int, *, slow_mm: float = 0.004, length_mm: float = 4.0) -> list[Mesh]:
        """The views as measured: white noise of the stated deviation and an error that nothing states, of deviation
        `slow_mm` and correlation exp(-d² / 2 l²) at distance d, both along the normal.
        """
        random = np.random.default_rng(seed)
        views = []
        for view in self.exact:
            waves = random.normal(size=(3, 80)) / length_mm
            phases = random.uniform(0, 2 * np.pi, 80)
            slow = slow_mm * np.sqrt(2 / 80) * np.cos(view.vertices_mm @ waves + phases).sum(axis=1)
            along = slow + view.sigma_mm * random.normal(size=len(slow))
            points = view.vertices_mm + view.normals * along[:, None]
            normals = vertex_normals(points, view.faces)
            views.append(replace(view, vertices_mm=points.astype(np.float32), normals=normals))
        return views


def seen(radius: Radius, angles_deg: Sequence[float], *, pitch_mm: float = 0.5, noise_mm: float = 0.008) -> Turned:
    """What a camera sees of an object that stands on a turntable, at each of its angles.

    noise_mm : stated deviation of a vertex that is seen head on; twice that at 60°.
    """
    random = np.random.default_rng(5)
    poses = turntable_poses(AXIS_POINT_MM, AXIS, np.deg2rad(angles_deg))
    ball = trimesh.creation.icosphere(subdivisions=6, radius=1.0)
    shape = ball.vertices * radius(np.asarray(ball.vertices))[:, None]
    views = []
    for pose in poses:
        turn = pose[:3, :3].T @ _UP.as_matrix()
        middle = pose[:3, :3].T @ (MIDDLE_MM - pose[:3, 3])
        hull = trimesh.Trimesh(shape @ turn.T + middle, ball.faces, process=False)
        views.append(_view(radius, hull, turn, middle, pitch_mm, noise_mm, random.uniform(0, pitch_mm, 2)))
    return Turned(views, list(poses))


def plane(tilts_deg: Sequence[float]) -> Turned:
    """A flat plate of 60 x 60 mm before the camera, tilted about the x axis: its middle stays."""
    rows, columns = np.meshgrid(np.arange(-30, 30.5), np.arange(-30, 30.5), indexing="ij")
    flat = np.stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)], axis=1)
    poses = turntable_poses(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.deg2rad(tilts_deg))
    views = []
    for pose in poses:
        points = flat @ pose[:3, :3]
        faces = _triangles(points, rows.shape, 4.0)
        views.append(mesh_of(points, faces, sigma_mm=0.01))
    return Turned(views, list(poses))


def _view(
    radius: Radius,
    hull: trimesh.Trimesh,
    turn: FloatArray,
    middle: FloatArray,
    pitch_mm: float,
    noise_mm: float,
    offset_mm: FloatArray,
) -> Mesh:
    """The camera stands at z = -`_DISTANCE_MM` and looks along z."""
    reach = np.arange(-60, 60, pitch_mm)
    columns, rows = np.meshgrid(reach + offset_mm[0], reach + offset_mm[1])
    eye = np.array([0.0, 0.0, -_DISTANCE_MM])
    target = np.stack([columns.ravel() + middle[0], rows.ravel() + middle[1], np.full(columns.size, middle[2])], 1)
    ways = (target - eye) / np.linalg.norm(target - eye, axis=1)[:, None]
    hits, rays, _ = hull.ray.intersects_location(np.broadcast_to(eye, ways.shape), ways, multiple_hits=False)
    along = np.full(len(ways), np.nan)
    along[rays] = np.linalg.norm(hits - eye, axis=1)

    def height(t: FloatArray) -> FloatArray:
        at = (eye + ways * t[:, None] - middle) @ turn
        distance = np.linalg.norm(at, axis=1)
        return np.asarray(distance - radius(at / distance[:, None]))

    for _ in range(4):  # Newton with a numerical slope: from the hull's facets to the surface
        now = height(along)
        along = along - now / ((height(along + 1e-4) - now) / 1e-4)
    points = eye + ways * along[:, None]
    faces = _triangles(points, columns.shape, 4 * pitch_mm)
    used = np.unique(faces)
    number = np.full(len(points), -1, dtype=np.int32)
    number[used] = np.arange(len(used))
    points, faces = points[used], number[faces]
    sigma = noise_mm / np.maximum(np.abs((vertex_normals(points, faces) * ways[used]).sum(axis=1)), 0.15)
    return mesh_of(points, faces, sigma_mm=sigma)


def _triangles(points: FloatArray, shape: tuple[int, int], longest_mm: float) -> IntArray:
    """Two triangles for each cell of the grid, wound to be seen from -z, without those that span a step in depth."""
    faces = grid_faces(*shape)[:, ::-1]
    edges = np.stack([np.linalg.norm(points[faces[:, k]] - points[faces[:, k - 1]], axis=1) for k in range(3)])
    return np.ascontiguousarray(faces[(edges < longest_mm).all(axis=0)])


def displacement_mm(view: Mesh, pose: FloatArray, true: FloatArray) -> float:
    """Rms distance of a view's vertices from where they belong."""
    apart = (pose - true)[:3]
    return float(np.sqrt(((view.vertices_mm @ apart[:, :3].T + apart[:, 3]) ** 2).sum(axis=1).mean()))


def off_surface_mm(radius: Radius, mesh: Mesh) -> FloatArray:
    """(n,): how far the vertices of a mesh in the first view's frame lie from the surface, along the normal."""
    at = (mesh.vertices_mm.astype(np.float64) - MIDDLE_MM) @ _UP.as_matrix()
    distance = np.linalg.norm(at, axis=1)
    outwards = at / distance[:, None]
    slope = (mesh.normals @ _UP.as_matrix() * outwards).sum(axis=1)
    return np.asarray((distance - radius(outwards)) * np.abs(slope))


def wrong_axis(angles_deg: Sequence[float]) -> list[FloatArray]:
    """Starts by an axis that is 0.5° and 1 mm wrong, and a stage that is 0.05° wrong."""
    random = np.random.default_rng(3)
    off = Rotation.from_rotvec(np.deg2rad(0.5) * np.cross(AXIS, [0.6, 0.0, 0.8]))
    angles = np.asarray(angles_deg) + np.append(0.0, random.normal(0, 0.05, len(angles_deg) - 1))
    point = AXIS_POINT_MM + np.array([0.7, 0.2, -0.68])
    return list(turntable_poses(point, off.apply(AXIS), np.deg2rad(angles)))
