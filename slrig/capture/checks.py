"""What a set of sampled pixels says about a frame: pure functions on vectors, each naming a contradiction or None.

All vectors hold the same n sampled pixels of one camera: (n,) float32, in digital numbers (DN). `u` is a frame on the
scale on which the black frame is 0 and the white frame is 1. Only `Reference.judged` pixels are asked: lit, not
saturated, and of these the brighter half, so that noise does not speak.

What they name becomes a `Contradiction` between frames of one camera, with words for their patterns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import Black, Gray, LineShift, Pattern, Primary, White

Samples = NDArray[np.float32]
Chosen = NDArray[np.bool_]

BANDS = 12
"""Frames are judged as a whole and in this many horizontal bands: a transfer that broke off spoils rows."""

NOISE_FLOOR_DN = 0.3
"""Standard deviation of rounding to whole numbers, 1/√12: no camera is less noisy."""

BAND_SAMPLES = 300
"""A band of fewer samples is not judged by itself."""

_LIT_SAMPLES = 40

NEARLY_FULL = 0.97  # of full scale: some sensors saturate a little below it, and not everywhere alike

_ALIKE = 0.02
"""Of a frame's own variation: lines that are blurred to three times their width differ by more from step to step."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Frames of one camera that cannot all show what they should.

    where : camera and pattern, in words, whose frame brought it to light. cause : what is wrong and what to do.
    suspects : the patterns whose frames it speaks against. beyond : those that are to blame if it stays when the
    suspects were shot again: what the test rests on, as far as no other frame has vouched for it.
    """

    camera: str
    where: str
    cause: str
    suspects: tuple[int, ...]
    beyond: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.where}: {self.cause}"


def named(index: int, pattern: Pattern) -> str:
    """Words for a pattern of a sequence.

    >>> from slrig.model import Axis
    >>> named(7, Gray(Axis.COLUMN, 2, 9, inverted=True))
    'pattern 7 (column Gray bit 2 of 9, inverse)'
    """
    words: str
    match pattern:
        case White() | Black():
            words = pattern.kind
        case Primary():
            words = pattern.words
        case Gray():
            words = f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverted else ''}"
        case LineShift():
            words = f"{pattern.axis} lines, shift {pattern.shift} of {pattern.period_px}"
    return f"pattern {index} ({words})"


def place(camera: str, index: int, pattern: Pattern) -> str:
    """Words for a camera's frame of a pattern."""
    return f"camera '{camera}', {named(index, pattern)}"


@dataclass(frozen=True, slots=True)
class Lighting:
    """What white and black say at pixels drawn from the whole image.

    lit : share of the image that the projector lights. threshold_dn : white − black of a lit pixel, at least.
    """

    lit: float
    threshold_dn: float


@dataclass(frozen=True, slots=True)
class Reference:
    """One camera's opening white and black frames at the sampled pixels.

    contrast : white − black, at least 1. lit, judged : which pixels the projector reaches, and which are asked.
    row, band : (n,) where the pixel lies, and in which band of equally many samples.
    """

    white: Samples
    black: Samples
    contrast: Samples
    lit: Chosen
    judged: Chosen
    row: NDArray[np.intp]
    band: NDArray[np.intp]

    def relative(self, frame: Samples) -> Samples:
        """Return u = (frame − black)/(white − black) at the judged pixels."""
        return np.asarray((frame - self.black)[self.judged] / self.contrast[self.judged])


