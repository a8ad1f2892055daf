"""A sparse grid about the views: bricks of 8 x 8 x 8 voxels where a triangle passes, and which corners are wanted.

A cell is named by its lowest corner. Flat index: 512 brick + 64 x + 8 y + z, x, y, z in 0 … 7 within the brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import used_vertices
from slrig.model import FloatArray, IntArray
from slrig.views.fusion_sheets import Sheets

BRICK = 8
CELLS = BRICK**3
_AXIS_BITS = 21  # of a key: three coordinates of a brick in 63 bits
_MOST_BRICKS = 400_000  # 2 kB a brick and dense array: about 2 GB with all that fusion holds
MARGIN = 0.1  # voxels: the views' mean may pass a little beside each of them
SEEN_BEYOND = 0.5  # voxels: what lies so near beside a border cannot be told from seen


class Grid(NamedTuple):
    """origin_mm : (3,) float64, the corner of brick (0, 0, 0). keys : (B,) int64, rising, of the bricks that are there.

    around : (B, 27) int32, the bricks about each by 9 dx + 3 dy + dz + 13, -1 where there is none.
    """

    origin_mm: FloatArray
    voxel_mm: float
    keys: NDArray[np.int64]
    around: IntArray


def grid_about(sheets: Sheets, voxel_mm: float) -> Grid:
    """The bricks that hold a corner of a cell in which the fused surface may lie.

    Raises
    ------
    InvalidInputError
        There are more than memory is meant for.
    """
    used = sheets.points_mm[used_vertices(sheets.faces, len(sheets.points_mm))]
    # A brick's width free on all sides, so that every brick has neighbours with keys.
    origin = used.min(axis=0) - 2 * BRICK * voxel_mm
    span = int(((used.max(axis=0) - origin) / (BRICK * voxel_mm)).max()) + 3
    empty = np.zeros((0, 27), dtype=np.int32)
    if span < 1 << _AXIS_BITS:
        bare = Grid(origin, voxel_mm, np.zeros(0, dtype=np.int64), empty)
        keys = np.unique(np.concatenate(in_bands(_touched_bricks, len(sheets.first_face) - 1, sheets, bare)))
    if span >= 1 << _AXIS_BITS or len(keys) > _MOST_BRICKS:
        message = (
            f"voxels of {voxel_mm:g} mm are too small for views that reach over {np.ptp(used, axis=0).max():.0f} mm: "
            f"they take more than {_MOST_BRICKS} bricks of {BRICK}³; ask for larger ones, or cut stray points away"
        )
        raise InvalidInputError(message)
    steps = np.array([-1, 0, 1])
    offsets = ((steps[:, None, None] << 2 * _AXIS_BITS) + (steps[:, None] << _AXIS_BITS) + steps).ravel()
    around = np.full((len(keys), 27), -1, dtype=np.int32)
    for number, offset in enumerate(offsets):
        place = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
        around[:, number] = np.where(keys[place] == keys + offset, place, -1)
    return Grid(origin, voxel_mm, keys, around)


def wanted_corners(sheets: Sheets, grid: Grid) -> IntArray:
    """(n,) int32, rising: flat indices of the corners of all cells that a triangle passes through, or nearly."""
    cells = np.zeros(CELLS * len(grid.keys), dtype=np.uint8)
    _mark_cells(sheets, grid, cells)
    wanted = np.zeros_like(cells)
    _mark_corners(grid.around, cells, wanted)
    return np.flatnonzero(wanted).astype(np.int32)


def corners_mm(grid: Grid, cells: IntArray) -> FloatArray:
    """(n, 3) float64: where the lowest corners of cells lie; cells (n,) int32, flat."""
    key, within = grid.keys[cells // CELLS], cells % CELLS
    bricks = np.stack([key >> 2 * _AXIS_BITS, key >> _AXIS_BITS, key], axis=1) & ((1 << _AXIS_BITS) - 1)
    steps = np.stack([within >> 6, within >> 3 & 7, within & 7], axis=1)
    return np.asarray(grid.origin_mm + grid.voxel_mm * (BRICK * bricks + steps))


@kernel_part
def cell_beside(around: Any, brick: int, x: int, y: int, z: int) -> int:
    """Flat index of a cell by its place from the brick's corner, -8 to 15 each way; -1 where no brick is."""
    other = around[brick, 9 * (x >> 3) + 3 * (y >> 3) + (z >> 3) + 13]
    return -1 if other < 0 else CELLS * other + 64 * (x & 7) + 8 * (y & 7) + (z & 7)


