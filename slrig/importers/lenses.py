"""Lenses of other programs in slrig's terms: k1, k2, p1, p2, k3.

A lens of more terms (OpenCV's rational, thin prism and tilt models) or of another model (equidistant, as OpenCV's
fisheye and Kalibr have it) is fitted over its image, with its matrix: what remains is an error of the calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from slrig.errors import CalibrationError
from slrig.model import FloatArray, Size
from slrig.model.lens import distort

MAX_FIT_PX = 0.2
"""Rms over the image of the difference between a lens and its fit: about what a good calibration leaves."""
_GRID = 33  # pixels along each side of the image, its border included
_PATH_STEPS, _NEWTON_STEPS, _STEP = 24, 3, 1e-6
_OPENCV_COUNTS = (4, 5, 8, 12, 14)


class Lens(NamedTuple):
    """A lens in slrig's terms. matrix : (3, 3); distortion : (5,); rms_px, worst_px : error of a fit, 0 without one."""

    matrix: FloatArray
    distortion: FloatArray
    rms_px: float = 0.0
    worst_px: float = 0.0

    @property
    def note(self) -> str:
        """What the fit costs; empty if the lens needed none."""
        return (
            f"its lens was fitted with k1, k2, p1, p2 and k3, which leaves {self.rms_px:.2g} px (rms over the image, "
            f"{self.worst_px:.2g} px at worst)"
            if self.rms_px
            else ""
        )


def as_lens(matrix: FloatArray, terms: FloatArray, size: Size, name: str, *, equidistant: bool = False) -> Lens:
    """Return a lens in slrig's terms. terms : OpenCV's k1, k2, p1, p2, k3, ...; of an equidistant lens k1 to k4.
    name : the entry, for messages.

    Raises CalibrationError: the number of terms is of no model, or the fit leaves more than `MAX_FIT_PX`.
    """
    terms = terms.ravel()
    if equidistant and len(terms) != 4:
        raise CalibrationError(f"{name}: expected 4 terms of an equidistant lens, found {len(terms)}; export it again")
    if not equidistant and (len(terms) not in _OPENCV_COUNTS or not terms[5:].any()):
        if len(terms) < 4:
            raise CalibrationError(
                f"{name}: expected 4 or more terms k1, k2, p1, p2, k3, found {len(terms)}; add zeros for the others"
            )
        if terms[5:].any():
            raise CalibrationError(f"{name}: expected {_OPENCV_COUNTS} terms of a lens, found {len(terms)}")
        five = np.zeros(5)
        five[: min(5, len(terms))] = terms[:5]
        return Lens(matrix, five)
    lens = _fit(matrix, terms, size, equidistant=equidistant)
    if lens is None or not lens.rms_px <= MAX_FIT_PX:
        model = "equidistant (fisheye)" if equidistant else f"of {len(terms)} terms (rational)"
        left = "its polynomial folds within the image" if lens is None else (
            f"the best fit is {lens.rms_px:.2g} px off (rms over {size}, {lens.worst_px:.2g} px at worst; at most "
            f"{MAX_FIT_PX} px)"
        )  # fmt: skip
        raise CalibrationError(
            f"{name}: expected a lens that k1, k2, p1, p2 and k3 describe, found one {model}: {left}; calibrate it "
            "with these five terms (OpenCV's default, ROS's plumb_bob, Kalibr's pinhole-radtan), or over a smaller "
            "part of the image"
        )
    return lens


def _fit(matrix: FloatArray, terms: FloatArray, size: Size, *, equidistant: bool) -> Lens | None:
    """Return the least-squares fit; None if the lens has no ray for some pixels."""
    from scipy.optimize import least_squares

    sides = [np.linspace(0, side - 1, _GRID) for side in (size.width_px, size.height_px)]
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    distorted = np.asarray(np.linalg.solve(matrix, np.column_stack([pixels, np.ones(len(pixels))]).T)[:2].T, float)

    def equidistant_lens(rays: FloatArray) -> FloatArray:
        radius = np.hypot(*rays.T)
        angle = np.arctan(radius)
        scaled = angle * (1 + np.polyval([*terms[::-1], 0.0], angle**2))
        return np.asarray(rays * np.divide(scaled, radius, out=np.ones_like(radius), where=radius > 0)[:, None])

    def opencv_lens(rays: FloatArray) -> FloatArray:
        points = np.column_stack([rays, np.ones(len(rays))])
        return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), terms)[0].reshape(-1, 2))

    rays = _undistort(equidistant_lens if equidistant else opencv_lens, distorted)
    if not np.isfinite(rays).all():
        return None
    start = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0, 0, 0, 0, 0])
    scale = np.array([100.0, 100.0, 10.0, 10.0, 0.1, 0.1, 0.01, 0.01, 0.1])

    def difference_px(p: FloatArray) -> FloatArray:
        x, y = distort(p[4:], *rays.T)[:2]
        return np.concatenate([p[0] * x + matrix[0, 1] * y + p[2] - pixels[:, 0], p[1] * y + p[3] - pixels[:, 1]])

    found = least_squares(difference_px, start, x_scale=scale)
    fitted = matrix.copy()
    fitted[0, 0], fitted[1, 1], fitted[0, 2], fitted[1, 2] = found.x[:4]
    error = np.hypot(*found.fun.reshape(2, -1))
    return Lens(fitted, found.x[4:], max(float(np.sqrt(np.mean(error**2))), 1e-9), float(error.max()))


def _undistort(lens: Callable[[FloatArray], FloatArray], distorted: FloatArray) -> FloatArray:
    """Return the rays (n, 2) of distorted points by the branch that begins at the axis; NaN where the lens folds.

    As `slrig.model.plausibility.imaged_pixels`: short steps from the axis, each by Newton's method.
    """
    rays = np.zeros_like(distorted)
    with np.errstate(all="ignore"):
        for step in range(1, _PATH_STEPS + 1):
            for _ in range(_NEWTON_STEPS):
                at = lens(rays)
                by_x = (lens(rays + np.array([_STEP, 0.0])) - at) / _STEP
                by_y = (lens(rays + np.array([0.0, _STEP])) - at) / _STEP
                det = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
                error = step / _PATH_STEPS * distorted - at
                newton = np.column_stack([
                    by_y[:, 1] * error[:, 0] - by_y[:, 0] * error[:, 1],
                    by_x[:, 0] * error[:, 1] - by_x[:, 1] * error[:, 0],
                ])  # fmt: skip
                rays = rays + newton / np.where(det > 0, det, np.nan)[:, None]
    return rays
