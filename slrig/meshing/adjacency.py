"""Which triangle lies across each edge of a mesh.

`faces` is (F, 3) int32, vertex indices, counter-clockwise, throughout. Flat arrays, no half-edge objects.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from slrig.kernels import in_bands, kernel
from slrig.model import IntArray

_CROWDED, _REPEATED = 1, 2  # what is wrong with a face


class Incidence(NamedTuple):
    """The triangles at each vertex: corners[starts[v]:starts[v + 1]] holds 4 * face + corner, rising.

    starts : (V + 1,) int32; corners : (3F,) int32.
    """

    starts: IntArray
    corners: IntArray


def incidence(faces: IntArray, *, vertex_count: int) -> Incidence:
    """The triangles at each of `vertex_count` vertices, by a counting sort.

    Raises
    ------
    ValueError
        A face names a vertex that is not among them.
    """
    starts = np.zeros(vertex_count + 1, dtype=np.int32)
    corners = np.zeros(faces.size, dtype=np.int32)
    faces = np.ascontiguousarray(faces)
    if not _incidence(faces, starts, corners):
        message = (
            f"faces name vertices {faces.min()} to {faces.max()}, there are {vertex_count}; "
            "pass the number of points that the faces index"
        )
        raise ValueError(message)
    return Incidence(starts, corners)


def neighbours(faces: IntArray, *, vertex_count: int) -> IntArray:
    """(F, 3) int32: entry k is the face across the edge opposite corner k, -1 at a boundary.

    Linear in F as long as no vertex has very many triangles. Faces may meet in a vertex alone: that makes no
    neighbours.

    Raises
    ------
    ValueError
        A face names a vertex that is not there or the same one twice, or an edge is not one of a consistently wound
        manifold: two faces run along it in the same direction. More than two faces on an edge always do.
    """
    faces = np.ascontiguousarray(faces)
    around = incidence(faces, vertex_count=vertex_count)
    across = np.full(faces.shape, -1, dtype=np.int32)
    fault = np.zeros(len(faces), dtype=np.uint8)
    in_bands(_neighbours, len(faces), faces, around.starts, around.corners, across, fault)
    if fault.any():
        face = int(np.flatnonzero(fault)[0])
        named = faces[face].tolist()
        message = (
            f"face {face} {named} uses a vertex twice; take degenerate faces away first"
            if fault[face] == _REPEATED
            else f"face {face} {named} shares an edge with a face that runs along it in the same direction; "
            "take away what makes the mesh non-manifold, and wind all faces alike"
        )
        raise ValueError(message)
    return across


@kernel(in_every_scan=False)
def _incidence(faces: Any, starts: Any, corners: Any) -> bool:
    count = len(starts) - 1
    for face in range(len(faces)):
        for corner in range(3):
            vertex = faces[face, corner]
            if vertex < 0 or vertex >= count:
                return False
            starts[vertex + 1] += 1
    for vertex in range(count):
        starts[vertex + 1] += starts[vertex]
    for face in range(len(faces)):
        for corner in range(3):
            vertex = faces[face, corner]
            corners[starts[vertex]] = 4 * face + corner
            starts[vertex] += 1
    # Each start has moved on to the next one's place.
    for vertex in range(count, 0, -1):
        starts[vertex] = starts[vertex - 1]
    starts[0] = 0
    return True


@kernel(in_every_scan=False)
def _neighbours(first: int, last: int, faces: Any, starts: Any, corners: Any, across: Any, fault: Any) -> None:
    for face in range(first, last):
        for corner in range(3):
            after = corner + 1 if corner < 2 else 0
            # The edge from a to b, opposite the third corner; a neighbour runs from b to a.
            a, b = faces[face, corner], faces[face, after]
            if a == b:
                fault[face] = _REPEATED
            found, alike = -1, 0
            for at in range(starts[b], starts[b + 1]):
                other, origin = corners[at] >> 2, corners[at] & 3
                if faces[other, origin + 1 if origin < 2 else 0] == a:
                    alike += found >= 0
                    found = other
                elif faces[other, origin - 1 if origin else 2] == a:
                    # This face itself, or another that runs along the edge in the same direction.
                    alike += other != face
            across[face, after + 1 if after < 2 else 0] = found
            if alike:
                fault[face] = max(fault[face], _CROWDED)
