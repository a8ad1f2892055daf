"""The nearest triangle of each view to points on and in a sparse grid: every triangle asks the points about it.

That is an order of magnitude less work than a tree's walk for each point where triangles are about as large as voxels
(after Mauch 2003, "Efficient algorithms for solving static Hamilton-Jacobi equations", closest point transform).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import nearest_on_triangle
from slrig.model import FloatArray, IntArray
from slrig.views.fusion_grid import CELLS, MARGIN, SEEN_BEYOND, Grid, brick_at, cells_about, new_cache
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
    # Of each cell, and one more: points of a row of cells are those from its first to before the next row's first.
    first_point = np.zeros(CELLS * len(grid.keys) + 1, dtype=np.int32)
    np.cumsum(np.bincount(cells, minlength=len(first_point) - 1), out=first_point[1:])
    views = len(sheets.first_face) - 1
    nearest = np.full((views, len(points)), -1, dtype=np.int32)
    in_bands(_nearest_faces, views, sheets, grid, points, first_point, reach, nearest)
    return nearest


@kernel(in_every_scan=False)
def _nearest_faces(
    first: int, last: int, sheets: Any, grid: Any, points: Any, first_point: Any, reach: Any,
    nearest: Any,
) -> None:  # fmt: skip
    corners, faces, origin, keys, voxel = sheets.points_mm, sheets.faces, grid.origin_mm, grid.keys, grid.voxel_mm
    open_edges, gaps, asked = sheets.open_edges, np.zeros(len(points)), np.zeros(len(corners), np.bool_)
    ox, oy, oz, per_mm, beside = origin[0], origin[1], origin[2], 1.0 / voxel, 1 if reach.width == 0.0 else 0
    cached_keys, cached = new_cache()
    for view in range(first, last):
        gaps[:] = reach.furthest * voxel
        begin, end = sheets.first_face[view], sheets.first_face[view + 1]
        # Vertices come first, as triangles without an extent: few triangles are then nearer than what is known.
        for corner in range(4):
            for face in range(begin, end):
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                if corner < 3:
                    a = b = c = faces[face, corner]
                    if asked[a]:
                        continue
                    asked[a] = True
                about = reach.box + (reach.border if open_edges[face] else 0.0)
                x_low, x_high = cells_about(corners[a, 0], corners[b, 0], corners[c, 0], ox, per_mm, about)
                y_low, y_high = cells_about(corners[a, 1], corners[b, 1], corners[c, 1], oy, per_mm, about)
                z_low, z_high = cells_about(corners[a, 2], corners[b, 2], corners[c, 2], oz, per_mm, about)
                # The corner of a cell that is cut is outside the box; another point of that cell may be inside.
                x_low, y_low, z_low = x_low + beside, y_low + beside, z_low + beside
                ax, ay, az = corners[a, 0], corners[a, 1], corners[a, 2]
                ux, uy, uz = corners[b, 0] - ax, corners[b, 1] - ay, corners[b, 2] - az
                vx, vy, vz = corners[c, 0] - ax, corners[c, 1] - ay, corners[c, 2] - az
                nx, ny, nz = _unit(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
                # Outwards across the edges: from a to b, from c to a, and from b to c, which does not pass through a.
                sx, sy, sz = _unit(uy * nz - uz * ny, uz * nx - ux * nz, ux * ny - uy * nx)
                tx, ty, tz = _unit(ny * vz - nz * vy, nz * vx - nx * vz, nx * vy - ny * vx)
                wx, wy, wz = vx - ux, vy - uy, vz - uz
                wx, wy, wz = _unit(wy * nz - wz * ny, wz * nx - wx * nz, wx * ny - wy * nx)
                third = wx * ux + wy * uy + wz * uz
                for bx in range(x_low >> 3, (x_high >> 3) + 1):
                    for by in range(y_low >> 3, (y_high >> 3) + 1):
                        for bz in range(z_low >> 3, (z_high >> 3) + 1):
                            brick = brick_at(keys, bx, by, bz, cached_keys, cached)
                            if brick < 0:
                                continue
                            z_begin, z_end = max(z_low - 8 * bz, 0), min(z_high - 8 * bz, 7)
                            for x in range(max(x_low - 8 * bx, 0), min(x_high - 8 * bx, 7) + 1):
                                for y in range(max(y_low - 8 * by, 0), min(y_high - 8 * by, 7) + 1):
                                    row = CELLS * brick + 64 * x + 8 * y
                                    for at in range(first_point[row + z_begin], first_point[row + z_end + 1]):
                                        gap = gaps[at]
                                        px, py, pz = points[at, 0], points[at, 1], points[at, 2]
                                        dx, dy, dz = px - ax, py - ay, pz - az
                                        if corner < 3:
                                            gap2 = dx * dx + dy * dy + dz * dz
                                        else:
                                            height = nx * dx + ny * dy + nz * dz
                                            aside = max(sx * dx + sy * dy + sz * dz, tx * dx + ty * dy + tz * dz)
                                            aside = max(aside, wx * dx + wy * dy + wz * dz - third, 0.0)
                                            gap2 = height * height + aside * aside  # at least
                                        if gap2 < gap * gap:
                                            if corner == 3:
                                                gap2 = nearest_on_triangle(px, py, pz, corners, a, b, c)[0]
                                            if gap2 < gap * gap:
                                                gaps[at] = np.sqrt(gap2)
                                                nearest[view, at] = face


@kernel_part(inline="always")
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Zero if it has no length."""
    scale = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-300)
    return x * scale, y * scale, z * scale
