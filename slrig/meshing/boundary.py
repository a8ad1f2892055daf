"""The boundary of a mesh: shrink and smooth (Yang & Chen 2010, section 3.4).

A boundary edge belongs to one triangle only; outer borders and the borders of holes are treated alike. Both steps
change triangles where they are, on the adjacency of `slrig.meshing.adjacency`, and build nothing anew. No vertex
moves and none is added. What may change at a corner, and why, is in `slrig.meshing.boundary_rules`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.adjacency import neighbours
from slrig.meshing.boundary_rules import (
    add,
    boundary_half_edges,
    cosine_at,
    following,
    is_notch,
    length_mm,
    may_add,
    may_remove,
    preceding,
    remove,
    side_towards,
)
from slrig.meshing.topology import kept_faces
from slrig.model import FloatArray, IntArray

PSI = math.pi / 2  # the paper's ψ
LONGEST_MM = 5.0  # the paper's λ
_SPACINGS = 4.0  # λ alone took 9 100 of 28 900 good triangles of every eighth stripe of a face
_MOST_TRIANGLES_OF_A_SPIKE = 6  # chosen; 3 leaves 8 of 239 246 triangles more of a rendered vase, 12 the same


@dataclass(frozen=True, slots=True)
class Shrunk:
    """faces, adjacency : (F', 3) int32, what is left of the faces, in their order, and their neighbours."""

    faces: IntArray
    adjacency: IntArray
    removed_triangles: int


@dataclass(frozen=True, slots=True)
class Smoothed:
    """faces, adjacency : (F', 3) int32, what is left of the faces, in their order, then what was added; neighbours.

    added : (F',) bool. removed_triangles : of the faces given, so that F' = F - removed_triangles + added.sum().
    rounds : how often there were sharp corners to go through; the last time may have changed nothing.
    """

    faces: IntArray
    adjacency: IntArray
    added: NDArray[np.bool_]
    removed_triangles: int
    rounds: int


def longest_boundary_edge_mm(points_mm: FloatArray, faces: IntArray, /) -> FloatArray:
    """(n,) float64: λ at each vertex, max(5 mm, 4 x local spacing); the local spacing is the median of its edges.

    The paper's λ = 5 alone takes good triangles where the points are sparse. The median (the upper one) keeps to the
    wider of the spacings along the curves and across, so that sparse curves of dense points are left alone too, and
    does not see the one long triangle beside a curve's end. A vertex of one triangle only, that has no such
    median, has the smaller spacing of the other two.
    """
    points, faces = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(faces)
    longest = np.full(len(points), LONGEST_MM)
    near = np.zeros(len(points), dtype=np.bool_)
    if not any(in_bands(_mark_long_edges, len(faces), points, faces, LONGEST_MM, near)):
        return longest
    # The spacing of all that an edge too long touches, and of their neighbours, from all edges of both.
    ring = np.zeros(len(points), dtype=np.bool_)
    ring[faces[near[faces].any(axis=1)]] = True
    around = faces[ring[faces].any(axis=1)]
    start, end = around.ravel().astype(np.int64), np.roll(around, -1, axis=1).ravel()
    low, high = np.divmod(np.unique(np.minimum(start, end) << 32 | np.maximum(start, end)), 1 << 32)
    length = np.linalg.norm(points[high] - points[low], axis=1)
    vertex, length = np.concatenate((low, high)), np.concatenate((length, length))
    order = np.lexsort((length, vertex))
    named, first, count = np.unique(vertex[order], return_index=True, return_counts=True)
    spacing, ear = np.zeros(len(points)), np.zeros(len(points), dtype=np.bool_)
    spacing[named] = length[order][first + count // 2]
    ear[named] = count == 2
    smaller = spacing.copy()
    for corner in range(3):
        tip, left, right = (around[:, (corner + k) % 3] for k in range(3))
        smaller[tip[ear[tip]]] = np.minimum(spacing[left], spacing[right])[ear[tip]]
    longest[near] = np.maximum(LONGEST_MM, _SPACINGS * smaller[near])
    return longest


def boundary_point_count(faces: IntArray, adjacency: IntArray, /) -> int:
    """Number of vertices on the boundary; adjacency as `neighbours` gives it."""
    face, corner = np.divmod(np.flatnonzero(adjacency < 0), 3)
    # Every boundary vertex has a half-edge that runs into it.
    return int(np.count_nonzero(np.bincount(faces[face, (corner + 2) % 3])))


def shrunk(
    points_mm: FloatArray, faces: IntArray, longest_mm: FloatArray, /, *, adjacency: IntArray | None = None
) -> Shrunk:
    """Take away triangles from the boundary inwards until no boundary edge is longer than λ.

    A boundary edge longer than λ goes with its triangle, and the triangle's third vertex joins the boundary.

    points_mm : (n, 3) float64; faces : (F, 3) int32, edge-manifold, consistently wound; longest_mm : (n,) float64, λ
    at each vertex. An edge's λ is the smaller of its ends': a fan of long triangles widens the spacing at its apex,
    not at its rim. adjacency : (F, 3) int32, as `neighbours` gives it, if it is known.

    Raises
    ------
    ValueError
        The faces are no such mesh (see `neighbours`).
    """
    points, longest = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(longest_mm, np.float64)
    faces = np.ascontiguousarray(faces)
    across = neighbours(faces, vertex_count=len(points)) if adjacency is None else adjacency.copy()
    alive = np.ones(len(faces), dtype=np.bool_)
    removed = _shrink(points, faces, across, longest, alive)
    if not removed:
        return Shrunk(faces, across, 0)
    kept, across = kept_faces(faces, across, alive)
    return Shrunk(kept, across, removed)


def smoothed(
    points_mm: FloatArray,
    faces: IntArray,
    allowed_mm: FloatArray,
    /,
    *,
    psi_rad: float = PSI,
    most_rounds: int = 8,
    adjacency: IntArray | None = None,
) -> Smoothed:
    """Fill the notches of the boundary and take off its spikes.

    Walked with the surface on its left, the boundary comes from b_(i-1) to b_i and goes on to b_(i+1). The corner is
    handled when ∠b_(i-1) b_i b_(i+1) < ψ: the angle between the two edges, at most π, which is the surface's own
    angle at a spike and the gap's at a notch. n' = (b_(i+1) - b_i) x (b_(i-1) - b_i), n the mean normal of the
    corner's triangles. ∠(n', n) > π/2, a notch (Fig. 8(a)): triangle b_(i+1) b_i b_(i-1) is added, b_i is inside.
    Otherwise a spike (Fig. 8(b)): b_i goes with its triangles and the vertices behind join the boundary.

    Corners are handled in rounds, notches first, each kind sharpest first; a round looks at what the one before has
    changed. A zigzag can be smoothed either way, and filling it keeps what was measured.

    The paper's rule alone eats through posts of a few triangles' width, peels a slanted border row after row, and
    skins depth edges. So `may_add` and `may_remove` may refuse; the two neighbours of a spike that went stay; and
    a notch or a spike is followed over at most `most_rounds` points. It ends without that limit, too: filling a
    notch leaves fewer boundary edges, taking a spike fewer fans of triangles about a vertex.

    points_mm : (n, 3) float64; faces : (F, 3) int32, edge-manifold, consistently wound; allowed_mm : (n,) float64,
    length beyond which an edge at each vertex crosses a depth edge. adjacency : (F, 3) int32, as `neighbours` gives
    it, if it is known.

    Raises
    ------
    ValueError
        The faces are no such mesh (see `neighbours`), or psi_rad is not between 0 and π.
    """
    if not 0.0 < psi_rad < math.pi:
        message = f"psi_rad: expected an angle between 0 and π, found {psi_rad:g}; π/2 is usual"
        raise ValueError(message)
    points, allowed = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(allowed_mm, np.float64)
    faces = np.ascontiguousarray(faces)
    across = neighbours(faces, vertex_count=len(points)) if adjacency is None else np.ascontiguousarray(adjacency)
    new_faces, new_across, alive, rounds = _smooth(points, faces, across, allowed, math.cos(psi_rad), most_rounds)
    removed = len(faces) - int(np.count_nonzero(alive[: len(faces)]))
    if not removed and len(new_faces) == len(faces):
        return Smoothed(faces, across, np.zeros(len(faces), dtype=np.bool_), 0, rounds)
    kept, across = kept_faces(new_faces, new_across, alive)
    added = np.zeros(len(kept), dtype=np.bool_)
    added[len(faces) - removed :] = True
    return Smoothed(kept, across, added, removed, rounds)


@kernel
def _mark_long_edges(begin: int, end: int, points: Any, faces: Any, longest_mm: float, near: Any) -> bool:
    """Mark both ends of every edge longer than longest_mm; whether there is one."""
    found = False
    for face in range(begin, end):
        for corner in range(3):
            a, b = faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]
            if length_mm(points, a, b) > longest_mm:
                near[a] = near[b] = found = True
    return found


@kernel
def _shrink(points: Any, faces: Any, adjacency: Any, longest_mm: Any, alive: Any) -> int:
    stack = boundary_half_edges(adjacency)
    removed = 0
    while len(stack):
        half_edge = stack.pop()
        face = half_edge // 3
        a, b = faces[face, (half_edge + 1) % 3], faces[face, (half_edge + 2) % 3]
        if not alive[face] or length_mm(points, a, b) <= min(longest_mm[a], longest_mm[b]):
            continue
        alive[face] = False
        removed += 1
        for corner in range(3):
            behind = adjacency[face, corner]
            if behind >= 0:
                side = side_towards(adjacency, behind, face)
                adjacency[behind, side] = -1
                stack.append(np.int64(3 * behind + side))
    return removed


def _smooth(
    points: FloatArray,
    given: IntArray,
    given_adjacency: IntArray,
    allowed_mm: FloatArray,
    cos_psi: float,
    most_rounds: int,
) -> tuple[IntArray, IntArray, NDArray[np.bool_], int]:
    """Faces given and added, their adjacency, which of them are alive, and the number of rounds."""
    queue = np.flatnonzero(given_adjacency.ravel() < 0)
    degree = np.bincount(given.ravel(), minlength=len(points)).astype(np.int32)
    ends = given[queue // 3, (queue + 2) % 3]
    corners = np.bincount(ends, minlength=len(points)).astype(np.int32)
    stays = np.zeros(len(points), dtype=np.bool_)
    count = len(given)
    faces, adjacency = given.copy(), given_adjacency.copy()
    alive, waiting = np.ones(count, dtype=np.bool_), np.zeros((count, 3), dtype=np.bool_)
    for rounds in range(most_rounds):
        waiting.ravel()[queue] = False
        sharp, rank = _sharp_corners(points, faces, adjacency, alive, queue, cos_psi)
        if not len(sharp):
            return faces[:count], adjacency[:count], alive[:count], rounds
        # Each corner adds one face at most.
        room = max(count + len(sharp) - len(faces), 0)
        faces, adjacency, waiting = (_lengthened(rows, room) for rows in (faces, adjacency, waiting))
        alive = _lengthened(alive, room)
        count, queue = _smooth_corners(
            points, faces, adjacency, count, alive, waiting, degree, corners, stays, allowed_mm, cos_psi,
            sharp[np.argsort(rank, kind="stable")], _MOST_TRIANGLES_OF_A_SPIKE,
        )  # fmt: skip
    return faces[:count], adjacency[:count], alive[:count], most_rounds


def _lengthened(rows: Any, more: int) -> Any:
    return np.concatenate((rows, np.zeros((more, *rows.shape[1:]), dtype=rows.dtype))) if more else rows


@kernel
def _sharp_corners(points: Any, faces: Any, adjacency: Any, alive: Any, queue: Any, cos_psi: float) -> Any:
    """Half-edges of the queue that run into a sharp corner, and the rank of each: notches before spikes, each sharpest
    first.
    """
    sharp, rank = np.zeros(len(queue), dtype=np.int64), np.zeros(len(queue))
    count = 0
    for into in queue:
        if alive[into // 3] and adjacency[into // 3, into % 3] < 0:
            out = following(faces, adjacency, into)
            a, b = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3]
            cosine = cosine_at(points, a, b, faces[out // 3, (out + 2) % 3])
            if cosine > cos_psi:
                sharp[count] = into
                rank[count] = -cosine - (2.0 if is_notch(points, faces, adjacency, into, out) else 0.0)
                count += 1
    return sharp[:count], rank[:count]


@kernel
def _smooth_corners(
    points: Any,
    faces: Any,
    adjacency: Any,
    count: int,
    alive: Any,
    waiting: Any,
    degree: Any,
    corners: Any,
    stays: Any,
    allowed_mm: Any,
    cos_psi: float,
    sharp: Any,
    most_triangles: int,
) -> Any:
    """One round, in place. The number of faces after it, and the half-edges to look at in the next."""
    queue = [np.int64(0) for _ in range(0)]
    for into in sharp:
        if not alive[into // 3] or adjacency[into // 3, into % 3] >= 0:
            continue
        out = following(faces, adjacency, into)
        a, b = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3]
        c = faces[out // 3, (out + 2) % 3]
        if not cosine_at(points, a, b, c) > cos_psi:
            continue
        changed = [np.int64(0) for _ in range(0)]
        if is_notch(points, faces, adjacency, into, out):
            if may_add(points, faces, adjacency, degree, allowed_mm, into, out):
                add(faces, adjacency, degree, corners, count, into, out)
                alive[count] = True
                if adjacency[count, 1] < 0:
                    changed.append(np.int64(3 * count + 1))
                    changed.append(preceding(faces, adjacency, np.int64(3 * count + 1)))
                count += 1
        elif not stays[b] and may_remove(faces, adjacency, corners, into, out, most_triangles):
            stays[a] = stays[c] = True
            changed.append(preceding(faces, adjacency, into))
            remove(faces, adjacency, degree, corners, alive, into, out, changed)
        for half_edge in changed:
            if not waiting[half_edge // 3, half_edge % 3]:
                waiting[half_edge // 3, half_edge % 3] = True
                queue.append(half_edge)
    return count, np.array(queue)
