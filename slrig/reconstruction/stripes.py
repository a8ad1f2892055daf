"""Sub-pixel points on light stripes and on code edges, linked along the curve that they lie on.

Stripes: Steger's curvilinear detector (PAMI 20(2) 1998, 113-125) with one further Newton step on kernels re-centred on
the sub-pixel point, which removes the S-shaped error of a single Taylor step. Code edges: the zero crossing of a bit
minus its inverse, found along its gradient by the same two steps. Both give points, normals and a standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray
from slrig.reconstruction.chaining import chain

_RIDGE = 0
_EDGE = 1
_SUPPORT = 3.6  # kernel radius in sigmas
_TAYLOR_BOX = 0.6  # a point this far from the pixel centre still belongs to it; the chain drops double responses
_NEWTON_BOX = 1.1


@dataclass(frozen=True, slots=True)
class StripeLimits:
    """What counts as a stripe.

    sigma_px : scale of the Gaussian; None measures the stripes and matches it, between 1 and 2.5 px.
    strong_sigma, weak_sigma : hysteresis, in standard deviations of the response to noise alone.
    weak_fraction : a point must reach this fraction of the image's typical response.
    shortest_points : a stripe of fewer points is refused.
    """

    sigma_px: float | None = None
    strong_sigma: float = 7.0
    weak_sigma: float = 3.5
    weak_fraction: float = 0.12
    shortest_points: int = 5


@dataclass(frozen=True, slots=True)
class Stripes:
    """Chains of sub-pixel points. Chain i holds the points offsets[i]:offsets[i + 1], in order along the curve.

    offsets : (s + 1,) int32; frame : (s,) int32, index of the line or bit frame the chain was found in.
    points_px : (n, 2) float64, (x, y) in the camera image; normals : (n, 2) float64, unit, across the curve.
    sigma_px : (n,) float64, standard deviation across the curve from noise.
    """

    offsets: IntArray
    frame: IntArray
    points_px: FloatArray
    normals: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.offsets) - 1


def joined(parts: list[Stripes]) -> Stripes:
    """All chains of several frames as one value, in the order given."""
    counts = np.concatenate([[0], *(np.diff(part.offsets) for part in parts)])
    return Stripes(
        offsets=np.cumsum(counts).astype(np.int32),
        frame=np.concatenate([np.zeros(0, np.int32), *(part.frame for part in parts)]),
        points_px=np.concatenate([np.zeros((0, 2)), *(part.points_px for part in parts)]),
        normals=np.concatenate([np.zeros((0, 2)), *(part.normals for part in parts)]),
        sigma_px=np.concatenate([np.zeros(0), *(part.sigma_px for part in parts)]),
    )


def normalised(
    image: NDArray[np.float32], black: NDArray[np.float32], contrast: NDArray[np.float32], noise: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Light relative to white, free of albedo, and its noise.

    (I - black)/(white - black), damped to zero where the contrast is not above the noise.
    noise : (H, W) float32, standard deviation of I - black, camera units.
    """
    weight = contrast / (contrast**2 + (3 * noise) ** 2)
    return (image - black) * weight, noise * np.abs(weight)


def measured_sigma_px(image: NDArray[np.float32], noise: NDArray[np.float32], lit: NDArray[np.bool_]) -> float:
    """Standard deviation of the stripes' cross-section, px: the median over the clear points of one frame.

    For a Gaussian bar smoothed to scale S the response is -r/S² at the centre, so S² = -r/r_nn.
    """
    probe = 1.2
    x, y, _, strength, _ = _points(image, noise, lit, probe, _RIDGE, 12.0, 0.12)
    if len(x) < 50:
        return probe
    smooth = cv2.GaussianBlur(image, (0, 0), probe)
    value = smooth[np.rint(y).astype(int), np.rint(x).astype(int)]
    clear = strength > np.median(strength)
    squared = np.median(value[clear] / strength[clear]) - probe**2
    return float(np.sqrt(max(squared, 0.25)))


