"""Meshes made and measured in plain numpy, for tests to compare with."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.meshing.surface import vertex_normals
from slrig.model import FloatArray, IntArray, Mesh


def boundary_edges(faces: IntArray) -> IntArray:
    """(B, 2): edges that only one triangle uses, in the direction in which it runs along them."""
    directed = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    _, which, uses = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(directed[uses[which] == 1])


def harmonic_indices(corners_mm: FloatArray) -> FloatArray:
    """(F,) float64: hrm = 4 (cot α + cot β + cot η) of each triangle, (F, 3, 3); infinite where it has no area.

    By the law of cosines this is (a² + b² + c²) / area, a, b, c the sides.
    """
    sides = corners_mm - np.roll(corners_mm, 1, axis=1)
    squares = np.einsum("ijk,ijk->i", sides, sides)
    area_mm2 = np.linalg.norm(np.cross(sides[:, 1], sides[:, 2]), axis=1) / 2
    return np.asarray(np.divide(squares, area_mm2, out=np.full(len(squares), np.inf), where=area_mm2 > 0))


def faces_of(*rows: tuple[int, int, int]) -> IntArray:
    return np.array(rows, dtype=np.int32).reshape(-1, 3)


def grid_faces(rows: int, columns: int) -> IntArray:
    """Two triangles a cell of a grid of vertices, counter-clockwise where columns run to the right and rows down."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = (index[s, t].ravel() for s in (np.s_[:-1], np.s_[1:]) for t in (np.s_[:-1], np.s_[1:]))
    return np.concatenate((np.stack((a, b, c), 1), np.stack((b, d, c), 1)))


def soup(seed: int, *, points: int = 700, faces: int = 5000) -> tuple[FloatArray, IntArray]:
    """Triangles between random points, three different ones each."""
    random = np.random.default_rng(seed)
    corners = np.stack([random.permutation(points)[:3] for _ in range(faces)])
    return random.normal(size=(points, 3)), corners.astype(np.int32)


def mesh_of(
    points_mm: NDArray[np.floating[Any]],
    faces: IntArray,
    *,
    sigma_mm: float | FloatArray = 0.02,
    normals: FloatArray | None = None,
    colour: int = 128,
    mark: int = 0,
) -> Mesh:
    """A mesh whose vertices are alike but for their places; normals : those of the faces if not given."""
    count = len(points_mm)
    return Mesh(
        vertices_mm=np.asarray(points_mm, dtype=np.float32),
        faces=faces,
        normals=vertex_normals(points_mm.astype(np.float64), faces)
        if normals is None
        else np.broadcast_to(normals, (count, 3)).astype(np.float32),
        colour=np.full((count, 3), colour, dtype=np.uint8),
        mark=np.full(count, mark, dtype=np.uint8),
        sigma_mm=np.broadcast_to(np.asarray(sigma_mm, dtype=np.float32), (count,)).copy(),
        stripe=np.zeros(count, dtype=np.int32),
    )


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes)])
    faces = [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=False)]
    names = [field.name for field in fields(Mesh) if field.name != "faces"]
    whole = {name: np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in names}
    return Mesh(faces=np.concatenate(faces), **whole)
