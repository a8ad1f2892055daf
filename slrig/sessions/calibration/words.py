"""What each number of a calibration is called, and means, in one sentence."""

from __future__ import annotations

import math

MEANINGS = {
    "expected error of a point": (
        "How far, one standard deviation, a scanned point lies from where it is, along the camera's line of sight, "
        "because the calibration is not perfect; the same for every point nearby, so that averaging does not help."
    ),
    "error across the line of sight": (
        "How far, one standard deviation, a point whose distance is known lies from where it is, across the camera's "
        "line of sight, because the calibration is not perfect. One camera alone tells no distance and cannot scan: "
        "that takes a projector or a second camera, calibrated with it."
    ),
    "noise of a point": (
        "How much the light's own noise moves one point, independently of its neighbours; smoothing or averaging "
        "lowers it."
    ),
    "both together": "The error of one point from calibration and noise, as the root of the sum of their squares.",
    "error of a length": (
        "How wrong a measured length of about half the volume's diagonal is, one standard deviation; multiply it by "
        "the length."
    ),
    "rms": (
        "How far the observations lie from where the calibration puts them (a camera's corners: distance; the "
        "projector's light: one coordinate). It says that the model fits the pictures, not that it measures well."
    ),
    "held out": (
        "The same at poses that were kept from the solve. Far above 1.3 times the rms, the model has learned the noise "
        "of too few poses."
    ),
    "noise alone": (
        "What the rms would be if nothing but noise were wrong. An rms far above it comes from a bent board, a "
        "movement, or a lens that the model does not fit."
    ),
    "observations": "Corners, or coordinates of light, that the solve used.",
    "outlying": "Of them, those far from all others, which the solve gave next to no weight.",
    "±": (
        "± is one standard deviation, from the solve's covariance: two calibrations of the same rig differ by about "
        "that much, and hardly ever by three times as much."
    ),
    "fx": "The larger, the narrower the view.",
    "fy": "The same as across where pixels are square.",
    "cx": "The column where the optical axis meets the image.",
    "cy": "The row; with lens shift it lies near or beyond the image's edge, as it should.",
    "k1": "How much straight lines bend: negative, outwards like a barrel.",
    "k2": "The same, felt towards the corners.",
    "p1": "A lens that is tilted or off centre, down.",
    "p2": "A lens that is tilted or off centre, across.",
    "k3": "Bending that is felt in the outermost corners only.",
    "x_mm": "Its centre of projection, to the right of the first camera's.",
    "y_mm": "The same, below it.",
    "z_mm": "The same, in front of it.",
    "baseline": "The distance between two devices is the ruler that everything is measured with.",
    "angle": "The smaller the angle at which they look at the middle of the volume, the less they can tell of depth.",
    "tilt": "Tilt is the angle between the board's normal and the first camera's line of sight to it.",
    "distance": "Distance is from the first camera to the middle of the board.",
    "coverage": "Where no pose put the board, the lens is a guess from its neighbourhood.",
}

NAMES = {
    "fx": "focal length across",
    "fy": "focal length down",
    "cx": "principal point across",
    "cy": "principal point down",
    "k1": "radial distortion",
    "k2": "radial distortion",
    "p1": "tangential distortion",
    "p2": "tangential distortion",
    "k3": "radial distortion",
    "x_mm": "place, x",
    "y_mm": "place, y",
    "z_mm": "place, z",
}
"""What the parameters of a device are called."""


def rounded(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, never as a power of ten.

    >>> rounded(0.17672), rounded(0.000591), rounded(1253.4), rounded(0.0)
    ('0.177', '0.000591', '1253', '0')
    """
    if not value or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
