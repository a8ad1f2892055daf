"""The initial mesh: a strip of triangles between each two neighbouring curves (Yang & Chen 2010, section 3.2).

`strips` gives exactly I + J - 2 triangles for curves of I and J points. What does not belong to the surface is taken
away by a second, recorded step: triangles across a depth edge and, on request, triangles that use a bridge.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.flips import prefers_flip
from slrig.model import FloatArray, IntArray


def strips(points_mm: FloatArray, runs: IntArray, /) -> IntArray:
    """Triangulate between the parts of two curves each.

    points_mm : (n, 3) float64, in curve order; runs : (s, 4) int32, the first and last point of both parts, those of
    the second behind those of the first; see `slrig.meshing.runs`. A step of a curve is in one strip on either side.
    Returns (Σ(I + J - 2), 3) int32. Seen with curves running down and following one another to the right, triangles
    run counter-clockwise.
    """
    firsts = _firsts(runs)
    faces = np.zeros((int(firsts[-1]), 3), dtype=np.int32)
    in_bands(_strips_kernel, len(runs), np.ascontiguousarray(points_mm), runs, firsts, faces)
    return faces


def strip_neighbours(faces: IntArray, runs: IntArray, point_count: int, /) -> IntArray:
    """What `neighbours` finds for the faces that `strips` made of these runs, in a fraction of its time.

    Triangles of a strip follow one another; two strips meet in the steps of the curve that they share.
    Returns (F, 3) int32: entry k is the face across the edge opposite corner k, -1 at a boundary.
    """
    after_first, after_second = np.full((2, point_count), -1, dtype=np.int32)
    across = np.zeros(faces.shape, dtype=np.int32)
    given = faces, runs, _firsts(runs), after_first, after_second
    in_bands(_note_steps, len(runs), *given)
    in_bands(_strip_neighbours, len(runs), *given, across)
    return across


def to_drop(
    points_mm: FloatArray,
    faces: IntArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    /,
    *,
    depth_edge_ratio: float,
    keep_holes: bool,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The triangles that cross a depth edge, and those that use a bridge: (F,) bool each. A triangle may do both.

    sampling_mm : (n,) float64, the distance at which the rig samples a surface that faces it, at each point.
    A triangle with an edge longer than depth_edge_ratio times that crosses a depth edge. Bridges count with keep_holes.
    """
    depth_edge = np.zeros(len(faces), dtype=np.bool_)
    bridge = np.zeros(len(faces), dtype=np.bool_)
    in_bands(
        _to_drop, len(faces), np.ascontiguousarray(points_mm), np.ascontiguousarray(faces), bridge_after, sampling_mm,
        depth_edge_ratio, keep_holes, depth_edge, bridge,
    )  # fmt: skip
    return depth_edge, bridge


def _firsts(runs: IntArray) -> NDArray[np.int64]:
    """(s + 1,) int64: where each strip's triangles begin."""
    counts = runs[:, 1] - runs[:, 0] + runs[:, 3] - runs[:, 2]
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@kernel
def _strips_kernel(begin: int, end: int, points: Any, runs: Any, firsts: Any, faces: Any) -> None:
    for s in range(begin, end):
        # Of one type from the start, so that the rule is compiled once.
        i, last_i = np.int64(runs[s, 0]), runs[s, 1]
        j, last_j = np.int64(runs[s, 2]), runs[s, 3]
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


@kernel
def _note_steps(begin: int, end: int, faces: Any, runs: Any, firsts: Any, after_first: Any, after_second: Any) -> None:
    """Note who stands on each step, as a strip's first curve and as its second: a curve is either at most once."""
    for s in range(begin, end):
        last_of_first = runs[s, 1]
        for face in range(firsts[s], firsts[s + 1]):
            if faces[face, 1] <= last_of_first:
                after_first[faces[face, 0]] = face
            else:
                after_second[faces[face, 2]] = face


@kernel
def _strip_neighbours(
    begin: int, end: int, faces: Any, runs: Any, firsts: Any, after_first: Any, after_second: Any, across: Any
) -> None:
    for s in range(begin, end):
        last_of_first = runs[s, 1]
        for face in range(firsts[s], firsts[s + 1]):
            before = face - 1 if face > firsts[s] else -1
            after = face + 1 if face + 1 < firsts[s + 1] else -1
            if faces[face, 1] <= last_of_first:
                # (i, i + 1, j): the step lies opposite j, the next triangle opposite i, the one before opposite i + 1.
                across[face, 0], across[face, 1], across[face, 2] = after, before, after_second[faces[face, 0]]
            else:
                # (i, j + 1, j): the step lies opposite i.
                across[face, 0], across[face, 1], across[face, 2] = after_first[faces[face, 2]], before, after


@kernel
def _to_drop(
    first: int, last: int, points: Any, faces: Any, bridge_after: Any, sampling: Any, ratio: float,
    keep_holes: bool, depth_edge: Any, bridge: Any,
) -> None:  # fmt: skip
    for face in range(first, last):
        longest, allowed, over = 0.0, 0.0, False
        for corner in range(3):
            a, b = faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]
            x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
            square = x * x + y * y + z * z
            # Not "square > longest": an unmeasured corner is longer than anything.
            if not square <= longest:
                longest = square if square > longest else np.inf
            allowed += sampling[a]
            over |= abs(a - b) == 1 and bridge_after[min(a, b)]
        depth_edge[face] = not math.sqrt(longest) <= ratio * (allowed / 3.0)
        bridge[face] = keep_holes and over
