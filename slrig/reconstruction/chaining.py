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
    in_bands(_chain_kernel, frames, placed, strong, by_strength, borders, shape, order, ends, filled, chains)
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
    begin: int, end: int, placed: Any, strong: Any, by_strength: Any, borders: Any, shape: Any,
    order: Any, ends: Any, filled: Any, chains: Any,
) -> None:  # fmt: skip
    """Chain each frame into its own part of the results.

    placed : (n, 4) x, y and normal of each point. Fills in order, the ends of the chains within each frame's part, and
    how much of either each frame has filled.
    """
    for frame in range(begin, end):
        first, last = borders[frame], borders[frame + 1]
        # at : one more than the point that a pixel holds and no chain has used; 0 for none.
        at = np.zeros(shape, dtype=np.int32)
        for k in range(first, last):
            i = first + by_strength[k]
            row, column = _pixel(placed, i, shape)
            # Where two points fall into one pixel the stronger is kept.
            if at[row, column] == 0:
                at[row, column] = i + 1
        ahead = np.zeros(last - first, dtype=np.int32)
        behind = np.zeros(last - first, dtype=np.int32)
        place = first
        for k in range(first, last):
            start = first + by_strength[k]
            row, column = _pixel(placed, start, shape)
            if not strong[start] or at[row, column] != start + 1:
                continue
            at[row, column] = 0
            forward = _trace(start, 1.0, at, placed, ahead)
            backward = _trace(start, -1.0, at, placed, behind)
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


@kernel_part(inline="always")
def _pixel(placed: Any, i: int, shape: Any) -> Any:
    column = min(max(int(np.rint(placed[i, 0])), 0), shape[1] - 1)
    row = min(max(int(np.rint(placed[i, 1])), 0), shape[0] - 1)
    return row, column


@kernel_part
def _trace(start: int, sign: float, at: Any, placed: Any, out: Any) -> int:
    height, width = at.shape
    current = start
    heading_x, heading_y = -sign * placed[start, 3], sign * placed[start, 2]
    count = 0
    while True:
        octant = _octant(heading_x, heading_y)
        row, column = _pixel(placed, current, at.shape)
        for side in (2, -2):
            k = (octant + side) % 8
            _use_double(current, row + _STEP_Y[k], column + _STEP_X[k], at, placed)
        best = -1
        best_cost = np.nan
        best_distance = 0.0
        for turn in (0, -1, 1):
            k = (octant + turn) % 8
            y, x = row + _STEP_Y[k], column + _STEP_X[k]
            if y < 0 or x < 0 or y >= height or x >= width:
                continue
            other = at[y, x] - 1
            if other < 0:
                continue
            dx, dy = placed[other, 0] - placed[current, 0], placed[other, 1] - placed[current, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            aligned = _alignment(placed, current, other)
            if distance > _LONGEST_STEP_PX or aligned < _SHARPEST_ALIGNED or dx * heading_x + dy * heading_y <= 0:
                continue
            if best < 0:
                best, best_distance = other, distance
                continue
            # Two ways to go on: now the angles themselves are needed.
            if np.isnan(best_cost):
                best_cost = best_distance + np.arccos(_alignment(placed, current, best))
            cost = distance + np.arccos(aligned)
            if cost < best_cost:
                best, best_cost = other, cost
        if best < 0:
            return count
        row, column = _pixel(placed, best, at.shape)
        at[row, column] = 0
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


@kernel_part
def _use_double(current: int, row: int, column: int, at: Any, placed: Any) -> None:
    if row < 0 or column < 0 or row >= at.shape[0] or column >= at.shape[1]:
        return
    other = at[row, column] - 1
    if other < 0:
        return
    dx, dy = placed[other, 0] - placed[current, 0], placed[other, 1] - placed[current, 1]
    across = abs(dx * placed[current, 2] + dy * placed[current, 3])
    if across < _SAME_LINE_PX and _alignment(placed, current, other) > _SAME_LINE_ALIGNED:
        at[row, column] = 0


@kernel_part(inline="always")
def _alignment(placed: Any, a: int, b: int) -> float:
    """Cosine of the angle between two points' lines."""
    return float(min(1.0, abs(placed[a, 2] * placed[b, 2] + placed[a, 3] * placed[b, 3])))
