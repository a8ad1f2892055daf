"""A bounding-box tree over triangles: exact distance to the nearest one, and what a ray meets first.

Triangles are ordered along a Morton curve through their centroids (Lauterbach et al. 2009, "Fast BVH construction on
GPUs") and shared out evenly among the leaves of a complete binary tree, so that node i has the children 2i + 1 and
2i + 2 and nothing but the boxes is stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part
from slrig.meshing.nearest_point import on_triangle
from slrig.model import FloatArray, IntArray

_TRIANGLES_PER_LEAF = 4
_STACK = 64  # a walk holds one node for each level of the tree, and one more: no tree in memory has as many
# A ray along an edge or through a vertex must not slip between two triangles: barycentric tolerance.
_EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class SearchTree:
    """Triangles in Morton order, (T, 3, 3) float64 mm, and the boxes of the tree, (2L - 1, 6) float64 mm: low, high."""

    corners_mm: FloatArray
    boxes_mm: FloatArray

    @classmethod
    def over(cls, vertices_mm: NDArray[np.floating[Any]], faces: IntArray) -> SearchTree:
        """The tree of a mesh: vertices (V, 3), faces (F, 3).

        Raises
        ------
        ValueError
            A vertex that a face uses is not finite.
        """
        points = np.asarray(vertices_mm, dtype=np.float64)
        centroids = (points[faces[:, 0]] + points[faces[:, 1]] + points[faces[:, 2]]) / 3
        if not np.isfinite(centroids).all():
            message = "a search tree needs finite vertices; drop the faces that use an unmeasured one"
            raise ValueError(message)
        corners = points[faces[np.argsort(_morton_codes(centroids), kind="stable")]]
        leaf_count = 1
        while leaf_count * _TRIANGLES_PER_LEAF < len(corners):
            leaf_count *= 2
        return cls(corners, np.asarray(_boxes(corners, leaf_count)))

    def distances_mm(self, points_mm: NDArray[np.floating[Any]]) -> FloatArray:
        """(n,) float64: exact distance from each point, (n, 3), to the nearest triangle.

        Infinite if there is no triangle, NaN for a point that is not finite.
        """
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        order = np.argsort(_morton_codes(points), kind="stable")  # neighbours in turn walk the same nodes
        return np.asarray(np.sqrt(_squared_distances(points, order, self.corners_mm, self.boxes_mm)))

    def first_hits(self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]]) -> FloatArray:
        """How far along its direction each ray first meets a triangle, in units of that direction's length.

        Rays start at `origin`, (3,), and run along `directions`, (n, 3); both sides of a triangle count.
        Returns (n,) float64, infinite where a ray meets nothing.
        """
        return self._ray_hits(origin, directions, first_only=True)[0]

    def crossing_counts(self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]]) -> IntArray:
        """How many triangles each ray of `first_hits` crosses, (n,) int32.

        A ray along an edge crosses both triangles there.
        """
        return self._ray_hits(origin, directions, first_only=False)[1]

    def _ray_hits(
        self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]], *, first_only: bool
    ) -> tuple[FloatArray, IntArray]:
        start = np.ascontiguousarray(origin, dtype=np.float64)
        along = np.ascontiguousarray(directions, dtype=np.float64)
        found: tuple[FloatArray, IntArray] = _ray_hits(start, along, self.corners_mm, self.boxes_mm, first_only)
        return found


def _morton_codes(points: FloatArray) -> NDArray[np.uint64]:
    """(n,) uint64: 21 bits of each coordinate, interleaved; 0 for a point that is not finite."""
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    if not finite.any():
        return np.zeros(len(points), dtype=np.uint64)
    low = points[finite].min(axis=0)
    extent = max(float((points[finite].max(axis=0) - low).max()), 1e-300)
    steps = np.where(finite[:, None], (points - low) * ((2**21 - 1) / extent), 0.0).astype(np.uint64)
    return _spread(steps[:, 0]) << np.uint64(2) | _spread(steps[:, 1]) << np.uint64(1) | _spread(steps[:, 2])


def _spread(steps: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """21 bits, each moved to where two zeros are above the one before (Anderson, "Bit twiddling hacks")."""
    for shift, kept in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):  # fmt: skip
        steps = (steps | steps << np.uint64(shift)) & np.uint64(kept)
    return steps


@kernel(in_every_scan=False)
def _boxes(corners: FloatArray, leaf_count: int) -> FloatArray:
    """(2 leaf_count - 1, 6): leaves from their triangles, then every parent from its two children."""
    boxes = np.full((2 * leaf_count - 1, 6), np.inf)
    boxes[:, 3:] = -np.inf
    for leaf in range(leaf_count):
        node = leaf_count - 1 + leaf
        for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
            for corner in range(3):
                for axis in range(3):
                    value = corners[triangle, corner, axis]
                    boxes[node, axis] = min(boxes[node, axis], value)
                    boxes[node, axis + 3] = max(boxes[node, axis + 3], value)
    for node in range(leaf_count - 2, -1, -1):
        for axis in range(3):
            boxes[node, axis] = min(boxes[2 * node + 1, axis], boxes[2 * node + 2, axis])
            boxes[node, axis + 3] = max(boxes[2 * node + 1, axis + 3], boxes[2 * node + 2, axis + 3])
    return boxes


@kernel_part(inline="always")
def _box_gap(x: float, y: float, z: float, boxes: FloatArray, node: int) -> float:
    """Squared distance from a point to a box, 0 inside."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    gap: float = dx * dx + dy * dy + dz * dz
    return gap