def locate_stripes(
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    frame: int,
    limits: StripeLimits,
    /,
    *,
    sigma_px: float,
) -> Stripes:
    """Bright stripes of a normalised line frame as linked sub-pixel points.

    image, noise : (H, W) float32; lit : (H, W) bool, pixels that can hold a point.
    """
    return _located(image, noise, lit, frame, limits, sigma_px, _RIDGE)


def locate_edges(
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    frame: int,
    limits: StripeLimits,
    /,
    *,
    sigma_px: float,
) -> Stripes:
    """Zero crossings of a bit minus its inverse as linked sub-pixel points.

    image, noise : (H, W) float32; lit : (H, W) bool, pixels that can hold a point.
    """
    return _located(image, noise, lit, frame, limits, sigma_px, _EDGE)


def _located(
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    frame: int,
    limits: StripeLimits,
    sigma_px: float,
    kind: int,
) -> Stripes:
    x, y, normals, strength, deviation = _points(
        image, noise, lit, sigma_px, kind, limits.weak_sigma, limits.weak_fraction
    )
    strong = strength > _response_noise(noise, sigma_px, kind)[np.rint(y).astype(int), np.rint(x).astype(int)] * (
        limits.strong_sigma
    )
    points = np.stack([x, y], axis=1)
    order, offsets = chain(points, normals, strength, strong, image.shape)
    return Stripes(
        offsets=offsets,
        frame=np.full(len(offsets) - 1, frame, dtype=np.int32),
        points_px=points[order],
        normals=normals[order],
        sigma_px=deviation[order],
    )


def _response_noise(noise: NDArray[np.float32], sigma_px: float, kind: int) -> NDArray[np.float32]:
    # ∫ g_xx² = 3/(16 π σ⁶) for the ridge response, ∫ g_x² = 1/(8 π σ⁴) for the gradient.
    if kind == _RIDGE:
        return noise * np.float32(np.sqrt(3 / (16 * np.pi)) / sigma_px**3)
    return noise * np.float32(np.sqrt(1 / (8 * np.pi)) / sigma_px**2)


