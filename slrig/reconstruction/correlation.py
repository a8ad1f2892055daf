"""Noise that neighbouring pixels share.

A position is found in a weighted sum of pixels. Where their noise is independent, its variance is that of one pixel
times Σ w². A camera that interpolates colours of its mosaic, sharpens, subtracts rows or looks at lamps on mains gives
neighbours the same noise, and the sum averages less of it. How much less is read from the frames: a bit and its inverse
add up to white plus black and differ by white less black. What bits differ by in either is noise alone, summed here as
positions are. Lamps may have the same phase in a bit and its inverse, or not: their sum and difference then err by
unlike amounts. For single frames the larger counts.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, coarse_bits
from slrig.reconstruction.frames import AxisFrames, Images
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.surface_fit import stencils

_MOST_WINDOWS = 10_000  # whose mean is known to a hundredth
_LEAST_WINDOWS = 200
_CLEAR_SHARE = 0.8  # of the contrast: less is an edge of the code, where a camera that bends its values breaks the sum
_LEAST_RATIO = 1.1  # the model is no better than that; of independent noise the windows tell 0.98 to 1.08
_FEWEST_BITS = 3  # as for `noise.estimate_noise`
_MOST_COUNTED = 200_000  # whose mean is known to a hundredth


class PixelSum(NamedTuple):
    """How a position sums pixels.

    weights : (k, k) float64 with k odd. cycles_per_px : (x, y) of stripes whose phase is what the pixels tell; 0 where
    their values themselves do. Noise at that frequency is a constant error of phase. of_swings : whether the pixels are
    of a bit less its inverse, and not of single frames.
    """

    weights: FloatArray
    cycles_per_px: tuple[float, float] = (0.0, 0.0)
    of_swings: bool = False

    def turned(self) -> NDArray[np.complex128]:
        """(k, k): the weights as they apply to a frame's noise."""
        reach = len(self.weights) // 2
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        across, down = self.cycles_per_px
        return np.asarray(self.weights * np.exp(-2j * np.pi * (across * x + down * y)))


def phase_sum(frames: AxisFrames, lit: NDArray[np.bool_]) -> PixelSum:
    """As the fit to the phase of line frames sums pixels. lit : (H, W) bool.

    How close lines lie is told by lines and their inverse, or by a fine bit of the code, which change their sign every
    so many projector pixels. The finest bit may not resolve.
    """
    lines, period_px = frames.telling_lines, frames.line_patterns[0].period_px
    index = max(len(frames.bits) - 2, 0)
    changes_px = (2 << (len(frames.bits) - 1 - index)) * frames.gray.cell_px if lines is None else period_px // 2
    every = max(1, lit.size // _MOST_COUNTED)

    def above(first: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        rows = slice(first, None if first else -1, every)
        if lines is not None:
            return lines[0][0][rows] > lines[1][0][rows], lit[rows]
        if frames.inverses is not None:
            against = frames.inverses[index][rows]
        else:
            against = (frames.white[rows] + frames.black[rows]) / 2
        return frames.bits[index][rows] > against, lit[rows]

    def cycles_per_px(here: NDArray[np.bool_], there: NDArray[np.bool_], both: NDArray[np.bool_]) -> float:
        changes = int(np.count_nonzero((here != there) & both)) / max(int(np.count_nonzero(both)), 1)
        return changes * changes_px / period_px

    (here, known), (below, known_below) = above(0), above(1)
    across = cycles_per_px(here[:, 1:], here[:, :-1], known[:, 1:] & known[:, :-1])
    down = cycles_per_px(here, below, known & known_below)
    return PixelSum(stencils()[0][0, :25].reshape(5, 5).astype(np.float64), (across, down))


def edge_sum(scale_px: float) -> PixelSum:
    """As a Gaussian of this scale, which finds edges of the code, sums pixels."""
    reach = int(np.ceil(3 * scale_px))
    gaussian = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * scale_px**2))
    return PixelSum(np.outer(gaussian, gaussian), of_swings=True)


def shared_noise(frames: AxisFrames, noise: NoiseModel, where: NDArray[np.bool_], summed: PixelSum) -> float:
    """Variance of sums of pixels, over what it would be by `noise` if it were independent; 1 where it is not more.

    where : (H, W) bool, pixels to look at. Of bits and their inverses only the coarser half counts, as for
    `noise.estimate_noise`, and that away from their edges. Of single bits two that light the same window tell, or lines
    of half their period, whichever tell less, as there. Otherwise, and of few windows, nothing is told.
    """
    count, lines = coarse_bits(len(frames.bits)), frames.telling_lines
    corner = _windows(where, len(summed.weights))
    if len(corner[0]) < _LEAST_WINDOWS or len(frames.bits) < _FEWEST_BITS:
        return 1.0
    if frames.inverses is not None:
        direct = _seen_in(frames.bits[:count], corner, summed)
        inverse = _seen_in(frames.inverses[:count], corner, summed)
        contrast = _seen_in([frames.contrast], corner, summed)
        clear = np.abs(direct - inverse) > _CLEAR_SHARE * contrast
        ratio = _ratio_of_pairs(frames, noise, corner, summed, direct, inverse, clear, edges=False)
    elif frames.lines_halve:
        ratio = _ratio_of_bits(frames, noise, corner, summed, count)
        if lines is None:
            ratio = min(ratio, _ratio_of_lines(frames, noise, corner, summed))
        else:
            direct, inverse = (_seen_in(images, corner, summed) for images in lines)
            clear = np.minimum(direct, inverse) > 0
            ratio = min(ratio, _ratio_of_pairs(frames, noise, corner, summed, direct, inverse, clear, edges=True))
    else:
        return 1.0
    return ratio if ratio >= _LEAST_RATIO else 1.0