def lighting(white: Samples, black: Samples, *, full_scale: int, row: NDArray[np.intp]) -> Lighting | str:
    """Compare white with black: what the projector lights, or what is wrong and what to do about it."""
    contrast = white - black
    high, low = float(np.percentile(contrast, 99.5)), -float(np.percentile(contrast, 0.5))
    # Where the projector does not reach, contrast is noise about zero: its lower tail tells how much.
    noise = max(0.0, -float(np.percentile(contrast, 2.0)) / 2.05)
    saturated_black = float(np.mean(black >= full_scale))
    levels = f"white mean {white.mean():.1f}, black mean {black.mean():.1f}, full scale {full_scale}"
    if saturated_black > 0.5:
        return (
            f"the black frame is saturated on {saturated_black:.0%} of the image ({levels}): shorten the exposure, "
            "lower the gain, or shade the room's light"
        )
    if low > 3 * max(high, 1.0):
        return (
            f"white is darker than black ({levels}): the projector shows its patterns inverted, or later than it "
            "says; set its input to normal polarity, check its latency, and scan again"
        )
    darker = _darker(contrast, high, row)
    if darker is not None:
        return (
            f"white is darker than black on {darker}: one of the two frames was damaged in transfer, or the room's "
            "light changed; check the cable and the light, and scan again"
        )
    threshold = max(2.0, 0.1 * high, 4 * noise)
    lit = contrast >= threshold
    if np.count_nonzero(lit) < _LIT_SAMPLES:
        if white.max() <= max(3.0, 0.02 * full_scale):
            remedy = "both are dark: is the lamp off, the lens cap on, or the exposure far too short?"
        else:
            remedy = (
                "the camera sees other light, and not the projector's: is the lamp off, does the camera look at what "
                "the projector lights, is the exposure long enough?"
            )
        return f"white is not brighter than black on {1 - np.mean(lit):.1%} of the image ({levels}): {remedy}"
    saturated = float(np.mean(white[lit] >= full_scale))
    if saturated > 0.9:
        return (
            f"the white frame is saturated on {saturated:.0%} of what the projector lights ({levels}): shorten the "
            "exposure or lower the gain"
        )
    return Lighting(float(np.mean(lit)), threshold)


def reference(
    white: Samples, black: Samples, *, threshold_dn: float, full_scale: int, row: NDArray[np.intp]
) -> Reference:
    """Choose which of the sampled pixels are asked. At least one must be lit and not saturated."""
    contrast = white - black
    lit = contrast >= threshold_dn
    usable = lit & (white < full_scale)
    # Noise makes of a clipped sample one that is nearly full, and of half of its light more than half of it is seen.
    clear = usable & (white < NEARLY_FULL * full_scale)
    if np.count_nonzero(clear) >= BAND_SAMPLES * BANDS:
        usable = clear
    judged = usable & (contrast >= np.median(contrast[usable]))
    return Reference(white, black, np.maximum(contrast, np.float32(1)), lit, judged, row, _bands(row))


def _bands(row: NDArray[np.intp]) -> NDArray[np.intp]:
    """Bands of equally many samples."""
    return np.searchsorted(np.quantile(row, np.arange(1, BANDS) / BANDS), row, side="right")


def _darker(contrast: Samples, high: float, row: NDArray[np.intp]) -> str | None:
    """Words for a band in which white − black is far below zero, which no light can do."""
    band = _bands(row)
    # Noise by the middle band: damage is not everywhere.
    lower = [float(np.percentile(contrast[band == b], 2.0)) for b in range(BANDS) if (band == b).any()]
    noise = max(0.0, -float(np.median(lower)) / 2.05)
    wrong = contrast < -max(3.0, 0.25 * high, 6 * noise)
    return _worst(wrong, band, row, whole=0.05, quarter=0.1, of="pixels")


def noise_dn(bit: Samples, inverse: Samples, ref: Reference, *, sums: Sequence[Samples] = ()) -> float:
    """Noise of one frame, DN: bit + inverse − white − black is the noise of four.

    sums : of other pairs. The least that a difference from one of them tells counts, too: if white or black was
    damaged, the difference from these is that damage, and noise so large would hide all else.
    """
    pair = bit + inverse
    return min(_noise_of_four((pair - other)[ref.judged]) for other in (ref.white + ref.black, *sums))


