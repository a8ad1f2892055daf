"""Lenses that are sharp at one distance: how far each pixel's light is spread beyond that, and blending by it.

The image of a point at distance d through a lens focused at f is a disc as wide as |1/f - 1/d|, taken for a Gaussian of
the standard deviation σ = s |1 - f/d|; s is that of a point far away. An image is rendered at a few levels of σ, and
each pixel lies between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray

LEVELS_PX = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Between two of these neighbours the mean of two Gaussians is within 3 % of white of one, also for a line of 1 px."""


@dataclass(frozen=True, slots=True)
class Focus:
    """sharp_mm : distance from the lens at which it is sharp. far_px : spread of a point far away."""

    sharp_mm: float = 1.0
    far_px: float = 0.0

    def spread_px(self, distance_mm: FloatArray) -> FloatArray:
        """Standard deviation at these distances, same shape; 0 where there is nothing (NaN)."""
        spread = self.far_px * np.abs(1 - self.sharp_mm / distance_mm)
        return np.asarray(np.nan_to_num(spread).clip(max=LEVELS_PX[-1]))


ALWAYS_SHARP = Focus()


def level_weights(spread_px: FloatArray) -> dict[int, NDArray[np.float32]]:
    """(H, W) float32 by the index of each level in use: how much of its image each pixel takes. They add up to 1."""
    levels = np.array(LEVELS_PX)
    above = np.searchsorted(levels, spread_px, side="left").clip(1, len(levels) - 1)
    share = (spread_px - levels[above - 1]) / (levels[above] - levels[above - 1])
    weights = {}
    for index in range(len(levels)):
        weight = np.where(above == index, share, 0) + np.where(above - 1 == index, 1 - share, 0)
        if weight.any():
            weights[index] = weight.astype(np.float32)
    return weights
