"""Least-squares fit of a small surface to a position map, and the points at which it has a given value."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part

_REACH = 2  # pixels either way: 5 x 5
# Chosen: half and double both increase the error of curved surfaces.
_QUADRATIC_SCALE_PX = 1.1
_LINEAR_SCALE_PX = 0.9
_MIN_FOR_PLANE = 5  # pixels: two more than a plane has parameters, to measure the scatter
_MAX_MOVE_PX = 1.0  # chosen; half and double change errors by 1 to 2 %
MIN_GRADIENT = 0.05  # projector px per camera px; the deviation of a point is that of the position over it
_MIN_FREEDOM = 0.5  # with less, residuals do not measure the scatter, and noise alone counts
_PIXELS = (2 * _REACH + 1) ** 2
_LANES = 32  # 25 pixels, or points side by side: whole vectors
MIN_POINTS = 1024  # least number for one call of the kernel

# Rows of the working memory of points side by side: the six coefficients of the surface, then these.
_X, _Y, _NOISE, _MISFIT, _VALUE = 6, 7, 8, 9, 10
_VARIANCE = _VALUE + _PIXELS
_ROWS = _VARIANCE + _PIXELS

# Rows in double precision: position of each point, gradient there, and target value.
_AT_X, _AT_Y, _ALONG_X, _ALONG_Y, _WANTED = 0, 1, 2, 3, 4


def stencils() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], float]:
    """Weighted least squares of a quadratic surface on 5 x 5 pixels, row by row, padded to whole vectors.

    Returns two (6, 32) float32: coefficients of 1, x, y, x², xy, y² as weighted sums of the pixels, and those terms at
    them; (32,) float32: weight of each pixel in the fit of a plane; and the expected sum of squared residuals for
    pixels of unit variance. For a weighted fit it exceeds 25 - 6: with the hat matrix H it is the trace of (1 - H)ᵀ(1 -
    H).
    """
    offset = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(offset, offset, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    weight = np.exp(-(x * x + y * y) / (2 * _QUADRATIC_SCALE_PX**2))
    sums = np.linalg.solve((basis * weight) @ basis.T, basis * weight)
    hat = basis.T @ sums
    freedom = float(_PIXELS - 2 * np.trace(hat) + np.sum(hat * hat))
    padding = ((0, 0), (0, _LANES - _PIXELS))
    plane = np.exp(-(x * x + y * y) / (2 * _LINEAR_SCALE_PX**2))
    quadratic, terms, linear = (np.pad(each, padding).astype(np.float32) for each in (sums, basis, plane[None]))
    return quadratic, terms, linear[0], freedom


@kernel
def fit_kernel(
    first: int, last: int, position: Any, sigma: Any, usable: Any, whole: Any, stencils: Any, basis: Any, plane: Any,
    whole_freedom: float, starts: Any, targets: Any, fitted: Any,
) -> None:  # fmt: skip
    """Fill in `phase.FittedPoints`, zeros so far: points where a local surface has the target positions.

    A quadratic surface is fitted to the 5 x 5 pixels round the start with Gaussian weights, a plane where pixels are
    missing. Pixels that unusable ones separate from the start are left out. From the start the point moves along the
    gradient by Newton's method. Its deviation along the normal is that by noise or by the pixels' scatter about the
    surface, whichever is larger. usable : (H, W) bool, pixels whose light is of one surface. whole : (H, W) uint8,
    pixels whose 5 x 5 neighbours are all usable; stencils, basis, plane, whole_freedom : from `stencils`. Sums over
    pixels are of differences from the middle one, small enough for single precision.
    """
    points, normals, deviation, found, by_noise = fitted
    rows, columns = position.shape
    flat_position, flat_sigma = position.reshape(-1), sigma.reshape(-1)
    # Window of one point with unusable neighbours.
    value = np.zeros(_LANES, dtype=np.float32)
    variance_at = np.ones(_LANES, dtype=np.float32)
    member = np.zeros(_LANES, dtype=np.float32)
    gains = np.zeros((6, _LANES), dtype=np.float32)
    # Points with usable neighbours only, side by side for vector registers.
    work = np.zeros(_ROWS * _LANES, dtype=np.float32)
    precise = np.zeros(5 * _LANES)
    which = np.zeros(_LANES, dtype=np.int64)
    waiting = np.int64(0)  # not a literal, for which functions would be compiled once more
    for i in range(first, last):
        points[i, 0], points[i, 1] = starts[i, 0], starts[i, 1]
        if np.isnan(targets[i]):
            continue
        ix, iy = int(np.rint(starts[i, 0])), int(np.rint(starts[i, 1]))
        if ix < _REACH or iy < _REACH or ix >= columns - _REACH or iy >= rows - _REACH or not usable[iy, ix]:
            continue
        origin = position[iy, ix]
        if whole[iy, ix]:
            corner = (iy - _REACH) * columns + ix - _REACH
            for dy in range(5):
                for dx in range(5):
                    at = np.uintp(corner + dy * columns + dx)
                    pixel = 5 * dy + dx
                    work[(_VALUE + pixel) * _LANES + waiting] = flat_position[at] - origin
                    work[(_VARIANCE + pixel) * _LANES + waiting] = flat_sigma[at] * flat_sigma[at]
            precise[_AT_X * _LANES + waiting] = starts[i, 0] - ix
            precise[_AT_Y * _LANES + waiting] = starts[i, 1] - iy
            precise[_WANTED * _LANES + waiting] = targets[i] - origin
            which[waiting] = i
            waiting += 1
            if waiting == _LANES:
                _fit_side_by_side(
                    work, precise, waiting, which, stencils, basis, whole_freedom,
                    starts, points, normals, deviation, found, by_noise,
                )  # fmt: skip
                waiting = np.int64(0)
            continue
        members = _connected_pixels(position, sigma, usable, iy, ix, value, variance_at, member)
        if not _plane_gains(member, members, plane, basis, gains):
            continue
        f0 = f1 = f2 = np.float32(0)
        for j in range(_PIXELS):
            f0 += gains[0, j] * value[j]
            f1 += gains[1, j] * value[j]
            f2 += gains[2, j] * value[j]
        x, y, gx, gy = _solve_position(
            f0, f1, f2, np.float32(0), np.float32(0), np.float32(0),
            starts[i, 0] - ix, starts[i, 1] - iy, targets[i] - origin,
        )  # fmt: skip
        noise = misfit = np.float32(0)
        x1, y1 = np.float32(x), np.float32(y)
        for j in range(_PIXELS):
            gain = gains[0, j] + gains[1, j] * x1 + gains[2, j] * y1
            noise += gain * gain * variance_at[j]
            residual = value[j] - (f0 + f1 * basis[1, j] + f2 * basis[2, j])
            misfit += member[j] * residual * residual / variance_at[j]
        freedom = _plane_freedom(member, members, gains, basis)
        _store_point(
            i, ix, iy, x, y, gx, gy, noise, misfit, freedom, starts, points, normals, deviation, found, by_noise
        )
    _fit_side_by_side(
        work, precise, waiting, which, stencils, basis, whole_freedom,
        starts, points, normals, deviation, found, by_noise,
    )  # fmt: skip


@kernel_part
def _fit_side_by_side(
    work: Any, precise: Any, count: int, which: Any, stencils: Any, basis: Any, freedom: float,
    starts: Any, points: Any, normals: Any, deviation: Any, found: Any, by_noise: Any,
) -> None:  # fmt: skip
    """Fit a quadratic surface to each of the first `count` columns of `work`: the points `which`.

    Row r of `work` is work[r * _LANES :], and likewise for `precise`. Lanes beyond `count` have arbitrary values.
    """
    _fit_surfaces(work, stencils)
    _solve_side_by_side(work, precise)
    for lane in range(_LANES):
        work[_X * _LANES + lane] = precise[_AT_X * _LANES + lane]
        work[_Y * _LANES + lane] = precise[_AT_Y * _LANES + lane]
    _measure_scatter(work, stencils, basis)
    for lane in range(count):
        i = which[lane]
        _store_point(
            i, int(np.rint(starts[i, 0])), int(np.rint(starts[i, 1])),
            precise[_AT_X * _LANES + lane], precise[_AT_Y * _LANES + lane],
            precise[_ALONG_X * _LANES + lane], precise[_ALONG_Y * _LANES + lane],
            work[_NOISE * _LANES + lane], work[_MISFIT * _LANES + lane], freedom,
            starts, points, normals, deviation, found, by_noise,
        )  # fmt: skip


# These loops use one array only: the compiler then sees that rows do not overlap.
@kernel_part
def _fit_surfaces(work: Any, stencils: Any) -> None:
    """Rows 0 to 5: coefficients of 1, x, y, x², xy, y²."""
    work[: 6 * _LANES] = 0
    for k in range(6):
        sums = work[k * _LANES : (k + 1) * _LANES]
        # Five pixels, a row, at a time: sums are loaded and stored a fifth as often.
        for j in range(0, _PIXELS, 5):
            w0, w1, w2, w3, w4 = (
                stencils[k, j], stencils[k, j + 1], stencils[k, j + 2], stencils[k, j + 3], stencils[k, j + 4]
            )  # fmt: skip
            values = work[(_VALUE + j) * _LANES :]
            for lane in range(_LANES):
                sums[lane] = (
                    sums[lane] + w0 * values[lane] + w1 * values[_LANES + lane] + w2 * values[2 * _LANES + lane]
                    + w3 * values[3 * _LANES + lane] + w4 * values[4 * _LANES + lane]
                )  # fmt: skip


@kernel_part
def _measure_scatter(work: Any, stencils: Any, basis: Any) -> None:
    """Rows _NOISE and _MISFIT: variance of the surface at (_X, _Y), and squared residuals over their variances."""
    work[_NOISE * _LANES : (_MISFIT + 1) * _LANES] = 0
    for j in range(_PIXELS):
        w0, w1, w2 = stencils[0, j], stencils[1, j], stencils[2, j]
        w3, w4, w5 = stencils[3, j], stencils[4, j], stencils[5, j]
        row = (_VARIANCE + j) * _LANES
        for lane in range(_LANES):
            x, y = work[_X * _LANES + lane], work[_Y * _LANES + lane]
            gain = w0 + w1 * x + w2 * y + w3 * (x * x) + w4 * (x * y) + w5 * (y * y)
            work[_NOISE * _LANES + lane] += gain * gain * work[row + lane]
    for j in range(_PIXELS):
        b0, b1, b2, b3, b4, b5 = basis[0, j], basis[1, j], basis[2, j], basis[3, j], basis[4, j], basis[5, j]
        values, variances = (_VALUE + j) * _LANES, (_VARIANCE + j) * _LANES
        for lane in range(_LANES):
            fitted = (
                work[lane] * b0 + work[_LANES + lane] * b1 + work[2 * _LANES + lane] * b2
                + work[3 * _LANES + lane] * b3 + work[4 * _LANES + lane] * b4 + work[5 * _LANES + lane] * b5
            )  # fmt: skip
            residual = work[values + lane] - fitted
            work[_MISFIT * _LANES + lane] += residual * residual / work[variances + lane]


@kernel_part
def _solve_side_by_side(work: Any, precise: Any) -> None:
    """Do `_solve_position` in every lane without branches: lanes that have converged no longer change."""
    for lane in range(_LANES):
        f0, f1, f2 = float(work[lane]), float(work[_LANES + lane]), float(work[2 * _LANES + lane])
        f3, f4, f5 = float(work[3 * _LANES + lane]), float(work[4 * _LANES + lane]), float(work[5 * _LANES + lane])
        x, y = precise[_AT_X * _LANES + lane], precise[_AT_Y * _LANES + lane]
        target = precise[_WANTED * _LANES + lane]
        gx = gy = 0.0
        moves = True
        for _ in range(3):
            slope_x = f1 + 2.0 * f3 * x + f4 * y
            slope_y = f2 + f4 * x + 2.0 * f5 * y
            gx, gy = slope_x if moves else gx, slope_y if moves else gy
            squared = gx * gx + gy * gy
            moves = moves & (not squared < MIN_GRADIENT * MIN_GRADIENT)
            miss = (f0 + f1 * x + f2 * y + f3 * x * x + f4 * x * y + f5 * y * y - target) / squared
            next_x, next_y = x - miss * gx, y - miss * gy
            x, y = next_x if moves else x, next_y if moves else y
            moves = moves & (not ((abs(x) > 2) | (abs(y) > 2)))
        precise[_AT_X * _LANES + lane], precise[_AT_Y * _LANES + lane] = x, y
        precise[_ALONG_X * _LANES + lane], precise[_ALONG_Y * _LANES + lane] = gx, gy


@kernel_part(inline="always")
def _solve_position(f0: Any, f1: Any, f2: Any, f3: Any, f4: Any, f5: Any, x: float, y: float, target: float) -> Any:
    """Move (x, y) along the gradient to where the surface is `target`: x, y and the gradient before the last step."""
    gx = gy = 0.0
    for _ in range(3):
        gx = f1 + 2.0 * f3 * x + f4 * y
        gy = f2 + f4 * x + 2.0 * f5 * y
        squared = gx * gx + gy * gy
        if squared < MIN_GRADIENT * MIN_GRADIENT:
            break
        miss = (f0 + f1 * x + f2 * y + f3 * x * x + f4 * x * y + f5 * y * y - target) / squared
        x -= miss * gx
        y -= miss * gy
        if abs(x) > 2 or abs(y) > 2:
            break
    return x, y, gx, gy


@kernel_part(inline="always")
def _store_point(
    i: int, ix: int, iy: int, x: float, y: float, gx: float, gy: float, noise: float, misfit: float, freedom: float,
    starts: Any, points: Any, normals: Any, deviation: Any, found: Any, by_noise: Any,
) -> None:  # fmt: skip
    """Store point i at (x, y) from the pixel (ix, iy), unless it moved too far or the surface is too flat."""
    gradient = np.sqrt(gx * gx + gy * gy)
    mx, my = x + ix - starts[i, 0], y + iy - starts[i, 1]
    if not gradient >= MIN_GRADIENT or not mx * mx + my * my <= _MAX_MOVE_PX * _MAX_MOVE_PX:
        return
    excess = max(1.0, misfit / freedom) if freedom > _MIN_FREEDOM else 1.0
    variance = noise * excess
    if not variance < np.inf:
        return
    points[i, 0], points[i, 1] = ix + x, iy + y
    normals[i, 0], normals[i, 1] = gx / gradient, gy / gradient
    by_noise[i] = np.sqrt(noise) / gradient
    deviation[i] = np.sqrt(variance) / gradient
    found[i] = True


@kernel_part
def _connected_pixels(
    position: Any, sigma: Any, usable: Any, iy: int, ix: int, value: Any, variance_at: Any, member: Any
) -> int:
    """Fill in the pixels of the 5 x 5 that are connected with the middle, and return their number."""
    members = 0
    for j in range(_PIXELS):
        dy, dx = j // 5 - 2, j % 5 - 2
        # The pixel half way to one two steps away; itself if it is one step away.
        half_y = dy // 2 if dy >= 0 else -(-dy // 2)
        half_x = dx // 2 if dx >= 0 else -(-dx // 2)
        on_the_way = _is_reachable(usable, iy, ix, half_y, half_x)
        if on_the_way and _is_reachable(usable, iy + half_y, ix + half_x, dy - half_y, dx - half_x):
            s = sigma[iy + dy, ix + dx]
            value[j] = position[iy + dy, ix + dx] - position[iy, ix]
            variance_at[j] = s * s
            member[j] = 1.0
            members += 1
        else:
            value[j] = 0.0
            variance_at[j] = 1.0
            member[j] = 0.0
    return members


@kernel_part(inline="always")
def _is_reachable(usable: Any, y: int, x: int, dy: int, dx: int) -> bool:
    """True if a step of at most one pixel ends on a usable one; a diagonal step must not pass between two unusable
    ones.
    """
    return usable[y + dy, x + dx] and (dy == 0 or dx == 0 or usable[y + dy, x] or usable[y, x + dx])


@kernel_part
def _plane_freedom(member: Any, members: int, gains: Any, basis: Any) -> float:
    """Trace of (1 - H)ᵀ(1 - H) of the weighted plane: n - 2 tr H + |H|²."""
    trace: float = 0.0
    square: float = 0.0
    for a in range(3):
        for b in range(a + 1):
            normal = gain = own = np.float32(0)
            for j in range(_LANES):
                normal += member[j] * basis[a, j] * basis[b, j]
                gain += gains[a, j] * gains[b, j]
                own += gains[a, j] * basis[b, j]
            square += float(normal * gain) * (1 if a == b else 2)
            if a == b:
                trace += float(own)
    return members - 2 * trace + square


@kernel_part
def _plane_gains(member: Any, members: int, plane: Any, basis: Any, gains: Any) -> bool:
    """Fill the first three rows of gains with those of a weighted plane; False if the pixels do not determine one.

    plane : (32,) float32, weight of each pixel.
    """
    if members < _MIN_FOR_PLANE:
        return False
    s0 = s1 = s2 = s3 = s4 = s5 = np.float32(0)
    for j in range(_LANES):
        w = member[j] * plane[j]
        s0 += w
        s1 += w * basis[1, j]
        s2 += w * basis[2, j]
        s3 += w * basis[3, j]
        s4 += w * basis[4, j]
        s5 += w * basis[5, j]
    m0, mx, my, mxx, mxy, myy = float(s0), float(s1), float(s2), float(s3), float(s4), float(s5)
    a = mxx * myy - mxy * mxy
    b = my * mxy - mx * myy
    c = mx * mxy - mxx * my
    det = m0 * a + mx * b + my * c
    if det <= 1e-3 * m0**3:
        return False
    d = m0 * myy - my * my
    e = mx * my - m0 * mxy
    f = m0 * mxx - mx * mx
    _fill_row(member, plane, basis, a / det, b / det, c / det, gains[0])
    _fill_row(member, plane, basis, b / det, d / det, e / det, gains[1])
    _fill_row(member, plane, basis, c / det, e / det, f / det, gains[2])
    return True


@kernel_part
def _fill_row(member: Any, plane: Any, basis: Any, one: float, of_x: float, of_y: float, row: Any) -> None:
    p, q, r = np.float32(one), np.float32(of_x), np.float32(of_y)
    for j in range(_LANES):
        row[j] = member[j] * plane[j] * (p + q * basis[1, j] + r * basis[2, j])