def _points(
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    sigma_px: float,
    kind: int,
    weak_sigma: float,
    weak_fraction: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    zero, one, two = _kernels(sigma_px)
    filtered = [
        cv2.sepFilter2D(image, cv2.CV_32F, across, along)
        for across, along in ((zero, zero), (one, zero), (zero, one), (two, zero), (one, one), (zero, two))
    ]
    offset, strength = _taylor_kernel(*filtered, kind)
    weak = _response_noise(noise, sigma_px, kind) * weak_sigma
    found = lit & (strength > weak)
    if found.any():
        found &= strength > weak_fraction * np.percentile(strength[found], 90)
    rows, columns = np.nonzero(found)
    starts = np.stack([columns, rows], axis=1) + offset[rows, columns]
    x, y, normals, response, kept = _newton_kernel(
        image, starts.astype(np.float64), columns.astype(np.int32), rows.astype(np.int32), sigma_px, kind
    )
    # Noise of the numerator of the last step over its slope: ∫ g_x² for the ridge, ∫ g² = 1/(4 π σ²) for the edge.
    gain = np.sqrt(1 / (8 * np.pi)) / sigma_px**2 if kind == _RIDGE else np.sqrt(1 / (4 * np.pi)) / sigma_px
    deviation = noise[rows, columns] * gain / np.maximum(response, 1e-12)
    return x[kept], y[kept], normals[kept], response[kept], deviation[kept].astype(np.float64)


def _kernels(sigma_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    radius = int(np.ceil(_SUPPORT * sigma_px))
    at = np.arange(-radius, radius + 1, dtype=np.float64)
    zero = np.exp(-(at**2) / (2 * sigma_px**2))
    zero /= zero.sum()
    one = at / sigma_px**2 * zero
    one /= (one * at).sum()
    two = (at**2 / sigma_px**4 - 1 / sigma_px**2) * zero
    two -= two.mean()
    two /= (two * at**2).sum() / 2
    # sepFilter2D correlates: a rising ramp gives +1 with `one`, a parabola x²/2 gives +1 with `two`.
    return zero, one, two


@njit(cache=True, nogil=True, parallel=True)
def _taylor_kernel(r: Any, rx: Any, ry: Any, rxx: Any, rxy: Any, ryy: Any, kind: int) -> Any:
    rows, columns = r.shape
    offset = np.zeros((rows, columns, 2), dtype=np.float32)
    strength = np.zeros((rows, columns), dtype=np.float32)
    for y in prange(rows):
        for x in range(columns):
            if kind == _RIDGE:
                nx, ny, curvature = _ridge_normal(rxx[y, x], rxy[y, x], ryy[y, x])
                if curvature >= 0:
                    continue
                t = -(rx[y, x] * nx + ry[y, x] * ny) / curvature
                response = -curvature
            else:
                gradient = np.sqrt(rx[y, x] ** 2 + ry[y, x] ** 2)
                if gradient <= 1e-9:
                    continue
                nx, ny = rx[y, x] / gradient, ry[y, x] / gradient
                t = -r[y, x] / gradient
                response = gradient
            if abs(t * nx) <= _TAYLOR_BOX and abs(t * ny) <= _TAYLOR_BOX:
                offset[y, x, 0] = t * nx
                offset[y, x, 1] = t * ny
                strength[y, x] = response
    return offset, strength


@njit(cache=True, nogil=True, inline="always")
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


@njit(cache=True, nogil=True, parallel=True)
def _newton_kernel(image: Any, starts: Any, columns: Any, rows: Any, sigma: float, kind: int) -> Any:
    """One Newton step from each start on kernels centred there; the response and normal are those of the start."""
    count = len(starts)
    height, width = image.shape
    radius = int(np.ceil(_SUPPORT * sigma))
    size = 2 * radius + 1
    x_out = np.zeros(count)
    y_out = np.zeros(count)
    normals = np.zeros((count, 2))
    response = np.zeros(count)
    kept = np.zeros(count, dtype=np.bool_)
    for i in prange(count):
        cx, cy = starts[i, 0], starts[i, 1]
        column, row = columns[i], rows[i]
        if column < radius or row < radius or column >= width - radius or row >= height - radius:
            continue
        wx = np.zeros((3, size))
        wy = np.zeros((3, size))
        _centred_weights(wx, column - radius - cx, sigma)
        _centred_weights(wy, row - radius - cy, sigma)
        r = rx = ry = rxx = rxy = ryy = 0.0
        for j in range(size):
            a0 = a1 = a2 = 0.0
            for k in range(size):
                value = image[row - radius + j, column - radius + k]
                a0 += value * wx[0, k]
                a1 += value * wx[1, k]
                a2 += value * wx[2, k]
            r += a0 * wy[0, j]
            rx += a1 * wy[0, j]
            rxx += a2 * wy[0, j]
            ry += a0 * wy[1, j]
            rxy += a1 * wy[1, j]
            ryy += a0 * wy[2, j]
        if kind == _RIDGE:
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
        x, y = cx + t * nx, cy + t * ny
        if abs(x - column) > _NEWTON_BOX or abs(y - row) > _NEWTON_BOX:
            continue
        x_out[i], y_out[i] = x, y
        normals[i, 0], normals[i, 1] = nx, ny
        response[i] = strength
        kept[i] = True
    return x_out, y_out, normals, response, kept


@njit(cache=True, nogil=True)
def _centred_weights(out: Any, first: float, sigma: float) -> None:
    """Fill (3, size) with Gaussian, first and second derivative weights for samples at first, first + 1, …"""
    size = out.shape[1]
    total = 0.0
    for k in range(size):
        at = first + k
        out[0, k] = np.exp(-at * at / (2 * sigma * sigma))
        total += out[0, k]
    s2 = sigma * sigma
    for k in range(size):
        at = first + k
        g = out[0, k] / total
        out[0, k] = g
        out[1, k] = at / s2 * g
        out[2, k] = (at * at / s2 - 1) / s2 * g
