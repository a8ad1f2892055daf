"""Least squares for a small surface of a position map: the kernel under `phase.fitted_points`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from slrig.model import FloatArray

_REACH = 2
_QUADRATIC_SCALE_PX = 1.1
_LINEAR_SCALE_PX = 0.9
_LEAST_FOR_LINEAR = 5
_LONGEST_MOVE_PX = 1.0
_LEAST_GRADIENT = 0.05
_LEAST_FREEDOM = 0.5
_PIXELS = 25
_LANES = 32  # 25 pixels, padded to whole vectors
_BLOCK = 4096


def stencils() -> tuple[FloatArray, FloatArray, float]:
    """Weighted least squares of a quadratic surface on 5 x 5 pixels, row by row, padded to whole vectors.

    Two (6, 32) float64: coefficients of 1, x, y, x², xy, y² as weighted sums of the pixels, and those terms at them.
    And the sum of squared residuals to expect of pixels of unit variance: a weighted fit leaves more scatter than
    25 - 6, with the hat matrix H the trace of (1 - H)ᵀ(1 - H).
    """
    at = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    weight = np.exp(-(x * x + y * y) / (2 * _QUADRATIC_SCALE_PX**2))
    sums = np.linalg.solve((basis * weight) @ basis.T, basis * weight)
    hat = basis.T @ sums
    freedom = float(_PIXELS - 2 * np.trace(hat) + np.sum(hat * hat))
    padding = ((0, 0), (0, _LANES - _PIXELS))
    return np.pad(sums, padding), np.pad(basis, padding), freedom


@njit(cache=True, nogil=True, parallel=True, fastmath={"reassoc", "contract"})
def fit_kernel(
    position: Any, sigma: Any, usable: Any, whole: Any, starts: Any, targets: Any, stencils: Any, basis: Any,
    whole_freedom: float,
) -> Any:  # fmt: skip
    """Points, normals, deviations and success of `phase.fitted_points`.

    whole : (H, W) uint8, pixels whose 5 x 5 neighbours are all usable; stencils, basis,
    whole_freedom : as `stencils` returns them.
    """
    count = len(starts)
    rows, columns = position.shape
    points = starts.copy()
    normals = np.zeros((count, 2))
    deviation = np.zeros(count)
    found = np.zeros(count, dtype=np.bool_)
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        value = np.zeros(_LANES)
        variance_at = np.ones(_LANES)
        member = np.zeros(_LANES)
        gains = np.zeros((6, _LANES))
        for i in range(block * _BLOCK, min(count, (block + 1) * _BLOCK)):
            if np.isnan(targets[i]):
                continue
            ix, iy = int(np.rint(starts[i, 0])), int(np.rint(starts[i, 1]))
            if ix < _REACH or iy < _REACH or ix >= columns - _REACH or iy >= rows - _REACH or not usable[iy, ix]:
                continue
            origin = position[iy, ix]
            members = _PIXELS
            weights = stencils
            if whole[iy, ix]:
                for dy in range(5):
                    for dx in range(5):
                        s = float(sigma[iy + dy - 2, ix + dx - 2])
                        value[5 * dy + dx] = position[iy + dy - 2, ix + dx - 2] - origin
                        variance_at[5 * dy + dx] = s * s
                        member[5 * dy + dx] = 1.0
            else:
                members = _members(position, sigma, usable, iy, ix, value, variance_at, member)
                if not _plane_gains(member, members, gains):
                    continue
                weights = gains
            f0 = f1 = f2 = f3 = f4 = f5 = 0.0
            for j in range(_LANES):
                f0 += weights[0, j] * value[j]
                f1 += weights[1, j] * value[j]
                f2 += weights[2, j] * value[j]
                f3 += weights[3, j] * value[j]
                f4 += weights[4, j] * value[j]
                f5 += weights[5, j] * value[j]
            x, y = starts[i, 0] - ix, starts[i, 1] - iy
            gx = gy = 0.0
            for _ in range(3):
                gx = f1 + 2 * f3 * x + f4 * y
                gy = f2 + f4 * x + 2 * f5 * y
                squared = gx * gx + gy * gy
                if squared < _LEAST_GRADIENT * _LEAST_GRADIENT:
                    break
                miss = origin + (f0 + f1 * x + f2 * y + f3 * x * x + f4 * x * y + f5 * y * y) - targets[i]
                x -= miss * gx / squared
                y -= miss * gy / squared
                if abs(x) > 2 or abs(y) > 2:
                    break
            gradient = np.sqrt(gx * gx + gy * gy)
            mx, my = x + ix - starts[i, 0], y + iy - starts[i, 1]
            if not gradient >= _LEAST_GRADIENT or not mx * mx + my * my <= _LONGEST_MOVE_PX * _LONGEST_MOVE_PX:
                continue
            variance = misfit = 0.0
            xx, xy, yy = x * x, x * y, y * y
            for j in range(_LANES):
                gain = (
                    weights[0, j] + weights[1, j] * x + weights[2, j] * y
                    + weights[3, j] * xx + weights[4, j] * xy + weights[5, j] * yy
                )  # fmt: skip
                variance += gain * gain * variance_at[j]
                fitted = (
                    f0 * basis[0, j] + f1 * basis[1, j] + f2 * basis[2, j]
                    + f3 * basis[3, j] + f4 * basis[4, j] + f5 * basis[5, j]
                )  # fmt: skip
                residual = value[j] - fitted
                misfit += member[j] * residual * residual / variance_at[j]
            freedom = whole_freedom if whole[iy, ix] else _plane_freedom(member, members, gains, basis)
            if freedom > _LEAST_FREEDOM:
                variance *= max(1.0, misfit / freedom)
            if not variance < np.inf:
                continue
            points[i, 0], points[i, 1] = ix + x, iy + y
            normals[i, 0], normals[i, 1] = gx / gradient, gy / gradient
            deviation[i] = np.sqrt(variance) / gradient
            found[i] = True
    return points, normals, deviation, found


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
            s = float(sigma[iy + dy, ix + dx])
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
    normal = np.zeros((3, 3))
    gain = np.zeros((3, 3))
    trace = 0.0
    for j in range(_PIXELS):
        if member[j] > 0:
            for a in range(3):
                trace += gains[a, j] * basis[a, j]
                for b in range(3):
                    normal[a, b] += basis[a, j] * basis[b, j]
                    gain[a, b] += gains[a, j] * gains[b, j]
    return float(members - 2 * trace + np.sum(normal * gain))


@njit(cache=True, nogil=True)
def _plane_gains(member: Any, members: int, gains: Any) -> bool:
    """Fill the first three rows of gains with those of a weighted plane; False when the pixels fix none."""
    if members < _LEAST_FOR_LINEAR:
        return False
    m = np.zeros((3, 3))
    for j in range(_PIXELS):
        if member[j] > 0:
            dy, dx = j // 5 - 2, j % 5 - 2
            w = np.exp(-(dx * dx + dy * dy) / (2 * _LINEAR_SCALE_PX * _LINEAR_SCALE_PX))
            m[0, 0] += w
            m[0, 1] += w * dx
            m[0, 2] += w * dy
            m[1, 1] += w * dx * dx
            m[1, 2] += w * dx * dy
            m[2, 2] += w * dy * dy
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    b = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    det = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
    if det <= 1e-3 * m[0, 0] ** 3:
        return False
    d = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    e = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    f = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    gains[:] = 0.0
    for j in range(_PIXELS):
        if member[j] > 0:
            dy, dx = j // 5 - 2, j % 5 - 2
            w = np.exp(-(dx * dx + dy * dy) / (2 * _LINEAR_SCALE_PX * _LINEAR_SCALE_PX)) / det
            gains[0, j] = w * (a + b * dx + c * dy)
            gains[1, j] = w * (b + d * dx + e * dy)
            gains[2, j] = w * (c + e * dx + f * dy)
    return True
