"""Linking of line points along the stripe (Steger 1998, section 3.2).

From the strongest point that is not yet used, the chain grows both ways: of the three neighbouring pixels ahead the
one with the least distance plus turning angle (radians) follows. Points beside the chain that answer to the same line
are used up with it. A chain ends where nothing follows, or where it meets another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, IntArray

_SHARPEST_TURN = np.pi / 3  # chosen; π/6 and π/2 give the same figures of a rendered vase
_SAME_LINE_ANGLE = np.pi / 6  # as linking after Steger has it
_SAME_LINE_PX = 0.8  # a line may answer again up to 0.6 px away (`steger._TAYLOR_BOX`)
_LONGEST_STEP_PX = 2.2  # chosen; 1.5 takes 61 of 239 246 triangles from a rendered vase, 3.3 changes none
# The neighbours of a pixel, by the octant that they lie in: 0 along x, 2 along y.
_STEP_X = np.array([1, 1, 0, -1, -1, -1, 0, 1])
_STEP_Y = np.array([0, 1, 1, 1, 0, -1, -1, -1])
_SHARPEST_ALIGNED = np.cos(_SHARPEST_TURN)
_SAME_LINE_ALIGNED = np.cos(_SAME_LINE_ANGLE)
_HALF_OCTANT = np.tan(np.pi / 8)  # slope of the border between two octants


def chain_points(
    points_px: FloatArray,
    normals: FloatArray,
    strength: FloatArray,
    strong: NDArray[np.bool_],
    shape: tuple[int, int],
) -> tuple[IntArray, IntArray]:
    """Link the points of one frame.

    points_px : (n, 2) float64 (x, y); normals : (n, 2) float64; strength : (n,) float64;
    strong : (n,) bool, points at which a chain may start; shape : (rows, columns) of the image.
    Returns order, the indices of the points chain by chain, and offsets (chains + 1,). A chain has two points or more.
    """
    # Positive numbers sort as their bits do; complemented, from the largest to the smallest.
    keys = ~strength.astype(np.float32).view(np.uint32)
    # With the index below them no two are equal: this sort takes a third of the time of a stable one.
    by_strength = np.sort(keys.astype(np.uint64) << np.uint64(32) | np.arange(len(keys), dtype=np.uint64))
    placed = np.concatenate([points_px, normals], axis=1)
    order, ends = np.zeros(len(placed), dtype=np.int32), np.zeros(len(placed) + 1, dtype=np.int32)
    count = _chain_kernel(placed, keys, strong, by_strength.astype(np.int32), shape, order, ends)
    return order[: ends[count]], ends[: count + 1]


@kernel
def _chain_kernel(
    placed: Any, keys: Any, strong: Any, by_strength: Any, shape: Any, order: Any, offsets: Any
) -> int:  # fmt: skip
    """Fill in order and offsets, and return the number of chains.

    placed : (n, 4) x, y and normal of each point; keys : (n,) uint32, rising from the strongest.
    """
    height, width = shape
    # at : one more than the point that a pixel holds and no chain has used; 0 for none. In tiles, see `_place`.
    at = np.zeros(-(-height // 4) * -(-width // 4) * 16, dtype=np.int32)
    # Whether a chain may begin at a point: to ask that takes less memory, and so less time, than to look at its pixel.
    may_start = np.zeros(len(placed), dtype=np.bool_)
    ahead = np.zeros(len(placed), dtype=np.int32)
    behind = np.zeros(len(placed), dtype=np.int32)
    for i in range(len(placed)):
        row, column = _pixel(placed, i, height, width)
        here = _place(row, column, width)
        # Where two points fall into one pixel the stronger is kept, the first of equals.
        other = at[here] - 1
        if other < 0 or keys[i] < keys[other]:
            at[here] = i + 1
            may_start[i] = strong[i]
            if other >= 0:
                may_start[other] = False
    place, chains = 0, 0
    for start in by_strength:
        if not may_start[start]:
            continue
        row, column = _pixel(placed, start, height, width)
        at[_place(row, column, width)] = 0
        forward = _trace(start, 1.0, at, height, width, placed, may_start, ahead)
        backward = _trace(start, -1.0, at, height, width, placed, may_start, behind)
        if forward + backward == 0:
            continue
        for j in range(backward - 1, -1, -1):
            order[place] = behind[j]
            place += 1
        order[place] = start
        place += 1
        for j in range(forward):
            order[place] = ahead[j]
            place += 1
        chains += 1
        offsets[chains] = place
    return chains


@kernel_part(inline="always")
def _pixel(placed: Any, i: int, height: int, width: int) -> Any:
    column = min(max(int(np.rint(placed[i, 0])), 0), width - 1)
    row = min(max(int(np.rint(placed[i, 1])), 0), height - 1)
    return row, column


@kernel_part(inline="always")
def _place(row: int, column: int, width: int) -> Any:
    """The index of a pixel in tiles of 4 x 4, each a line of the cache: neighbours are near, whichever way one goes."""
    tile = (row >> 2) * ((width + 3) >> 2) + (column >> 2)
    return np.uintp((tile << 4) + ((row & 3) << 2) + (column & 3))


@kernel_part
def _trace(
    start: int, sign: float, at: Any, height: int, width: int, placed: Any, may_start: Any, out: Any
) -> int:  # fmt: skip
    current = start
    row, column = _pixel(placed, current, height, width)
    heading_x, heading_y = -sign * placed[start, 3], sign * placed[start, 2]
    count = 0
    while True:
        octant = _octant(heading_x, heading_y)
        for side in (2, -2):
            k = (octant + side) & 7
            y, x = row + _STEP_Y[k], column + _STEP_X[k]
            if y < 0 or x < 0 or y >= height or x >= width:
                continue
            here = _place(y, x, width)
            double = at[here] - 1
            if double >= 0 and _is_double(current, double, placed):
                at[here] = 0
                may_start[double] = False
        best = -1
        best_cost = np.nan
        best_distance = 0.0
        best_row, best_column = row, column
        for turn in (0, -1, 1):
            k = (octant + turn) & 7
            y, x = row + _STEP_Y[k], column + _STEP_X[k]
            if y < 0 or x < 0 or y >= height or x >= width:
                continue
            other = at[_place(y, x, width)] - 1
            if other < 0:
                continue
            dx, dy = placed[other, 0] - placed[current, 0], placed[other, 1] - placed[current, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            aligned = _alignment(placed, current, other)
            if distance > _LONGEST_STEP_PX or aligned < _SHARPEST_ALIGNED or dx * heading_x + dy * heading_y <= 0:
                continue
            if best < 0:
                best, best_distance, best_row, best_column = other, distance, y, x
                continue
            # Two ways to go on: now the angles themselves are needed.
            if np.isnan(best_cost):
                best_cost = best_distance + np.arccos(_alignment(placed, current, best))
            cost = distance + np.arccos(aligned)
            if cost < best_cost:
                best, best_cost, best_row, best_column = other, cost, y, x
        if best < 0:
            return count
        row, column = best_row, best_column
        at[_place(row, column, width)] = 0
        may_start[best] = False
        out[count] = best
        count += 1
        tangent_x, tangent_y = -placed[best, 3], placed[best, 2]
        if tangent_x * heading_x + tangent_y * heading_y < 0:
            tangent_x, tangent_y = -tangent_x, -tangent_y
        heading_x, heading_y = tangent_x, tangent_y
        current = best


@kernel_part(inline="always")
def _octant(x: float, y: float) -> int:
    """The direction in eighths of a turn, rounded: 0 along x, 2 along y."""
    if abs(y) <= _HALF_OCTANT * abs(x):
        return 0 if x > 0 else 4
    if abs(x) <= _HALF_OCTANT * abs(y):
        return 2 if y > 0 else 6
    if x > 0:
        return 1 if y > 0 else 7
    return 3 if y > 0 else 5


@kernel_part(inline="always")
def _is_double(current: int, other: int, placed: Any) -> bool:
    """Whether a point beside another one answers to the same line."""
    dx, dy = placed[other, 0] - placed[current, 0], placed[other, 1] - placed[current, 1]
    across = abs(dx * placed[current, 2] + dy * placed[current, 3])
    return bool(across < _SAME_LINE_PX and _alignment(placed, current, other) > _SAME_LINE_ALIGNED)


@kernel_part(inline="always")
def _alignment(placed: Any, a: int, b: int) -> float:
    """Cosine of the angle between two points' lines."""
    return float(min(1.0, abs(placed[a, 2] * placed[b, 2] + placed[a, 3] * placed[b, 3])))
