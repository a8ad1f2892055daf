"""Sub-pixel points on light stripes and on code edges, and their chaining along each stripe.

Stripes: Steger's curvilinear detector (PAMI 20(2) 1998, 113-125) with one further Newton step on kernels re-centred on
the sub-pixel point, which removes the S-shaped error of a single Taylor step. Code edges: the zero crossing of a bit
minus its inverse along its gradient, by the same two steps. Both give points, normals and a standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray

RIDGE = 0
"""Bright lines: points where the first derivative across the line is zero."""

EDGE = 1
"""Steps through zero: points where the value is zero."""

_MIN_SIDE = 0.8  # of light and dark, which are 1 and -1
_SUPPORT = 3.6  # kernel radius in sigmas
_TAYLOR_BOX = 0.6  # a point this far from the pixel centre still belongs to it; chaining drops double responses
_NEWTON_BOX = 1.1  # half a pixel more than in the first step
_BEND_SHARE, _MIN_BEND_SIGMA = 0.4, 2.5  # see `_points_kernel`
_VECTOR = 4  # numbers of double precision in a vector register
_MIN_ROWS, _MIN_POINTS = 32, 1024  # least number for one call of a kernel

_MAX_TURN = np.pi / 3  # chosen; π/6 and π/2 make no difference
_SAME_LINE_ANGLE = np.pi / 6  # as in Steger's linking
_SAME_LINE_PX = 0.8  # a line may respond again up to 0.6 px away (`_TAYLOR_BOX`)
_MAX_STEP_PX = 2.2  # chosen; 1.5 loses points, 3.3 makes no difference
# Neighbours of a pixel by octant: 0 along x, 2 along y.
_STEP_X = np.array([1, 1, 0, -1, -1, -1, 0, 1])
_STEP_Y = np.array([0, 1, 1, 1, 0, -1, -1, -1])
_MIN_TURN_COSINE = np.cos(_MAX_TURN)
_SAME_LINE_COSINE = np.cos(_SAME_LINE_ANGLE)
_HALF_OCTANT = np.tan(np.pi / 8)  # slope of the border between two octants


def gaussian_kernels(filter_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Sampled Gaussian of this scale and its first two derivatives, each (2 r + 1,) float32."""
    radius = int(np.ceil(_SUPPORT * filter_px))
    offset = np.arange(-radius, radius + 1, dtype=np.float64)
    zero = np.exp(-(offset**2) / (2 * filter_px**2))
    zero /= zero.sum()
    one = offset / filter_px**2 * zero
    one /= (one * offset).sum()
    two = (offset**2 / filter_px**4 - 1 / filter_px**2) * zero
    two -= two.mean()
    two /= (two * offset**2).sum() / 2
    # For correlation: a rising ramp gives +1 with `one`, a parabola x²/2 gives +1 with `two`.
    return zero.astype(np.float32), one.astype(np.float32), two.astype(np.float32)


