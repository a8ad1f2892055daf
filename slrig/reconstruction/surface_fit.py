"""Least squares for a small surface of a position map: the kernel under `phase.fitted_points`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

_REACH = 2
_QUADRATIC_SCALE_PX = 1.1
_LINEAR_SCALE_PX = 0.9
_LEAST_FOR_LINEAR = 5
_LONGEST_MOVE_PX = 1.0
_LEAST_GRADIENT = 0.05
_LEAST_FREEDOM = 0.5
_PIXELS = 25
_LANES = 32  # 25 pixels, padded to whole vectors
_BLOCK = 1024


def stencils() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], float]:
    """Weighted least squares of a quadratic surface on 5 x 5 pixels, row by row, padded to whole vectors.

    Two (6, 32) float32: coefficients of 1, x, y, x², xy, y² as weighted sums of the pixels, and those terms at them.
    (32,) float32: the weight of each pixel where a plane is fitted instead. And the sum of squared residuals to expect
    of pixels of unit variance: a weighted fit leaves more scatter than 25 - 6, with the hat matrix H the trace of
    (1 - H)ᵀ(1 - H).
    """
    at = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    weight = np.exp(-(x * x + y * y) / (2 * _QUADRATIC_SCALE_PX**2))
    sums = np.linalg.solve((basis * weight) @ basis.T, basis * weight)
    hat = basis.T @ sums
    freedom = float(_PIXELS - 2 * np.trace(hat) + np.sum(hat * hat))
    padding = ((0, 0), (0, _LANES - _PIXELS))
    plane = np.exp(-(x * x + y * y) / (2 * _LINEAR_SCALE_PX**2))
    quadratic, terms, linear = (np.pad(each, padding).astype(np.float32) for each in (sums, basis, plane[None]))
    return quadratic, terms, linear[0], freedom


@njit(cache=True, nogil=True, parallel=True)
def fit_kernel(
    position: Any, sigma: Any, usable: Any, whole: Any, stencils: Any, basis: Any, plane: Any,
    whole_freedom: float, starts: Any, targets: Any, points: Any, normals: Any, deviation: Any, found: Any,
) -> None:  # fmt: skip
    """Fill in points, normals, deviation and found, zeros so far, as `phase.fitted_points` returns them.

    whole : (H, W) uint8, pixels whose 5 x 5 neighbours are all usable; stencils, basis, plane, whole_freedom : as
    `stencils` returns them. Sums over pixels are of differences from the middle one, small enough for single precision.
    """
    count = len(starts)
    rows, columns = position.shape
    flat_position, flat_sigma = position.reshape(-1), sigma.reshape(-1)
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        value = np.zeros(_LANES, dtype=np.float32)
        variance_at = np.ones(_LANES, dtype=np.float32)
        every, some = basis[0], np.zeros(_LANES, dtype=np.float32)
        gains = np.zeros((6, _LANES), dtype=np.float32)
        for i in range(block * _BLOCK, min(count, (block + 1) * _BLOCK)):
            points[i, 0], points[i, 1] = starts[i, 0], starts[i, 1]
            if np.isnan(targets[i]):
                continue
            ix, iy = int(np.rint(starts[i, 0])), int(np.rint(starts[i, 1]))
            if ix < _REACH or iy < _REACH or ix >= columns - _REACH or iy >= rows - _REACH or not usable[iy, ix]:
                continue
            origin = position[iy, ix]
            members = _PIXELS
            weights = stencils
            if whole[iy, ix]:
                corner = (iy - _REACH) * columns + ix - _REACH
                for dy in range(5):
                    for dx in range(5):
                        at = np.uintp(corner + dy * columns + dx)
                        value[5 * dy + dx] = flat_position[at] - origin
                        variance_at[5 * dy + dx] = flat_sigma[at] * flat_sigma[at]
                member = every
            else:
                members = _members(position, sigma, usable, iy, ix, value, variance_at, some)
                if not _plane_gains(some, members, plane, basis, gains):
                    continue
                weights = gains
                member = some
            f0 = f1 = f2 = f3 = f4 = f5 = np.float32(0)
            for j in range(_LANES):
                f0 += weights[0, j] * value[j]
                f1 += weights[1, j] * value[j]
                f2 += weights[2, j] * value[j]
                f3 += weights[3, j] * value[j]
                f4 += weights[4, j] * value[j]
                f5 += weights[5, j] * value[j]
            x, y = starts[i, 0] - ix, starts[i, 1] - iy
            gx = gy = 0.0
            target = targets[i] - origin
            for _ in range(3):
                gx = f1 + 2.0 * f3 * x + f4 * y
                gy = f2 + f4 * x + 2.0 * f5 * y
                squared = gx * gx + gy * gy
                if squared < _LEAST_GRADIENT * _LEAST_GRADIENT:
                    break
                miss = (f0 + f1 * x + f2 * y + f3 * x * x + f4 * x * y + f5 * y * y - target) / squared
                x -= miss * gx
                y -= miss * gy
                if abs(x) > 2 or abs(y) > 2:
                    break
            gradient = np.sqrt(gx * gx + gy * gy)
            mx, my = x + ix - starts[i, 0], y + iy - starts[i, 1]
            if not gradient >= _LEAST_GRADIENT or not mx * mx + my * my <= _LONGEST_MOVE_PX * _LONGEST_MOVE_PX:
                continue
            noise = misfit = np.float32(0)
            x1, y1 = np.float32(x), np.float32(y)
            xx, xy, yy = x1 * x1, x1 * y1, y1 * y1
            for j in range(_LANES):
                gain = (
                    weights[0, j] + weights[1, j] * x1 + weights[2, j] * y1
                    + weights[3, j] * xx + weights[4, j] * xy + weights[5, j] * yy
                )  # fmt: skip
                noise += gain * gain * variance_at[j]
                fitted = (
                    f0 * basis[0, j] + f1 * basis[1, j] + f2 * basis[2, j]
                    + f3 * basis[3, j] + f4 * basis[4, j] + f5 * basis[5, j]
                )  # fmt: skip
                residual = value[j] - fitted
                misfit += member[j] * residual * residual / variance_at[j]
            freedom = whole_freedom if whole[iy, ix] else _plane_freedom(member, members, gains, basis)
            excess = max(1.0, misfit / freedom) if freedom > _LEAST_FREEDOM else 1.0
            variance = noise * excess
            if not variance < np.inf:
                continue
            points[i, 0], points[i, 1] = ix + x, iy + y
            normals[i, 0], normals[i, 1] = gx / gradient, gy / gradient
            deviation[i] = np.sqrt(variance) / gradient
            found[i] = True


@njit(cache=True, nogil=True)
def _members(
    position: Any, sigma: Any, usable: Any, iy: int, ix: int, value: Any, variance_at: Any, member: Any
) -> int:
    """Fill in the pixels of the 5 x 5 that nothing separates from the middle, and return how many they are."""
    members = 0
    for j in range(_PIXELS):
        dy, dx = j // 5 - 2, j % 5 - 2
        # The pixel on the way to one two steps away; one step away is its own.
        half_y = dy // 2 if dy >= 0 else -(-dy // 2)
        half_x = dx // 2 if dx >= 0 else -(-dx // 2)
        on_the_way = _reached(usable, iy, ix, half_y, half_x)
        if on_the_way and _reached(usable, iy + half_y, ix + half_x, dy - half_y, dx - half_x):
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


@njit(cache=True, nogil=True, inline="always")
def _reached(usable: Any, y: int, x: int, dy: int, dx: int) -> bool:
    """Whether a step of one pixel or none ends on a usable one; a slanting step must not squeeze between two others."""
    return usable[y + dy, x + dx] and (dy == 0 or dx == 0 or usable[y + dy, x] or usable[y, x + dx])


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _plane_gains(member: Any, members: int, plane: Any, basis: Any, gains: Any) -> bool:
    """Fill the first three rows of gains with those of a weighted plane; False when the pixels fix none.

    plane : (32,) float32, weight of each pixel.
    """
    if members < _LEAST_FOR_LINEAR:
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


@njit(cache=True, nogil=True)
def _fill_row(member: Any, plane: Any, basis: Any, one: float, of_x: float, of_y: float, row: Any) -> None:
    p, q, r = np.float32(one), np.float32(of_x), np.float32(of_y)
    for j in range(_LANES):
        row[j] = member[j] * plane[j] * (p + q * basis[1, j] + r * basis[2, j])