@kernel(in_every_scan=False)
def _squared_distances(
    points: FloatArray, order: NDArray[np.intp], corners: FloatArray, boxes: FloatArray
) -> FloatArray:
    """Nearest-first descent; a node farther than the best triangle so far is left out."""
    leaf_count = (len(boxes) + 1) // 2
    out = np.full(len(points), np.nan)
    stack = np.zeros(_STACK, dtype=np.int64)
    gaps = np.zeros(_STACK)
    near = 0
    for index in order:
        x, y, z = points[index]
        if not np.isfinite(x + y + z):
            continue
        best = np.inf
        if len(corners):
            # The last point's triangle: a close bound at no cost.
            best = on_triangle(x, y, z, corners[near], 0, 1, 2)[0]
        stack[0], gaps[0], depth = 0, _box_gap(x, y, z, boxes, 0), 1
        while depth > 0:
            depth -= 1
            if gaps[depth] >= best:
                continue
            node = stack[depth]
            if node >= leaf_count - 1:
                leaf = node - leaf_count + 1
                for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
                    gap = on_triangle(x, y, z, corners[triangle], 0, 1, 2)[0]
                    if gap < best:
                        best, near = gap, triangle
                continue
            first, second = 2 * node + 1, 2 * node + 2
            first_gap, second_gap = _box_gap(x, y, z, boxes, first), _box_gap(x, y, z, boxes, second)
            if first_gap < second_gap:
                first, second, first_gap, second_gap = second, first, second_gap, first_gap
            if first_gap < best:
                stack[depth], gaps[depth] = first, first_gap
                depth += 1
            if second_gap < best:
                stack[depth], gaps[depth] = second, second_gap
                depth += 1
        out[index] = best
    return out


@kernel(in_every_scan=False)
def _ray_hits(
    origin: FloatArray, directions: FloatArray, corners: FloatArray, boxes: FloatArray, first_only: bool
) -> tuple[FloatArray, IntArray]:
    """Distances to the first hit and numbers of hits; `first_only` leaves out what lies behind a hit."""
    leaf_count = (len(boxes) + 1) // 2
    reach = np.full(len(directions), np.inf)
    crossings = np.zeros(len(directions), dtype=np.int32)
    stack = np.zeros(_STACK, dtype=np.int64)
    entries = np.zeros(_STACK)
    for i in range(len(directions)):
        stack[0], entries[0], depth = 0, _box_entry(origin, directions[i], boxes[0]), 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if entries[depth] == np.inf or (first_only and entries[depth] > reach[i]):
                continue
            if node >= leaf_count - 1:
                leaf = node - leaf_count + 1
                for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
                    t = _ray_meets_triangle(origin, directions[i], corners[triangle])
                    if t < np.inf:
                        crossings[i] += 1
                        reach[i] = min(reach[i], t)
                continue
            first, second = 2 * node + 1, 2 * node + 2
            first_entry = _box_entry(origin, directions[i], boxes[first])
            second_entry = _box_entry(origin, directions[i], boxes[second])
            if first_entry < second_entry:
                first, second, first_entry, second_entry = second, first, second_entry, first_entry
            stack[depth], entries[depth] = first, first_entry
            stack[depth + 1], entries[depth + 1] = second, second_entry
            depth += 2
    return reach, crossings


@kernel_part
def _box_entry(origin: FloatArray, direction: FloatArray, box: FloatArray) -> float:
    """How far along the ray the box begins, infinite if it is missed: slab test.

    The box is padded by some rounding errors, because it may be flat.
    """
    enter, leave = 0.0, np.inf
    for axis in range(3):
        pad = 1e-12 * (abs(box[axis]) + abs(box[axis + 3]) + abs(origin[axis]))
        low, high = box[axis] - pad - origin[axis], box[axis + 3] + pad - origin[axis]
        if direction[axis] == 0.0:
            if low > 0.0 or high < 0.0:
                return np.inf
        else:
            one, two = low / direction[axis], high / direction[axis]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter if enter <= leave else np.inf


@kernel_part
def _ray_meets_triangle(origin: FloatArray, direction: FloatArray, triangle: FloatArray) -> float:
    """How far along the ray it meets the triangle, infinite if it does not (Möller and Trumbore 1997)."""
    ux, uy, uz = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    vx, vy, vz = triangle[2, 0] - triangle[0, 0], triangle[2, 1] - triangle[0, 1], triangle[2, 2] - triangle[0, 2]
    sx, sy, sz = origin[0] - triangle[0, 0], origin[1] - triangle[0, 1], origin[2] - triangle[0, 2]
    dx, dy, dz = direction
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:
        return np.inf
    a = (sx * px + sy * py + sz * pz) / determinant
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    b = (dx * qx + dy * qy + dz * qz) / determinant
    t = (vx * qx + vy * qy + vz * qz) / determinant
    inside = a >= -_EDGE_TOLERANCE and b >= -_EDGE_TOLERANCE and a + b <= 1.0 + _EDGE_TOLERANCE
    return t if inside and t > 0.0 else np.inf
