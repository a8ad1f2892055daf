"""Surface net between inside and outside voxels of a sparse grid: a dual mesh, manifold by construction.

Each sheet of surface in a cell is a loop through its faces and crosses some of its edges; it has one vertex, at the
mean of the crossings (Gibson 1998, "Constrained elastic surface nets", and Nielson 2004, "Dual marching cubes"). Each
crossed edge of the grid has one quadrangle of its four cells if all their corners are known; else the surface is open.

A face with alternating corners can be crossed in two ways: by separating the inside corners, the default, or the
outside ones. If both crossings belong to one loop on both sides of the face, two vertices would share two edges with
four quadrangles (Wenger 2013, "Isosurfaces", 3.3.5): then the outside corners are separated, which splits the loops.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray
from slrig.multiview.fusion_grid import CELLS, Grid, corner_index, corner_positions_mm, neighbour_cell

_BITS = (4, 2, 1)  # of a corner of a cell: x, y, z
_EDGES = np.array([(c, c | bit) for bit in _BITS for c in range(8) if not c & bit])
"""(12, 2): the corners of each edge: four along x, four along y, four along z."""
_EDGE_OF = {frozenset(edge): number for number, edge in enumerate(_EDGES.tolist())}


def _faces() -> list[list[int]]:
    """Four corners of each face, counter-clockwise seen from outside; face 2 a + s is the upper one of axis a if s."""
    found = []
    for axis in range(3):
        bit, u, v = _BITS[axis], _BITS[(axis + 1) % 3], _BITS[(axis + 2) % 3]
        upper = [bit, bit | u, bit | u | v, bit | v]
        found += [[corner ^ bit for corner in upper[::-1]], upper]
    return found


_CORNERS_OF_FACE = np.array(_faces())
_EDGES_OF_FACE = np.array([[_EDGE_OF[frozenset((f[k], f[(k + 1) % 4]))] for k in range(4)] for f in _faces()])


class SurfaceNet(NamedTuple):
    """points_mm : (m, 3) float64; cells : (m,) int32, sorted, of each vertex; quads : (q, 4) int32, counter-clockwise
    seen from outside, where values are positive.
    """

    points_mm: FloatArray
    cells: IntArray
    quads: IntArray


def extract_net(grid: Grid, values: NDArray[np.floating[Any]]) -> SurfaceNet:
    """Extract the zero surface. values : (512 B,) float, by cell index, NaN if unknown."""
    signs, flips = np.zeros(len(values), dtype=np.uint8), np.zeros(len(values), dtype=np.uint8)
    bricks = len(grid.keys)
    in_bands(_signs, bricks, grid.around, values, signs)
    _separate_outsides(grid.around, signs, flips)
    counts = np.zeros(len(values), dtype=np.uint8)
    in_bands(_count_loops, bricks, signs, flips, counts)
    first_vertex = np.cumsum(counts, dtype=np.int32) - counts.astype(np.int32)
    cells = np.repeat(np.arange(len(values), dtype=np.int32), counts)
    within = np.zeros((len(cells), 3))
    in_bands(_place_vertices, bricks, grid.around, values, signs, flips, first_vertex, within)
    quads = np.concatenate(in_bands(_quads, bricks, grid.around, values, signs, flips, counts, first_vertex))
    return SurfaceNet(corner_positions_mm(grid, cells) + grid.voxel_mm * within, cells, quads)


@kernel(in_every_scan=False)
def _signs(first: int, last: int, around: Any, values: Any, signs: Any) -> None:
    """Set bit c of a cell's sign if corner c is inside; 0 for cells with an unknown corner or without surface."""
    for cell in range(CELLS * first, CELLS * last):
        inside = 0
        for corner in range(8):
            at = corner_index(around, cell, corner)
            if at < 0 or np.isnan(values[at]):
                inside = 0
                break
            inside |= (values[at] < 0.0) << corner
        signs[cell] = inside if inside < 255 else 0


@kernel_part
def _loops(inside: int, flipped: int, after: Any, loops: Any) -> int:
    """Write the number of the loop that crosses each edge of a cell, (12,), -1 for none, and return their number.

    A loop runs with the inside on its left: on a face, seen from outside, from an edge that leads out to one that leads
    in. Bit f of `flipped` is set if the outside corners are separated on face f. after : (12,) int64, scratch space.
    """
    for edge in range(12):
        after[edge] = loops[edge] = -1
    for face in range(6):
        for k in range(4):
            if inside >> _CORNERS_OF_FACE[face, k] & 1 and not inside >> _CORNERS_OF_FACE[face, (k + 1) % 4] & 1:
                step = 1 if flipped >> face & 1 else 3
                j = (k + step) % 4
                while inside >> _CORNERS_OF_FACE[face, j] & 1 or not inside >> _CORNERS_OF_FACE[face, (j + 1) % 4] & 1:
                    j = (j + step) % 4
                after[_EDGES_OF_FACE[face, k]] = _EDGES_OF_FACE[face, j]
    count = 0
    for edge in range(12):
        if after[edge] >= 0 and loops[edge] < 0:
            at = edge
            while loops[at] < 0:
                loops[at] = count
                at = after[at]
            count += 1
    return count


