"""The two steps of Steger's detector as kernels: Taylor at every pixel, and Newton on kernels centred on the point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray

RIDGE = 0
"""Bright lines: the point where the first derivative across the line is zero."""

EDGE = 1
"""Steps through zero: the point where the value is zero."""

_SUPPORT = 3.6  # kernel radius in sigmas
_TAYLOR_BOX = 0.6  # a point this far from the pixel centre still belongs to it; the chain drops double responses
_NEWTON_BOX = 1.1  # half a pixel beyond the first step's
_VECTOR = 4  # of double precision
_ROWS, _POINTS = 32, 1024  # that are worth calling a kernel for


def kernels(sigma_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Sampled Gaussian of this scale and its first two derivatives, each (2 r + 1,) float32."""
    radius = int(np.ceil(_SUPPORT * sigma_px))
    at = np.arange(-radius, radius + 1, dtype=np.float64)
    zero = np.exp(-(at**2) / (2 * sigma_px**2))
    zero /= zero.sum()
    one = at / sigma_px**2 * zero
    one /= (one * at).sum()
    two = (at**2 / sigma_px**4 - 1 / sigma_px**2) * zero
    two -= two.mean()
    two /= (two * at**2).sum() / 2
    # They correlate: a rising ramp gives +1 with `one`, a parabola x²/2 gives +1 with `two`.
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
    """One Taylor step at every lit pixel whose response exceeds `weak` times its noise.

    image, noise : (H, W) float32; zero, one, two : as `kernels` gives them; kind : `RIDGE` or `EDGE`.
    Returns the offsets (H, W, 2) of the points from their pixels, x and y, and the responses (H, W), 0 where none is.
    """
    offset, response = np.zeros((*image.shape, 2), dtype=np.float32), np.zeros(image.shape, dtype=np.float32)
    in_bands(
        _taylor_kernel, len(image), image, noise, lit, weak, zero, one, two, kind, offset, response,
        rows_at_least=_ROWS,
    )  # fmt: skip
    return offset, response


