"""The figures of one mesh, found in the same way for every method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import BundleTruth
from slrig.meshing.quality import TruthScore, mesh_figures, score
from slrig.model import FloatArray, IntArray, Mesh, Surface

_FOLD_DEG = 60.0


@dataclass(frozen=True, slots=True)
class Figures:
    """Shape and error of a mesh; `min_angle_deg` are its 1st, 5th and 50th percentile by area."""

    triangles: int
    min_angle_deg: tuple[float, float, float]
    folds: int
    nonmanifold_edges: int
    error: TruthScore


def figures_of(surface: Surface, truth: BundleTruth, eye_mm: FloatArray) -> Figures:
    """Score a mesh against the rendered surface; `eye_mm` (3,) is the first camera's centre."""
    mesh = _bare(surface)
    shape = mesh_figures(mesh.vertices_mm, mesh.faces)
    error = score(mesh, truth.surface, truth.visible_points_mm, eye_mm)
    return Figures(
        triangles=len(mesh.faces),
        min_angle_deg=(
            float(shape["min_angle_p1_deg"]), float(shape["min_angle_p5_deg"]), float(shape["min_angle_p50_deg"])
        ),
        folds=fold_count(surface.vertices_mm, mesh.faces),
        nonmanifold_edges=error.nonmanifold_edges,
        error=error,
    )  # fmt: skip


def fold_count(vertices_mm: FloatArray, faces: IntArray) -> int:
    """Number of edges of exactly two triangles at which the surface bends by more than 60 degrees.

    The bend is that between one triangle and the other's continuation, which needs no winding: with the foot of each
    triangle's third corner on the edge, 180° less the angle between the two perpendiculars.
    """
    sides, opposite = _sides(faces)
    _, count = np.unique(sides, axis=0, return_counts=True)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    starts = np.cumsum(count) - count
    interior = starts[count == 2]
    one, other = order[interior], order[interior + 1]
    start_mm = vertices_mm[sides[one, 0]]
    along = vertices_mm[sides[one, 1]] - start_mm
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    up, down = (_perpendicular(vertices_mm[opposite[side]] - start_mm, along) for side in (one, other))
    lengths = np.linalg.norm(up, axis=1) * np.linalg.norm(down, axis=1)
    cosine = -np.einsum("ij,ij->i", up, down)
    return int(((lengths > 0) & (cosine < np.cos(np.radians(_FOLD_DEG)) * lengths)).sum())


def _sides(faces: IntArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(3F, 2) the sides of the triangles, smaller vertex first; (3F,) the vertex opposite each."""
    sides = np.concatenate((faces[:, (0, 1)], faces[:, (1, 2)], faces[:, (2, 0)]))
    opposite = np.concatenate((faces[:, 2], faces[:, 0], faces[:, 1]))
    return np.sort(sides, axis=1), opposite


def _perpendicular(vectors: FloatArray, unit: FloatArray) -> FloatArray:
    return np.asarray(vectors - np.einsum("ij,ij->i", vectors, unit)[:, None] * unit)


def _bare(surface: Surface) -> Mesh:
    """Return the surface as a mesh that states no normals and no uncertainty."""
    count = len(surface.vertices_mm)
    return Mesh(
        vertices_mm=surface.vertices_mm.astype(np.float32),
        faces=np.ascontiguousarray(surface.faces, dtype=np.int32),
        normals=np.full((count, 3), np.nan, dtype=np.float32),
        colour=np.zeros((count, 3), dtype=np.uint8),
        mark=np.zeros(count, dtype=np.uint8),
        sigma_mm=np.full(count, np.nan, dtype=np.float32),
        stripe=np.zeros(count, dtype=np.int32),
    )