@kernel_part
def _is_one_loop(inside: int, flipped: int, face: int, after: Any, loops: Any) -> bool:
    _loops(inside, flipped, after, loops)
    first = loops[_EDGES_OF_FACE[face, 0]]
    one = True
    for k in range(1, 4):
        one &= loops[_EDGES_OF_FACE[face, k]] == first
    return one


@kernel(in_every_scan=False)
def _separate_outsides(around: Any, signs: Any, flips: Any) -> None:
    """Set the bits of faces that both cells cross twice with one loop. The order is irrelevant: each adds loops."""
    after, loops = np.zeros(12, np.int64), np.zeros(12, np.int64)
    for cell in range(len(signs)):
        for axis in range(3):
            face = 2 * axis + 1
            first = signs[cell] >> _CORNERS_OF_FACE[face, 0] & 1
            alternating = signs[cell] > 0
            for k in range(1, 4):
                alternating &= signs[cell] >> _CORNERS_OF_FACE[face, k] & 1 == first ^ k & 1
            if not alternating:
                continue
            other = corner_index(around, cell, _BITS[axis])
            if (
                other >= 0
                and signs[other] > 0
                and _is_one_loop(signs[cell], flips[cell], face, after, loops)
                and _is_one_loop(signs[other], flips[other], face - 1, after, loops)
            ):
                flips[cell] |= 1 << face
                flips[other] |= 1 << (face - 1)


@kernel(in_every_scan=False)
def _count_loops(first: int, last: int, signs: Any, flips: Any, counts: Any) -> None:
    after, loops = np.zeros(12, np.int64), np.zeros(12, np.int64)
    for cell in range(CELLS * first, CELLS * last):
        if signs[cell]:
            counts[cell] = _loops(signs[cell], flips[cell], after, loops)


@kernel(in_every_scan=False)
def _place_vertices(
    first: int, last: int, around: Any, values: Any, signs: Any, flips: Any, first_vertex: Any, within: Any
) -> None:  # fmt: skip
    """The mean of each loop's crossings, in voxels from the cell's lowest corner."""
    after, loops = np.zeros(12, np.int64), np.zeros(12, np.int64)
    crossings = np.zeros(4)
    for cell in range(CELLS * first, CELLS * last):
        if not signs[cell]:
            continue
        count = _loops(signs[cell], flips[cell], after, loops)
        for loop in range(count):
            vertex, crossings[loop] = first_vertex[cell] + loop, 0.0
        for edge in range(12):
            loop = loops[edge]
            if loop < 0:
                continue
            low, high = _EDGES[edge]
            begin, end = values[corner_index(around, cell, low)], values[corner_index(around, cell, high)]
            vertex = first_vertex[cell] + loop
            crossings[loop] += 1.0
            for axis in range(3):
                within[vertex, axis] += low >> (2 - axis) & 1
            within[vertex, edge // 4] += begin / (begin - end)
        for loop in range(count):
            within[first_vertex[cell] + loop] /= crossings[loop]


@kernel(in_every_scan=False)
def _quads(
    first: int, last: int, around: Any, values: Any, signs: Any, flips: Any, counts: Any, first_vertex: Any
) -> IntArray:  # fmt: skip
    after, loops = np.zeros(12, np.int64), np.zeros(12, np.int64)
    found, count = np.zeros((1024, 4), dtype=np.int32), 0
    place, corners = np.zeros(3, np.int64), np.zeros(4, dtype=np.int32)
    for voxel in range(CELLS * first, CELLS * last):
        if np.isnan(values[voxel]):
            continue
        for axis in range(3):
            end = corner_index(around, voxel, _BITS[axis])
            if end < 0 or np.isnan(values[end]) or (values[voxel] < 0.0) == (values[end] < 0.0):
                continue
            u, v = (axis + 1) % 3, (axis + 2) % 3
            known = True
            for k in range(4):
                # The cells around the edge, counter-clockwise seen from its end.
                back_u, back_v = k == 1 or k == 2, k >= 2
                place[0], place[1], place[2] = voxel >> 6 & 7, voxel >> 3 & 7, voxel & 7
                place[u] -= back_u
                place[v] -= back_v
                cell = neighbour_cell(around, voxel // CELLS, place[0], place[1], place[2])
                if cell < 0 or not signs[cell]:
                    known = False
                    break
                loop = 0
                if counts[cell] > 1:
                    _loops(signs[cell], flips[cell], after, loops)
                    low = back_u * _BITS[u] | back_v * _BITS[v]
                    for edge in range(4 * axis, 4 * axis + 4):
                        if _EDGES[edge, 0] == low:
                            loop = loops[edge]
                corners[k] = first_vertex[cell] + loop
            if not known:
                continue
            if count == len(found):
                found = np.concatenate((found, np.zeros_like(found)))
            outward = values[voxel] < 0.0
            for k in range(4):
                found[count, k] = corners[k if outward else 3 - k]
            count += 1
    return found[:count]
