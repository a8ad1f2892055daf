"""Tessellation of shapes: triangles in the shape's own frame, within FACET_ERROR_MM of the exact surface.

Triangles are counter-clockwise seen from outside (from -z for open shapes).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from slrig.errors import ConfigError
from slrig.kernels import kernel
from slrig.model import FloatArray, IntArray

FACET_ERROR_MM = 0.003
"""Largest distance between a facet and the exact surface of spheres and rods. Reliefs and vessels are as fine as their
`step_mm`; their triangles are the truth."""


@dataclass(frozen=True, slots=True)
class MeshPart:
    """One primitive in its object's frame.

    vertices_mm : (V, 3) float64; faces : (F, 3) int32; corner_normals : (F, 3, 3) float64, unit.
    sphere_mm : centre and radius of the exact ball, or zeros.
    """

    vertices_mm: FloatArray
    faces: IntArray
    corner_normals: FloatArray
    sphere_mm: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


def rectangle(width_mm: float, height_mm: float) -> MeshPart:
    """Flat rectangle in x and y, centred on the origin, that faces -z."""
    reach = np.array([width_mm, height_mm]) / 2
    return rectangle_between(-reach, reach)


def rectangle_between(least_mm: FloatArray, most_mm: FloatArray) -> MeshPart:
    """Flat rectangle that faces -z between two corners (x, y)."""
    (left, top), (right, bottom) = least_mm, most_mm
    vertices = np.array([(left, top, 0), (right, top, 0), (right, bottom, 0), (left, bottom, 0)], np.float64)
    return _flat_part(vertices, np.array([(0, 2, 1), (0, 3, 2)], np.int32))


def bent_sheet(across_mm: tuple[float, float], down_mm: tuple[float, float], curvature_per_mm: float) -> MeshPart:
    """Sheet z = curvature x² that faces -z, in strips narrow enough for FACET_ERROR_MM / 30."""
    # A chord of a parabola over a strip of width w sags by curvature w² / 4.
    width = np.sqrt(4 * FACET_ERROR_MM / 30 / abs(curvature_per_mm))
    count = int(np.ceil((across_mm[1] - across_mm[0]) / width)) + 1
    x = np.linspace(*across_mm, count)
    z = curvature_per_mm * x**2
    vertices = np.concatenate([np.column_stack([x, np.full(count, y), z]) for y in down_mm])
    return _smooth_part(vertices, _grid_faces(2, count, closed=False), crease_rad=np.pi)


def ball(radius_mm: float, *, centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> MeshPart:
    """Icosphere whose facet centres are at most FACET_ERROR_MM inside the sphere."""
    # The icosahedron's edge is 1.05 radii and halves with each subdivision, though the longest stay up to 1.24 times
    # that; the middle of an equilateral triangle of edge e (circumradius e/√3) sags by e²/(6 r).
    level = int(np.ceil(np.log2(1.3 * np.sqrt(radius_mm / (6 * FACET_ERROR_MM)))))
    mesh = trimesh.creation.icosphere(subdivisions=min(max(level, 2), 8), radius=radius_mm)
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    normals = vertices[faces] / np.linalg.norm(vertices[faces], axis=2, keepdims=True)
    return MeshPart(vertices + np.array(centre_mm), faces, normals, (*centre_mm, radius_mm))


def rod(radius_mm: float, length_mm: float) -> MeshPart:
    """Wall of a cylinder along x, open at both ends."""
    count = int(np.ceil(np.pi / np.arccos(max(1 - FACET_ERROR_MM / radius_mm, 0.0)))) + 3
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = np.column_stack([np.zeros(count), radius_mm * np.cos(turn), radius_mm * np.sin(turn)])
    ends = np.array([length_mm / 2, 0.0, 0.0])
    vertices = np.concatenate([ring - ends, ring + ends])
    here = np.arange(count)
    after = (here + 1) % count
    faces = np.concatenate(
        [np.column_stack([here, after, after + count]), np.column_stack([here, after + count, here + count])]
    ).astype(np.int32)
    radial = np.concatenate([ring, ring]) / radius_mm
    return MeshPart(vertices, faces, radial[faces])


def staircase(steps: int, tread_mm: float, rise_mm: float, height_mm: float) -> MeshPart:
    """Treads facing -z and risers facing -x, centred on the origin; each step is nearer than its left neighbour."""
    x = (np.repeat(np.arange(steps + 1), 2)[1:-1] - steps / 2) * tread_mm
    z = -(np.repeat(np.arange(steps), 2) - (steps - 1) / 2) * rise_mm
    count = len(x)
    top, bottom = np.full(count, -height_mm / 2), np.full(count, height_mm / 2)
    vertices = np.concatenate([np.column_stack([x, top, z]), np.column_stack([x, bottom, z])])
    here = np.arange(count - 1)
    faces = np.concatenate(
        [
            np.column_stack([here, here + 1 + count, here + 1]),
            np.column_stack([here, here + count, here + 1 + count]),
        ]
    ).astype(np.int32)
    return _flat_part(vertices, faces)


def groove(opening_rad: float, wall_mm: float, length_mm: float) -> MeshPart:
    """Two walls that meet along y and open towards -z with this angle between them."""
    across, towards = wall_mm * np.sin(opening_rad / 2), -wall_mm * np.cos(opening_rad / 2)
    profile = np.array([(-across, towards), (0.0, 0.0), (across, towards)])
    vertices = np.concatenate(
        [np.column_stack([profile[:, 0], np.full(3, y), profile[:, 1]]) for y in (-length_mm / 2, length_mm / 2)]
    )
    return _flat_part(vertices, _grid_faces(2, 3, closed=False))


def bowl(radius_mm: float, half_angle_rad: float, step_mm: float) -> MeshPart:
    """Inside of a spherical cap about z that opens towards -z, its lowest point at the origin.

    A square grid is bent: a distance from the middle of the square becomes an angle from the axis. Normals are exact.
    """
    count = 2 * int(np.ceil(radius_mm * half_angle_rad / step_mm)) + 1
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    # Squares about the middle become circles: of each, the distance is the larger coordinate.
    angle = half_angle_rad * np.maximum(np.abs(x), np.abs(y))
    length = np.maximum(np.hypot(x, y), 1e-300)
    outwards = np.stack([x / length * np.sin(angle), y / length * np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 3)
    faces = _grid_faces(count, count, closed=False)
    return MeshPart(radius_mm * (outwards - (0.0, 0.0, 1.0)), faces, -outwards[faces])


def height_field(
    size_mm: tuple[float, float], step_mm: float, height_mm: Callable[[FloatArray, FloatArray], FloatArray]
) -> MeshPart:
    """Rectangle sampled every `step_mm` (or slightly finer) and raised towards -z."""
    columns, rows = (max(int(np.ceil(extent / step_mm)), 1) + 1 for extent in size_mm)
    x, y = np.meshgrid(
        np.linspace(-size_mm[0] / 2, size_mm[0] / 2, columns), np.linspace(-size_mm[1] / 2, size_mm[1] / 2, rows)
    )
    vertices = np.stack([x, y, -height_mm(x, y)], axis=-1).reshape(-1, 3)
    return _smooth_part(vertices, _grid_faces(rows, columns, closed=False), crease_rad=np.pi)


def vessel(profile_mm: FloatArray, flutes: int, flute_depth_mm: float, twist_rad: float, step_mm: float) -> MeshPart:
    """Wall of a vessel about the y axis: radius by a cubic spline through (radius, height), with flutes."""
    radius, height = profile_mm.T
    curve = CubicSpline(height, radius)
    rows = max(int(np.ceil((height[-1] - height[0]) / step_mm)), 2) + 1
    columns = max(int(np.ceil(2 * np.pi * radius.max() / step_mm)), 12)
    h, turn = np.meshgrid(
        np.linspace(height[0], height[-1], rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    twist = twist_rad * (h - height[0]) / (height[-1] - height[0])
    r = curve(h) + flute_depth_mm * np.cos(flutes * (turn - twist))
    vertices = np.stack([r * np.sin(turn), -h, -r * np.cos(turn)], axis=-1).reshape(-1, 3)
    return _smooth_part(vertices, _grid_faces(rows, columns, closed=True)[:, ::-1].copy(), crease_rad=np.pi)


def mesh_file(path: Path, unit_mm: float, *, crease_rad: float) -> MeshPart:
    """Read the triangles of an STL, PLY, OBJ or GLB file, scaled by `unit_mm`. Raises ConfigError."""
    if not path.is_file():
        message = f"mesh file {path}: not found; paths are relative to the folder of the scene file"
        raise ConfigError(message)
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # each format's reader fails in its own way
        message = f"mesh file {path}: cannot be read as {path.suffix or 'a mesh'}: {error}; use STL, PLY, OBJ or GLB"
        raise ConfigError(message) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        message = f"mesh file {path}: expected triangles, found none; use a triangle mesh in STL, PLY, OBJ or GLB"
        raise ConfigError(message)
    vertices = np.asarray(mesh.vertices, np.float64) * unit_mm
    if not np.isfinite(vertices).all():
        message = f"mesh file {path}: some vertices are not finite; repair the mesh"
        raise ConfigError(message)
    return _smooth_part(vertices, np.asarray(mesh.faces, np.int32), crease_rad=crease_rad)


def _grid_faces(rows: int, columns: int, *, closed: bool) -> IntArray:
    """Two triangles per cell of a grid, facing -z when x grows with the column and y with the row."""
    across = columns if closed else columns - 1
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(across), indexing="ij")
    a = (row * columns + column).ravel()
    b = (row * columns + (column + 1) % columns).ravel()
    c, d = a + columns, b + columns
    return np.concatenate([np.column_stack([a, d, b]), np.column_stack([a, c, d])]).astype(np.int32)


def _face_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(F, 3): unit normal times twice the area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def _normalise(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0), dtype=np.float64)


def _flat_part(vertices: FloatArray, faces: IntArray) -> MeshPart:
    normals = _normalise(_face_normals(vertices, faces))
    return MeshPart(vertices, faces, np.repeat(normals[:, None], 3, axis=1))


def _smooth_part(vertices: FloatArray, faces: IntArray, *, crease_rad: float) -> MeshPart:
    """Smooth corner normals: area-weighted mean over the faces at the vertex that bend less than a crease."""
    weighted = _face_normals(vertices, faces)
    corners = np.argsort(faces, axis=None, kind="stable")
    first = np.searchsorted(faces.ravel()[corners], np.arange(len(vertices) + 1))
    normals = _corner_normals(
        np.ascontiguousarray(faces),
        first,
        corners // 3,
        weighted,
        _normalise(weighted),
        float(np.cos(crease_rad)) - 1e-12,
    )
    return MeshPart(vertices, faces, normals)


@kernel(in_every_scan=False)
def _corner_normals(
    faces: IntArray,
    first: NDArray[np.int64],
    around: NDArray[np.int64],
    weighted: FloatArray,
    unit: FloatArray,
    cos_crease: float,
) -> FloatArray:
    """(F, 3, 3) float64, unit. Vertex v belongs to the faces around[first[v]:first[v + 1]]."""
    out = np.zeros((len(faces), 3, 3))
    for face in range(len(faces)):
        n = unit[face]
        for corner in range(3):
            vertex = faces[face, corner]
            x, y, z = 0.0, 0.0, 0.0
            for k in range(first[vertex], first[vertex + 1]):
                m = around[k]
                if n[0] * unit[m, 0] + n[1] * unit[m, 1] + n[2] * unit[m, 2] >= cos_crease:
                    x, y, z = x + weighted[m, 0], y + weighted[m, 1], z + weighted[m, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                out[face, corner, 0], out[face, corner, 1], out[face, corner, 2] = x / length, y / length, z / length
            else:
                out[face, corner] = n
    return out
