"""The nearest triangle of each view to points on and in a sparse grid: every triangle asks the points about it.

That is an order of magnitude less work than a tree's walk for each point where triangles are about as large as voxels
(after Mauch 2003, "Efficient algorithms for solving static Hamilton-Jacobi equations", closest point transform).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray
from slrig.views.fusion_grid import CELLS, MARGIN, SEEN_BEYOND, Grid, brick_at, new_cache
from slrig.views.fusion_sheets import Sheets


def nearest_to_corners(sheets: Sheets, grid: Grid, points_mm: FloatArray, cells: IntArray) -> IntArray:
    """(V, n) int32: the triangle of each view that is nearest to each corner of the grid, the first of equals; else -1.

    points_mm : (n, 3) float64; cells : (n,) int32, rising, flat indices of the corners.
    Of the triangles that pass through the cells about the corner, or whose box does: so it is exact within a voxel.
    Further off a corner only has to be on the right side of the surface.
    """
    reach = _Reach(box=1.0 + MARGIN, border=SEEN_BEYOND, furthest=3**0.5 + SEEN_BEYOND, width=0.0)
    return _nearest(sheets, grid, points_mm, cells, reach)


def nearest_within(sheets: Sheets, grid: Grid, points_mm: FloatArray, cells: IntArray, *, reach_mm: float) -> IntArray:
    """(V, n) int32: the triangle of each view that is nearest to each point, the first of equals; -1 beyond reach.

    points_mm : (n, 3) float64; cells : (n,) int32, rising, the flat cell that each point lies in.
    """
    voxels = reach_mm / grid.voxel_mm
    return _nearest(sheets, grid, points_mm, cells, _Reach(box=voxels, border=0.0, furthest=voxels, width=1.0))


class _Reach(NamedTuple):
    """In voxels. box : a triangle asks the points in its box with so much about it; border : and this much more, if it
    has an open edge. furthest : distances from there on are none. width : 0 where each point is its cell's lowest
    corner, 1 where it is anywhere inside.
    """

    box: float
    border: float
    furthest: float
    width: float


def _nearest(sheets: Sheets, grid: Grid, points: FloatArray, cells: IntArray, reach: _Reach) -> IntArray:
    first_point = np.full(CELLS * len(grid.keys), -1, dtype=np.int32)
    first_point[cells[::-1]] = np.arange(len(cells), dtype=np.int32)[::-1]
    views = len(sheets.first_face) - 1
    nearest = np.full((views, len(points)), -1, dtype=np.int32)
    in_bands(_nearest_faces, views, sheets, grid, points, cells, first_point, reach, nearest)
    return nearest


@kernel_part
def on_triangle(
    px: float, py: float, pz: float, points: Any, a: int, b: int, c: int
) -> tuple[float, float, float, float]:
    """Squared distance from p to a triangle, and the weights of its corners in the nearest point: they add up to 1.

    Weights are exactly 0 where the nearest point is on an edge. The nearest point is the foot of the perpendicular if
    that lies inside, else it is on an edge.
    """
    ax, ay, az = points[a, 0] - px, points[a, 1] - py, points[a, 2] - pz
    bx, by, bz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
    cx, cy, cz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    if square > 0.0:
        # Areas opposite each corner, times the square of the whole.
        at_a = nx * (by * cz - bz * cy) + ny * (bz * cx - bx * cz) + nz * (bx * cy - by * cx)
        at_b = nx * (cy * az - cz * ay) + ny * (cz * ax - cx * az) + nz * (cx * ay - cy * ax)
        at_c = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
        if at_a >= 0.0 and at_b >= 0.0 and at_c >= 0.0:
            height = nx * ax + ny * ay + nz * az
            return height * height / square, at_a / square, at_b / square, at_c / square
    ab, t_ab = _on_edge(ax, ay, az, ux, uy, uz)
    ac, t_ac = _on_edge(ax, ay, az, vx, vy, vz)
    bc, t_bc = _on_edge(bx, by, bz, cx - bx, cy - by, cz - bz)
    if ab <= ac and ab <= bc:
        return ab, 1.0 - t_ab, t_ab, 0.0
    if ac <= bc:
        return ac, 1.0 - t_ac, 0.0, t_ac
    return bc, 0.0, 1.0 - t_bc, t_bc


@kernel_part(inline="always")
def _on_edge(px: float, py: float, pz: float, dx: float, dy: float, dz: float) -> tuple[float, float]:
    """Squared distance from the origin to the segment from p to p + d, and how far along it the nearest point is."""
    square = dx * dx + dy * dy + dz * dz
    t = 0.0
    if square > 0.0:
        t = min(max(-(px * dx + py * dy + pz * dz) / square, 0.0), 1.0)
    qx, qy, qz = px + t * dx, py + t * dy, pz + t * dz
    return qx * qx + qy * qy + qz * qz, t


@kernel(in_every_scan=False)
def _nearest_faces(
    first: int, last: int, sheets: Any, grid: Any, points: Any, cells: Any, first_point: Any, reach: Any,
    nearest: Any,
) -> None:  # fmt: skip
    corners, faces, origin, keys, voxel = sheets.points_mm, sheets.faces, grid.origin_mm, grid.keys, grid.voxel_mm
    low, high, middle = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3)
    open_edges, gaps = sheets.open_edges, np.zeros(len(points))
    for view in range(first, last):
        gaps[:] = reach.furthest * voxel
        cached_keys, cached = new_cache()
        for face in range(sheets.first_face[view], sheets.first_face[view + 1]):
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            square, about = 0.0, reach.box + (reach.border if open_edges[face] else 0.0)
            for axis in range(3):
                p, q, r = corners[a, axis], corners[b, axis], corners[c, axis]
                least, most = min(p, q, r), max(p, q, r)
                middle[axis] = (least + most) / 2
                square += (most - least) ** 2 / 4
                # Coordinates are positive: the grid begins beyond all triangles' reach.
                low[axis] = int((least - origin[axis]) / voxel - about + 1.0 - reach.width)
                high[axis] = int((most - origin[axis]) / voxel + about)
            radius, mx, my, mz = np.sqrt(square), middle[0], middle[1], middle[2]
            nx, ny, nz = _unit_normal(corners, a, b, c)
            offset = nx * corners[a, 0] + ny * corners[a, 1] + nz * corners[a, 2]
            for bx in range(low[0] >> 3, (high[0] >> 3) + 1):
                for by in range(low[1] >> 3, (high[1] >> 3) + 1):
                    for bz in range(low[2] >> 3, (high[2] >> 3) + 1):
                        brick = brick_at(keys, bx, by, bz, cached_keys, cached)
                        if brick < 0:
                            continue
                        z_low, z_high = max(low[2] - 8 * bz, 0), min(high[2] - 8 * bz, 7)
                        for x in range(max(low[0] - 8 * bx, 0), min(high[0] - 8 * bx, 7) + 1):
                            for y in range(max(low[1] - 8 * by, 0), min(high[1] - 8 * by, 7) + 1):
                                row = CELLS * brick + 64 * x + 8 * y
                                for cell in range(row + z_low, row + z_high + 1):
                                    at = first_point[cell]
                                    while at >= 0:
                                        px, py, pz, gap = points[at, 0], points[at, 1], points[at, 2], gaps[at]
                                        away = (px - mx) ** 2 + (py - my) ** 2 + (pz - mz) ** 2
                                        # Neither its plane nor the ball about it is too far.
                                        if (
                                            abs(nx * px + ny * py + nz * pz - offset) < gap
                                            and away < (gap + radius) ** 2
                                        ):
                                            gap2 = on_triangle(px, py, pz, corners, a, b, c)[0]
                                            if gap2 < gap * gap:
                                                gaps[at] = np.sqrt(gap2)
                                                nearest[view, at] = face
                                        at += 1
                                        if at == len(cells) or cells[at] != cell:
                                            break


@kernel_part(inline="always")
def _unit_normal(points: Any, a: int, b: int, c: int) -> tuple[float, float, float]:
    """Zero for a triangle without an area."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    scale = 1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
    return nx * scale, ny * scale, nz * scale
