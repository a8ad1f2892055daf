"""Linking of line points along the stripe (Steger 1998, section 3.2).

From the strongest point that is not yet used, the chain grows both ways: of the three neighbouring pixels ahead the
one with the least distance plus turning angle (radians) follows. Points beside the chain that answer to the same line
are used up with it. A chain ends where nothing follows, or where it meets another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray

_SHARPEST_TURN = np.pi / 3
_SAME_LINE_ANGLE = np.pi / 6
_SAME_LINE_PX = 0.8
_LONGEST_STEP_PX = 2.2


def chain(
    points_px: FloatArray,
    normals: FloatArray,
    strength: FloatArray,
    strong: NDArray[np.bool_],
    shape: tuple[int, int],
) -> tuple[IntArray, IntArray]:
    """Link points into chains.

    points_px : (n, 2) float64 (x, y); normals : (n, 2) float64; strength : (n,) float64;
    strong : (n,) bool, points at which a chain may start; shape : (rows, columns) of the image.
    Returns order, the indices of the points chain by chain, and offsets (chains + 1,). A chain has two points or more.
    """
    at = np.full(shape, -1, dtype=np.int32)
    columns = np.clip(np.rint(points_px[:, 0]).astype(np.int32), 0, shape[1] - 1)
    rows = np.clip(np.rint(points_px[:, 1]).astype(np.int32), 0, shape[0] - 1)
    by_strength = np.argsort(-strength, kind="stable").astype(np.int32)
    # Where two points fall into one pixel the stronger is kept.
    at[rows[by_strength[::-1]], columns[by_strength[::-1]]] = by_strength[::-1]
    order, offsets = _chain_kernel(at, points_px, normals, columns, rows, strong, by_strength)
    return order, offsets


@njit(cache=True, nogil=True)
def _chain_kernel(at: Any, points: Any, normals: Any, columns: Any, rows: Any, strong: Any, by_strength: Any) -> Any:
    count = len(points)
    used = np.zeros(count, dtype=np.bool_)
    order = np.zeros(count, dtype=np.int32)
    offsets = np.zeros(count + 1, dtype=np.int32)
    ahead = np.zeros(count, dtype=np.int32)
    behind = np.zeros(count, dtype=np.int32)
    filled = 0
    chains = 0
    for start in by_strength:
        if used[start] or not strong[start] or at[rows[start], columns[start]] != start:
            continue
        used[start] = True
        forward = _trace(start, 1.0, at, points, normals, columns, rows, used, ahead)
        backward = _trace(start, -1.0, at, points, normals, columns, rows, used, behind)
        if forward + backward == 0:
            continue
        for k in range(backward - 1, -1, -1):
            order[filled] = behind[k]
            filled += 1
        order[filled] = start
        filled += 1
        for k in range(forward):
            order[filled] = ahead[k]
            filled += 1
        chains += 1
        offsets[chains] = filled
    return order[:filled].copy(), offsets[: chains + 1].copy()


@njit(cache=True, nogil=True)
def _trace(
    start: int, sign: float, at: Any, points: Any, normals: Any, columns: Any, rows: Any, used: Any, out: Any
) -> int:
    height, width = at.shape
    step_x = np.array([1, 1, 0, -1, -1, -1, 0, 1])
    step_y = np.array([0, 1, 1, 1, 0, -1, -1, -1])
    current = start
    heading_x, heading_y = -sign * normals[start, 1], sign * normals[start, 0]
    count = 0
    while True:
        octant = int(np.rint(np.arctan2(heading_y, heading_x) / (np.pi / 4)))
        column, row = columns[current], rows[current]
        for side in (2, -2):
            k = (octant + side) % 8
            _use_double(current, row + step_y[k], column + step_x[k], at, points, normals, used)
        best = -1
        best_cost = np.inf
        for turn in (0, -1, 1):
            k = (octant + turn) % 8
            y, x = row + step_y[k], column + step_x[k]
            if y < 0 or x < 0 or y >= height or x >= width:
                continue
            other = at[y, x]
            if other < 0 or used[other]:
                continue
            dx, dy = points[other, 0] - points[current, 0], points[other, 1] - points[current, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            angle = _angle_between(normals, current, other)
            if distance > _LONGEST_STEP_PX or angle > _SHARPEST_TURN or dx * heading_x + dy * heading_y <= 0:
                continue
            if distance + angle < best_cost:
                best_cost = distance + angle
                best = other
        if best < 0:
            return count
        used[best] = True
        out[count] = best
        count += 1
        tangent_x, tangent_y = -normals[best, 1], normals[best, 0]
        if tangent_x * heading_x + tangent_y * heading_y < 0:
            tangent_x, tangent_y = -tangent_x, -tangent_y
        heading_x, heading_y = tangent_x, tangent_y
        current = best


@njit(cache=True, nogil=True)
def _use_double(current: int, row: int, column: int, at: Any, points: Any, normals: Any, used: Any) -> None:
    if row < 0 or column < 0 or row >= at.shape[0] or column >= at.shape[1]:
        return
    other = at[row, column]
    if other < 0 or used[other]:
        return
    dx, dy = points[other, 0] - points[current, 0], points[other, 1] - points[current, 1]
    across = abs(dx * normals[current, 0] + dy * normals[current, 1])
    if across < _SAME_LINE_PX and _angle_between(normals, current, other) < _SAME_LINE_ANGLE:
        used[other] = True


@njit(cache=True, nogil=True)
def _angle_between(normals: Any, a: int, b: int) -> float:
    dot = abs(normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1])
    return float(np.arccos(min(1.0, dot)))
