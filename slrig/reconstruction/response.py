"""Cameras whose values bend against light, told by their own frames and made straight.

Cameras made for displays give v = full · (light/full)^(1/γ) (Rec. 709, sRGB: γ of about 2.2 as a whole). All that is
done with frames takes light: stripes add up with the room's light, a pixel's light is a mean over its blur. On bent
values a stripe's first harmonic is mixed with its others, which makes waves of the surface, and a print reaches further
over its edges than a blur can.

The code tells γ: where a bit and its inverse are alike, at the middle of an edge, each has half of the projector's
light, 2 m^γ = white^γ + black^γ. A lens and a projector that is out of focus blur light, and keep that; sharpening is
the same on both sides of an edge. A projector or cable that blurs the signal, before the projector's own gamma, loses
light at edges, which looks like γ < 1, and nothing is made straight then.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import telling_bits
from slrig.reconstruction.compression import frames_loss
from slrig.reconstruction.decoding import DecodingLimits, lit_pixels
from slrig.reconstruction.frames import AxisFrames, FrameStacks, Images, rows_of
from slrig.reconstruction.noise import NoiseModel, estimate_noise

_LEAST = 1.2  # chosen: cameras bend by 1.8 and more if at all, and edges of eight scenes by straight ones told 1.00
_MOST = 4.0
_ALIKE = 0.15  # of the contrast, between a bit and its inverse: their mean is then the middle to 2 %
_CLEAR_LEVELS = 20.0  # of 255: of white over black, so that rounding tells nothing of the middle
_LEAST_EDGES = 500
_MOST_PIXELS = 200_000
_TURNS = 20  # each halves what γ may be


def found_gamma(frames: AxisFrames) -> float:
    """How a camera bends light into values, by the edges of the code; 1 where that is not told, or next to nothing."""
    if frames.inverses is None or frames.exposure_ratio != 1.0:
        return 1.0
    full = frames.full_scale
    # Rows enough: an edge of the code crosses most of them.
    step = max(1, frames.white.size // _MOST_PIXELS)
    telling = telling_bits(len(frames.bits))
    bits, inverses = ([images[bit][::step] for bit in telling] for images in (frames.bits, frames.inverses))
    found = in_bands(partial(_edges, bits, inverses, full, frames.clipped_at), len(bits[0]))
    middle, bright, dark = np.maximum(np.concatenate(found, axis=1), 0).astype(np.float64) / full
    if len(middle) < _LEAST_EDGES:
        return 1.0

    def bends_more(gamma: float) -> bool:
        # Bent values have the middle too high, and the more so the less is made of γ.
        return bool(np.median((2 * middle**gamma - bright**gamma - dark**gamma) / bright**gamma) > 0)

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


def _edges(
    bits: Images, inverses: Images, full: float, clipped_at: float, first: int, last: int
) -> NDArray[np.float32]:
    """(3, n): at edges of the code in some rows, the mean of a bit and its inverse, white and black."""
    direct, inverted = rows_of(bits, slice(first, last)), rows_of(inverses, slice(first, last))
    # At most bits a pixel is clear of edges. White does not tell: projectors may dim a picture that is all white.
    white, black = (_middle(each(direct, inverted)) for each in (np.maximum, np.minimum))
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
