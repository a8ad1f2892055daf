"""Cameras whose values bend against light, told by their own frames and made straight.

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
    full, telling, lines = frames.full_scale, telling_bits(len(frames.bits)), frames.telling_lines
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
    told = [bits[bit] for bit in telling_bits(len(bits))]
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
