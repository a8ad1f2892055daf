"""The initial mesh: a strip of triangles between each two neighbouring curves (Yang & Chen 2010, section 3.2).

`strips` gives exactly I + J - 2 triangles for curves of I and J points. What does not belong to the surface is taken
away by a second, recorded step: triangles across a depth edge and, on request, triangles that use a bridge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.meshing.flips import prefers_flip
from slrig.model import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class DroppedTriangles:
    """Which triangles go, and why: (F,) bool each; a triangle may have both causes."""

    depth_edge: NDArray[np.bool_]
    bridge: NDArray[np.bool_]

    @property
    def any(self) -> NDArray[np.bool_]:
        """(F,) bool: dropped for either cause."""
        return self.depth_edge | self.bridge


def neighbouring_curves(position_px: FloatArray, offsets: IntArray, /, *, widest_step_px: float) -> IntArray:
    """(s, 2) int32: pairs of consecutive curves, neither empty, at most `widest_step_px` columns apart."""
    filled = np.flatnonzero(np.diff(offsets) > 0)
    near = np.diff(position_px[filled]) <= widest_step_px + 1e-9
    return np.stack([filled[:-1][near], filled[1:][near]], axis=1).astype(np.int32)


def strips(points_mm: FloatArray, offsets: IntArray, pairs: IntArray, /) -> IntArray:
    """Triangulate between each pair of curves.

    points_mm : (n, 3) float64, in curve order; offsets : (c + 1,) int32; pairs : (s, 2) int32.
    Returns (Σ(I + J - 2), 3) int32. Seen with curves running down and following one another to the right, triangles
    run counter-clockwise.
    """
    lengths = np.diff(offsets)
    counts = lengths[pairs[:, 0]] + lengths[pairs[:, 1]] - 2
    firsts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    faces = np.zeros((int(firsts[-1]), 3), dtype=np.int32)
    _strips_kernel(np.ascontiguousarray(points_mm), offsets, pairs, firsts, faces)
    return faces


def to_drop(
    points_mm: FloatArray,
    faces: IntArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    /,
    *,
    depth_edge_ratio: float,
    keep_holes: bool,
) -> DroppedTriangles:
    """Find the triangles that do not belong to the surface.

    sampling_mm : (n,) float64, the distance at which the rig samples a surface that faces it, at each point.
    A triangle with an edge longer than depth_edge_ratio times that crosses a depth edge. With keep_holes, a triangle
    that uses the step over a bridge goes too.
    """
    corners = points_mm[faces]
    longest = np.sqrt(np.max(np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=2), axis=1))
    allowed = depth_edge_ratio * sampling_mm[faces].mean(axis=1)
    rolled = np.roll(faces, -1, axis=1)
    step = np.abs(faces - rolled) == 1
    over_bridge = (step & bridge_after[np.minimum(faces, rolled)]).any(axis=1)
    return DroppedTriangles(
        # Not "longest > allowed": a triangle with an unmeasured corner goes too.
        depth_edge=~(longest <= allowed),
        bridge=over_bridge if keep_holes else np.zeros(len(faces), dtype=bool),
    )


@njit(cache=True, nogil=True, parallel=True)
def _strips_kernel(points: Any, offsets: Any, pairs: Any, firsts: Any, faces: Any) -> None:
    for s in prange(len(pairs)):
        i, last_i = offsets[pairs[s, 0]], offsets[pairs[s, 0] + 1] - 1
        j, last_j = offsets[pairs[s, 1]], offsets[pairs[s, 1] + 1] - 1
        at = firsts[s]
        while i < last_i or j < last_j:
            if i == last_i:
                first_moves = False
            elif j == last_j:
                first_moves = True
            else:
                first_moves = prefers_flip(points, i, j + 1, j, i + 1)
            faces[at, 0] = i
            if first_moves:
                faces[at, 1] = i + 1
                faces[at, 2] = j
                i += 1
            else:
                faces[at, 1] = j + 1
                faces[at, 2] = j
                j += 1
            at += 1