def _ratio_of_pairs(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], summed: PixelSum,
    direct: NDArray[np.float32], inverse: NDArray[np.float32], clear: NDArray[np.bool_], *, edges: bool,
) -> float:  # fmt: skip
    """The ratio by windows of images and their inverses, (images, windows, k²) each, where they are clear; 1 of few.

    edges : there are edges within the windows, at which an image differs from its inverse by more than noise.
    """
    # Where the dark one of both is cut off at zero, pixels and sums lose alike.
    clear &= np.maximum(direct, inverse) < frames.clipped_at
    kept = clear.all(axis=(0, 2))
    if np.count_nonzero(kept) < _LEAST_WINDOWS:
        return 1.0
    ends = _seen_in([noise.variance(frames.white) + noise.variance(frames.black)], corner, summed)[0, kept]
    direct, inverse = direct[:, kept], inverse[:, kept]
    swings = 1.0 if edges else _ratio(np.abs(direct - inverse), ends, summed)
    return swings if summed.of_swings else max(swings, _ratio(direct + inverse, ends, summed))


def _ratio_of_lines(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], summed: PixelSum
) -> float:
    """The ratio by lines that light half of their period: they add up to white and black."""
    lines = _seen_in(frames.lines, corner, summed)
    white, black = (_seen_in([each], corner, summed)[0] for each in (frames.white, frames.black))
    kept = ((lines.max(axis=0) < frames.clipped_at) & (lines.min(axis=0) > 0) & (white < frames.clipped_at)).all(axis=1)
    if np.count_nonzero(kept) < _LEAST_WINDOWS:
        return 1.0
    count = np.float32(len(lines))
    steady = np.stack([2 * lines[:, kept].sum(axis=0) / count, (white + black)[kept]])
    variance = noise.variance(frames.white) + noise.variance(frames.black)
    return _ratio(steady, _seen_in([variance], corner, summed)[0, kept] * (1 / count + 1 / 2), summed)


def _ratio_of_bits(
    frames: AxisFrames, noise: NoiseModel, corner: tuple[NDArray[np.intp], NDArray[np.intp]], summed: PixelSum,
    count: int,
) -> float:  # fmt: skip
    """The ratio by the windows that two coarse bits light wholly."""
    bits = _seen_in(frames.bits[:count], corner, summed)
    white, black = (_seen_in([each], corner, summed)[0] for each in (frames.white, frames.black))
    lit = ((2 * bits - white - black > _CLEAR_SHARE * (white - black)) & (bits < frames.clipped_at)).all(axis=2)
    two = np.count_nonzero(lit, axis=0) > 1
    if np.count_nonzero(two) < _LEAST_WINDOWS:
        return 1.0
    ends = np.argmax(lit, axis=0), len(lit) - 1 - np.argmax(lit[::-1], axis=0)
    steady = np.stack([bits[at[two], np.flatnonzero(two)] for at in ends])
    return _ratio(steady, _seen_in([noise.variance(frames.white)], corner, summed)[0, two], summed)


def _ratio(steady: NDArray[np.float32], variance: NDArray[np.float32], summed: PixelSum) -> float:
    """Variance of sums of pixels by what differs from bit to bit, over that of independent noise, at least 1.

    steady : (bits, windows, k²); variance : (windows, k²), of its pixels by the model.
    """
    by_noise = steady - steady.mean(axis=0)
    weights = summed.turned().ravel()
    squares = (np.abs(weights) ** 2).astype(np.float32)
    # In two real parts: of a complex product numpy makes all noise complex first, and calls threads that spin.
    parts = np.stack([weights.real, weights.imag], axis=1).astype(np.float32)
    found = 2 * np.mean((by_noise @ parts) ** 2, dtype=np.float64)
    # By the pixels of the windows themselves, and by the model: it takes a median, which pixels that a camera
    # interpolated make too small, and those that scatter more count most in a sum.
    alone = np.mean(by_noise**2 @ squares, dtype=np.float64)
    # The mean of all bits took one degree of freedom.
    told = (1 - 1 / len(steady)) * np.mean(variance @ squares, dtype=np.float64)
    return max([1.0, *(float(found / each) for each in (alone, told) if each > 0)])


def _windows(where: NDArray[np.bool_], side: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the upper left pixel of an even sample of windows that lie within `where`."""
    rows, columns = where.shape
    step = max(1, int(np.sqrt(rows * columns / _MOST_WINDOWS)))
    whole = cv2.erode(where.view(np.uint8), np.ones((side, side), dtype=np.uint8), anchor=(0, 0), borderValue=0)
    row, column = np.nonzero(whole[::step, ::step])
    return row * step, column * step


def _seen_in(
    images: Images, corner: tuple[NDArray[np.intp], NDArray[np.intp]], summed: PixelSum
) -> NDArray[np.float32]:
    """(images, windows, k²) float32: the pixels of each window."""
    sides = (len(summed.weights),) * 2
    views = (np.lib.stride_tricks.sliding_window_view(image, sides) for image in images)
    return np.array([view[corner].reshape(len(corner[0]), -1) for view in views], dtype=np.float32)
