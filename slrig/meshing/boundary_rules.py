"""Walking the boundary of a mesh, what may change at one of its corners, and changing it.

A boundary half-edge is the number 3 f + k: the edge of face f opposite its corner k, from corner k + 1 to corner
k + 2, with no face beyond it. The surface lies to its left, seen from the side where faces are counter-clockwise. A
corner of the boundary is named by the half-edge that runs into it: a vertex where boundaries touch has several
corners, each with its own fan of triangles, and is never mistaken for one.

points : (n, 3) float64, mm; faces : (F, 3) int32; adjacency : (F, 3) int32, the face across the edge opposite each
corner, -1 at the boundary, throughout.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from slrig.kernels import kernel_part

# Of an added triangle: no sliver, no fold against the triangles that it is put beside.
_COS_SMALLEST_ANGLE = math.cos(math.radians(10.0))
_COS_LARGEST_FOLD = math.cos(math.radians(60.0))
# Half-edges looked at on each side of a notch for a boundary that runs into it.
_STEPS_ASIDE = 4


@kernel_part
def corner_of(faces: Any, face: int, vertex: int) -> int:
    """Which corner of the face the vertex is."""
    if faces[face, 0] == vertex:
        return 0
    return 1 if faces[face, 1] == vertex else 2


@kernel_part
def boundary_half_edges(adjacency: Any) -> Any:
    """All of them, a list, rising."""
    return [
        np.int64(3 * face + corner)
        for face in range(len(adjacency))
        for corner in range(3)
        if adjacency[face, corner] < 0
    ]


@kernel_part
def following(faces: Any, adjacency: Any, half_edge: int) -> int:
    """The boundary half-edge that leaves the corner which `half_edge` runs into."""
    return int(_round_the_corner(faces, adjacency, half_edge, np.int64(2)))


@kernel_part
def preceding(faces: Any, adjacency: Any, half_edge: int) -> int:
    """The boundary half-edge that runs into the corner which `half_edge` leaves."""
    return int(_round_the_corner(faces, adjacency, half_edge, np.int64(1)))


@kernel_part
def _round_the_corner(faces: Any, adjacency: Any, half_edge: int, side: int) -> int:
    """From face to face round the vertex at one end of `half_edge`, to the boundary on the other side of it.

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
    """Distance of two points."""
    u = _difference(points, a, b)
    return math.sqrt(_dot(u, u))


@kernel_part
def cosine_at(points: Any, a: int, b: int, c: int) -> float:
    """The cosine of ∠abc, -1 where a side has no length: such a corner is never sharp."""
    u, v = _difference(points, a, b), _difference(points, c, b)
    squares = _dot(u, u) * _dot(v, v)
    return _dot(u, v) / math.sqrt(squares) if squares > 0.0 else -1.0


@kernel_part
def _unit_normal(points: Any, a: int, b: int, c: int) -> Any:
    """Of triangle abc; zero where it has no area."""
    n = _cross(_difference(points, b, a), _difference(points, c, a))
    size = math.sqrt(_dot(n, n))
    if not size > 0.0:
        return 0.0, 0.0, 0.0
    return n[0] / size, n[1] / size, n[2] / size


@kernel_part
def is_notch(points: Any, faces: Any, adjacency: Any, into: int, out: int) -> bool:
    """True for Fig. 8(a) at the corner between half-edges `into` (a to b) and `out` (b to c), False for Fig. 8(b).

    n' = (c - b) x (a - b), n the mean of the unit normals of the corner's triangles. With the surface to the left,
    n' looks along n where the boundary turns left (a spike of surface) and against it where it turns right (a notch
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
    """Whether the corner's fan has an edge to the vertex `other`, and whether the fan is all its vertex has.

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
def _lies_inside(points: Any, p: int, a: int, b: int, c: int, normal: Any) -> bool:
    """Whether p, seen along the normal of triangle abc, lies in it or on its edge."""
    for u, v in ((a, b), (b, c), (c, a)):
        if _dot(_cross(_difference(points, v, u), _difference(points, p, u)), normal) < 0.0:
            return False
    return True


