"""What JPEG took from frames, read from their pixels.

JPEG (ITU-T T.81) rounds every coefficient of the cosine transform of 8 x 8 pixels to a multiple of a step. Most noise
goes with that, so that the scatter of frames tells less than they err by. What was rounded still lies on multiples of
the step when the frame is decoded, made grey and saved without loss; so the steps are found in the frame itself, and no
header has to travel with it. A camera that changes its tables from frame to frame, and a recording of another program,
are told alike.

A coefficient that is rounded errs by step²/12; one that is rounded to zero errs by what it was. How much that is, is
told by the share of blocks where it was not: coefficients follow a Laplace distribution (Lam and Goodman 2000, DOI
10.1109/83.869177), of which share and step fix the scale (as for the error of a decoded picture without its original:
Turaga, Chen and Caviedes 2004, DOI 10.1016/j.image.2003.09.001).

Frames that were scaled, turned by less than a right angle or cut elsewhere than at a multiple of 8 after they were
decoded show no steps.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray, Refusal, telling_bits
from slrig.reconstruction.correlation import PixelSum
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames, Images
from slrig.reconstruction.noise import NoiseModel

_SIDE = 8
_FULL_SCALE = 255  # of what JPEG is used for
_MOST_BLOCKS = 8000  # of all frames together: a share of blocks is known to half a hundredth
_LARGEST_STEP = 128  # of the first coefficients, which hold the stripes, no table in use has more
_LIMITED_RANGE = 255 / 219  # what stretching luma of 16..235 to 0..255 makes of the steps
_BIN, _BINS = 0.125, 4096  # of a coefficient's size; beyond 512 there is nothing to learn
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
    telling, lines = telling_bits(len(frames.bits)), frames.telling_lines
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
    size = (np.arange(_BINS)[:, np.newaxis] + 0.5) * _BIN
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
    at = np.minimum((size / _BIN).astype(np.intp), _BINS - 1) + _BINS * np.arange(size.shape[1])
    counts = np.bincount(at.ravel(), minlength=_BINS * size.shape[1]).reshape(-1, _BINS).astype(np.float32)
    counts[:, -1] = 0
    below = np.cumsum(counts, axis=1)
    near, all_zeros, every = below[:, _NEAR_ZERO, np.newaxis], below[:, zeros - 1], below[:, -1:]
    # A larger step than the true one finds multiples by chance among few coefficients, and others where none can be.
    possible = (every - all_zeros >= _LEAST_ROUNDED) & (all_zeros - near <= _MOST_ASTRAY * (every - near))
    clustered = np.divide(counts @ cosine, every - all_zeros, out=np.zeros_like(all_zeros), where=possible)
    best = np.argmax(clustered, axis=1)
    step = steps[best]
    centres = (np.arange(_BINS) + 0.5) * _BIN
    beyond = np.sum(counts * (centres > 1.5 * step[:, np.newaxis]), axis=1)
    different = np.sum((counts > 0) & (centres > 0.5 * step[:, np.newaxis]), axis=1)
    clear = clustered[np.arange(len(best)), best] >= _LEAST_CLUSTERED
    clear &= (beyond >= _LEAST_BEYOND) & (different >= _LEAST_DIFFERENT)
    clear[0] = False
    return np.where(clear, step, 0.0)
