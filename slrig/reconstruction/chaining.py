"""Linking of line points along the stripe (Steger 1998, section 3.2).

From the strongest point that is not yet used, the chain grows both ways: of the three neighbouring pixels ahead the
one with the least distance plus turning angle (radians) follows. Points beside the chain that answer to the same line
are used up with it. A chain ends where nothing follows, or where it meets another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
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


def chain_frames(
    points_px: FloatArray,
    normals: FloatArray,
    strength: FloatArray,
    strong: NDArray[np.bool_],
    borders: NDArray[np.int64],
    shape: tuple[int, int],
) -> tuple[IntArray, IntArray, IntArray]:
    """Link the points of several frames, each by itself: frame k holds the points borders[k]:borders[k + 1].

    points_px : (n, 2) float64 (x, y); normals : (n, 2) float64; strength : (n,) float64;
    strong : (n,) bool, points at which a chain may start; shape : (rows, columns) of the image.
    Returns, frame by frame, order, the indices of the points chain by chain, offsets (chains + 1,), and the frame of
    each chain (chains,). A chain has two points or more.
    """
    # Positive numbers sort as their bits do; complemented, from the largest to the smallest.
    keys = ~strength.astype(np.float32).view(np.uint32)
    by_strength = np.zeros(len(keys), dtype=np.int32)
    in_bands(_order_kernel, len(borders) - 1, keys, borders, by_strength)
    placed = np.concatenate([points_px, normals], axis=1)
    frames = len(borders) - 1
    order, ends = np.zeros(len(placed), dtype=np.int32), np.zeros(len(placed), dtype=np.int32)
    filled, chains = np.zeros(frames, dtype=np.int64), np.zeros(frames, dtype=np.int64)
    in_bands(_chain_kernel, frames, placed, keys, strong, by_strength, borders, shape, order, ends, filled, chains)
    none = np.zeros(0, dtype=np.int32)
    parts = list(zip(borders, filled, chains, strict=False))
    lengths = np.concatenate([none, *(np.diff(ends[a : a + count], prepend=0) for a, _, count in parts)])
    return (
        np.concatenate([none, *(order[a : a + count] for a, count, _ in parts)]),
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32),
        np.repeat(np.arange(len(chains), dtype=np.int32), chains),
    )


@kernel
def _order_kernel(begin: int, end: int, keys: Any, borders: Any, order: Any) -> None:
    """For each frame the order of its rising keys, ties by index (radix sort, eleven bits at a time)."""
    for frame in range(begin, end):
        first, last = borders[frame], borders[frame + 1]
        now = np.zeros(last - first, dtype=np.int32)
        for k in range(last - first):
            now[k] = k
        following = np.zeros(last - first, dtype=np.int32)
        for shift in (0, 11, 22):
            place = np.zeros(2049, dtype=np.int64)
            for i in range(first, last):
                place[((keys[i] >> shift) & 2047) + 1] += 1
            for digit in range(2048):
                place[digit + 1] += place[digit]
            for at in range(last - first):
                k = now[at]
                digit = (keys[first + k] >> shift) & 2047
                following[place[digit]] = k
                place[digit] += 1
            now, following = following, now
        for at in range(last - first):
            order[first + at] = now[at]


@kernel
def _chain_kernel(
    begin: int, end: int, placed: Any, keys: Any, strong: Any, by_strength: Any, borders: Any, shape: Any,
    order: Any, ends: Any, filled: Any, chains: Any,
) -> None:  # fmt: skip
    """Chain each frame into its own part of the results.

    placed : (n, 4) x, y and normal of each point; keys : (n,) uint32, rising from the strongest. Fills in order, the
    ends of the chains within each frame's part, and how much of either each frame has filled.
    """
    height, width = shape
    most = np.int64(0)
    for frame in range(begin, end):
        most = max(most, borders[frame + 1] - borders[frame])
    # at : one more than the point that a pixel holds and no chain has used; 0 for none. In tiles, see `_place`.
    at = np.zeros(-(-height // 4) * -(-width // 4) * 16, dtype=np.int32)
    # Whether a chain may begin at a point: to ask that takes less memory, and so less time, than to look at its pixel.
    may_start = np.zeros(most, dtype=np.bool_)
    ahead = np.zeros(most, dtype=np.int32)
    behind = np.zeros(most, dtype=np.int32)
    for frame in range(begin, end):
        first, last = borders[frame], borders[frame + 1]
        for i in range(first, last):
            may_start[i - first] = False
            row, column = _pixel(placed, i, height, width)
            here = _place(row, column, width)
            # Where two points fall into one pixel the stronger is kept, the first of equals.
            other = at[here] - 1
            if other < 0 or keys[i] < keys[other]:
                at[here] = i + 1
                may_start[i - first] = strong[i]
                if other >= 0:
                    may_start[other - first] = False
        place = first
        for k in range(first, last):
            if not may_start[by_strength[k]]:
                continue
            start = first + by_strength[k]
            row, column = _pixel(placed, start, height, width)
            at[_place(row, column, width)] = 0
            forward = _trace(start, 1.0, at, height, width, placed, first, may_start, ahead)
            backward = _trace(start, -1.0, at, height, width, placed, first, may_start, behind)
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
            ends[first + chains[frame]] = place - first
            chains[frame] += 1
        filled[frame] = place - first
        for i in range(first, last):
            row, column = _pixel(placed, i, height, width)
            at[_place(row, column, width)] = 0


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
    start: int, sign: float, at: Any, height: int, width: int, placed: Any, first: int, may_start: Any, out: Any
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
                may_start[double - first] = False
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
        may_start[best - first] = False
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
