"""The lens model for kernels: `slrig.model.lens` compiled, and the inverse, from distorted to undistorted points.

`slrig.model` does not import this module, because numba takes a second to load.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import kernel_part
from slrig.model import lens as lens_model

MAX_STEPS = 30  # Newton's method doubles the correct digits with each step: a point that needs more does not converge

distort = kernel_part(inline="always")(lens_model.distort)
distortion_by_terms = kernel_part(inline="always")(lens_model.distortion_by_terms)


@kernel_part(inline="always")
def undistort(lens: Any, xd: float, yd: float, x: float, y: float, settled: float) -> Any:
    """Return the point (x, y) that the lens distorts to (xd, yd), by Newton's method from a start value.

    lens : (5,) float64; settled : length of the last step; the remaining error is about its square.
    NaN for a point beyond the radius where the distortion is invertible.
    """
    for _ in range(MAX_STEPS):
        dx, dy = undistort_step(lens, xd, yd, x, y)
        x += dx
        y += dy
        size = dx * dx + dy * dy
        if size < settled * settled:
            return x, y
        if np.isnan(size):
            break
    return np.nan, np.nan


@kernel_part(inline="always")
def undistort_step(lens: Any, xd: float, yd: float, x: float, y: float) -> Any:
    """Return a step of Newton's method from (x, y) towards the point that the lens distorts to (xd, yd); NaN where the
    distortion is not invertible.
    """
    gx, gy, a, b, c = distort(lens, x, y)
    det = a * c - b * b
    scale = 1 / det if det > 0 else np.nan
    return (c * (xd - gx) - b * (yd - gy)) * scale, (a * (yd - gy) - b * (xd - gx)) * scale