def noise_of_bit(bit: Samples, ref: Reference) -> float:
    """Noise of one frame, DN, by a bit that lights few edges: where it is lit it shows what white does, else black."""
    above, below = bit - ref.white, bit - ref.black
    nearer = np.where(np.abs(above) < np.abs(below), above, below)[ref.judged]
    # Of two frames; the square root of two less than what four would tell.
    return max(NOISE_FLOOR_DN, _noise_of_four(nearer) * math.sqrt(2))


def _noise_of_four(rest: Samples) -> float:
    # Whole numbers have a coarse median; spread over the interval that each stands for, they have a fine one.
    rest = rest + np.linspace(-0.5, 0.5, len(rest), dtype=np.float32)
    spread = 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
    return max(NOISE_FLOOR_DN, math.sqrt(max(spread**2 - 1 / 12, 0.0)) / 2)


def range_fault(frame: Samples, ref: Reference, *, noise: float | None) -> str | None:
    """No pattern is darker than black or brighter than white: a frame that is was damaged on its way.

    Without a known noise, more is let pass.
    """
    u = ref.relative(frame)
    slack = np.maximum(0.3, 6 * noise / ref.contrast[ref.judged]) if noise is not None else np.float32(0.6)
    outside = (u < -slack) | (u > 1 + slack)
    worst = worst_judged(outside, ref, whole=0.05)
    if worst is None:
        return None
    return (
        f"{worst} lie outside the range between the black and the white frame: the frame was damaged in transfer, the "
        f"room's light changed, the projector's light comes later than it says, or {contrast_words(ref)}; check the "
        "cable, the light and the projector's latency, and scan again"
    )


def dimmed(frame: Samples, ref: Reference) -> bool:
    """Whether a frame is neither as dark as black nor as bright as white, all in all."""
    u = ref.relative(frame)
    return bool(0.005 < np.average(u, weights=ref.contrast[ref.judged]) < 0.985)


def variation(frame: Samples, ref: Reference) -> float:
    """Mean square, DN², of what is left of a frame after its best fit by black + share · (white − black)."""
    contrast, seen = ref.contrast[ref.judged], (frame - ref.black)[ref.judged]
    share = float(np.dot(contrast, seen) / np.dot(contrast, contrast))
    return float(np.mean((seen - share * contrast) ** 2))


def repeated(frame: Samples, earlier: Sequence[Samples], ref: Reference, *, noise: float, factor: float) -> int | None:
    """Index of an earlier frame from which this one differs by noise only.

    A frame may rightly equal another where the visible part of the pattern is constant: only one whose own variation
    is `factor` times the noise can be a repetition.
    """
    if not earlier or variation(frame, ref) < factor * noise**2:
        return None
    here = frame[ref.judged]
    distance = [float(np.mean((here - other[ref.judged]) ** 2)) for other in earlier]
    nearest = int(np.argmin(distance))
    # The noise is that of bright pixels. A camera whose values are made for displays has several times as much in dark.
    alike = max(6 * noise**2, _ALIKE * variation(frame, ref))
    return nearest if distance[nearest] < alike else None


@dataclass(frozen=True, slots=True)
class Drift:
    """How a pattern's second frame differs from its first.

    light : median of the difference over the white contrast; light_limit : how large it may be.
    moved : share of pixels that changed by much more.
    """

    light: float
    light_limit: float
    moved: float


def drift(first: Samples, again: Samples, ref: Reference, *, noise: float | None) -> Drift:
    """Compare two frames of one pattern. Without a known noise, that of their difference is taken."""
    contrast, change = ref.contrast[ref.judged], (again - first)[ref.judged]
    light = float(np.median(change / contrast))
    rest = np.abs(change - light * contrast)
    if noise is None:
        noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(rest)) / 2**0.5)
    moved = float(np.mean(rest > np.maximum(0.3 * contrast, 8 * noise)))
    # In the dark, the brighter half of the pixels are those that noise made bright: they come back darker.
    return Drift(light, 0.1 + 1.5 * noise / float(np.median(contrast)), moved)