def taylor_step(
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    weak: np.float32,
    zero: NDArray[np.float32],
    one: NDArray[np.float32],
    two: NDArray[np.float32],
    kind: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Make one Taylor step at every lit pixel whose response exceeds `weak` times its noise.

    image, noise : (H, W) float32; zero, one, two : from `gaussian_kernels`; kind : `RIDGE` or `EDGE`. Returns the
    offsets (H, W, 2) of the points from their pixels, x and y, and the responses (H, W), 0 without a point.
    """
    offset, response = np.zeros((*image.shape, 2), dtype=np.float32), np.zeros(image.shape, dtype=np.float32)
    in_bands(
        _taylor_kernel, len(image), image, noise, lit, weak, zero, one, two, kind, offset, response,
        rows_at_least=_MIN_ROWS,
    )  # fmt: skip
    return offset, response


@kernel
def _taylor_kernel(
    first: int, last: int, image: Any, noise: Any, lit: Any, weak: Any, zero: Any, one: Any, two: Any, kind: int,
    offset: Any, response: Any,
) -> None:  # fmt: skip
    """Fill in offset and response, which are zeros.

    The filters are separable, even or odd. Rows are filtered first, then along the row while it is in the cache.
    """
    columns = image.shape[1]
    radius = len(zero) // 2
    g0, g1, g2 = zero[radius:], one[radius:], two[radius:]
    down = np.zeros((3, columns + 2 * radius), dtype=np.float32)
    along = np.zeros((6, columns), dtype=np.float32)
    for y in range(first, last):
        begin, end = _lit_range(lit[y])
        if begin == end:
            continue
        _filter_down(image, y, radius, max(begin - radius, 0), min(end + radius, columns), g0, g1, g2, down)
        _filter_along(down, radius, begin, end, g0, g1, g2, along)
        for x in range(begin, end):
            if not lit[y, x]:
                continue
            r, rx, ry, rxx, rxy, ryy = (
                along[0, x], along[1, x], along[2, x], along[3, x], along[4, x], along[5, x]
            )  # fmt: skip
            if kind == RIDGE:
                if rxx + ryy > 0:
                    continue
                nx, ny, curvature = _ridge_normal(rxx, rxy, ryy)
                if not -curvature > weak * noise[y, x]:
                    continue
                t = -(rx * nx + ry * ny) / curvature
                strength = -curvature
            else:
                strength = np.sqrt(rx * rx + ry * ry)
                if not strength > max(weak * noise[y, x], 1e-9):
                    continue
                nx, ny = rx / strength, ry / strength
                t = -r / strength
            if abs(t * nx) <= _TAYLOR_BOX and abs(t * ny) <= _TAYLOR_BOX:
                offset[y, x, 0] = t * nx
                offset[y, x, 1] = t * ny
                response[y, x] = strength


@kernel_part
def _lit_range(lit: Any) -> Any:
    """First lit pixel of a row, and last plus one; twice the same if none is lit."""
    begin, end = 0, len(lit)
    while begin < end and not lit[begin]:
        begin += 1
    while begin < end and not lit[end - 1]:
        end -= 1
    return begin, end


@kernel_part
def _filter_down(
    image: Any, y: int, radius: int, begin: int, end: int, g0: Any, g1: Any, g2: Any, out: Any
) -> None:  # fmt: skip
    """Fill (3, columns + 2 radius) with the image rows round y, smoothed and differentiated once and twice.

    Only columns from begin to end are filled, and the margins beyond the image, reflected about its outermost pixels.
    """
    rows, columns = image.shape
    count = end - begin
    smooth, first, second = (
        out[0, radius + begin :], out[1, radius + begin :], out[2, radius + begin :]
    )  # fmt: skip
    middle = image[y, begin:]
    _scale(smooth, count, g0[0], middle)
    _scale(second, count, g2[0], middle)
    first[:count] = 0
    for t in range(1, radius, 2):
        above, below = image[_reflect(y - t, rows), begin:], image[_reflect(y + t, rows), begin:]
        top, bottom = image[_reflect(y - t - 1, rows), begin:], image[_reflect(y + t + 1, rows), begin:]
        _add_two(smooth, count, g0[t], below, above, g0[t + 1], bottom, top)
        _subtract_two(first, count, g1[t], below, above, g1[t + 1], bottom, top)
        _add_two(second, count, g2[t], below, above, g2[t + 1], bottom, top)
    if radius % 2:
        above, below = image[_reflect(y - radius, rows), begin:], image[_reflect(y + radius, rows), begin:]
        _add(smooth, count, g0[radius], below, above)
        _subtract(first, count, g1[radius], below, above)
        _add(second, count, g2[radius], below, above)
    for k in range(3):
        for t in range(1, radius + 1):
            out[k, radius - t] = out[k, radius + _reflect(-t, columns)]
            out[k, radius + columns - 1 + t] = out[k, radius + _reflect(columns - 1 + t, columns)]


@kernel_part
def _filter_along(down: Any, radius: int, begin: int, end: int, g0: Any, g1: Any, g2: Any, out: Any) -> None:
    """Fill (6, columns) from begin to end with r, rx, ry, rxx, rxy, ryy of one row."""
    smooth, first, second = down[0, begin:], down[1, begin:], down[2, begin:]
    _filter_even(out[0, begin:end], radius, g0, smooth)
    _filter_odd(out[1, begin:end], radius, g1, smooth)
    _filter_even(out[2, begin:end], radius, g0, first)
    _filter_even(out[3, begin:end], radius, g2, smooth)
    _filter_odd(out[4, begin:end], radius, g1, first)
    _filter_even(out[5, begin:end], radius, g0, second)


@kernel_part
def _filter_even(out: Any, radius: int, weights: Any, row: Any) -> None:
    count = len(out)
    _scale(out, count, weights[0], row[radius:])
    for t in range(1, radius, 2):
        left, right = radius - t, radius + t
        _add_two(out, count, weights[t], row[right:], row[left:], weights[t + 1], row[right + 1 :], row[left - 1 :])
    if radius % 2:
        _add(out, count, weights[radius], row[2 * radius :], row)


@kernel_part
def _filter_odd(out: Any, radius: int, weights: Any, row: Any) -> None:
    count = len(out)
    out[:] = 0
    for t in range(1, radius, 2):
        left, right = radius - t, radius + t
        _subtract_two(
            out, count, weights[t], row[right:], row[left:], weights[t + 1], row[right + 1 :], row[left - 1 :]
        )  # fmt: skip
    if radius % 2:
        _subtract(out, count, weights[radius], row[2 * radius :], row)


# Loops over five arrays at most, one of them written: with more, the compiler cannot prove that they do not overlap,
# and does not vectorise.
@kernel_part
def _scale(out: Any, count: int, weight: Any, row: Any) -> None:
    for x in range(count):
        out[x] = weight * row[x]


@kernel_part
def _add(out: Any, count: int, weight: Any, right: Any, left: Any) -> None:
    for x in range(count):
        out[x] += weight * (right[x] + left[x])


@kernel_part
def _subtract(out: Any, count: int, weight: Any, right: Any, left: Any) -> None:
    for x in range(count):
        out[x] += weight * (right[x] - left[x])


@kernel_part
def _add_two(
    out: Any, count: int, weight: Any, right: Any, left: Any, other: Any, far_right: Any, far_left: Any
) -> None:  # fmt: skip
    for x in range(count):
        out[x] = out[x] + weight * (right[x] + left[x]) + other * (far_right[x] + far_left[x])


@kernel_part
def _subtract_two(
    out: Any, count: int, weight: Any, right: Any, left: Any, other: Any, far_right: Any, far_left: Any
) -> None:  # fmt: skip
    for x in range(count):
        out[x] = out[x] + weight * (right[x] - left[x]) + other * (far_right[x] - far_left[x])


@kernel_part(inline="always")
def _reflect(index: int, count: int) -> int:
    while index < 0 or index >= count:
        index = -index if index < 0 else 2 * (count - 1) - index
        if count == 1:
            return 0
    return index


@kernel_part(inline="always")
def _ridge_normal(rxx: float, rxy: float, ryy: float) -> Any:
    # Eigenvector of the symmetric 2 x 2 Hessian for the eigenvalue of largest magnitude.
    half = 0.5 * (rxx - ryy)
    root = np.sqrt(half * half + rxy * rxy)
    mean = 0.5 * (rxx + ryy)
    value = mean + root if mean > 0 else mean - root
    ax, ay = rxy, value - rxx
    bx, by = value - ryy, rxy
    if ax * ax + ay * ay < bx * bx + by * by:
        ax, ay = bx, by
    length = np.sqrt(ax * ax + ay * ay)
    if length < 1e-20:
        return 1.0, 0.0, value
    return ax / length, ay / length, value


def newton_step(
    image: NDArray[np.float32], offset: NDArray[np.float32], columns: IntArray, rows: IntArray, sigma: float, kind: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Make one Newton step from the offsets of these pixels, (n,) each, on kernels centred there.

    Returns x and y (n,), px, normal (n, 2) and response (n,) at the start, the bend of edges there, (n,): the second
    derivative across the edge over the first, 1/px; and (n,) bool: True if the step stayed near.
    """
    count = len(columns)
    x, y, response, bend = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    normals, valid = np.zeros((count, 2)), np.zeros(count, dtype=np.bool_)
    in_bands(
        _newton_kernel, count, image, offset, columns, rows, sigma, kind, x, y, normals, response, bend, valid,
        rows_at_least=_MIN_POINTS,
    )  # fmt: skip
    return x, y, normals, response, bend, valid


@kernel
def _newton_kernel(
    first: int, last: int, image: Any, offset: Any, columns: Any, rows: Any, sigma: float, kind: int,
    x_out: Any, y_out: Any, normals: Any, response: Any, bend: Any, valid: Any,
) -> None:  # fmt: skip
    height, width = image.shape
    radius = int(np.ceil(_SUPPORT * sigma))
    size = 2 * radius + 1
    # One by one: numba names an expression of arrays by its address, and the machine code would differ each time.
    whole = np.zeros(size)
    for k in range(size):
        whole[k] = np.exp(-((k - radius) ** 2) / (2 * sigma * sigma))
    wx = np.zeros((3, size))
    wy = np.zeros((3, size))
    flat = image.reshape(-1)
    # Whole vectors of columns: the sums of those beyond the window are not used.
    lanes = min(-(-size // _VECTOR) * _VECTOR, width)
    last_start = len(flat) - (size - 1) * width - lanes
    smooth, once, twice = np.zeros(lanes), np.zeros(lanes), np.zeros(lanes)
    for i in range(first, last):
        column, row = columns[i], rows[i]
        if column < radius or row < radius or column >= width - radius or row >= height - radius:
            continue
        fx, fy = float(offset[row, column, 0]), float(offset[row, column, 1])
        _centred_weights(wx, fx, sigma, whole)
        _centred_weights(wy, fy, sigma, whole)
        corner = (row - radius) * width + column - radius
        window_start = min(corner, last_start)
        _sum_columns(flat, window_start, width, wy, smooth, once, twice)
        r = rx = ry = rxx = rxy = ryy = 0.0
        for k in range(size):
            s0, s1, s2 = (
                smooth[corner - window_start + k],
                once[corner - window_start + k],
                twice[corner - window_start + k],
            )
            r += s0 * wx[0, k]
            rx += s0 * wx[1, k]
            rxx += s0 * wx[2, k]
            ry += s1 * wx[0, k]
            rxy += s1 * wx[1, k]
            ryy += s2 * wx[0, k]
        if kind == RIDGE:
            nx, ny, curvature = _ridge_normal(rxx, rxy, ryy)
            if curvature >= 0:
                continue
            t = -(rx * nx + ry * ny) / curvature
            strength = -curvature
        else:
            strength = np.sqrt(rx * rx + ry * ry)
            if strength <= 1e-9:
                continue
            nx, ny = rx / strength, ry / strength
            t = -r / strength
            bend[i] = (rxx * nx * nx + 2 * rxy * nx * ny + ryy * ny * ny) / strength
        x, y = fx + t * nx, fy + t * ny
        if abs(x) > _NEWTON_BOX or abs(y) > _NEWTON_BOX:
            continue
        x_out[i], y_out[i] = column + x, row + y
        normals[i, 0], normals[i, 1] = nx, ny
        response[i] = strength
        valid[i] = True


@kernel_part
def _sum_columns(flat: Any, corner: int, width: int, weights: Any, smooth: Any, first: Any, second: Any) -> None:
    """Fill (lanes,) each with sums down the columns of a window, weighted with each row of weights, (3, size).

    flat, corner, width : pixels of the image, index of the first of the window, and length of a row. Neighbouring
    columns are summed together in vector registers, two rows at a time, since each iteration waits for the sums before
    it.
    """
    lanes = len(smooth)
    line = flat[corner:]
    w0, w1, w2 = weights[0, 0], weights[1, 0], weights[2, 0]
    for k in range(lanes):
        value = float(line[k])
        smooth[k] = value * w0
        first[k] = value * w1
        second[k] = value * w2
    for j in range(1, weights.shape[1], 2):
        line, following = flat[corner + j * width :], flat[corner + (j + 1) * width :]
        w0, w1, w2 = weights[0, j], weights[1, j], weights[2, j]
        u0, u1, u2 = weights[0, j + 1], weights[1, j + 1], weights[2, j + 1]
        for k in range(lanes):
            value, below = float(line[k]), float(following[k])
            smooth[k] += value * w0 + below * u0
            first[k] += value * w1 + below * u1
            second[k] += value * w2 + below * u2


@kernel_part
def _centred_weights(out: Any, centre: float, sigma: float, whole: Any) -> None:
    """Fill (3, size) with weights of Gaussian, first and second derivative for samples at -radius … radius.

    whole : (size,) values of the Gaussian with centre 0. For another centre f each changes by exp(f k / σ²) and by a
    common factor.
    """
    zero, one, two = out[0], out[1], out[2]
    size = len(zero)
    radius = size // 2
    variance = sigma * sigma
    step = np.exp(centre / variance)
    back = 1 / step
    total = zero[radius] = whole[radius]
    up = down = 1.0
    for k in range(1, radius + 1):
        up *= step
        down *= back
        right, left = whole[radius + k] * up, whole[radius - k] * down
        zero[radius + k] = right
        zero[radius - k] = left
        total += right + left
    # Division takes several times as long as multiplication.
    share = 1 / total
    of_one = share / variance
    of_two = of_one / variance
    for k in range(size):
        at = k - radius - centre
        value = zero[k]
        zero[k] = value * share
        one[k] = at * (value * of_one)
        two[k] = (at * at - variance) * (value * of_two)


def chain_points(
    points_px: FloatArray, normals: FloatArray, strength: FloatArray, strong: NDArray[np.bool_], shape: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Link the points of one frame.

    points_px : (n, 2) float64 (x, y); normals : (n, 2) float64; strength : (n,) float64; strong : (n,) bool, points at
    which a chain may start; shape : (rows, columns) of the image. Returns order, the indices of the points chain by
    chain, and offsets (chains + 1,). A chain has two points or more.
    """
    # Positive floats sort by their bits; complemented, from the largest to the smallest.
    keys = ~strength.astype(np.float32).view(np.uint32)
    # With the index in the lower bits no two are equal: this sort takes a third of the time of a stable one.
    by_strength = np.sort(keys.astype(np.uint64) << np.uint64(32) | np.arange(len(keys), dtype=np.uint64))
    vectors = np.concatenate([points_px, normals], axis=1)
    order, ends = np.zeros(len(vectors), dtype=np.int32), np.zeros(len(vectors) + 1, dtype=np.int32)
    count = _chain_kernel(vectors, keys, strong, by_strength.astype(np.int32), shape, order, ends)
    return order[: ends[count]], ends[: count + 1]


@kernel
def _chain_kernel(
    vectors: Any, keys: Any, strong: Any, by_strength: Any, shape: Any, order: Any, offsets: Any
) -> int:  # fmt: skip
    """Fill in order and offsets, and return the number of chains.

    vectors : (n, 4) x, y and normal of each point; keys : (n,) uint32, rising from the strongest.
    """
    height, width = shape
    # point_at : index + 1 of the unused point at a pixel; 0 for none. In tiles, see `_tile_index`.
    point_at = np.zeros(-(-height // 4) * -(-width // 4) * 16, dtype=np.int32)
    # True if a chain may start at a point. This array is smaller than `point_at`, and faster to read.
    may_start = np.zeros(len(vectors), dtype=np.bool_)
    ahead = np.zeros(len(vectors), dtype=np.int32)
    behind = np.zeros(len(vectors), dtype=np.int32)
    for i in range(len(vectors)):
        row, column = _pixel(vectors, i, height, width)
        here = _tile_index(row, column, width)
        # Of two points in one pixel the stronger is used, the first of equals.
        other = point_at[here] - 1
        if other < 0 or keys[i] < keys[other]:
            point_at[here] = i + 1
            may_start[i] = strong[i]
            if other >= 0:
                may_start[other] = False
    place, chains = 0, 0
    for start in by_strength:
        if not may_start[start]:
            continue
        row, column = _pixel(vectors, start, height, width)
        point_at[_tile_index(row, column, width)] = 0
        forward = _trace(start, 1.0, point_at, height, width, vectors, may_start, ahead)
        backward = _trace(start, -1.0, point_at, height, width, vectors, may_start, behind)
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
def _pixel(vectors: Any, i: int, height: int, width: int) -> Any:
    column = min(max(int(np.rint(vectors[i, 0])), 0), width - 1)
    row = min(max(int(np.rint(vectors[i, 1])), 0), height - 1)
    return row, column


@kernel_part(inline="always")
def _tile_index(row: int, column: int, width: int) -> Any:
    """Index of a pixel in tiles of 4 x 4, each a line of the cache, so that neighbours in all directions are near."""
    tile = (row >> 2) * ((width + 3) >> 2) + (column >> 2)
    return np.uintp((tile << 4) + ((row & 3) << 2) + (column & 3))


@kernel_part
def _trace(
    start: int, sign: float, point_at: Any, height: int, width: int, vectors: Any, may_start: Any, out: Any
) -> int:  # fmt: skip
    current = start
    row, column = _pixel(vectors, current, height, width)
    heading_x, heading_y = -sign * vectors[start, 3], sign * vectors[start, 2]
    count = 0
    while True:
        octant = _octant(heading_x, heading_y)
        for side in (2, -2):
            k = (octant + side) & 7
            y, x = row + _STEP_Y[k], column + _STEP_X[k]
            if y < 0 or x < 0 or y >= height or x >= width:
                continue
            here = _tile_index(y, x, width)
            double = point_at[here] - 1
            if double >= 0 and _is_double(current, double, vectors):
                point_at[here] = 0
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
            other = point_at[_tile_index(y, x, width)] - 1
            if other < 0:
                continue
            dx, dy = vectors[other, 0] - vectors[current, 0], vectors[other, 1] - vectors[current, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            aligned = _alignment(vectors, current, other)
            if distance > _MAX_STEP_PX or aligned < _MIN_TURN_COSINE or dx * heading_x + dy * heading_y <= 0:
                continue
            if best < 0:
                best, best_distance, best_row, best_column = other, distance, y, x
                continue
            # Two candidates: the angles themselves are needed.
            if np.isnan(best_cost):
                best_cost = best_distance + np.arccos(_alignment(vectors, current, best))
            cost = distance + np.arccos(aligned)
            if cost < best_cost:
                best, best_cost, best_row, best_column = other, cost, y, x
        if best < 0:
            return count
        row, column = best_row, best_column
        point_at[_tile_index(row, column, width)] = 0
        may_start[best] = False
        out[count] = best
        count += 1
        tangent_x, tangent_y = -vectors[best, 3], vectors[best, 2]
        if tangent_x * heading_x + tangent_y * heading_y < 0:
            tangent_x, tangent_y = -tangent_x, -tangent_y
        heading_x, heading_y = tangent_x, tangent_y
        current = best


@kernel_part(inline="always")
def _octant(x: float, y: float) -> int:
    """Direction in eighths of a turn, rounded: 0 along x, 2 along y."""
    if abs(y) <= _HALF_OCTANT * abs(x):
        return 0 if x > 0 else 4
    if abs(x) <= _HALF_OCTANT * abs(y):
        return 2 if y > 0 else 6
    if x > 0:
        return 1 if y > 0 else 7
    return 3 if y > 0 else 5


@kernel_part(inline="always")
def _is_double(current: int, other: int, vectors: Any) -> bool:
    """True if a neighbouring point is a response to the same line."""
    dx, dy = vectors[other, 0] - vectors[current, 0], vectors[other, 1] - vectors[current, 1]
    across = abs(dx * vectors[current, 2] + dy * vectors[current, 3])
    return bool(across < _SAME_LINE_PX and _alignment(vectors, current, other) > _SAME_LINE_COSINE)


@kernel_part(inline="always")
def _alignment(vectors: Any, a: int, b: int) -> float:
    """Cosine of the angle between the lines of two points."""
    return float(min(1.0, abs(vectors[a, 2] * vectors[b, 2] + vectors[a, 3] * vectors[b, 3])))


@dataclass(frozen=True, slots=True)
class StripeLimits:
    """Thresholds for stripes.

    filter_px : scale of the Gaussian; None matches it to the stripes, between 1 and 2.5 px. strong_sigma, weak_sigma :
    hysteresis, in standard deviations of the response to noise. weak_fraction : least fraction of the typical response
    of the image. shortest_points : a stripe of fewer points is refused.
    """

    filter_px: float | None = None
    strong_sigma: float = 7.0
    weak_sigma: float = 3.5
    weak_fraction: float = 0.12
    shortest_points: int = 5


@dataclass(frozen=True, slots=True)
class Stripes:
    """Chains of sub-pixel points. Chain i holds the points offsets[i]:offsets[i + 1], in order along the curve.

    offsets : (s + 1,) int32; frame : (s,) int32, index of the line or bit frame of the chain. points_px : (n, 2)
    float64, (x, y) in the camera image; normals : (n, 2) float64, unit, across the curve. sigma_px : (n,) float64,
    standard deviation across the curve from noise.
    """

    offsets: IntArray
    frame: IntArray
    points_px: FloatArray
    normals: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.offsets) - 1


class LinePoints(NamedTuple):
    """Sub-pixel points of one line or bit frame, not yet linked.

    points_px, normals, sigma_px : as in `Stripes`; strength : (n,) float64, response of the filter; strong : (n,) bool,
    points at which a stripe may begin.
    """

    points_px: FloatArray
    normals: FloatArray
    strength: FloatArray
    strong: NDArray[np.bool_]
    sigma_px: FloatArray

    def head(self, count: int) -> LinePoints:
        """The first `count` points."""
        return LinePoints(
            self.points_px[:count], self.normals[:count], self.strength[:count], self.strong[:count],
            self.sigma_px[:count],
        )  # fmt: skip


def chain_stripes(frames: Sequence[LinePoints], shape: tuple[int, int], /) -> Stripes:
    """Link the points of each frame along their lines, and return all chains, frame by frame.

    shape : (rows, columns) of the image.
    """

    def chain(first: int, last: int) -> list[tuple[IntArray, IntArray]]:
        return [chain_points(*each[:4], shape) for each in frames[first:last]]

    # Points are copied once, when all indices are known, since they and the chains are large.
    chains = [each for band in in_bands(chain, len(frames)) for each in band]
    borders = np.cumsum([0, *(len(order) for order, _ in chains)])
    count = int(borders[-1])
    points_px, normals, sigma_px = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count)

    def gather(first: int, last: int) -> None:
        for index in range(first, last):
            points, order, part = frames[index], chains[index][0], slice(borders[index], borders[index + 1])
            np.take(points.points_px, order, axis=0, out=points_px[part], mode="clip")
            np.take(points.normals, order, axis=0, out=normals[part], mode="clip")
            np.take(points.sigma_px, order, out=sigma_px[part], mode="clip")

    in_bands(gather, len(frames))
    lengths = [np.diff(offsets) for _, offsets in chains]
    frame = np.repeat(np.arange(len(frames), dtype=np.int32), [len(each) for each in lengths])
    offsets = np.cumsum(np.concatenate([[0], *lengths]), dtype=np.int32)
    return Stripes(offsets, frame, points_px, normals, sigma_px)


def gather_points(
    order: IntArray, points_px: FloatArray, normals: FloatArray, sigma_px: FloatArray, /
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points, normals and deviations at the indices `order`."""
    return np.take(points_px, order, axis=0), np.take(normals, order, axis=0), np.take(sigma_px, order)


def normalise(
    image: NDArray[np.float32], black: NDArray[np.float32], contrast: NDArray[np.float32], noise: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return light relative to white, without albedo, and its noise.

    (I - black)/(white - black), damped to zero where the contrast does not exceed the noise. noise : (H, W) float32,
    standard deviation of I - black, camera units.
    """
    light, deviation = np.zeros_like(image), np.zeros_like(image)
    in_bands(normalise_kernel, len(image), image, black, contrast, noise, light, deviation)
    return light, deviation


@kernel(in_every_scan=False)
def normalise_kernel(
    first: int, last: int, image: Any, black: Any, contrast: Any, noise: Any, light: Any, deviation: Any
) -> None:
    """Fill in light and deviation: see `normalise`."""
    for y in range(first, last):
        for x in range(image.shape[1]):
            weight = _weight(contrast[y, x], noise[y, x])
            light[y, x] = (image[y, x] - black[y, x]) * weight
            deviation[y, x] = noise[y, x] * abs(weight)


@kernel_part(inline="always")
def _weight(contrast: Any, noise: Any) -> Any:
    """1/contrast, damped to zero where the contrast does not exceed the noise."""
    damping = np.float32(3) * noise
    squared = contrast * contrast + damping * damping
    return contrast / squared if squared > 0 else np.float32(0)


def normalise_line(
    line: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    read_variance: float,
    slope: float,
    reference_repeats: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normalise a line frame as `normalise` does, with the noise of line, white and black by their share in the result.

    read_variance, slope : of the camera's noise; reference_repeats : number of frames that white and black are means
    of.
    """
    light, deviation = np.zeros_like(line), np.zeros_like(line)
    in_bands(
        _normalise_line_kernel, len(line), line, white, black, read_variance, slope, reference_repeats, light, deviation
    )
    return light, deviation


@kernel
def _normalise_line_kernel(
    first: int, last: int, line: Any, white: Any, black: Any, read: float, slope: float, reference_repeats: float,
    normal: Any, deviation: Any,
) -> None:  # fmt: skip
    for y in range(first, last):
        for x in range(line.shape[1]):
            contrast, above = white[y, x] - black[y, x], line[y, x] - black[y, x]
            # (I - black)/(white - black) contains 1 - light of black's noise and light of white's.
            light = min(max(above / max(contrast, np.float32(1)), np.float32(0)), np.float32(1))
            of_white = (read + slope * max(white[y, x], np.float32(0))) / reference_repeats
            of_black = (read + slope * max(black[y, x], np.float32(0))) / reference_repeats
            own = read + slope * max(line[y, x], np.float32(0))
            noise = np.float32(np.sqrt(own + (1 - light) ** 2 * of_black + light**2 * of_white))
            weight = _weight(contrast, noise)
            normal[y, x] = above * weight
            deviation[y, x] = noise * abs(weight)


def stripe_width_px(image: NDArray[np.float32], noise: NDArray[np.float32], lit: NDArray[np.bool_]) -> float:
    """Standard deviation of the cross-section of the stripes, px: median over the clear points of one frame.

    For a Gaussian bar smoothed to scale S the response is -r/S² at the centre, so S² = -r/r_nn.
    """
    probe = 1.2
    found = line_points(RIDGE, image, noise, lit, StripeLimits(weak_sigma=12.0), filter_px=probe)
    strength = found.strength
    if len(strength) < 50:
        return probe
    smooth = cv2.GaussianBlur(image, (0, 0), probe)
    x, y = np.rint(found.points_px).astype(int).T
    value = smooth[y, x]
    clear = strength > np.median(strength)
    squared = np.median(value[clear] / strength[clear]) - probe**2
    return float(np.sqrt(max(squared, 0.25)))


def line_points(
    kind: int,
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    limits: StripeLimits,
    /,
    *,
    filter_px: float,
) -> LinePoints:
    """Points of one frame, with their standard deviations.

    kind : `RIDGE` or `EDGE`; image, noise : (H, W) float32; lit : (H, W) bool, pixels that can contain a point;
    filter_px : scale of the Gaussian.
    """
    # Standard deviation of the response to noise over that of the noise: ∫ g_xx² = 3/(16 π σ⁶) for the ridge response,
    # ∫ g_x² = 1/(8 π σ⁴) for the gradient. For the numerator of the last step: ∫ g_x², and ∫ g² = 1/(4 π σ²).
    gradient_noise = np.sqrt(1 / (8 * np.pi)) / filter_px**2
    bend_noise = np.sqrt(3 / (16 * np.pi)) / filter_px**3
    if kind == RIDGE:
        response_noise, gain = bend_noise, gradient_noise
    else:
        response_noise, gain = gradient_noise, np.sqrt(1 / (4 * np.pi)) / filter_px
    weakest = np.float32(limits.weak_sigma * response_noise)
    offset, strength = taylor_step(image, noise, lit, weakest, *gaussian_kernels(filter_px), kind)
    rows, columns, height = _responses_kernel(strength)
    if len(height):
        significant = height > limits.weak_fraction * np.percentile(height, 90)
        rows, columns = rows[significant], columns[significant]
    x, y, normals, response, bend, valid = newton_step(image, offset, columns, rows, filter_px, kind)
    strongest = np.float32(limits.strong_sigma * response_noise)
    return LinePoints(*_points_kernel(
        valid, x, y, normals, response, bend, noise, rows, columns, gain, bend_noise, strongest,
    ))  # fmt: skip


stripe_points = partial(line_points, RIDGE)
"""Centres of the bright stripes of a normalised line frame."""

edge_points = partial(line_points, EDGE)
"""Zero crossings of a bit minus its inverse."""


def smoothing_shift_px(
    image: NDArray[np.float32], points: LinePoints, inside: NDArray[np.bool_], filter_px: float, /
) -> FloatArray:
    """(n,) float64: how far the filter may move the zero crossings of an image, px; 0 for points not `inside`.

    A Gaussian of variance σ² adds σ²/2 of the second derivative across the edge to the image, which is 0 where its two
    flanks are alike. inside : (H, W) bool.
    """
    columns, rows = np.rint(points.points_px).astype(np.intp).T
    shift_px, chosen = np.zeros(len(rows)), inside[rows, columns]
    slope, bend = _slope_and_bend(image, points, chosen, filter_px)
    shift_px[chosen] = filter_px**2 / 2 * np.abs(bend) / np.maximum(np.abs(slope), 1e-9)
    return shift_px


def sample_image(image: NDArray[Any], points_px: FloatArray) -> FloatArray:
    """(n,) float64: an image at (x, y) points, interpolated between the four pixels around each, extended beyond the
    outermost pixels.
    """
    last = np.array(image.shape[1::-1]) - 1
    within = np.clip(points_px, 0, last)
    first = np.minimum(np.floor(within), np.maximum(last - 1, 0)).astype(np.intp)
    (x, y), (right, down) = (within - first).T, np.minimum(first + 1, last).T
    left, up = first.T
    above = (1 - x) * image[up, left] + x * image[up, right]
    below = (1 - x) * image[down, left] + x * image[down, right]
    return np.asarray((1 - y) * above + y * below, dtype=np.float64)


def edge_skew_px(image: NDArray[np.float32], points: LinePoints, filter_px: float, /) -> FloatArray:
    """(n,) float64: how far the zero crossings of an image from -1 to 1 lie from the centroids of their edges, px,
    along the normal; of edges that are far from others.

    With light that spreads with variance v and third moment m, and a filter of variance t, a crossing lies
    m / 6 (v + t) before the centroid (Edgeworth's expansion); its shift by the filter, per variance, gives m. The
    slope gives v + t. NaN for an edge next to others.
    """
    slope, bend = _slope_and_bend(image, points, np.ones(len(points.points_px), np.bool_), filter_px)
    slope = np.where(np.abs(slope) < 1e-3, np.nan, slope)
    # An edge alone has light and dark on its sides: 3 of its deviations, by its slope, away.
    away = points.normals * (3 * np.sqrt(2 / np.pi) / slope)[:, None]
    sides = [sample_image(image, np.nan_to_num(points.points_px + each)) for each in (away, -away)]
    alone = (sides[0] > _MIN_SIDE) & (sides[1] < -_MIN_SIDE)
    return np.asarray(np.where(alone, bend / (np.pi * slope * slope * slope), np.nan))


def _slope_and_bend(
    image: NDArray[np.float32], points: LinePoints, chosen: NDArray[np.bool_], filter_px: float
) -> tuple[FloatArray, FloatArray]:
    """First and second derivative of the filtered image along the normals of chosen points."""
    if not chosen.any():
        return np.zeros(0), np.zeros(0)
    zero, one, two = gaussian_kernels(filter_px)
    at = points.points_px[chosen]
    pairs = ((one, zero), (zero, one), (two, zero), (one, one), (zero, two))
    derivatives = (cv2.sepFilter2D(image, cv2.CV_32F, across, down) for across, down in pairs)
    rx, ry, rxx, rxy, ryy = (sample_image(each, at) for each in derivatives)
    nx, ny = points.normals[chosen].T
    return nx * rx + ny * ry, nx * nx * rxx + 2 * nx * ny * rxy + ny * ny * ryy


@kernel
def _responses_kernel(strength: Any) -> Any:
    """Row, column (int32) and value of every pixel that is not zero, in the order of the image."""
    count = 0
    for y in range(strength.shape[0]):
        for x in range(strength.shape[1]):
            count += strength[y, x] != 0
    rows = np.zeros(count, dtype=np.int32)
    columns = np.zeros(count, dtype=np.int32)
    height = np.zeros(count, dtype=np.float32)
    at = 0
    for y in range(strength.shape[0]):
        for x in range(strength.shape[1]):
            if strength[y, x] != 0:
                rows[at], columns[at], height[at] = y, x, strength[y, x]
                at += 1
    return rows, columns, height


@kernel
def _points_kernel(
    valid: Any, x: Any, y: Any, normals: Any, response: Any, bend: Any, noise: Any, rows: Any, columns: Any,
    gain: float, bend_noise: float, weakest: float,
) -> Any:  # fmt: skip
    """Fields of `LinePoints` for the valid points; gain, bend_noise and weakest convert noise to deviations and a
    threshold.

    A clean edge has no second derivative where it crosses zero. What displaces it (neighbouring edges at unequal
    distances, curvature, uneven light, pixels too coarse for its slope) bends it, too: an edge of width S and bend b is
    displaced by q S² b, with q = 1 for a curved edge alone, 1/4 for narrow stripes whose width changes evenly. Without
    knowing the cause, the displacement counts as a standard deviation, with q = 0.4, where noise does not explain the
    bend.
    """
    total = 0
    for i in range(len(valid)):
        total += valid[i]
    points, across = np.zeros((total, 2)), np.zeros((total, 2))
    strength, sigma = np.zeros(total), np.zeros(total)
    strong = np.zeros(total, dtype=np.bool_)
    at = 0
    for i in range(len(valid)):
        if valid[i]:
            points[at, 0], points[at, 1] = x[i], y[i]
            across[at, 0], across[at, 1] = normals[i, 0], normals[i, 1]
            strength[at] = response[i]
            sigma[at] = noise[rows[i], columns[i]] * gain / max(response[i], 1e-12)
            if bend[i] != 0:
                # S², by the slope of a smoothed step from -1 to 1.
                squared_width = 2 / (np.pi * response[i] * response[i])
                by_noise = noise[rows[i], columns[i]] * bend_noise / response[i]
                if abs(bend[i]) > _MIN_BEND_SIGMA * by_noise:
                    squared = bend[i] * bend[i] - by_noise * by_noise
                    sigma[at] = np.sqrt(sigma[at] ** 2 + (_BEND_SHARE * squared_width) ** 2 * squared)
            strong[at] = response[i] > noise[int(np.rint(y[i])), int(np.rint(x[i]))] * weakest
            at += 1
    return points, across, strength, strong, sigma
