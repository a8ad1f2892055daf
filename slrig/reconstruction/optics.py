"""Pinholes with a lens (`slrig.model.lens`), for kernels: pixels to rays and points to pixels.

A device is passed to kernels as one flat array (22,) float64:
fx, skew, cx, fy, cy, the lens's k1, k2, p1, p2, k3, then the rotation row by row and the translation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, Pinhole
from slrig.model.lens_kernels import distorted, undistorted

_POINTS = 1024  # that are worth calling a kernel for
SETTLED = 1e-7  # a step shorter than this, in normalised coordinates, is the last of the way back through a lens


def packed(device: Pinhole) -> FloatArray:
    """(22,) float64: the device as kernels take it."""
    m = device.matrix
    return np.concatenate(
        [
            [m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2]],
            device.distortion,
            device.rotation.ravel(),
            device.translation_mm,
        ]
    ).astype(np.float64)


def rays(device: Pinhole, points_px: FloatArray) -> FloatArray:
    """(n, 3) float64: world direction through each pixel (n, 2), scaled so that its depth in the device is 1."""
    points, out = np.ascontiguousarray(points_px, dtype=np.float64), np.zeros((len(points_px), 3))
    in_bands(_rays_kernel, len(points), packed(device), points, out, rows_at_least=_POINTS)
    return out


def project(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64 pixels of world points (n, 3); NaN for points behind the device."""
    points, out = np.ascontiguousarray(points_mm, dtype=np.float64), np.full((len(points_mm), 2), np.nan)
    in_bands(_project_kernel, len(points), packed(device), points, out, rows_at_least=_POINTS)
    return out


def to_depths(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n,) float64: depth of world points (n, 3) along the device's optical axis, mm."""
    return np.asarray(points_mm @ device.rotation[2] + device.translation_mm[2])


@kernel_part(inline="always")
def distorted_from_pixel(d: Any, u: float, v: float) -> Any:
    """Normalised coordinates of a pixel, as the lens distorted them."""
    yd = (v - d[4]) / d[3]
    return (u - d[2] - d[1] * yd) / d[0], yd


@kernel_part
def normalised_from_pixel(d: Any, u: float, v: float) -> Any:
    """Undistorted normalised coordinates of a pixel, NaN for one that the lens cannot light."""
    xd, yd = distorted_from_pixel(d, u, v)
    return undistorted(d[5:10], xd, yd, xd, yd, SETTLED)


@kernel_part
def world_ray(d: Any, u: float, v: float, out: Any) -> None:
    """Fill out (3,) with the world direction through a pixel: Rᵀ (x, y, 1)."""
    x, y = normalised_from_pixel(d, u, v)
    for k in range(3):
        out[k] = d[10 + k] * x + d[13 + k] * y + d[16 + k]


@kernel_part(inline="always")
def to_device(d: Any, px: float, py: float, pz: float) -> Any:
    """World point to device coordinates, mm: R X + t."""
    return (
        d[10] * px + d[11] * py + d[12] * pz + d[19],
        d[13] * px + d[14] * py + d[15] * pz + d[20],
        d[16] * px + d[17] * py + d[18] * pz + d[21],
    )


@kernel(in_every_scan=False)
def _rays_kernel(first: int, last: int, d: Any, points: Any, out: Any) -> None:
    for i in range(first, last):
        world_ray(d, points[i, 0], points[i, 1], out[i])


@kernel(in_every_scan=False)
def _project_kernel(first: int, last: int, d: Any, points: Any, out: Any) -> None:
    for i in range(first, last):
        px, py, pz = to_device(d, points[i, 0], points[i, 1], points[i, 2])
        if pz > 0:
            xd, yd, _, _, _ = distorted(d[5:10], px / pz, py / pz)
            out[i, 0] = d[0] * xd + d[1] * yd + d[2]
            out[i, 1] = d[3] * yd + d[4]