def drift_fault(seen: Drift) -> str | None:
    """Refuse light that changed by more than 10 % of white, and more than 5 % of pixels that changed otherwise."""
    if seen.moved > 0.05:
        return (
            f"{seen.moved:.0%} of the pixels changed since this pattern was first shown: the object, the projector or "
            "a camera moved; hold them still, and scan again"
        )
    if abs(seen.light) > seen.light_limit:
        return (
            f"the light changed by {seen.light:+.0%} of white since this pattern was first shown: let the lamp warm "
            "up, switch off automatic exposure and dynamic contrast, keep the room's light steady, and scan again"
        )
    return None


def changed_fault(
    first: Samples,
    again: Samples,
    brighter: tuple[Samples, Samples],
    *,
    threshold_dn: float,
    noise: float | None,
    row: NDArray[np.intp],
) -> str | None:
    """Compare two white or two black frames wherever either of them says that the projector lights.

    The pixels that all other tests ask were chosen by the first two frames, and damage may have chosen them.

    brighter : white − black, with the first and with the second of the two frames, at pixels of the whole image.
    """
    contrast = np.maximum(*brighter)
    lit = contrast >= threshold_dn
    if np.count_nonzero(lit) < BAND_SAMPLES:
        return None
    change = np.abs(again - first)[lit]
    if noise is None:
        noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(change)) / 2**0.5)
    wrong = change > np.maximum(0.3 * contrast[lit], 8 * noise)
    where = _worst(wrong, _bands(row[lit]), row[lit], whole=0.05, quarter=0.15)
    if where is None:
        return None
    return (
        f"{where} changed since this pattern was first shown: the object, the projector or a camera moved, or one of "
        "the two frames was damaged or shows another pattern; hold them still, check the cable, and scan again"
    )


def worst_judged(wrong: Chosen, ref: Reference, *, whole: float, quarter: float = 0.25) -> str | None:
    """Words for the share of judged pixels that are wrong: None below `whole` of all and below `quarter` of a band."""
    return _worst(wrong, ref.band[ref.judged], ref.row[ref.judged], whole=whole, quarter=quarter)


def worst_of(wrong: Chosen, row: NDArray[np.intp], *, whole: float, quarter: float = 0.25) -> str | None:
    """As `worst_judged`, of any lit pixels in these rows."""
    return _worst(wrong, _bands(row), row, whole=whole, quarter=quarter)


def _worst(
    wrong: Chosen,
    band: NDArray[np.intp],
    row: NDArray[np.intp],
    *,
    whole: float,
    quarter: float = 0.25,
    of: str = "lit pixels",
) -> str | None:
    """Words for the share of wrong pixels: None below `whole` of the image and below `quarter` of every band."""
    total = float(np.mean(wrong))
    if total > whole:
        return f"{total:.0%} of the {of}"
    counts = np.bincount(band, minlength=BANDS)
    shares = np.bincount(band, weights=wrong, minlength=BANDS) / np.maximum(counts, 1)
    shares[counts < BAND_SAMPLES // 4] = 0.0
    top = int(np.argmax(shares))
    inside = row[band == top]
    return f"{shares[top]:.0%} of the {of} in {_rows(inside)}" if shares[top] > quarter else None


def contrast_words(ref: Reference) -> str:
    """Words for the case that it is noise after all."""
    return (
        f"noise hides the pattern (white − black is {float(np.median(ref.contrast[ref.judged])):.0f} DN: if that is "
        "little, lengthen the exposure)"
    )


def rows_of(ref: Reference, band: int) -> str:
    """Words for where a band lies."""
    return _rows(ref.row[ref.band == band])


def _rows(row: NDArray[np.intp]) -> str:
    return f"rows {row.min()} to {row.max()}"
