"""Where a surface is open: the borders of its holes, and of itself where it does not close."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from slrig.meshing.adjacency import neighbours
from slrig.model import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class OpenBorders:
    """Each border, longest first: length_mm, area_mm2 (n,) float64. edges : of all of them.

    The area is that of the loop's shadow where it is largest, |½ Σ p × q| over its edges: a flat hole's own, and less
    than what it takes to fill one that is not flat. Loops that meet in a vertex count as one.
    """

    edges: int
    length_mm: FloatArray
    area_mm2: FloatArray


def open_borders(points_mm: NDArray[np.floating[Any]], faces: IntArray) -> OpenBorders:
    """Of a mesh: points (n, 3), faces (F, 3). Raises ValueError: it is no manifold (`neighbours`)."""
    face, corner = np.divmod(np.flatnonzero(neighbours(faces, vertex_count=len(points_mm)) < 0), 3)
    if not len(face):
        return OpenBorders(0, np.zeros(0), np.zeros(0))
    begin, end = faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
    graph = coo_matrix((np.ones(len(begin)), (begin, end)), shape=(len(points_mm),) * 2)
    loop = np.unique(connected_components(graph, directed=False)[1][begin], return_inverse=True)[1].ravel()
    # Near the origin, so that large coordinates do not cancel: a closed loop's sum does not depend on it.
    points = points_mm.astype(np.float64) - points_mm[begin].mean(axis=0, dtype=np.float64)
    across = np.cross(points[begin], points[end]) / 2
    area = np.linalg.norm(np.stack([np.bincount(loop, across[:, axis]) for axis in range(3)]), axis=0)
    length = np.bincount(loop, np.linalg.norm(points[end] - points[begin], axis=1)).astype(np.float64)
    order = np.argsort(-length, kind="stable")
    return OpenBorders(len(begin), length[order], area[order])
