"""What the faulty rig looks at: a flat wall, half a metre away, and devices with an exact calibration."""

from __future__ import annotations

import numpy as np

from slrig.model import Calibration, FloatArray, Pinhole, Pixels, Size

PROJECTOR = Size(64, 48)
CAMERA = Size(96, 72)
CAMERA_NAME = "left"

_DISTANCE_MM = 500.0
_BASELINE_MM = 120.0
_CAMERA_FOCAL_PX = 150.0
_PROJECTOR_FOCAL_PX = 100.0
_BLUR_PX = 0.5
_BLACK_DN, _WHITE_DN, _NOISE_DN = 6.0, 190.0, 1.0


def _device(size: Size, focal_px: float, shift_mm: float) -> Pinhole:
    """A device that looks along z from (`shift_mm`, 0, 0), aimed at the wall's middle by its principal point."""
    centre_px = (size.width_px - 1) / 2 + focal_px * shift_mm / _DISTANCE_MM
    matrix = np.array([[focal_px, 0.0, centre_px], [0.0, focal_px, (size.height_px - 1) / 2], [0.0, 0.0, 1.0]])
    return Pinhole(size, matrix, np.zeros(5), np.eye(3), np.array([-shift_mm, 0.0, 0.0]))


def calibration() -> Calibration:
    return Calibration(
        {CAMERA_NAME: _device(CAMERA, _CAMERA_FOCAL_PX, 0.0)}, _device(PROJECTOR, _PROJECTOR_FOCAL_PX, _BASELINE_MM)
    )


def photograph(profile: Pixels | None, noise: np.random.Generator) -> Pixels:
    """What the camera sees of a column pattern, or of the dark: (H, W) uint8."""
    light = np.zeros(CAMERA.width_px)
    if profile is not None:
        light = _SPREAD @ np.broadcast_to(profile[0], (PROJECTOR.width_px,)) / 255
    level = _BLACK_DN + (_WHITE_DN - _BLACK_DN) * np.broadcast_to(light, CAMERA.shape)
    return np.clip(np.rint(level + _NOISE_DN * noise.standard_normal(CAMERA.shape)), 0, 255).astype(np.uint8)


def _spread() -> FloatArray:
    """(camera columns, projector columns): how much of each projector column's light each camera column gets."""
    scale = _PROJECTOR_FOCAL_PX / _CAMERA_FOCAL_PX
    columns = (np.arange(CAMERA.width_px) - (CAMERA.width_px - 1) / 2) * scale + (PROJECTOR.width_px - 1) / 2
    # The wall beyond the projector's edge is lit by nothing: the columns out there take their share with them.
    beyond = np.arange(-4, PROJECTOR.width_px + 4)
    weights = np.exp(-((columns[:, None] - beyond[None, :]) ** 2) / (2 * _BLUR_PX**2))
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(weights[:, 4:-4])


_SPREAD = _spread()
