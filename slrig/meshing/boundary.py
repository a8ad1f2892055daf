"""The boundary of a mesh: shrink and smooth (Yang & Chen 2010, section 3.4).

A boundary edge belongs to one triangle only; outer borders and the borders of holes are treated alike. Both steps
edit the triangles in place on the adjacency of `slrig.meshing.topology`. They move no vertex and add none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.topology import neighbours, select_faces
from slrig.model import FloatArray, IntArray

# Limits of an added triangle: not a sliver, and not folded against its neighbours.
_COS_MIN_ANGLE = math.cos(math.radians(10.0))
_COS_MAX_FOLD = math.cos(math.radians(60.0))
# Half-edges on each side of a notch that are checked for a boundary that runs into it.
_STEPS_ASIDE = 4


@kernel_part
def corner_of(faces: Any, face: int, vertex: int) -> int:
    """Index (0, 1 or 2) of a vertex in a face."""
    if faces[face, 0] == vertex:
        return 0
    return 1 if faces[face, 1] == vertex else 2


@kernel_part
def boundary_half_edges(adjacency: Any) -> Any:
    """All boundary half-edges in ascending order."""
    return [
        np.int64(3 * face + corner)
        for face in range(len(adjacency))
        for corner in range(3)
        if adjacency[face, corner] < 0
    ]


@kernel_part
def next_boundary_edge(faces: Any, adjacency: Any, half_edge: int) -> int:
    """The boundary half-edge after `half_edge`: it leaves the vertex where `half_edge` ends."""
    return int(_walk_around_vertex(faces, adjacency, half_edge, np.int64(2)))


@kernel_part
def previous_boundary_edge(faces: Any, adjacency: Any, half_edge: int) -> int:
    """The boundary half-edge before `half_edge`: it ends at the vertex where `half_edge` begins."""
    return int(_walk_around_vertex(faces, adjacency, half_edge, np.int64(1)))


@kernel_part
def _walk_around_vertex(faces: Any, adjacency: Any, half_edge: int, side: int) -> int:
    """Walk from face to face around one end of `half_edge`, to the boundary on the other side.

    side : corners onward from the half-edge's own number to that vertex, 1 where the half-edge leaves, 2 where it ends.
    """
    face, corner = half_edge // 3, (half_edge + side) % 3
    vertex = faces[face, corner]
    while adjacency[face, (corner + side) % 3] >= 0:
        face = adjacency[face, (corner + side) % 3]
        corner = corner_of(faces, face, vertex)
    return 3 * face + (corner + side) % 3


@kernel_part
def _difference(points: Any, a: int, b: int) -> Any:
    return points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]


@kernel_part
def _cross(u: Any, v: Any) -> Any:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@kernel_part
def _dot(u: Any, v: Any) -> float:
    return float(u[0] * v[0] + u[1] * v[1] + u[2] * v[2])


@kernel_part
def length_mm(points: Any, a: int, b: int) -> float:
    """Distance between two points."""
    u = _difference(points, a, b)
    return math.sqrt(_dot(u, u))


@kernel_part
def cosine_at(points: Any, a: int, b: int, c: int) -> float:
    """Cosine of ∠abc; -1 if a side has zero length, so that such a corner never counts as sharp."""
    u, v = _difference(points, a, b), _difference(points, c, b)
    squares = _dot(u, u) * _dot(v, v)
    return _dot(u, v) / math.sqrt(squares) if squares > 0.0 else -1.0


@kernel_part
def _unit_normal(points: Any, a: int, b: int, c: int) -> Any:
    """Unit normal of triangle abc; zero if it has no area."""
    n = _cross(_difference(points, b, a), _difference(points, c, a))
    size = math.sqrt(_dot(n, n))
    if not size > 0.0:
        return 0.0, 0.0, 0.0
    return n[0] / size, n[1] / size, n[2] / size


@kernel_part
def is_notch(points: Any, faces: Any, adjacency: Any, into: int, out: int) -> bool:
    """True for Fig. 8(a) at the corner between half-edges `into` (a to b) and `out` (b to c), False for Fig. 8(b).

    n' = (c - b) x (a - b), n the mean of the unit normals of the corner's triangles. With the surface to the left,
    n' points along n where the boundary turns left (a spike of surface) and against it where it turns right (a notch
    in the surface): angle (n', n) > π/2 is a notch.
    """
    face, corner = into // 3, (into + 2) % 3
    b = faces[face, corner]
    a, c = faces[face, (corner + 2) % 3], faces[out // 3, (out + 2) % 3]
    x, y, z = 0.0, 0.0, 0.0
    while True:
        n = _unit_normal(points, faces[face, 0], faces[face, 1], faces[face, 2])
        x, y, z = x + n[0], y + n[1], z + n[2]
        if 3 * face + (corner + 2) % 3 == out:
            break
        face = adjacency[face, (corner + 2) % 3]
        corner = corner_of(faces, face, b)
    return bool(_dot(_cross(_difference(points, c, b), _difference(points, a, b)), (x, y, z)) < 0.0)


@kernel_part
def _has_edge(faces: Any, adjacency: Any, degree: Any, into: int, other: int) -> Any:
    """Two flags: the corner's fan of triangles has an edge to the vertex `other`; its vertex has no other fan.

    degree : (n,) int32, triangles at each vertex.
    """
    face, corner = into // 3, (into + 2) % 3
    vertex = faces[face, corner]
    found = faces[face, (corner + 2) % 3] == other
    count = 1
    while True:
        found |= faces[face, (corner + 1) % 3] == other
        if adjacency[face, (corner + 2) % 3] < 0:
            return found, count == degree[vertex]
        face = adjacency[face, (corner + 2) % 3]
        corner = corner_of(faces, face, vertex)
        count += 1


@kernel_part
def _is_inside(points: Any, p: int, a: int, b: int, c: int, normal: Any) -> bool:
    """True if p, projected along the normal of triangle abc, is inside it or on its edge."""
    for u, v in ((a, b), (b, c), (c, a)):
        if _dot(_cross(_difference(points, v, u), _difference(points, p, u)), normal) < 0.0:
            return False
    return True


@kernel_part
def _is_clear(points: Any, faces: Any, adjacency: Any, into: int, out: int, normal: Any) -> bool:
    """True if the boundary on either side stays outside the triangle between two half-edges; `normal` is its normal."""
    a, b, c = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3], faces[out // 3, (out + 2) % 3]
    ahead, behind = out, into
    for _ in range(_STEPS_ASIDE):
        ahead = next_boundary_edge(faces, adjacency, ahead)
        behind = previous_boundary_edge(faces, adjacency, behind)
        for p in (faces[ahead // 3, (ahead + 2) % 3], faces[behind // 3, (behind + 1) % 3]):
            if p != a and p != b and p != c and _is_inside(points, p, c, b, a, normal):
                return False
    return True


@kernel_part
def can_add_triangle(
    points: Any, faces: Any, adjacency: Any, degree: Any, allowed_mm: Any, into: int, out: int
) -> bool:
    """True if triangle (c, b, a) may fill the notch at b between half-edges `into` (a to b) and `out` (b to c).

    Not across a depth edge: its longest edge is at most the mean of `allowed_mm` (n,) at its corners. Not as a
    sliver, nor folded against the triangle on any side. Not where edge ac exists, unless it is the third side of a
    hole of three edges. Not over another stretch of the boundary.
    """
    a, b, c = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3], faces[out // 3, (out + 2) % 3]
    longest = max(length_mm(points, a, b), length_mm(points, b, c), length_mm(points, c, a))
    if not longest <= (allowed_mm[a] + allowed_mm[b] + allowed_mm[c]) / 3.0:
        return False
    sharpest = max(cosine_at(points, a, b, c), cosine_at(points, b, c, a), cosine_at(points, c, a, b))
    if sharpest > _COS_MIN_ANGLE:
        return False
    normal = _unit_normal(points, c, b, a)
    third = next_boundary_edge(faces, adjacency, out)
    closes = faces[third // 3, (third + 2) % 3] == a
    for face in (into // 3, out // 3, third // 3 if closes else out // 3):
        n = _unit_normal(points, faces[face, 0], faces[face, 1], faces[face, 2])
        if _dot(n, normal) < _COS_MAX_FOLD:
            return False
    if closes:
        return True
    found, whole = _has_edge(faces, adjacency, degree, out, a)
    if not (found or whole):
        # Another fan of c may have the edge; then a has it as well. If neither fan is complete, assume the worst.
        found, whole = _has_edge(faces, adjacency, degree, previous_boundary_edge(faces, adjacency, into), c)
        found |= not whole
    return not found and _is_clear(points, faces, adjacency, into, out, normal)


@kernel_part
def can_remove_fan(faces: Any, adjacency: Any, corners: Any, into: int, out: int, max_triangles: int) -> bool:
    """True if the spike at b between half-edges `into` (a to b) and `out` (b to c) may be removed with its triangles.

    corners : (n,) int32, boundary corners at each vertex, 0 inside the surface.
    The vertices that join the boundary must have been inside: otherwise two boundaries would touch in one, or a strip
    of one triangle's width would be cut through. The triangles behind must reach inside as well, except those of the
    next half-edges on either side: otherwise a strip of two triangles' width would be thinned.
    """
    face, corner = into // 3, (into + 2) % 3
    b = faces[face, corner]
    before = previous_boundary_edge(faces, adjacency, into)
    after = next_boundary_edge(faces, adjacency, out)
    left, right = faces[before // 3, (before + 1) % 3], faces[after // 3, (after + 2) % 3]
    count = 0
    while True:
        behind = adjacency[face, corner]
        if behind < 0:
            return False
        u, v = faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
        apex = faces[behind, 0]
        if apex in (u, v):
            apex = faces[behind, 1]
        if apex in (u, v):
            apex = faces[behind, 2]
        count += 1
        last = 3 * face + (corner + 2) % 3 == out
        is_ear = last and count == 1
        if count > max_triangles:
            return False
        if corners[apex] > 0 and (is_ear or (apex != left and apex != right)):
            return False
        if last:
            return True
        if corners[u] > 0:
            return False
        face = adjacency[face, (corner + 2) % 3]
        corner = corner_of(faces, face, b)


@kernel_part
def corner_facing(adjacency: Any, face: int, other: int) -> int:
    """The corner of `face` opposite the edge that it shares with `other`."""
    if adjacency[face, 0] == other:
        return 0
    return 1 if adjacency[face, 1] == other else 2


@kernel_part
def add_triangle(faces: Any, adjacency: Any, degree: Any, corners: Any, face: int, into: int, out: int) -> None:
    """Insert triangle (c, b, a) between half-edges `into` (a to b) and `out` (b to c) as face number `face`."""
    third = next_boundary_edge(faces, adjacency, out)
    a, b = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3]
    c = faces[out // 3, (out + 2) % 3]
    faces[face, 0], faces[face, 1], faces[face, 2] = c, b, a
    adjacency[face, 0], adjacency[face, 1], adjacency[face, 2] = into // 3, -1, out // 3
    adjacency[into // 3, into % 3] = adjacency[out // 3, out % 3] = face
    for vertex in (a, b, c):
        degree[vertex] += 1
    corners[b] -= 1
    if faces[third // 3, (third + 2) % 3] == a:
        # A hole of three edges: it is closed.
        adjacency[face, 1] = third // 3
        adjacency[third // 3, third % 3] = face
        corners[a] -= 1
        corners[c] -= 1


@kernel_part
def remove_fan(
    faces: Any, adjacency: Any, degree: Any, corners: Any, alive: Any, into: int, out: int, new_boundary: Any
) -> None:
    """Remove the fan at the corner between half-edges `into` and `out`; append the new boundary half-edges in order."""
    face, corner = into // 3, (into + 2) % 3
    b = faces[face, corner]
    corners[b] -= 1
    while True:
        alive[face] = False
        for k in range(3):
            degree[faces[face, k]] -= 1
        behind = adjacency[face, corner]
        side = corner_facing(adjacency, behind, face)
        adjacency[behind, side] = -1
        new_boundary.append(np.int64(3 * behind + side))
        if 3 * face + (corner + 2) % 3 == out:
            return
        corners[faces[face, (corner + 1) % 3]] += 1
        face = adjacency[face, (corner + 2) % 3]
        corner = corner_of(faces, face, b)


PSI = math.pi / 2  # the paper's ψ
MAX_EDGE_MM = 5.0  # the paper's λ
_SPACINGS = 4.0  # λ alone removes good triangles of sparse curves
_MAX_SPIKE_TRIANGLES = 6  # more make no difference


@dataclass(frozen=True, slots=True)
class ShrinkResult:
    """A mesh without long boundary edges. faces, adjacency : (F', 3) int32, the remaining faces, and neighbours."""

    faces: IntArray
    adjacency: IntArray
    removed_triangles: int


@dataclass(frozen=True, slots=True)
class SmoothResult:
    """A mesh with a smooth boundary.

    faces, adjacency : (F', 3) int32, the remaining faces in order, then the added ones; their neighbours.
    added : (F',) bool. removed_triangles : number of removed input faces: F' = F - removed_triangles + added.sum().
    rounds : number of passes over sharp corners; the last one may have changed nothing.
    """

    faces: IntArray
    adjacency: IntArray
    added: NDArray[np.bool_]
    removed_triangles: int
    rounds: int


def max_boundary_edge_mm(points_mm: FloatArray, faces: IntArray, /) -> FloatArray:
    """(n,) float64: λ at each vertex, max(5 mm, 4 x local spacing); the local spacing is the median of its edges.

    The paper's λ = 5 alone removes good triangles of sparse points. The median (the upper one) follows the wider of the
    spacings along and across the curves, which spares sparse curves of dense points, and ignores a single long triangle
    at a curve's end. A vertex of one triangle only, which has no such median, has the smaller spacing of the other two.
    """
    points, faces = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(faces)
    longest = np.full(len(points), MAX_EDGE_MM)
    near = np.zeros(len(points), dtype=np.bool_)
    if not any(in_bands(_mark_long_edges, len(faces), points, faces, MAX_EDGE_MM, near)):
        return longest
    # The spacing at vertices of triangles with a long edge, and of their neighbours, from all edges of both.
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
    longest[near] = np.maximum(MAX_EDGE_MM, _SPACINGS * smaller[near])
    return longest


def boundary_point_count(faces: IntArray, adjacency: IntArray, /) -> int:
    """Number of vertices on the boundary; adjacency : result of `neighbours`."""
    face, corner = np.divmod(np.flatnonzero(adjacency < 0), 3)
    # Every boundary vertex has a half-edge that runs into it.
    return int(np.count_nonzero(np.bincount(faces[face, (corner + 2) % 3])))


def shrink_boundary(
    points_mm: FloatArray, faces: IntArray, longest_mm: FloatArray, /, *, adjacency: IntArray | None = None
) -> ShrinkResult:
    """Remove triangles from the boundary inwards until no boundary edge is longer than λ.

    A boundary edge longer than λ is removed with its triangle, whose third vertex then joins the boundary.

    points_mm : (n, 3) float64; faces : (F, 3) int32, edge-manifold, consistently wound; longest_mm : (n,) float64, λ
    at each vertex. An edge takes the smaller λ of its two ends: a fan of long triangles increases the spacing at its
    apex, not at its rim. adjacency : (F, 3) int32, result of `neighbours`, if available.

    Raises ValueError: the faces are not an edge-manifold mesh (see `neighbours`).
    """
    points, longest = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(longest_mm, np.float64)
    faces = np.ascontiguousarray(faces)
    across = neighbours(faces, vertex_count=len(points)) if adjacency is None else adjacency.copy()
    alive = np.ones(len(faces), dtype=np.bool_)
    removed = _shrink(points, faces, across, longest, alive)
    if not removed:
        return ShrinkResult(faces, across, 0)
    remaining, across = select_faces(faces, across, alive)
    return ShrinkResult(remaining, across, removed)


def smooth_boundary(
    points_mm: FloatArray,
    faces: IntArray,
    allowed_mm: FloatArray,
    /,
    *,
    psi_rad: float = PSI,
    max_rounds: int = 8,
    adjacency: IntArray | None = None,
) -> SmoothResult:
    """Fill notches in the boundary and remove spikes.

    Walked with the surface on its left, the boundary comes from b_(i-1) to b_i and goes on to b_(i+1). The corner is
    handled when ∠b_(i-1) b_i b_(i+1) < ψ: the angle between the two edges, at most π, which is the surface's own
    angle at a spike and the gap's at a notch. n' = (b_(i+1) - b_i) x (b_(i-1) - b_i), n the mean normal of the
    corner's triangles. ∠(n', n) > π/2, a notch (Fig. 8(a)): triangle b_(i+1) b_i b_(i-1) is added, b_i is then inside.
    Otherwise a spike (Fig. 8(b)): b_i is removed with its triangles, and the vertices behind it join the boundary.

    Corners are processed in rounds, notches first, each kind from the sharpest on; a round examines the corners that
    the previous one changed. A zigzag can be smoothed either way; filling it keeps the measured points.

    The paper's rule alone erodes posts of a few triangles' width, peels a slanted border row by row, and bridges depth
    edges. Therefore `can_add_triangle` and `can_remove_fan` may refuse, the two neighbours of a removed spike stay, and
    a notch or a spike is followed over at most `max_rounds` points. The loop also ends without that limit: filling a
    notch leaves fewer boundary edges, removing a spike fewer fans of triangles around a vertex.

    points_mm : (n, 3) float64; faces : (F, 3) int32, edge-manifold, consistently wound; allowed_mm : (n,) float64,
    length beyond which an edge at each vertex crosses a depth edge. adjacency : (F, 3) int32, result of `neighbours`,
    if available.

    Raises ValueError: the faces are not an edge-manifold mesh (see `neighbours`), or psi_rad is not between 0 and π.
    """
    if not 0.0 < psi_rad < math.pi:
        message = f"psi_rad: expected an angle between 0 and π, found {psi_rad:g}; π/2 is usual"
        raise ValueError(message)
    points, allowed = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(allowed_mm, np.float64)
    faces = np.ascontiguousarray(faces)
    across = neighbours(faces, vertex_count=len(points)) if adjacency is None else np.ascontiguousarray(adjacency)
    new_faces, new_across, alive, rounds = _smooth(points, faces, across, allowed, math.cos(psi_rad), max_rounds)
    removed = len(faces) - int(np.count_nonzero(alive[: len(faces)]))
    if not removed and len(new_faces) == len(faces):
        return SmoothResult(faces, across, np.zeros(len(faces), dtype=np.bool_), 0, rounds)
    remaining, across = select_faces(new_faces, new_across, alive)
    added = np.zeros(len(remaining), dtype=np.bool_)
    added[len(faces) - removed :] = True
    return SmoothResult(remaining, across, added, removed, rounds)


@kernel
def _mark_long_edges(begin: int, end: int, points: Any, faces: Any, longest_mm: float, near: Any) -> bool:
    """Mark both ends of every edge longer than longest_mm; return whether there is one."""
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
                side = corner_facing(adjacency, behind, face)
                adjacency[behind, side] = -1
                stack.append(np.int64(3 * behind + side))
    return removed


def _smooth(
    points: FloatArray,
    given: IntArray,
    given_adjacency: IntArray,
    allowed_mm: FloatArray,
    cos_psi: float,
    max_rounds: int,
) -> tuple[IntArray, IntArray, NDArray[np.bool_], int]:
    """Return all faces, given and added, their adjacency, which of them remain, and the number of rounds."""
    queue = np.flatnonzero(given_adjacency.ravel() < 0)
    degree = np.bincount(given.ravel(), minlength=len(points)).astype(np.int32)
    ends = given[queue // 3, (queue + 2) % 3]
    corners = np.bincount(ends, minlength=len(points)).astype(np.int32)
    stays = np.zeros(len(points), dtype=np.bool_)
    count = len(given)
    faces, adjacency = given.copy(), given_adjacency.copy()
    alive, waiting = np.ones(count, dtype=np.bool_), np.zeros((count, 3), dtype=np.bool_)
    for rounds in range(max_rounds):
        waiting.ravel()[queue] = False
        sharp, rank = _sharp_corners(points, faces, adjacency, alive, queue, cos_psi)
        if not len(sharp):
            return faces[:count], adjacency[:count], alive[:count], rounds
        # Each corner adds one face at most.
        room = max(count + len(sharp) - len(faces), 0)
        faces, adjacency, waiting = (_with_more_rows(rows, room) for rows in (faces, adjacency, waiting))
        alive = _with_more_rows(alive, room)
        count, queue = _smooth_corners(
            points, faces, adjacency, count, alive, waiting, degree, corners, stays, allowed_mm, cos_psi,
            sharp[np.argsort(rank, kind="stable")], _MAX_SPIKE_TRIANGLES,
        )  # fmt: skip
    return faces[:count], adjacency[:count], alive[:count], max_rounds


def _with_more_rows(rows: Any, more: int) -> Any:
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
            out = next_boundary_edge(faces, adjacency, into)
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
    max_triangles: int,
) -> Any:
    """Process one round in place; return the number of faces after it, and the half-edges to examine in the next."""
    queue = [np.int64(0) for _ in range(0)]
    for into in sharp:
        if not alive[into // 3] or adjacency[into // 3, into % 3] >= 0:
            continue
        out = next_boundary_edge(faces, adjacency, into)
        a, b = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3]
        c = faces[out // 3, (out + 2) % 3]
        if not cosine_at(points, a, b, c) > cos_psi:
            continue
        changed = [np.int64(0) for _ in range(0)]
        if is_notch(points, faces, adjacency, into, out):
            if can_add_triangle(points, faces, adjacency, degree, allowed_mm, into, out):
                add_triangle(faces, adjacency, degree, corners, count, into, out)
                alive[count] = True
                if adjacency[count, 1] < 0:
                    changed.append(np.int64(3 * count + 1))
                    changed.append(previous_boundary_edge(faces, adjacency, np.int64(3 * count + 1)))
                count += 1
        elif not stays[b] and can_remove_fan(faces, adjacency, corners, into, out, max_triangles):
            stays[a] = stays[c] = True
            changed.append(previous_boundary_edge(faces, adjacency, into))
            remove_fan(faces, adjacency, degree, corners, alive, into, out, changed)
        for half_edge in changed:
            if not waiting[half_edge // 3, half_edge % 3]:
                waiting[half_edge // 3, half_edge % 3] = True
                queue.append(half_edge)
    return count, np.array(queue)
