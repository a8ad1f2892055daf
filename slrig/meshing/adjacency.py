"""Which triangle lies across each edge of a mesh.

`faces` is (F, 3) int32, vertex indices, counter-clockwise, throughout. Flat arrays, no half-edge objects.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import in_bands, kernel
from slrig.model import IntArray

_CROWDED, _REPEATED = 1, 2  # what is wrong with a face


@kernel
def in_groups(groups: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Where the members of each group begin, (count + 1,) int32, and the members in that order, rising, (n,) int32.

    groups : (n,) int32, the group of each, from 0 to count - 1. A counting sort.
    """
    starts = np.zeros(count + 2, dtype=np.int32)
    for group in groups:
        starts[group + 2] += 1
    for group in range(count):
        starts[group + 2] += starts[group + 1]
    members = np.zeros(len(groups), dtype=np.int32)
    for member in range(len(groups)):
        # A group's start stands one place to the right until its members have moved it on to its end.
        place = groups[member] + 1
        members[starts[place]] = member
        starts[place] += 1
    return starts[:-1], members


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
    if faces.size and (faces.min() < 0 or faces.max() >= vertex_count):
        message = (
            f"faces name vertices {faces.min()} to {faces.max()}, there are {vertex_count}; "
            "pass the number of points that the faces index"
        )
        raise ValueError(message)
    across = np.full(faces.shape, -1, dtype=np.int32)
    fault = np.zeros(len(faces), dtype=np.uint8)
    in_bands(_neighbours, len(faces), faces, *in_groups(faces.ravel(), vertex_count), across, fault)
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
                other, origin = corners[at] // 3, corners[at] % 3
                if faces[other, origin + 1 if origin < 2 else 0] == a:
                    alike += found >= 0
                    found = other
                elif faces[other, origin - 1 if origin else 2] == a:
                    # This face itself, or another that runs along the edge in the same direction.
                    alike += other != face
            across[face, after + 1 if after < 2 else 0] = found
            if alike:
                fault[face] = max(fault[face], _CROWDED)
