"""Noise of a camera: the variance of a sample by its level."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slrig.model.geometry import FloatArray, IntArray

_QUANTISATION_VARIANCE = 1.0 / 12.0  # of rounding to whole camera units: no camera has less
_BINS = 24
MIN_RANGE_SIGMA = 10.0
"""Least range of levels, in standard deviations of the noise, that determines the slope."""
_MIN_PER_BIN = 50


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """variance(I) = read_variance · read_share + slope · shot_share · I, camera units squared.

    read_variance, slope : of a frame as the camera gives it. read_share, shot_share : (H, W) float32, their remaining
    share at each pixel of fused exposures (`slrig.reconstruction.fusion`); None for frames as the camera gives them,
    where both are 1. loss : (8, 8), result of `compression_loss` for fused or linearised frames, which do not show it
    any more; None for others.
    """

    read_variance: float
    slope: float
    read_share: NDArray[np.float32] | None = None
    shot_share: NDArray[np.float32] | None = None
    loss: FloatArray | None = None

    def variance(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) float32: expected variance of each sample of `image`."""
        if self.read_share is None or self.shot_share is None:
            # One array, because new memory costs more than the sums.
            variance = np.maximum(image, 0)
            variance *= np.float32(self.slope)
            variance += np.float32(self.read_variance)
            return np.asarray(variance)
        read, shot = np.float32(self.read_variance) * self.read_share, np.float32(self.slope) * self.shot_share
        return np.asarray(read + shot * np.maximum(image, 0), dtype=np.float32)

    def variance_at(self, level: float) -> float:
        """Variance of a sample of this level, for a frame as the camera gives it."""
        return self.read_variance + self.slope * max(level, 0.0)

    def rows(self, rows: slice | IntArray) -> NoiseModel:
        """Select rows."""
        if self.read_share is None or self.shot_share is None:
            return self
        return replace(self, read_share=self.read_share[rows], shot_share=self.shot_share[rows])

    def scale_variance(self, factor: float) -> NoiseModel:
        """Multiply the variance of every sample."""
        return replace(self, read_variance=self.read_variance * factor, slope=self.slope * factor)

    def add_variance(self, variance: float) -> NoiseModel:
        """Add variance to every sample, at all levels."""
        return replace(self, read_variance=self.read_variance + variance)


def fit_noise(samples: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> NoiseModel:
    """Fit the noise model to levels and variances of samples, (n,) float32 each, of each exposure of one camera."""
    level, variance = map(np.concatenate, zip(*samples, strict=True))
    floor = NoiseModel(_QUANTISATION_VARIANCE, 0.0)
    if len(level) < _MIN_PER_BIN:
        return floor
    # Sorted by level, a bin is a range of samples with its median level in the middle.
    order = np.argsort(level)
    level, variance = level[order], variance[order]
    borders = np.unique(np.quantile(level, np.linspace(0, 1, _BINS + 1)))
    # A sample on a border belongs to the bin above it, the largest to the last.
    bin_ends = np.searchsorted(level, borders[1:-1], side="left")
    points = [
        (float(np.median(level[a:b])), float(np.median(variance[a:b])), int(b - a))
        for a, b in pairwise([0, *bin_ends, len(level)])
        if b - a >= _MIN_PER_BIN
    ]
    if not points:
        return floor
    x, y, weight = np.array(points).T
    # Levels that hardly differ do not determine the slope.
    if np.ptp(x) < MIN_RANGE_SIGMA * np.sqrt(np.median(y)):
        return NoiseModel(max(float(np.median(y)), _QUANTISATION_VARIANCE), 0.0)
    # Weighted by 1/variance: the scatter of a variance grows with the variance.
    root = np.sqrt(weight) / np.maximum(y, _QUANTISATION_VARIANCE)
    slope, read = np.linalg.lstsq(np.stack([x, np.ones_like(x)], axis=1) * root[:, None], y * root, rcond=None)[0]
    if slope <= 0:
        return NoiseModel(max(float(np.average(y, weights=weight)), _QUANTISATION_VARIANCE), 0.0)
    return NoiseModel(max(float(read), _QUANTISATION_VARIANCE), float(slope))
