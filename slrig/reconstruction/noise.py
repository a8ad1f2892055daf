"""Noise of the camera, estimated from the frames of a scan.

Model: variance(I) = read + slope · I, in camera units (photon transfer; EMVA 1288).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray, coarse_bit_count
from slrig.reconstruction.frames import AxisFrames, Images, at_rows, sampled

_QUANTISATION_VARIANCE = 1.0 / 12.0  # of rounding to whole camera units: no camera has less
_MOST_SAMPLES = 200_000  # some 8000 for each of the bins
_LEAST_RANGE = 10.0  # of levels, in standard deviations of the noise, for a slope
# Of the brightest level, that the darkest has to be below, or else read noise is but guessed at from far. A relief that
# fills the picture has levels of 52 to 90; without dark ones its read noise is told eight times too large.
_DARK_SHARE = 0.25
# Chosen. Half and double change the error of a rendered vase by less than 1 %, but multiply that over the stated one by
# 1.8 and 2.5 on a glossy relief of which one exposure saturates a part.
_BINS = 24
_LEAST_PER_BIN = 50
_BOX = np.ones((3, 3), dtype=np.uint8)
_FEWEST_BITS = 3
_LEAST_LIT = 0.02  # of full scale, white over black
_CLEAR_SWING = 0.75  # of white less black, from the middle: what is less lies at an edge of the code
_MEDIAN_SQUARE = 0.4549  # the median of a squared normal, of its variance


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """variance(I) = read_variance · read_share + slope · shot_share · I, camera units squared.

    read_variance, slope : of a frame as the camera gives it.
    read_share, shot_share : (H, W) float32, what is left of them at each pixel of frames that are fused of several
    exposures (`slrig.reconstruction.fusion`); None for frames as the camera gives them, where both are 1.
    loss : of a bracket and of a camera that bends its values, as `camera_response.compression_loss` gives it: fused and
    straightened frames do not show it any more.
    """

    read_variance: float
    slope: float
    read_share: NDArray[np.float32] | None = None
    shot_share: NDArray[np.float32] | None = None
    loss: FloatArray | None = None

    def variance(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) float32: the variance expected of each sample of `image`."""
        if self.read_share is None or self.shot_share is None:
            # In one array: pages of fresh memory cost more than the sums.
            variance = np.maximum(image, 0)
            variance *= np.float32(self.slope)
            variance += np.float32(self.read_variance)
            return np.asarray(variance)
        read, shot = np.float32(self.read_variance) * self.read_share, np.float32(self.slope) * self.shot_share
        return np.asarray(read + shot * np.maximum(image, 0), dtype=np.float32)

    def at(self, level: float) -> float:
        """The variance of a sample of this level of a frame as the camera gives it."""
        return self.read_variance + self.slope * max(level, 0.0)

    def rows(self, rows: slice | IntArray) -> NoiseModel:
        """The noise of some rows."""
        return replace(self, read_share=at_rows(self.read_share, rows), shot_share=at_rows(self.shot_share, rows))

    def times(self, factor: float) -> NoiseModel:
        """The same with the variance of every sample multiplied."""
        return replace(self, read_variance=self.read_variance * factor, slope=self.slope * factor)

    def with_more(self, variance: float) -> NoiseModel:
        """The same with that much more variance in every sample of a frame, whatever its level."""
        return replace(self, read_variance=self.read_variance + variance)


def estimate_noise(frames: AxisFrames) -> NoiseModel:
    """Fit the noise model to the frames of one camera.

    A bit and its inverse add up to white plus black whatever the code and the lens, so the scatter of that sum over the
    bits is noise alone: variance = 2 · read + slope · (white + black). A projector that spreads its signal before its
    gamma (a scaler, a cable) breaks the sum at code edges, so only the coarser half of the bits counts, which has few.
    Of single bits, two coarse ones that light a pixel differ by noise, and two that do not; and by the light that walls
    of a hollow send to one another. That adds up in lines of half their period and their inverses, or in all such
    lines, which a scaler breaks: the lesser of both is noise.

    Where the sums have one level only, as on an even wall, or none that is dark, the black frame's scatter between
    neighbouring pixels (Immerkær 1996, DOI 10.1006/cviu.1996.0060) tells the noise of the dark. Without any of these
    frames that scatter of white and black stands alone.
    """
    return fitted_noise([noise_samples(frames)])