@kernel_part
def corner_of(around: Any, cell: int, corner: int) -> int:
    """Flat index of one of a cell's eight corners, 4 x + 2 y + z, or of the cell there; -1 where no brick is."""
    x, y, z = cell >> 6 & 7, cell >> 3 & 7, cell & 7
    at: int = cell_beside(around, cell // CELLS, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
    return at


@kernel_part
def brick_key(x: int, y: int, z: int) -> int:
    """Key of a brick by its coordinates."""
    return (x << 2 * _AXIS_BITS) + (y << _AXIS_BITS) + z


@kernel_part
def brick_at(keys: Any, x: int, y: int, z: int, cached_keys: Any, cached: Any) -> int:
    """Number of a brick by its coordinates, -1 where there is none; triangles beside one another ask for the same ones.

    cached_keys, cached : (64,) int64, what was asked for last, -1 at first.
    """
    key = brick_key(x, y, z)
    slot = (x & 3) << 4 | (y & 3) << 2 | z & 3
    if cached_keys[slot] != key:
        place = np.searchsorted(keys, key)
        cached_keys[slot] = key
        cached[slot] = place if place < len(keys) and keys[place] == key else -1
    found: int = cached[slot]
    return found


@kernel_part
def new_cache() -> Any:
    """The two arrays that `brick_at` remembers in."""
    return np.full(64, -1, dtype=np.int64), np.full(64, -1, dtype=np.int64)


@kernel_part(inline="always")
def cells_about(a: float, b: float, c: float, origin: float, per_mm: float, about: float) -> tuple[int, int]:
    """The first and the last cell, along an axis, of those that three coordinates and `about` voxels beside them touch.

    Coordinates less the origin's are positive: the grid begins beyond all triangles' reach.
    """
    return int((min(a, b, c) - origin) * per_mm - about), int((max(a, b, c) - origin) * per_mm + about)


@kernel(in_every_scan=False)
def _touched_bricks(first: int, last: int, sheets: Any, grid: Any) -> Any:
    """Keys of the bricks with a corner of a cell in the boxes of these views' triangles, which are wider at borders."""
    points, faces, origin, per_mm = sheets.points_mm, sheets.faces, grid.origin_mm, 1.0 / grid.voxel_mm
    low, high = np.full(3, -1, np.int64), np.full(3, -1, np.int64)
    found, count = np.zeros(1024, dtype=np.int64), 0
    for face in range(sheets.first_face[first], sheets.first_face[last]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond, same = SEEN_BEYOND if sheets.open_edges[face] else MARGIN, True
        for axis in range(3):
            begin, end = cells_about(points[a, axis], points[b, axis], points[c, axis], origin[axis], per_mm, beyond)
            begin, end = begin >> 3, (end + 1) >> 3
            same &= low[axis] == begin and high[axis] == end
            low[axis], high[axis] = begin, end
        if same:
            continue
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1) > _MOST_BRICKS:
            return np.arange(_MOST_BRICKS + 1)  # one triangle alone takes more than are meant
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for z in range(low[2], high[2] + 1):
                    if count == len(found):
                        found = np.concatenate((found, np.zeros_like(found)))
                    found[count] = brick_key(x, y, z)
                    count += 1
    return np.unique(found[:count])


@kernel(in_every_scan=False)
def _mark_cells(sheets: Any, grid: Any, cells: Any) -> None:
    """Mark the cells of a triangle's box that its plane passes through, or nearly."""
    points, faces, keys, open_edges = sheets.points_mm, sheets.faces, grid.keys, sheets.open_edges
    ox, oy, oz, per_mm = grid.origin_mm[0], grid.origin_mm[1], grid.origin_mm[2], 1.0 / grid.voxel_mm
    cached_keys, cached = new_cache()
    key_before, brick = -1, -1
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond = SEEN_BEYOND if open_edges[face] else MARGIN
        px, py, pz = points[a, 0], points[a, 1], points[a, 2]
        x_low, x_high = cells_about(px, points[b, 0], points[c, 0], ox, per_mm, beyond)
        y_low, y_high = cells_about(py, points[b, 1], points[c, 1], oy, per_mm, beyond)
        z_low, z_high = cells_about(pz, points[b, 2], points[c, 2], oz, per_mm, beyond)
        ux, uy, uz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
        vx, vy, vz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        # The plane is n . x = offset, x the lowest corner of a cell in voxels, whose middle is meant.
        # A triangle without an area marks its whole box.
        offset = (nx * (px - ox) + ny * (py - oy) + nz * (pz - oz)) * per_mm - (nx + ny + nz) / 2
        reach = (0.5 + MARGIN) * (abs(nx) + abs(ny) + abs(nz))
        for x in range(x_low, x_high + 1):
            for y in range(y_low, y_high + 1):
                for z in range(z_low, z_high + 1):
                    if abs(nx * x + ny * y + nz * z - offset) <= reach:
                        key = brick_key(x >> 3, y >> 3, z >> 3)
                        if key != key_before:
                            key_before, brick = key, brick_at(keys, x >> 3, y >> 3, z >> 3, cached_keys, cached)
                        cells[CELLS * brick + 64 * (x & 7) + 8 * (y & 7) + (z & 7)] = 1


@kernel(in_every_scan=False)
def _mark_corners(around: Any, cells: Any, wanted: Any) -> None:
    for cell in range(len(cells)):
        if cells[cell]:
            for corner in range(8):
                wanted[corner_of(around, cell, corner)] = 1
