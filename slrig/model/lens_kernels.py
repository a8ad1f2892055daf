"""The lens model for kernels: `slrig.model.lens` compiled, and the way back from distorted to undistorted points.

A module of its own, which `slrig.model` does not import: numba takes a second to load.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import kernel_part
from slrig.model import lens as model

STEPS = 30  # Newton's method doubles the digits with each: what needs more does not settle

distorted = kernel_part(inline="always")(model.distorted)
by_terms = kernel_part(inline="always")(model.by_terms)


@kernel_part(inline="always")
def undistorted(lens: Any, xd: float, yd: float, x: float, y: float, settled: float) -> Any:
    """The point (x, y) that the lens sends to (xd, yd), by Newton's method from a start.

    lens : (5,) float64; settled : a step shorter than this is the last, and leaves about the square of it.
    NaN for a point that the lens cannot light: beyond the radius where its distortion turns back there is no direction.
    """
    for _ in range(STEPS):
        dx, dy = step_back(lens, xd, yd, x, y)
        x += dx
        y += dy
        size = dx * dx + dy * dy
        if size < settled * settled:
            return x, y
        if np.isnan(size):
            break
    return np.nan, np.nan


@kernel_part(inline="always")
def step_back(lens: Any, xd: float, yd: float, x: float, y: float) -> Any:
    """A step of Newton's method from (x, y) towards the point that the lens sends to (xd, yd); NaN where the lens has
    turned back.
    """
    gx, gy, a, b, c = distorted(lens, x, y)
    det = a * c - b * b
    scale = 1 / det if det > 0 else np.nan
    return (c * (xd - gx) - b * (yd - gy)) * scale, (a * (yd - gy) - b * (xd - gx)) * scale