@kernel
def _taylor_kernel(
    first: int, last: int, image: Any, noise: Any, lit: Any, weak: Any, zero: Any, one: Any, two: Any, kind: int,
    offset: Any, response: Any,
) -> None:  # fmt: skip
    """Fill in offset and response, zeros so far.

    The filters are separable, even or odd: rows first, and then along the row, while it is in the cache.
    """
    columns = image.shape[1]
    radius = len(zero) // 2
    g0, g1, g2 = zero[radius:], one[radius:], two[radius:]
    down = np.zeros((3, columns + 2 * radius), dtype=np.float32)
    along = np.zeros((6, columns), dtype=np.float32)
    for y in range(first, last):
        begin, end = _lit_part(lit[y])
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
def _lit_part(lit: Any) -> Any:
    """The first lit pixel of a row, and one more than the last; twice the same where none is."""
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
    """Fill (3, columns + 2 radius) with the image's rows round y, smoothed and differentiated once and twice.

    Only the columns from begin to end are filled in, and what lies beyond the image's borders, where it is reflected
    about its outermost pixels.
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
        above, below = image[_reflected(y - t, rows), begin:], image[_reflected(y + t, rows), begin:]
        top, bottom = image[_reflected(y - t - 1, rows), begin:], image[_reflected(y + t + 1, rows), begin:]
        _add_two(smooth, count, g0[t], below, above, g0[t + 1], bottom, top)
        _subtract_two(first, count, g1[t], below, above, g1[t + 1], bottom, top)
        _add_two(second, count, g2[t], below, above, g2[t + 1], bottom, top)
    if radius % 2:
        above, below = image[_reflected(y - radius, rows), begin:], image[_reflected(y + radius, rows), begin:]
        _add(smooth, count, g0[radius], below, above)
        _subtract(first, count, g1[radius], below, above)
        _add(second, count, g2[radius], below, above)
    for k in range(3):
        for t in range(1, radius + 1):
            out[k, radius - t] = out[k, radius + _reflected(-t, columns)]
            out[k, radius + columns - 1 + t] = out[k, radius + _reflected(columns - 1 + t, columns)]


@kernel_part
def _filter_along(down: Any, radius: int, begin: int, end: int, g0: Any, g1: Any, g2: Any, out: Any) -> None:
    """Fill (6, columns) from begin to end with r, rx, ry, rxx, rxy, ryy of one row."""
    smooth, first, second = down[0, begin:], down[1, begin:], down[2, begin:]
    _even(out[0, begin:end], radius, g0, smooth)
    _odd(out[1, begin:end], radius, g1, smooth)
    _even(out[2, begin:end], radius, g0, first)
    _even(out[3, begin:end], radius, g2, smooth)
    _odd(out[4, begin:end], radius, g1, first)
    _even(out[5, begin:end], radius, g0, second)


@kernel_part
def _even(out: Any, radius: int, weights: Any, row: Any) -> None:
    count = len(out)
    _scale(out, count, weights[0], row[radius:])
    for t in range(1, radius, 2):
        left, right = radius - t, radius + t
        _add_two(out, count, weights[t], row[right:], row[left:], weights[t + 1], row[right + 1 :], row[left - 1 :])
    if radius % 2:
        _add(out, count, weights[radius], row[2 * radius :], row)


@kernel_part
def _odd(out: Any, radius: int, weights: Any, row: Any) -> None:
    count = len(out)
    out[:] = 0
    for t in range(1, radius, 2):
        left, right = radius - t, radius + t
        _subtract_two(
            out, count, weights[t], row[right:], row[left:], weights[t + 1], row[right + 1 :], row[left - 1 :]
        )  # fmt: skip
    if radius % 2:
        _subtract(out, count, weights[radius], row[2 * radius :], row)


# Loops of five arrays at most, of which one is written: with more, the compiler gives up proving that they do not
# overlap, and uses no vectors.
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
def _reflected(index: int, count: int) -> int:
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
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """One Newton step from the offsets of these pixels, (n,) each, on kernels centred there.

    Returns x and y (n,), px, the normal (n, 2) and the response (n,) at the start, and (n,) bool: the step stayed near.
    """
    count = len(columns)
    x, y, response = np.zeros(count), np.zeros(count), np.zeros(count)
    normals, kept = np.zeros((count, 2)), np.zeros(count, dtype=np.bool_)
    in_bands(
        _newton_kernel, count, image, offset, columns, rows, sigma, kind, x, y, normals, response, kept,
        rows_at_least=_POINTS,
    )  # fmt: skip
    return x, y, normals, response, kept


@kernel
def _newton_kernel(
    first: int, last: int, image: Any, offset: Any, columns: Any, rows: Any, sigma: float, kind: int,
    x_out: Any, y_out: Any, normals: Any, response: Any, kept: Any,
) -> None:  # fmt: skip
    height, width = image.shape
    radius = int(np.ceil(_SUPPORT * sigma))
    size = 2 * radius + 1
    whole = np.exp(-((np.arange(size) - radius) ** 2) / (2 * sigma * sigma))
    wx = np.zeros((3, size))
    wy = np.zeros((3, size))
    flat = image.reshape(-1)
    # Whole vectors of columns: those beyond the window are summed, too, and nobody looks at them.
    lanes = min(-(-size // _VECTOR) * _VECTOR, width)
    furthest = len(flat) - (size - 1) * width - lanes
    smooth, once, twice = np.zeros(lanes), np.zeros(lanes), np.zeros(lanes)
    for i in range(first, last):
        column, row = columns[i], rows[i]
        if column < radius or row < radius or column >= width - radius or row >= height - radius:
            continue
        fx, fy = float(offset[row, column, 0]), float(offset[row, column, 1])
        _centred_weights(wx, fx, sigma, whole)
        _centred_weights(wy, fy, sigma, whole)
        corner = (row - radius) * width + column - radius
        begun = min(corner, furthest)
        _weighted_down(flat, begun, width, wy, smooth, once, twice)
        r = rx = ry = rxx = rxy = ryy = 0.0
        for k in range(size):
            s0, s1, s2 = smooth[corner - begun + k], once[corner - begun + k], twice[corner - begun + k]
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
        x, y = fx + t * nx, fy + t * ny
        if abs(x) > _NEWTON_BOX or abs(y) > _NEWTON_BOX:
            continue
        x_out[i], y_out[i] = column + x, row + y
        normals[i, 0], normals[i, 1] = nx, ny
        response[i] = strength
        kept[i] = True


@kernel_part
def _weighted_down(flat: Any, corner: int, width: int, weights: Any, smooth: Any, first: Any, second: Any) -> None:
    """Fill (lanes,) each with sums down the columns of a window, weighted with each row of weights, (3, size).

    flat, corner, width : the image's pixels, the window's first among them, and the pixels of a row. The sums of
    neighbouring columns are made side by side, in vector registers; two rows at a time after the first, for each turn
    waits for the sums of the one before.
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
    """Fill (3, size) with Gaussian, first and second derivative weights for samples at -radius … radius.

    whole : (size,) the Gaussian's values when its centre is 0. About another centre f each changes by
    exp(f k / σ²) and by a factor that all share.
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
    # Dividing takes several times as long as multiplying.
    share = 1 / total
    of_one = share / variance
    of_two = of_one / variance
    for k in range(size):
        at = k - radius - centre
        value = zero[k]
        zero[k] = value * share
        one[k] = at * (value * of_one)
        two[k] = (at * at - variance) * (value * of_two)
