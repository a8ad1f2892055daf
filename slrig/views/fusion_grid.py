"""A sparse grid about the views: bricks of 8 x 8 x 8 voxels where a triangle passes, and which corners are wanted.

A cell is named by its lowest corner. Flat index: 512 brick + 64 x + 8 y + z, x, y, z in 0 … 7 within the brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.topology import used_vertices
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


@kernel_part
def _set_corners_about(sheets: Any, face: int, grid: Any, low: Any, high: Any) -> None:
    """The corners of the cells in a triangle's box, low to high; the box is wider at a border."""
    beyond = SEEN_BEYOND if sheets.open_edges[face] else MARGIN
    a, b, c = sheets.faces[face, 0], sheets.faces[face, 1], sheets.faces[face, 2]
    for axis in range(3):
        p, q, r = sheets.points_mm[a, axis], sheets.points_mm[b, axis], sheets.points_mm[c, axis]
        low[axis] = int((min(p, q, r) - grid.origin_mm[axis]) / grid.voxel_mm - beyond)
        high[axis] = int((max(p, q, r) - grid.origin_mm[axis]) / grid.voxel_mm + beyond) + 1


@kernel(in_every_scan=False)
def _touched_bricks(first: int, last: int, sheets: Any, grid: Any) -> Any:
    """Keys of the bricks with a corner that a triangle of these views may want."""
    low, high, before = np.zeros(3, np.int64), np.zeros(3, np.int64), np.full(6, -1, dtype=np.int64)
    found, count = np.zeros(1024, dtype=np.int64), 0
    for face in range(sheets.first_face[first], sheets.first_face[last]):
        _set_corners_about(sheets, face, grid, low, high)
        same = True
        for axis in range(3):
            begin, end = low[axis] >> 3, high[axis] >> 3
            same &= before[axis] == begin and before[axis + 3] == end
            before[axis], before[axis + 3] = begin, end
        if same:
            continue
        if (before[3] - before[0] + 1) * (before[4] - before[1] + 1) * (before[5] - before[2] + 1) > _MOST_BRICKS:
            return np.arange(_MOST_BRICKS + 1)  # one triangle alone takes more than are meant
        for x in range(before[0], before[3] + 1):
            for y in range(before[1], before[4] + 1):
                for z in range(before[2], before[5] + 1):
                    if count == len(found):
                        found = np.concatenate((found, np.zeros_like(found)))
                    found[count] = brick_key(x, y, z)
                    count += 1
    return np.unique(found[:count])


@kernel(in_every_scan=False)
def _mark_cells(sheets: Any, grid: Any, cells: Any) -> None:
    """Mark the cells of a triangle's box that its plane passes through, or nearly."""
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    cached_keys, cached = new_cache()
    points, faces, origin, keys = sheets.points_mm, sheets.faces, grid.origin_mm, grid.keys
    for face in range(len(faces)):
        _set_corners_about(sheets, face, grid, low, high)
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        px, py, pz = points[a, 0], points[a, 1], points[a, 2]
        ux, uy, uz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
        vx, vy, vz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        # The plane is n . x = offset, x the lowest corner of a cell in voxels, whose middle is meant.
        # A triangle without an area marks its whole box.
        offset = (nx * (px - origin[0]) + ny * (py - origin[1]) + nz * (pz - origin[2])) / grid.voxel_mm
        offset -= (nx + ny + nz) / 2
        reach = (0.5 + MARGIN) * (abs(nx) + abs(ny) + abs(nz))
        for x in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for z in range(low[2], high[2]):
                    if abs(nx * x + ny * y + nz * z - offset) <= reach:
                        brick = brick_at(keys, x >> 3, y >> 3, z >> 3, cached_keys, cached)
                        cells[CELLS * brick + 64 * (x & 7) + 8 * (y & 7) + (z & 7)] = 1


@kernel(in_every_scan=False)
def _mark_corners(around: Any, cells: Any, wanted: Any) -> None:
    for cell in range(len(cells)):
        if cells[cell]:
            for corner in range(8):
                wanted[corner_of(around, cell, corner)] = 1