@kernel_part
def _is_clear(points: Any, faces: Any, adjacency: Any, into: int, out: int, normal: Any) -> bool:
    """Whether the boundary on either side keeps out of the triangle between two half-edges, `normal` its normal."""
    a, b, c = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3], faces[out // 3, (out + 2) % 3]
    ahead, behind = out, into
    for _ in range(_STEPS_ASIDE):
        ahead = following(faces, adjacency, ahead)
        behind = preceding(faces, adjacency, behind)
        for p in (faces[ahead // 3, (ahead + 2) % 3], faces[behind // 3, (behind + 1) % 3]):
            if p != a and p != b and p != c and _lies_inside(points, p, c, b, a, normal):
                return False
    return True


@kernel_part
def may_add(points: Any, faces: Any, adjacency: Any, degree: Any, allowed_mm: Any, into: int, out: int) -> bool:
    """Whether triangle (c, b, a) may fill the notch at b between half-edges `into` (a to b) and `out` (b to c).

    Not across a depth edge: its longest edge is at most the mean of `allowed_mm` (n,) at its corners. Not as a
    sliver, nor folded against the triangle on any side. Not where edge ac exists, unless it is the third side of a
    hole of three edges. Not over another stretch of the boundary.
    """
    a, b, c = faces[into // 3, (into + 1) % 3], faces[into // 3, (into + 2) % 3], faces[out // 3, (out + 2) % 3]
    longest = max(length_mm(points, a, b), length_mm(points, b, c), length_mm(points, c, a))
    if not longest <= (allowed_mm[a] + allowed_mm[b] + allowed_mm[c]) / 3.0:
        return False
    sharpest = max(cosine_at(points, a, b, c), cosine_at(points, b, c, a), cosine_at(points, c, a, b))
    if sharpest > _COS_SMALLEST_ANGLE:
        return False
    normal = _unit_normal(points, c, b, a)
    third = following(faces, adjacency, out)
    closes = faces[third // 3, (third + 2) % 3] == a
    for beside in (into // 3, out // 3, third // 3 if closes else out // 3):
        n = _unit_normal(points, faces[beside, 0], faces[beside, 1], faces[beside, 2])
        if _dot(n, normal) < _COS_LARGEST_FOLD:
            return False
    if closes:
        return True
    found, whole = _has_edge(faces, adjacency, degree, out, a)
    if not (found or whole):
        # Another fan of c may have the edge; then a has it as well. If neither fan is all there is, assume the worst.
        found, whole = _has_edge(faces, adjacency, degree, preceding(faces, adjacency, into), c)
        found |= not whole
    return not found and _is_clear(points, faces, adjacency, into, out, normal)


@kernel_part
def may_remove(faces: Any, adjacency: Any, corners: Any, into: int, out: int, most_triangles: int) -> bool:
    """Whether the spike at b between half-edges `into` (a to b) and `out` (b to c) may go with its triangles.

    corners : (n,) int32, boundary corners at each vertex, 0 inside the surface.
    The vertices that this lays bare must have been inside: otherwise two boundaries would touch in one, or a strip
    of one triangle's width would be cut through. The triangles behind must reach inside as well, but for those that
    the next half-edges on either side belong to: otherwise a strip of two triangles' width would be thinned.
    """
    face, corner = into // 3, (into + 2) % 3
    b = faces[face, corner]
    before = preceding(faces, adjacency, into)
    after = following(faces, adjacency, out)
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
        if count > most_triangles:
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
def side_towards(adjacency: Any, face: int, other: int) -> int:
    """The corner of `face` whose opposite edge has `other` beyond it."""
    if adjacency[face, 0] == other:
        return 0
    return 1 if adjacency[face, 1] == other else 2


@kernel_part
def add(faces: Any, adjacency: Any, degree: Any, corners: Any, face: int, into: int, out: int) -> None:
    """Put triangle (c, b, a) between half-edges `into` (a to b) and `out` (b to c), as number `face`."""
    third = following(faces, adjacency, out)
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
def remove(
    faces: Any, adjacency: Any, degree: Any, corners: Any, alive: Any, into: int, out: int, laid_bare: Any
) -> None:
    """Take away the fan of the corner between half-edges `into` and `out`; append the new half-edges, in order."""
    face, corner = into // 3, (into + 2) % 3
    b = faces[face, corner]
    corners[b] -= 1
    while True:
        alive[face] = False
        for k in range(3):
            degree[faces[face, k]] -= 1
        behind = adjacency[face, corner]
        side = side_towards(adjacency, behind, face)
        adjacency[behind, side] = -1
        laid_bare.append(np.int64(3 * behind + side))
        if 3 * face + (corner + 2) % 3 == out:
            return
        corners[faces[face, (corner + 1) % 3]] += 1
        face = adjacency[face, (corner + 2) % 3]
        corner = corner_of(faces, face, b)
