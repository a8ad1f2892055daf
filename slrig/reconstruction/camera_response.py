"""Model of one camera, estimated from the frames of a scan: noise, gamma, compression loss and noise correlation.

Noise: variance(I) = read + slope · I, in camera units (photon transfer; EMVA 1288).

Correlation: a position sums pixels (`PixelSum`). Where neighbouring pixels share noise, the variance of such a sum is
larger than that of independent pixels.

Compression: JPEG rounds the coefficients of the cosine transform to steps, which the pixels still show. The variance
that is lost counts as noise of positions.

Gamma: cameras made for displays give v = full · (light/full)^(1/γ) (Rec. 709, sRGB: γ of about 2.2 as a whole). All
other steps need values proportional to light. The code determines γ: where a bit and its inverse are alike, at the
middle of an edge, each has half of the projector's light, 2 m^γ = white^γ + black^γ. The same holds for lines of half
their period and their inverses (`AxisFrames.line_pairs`), and for lines whose light adds up to the middle of white and
black. Blur by lenses keeps that relation, and sharpening is the same on both sides of an edge. A projector or cable
that blurs the signal before the projector's gamma loses light at edges, as γ < 1 would; values then stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import (
    MIN_RANGE_SIGMA,
    Axis,
    FloatArray,
    IntArray,
    NoiseModel,
    coarse_bit_count,
    diagnostic_bits,
    fit_noise,
    sine_groups,
)
from slrig.reconstruction.frames import AxisFrames, Images, sine_weights, stack_rows, subsample
from slrig.reconstruction.surface_fit import stencils

# Noise.
_MAX_SAMPLES = 200_000  # about 8000 for each bin
# Share of the brightest level that the darkest must be below; otherwise read noise is extrapolated, and too large.
_DARK_SHARE = 0.25
# Chosen. Half and double change stated errors on glossy surfaces that one exposure saturates.
_BOX = np.ones((3, 3), dtype=np.uint8)
_MIN_BITS = 3
_MIN_LIT = 0.02  # of full scale, white over black
_MIN_BIT_SWING = 0.75  # of white less black, from the middle: smaller swings are at an edge of the code
_MEDIAN_SQUARE = 0.4549  # the median of a squared normal, of its variance

# Correlation.
_MAX_WINDOWS = 10_000  # whose mean is known to a hundredth
_MIN_WINDOWS = 200
_SPACING_PX = 8  # of windows in a line: noise that pixels share reaches less far, blocks of JPEG included
_DIFFERENCES = tuple(np.array(each, np.float32) for each in ((1, -4, 6, -4, 1), (1, -2, 1), (1,)))
_MIN_SWING = 0.8  # of the contrast: less is an edge of the code, where gamma breaks the sum
_MIN_RATIO = 1.1  # accuracy of the noise model: independent noise gives ratios up to 1.08
_MAX_COUNTED = 200_000  # whose mean is known to a hundredth

# Compression.
_SIDE = 8
_FULL_SCALE = 255  # of the values that JPEG is used for
_MAX_BLOCKS = 8000  # of all frames together: a share of blocks is then known to half a hundredth
_MAX_STEP = 128  # of the first coefficients, which hold the stripes: no table in use has more
_LIMITED_RANGE = 255 / 219  # factor on the steps if luma of 16..235 is stretched to 0..255
_BIN, _QUOTIENT_BINS = 0.125, 4096  # of the magnitude of a coefficient; up to 512
_MIN_CLUSTERING = 0.4  # mean cosine of 2π c/step: about 0 without steps, 0.66 for steps of 2 with rounded pixels
_NEAR_ZERO = 11  # bin: up to 1.5, to which rounded pixels rarely change zero
_MAX_ASTRAY = 0.1  # of coefficients beyond that, share that may be less than half a step
_MIN_NONZERO = 30  # coefficients not rounded to zero
_MIN_BEYOND = 10  # of these, number of coefficients of more than one step
_MIN_DIFFERENT = 30  # different values: a drawing of few colours has few, and they may all be multiples
_ROUNDING_VARIANCE = 1 / 12  # of decoded pixels, in addition to the camera's own
_MIN_STEPS = 6  # coefficients with a step: frames without loss seem to have one at most

# Gamma.
_MIN_GAMMA = 1.2  # chosen: cameras for displays have 1.8 and more, and linear cameras give 1.00
_MAX_GAMMA = 4.0
_EDGE_SHARE = 0.5  # of the contrast, from its middle
_MAX_DIFFERENCE = 0.15  # of the contrast, between a bit and its inverse: their mean is then the middle to 2 %
_MIN_CONTRAST_LEVELS = 20.0  # of 255: white over black, so that rounding does not shift the middle
_MIN_EDGES = 500
_MAX_PIXELS = 200_000
_GAMMA_ITERATIONS = 20  # each halves the interval of γ


def estimate_noise(frames: AxisFrames) -> NoiseModel:
    """Fit the noise model to the frames of one camera.

    A bit and its inverse add up to white plus black for any code and lens, so the scatter of that sum over the bits is
    noise alone: variance = 2 · read + slope · (white + black). A projector that spreads its signal before its gamma (a
    scaler, a cable) breaks the sum at code edges, so only the coarser half of the bits counts, which has few edges.

    Without inverses, two coarse bits that both light a pixel, or both leave it dark, differ by noise and by light
    between the walls of a hollow. Such light adds up in lines of half their period and their inverses, or in all such
    lines, which a scaler breaks: the smaller of both scatters is noise.

    If all sums have one level, as on an even wall, or none is dark, the scatter between neighbouring pixels of the
    black frame (Immerkær 1996, DOI 10.1006/cviu.1996.0060) adds the noise of the dark. Without code and lines of this
    kind that scatter of white and black is all there is.
    """
    # In steps of the samples, whose rounding is the least noise.
    step = frames.sample_step
    level, variance = sample_noise(frames)
    noise = fit_noise([(level / np.float32(step), variance / np.float32(step**2))])
    return NoiseModel(noise.read_variance * step**2, noise.slope * step)


def sample_noise(
    frames: AxisFrames, where: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (n,) levels and (n,) variances of single samples, to fit the noise model to.

    where : (H, W) bool, pixels to sample; None for all.
    """
    coarse_count, lines = coarse_bit_count(len(frames.bits)), frames.line_pairs
    has_pairs = frames.inverses is not None and len(frames.bits) >= _MIN_BITS
    if len(frames.sinusoids) and not has_pairs:
        return _scatter_of_sinusoids(frames, where)
    if frames.inverses is not None and len(frames.bits) >= _MIN_BITS:
        level, variance = _scatter_of_sums(
            frames.bits[:coarse_count], frames.inverses[:coarse_count], frames.clipped_at, where
        )
    elif frames.lines_light_half and len(frames.bits) >= _MIN_BITS:
        level, variance = _scatter_of_bits(frames, coarse_count, where)
        by_lines = _scatter_of_lines(frames, where) if lines is None else _scatter_of_pairs(frames, lines, where)
        bright = float(np.median(frames.white))
        if fit_noise([by_lines]).variance_at(bright) < fit_noise([(level, variance)]).variance_at(bright):
            level, variance = by_lines
    else:
        return _scatter_between_neighbours(frames, where, frames.white, frames.black)
    if len(level) and not _determines_slope(level, variance):
        dark, dark_variance = _scatter_between_neighbours(frames, where, frames.black)
        level, variance = np.concatenate([level, dark]), np.concatenate([variance, dark_variance])
    return level, variance


