"""Rays, light and the spare equation of two devices that see one point, by OpenCV's projection.

A pixel of one device fixes a ray. Where the other device measures both coordinates of the same point, one of them gives
the depth on that ray and one is left over: the distance from what was measured to the image of the ray, the epipolar
line (a curve, for a lens that bends it). That distance is zero but for noise as long as the calibration holds, whatever
the point's depth is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slrig.calibration.solution import PARAMETERS
from slrig.model import FloatArray, Pinhole

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-13)
_STEP_MM = 0.05
_TURNS = 4
_STEPS = np.array([1e-2] * 4 + [1e-4] * 5 + [1e-6] * 3 + [1e-3] * 3)
"""Steps of a device's parameters for derivatives: px, lens terms, rad, mm."""


@dataclass(frozen=True, slots=True)
class Spare:
    """The spare equation of n points.

    residual_px : (n,) float64, measured minus the epipolar line, across it, px of the second device.
    across : (n, 2) float64, the unit vector across the line. points_mm : (n, 3) float64, on the first device's ray.
    """

    residual_px: FloatArray
    across: FloatArray
    points_mm: FloatArray


def projected(device: Pinhole, points_mm: FloatArray, /) -> FloatArray:
    """(n, 2) float64: pixels of points (n, 3) in the world; NaN behind the device."""
    turned = points_mm @ device.rotation.T + device.translation_mm
    before = np.isfinite(turned).all(axis=1) & (turned[:, 2] > 0)
    safe = np.where(before[:, None], turned, (0.0, 0.0, 1.0))
    pixels, _ = cv2.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), device.matrix, device.distortion)
    return np.where(before[:, None], np.asarray(pixels, dtype=np.float64).reshape(-1, 2), np.nan)


def rays(device: Pinhole, pixels_px: FloatArray, /) -> FloatArray:
    """(n, 3) float64: directions in the world of pixels (n, 2), of depth 1 in the device."""
    flat = cv2.undistortPoints(pixels_px[:, None], device.matrix, device.distortion, criteria=_CRITERIA)
    ahead = np.column_stack([np.asarray(flat, dtype=np.float64).reshape(-1, 2), np.ones(len(pixels_px))])
    return np.asarray(ahead @ device.rotation)


def spare_equation(
    first: Pinhole, second: Pinhole, pixels_px: FloatArray, measured_px: FloatArray, start_mm: FloatArray, /
) -> Spare:
    """Meet the rays of pixels (n, 2) of the first device with what the second one measured (n, 2).

    start_mm : (n, 3), about where the points are. The point on the ray is that whose image is nearest.
    """
    origin, ahead = first.centre_mm, rays(first, pixels_px)
    depth = (start_mm - origin) @ first.rotation[2]
    for _ in range(_TURNS):
        at = projected(second, origin + depth[:, None] * ahead)
        along = (projected(second, origin + (depth + _STEP_MM)[:, None] * ahead) - at) / _STEP_MM
        off = measured_px - at
        depth = depth + (off * along).sum(axis=1) / (along**2).sum(axis=1)
    points = origin + depth[:, None] * ahead
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    return Spare(((measured_px - projected(second, points)) * across).sum(axis=1), across, points)


def changed(device: Pinhole, change: FloatArray, /) -> Pinhole:
    """The device with its 15 parameters changed, in the order of PARAMETERS."""
    matrix = device.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    turn = np.asarray(cv2.Rodrigues(np.asarray(change[9:12], dtype=np.float64))[0], dtype=np.float64)
    return replace(
        device,
        matrix=matrix,
        distortion=device.distortion + change[4:9],
        rotation=turn @ device.rotation,
        translation_mm=device.translation_mm + change[12:],
    )


def stepped(device: Pinhole, /) -> list[tuple[float, Pinhole, Pinhole]]:
    """For each parameter: the width of a step across its value, and the device at the step's two ends."""
    ends = []
    for number, step in enumerate(_STEPS):
        change = np.zeros(len(PARAMETERS))
        change[number] = step
        ends.append((2 * step, changed(device, -change), changed(device, change)))
    return ends
