"""Vertex normals of a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import config
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.angles import angle_rad
from slrig.model import IntArray

_BLOCK = 488  # not a power of two: rows of a page each would share their places in the cache


def vertex_normals(vertices_mm: NDArray[np.floating[Any]], faces: IntArray) -> NDArray[np.float32]:
    """(V, 3) float32, unit: the mean normal of the triangles at each vertex, weighted by their angle there.

    Weighting by angle makes the normal independent of how the surface is cut into triangles
    (Thürmer and Wüthrich 1998, "Computing vertex normals from polygonal facets").
    NaN where no triangle with an area meets the vertex.
    """
    points = np.ascontiguousarray(vertices_mm, dtype=np.float64)
    sums = np.zeros((len(points), 3))
    normals = np.full((len(points), 3), np.nan, dtype=np.float32)
    parts = config.NUMBA_NUM_THREADS
    in_bands(_add_normals, parts, points, np.ascontiguousarray(faces), parts, sums)
    in_bands(_unit_normals, len(points), sums, normals)
    return normals


@kernel_part
def _weigh(count: int, work: Any) -> None:
    """From normals as long as twice the area, (0, 1, 2), and the dots of the edges at a and b, (3, 4), of up to _BLOCK
    triangles, their unit normals and their angles at a, b and c, (3, 4, 5).

    Row r of `work` is work[r * _BLOCK :]. Nothing else stands in this loop, so that it runs in vector registers.
    """
    for at in range(count):
        nx, ny, nz = work[at], work[_BLOCK + at], work[2 * _BLOCK + at]
        twice_area = np.sqrt(nx * nx + ny * ny + nz * nz)
        # The cross product of any two edges is twice the area: each angle is atan2(2 A, dot of the edges there).
        at_a = angle_rad(twice_area, work[3 * _BLOCK + at])
        at_b = angle_rad(twice_area, work[4 * _BLOCK + at])
        work[at], work[_BLOCK + at], work[2 * _BLOCK + at] = nx / twice_area, ny / twice_area, nz / twice_area
        work[3 * _BLOCK + at], work[4 * _BLOCK + at], work[5 * _BLOCK + at] = at_a, at_b, np.pi - at_a - at_b


@kernel
def _add_normals(begin: int, end: int, points: Any, faces: Any, parts: int, sums: Any) -> None:
    # Each part owns a range of vertices, goes over all faces and adds to its own vertices only: every vertex has its
    # sum taken in the order of the faces, so the result is the same for any number of threads.
    for part in range(begin, end):
        low, high = len(points) * part // parts, len(points) * (part + 1) // parts
        work, mine = np.zeros(6 * _BLOCK), np.zeros(_BLOCK, dtype=np.int32)
        face = 0
        while face < len(faces):
            count = 0
            while face < len(faces) and count < _BLOCK:
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                face += 1
                if not (low <= a < high or low <= b < high or low <= c < high):
                    continue
                ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
                vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
                work[count] = uy * vz - uz * vy
                work[_BLOCK + count] = uz * vx - ux * vz
                work[2 * _BLOCK + count] = ux * vy - uy * vx
                work[3 * _BLOCK + count] = ux * vx + uy * vy + uz * vz
                work[4 * _BLOCK + count] = ux * (ux - vx) + uy * (uy - vy) + uz * (uz - vz)
                mine[count] = face - 1
                count += 1
            _weigh(count, work)
            for at in range(count):
                x, y, z = work[at], work[_BLOCK + at], work[2 * _BLOCK + at]
                # A triangle without an area has no normal: it was divided by zero.
                if not x * x + y * y + z * z > 0.0:
                    continue
                for corner in range(3):
                    vertex, angle = faces[mine[at], corner], work[(3 + corner) * _BLOCK + at]
                    if low <= vertex < high:
                        sums[vertex, 0] += angle * x
                        sums[vertex, 1] += angle * y
                        sums[vertex, 2] += angle * z


@kernel
def _unit_normals(first: int, last: int, sums: Any, normals: Any) -> None:
    for vertex in range(first, last):
        x, y, z = sums[vertex, 0], sums[vertex, 1], sums[vertex, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            normals[vertex, 0], normals[vertex, 1], normals[vertex, 2] = x / length, y / length, z / length
