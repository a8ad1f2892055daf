"""Response of the camera, estimated from the frames: gamma, loss by compression, noise shared by neighbouring pixels.

Cameras made for displays give v = full · (light/full)^(1/γ) (Rec. 709, sRGB: γ of about 2.2 as a whole). All that is
done with frames takes light: stripes add up with the room's light, a pixel's light is a mean over its blur. On bent
values a stripe's first harmonic is mixed with its others, which makes waves of the surface, and a print reaches further
over its edges than a blur can.

The code tells γ: where a bit and its inverse are alike, at the middle of an edge, each has half of the projector's
light, 2 m^γ = white^γ + black^γ. So do lines of half their period and their inverses (`AxisFrames.telling_lines`); and
where there are none of these, lines whose light adds up to the middle of white and black. A lens and a projector that
is out of focus blur light, and keep that; sharpening is the same on both sides of an edge. A projector or cable that
blurs the signal, before the projector's own gamma, loses light at edges, which looks like γ < 1, and nothing is made
straight then.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import FloatArray, IntArray, Refusal, coarse_bit_count, diagnostic_bits
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, lit_pixels
from slrig.reconstruction.frames import AxisFrames, FrameStacks, Images, rows_of
from slrig.reconstruction.noise import NoiseModel, estimate_noise
from slrig.reconstruction.surface_fit import stencils

_MOST_WINDOWS = 10_000  # whose mean is known to a hundredth
_LEAST_WINDOWS = 200
_CLEAR_SHARE = 0.8  # of the contrast: less is an edge of the code, where a camera that bends its values breaks the sum
_LEAST_RATIO = 1.1  # the model is no better than that; of independent noise the windows tell 0.98 to 1.08
_FEWEST_DEVIATING_BITS = 3  # as for `noise.estimate_noise`
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
    count, lines = coarse_bit_count(len(frames.bits)), frames.telling_lines
    corner = _windows(where, len(summed.weights))
    if len(corner[0]) < _LEAST_WINDOWS or len(frames.bits) < _FEWEST_DEVIATING_BITS:
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


_SIDE = 8
_FULL_SCALE = 255  # of what JPEG is used for
_MOST_BLOCKS = 8000  # of all frames together: a share of blocks is known to half a hundredth
_LARGEST_STEP = 128  # of the first coefficients, which hold the stripes, no table in use has more
_LIMITED_RANGE = 255 / 219  # what stretching luma of 16..235 to 0..255 makes of the steps
_BIN, _QUOTIENT_BINS = 0.125, 4096  # of a coefficient's size; beyond 512 there is nothing to learn
_LEAST_CLUSTERED = 0.4  # mean cosine of 2π c/step. Rounding of pixels leaves 0.66 of steps of 2; smooth is about 0
_NEAR_ZERO = 11  # bin: up to 1.5, which rounding of pixels seldom makes of zero
_MOST_ASTRAY = 0.1  # of coefficients beyond that, may be less than half a step
_LEAST_ROUNDED = 30  # coefficients that were not rounded to zero
_LEAST_BEYOND = 10  # of which these many not to one step
_LEAST_DIFFERENT = 30  # different values: a drawn picture of few colours has few, and they may all be multiples
_ROUNDING_VARIANCE = 1 / 12  # of decoded pixels, once more after the camera's own
_LEAST_STEPS = 6  # coefficients with a step; of frames without loss one at most seems to have one


def compression_loss(images: Images, code: Images, where: NDArray[np.bool_], full_scale: float) -> FloatArray:
    """(8, 8) float64: variance that compression left out of each coefficient, camera units squared; zeros for none.

    images : (H, W) each, whose loss is asked for, on average; code : (H, W) each, where the steps are looked for:
    between lines it is dark, and coefficients of pixels that are cut off at zero are no multiples. where : (H, W) bool,
    pixels to look at; full_scale : the value of a saturated sample. The transform keeps lengths: noise of variance v
    in each pixel has v in each coefficient.
    """
    loss = np.zeros((_SIDE, _SIDE))
    if full_scale > _FULL_SCALE:
        return loss
    lit = np.argwhere(_tiles(where).all(axis=(2, 3))).astype(np.int32)
    step = _found_steps(_sizes(code, lit, full_scale)).reshape(_SIDE, _SIDE)
    if np.count_nonzero(step) < _LEAST_STEPS:
        return loss
    size = _sizes(images, lit, None)
    # Means of blocks lie anywhere, and cluster for other reasons, too; tables hold much the same for them.
    step[0, 0] = max(step[0, 1], step[1, 0])
    for u, v in np.ndindex(loss.shape):
        # Steps of 1 do not show, nor that of a coefficient which is hardly ever anything but zero: tables rise.
        if step[u, v] == 0:
            step[u, v] = max(1.0, float(step[max(u - 1, 0), v]), float(step[u, max(v - 1, 0)]))
        half = step[u, v] / 2
        share = (np.count_nonzero(size[:, _SIDE * u + v] > half) + 0.5) / (len(size) + 1)
        scale = -half / np.log(share)
        zeroed = 2 * scale**2 - share * (half**2 + 2 * half * scale + 2 * scale**2)
        loss[u, v] = share * half**2 / 3 + max(zeroed, 0.0)
    return loss + _ROUNDING_VARIANCE


def white_equivalent(loss: FloatArray, summed: PixelSum) -> float:
    """Variance of independent pixels that errs a sum of pixels by as much as this loss does."""
    reach = len(summed.weights) // 2
    waves = np.einsum("ua,vb->uvab", _transform(), _transform())
    heard = np.zeros((_SIDE, _SIDE, _SIDE + 2 * reach, _SIDE + 2 * reach), dtype=np.complex128)
    for (row, column), weight in np.ndenumerate(summed.turned()[::-1, ::-1]):
        heard[:, :, row : row + _SIDE, column : column + _SIDE] += weight * waves
    power = np.sum(np.abs(heard) ** 2, axis=(2, 3))
    return float(np.sum(loss * power) / np.sum(power))


def loss_variance(frames: AxisFrames, noise: NoiseModel, code: CodeMap, images: Images, summed: PixelSum) -> float:
    """What compression adds to the variance of each sample of these images, as positions sum them; 0 for none."""
    loss = noise.loss
    if loss is None:
        loss = frames_loss(frames, code.refusal != Refusal.NOT_LIT, images)
    return white_equivalent(loss, summed) if loss.any() else 0.0


def frames_loss(frames: AxisFrames, lit: NDArray[np.bool_], images: Images | None = None) -> FloatArray:
    """`compression_loss` of these images, of one camera and axis; by default of those that tell what the camera makes
    of light. lit : (H, W) bool.
    """
    telling, lines = diagnostic_bits(len(frames.bits)), frames.telling_lines
    direct = [frames.bits[bit] for bit in telling] if lines is None else lines[0]
    told_by = direct + (lines[1] if lines is not None else [])
    if frames.inverses is not None:
        told_by += [frames.inverses[bit] for bit in telling]
    return compression_loss(direct if images is None else images, told_by, lit, frames.full_scale)


@cache
def _transform() -> FloatArray:
    """(8, 8) float64: the cosine transform, orthonormal; row u is wave u."""
    u, x = np.mgrid[:_SIDE, :_SIDE]
    return np.asarray(np.where(u == 0, np.sqrt(1 / 8), 0.5) * np.cos(np.pi * (2 * x + 1) * u / 16))


@cache
def _steps() -> tuple[FloatArray, NDArray[np.float32], IntArray]:
    """(s,) steps that are tried; (bins, s) float32, the cosine at each size of coefficient that does not round to zero;
    (s,) int32, how many bins do.
    """
    whole = np.arange(2.0, _LARGEST_STEP + 1)
    steps = np.concatenate([whole, whole * _LIMITED_RANGE])
    size = (np.arange(_QUOTIENT_BINS)[:, np.newaxis] + 0.5) * _BIN
    zero = size <= steps / 2
    cosine = np.where(zero, 0, np.cos(2 * np.pi * size / steps)).astype(np.float32)
    return steps, cosine, np.sum(zero, axis=0, dtype=np.int32)


def _tiles(image: NDArray[Any]) -> NDArray[Any]:
    """(rows, columns, 8, 8): the blocks of an image, without what is left at its right and lower border."""
    rows, columns = (each // _SIDE for each in image.shape)
    whole = image[: rows * _SIDE, : columns * _SIDE]
    return whole.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)


def _sizes(images: Images, lit: IntArray, full_scale: float | None) -> NDArray[np.float32]:
    """(n, 64): sizes of the coefficients of a sample of blocks of all images; not of those that are clipped between 0
    and full_scale, if that is given. lit : (m, 2), row and column of the blocks to choose from.
    """
    row, column = lit[:: max(1, -(-len(lit) * len(images) // _MOST_BLOCKS))].T
    sample = np.concatenate([_tiles(image)[row, column] for image in images]).reshape(-1, _SIDE * _SIDE)
    if full_scale is not None:
        sample = sample[((sample > 0) & (sample < full_scale)).all(axis=1)]
    waves = np.kron(_transform(), _transform()).astype(np.float32)
    return np.asarray(np.abs(sample.astype(np.float32, copy=False) @ waves.T))


def _found_steps(size: NDArray[np.float32]) -> FloatArray:
    """(64,) float64: the step of each coefficient but the mean, 0 where none shows. size : (n, 64)."""
    steps, cosine, zeros = _steps()
    at = np.minimum((size / _BIN).astype(np.intp), _QUOTIENT_BINS - 1) + _QUOTIENT_BINS * np.arange(size.shape[1])
    counts = (
        np.bincount(at.ravel(), minlength=_QUOTIENT_BINS * size.shape[1]).reshape(-1, _QUOTIENT_BINS).astype(np.float32)
    )
    counts[:, -1] = 0
    below = np.cumsum(counts, axis=1)
    near, all_zeros, every = below[:, _NEAR_ZERO, np.newaxis], below[:, zeros - 1], below[:, -1:]
    # A larger step than the true one finds multiples by chance among few coefficients, and others where none can be.
    possible = (every - all_zeros >= _LEAST_ROUNDED) & (all_zeros - near <= _MOST_ASTRAY * (every - near))
    clustered = np.divide(counts @ cosine, every - all_zeros, out=np.zeros_like(all_zeros), where=possible)
    best = np.argmax(clustered, axis=1)
    step = steps[best]
    centres = (np.arange(_QUOTIENT_BINS) + 0.5) * _BIN
    beyond = np.sum(counts * (centres > 1.5 * step[:, np.newaxis]), axis=1)
    different = np.sum((counts > 0) & (centres > 0.5 * step[:, np.newaxis]), axis=1)
    clear = clustered[np.arange(len(best)), best] >= _LEAST_CLUSTERED
    clear &= (beyond >= _LEAST_BEYOND) & (different >= _LEAST_DIFFERENT)
    clear[0] = False
    return np.where(clear, step, 0.0)


_LEAST = 1.2  # chosen: cameras bend by 1.8 and more if at all, and edges of eight scenes by straight ones told 1.00
_MOST = 4.0
_AT_EDGE = 0.5  # of the contrast, from its middle
_ALIKE = 0.15  # of the contrast, between a bit and its inverse: their mean is then the middle to 2 %
_CLEAR_LEVELS = 20.0  # of 255: of white over black, so that rounding tells nothing of the middle
_LEAST_EDGES = 500
_MOST_PIXELS = 200_000
_TURNS = 20  # each halves what γ may be


def found_gamma(frames: AxisFrames) -> float:
    """How a camera bends light into values, by the edges of the code; 1 where that is not told, or next to nothing."""
    if frames.exposure_ratio != 1.0:
        return 1.0
    full, telling, lines = frames.full_scale, diagnostic_bits(len(frames.bits)), frames.telling_lines
    # Rows enough: an edge of the code crosses most of them.
    step = max(1, frames.white.size // _MOST_PIXELS)
    if frames.inverses is not None:
        pairs = [frames.bits[bit] for bit in telling], [frames.inverses[bit] for bit in telling]
    elif lines is not None:
        pairs = lines
    elif frames.lines_halve:
        found = _sums(frames, step)
    else:
        return 1.0
    if frames.inverses is not None or lines is not None:
        bits, inverses = ([image[::step] for image in images] for images in pairs)
        edges = partial(_edges, bits, inverses, full, frames.clipped_at, lines is not None)
        found = np.concatenate(in_bands(edges, len(bits[0])), axis=1)
    *halves, bright, dark = np.maximum(found, 0).astype(np.float64) / full
    if len(bright) < _LEAST_EDGES:
        return 1.0

    def bends_more(gamma: float) -> bool:
        # Bent values have the middle too high, and the more so the less is made of γ.
        middle = 2 * np.mean([half**gamma for half in halves], axis=0)
        return bool(np.median((middle - bright**gamma - dark**gamma) / bright**gamma) > 0)

    low, high = _LEAST, _MOST
    if not bends_more(low):
        return 1.0
    for _ in range(_TURNS):
        gamma = float(np.sqrt(low * high))
        if bends_more(gamma):
            low = gamma
        else:
            high = gamma
    return low


def _sums(frames: AxisFrames, step: int) -> NDArray[np.float32]:
    """(lines + 2, n): where one of the lines that light half of their period has an edge, in every so many rows, all of
    them, and white and black as single bits show them.
    """
    lines, bits = ([image[::step] for image in images] for images in (frames.lines, frames.bits))
    told = [bits[bit] for bit in diagnostic_bits(len(bits))]
    shown, seen = rows_of(lines), rows_of(told)
    white, black = seen.max(axis=0), seen.min(axis=0)
    clear = (white - black > _CLEAR_LEVELS / 255 * frames.full_scale) & (white < frames.clipped_at)
    clear &= (np.abs(2 * shown - white - black) < _AT_EDGE * (white - black)).any(axis=0)
    return np.concatenate([shown[:, clear], [white[clear], black[clear]]])


def _edges(
    bits: Images, inverses: Images, full: float, clipped_at: float, apart: bool, first: int, last: int
) -> NDArray[np.float32]:
    """(3, n): at edges of the code in some rows, the mean of a bit and its inverse, white and black.

    apart : where one pair has its edges, another has none.
    """
    direct, inverted = rows_of(bits, slice(first, last)), rows_of(inverses, slice(first, last))
    # At most bits a pixel is clear of edges. White does not tell: projectors may dim a picture that is all white.
    bright, dark = np.maximum(direct, inverted), np.minimum(direct, inverted)
    white, black = (bright.max(axis=0), dark.min(axis=0)) if apart else (_middle(bright), _middle(dark))
    clear = (white - black > _CLEAR_LEVELS / 255 * full) & (white < clipped_at)
    found = []
    for bit, inverse in zip(direct, inverted, strict=True):
        alike = clear & (np.abs(bit - inverse) < _ALIKE * (white - black))
        found.append(np.stack([(bit[alike] + inverse[alike]) / 2, white[alike], black[alike]]))
    return np.concatenate(found, axis=1)


def _middle(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median image; `np.median` takes twice as long for few images."""
    images.sort(axis=0)
    count = len(images)
    return np.asarray((images[(count - 1) // 2] + images[count // 2]) / 2)


def in_light(stacks: FrameStacks, limits: DecodingLimits) -> tuple[AxisFrames, NoiseModel, float]:
    """The frames so far in proportion to light, their noise, and how the camera had bent them; `stacks` goes on so.

    The noise has the loss of the camera's own values, of which `gain` makes one of light.
    """
    frames = stacks.frames()
    noise, gamma = estimate_noise(frames), found_gamma(frames)
    if gamma == 1:
        return frames, noise, gamma
    # What compression took is seen in its own values only.
    loss = frames_loss(frames, lit_pixels(frames, noise, limits))
    stacks.straighten(gamma)
    frames = stacks.frames()
    return frames, replace(estimate_noise(frames), loss=loss), gamma


def gain(light: Iterable[NDArray[Any]], gamma: float, full_scale: float) -> float:
    """By what an error's variance grew on average where values were made straight: the mean square slope, 1 for γ = 1.

    light : straight values of one full scale, as many of each image. Light v^γ has the slope γ v^(γ - 1) over the
    value v.
    """
    if gamma == 1:
        return 1.0
    shares = (np.maximum(each, 0) / np.float32(full_scale) for each in light)
    return float(np.mean([np.mean((gamma * s ** np.float32(1 - 1 / gamma)) ** 2, dtype=np.float64) for s in shares]))