def _determines_slope(level: NDArray[np.float32], variance: NDArray[np.float32]) -> bool:
    """Return True if levels differ by more than noise and some are dark, without the outermost hundredths."""
    low, high = np.quantile(level, (0.01, 0.99))
    return bool(high - low >= MIN_RANGE_SIGMA * np.sqrt(np.median(variance)) and low < _DARK_SHARE * high)


def _scatter_of_sums(
    bits: Images, inverses: Images, clipped_at: float, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples, half those of the sums."""
    step = math.ceil(math.sqrt(bits[0].size / _MAX_SAMPLES))
    direct, inverse = subsample(bits, step, step), subsample(inverses, step, step)
    sums = direct + inverse
    unclipped = (np.maximum(direct, inverse).max(axis=0) < clipped_at) & (np.minimum(direct, inverse).min(axis=0) > 0)
    if where is not None:
        unclipped &= where[::step, ::step]
    count = len(sums) - 1
    variance = sums.var(axis=0, ddof=1, dtype=np.float64)
    # The median of a bin is below the mean of a chi-square distribution (Wilson-Hilferty).
    variance = variance / (1 - 2 / (9 * count)) ** 3
    return sums.mean(axis=0)[unclipped] / 2, (variance[unclipped] / 2).astype(np.float32)


def _scatter_of_sinusoids(
    frames: AxisFrames, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: the mean of all shifts of a period is free of stripes.

    The means of two periods are alike. Those of one period scatter between neighbouring pixels, and so do white and
    black.
    """
    unclipped = np.ones(frames.white.shape, dtype=np.bool_) if where is None else where.copy()
    for image in frames.sinusoids:
        unclipped &= (image < frames.clipped_at) & (image > 0)
    means, gains = [], []
    for members in sine_groups(frames.sine_patterns):
        weights = sine_weights([frames.sine_patterns[i] for i in members])[0].astype(np.float32)
        means.append(np.sum([w * frames.sinusoids[i] for w, i in zip(weights, members, strict=True)], axis=0))
        gains.append(float(weights @ weights))
    if len(means) > 1:
        step = max(1, int(np.count_nonzero(unclipped)) // _MAX_SAMPLES)
        first, last = (each[unclipped][::step] for each in (means[0], means[-1]))
        samples = gains[0] + gains[-1]
        return (first + last) / 2, (first - last) ** 2 / np.float32(samples * _MEDIAN_SQUARE)
    alone = replace(frames, reference_repeats=1 / gains[0])
    level, variance = _scatter_between_neighbours(alone, unclipped, means[0])
    if not frames.has_reference:
        return level, variance
    ends, of_ends = _scatter_between_neighbours(frames, where, frames.white, frames.black)
    return np.concatenate([level, ends]), np.concatenate([variance, of_ends])


def _scatter_of_lines(
    frames: AxisFrames, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: lines of half their period add up to white and black times half their
    number.
    """
    step = math.ceil(math.sqrt(frames.white.size / _MAX_SAMPLES))
    lines, reference = subsample(frames.lines, step, step), (frames.white + frames.black)[::step, ::step]
    half = len(lines) / 2
    usable = (lines.max(axis=0) < frames.clipped_at) & (lines.min(axis=0) > 0)
    usable &= (frames.white[::step, ::step] < frames.clipped_at) & (frames.black[::step, ::step] > 0)
    if where is not None:
        usable &= where[::step, ::step]
    difference = (lines.sum(axis=0) - np.float32(half) * reference)[usable]
    samples = 2 * half + 2 * half**2 / frames.reference_repeats
    return reference[usable] / 2, _variances(difference, samples, frames.sample_step)


def _scatter_of_pairs(
    frames: AxisFrames, lines: tuple[Images, Images], where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: two lines and their inverses have the same sums.

    Of the lit pixels, the half furthest from edges counts.
    """
    step = math.ceil(math.sqrt(frames.white.size / _MAX_SAMPLES))
    direct, inverse = (subsample(images, step, step) for images in lines)
    contrast = frames.contrast[::step, ::step]
    usable = (np.maximum(direct, inverse).max(axis=0) < frames.clipped_at) & (
        np.minimum(direct, inverse).min(axis=0) > 0
    )
    clear = np.abs(direct - inverse).min(axis=0) / np.maximum(contrast, 1)
    lit = contrast > _MIN_LIT * frames.clipped_at
    usable &= ~lit | (clear >= (np.median(clear[lit]) if lit.any() else 0.0))
    if where is not None:
        usable &= where[::step, ::step]
    first, second = (direct + inverse)[:, usable]
    # The level is that of white and black: the means of pairs would be whole or half numbers by their difference.
    level = (frames.white + frames.black)[::step, ::step][usable] / 2
    return level, _variances(first - second, 4, frames.sample_step)


def _scatter_of_bits(
    frames: AxisFrames, coarse_count: int, where: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples: two coarse bits that light a pixel, and two that do not."""
    step = math.ceil(math.sqrt(frames.white.size / _MAX_SAMPLES))
    bits = subsample(frames.bits[:coarse_count], step, step)
    white, black = (each[::step, ::step] for each in (frames.white, frames.black))
    swing = (2 * bits - white - black) / np.maximum(white - black, 1)
    usable = (bits.max(axis=0) < frames.clipped_at) & (bits.min(axis=0) > 0)
    if where is not None:
        usable &= where[::step, ::step]
    levels, variances = [], []
    for state, level in ((swing > _MIN_BIT_SWING, white), (swing < -_MIN_BIT_SWING, black)):
        first = np.argmax(state, axis=0)
        last = coarse_count - 1 - np.argmax(state[::-1], axis=0)
        has_two = usable & (np.count_nonzero(state, axis=0) > 1)
        first_bit, last_bit = (np.take_along_axis(bits, index[None], axis=0)[0][has_two] for index in (first, last))
        levels.append(level[has_two])
        variances.append(_variances(first_bit - last_bit, 2, frames.sample_step))
    return np.concatenate(levels), np.concatenate(variances)


def _variances(difference: NDArray[np.float32], samples: float, step: float) -> NDArray[np.float32]:
    """(n,) float32: variances of single samples, for a median, from differences over this number of samples.

    step : `SampleFormat.step`.
    """
    # Whole numbers have a coarse median. Spread over their rounding interval, they have a fine one.
    spread = difference + (step * np.random.default_rng(0).uniform(-0.5, 0.5, len(difference))).astype(np.float32)
    return np.asarray((spread**2 / _MEDIAN_SQUARE - step**2 / 12) / samples, dtype=np.float32)


def _scatter_between_neighbours(
    frames: AxisFrames, where: NDArray[np.bool_] | None, *images: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    levels, variances = [], []
    for image in images:
        across = image[:, :-2] - 2 * image[:, 1:-1] + image[:, 2:]
        second_difference = across[:-2] - 2 * across[1:-1] + across[2:]
        # The mask sums to zero, so the mean of its pixels is independent of its response; the centre alone is not.
        mean = cv2.blur(image, (3, 3))[1:-1, 1:-1]
        lowest, highest = cv2.erode(image, _BOX)[1:-1, 1:-1], cv2.dilate(image, _BOX)[1:-1, 1:-1]
        unclipped = (lowest > 0) & (highest < frames.clipped_at)
        if where is not None:
            unclipped &= where[1:-1, 1:-1]
        levels.append(mean[unclipped])
        # The squared norm of the mask is 36.
        variances.append(second_difference[unclipped] ** 2 * (frames.reference_repeats / 36 / _MEDIAN_SQUARE))
    return np.concatenate(levels), np.concatenate(variances)


class PixelSum(NamedTuple):
    """Weights with which a position sums pixels.

    weights : (k, k) float64 with k odd. cycles_per_px : (x, y) frequency of the stripes if the pixels give their phase,
    0 if the values themselves count. Noise at that frequency is a constant error of phase. of_bit_differences : True if
    the pixels are differences of a bit and its inverse, False for single frames.
    """

    weights: FloatArray
    cycles_per_px: tuple[float, float] = (0.0, 0.0)
    of_bit_differences: bool = False

    def complex_weights(self) -> NDArray[np.complex128]:
        """(k, k): the weights on the noise of a frame."""
        reach = len(self.weights) // 2
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        across, down = self.cycles_per_px
        return np.asarray(self.weights * np.exp(-2j * np.pi * (across * x + down * y)))


@dataclass(frozen=True, slots=True)
class CameraResponse:
    """Noise of single samples, and how gamma, compression and correlation change it for positions.

    gamma : of the camera's own values; frames are linearised. loss_variance : extra variance of each sample by
    compression, camera units squared; it displaces stripes and edges, but turns no bit over. noise_correlation :
    factor on the variance of sums of pixels, as `noise_correlation` returns it.
    """

    noise: NoiseModel
    gamma: float = 1.0
    loss_variance: float = 0.0
    noise_correlation: float = 1.0

    @property
    def position_noise(self) -> NoiseModel:
        """Noise of positions, correlation and compression included."""
        return self.noise.scale_variance(self.noise_correlation).add_variance(self.loss_variance)

    def for_positions(
        self, frames: AxisFrames, lit: NDArray[np.bool_], images: Images, pixel_sum: PixelSum
    ) -> CameraResponse:
        """Measure loss and correlation for positions that sum pixels of `images` in this way. lit : (H, W) bool."""
        loss = frame_compression_loss(frames, lit, images) if self.noise.loss is None else self.noise.loss
        variance = 0.0
        if loss.any():
            variance = equivalent_white_variance(loss, pixel_sum)
            variance *= linearisation_gain((image[lit] for image in images), self.gamma, frames.full_scale)
        correlation = noise_correlation(frames, self.noise, lit, pixel_sum)
        return replace(self, loss_variance=variance, noise_correlation=correlation)


def phase_pixel_sum(frames: AxisFrames, lit: NDArray[np.bool_]) -> PixelSum:
    """Weights of the fit to the phase of line frames. lit : (H, W) bool.

    The spacing of lines in the image is counted in lines and their inverses, or in a fine bit of the code, which change
    sign once in a known number of projector pixels. The finest bit may not resolve.
    """
    lines, period_px = frames.line_pairs, frames.line_patterns[0].period_px
    index = max(len(frames.bits) - 2, 0)
    changes_px = (2 << (len(frames.bits) - 1 - index)) * frames.gray.cell_px if lines is None else period_px // 2
    every = max(1, lit.size // _MAX_COUNTED)

    def above(first: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        rows = slice(first, None if first else -1, every)
        if lines is not None:
            return lines[0][0][rows] > lines[1][0][rows], lit[rows]
        if frames.inverses is not None:
            reference = frames.inverses[index][rows]
        else:
            reference = (frames.white[rows] + frames.black[rows]) / 2
        return frames.bits[index][rows] > reference, lit[rows]

    def cycles_per_px(here: NDArray[np.bool_], there: NDArray[np.bool_], both: NDArray[np.bool_]) -> float:
        changes = int(np.count_nonzero((here != there) & both)) / max(int(np.count_nonzero(both)), 1)
        return changes * changes_px / period_px

    (here, known), (below, known_below) = above(0), above(1)
    across = cycles_per_px(here[:, 1:], here[:, :-1], known[:, 1:] & known[:, :-1])
    down = cycles_per_px(here, below, known & known_below)
    return PixelSum(_fit_weights(), (across, down))


def sinusoid_pixel_sum(position: NDArray[np.float32], period_px: float) -> PixelSum:
    """Weights of the fit to positions by sinusoids. position : (H, W) float32, projector px, NaN where unknown."""
    across, down = (np.abs(np.diff(position, axis=axis)) for axis in (1, 0))
    cycles = [float(np.nanmedian(each)) / period_px if np.isfinite(each).any() else 0.0 for each in (across, down)]
    return PixelSum(_fit_weights(), (cycles[0], cycles[1]))


def _fit_weights() -> FloatArray:
    """(5, 5) float64: weights of the pixels in the fit of a surface to positions."""
    return stencils()[0][0, :25].reshape(5, 5).astype(np.float64)


def edge_pixel_sum(scale_px: float) -> PixelSum:
    """Weights of a Gaussian of this scale, which finds edges of the code."""
    reach = int(np.ceil(3 * scale_px))
    gaussian = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * scale_px**2))
    return PixelSum(np.outer(gaussian, gaussian), of_bit_differences=True)


def noise_correlation(frames: AxisFrames, noise: NoiseModel, where: NDArray[np.bool_], pixel_sum: PixelSum) -> float:
    """Variance of sums of pixels over that of independent noise by `noise`; 1 if it is not larger.

    where : (H, W) bool, pixels to use. Of bits and their inverses the coarser half counts, as in `estimate_noise`, away
    from their edges: their sums, and of their differences what changes within `_SPACING_PX` pixels, since light from
    other surfaces differs from bit to bit, but smoothly. Without inverses, two bits that light the same window count,
    or lines of half their period, whichever give less. Without either, or with few windows, the result is 1.
    """
    count, lines = coarse_bit_count(len(frames.bits)), frames.line_pairs
    corner = _windows(where, *pixel_sum.weights.shape)
    if len(corner[0]) < _MIN_WINDOWS or len(frames.bits) < _MIN_BITS:
        return 1.0
    if frames.inverses is not None:
        direct = _window_pixels(frames.bits[:count], corner, pixel_sum)
        inverse = _window_pixels(frames.inverses[:count], corner, pixel_sum)
        contrast = _window_pixels([frames.contrast], corner, pixel_sum)
        clear = np.abs(direct - inverse) > _MIN_SWING * contrast
        ratio = _ratio_of_differences(frames, frames.inverses, noise, where, pixel_sum)
        if not pixel_sum.of_bit_differences:
            ratio = max(ratio, _ratio_of_sums(frames, noise, corner, pixel_sum, direct, inverse, clear))
    elif frames.lines_light_half:
        ratio = _ratio_of_bits(frames, noise, corner, pixel_sum, count)
        if lines is None:
            ratio = min(ratio, _ratio_of_lines(frames, noise, corner, pixel_sum))
        else:
            direct, inverse = (_window_pixels(images, corner, pixel_sum) for images in lines)
            clear = np.minimum(direct, inverse) > 0
            ratio = min(ratio, _ratio_of_sums(frames, noise, corner, pixel_sum, direct, inverse, clear))
    else:
        return 1.0
    return ratio if ratio >= _MIN_RATIO else 1.0


def _ratio_of_sums(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], pixel_sum: PixelSum,
    direct: NDArray[np.float32], inverse: NDArray[np.float32], clear: NDArray[np.bool_],
) -> float:  # fmt: skip
    """Ratio from sums of images and their inverses, (images, windows, k²) each, where they are clear; 1 if these are
    few.
    """
    # If the dark one of both is cut off at zero, pixels and sums lose alike.
    usable = (clear & (np.maximum(direct, inverse) < frames.clipped_at)).all(axis=(0, 2))
    if np.count_nonzero(usable) < _MIN_WINDOWS:
        return 1.0
    variance = _window_pixels([noise.variance(frames.white) + noise.variance(frames.black)], corner, pixel_sum)
    return _ratio((direct + inverse)[:, usable], variance[0, usable], pixel_sum)


def _ratio_of_differences(
    frames: AxisFrames, inverses: Images, noise: NoiseModel, where: NDArray[np.bool_], pixel_sum: PixelSum
) -> float:
    """Ratio from differences of two coarse bits and their inverses, away from edges; 1 if there are few.

    In windows in a line along the stripes, weighted by the fourth (or second) difference, light cancels that changes
    from window to window by a polynomial of third (or first) degree. Without room for these, single windows count, with
    all such light.
    """
    count = _MIN_BITS  # the same ones, however many finer bits were played
    side, along_rows = len(pixel_sum.weights), frames.axis is Axis.ROW
    variance = noise.variance(frames.white) + noise.variance(frames.black)
    for weights in _DIFFERENCES:
        long = side + _SPACING_PX * (len(weights) - 1)
        row, column = _windows(where, side, long) if along_rows else _windows(where, long, side)
        # As many pixels as of single windows.
        row, column = row[:: len(weights)], column[:: len(weights)]
        if len(row) < _MIN_WINDOWS:
            continue
        ahead = [_SPACING_PX * step for step in range(len(weights))]
        line = [(row, column + step) if along_rows else (row + step, column) for step in ahead]
        direct, inverse, (contrast, of_pixels) = (
            np.stack([_window_pixels(images, here, pixel_sum) for here in line], axis=1)
            for images in (frames.bits[:count], inverses[:count], (frames.contrast, variance))
        )
        swing = np.abs(direct - inverse)
        share = swing / np.maximum(contrast, 1)
        # Light from other surfaces changes the swing of a whole window, an edge that of a part.
        clear = share.min(axis=(1, 3)) > _MIN_SWING * share.max(axis=(1, 3))
        clear &= np.maximum(direct, inverse).max(axis=(1, 3)) < frames.clipped_at
        has_two = np.flatnonzero(np.count_nonzero(clear, axis=0) > 1)
        if len(has_two) < _MIN_WINDOWS:
            continue
        first, last = np.argmax(clear, axis=0)[has_two], count - 1 - np.argmax(clear[::-1], axis=0)[has_two]
        norm = weights / np.sqrt(np.sum(weights**2))
        steady = np.stack([np.einsum("l,nlp->np", norm, swing[bit, :, has_two]) for bit in (first, last)])
        return _ratio(steady, np.einsum("l,lnp->np", norm**2, of_pixels[:, has_two]), pixel_sum)
    return 1.0


def _ratio_of_lines(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], pixel_sum: PixelSum
) -> float:
    """Ratio from lines of half their period: they add up to white and black."""
    lines = _window_pixels(frames.lines, corner, pixel_sum)
    white, black = (_window_pixels([each], corner, pixel_sum)[0] for each in (frames.white, frames.black))
    usable = ((lines.max(axis=0) < frames.clipped_at) & (lines.min(axis=0) > 0) & (white < frames.clipped_at)).all(
        axis=1
    )
    if np.count_nonzero(usable) < _MIN_WINDOWS:
        return 1.0
    count = np.float32(len(lines))
    steady = np.stack([2 * lines[:, usable].sum(axis=0) / count, (white + black)[usable]])
    variance = noise.variance(frames.white) + noise.variance(frames.black)
    return _ratio(steady, _window_pixels([variance], corner, pixel_sum)[0, usable] * (1 / count + 1 / 2), pixel_sum)


def _ratio_of_bits(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], pixel_sum: PixelSum,
    count: int,
) -> float:  # fmt: skip
    """Ratio from windows that two coarse bits light wholly."""
    bits = _window_pixels(frames.bits[:count], corner, pixel_sum)
    white, black = (_window_pixels([each], corner, pixel_sum)[0] for each in (frames.white, frames.black))
    lit = ((2 * bits - white - black > _MIN_SWING * (white - black)) & (bits < frames.clipped_at)).all(axis=2)
    has_two = np.count_nonzero(lit, axis=0) > 1
    if np.count_nonzero(has_two) < _MIN_WINDOWS:
        return 1.0
    lit_bits = np.argmax(lit, axis=0), len(lit) - 1 - np.argmax(lit[::-1], axis=0)
    steady = np.stack([bits[index[has_two], np.flatnonzero(has_two)] for index in lit_bits])
    return _ratio(steady, _window_pixels([noise.variance(frames.white)], corner, pixel_sum)[0, has_two], pixel_sum)


def _ratio(steady: NDArray[np.float32], variance: NDArray[np.float32], pixel_sum: PixelSum) -> float:
    """Variance of sums of pixels, from differences between bits, over that of independent noise; at least 1.

    steady : (bits, windows, k²), the same light in each; variance : (windows, k²), by the noise model.
    """
    by_noise = steady - steady.mean(axis=0)
    weights = pixel_sum.complex_weights().ravel()
    squares = (np.abs(weights) ** 2).astype(np.float32)
    # In two real parts: numpy would make all noise complex first, and start threads that spin.
    parts = np.stack([weights.real, weights.imag], axis=1).astype(np.float32)
    measured = 2 * np.mean((by_noise @ parts) ** 2, dtype=np.float64)
    # By the pixels of the windows themselves, and by the model. The median in the model is too small for interpolated
    # pixels, and pixels that scatter more count most in a sum.
    by_pixels = np.mean(by_noise**2 @ squares, dtype=np.float64)
    # The mean of all bits took one degree of freedom.
    by_model = (1 - 1 / len(steady)) * np.mean(variance @ squares, dtype=np.float64)
    return max([1.0, *(float(measured / each) for each in (by_pixels, by_model) if each > 0)])


def _windows(where: NDArray[np.bool_], height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the upper left pixels of an even sample of windows within `where`."""
    rows, columns = where.shape
    step = max(1, int(np.sqrt(rows * columns / _MAX_WINDOWS)))
    whole = cv2.erode(where.view(np.uint8), np.ones((height, width), dtype=np.uint8), anchor=(0, 0), borderValue=0)
    row, column = np.nonzero(whole[::step, ::step])
    return row * step, column * step


def _window_pixels(
    images: Images, corner: tuple[NDArray[np.intp], NDArray[np.intp]], pixel_sum: PixelSum
) -> NDArray[np.float32]:
    """(images, windows, k²) float32: the pixels of each window."""
    sides = (len(pixel_sum.weights),) * 2
    views = (np.lib.stride_tricks.sliding_window_view(image, sides) for image in images)
    return np.array([view[corner].reshape(len(corner[0]), -1) for view in views], dtype=np.float32)


def compression_loss(images: Images, code: Images, where: NDArray[np.bool_], full_scale: float) -> FloatArray:
    """(8, 8) float64: variance that compression removed from each coefficient, camera units squared; zeros without
    loss.

    images : (H, W) each, whose mean loss is returned; code : (H, W) each, in which steps are searched. Line frames are
    dark between lines, and coefficients of pixels cut off at zero are not multiples of the step. where : (H, W) bool,
    pixels to use; full_scale : value of a saturated sample. The transform is orthonormal: noise of variance v in each
    pixel has variance v in each coefficient.
    """
    loss = np.zeros((_SIDE, _SIDE))
    if full_scale > _FULL_SCALE:
        return loss
    lit = np.argwhere(_blocks(where).all(axis=(2, 3))).astype(np.int32)
    step = _quantisation_steps(_coefficient_magnitudes(code, lit, full_scale)).reshape(_SIDE, _SIDE)
    if np.count_nonzero(step) < _MIN_STEPS:
        return loss
    size = _coefficient_magnitudes(images, lit, None)
    # Block means cluster for other reasons, too; tables have about the same step for them as for their neighbours.
    step[0, 0] = max(step[0, 1], step[1, 0])
    for u, v in np.ndindex(loss.shape):
        # Steps of 1 are not detected, nor those of coefficients that are mostly zero: tables rise, so the neighbour's
        # step is a lower limit.
        if step[u, v] == 0:
            step[u, v] = max(1.0, float(step[max(u - 1, 0), v]), float(step[u, max(v - 1, 0)]))
        half = step[u, v] / 2
        share = (np.count_nonzero(size[:, _SIDE * u + v] > half) + 0.5) / (len(size) + 1)
        scale = -half / np.log(share)
        zeroed = 2 * scale**2 - share * (half**2 + 2 * half * scale + 2 * scale**2)
        loss[u, v] = share * half**2 / 3 + max(zeroed, 0.0)
    return loss + _ROUNDING_VARIANCE


def equivalent_white_variance(loss: FloatArray, pixel_sum: PixelSum) -> float:
    """Variance of independent pixels that displaces a sum of pixels by as much as this loss."""
    reach = len(pixel_sum.weights) // 2
    waves = np.einsum("ua,vb->uvab", _transform(), _transform())
    response = np.zeros((_SIDE, _SIDE, _SIDE + 2 * reach, _SIDE + 2 * reach), dtype=np.complex128)
    for (row, column), weight in np.ndenumerate(pixel_sum.complex_weights()[::-1, ::-1]):
        response[:, :, row : row + _SIDE, column : column + _SIDE] += weight * waves
    power = np.sum(np.abs(response) ** 2, axis=(2, 3))
    return float(np.sum(loss * power) / np.sum(power))


def frame_compression_loss(frames: AxisFrames, lit: NDArray[np.bool_], images: Images | None = None) -> FloatArray:
    """Return `compression_loss` of these images of one camera and axis; by default of the patterns that determine
    gamma.

    lit : (H, W) bool.
    """
    bits, lines = diagnostic_bits(len(frames.bits)), frames.line_pairs
    direct = [frames.bits[bit] for bit in bits] if lines is None else lines[0]
    searched = direct + (lines[1] if lines is not None else [])
    if frames.inverses is not None:
        searched += [frames.inverses[bit] for bit in bits]
    searched = searched or list(frames.sinusoids)
    return compression_loss(direct if images is None else images, searched, lit, frames.full_scale)


@cache
def _transform() -> FloatArray:
    """(8, 8) float64: orthonormal cosine transform; row u is wave u."""
    u, x = np.mgrid[:_SIDE, :_SIDE]
    return np.asarray(np.where(u == 0, np.sqrt(1 / 8), 0.5) * np.cos(np.pi * (2 * x + 1) * u / 16))


@cache
def _candidate_steps() -> tuple[FloatArray, NDArray[np.float32], IntArray]:
    """(s,) candidate steps; (bins, s) float32, cosine at each magnitude not rounded to zero; (s,) int32, number of
    other bins.
    """
    whole = np.arange(2.0, _MAX_STEP + 1)
    steps = np.concatenate([whole, whole * _LIMITED_RANGE])
    size = (np.arange(_QUOTIENT_BINS)[:, np.newaxis] + 0.5) * _BIN
    zero = size <= steps / 2
    cosine = np.where(zero, 0, np.cos(2 * np.pi * size / steps)).astype(np.float32)
    return steps, cosine, np.sum(zero, axis=0, dtype=np.int32)


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """(rows, columns, 8, 8): blocks of an image, without the remainder at its right and lower border."""
    rows, columns = (each // _SIDE for each in image.shape)
    whole = image[: rows * _SIDE, : columns * _SIDE]
    return whole.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)


def _coefficient_magnitudes(images: Images, lit: IntArray, full_scale: float | None) -> NDArray[np.float32]:
    """(n, 64): magnitudes of the coefficients of a sample of blocks of all images.

    lit : (m, 2), row and column of the blocks to choose from. full_scale : leave out blocks clipped at 0 or full_scale;
    None to use all.
    """
    row, column = lit[:: max(1, -(-len(lit) * len(images) // _MAX_BLOCKS))].T
    sample = np.concatenate([_blocks(image)[row, column] for image in images]).reshape(-1, _SIDE * _SIDE)
    if full_scale is not None:
        sample = sample[((sample > 0) & (sample < full_scale)).all(axis=1)]
    waves = np.kron(_transform(), _transform()).astype(np.float32)
    return np.asarray(np.abs(sample.astype(np.float32, copy=False) @ waves.T))


def _quantisation_steps(size: NDArray[np.float32]) -> FloatArray:
    """(64,) float64: step of each coefficient except the mean, 0 if none is detected. size : (n, 64)."""
    steps, cosine, zeros = _candidate_steps()
    at = np.minimum((size / _BIN).astype(np.intp), _QUOTIENT_BINS - 1) + _QUOTIENT_BINS * np.arange(size.shape[1])
    counts = (
        np.bincount(at.ravel(), minlength=_QUOTIENT_BINS * size.shape[1]).reshape(-1, _QUOTIENT_BINS).astype(np.float32)
    )
    counts[:, -1] = 0
    below = np.cumsum(counts, axis=1)
    near, all_zeros, total = below[:, _NEAR_ZERO, np.newaxis], below[:, zeros - 1], below[:, -1:]
    # A larger step than the true one finds multiples by chance among few coefficients, and others where there can be
    # none.
    possible = (total - all_zeros >= _MIN_NONZERO) & (all_zeros - near <= _MAX_ASTRAY * (total - near))
    clustered = np.divide(counts @ cosine, total - all_zeros, out=np.zeros_like(all_zeros), where=possible)
    best = np.argmax(clustered, axis=1)
    step = steps[best]
    centres = (np.arange(_QUOTIENT_BINS) + 0.5) * _BIN
    beyond = np.sum(counts * (centres > 1.5 * step[:, np.newaxis]), axis=1)
    different = np.sum((counts > 0) & (centres > 0.5 * step[:, np.newaxis]), axis=1)
    clear = clustered[np.arange(len(best)), best] >= _MIN_CLUSTERING
    clear &= (beyond >= _MIN_BEYOND) & (different >= _MIN_DIFFERENT)
    clear[0] = False
    return np.where(clear, step, 0.0)


def estimate_gamma(frames: AxisFrames) -> float:
    """Estimate gamma of a camera from the edges of the code; 1 if they do not determine it, or it is close to 1."""
    if frames.exposure_ratio != 1.0:
        return 1.0
    full, bit_numbers, lines = frames.full_scale, diagnostic_bits(len(frames.bits)), frames.line_pairs
    # Some rows are enough: an edge of the code crosses most of them.
    step = max(1, frames.white.size // _MAX_PIXELS)
    if frames.inverses is not None:
        pairs = [frames.bits[bit] for bit in bit_numbers], [frames.inverses[bit] for bit in bit_numbers]
    elif lines is not None:
        pairs = lines
    elif frames.lines_light_half:
        found = _line_edge_samples(frames, step)
    else:
        return 1.0
    if frames.inverses is not None or lines is not None:
        bits, inverses = ([image[::step] for image in images] for images in pairs)
        edges = partial(_bit_edge_samples, bits, inverses, full, frames.clipped_at, lines is not None)
        found = np.concatenate(in_bands(edges, len(bits[0])), axis=1)
    *halves, bright, dark = np.maximum(found, 0).astype(np.float64) / full
    if len(bright) < _MIN_EDGES:
        return 1.0

    def is_below(gamma: float) -> bool:
        # Non-linear values have the middle too high, less so the closer `gamma` is.
        middle = 2 * np.mean([half**gamma for half in halves], axis=0)
        return bool(np.median((middle - bright**gamma - dark**gamma) / bright**gamma) > 0)

    low, high = _MIN_GAMMA, _MAX_GAMMA
    if not is_below(low):
        return 1.0
    for _ in range(_GAMMA_ITERATIONS):
        gamma = float(np.sqrt(low * high))
        if is_below(gamma):
            low = gamma
        else:
            high = gamma
    return low


def _line_edge_samples(frames: AxisFrames, step: int) -> NDArray[np.float32]:
    """(lines + 2, n): in every `step` rows, all lines at the edges of any, for lines of half their period; white and
    black as single bits show them.
    """
    lines, bits = ([image[::step] for image in images] for images in (frames.lines, frames.bits))
    selected = [bits[bit] for bit in diagnostic_bits(len(bits))]
    line_values, bit_values = stack_rows(lines), stack_rows(selected)
    white, black = bit_values.max(axis=0), bit_values.min(axis=0)
    clear = (white - black > _MIN_CONTRAST_LEVELS / 255 * frames.full_scale) & (white < frames.clipped_at)
    clear &= (np.abs(2 * line_values - white - black) < _EDGE_SHARE * (white - black)).any(axis=0)
    return np.concatenate([line_values[:, clear], [white[clear], black[clear]]])


def _bit_edge_samples(
    bits: Images, inverses: Images, full: float, clipped_at: float, apart: bool, first: int, last: int
) -> NDArray[np.float32]:
    """(3, n): at edges of the code in some rows, the mean of a bit and its inverse, white and black.

    apart : True if the pairs have their edges at different places.
    """
    direct, inverted = stack_rows(bits, slice(first, last)), stack_rows(inverses, slice(first, last))
    # In most bits a pixel is clear of edges. White frames do not serve: projectors may dim a picture that is all white.
    bright, dark = np.maximum(direct, inverted), np.minimum(direct, inverted)
    white, black = (bright.max(axis=0), dark.min(axis=0)) if apart else (_median_image(bright), _median_image(dark))
    clear = (white - black > _MIN_CONTRAST_LEVELS / 255 * full) & (white < clipped_at)
    found = []
    for bit, inverse in zip(direct, inverted, strict=True):
        is_edge = clear & (np.abs(bit - inverse) < _MAX_DIFFERENCE * (white - black))
        found.append(np.stack([(bit[is_edge] + inverse[is_edge]) / 2, white[is_edge], black[is_edge]]))
    return np.concatenate(found, axis=1)


def _median_image(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median image; `np.median` takes twice as long for few images."""
    images.sort(axis=0)
    count = len(images)
    return np.asarray((images[(count - 1) // 2] + images[count // 2]) / 2)


def linearisation_gain(light: Iterable[NDArray[Any]], gamma: float, full_scale: float) -> float:
    """Factor on the variance of an error by linearisation, on average: the mean square slope, 1 for γ = 1.

    light : linear values of one full scale, the same number of each image. Light v^γ has the slope γ v^(γ - 1) over the
    value v.
    """
    if gamma == 1:
        return 1.0
    shares = (np.maximum(each, 0) / np.float32(full_scale) for each in light)
    return float(np.mean([np.mean((gamma * s ** np.float32(1 - 1 / gamma)) ** 2, dtype=np.float64) for s in shares]))