def fitted_noise(samples: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> NoiseModel:
    """Fit the noise model to what `noise_samples` found in the frames of each exposure of one camera."""
    levels, variances = zip(*samples, strict=True)
    return _fitted(np.concatenate(levels), np.concatenate(variances))


def noise_samples(
    frames: AxisFrames, where: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n,) levels and (n,) variances of single samples: what `estimate_noise` fits its model to.

    where : (H, W) bool, the pixels to take them from; all if it is None.
    """
    coarse, lines = coarse_bit_count(len(frames.bits)), frames.telling_lines
    if frames.inverses is not None and len(frames.bits) >= _FEWEST_BITS:
        level, variance = _scatter_of_sums(frames.bits[:coarse], frames.inverses[:coarse], frames.clipped_at, where)
    elif frames.lines_halve and len(frames.bits) >= _FEWEST_BITS:
        level, variance = _scatter_of_bits(frames, coarse, where)
        by_lines = _scatter_of_lines(frames, where) if lines is None else _scatter_of_pairs(frames, lines, where)
        bright = float(np.median(frames.white))
        if _fitted(*by_lines).at(bright) < _fitted(level, variance).at(bright):
            level, variance = by_lines
    else:
        return _scatter_between_neighbours(frames, where, frames.white, frames.black)
    if len(level) and not _tells_slope(level, variance):
        dark, dark_variance = _scatter_between_neighbours(frames, where, frames.black)
        level, variance = np.concatenate([level, dark]), np.concatenate([variance, dark_variance])
    return level, variance


def _tells_slope(level: NDArray[np.float32], variance: NDArray[np.float32]) -> bool:
    """Whether levels differ by more than noise makes them, and some are dark; the outermost hundredths do not count."""
    low, high = np.quantile(level, (0.01, 0.99))
    return bool(high - low >= _LEAST_RANGE * np.sqrt(np.median(variance)) and low < _DARK_SHARE * high)


def _scatter_of_sums(
    bits: Images, inverses: Images, clipped_at: float, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples, half those of the sums."""
    step = math.ceil(math.sqrt(bits[0].size / _MOST_SAMPLES))
    direct, inverse = sampled(bits, step, step), sampled(inverses, step, step)
    sums = direct + inverse
    unclipped = (np.maximum(direct, inverse).max(axis=0) < clipped_at) & (np.minimum(direct, inverse).min(axis=0) > 0)
    if where is not None:
        unclipped &= where[::step, ::step]
    count = len(sums) - 1
    variance = sums.var(axis=0, ddof=1, dtype=np.float64)
    # A bin takes the median, which lies below the mean of a chi-square (Wilson-Hilferty).
    variance = variance / (1 - 2 / (9 * count)) ** 3
    return sums.mean(axis=0)[unclipped] / 2, (variance[unclipped] / 2).astype(np.float32)


def _scatter_of_lines(
    frames: AxisFrames, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: lines that light half of their period add up to white and black, half as
    often as there are lines.
    """
    step = math.ceil(math.sqrt(frames.white.size / _MOST_SAMPLES))
    lines, ends = sampled(frames.lines, step, step), (frames.white + frames.black)[::step, ::step]
    half = len(lines) / 2
    usable = (lines.max(axis=0) < frames.clipped_at) & (lines.min(axis=0) > 0)
    usable &= (frames.white[::step, ::step] < frames.clipped_at) & (frames.black[::step, ::step] > 0)
    if where is not None:
        usable &= where[::step, ::step]
    difference = (lines.sum(axis=0) - np.float32(half) * ends)[usable]
    return ends[usable] / 2, _variances(difference, 2 * half + 2 * half**2 / frames.ends_repeats)


def _scatter_of_pairs(
    frames: AxisFrames, lines: tuple[Images, Images], where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: two lines and their inverses have the same sums. Of the pixels that are
    lit, the half that lies farthest from edges counts.
    """
    step = math.ceil(math.sqrt(frames.white.size / _MOST_SAMPLES))
    direct, inverse = (sampled(images, step, step) for images in lines)
    contrast = frames.contrast[::step, ::step]
    usable = (np.maximum(direct, inverse).max(axis=0) < frames.clipped_at) & (
        np.minimum(direct, inverse).min(axis=0) > 0
    )
    clear = np.abs(direct - inverse).min(axis=0) / np.maximum(contrast, 1)
    lit = contrast > _LEAST_LIT * frames.clipped_at
    usable &= ~lit | (clear >= (np.median(clear[lit]) if lit.any() else 0.0))
    if where is not None:
        usable &= where[::step, ::step]
    first, second = (direct + inverse)[:, usable]
    # White and black tell the level: whether the mean of whole numbers is whole goes by whether they differ by an even
    # number.
    level = (frames.white + frames.black)[::step, ::step][usable] / 2
    return level, _variances(first - second, 4)


def _scatter_of_bits(
    frames: AxisFrames, coarse: int, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: of coarse bits, two that light a pixel, and two that do not."""
    step = math.ceil(math.sqrt(frames.white.size / _MOST_SAMPLES))
    bits = sampled(frames.bits[:coarse], step, step)
    white, black = (each[::step, ::step] for each in (frames.white, frames.black))
    swing = (2 * bits - white - black) / np.maximum(white - black, 1)
    usable = (bits.max(axis=0) < frames.clipped_at) & (bits.min(axis=0) > 0)
    if where is not None:
        usable &= where[::step, ::step]
    levels, variances = [], []
    for state, level in ((swing > _CLEAR_SWING, white), (swing < -_CLEAR_SWING, black)):
        first = np.argmax(state, axis=0)
        last = coarse - 1 - np.argmax(state[::-1], axis=0)
        two = usable & (np.count_nonzero(state, axis=0) > 1)
        one, other = (np.take_along_axis(bits, at[None], axis=0)[0][two] for at in (first, last))
        levels.append(level[two])
        variances.append(_variances(one - other, 2))
    return np.concatenate(levels), np.concatenate(variances)


def _variances(difference: NDArray[np.float32], samples: float) -> NDArray[np.float32]:
    """(n,) float32: variances of single samples, whose median is to be taken, by what so many of them differ."""
    # Whole numbers have a coarse median; spread over the interval that each stands for, they have a fine one.
    spread = difference + np.random.default_rng(0).uniform(-0.5, 0.5, len(difference)).astype(np.float32)
    return np.asarray((spread**2 / _MEDIAN_SQUARE - 1 / 12) / samples, dtype=np.float32)


def _scatter_between_neighbours(
    frames: AxisFrames, where: NDArray[np.bool_] | None, *images: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    levels, variances = [], []
    for image in images:
        across = image[:, :-2] - 2 * image[:, 1:-1] + image[:, 2:]
        both = across[:-2] - 2 * across[1:-1] + across[2:]
        # The mask sums to zero, so the mean of its pixels is independent of its response; the centre alone is not.
        mean = cv2.blur(image, (3, 3))[1:-1, 1:-1]
        lowest, highest = cv2.erode(image, _BOX)[1:-1, 1:-1], cv2.dilate(image, _BOX)[1:-1, 1:-1]
        unclipped = (lowest > 0) & (highest < frames.clipped_at)
        if where is not None:
            unclipped &= where[1:-1, 1:-1]
        levels.append(mean[unclipped])
        # The mask has norm² 36.
        variances.append(both[unclipped] ** 2 * (frames.ends_repeats / 36 / _MEDIAN_SQUARE))
    return np.concatenate(levels), np.concatenate(variances)


def _fitted(level: NDArray[np.float32], variance: NDArray[np.float32]) -> NoiseModel:
    floor = NoiseModel(_QUANTISATION_VARIANCE, 0.0)
    if len(level) < _LEAST_PER_BIN:
        return floor
    # In order of level a bin is a stretch, and its median level the stretch's middle.
    order = np.argsort(level)
    level, variance = level[order], variance[order]
    borders = np.unique(np.quantile(level, np.linspace(0, 1, _BINS + 1)))
    # A sample on a border belongs to the bin above it, the largest to the last.
    ends = np.searchsorted(level, borders[1:-1], side="left")
    points = [
        (float(np.median(level[a:b])), float(np.median(variance[a:b])), int(b - a))
        for a, b in pairwise([0, *ends, len(level)])
        if b - a >= _LEAST_PER_BIN
    ]
    if not points:
        return floor
    x, y, weight = np.array(points).T
    # Levels that differ by little more than noise tell nothing of the slope.
    if np.ptp(x) < _LEAST_RANGE * np.sqrt(np.median(y)):
        return NoiseModel(max(float(np.median(y)), _QUANTISATION_VARIANCE), 0.0)
    # Weighted by 1/variance: the scatter of a variance grows with the variance.
    root = np.sqrt(weight) / np.maximum(y, _QUANTISATION_VARIANCE)
    slope, read = np.linalg.lstsq(np.stack([x, np.ones_like(x)], axis=1) * root[:, None], y * root, rcond=None)[0]
    if slope <= 0:
        return NoiseModel(max(float(np.average(y, weights=weight)), _QUANTISATION_VARIANCE), 0.0)
    return NoiseModel(max(float(read), _QUANTISATION_VARIANCE), float(slope))
