"""Checks of sampled pixels of a frame: pure functions on vectors, each returns a contradiction or None.

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

from slrig.model import Black, Gray, Integers, LineShift, Pattern, Primary, White, from_gray, gray_index, to_gray

Samples = NDArray[np.float32]
SampleMask = NDArray[np.bool_]

BANDS = 12
"""Frames are judged as a whole and in this many horizontal bands: a transfer that broke off spoils rows."""

NOISE_FLOOR_DN = 0.3
"""Standard deviation of rounding to whole numbers, 1/√12: no camera is less noisy."""

BAND_SAMPLES = 300
"""A band of fewer samples is not judged by itself."""

_MIN_LIT_SAMPLES = 40

NEAR_SATURATION = 0.97  # of full scale: some sensors saturate a little below it, and not everywhere alike

_REPEAT_TOLERANCE = 0.02
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


def describe_pattern(index: int, pattern: Pattern) -> str:
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
            words = pattern.description
        case Gray():
            words = f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverted else ''}"
        case LineShift():
            words = f"{pattern.axis} lines, shift {pattern.shift} of {pattern.period_px}"
    return f"pattern {index} ({words})"


def describe_frame(camera: str, index: int, pattern: Pattern) -> str:
    """Words for a camera's frame of a pattern."""
    return f"camera '{camera}', {describe_pattern(index, pattern)}"


@dataclass(frozen=True, slots=True)
class Lighting:
    """What white and black say at pixels drawn from the whole image.

    lit : share of the image that the projector lights. threshold_dn : white − black of a lit pixel, at least.
    """

    lit: float
    threshold_dn: float


@dataclass(frozen=True, slots=True)
class ReferenceFrames:
    """One camera's opening white and black frames at the sampled pixels.

    contrast : white − black, at least 1. lit, judged : which pixels the projector reaches, and which are asked.
    row, band : (n,) where the pixel lies, and in which band of equally many samples.
    """

    white: Samples
    black: Samples
    contrast: Samples
    lit: SampleMask
    judged: SampleMask
    row: NDArray[np.intp]
    band: NDArray[np.intp]

    def relative(self, frame: Samples) -> Samples:
        """Return u = (frame − black)/(white − black) at the judged pixels."""
        return np.asarray((frame - self.black)[self.judged] / self.contrast[self.judged])


def measure_lighting(white: Samples, black: Samples, *, full_scale: int, row: NDArray[np.intp]) -> Lighting | str:
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
    darker = _find_darker_band(contrast, high, row)
    if darker is not None:
        return (
            f"white is darker than black on {darker}: one of the two frames was damaged in transfer, or the room's "
            "light changed; check the cable and the light, and scan again"
        )
    threshold = max(2.0, 0.1 * high, 4 * noise)
    lit = contrast >= threshold
    if np.count_nonzero(lit) < _MIN_LIT_SAMPLES:
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


def build_reference(
    white: Samples, black: Samples, *, threshold_dn: float, full_scale: int, row: NDArray[np.intp]
) -> ReferenceFrames:
    """Choose which of the sampled pixels are asked. At least one must be lit and not saturated."""
    contrast = white - black
    lit = contrast >= threshold_dn
    usable = lit & (white < full_scale)
    # Noise makes of a clipped sample one that is nearly full, and of half of its light more than half of it is seen.
    clear = usable & (white < NEAR_SATURATION * full_scale)
    if np.count_nonzero(clear) >= BAND_SAMPLES * BANDS:
        usable = clear
    judged = usable & (contrast >= np.median(contrast[usable]))
    return ReferenceFrames(white, black, np.maximum(contrast, np.float32(1)), lit, judged, row, _assign_bands(row))


def _assign_bands(row: NDArray[np.intp]) -> NDArray[np.intp]:
    """Bands of equally many samples."""
    return np.searchsorted(np.quantile(row, np.arange(1, BANDS) / BANDS), row, side="right")


def _find_darker_band(contrast: Samples, high: float, row: NDArray[np.intp]) -> str | None:
    """Words for a band in which white − black is far below zero, which no light can do."""
    band = _assign_bands(row)
    # Noise by the middle band: damage is not everywhere.
    lower = [float(np.percentile(contrast[band == b], 2.0)) for b in range(BANDS) if (band == b).any()]
    noise = max(0.0, -float(np.median(lower)) / 2.05)
    wrong = contrast < -max(3.0, 0.25 * high, 6 * noise)
    return _describe_worst(wrong, band, row, whole=0.05, quarter=0.1, of="pixels")


def pair_noise_dn(bit: Samples, inverse: Samples, ref: ReferenceFrames, *, sums: Sequence[Samples] = ()) -> float:
    """Noise of one frame, DN: bit + inverse − white − black is the noise of four.

    sums : of other pairs. The least that a difference from one of them tells counts, too: if white or black was
    damaged, the difference from these is that damage, and noise so large would hide all else.
    """
    pair = bit + inverse
    return min(_noise_from_four_frames((pair - other)[ref.judged]) for other in (ref.white + ref.black, *sums))


def bit_noise_dn(bit: Samples, ref: ReferenceFrames) -> float:
    """Noise of one frame, DN, by a bit that lights few edges: where it is lit it shows what white does, else black."""
    above, below = bit - ref.white, bit - ref.black
    nearer = np.where(np.abs(above) < np.abs(below), above, below)[ref.judged]
    # Of two frames; the square root of two less than what four would tell.
    return max(NOISE_FLOOR_DN, _noise_from_four_frames(nearer) * math.sqrt(2))


def _noise_from_four_frames(rest: Samples) -> float:
    # Whole numbers have a coarse median; spread over the interval that each stands for, they have a fine one.
    rest = rest + np.linspace(-0.5, 0.5, len(rest), dtype=np.float32)
    spread = 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
    return max(NOISE_FLOOR_DN, math.sqrt(max(spread**2 - 1 / 12, 0.0)) / 2)


def range_fault(frame: Samples, ref: ReferenceFrames, *, noise: float | None) -> str | None:
    """No pattern is darker than black or brighter than white: a frame that is was damaged on its way.

    Without a known noise, more is let pass.
    """
    u = ref.relative(frame)
    slack = np.maximum(0.3, 6 * noise / ref.contrast[ref.judged]) if noise is not None else np.float32(0.6)
    outside = (u < -slack) | (u > 1 + slack)
    worst = describe_worst_tested(outside, ref, whole=0.05)
    if worst is None:
        return None
    return (
        f"{worst} lie outside the range between the black and the white frame: the frame was damaged in transfer, the "
        f"room's light changed, the projector's light comes later than it says, or {describe_contrast(ref)}; check the "
        "cable, the light and the projector's latency, and scan again"
    )


def is_partly_lit(frame: Samples, ref: ReferenceFrames) -> bool:
    """Whether a frame is neither as dark as black nor as bright as white, all in all."""
    u = ref.relative(frame)
    return bool(0.005 < np.average(u, weights=ref.contrast[ref.judged]) < 0.985)


def variation(frame: Samples, ref: ReferenceFrames) -> float:
    """Mean square, DN², of what is left of a frame after its best fit by black + share · (white − black)."""
    contrast, seen = ref.contrast[ref.judged], (frame - ref.black)[ref.judged]
    share = float(np.dot(contrast, seen) / np.dot(contrast, contrast))
    return float(np.mean((seen - share * contrast) ** 2))


def find_repeated(
    frame: Samples, earlier: Sequence[Samples], ref: ReferenceFrames, *, noise: float, factor: float
) -> int | None:
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
    alike = max(6 * noise**2, _REPEAT_TOLERANCE * variation(frame, ref))
    return nearest if distance[nearest] < alike else None


@dataclass(frozen=True, slots=True)
class FrameDrift:
    """How a pattern's second frame differs from its first.

    light : median of the difference over the white contrast; light_limit : how large it may be.
    moved : share of pixels that changed by much more.
    """

    light: float
    light_limit: float
    moved: float


def measure_drift(first: Samples, again: Samples, ref: ReferenceFrames, *, noise: float | None) -> FrameDrift:
    """Compare two frames of one pattern. Without a known noise, that of their difference is taken."""
    contrast, change = ref.contrast[ref.judged], (again - first)[ref.judged]
    light = float(np.median(change / contrast))
    rest = np.abs(change - light * contrast)
    if noise is None:
        noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(rest)) / 2**0.5)
    moved = float(np.mean(rest > np.maximum(0.3 * contrast, 8 * noise)))
    # In the dark, the brighter half of the pixels are those that noise made bright: they come back darker.
    return FrameDrift(light, 0.1 + 1.5 * noise / float(np.median(contrast)), moved)


def drift_fault(seen: FrameDrift) -> str | None:
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


def reference_change_fault(
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
    where = _describe_worst(wrong, _assign_bands(row[lit]), row[lit], whole=0.05, quarter=0.15)
    if where is None:
        return None
    return (
        f"{where} changed since this pattern was first shown: the object, the projector or a camera moved, or one of "
        "the two frames was damaged or shows another pattern; hold them still, check the cable, and scan again"
    )


def describe_worst_tested(
    wrong: SampleMask, ref: ReferenceFrames, *, whole: float, quarter: float = 0.25
) -> str | None:
    """Words for the share of judged pixels that are wrong: None below `whole` of all and below `quarter` of a band."""
    return _describe_worst(wrong, ref.band[ref.judged], ref.row[ref.judged], whole=whole, quarter=quarter)


def describe_worst_lit(wrong: SampleMask, row: NDArray[np.intp], *, whole: float, quarter: float = 0.25) -> str | None:
    """As `describe_worst_tested`, of any lit pixels in these rows."""
    return _describe_worst(wrong, _assign_bands(row), row, whole=whole, quarter=quarter)


def _describe_worst(
    wrong: SampleMask,
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
    return f"{shares[top]:.0%} of the {of} in {_describe_rows(inside)}" if shares[top] > quarter else None


def describe_contrast(ref: ReferenceFrames) -> str:
    """Words for the case that it is noise after all."""
    return (
        f"noise hides the pattern (white − black is {float(np.median(ref.contrast[ref.judged])):.0f} DN: if that is "
        "little, lengthen the exposure)"
    )


def describe_band(ref: ReferenceFrames, band: int) -> str:
    """Words for where a band lies."""
    return _describe_rows(ref.row[ref.band == band])


def _describe_rows(row: NDArray[np.intp]) -> str:
    return f"rows {row.min()} to {row.max()}"


_EDGE_PX = 8.0
"""Breadth of an edge that a scaler blurred, projector pixels: from end to end of a Gaussian of 2 px, ± 2 deviations."""

_EVEN_SPREAD = 0.08
"""Spread of what an even change of light leaves, by noise: damage and other patterns leave light and dark."""

_ROUGHNESS_RATIO, _ROUGHNESS_MARGIN = 1.25, 0.15
"""Bytes that are anything differ from pixel to pixel by a third of the full scale on average. A projector that was
found to dither differed by 0.18 of white where all was lit."""

_NOISE_ROUGHNESS = 1.5
"""Two samples of normal noise differ by 1.13 of its standard deviation on average."""

_STEEPEST_GAMMA = 2.4
"""Of displays: ITU-R BT.1886."""

_MIN_CROSSINGS = 12  # pairs across an edge, for a median of their steps
_MIN_SPAN_PERIODS = 3  # between the 5th and the 95th percentile of the positions
_MIN_BAND_LINES = 4  # of a band: where it is used says why

_LINE_SUM_TOLERANCE = 0.25
"""Of white: sums of line frames that differ by less are those of sharp lines on pixels as wide as theirs."""

_HALF_LINE_SUM_TOLERANCE = 0.08
"""Of white, for lines of half their period: of twelve rendered scenes the sums of all differ by less."""

_BLAME_MARGIN = 0.1  # of the wrong pixels: frames that explain as many, less this

_MAX_WORSENED_FRACTION = 0.25  # of the pairs that come closer when two bits are exchanged back: those that come apart
_MIN_EXPLAINED_FRACTION = 0.5  # of the pixels in what is wrong: a bit that explains fewer is not to blame alone
_MIN_SHAPE_FRAMES = 5  # line frames: three tell a wave's place, height and level, and no more
_MIN_WAVE_HEIGHT = 0.15  # of white over black; sharp lines have 0.64
_SHAPE_BINS = 32
_SHAPE_SPREADS, _MIN_SHAPE_TOLERANCE = 6.0, 0.15  # of the wave's height, which half of a wave rises by
_MAX_ODD_FRACTION, _MAX_ODD_FRACTION_IN_BAND = 0.05, 0.15  # of the judged pixels
_EDGE_SWING, _MIN_SWING_DIFFERENCE = (
    0.8,
    0.2,
)  # of white over black, by which a bit swings beside its edge, and less than another
_MIN_WAVE_SIGMAS = 5.0  # standard deviations
_MIN_WAVE = 0.03  # of white over black, for each line; sharp lines have 0.32
_MIN_LINE_LIGHT = 0.1
_REFERENCE_LEVEL_TOLERANCE, _MIN_REFERENCE_MARGIN = 0.3, 0.15  # of what lines light of a pixel, from dark to bright


def pair_fault(bit: Samples, inverse: Samples, ref: ReferenceFrames, *, noise: float, run_px: int) -> str | None:
    """Light is additive: a bit and its inverse add up to white and black.

    Limits leave room for noise; for a camera that is not linear, whose blurred edges add up to more than white; and for
    a projector behind a scaler. That blurs the pattern's values before gamma makes light of them, and then both frames
    are dark at an edge. There a pair may fall short by as much as its own swing explains (`_min_pair_sum`). How much of
    the image lies at edges follows from run_px, the length of the bit's runs of equal pixels in the projector.
    """
    u, v = ref.relative(bit), ref.relative(inverse)
    excess = u + v - 1
    slack = np.clip(8 * max(noise, pair_noise_dn(bit, inverse, ref)) / ref.contrast[ref.judged], 0.2, 0.5)
    above = excess > 0.8
    at_edges = min(1.0, _EDGE_PX / run_px)
    dark = _dark_band_mask(u, v, ref)
    for one, other in ((bit, inverse), (inverse, bit)):
        rough = roughness_fault(one, [other], ref, noise=noise)
        if rough is not None:
            return rough
    worst = describe_worst_tested(above | dark | (u + v < _min_pair_sum(np.abs(u - v)) - slack), ref, whole=0.1)
    if worst is None and at_edges < 1.0:
        wrong = above | (excess < -slack)
        worst = describe_worst_tested(wrong, ref, whole=0.1 + at_edges, quarter=0.25 + at_edges)
    if worst is None:
        return None
    apart = float(np.median(np.abs((bit - inverse)[ref.judged]) / ref.contrast[ref.judged]))
    if apart < 0.25:
        return f"the frame and its inverse show the same on {worst}: one of them is stale; scan again"
    together = float(np.median(u + v))
    if float(np.median(np.abs(u + v - together))) < _EVEN_SPREAD * together:
        return (
            f"the frame and its inverse have {together:.0%} of the light of white and black, evenly on all of the "
            "image: the exposure or the lamp changed since: switch off automatic exposure and gain, dynamic contrast "
            "and power saving, and scan again"
        )
    return (
        f"the frame and its inverse do not add up to white and black on {worst}: one of them shows another pattern or "
        f"was damaged, or something moved, or {describe_contrast(ref)}; scan again"
    )


def _dark_band_mask(u: Samples, v: Samples, ref: ReferenceFrames) -> SampleMask:
    """Which pixels lie in bands where one frame of a pair has hardly any light and the other does not make up for it.

    What a scaler takes from the edges it takes from both.
    """
    band = ref.band[ref.judged]
    counts = np.bincount(band, minlength=BANDS)
    means = np.stack([np.bincount(band, weights=each, minlength=BANDS) for each in (u, v)]) / np.maximum(counts, 1)
    dark = (means.sum(axis=0) < 0.8) & (means.min(axis=0) < 0.3 * means.max(axis=0))
    return np.asarray(dark[band], dtype=np.bool_)


_SIGNAL = np.linspace(0.5, 1.0, 257)
_SWING = _SIGNAL**_STEEPEST_GAMMA - (1 - _SIGNAL) ** _STEEPEST_GAMMA
_SUM = _SIGNAL**_STEEPEST_GAMMA + (1 - _SIGNAL) ** _STEEPEST_GAMMA


def _min_pair_sum(swing: Samples) -> Samples:
    """What a bit and its inverse add up to, at least, where they differ by `swing`; all on the scale of `u`.

    A blurred bit has the value s where its inverse has 1 - s: they differ by s^g - (1 - s)^g and add up to
    s^g + (1 - s)^g, least for the steepest gamma g.
    """
    return np.asarray(np.interp(swing, _SWING, _SUM), dtype=np.float32)


def roughness_fault(frame: Samples, others: Sequence[Samples], ref: ReferenceFrames, *, noise: float) -> str | None:
    """Words for a band in which a frame is rougher than frames of patterns as fine as its own: it was damaged there.

    Roughness is the mean difference of pixels that lie beside each other. A bit and its inverse have the same, and so
    have line frames among themselves, whatever camera and projector make of light. What is lit may be rougher than what
    is dark: by its noise, and where white itself was not shown evenly.
    """
    here, light = _roughness(frame, ref)
    usual = np.median([_roughness(each, ref)[0] for each in others], axis=0)
    hidden = _NOISE_ROUGHNESS * noise / float(np.median(ref.contrast[ref.judged]))
    over = here - _ROUGHNESS_RATIO * usual - _ROUGHNESS_MARGIN * (1 + np.clip(light, 0, 1)) - hidden
    worst = int(np.nanargmax(np.append(over, 0.0)))
    if worst == BANDS:
        return None
    return (
        f"in {describe_band(ref, worst)} pixels beside each other differ by {here[worst]:.0%} of white, and by "
        f"{usual[worst]:.0%} in frames of patterns as fine: the frame was damaged in transfer; check the cable, and "
        "scan again"
    )


def _roughness(frame: Samples, ref: ReferenceFrames) -> tuple[Samples, Samples]:
    """(BANDS,) float32 each: the mean difference of pixels beside each other, and the mean light, NaN where few are
    judged.
    """
    light, beside = ((frame - ref.black) / ref.contrast).reshape(2, -1)
    both = ref.judged.reshape(2, -1).all(axis=0)
    band = ref.band.reshape(2, -1)[0][both]
    counts = np.bincount(band, minlength=BANDS).astype(np.float32)
    counts[counts < BAND_SAMPLES // 8] = np.nan
    rough, mean = (
        np.bincount(band, weights=each[both], minlength=BANDS) / counts
        for each in (np.abs(light - beside), (light + beside) / 2)
    )
    return rough.astype(np.float32), mean.astype(np.float32)


@dataclass(frozen=True, slots=True)
class DecodedCode:
    """Gray code read at the sampled pixels. index : (n,) int64, cell index; sure : every bit is beyond doubt;
    differences : (bits, n), of each bit from its inverse.
    """

    index: Integers
    certain: SampleMask
    bits: int
    differences: Samples


def decode_samples(differences: Sequence[Samples], ref: ReferenceFrames) -> DecodedCode:
    """Decode: one vector bit − inverse (or 2·bit − white − black) per bit, most significant first."""
    stack = np.stack(differences)
    sure = ref.lit & (np.abs(stack) > 0.2 * ref.contrast).all(axis=0)
    return DecodedCode(gray_index(stack > 0), sure, len(stack), stack)


def find_inverted_bit(code: DecodedCode) -> int | None:
    """Which bit was exchanged with its inverse, told from where more significant bits change.

    The first half of the sampled pixels lie beside the second half. Two pixels beside each other have close indices,
    also where a coarse bit changes, unless a finer bit is inverted: that mirrors the indices within each of its
    blocks, and mirroring them back closes the gap. What this cannot see: an exchange of the most significant bit, which
    mirrors everything and leaves no gap, and of the last two or three, whose gap is as small as a common step. Line
    frames show these (`line_fault`).
    """
    here, beside = code.index.reshape(2, -1)
    sure = code.certain.reshape(2, -1).all(axis=0)
    if not sure.any():
        return None
    here, beside = here[sure], beside[sure]
    step = max(1.0, float(np.percentile(np.abs(here - beside), 75)))
    words = to_gray(here) ^ to_gray(beside)
    for coarse in range(code.bits - 1):
        # Pairs whose most significant difference is this bit.
        crossing = words >> (code.bits - 1 - coarse) == 1
        if np.count_nonzero(crossing) < _MIN_CROSSINGS:
            continue
        a, b = here[crossing], beside[crossing]
        if np.median(np.abs(a - b)) <= 4 * step:
            continue
        for fine in range(coarse + 1, code.bits):
            mirror = 2 ** (code.bits - fine) - 1
            if np.median(np.abs((a ^ mirror) - (b ^ mirror))) <= 1.5 * step:
                return fine
    return None


@dataclass(frozen=True, slots=True)
class LineExpectation:
    """Where the Gray code says that the lines of one frame are.

    position : (n,) float32, decoded position in periods, NaN where it is unsure or not asked.
    light : (n,) float32, which part of the decoded cell the frame lights, 0 to 1.
    """

    position: Samples
    light: Samples

    def is_testable(self, where: SampleMask) -> bool:
        """Whether these pixels, all of them sure, are enough of them and see several lines."""
        if np.count_nonzero(where) < BAND_SAMPLES:
            return False
        near, far = np.percentile(self.position[where], (5, 95))
        # A line that straddles two cells of half a period lights all cells alike.
        return bool(far - near >= _MIN_SPAN_PERIODS and np.ptp(self.light[where]) > 0)

    def lines(self, where: SampleMask) -> int:
        """How many periods these pixels, all of them sure, lie in."""
        return len(np.unique(np.floor(self.position[where])))


def find_exchanged_bits(code: DecodedCode) -> tuple[int, int] | None:
    """Which two bits stand in each other's place, told from pixels beside each other: these have close indices.

    Exchanged back, indices come closer at many pairs, and apart at few. What this cannot see: an exchange of bits of
    which neither changes over what is lit.
    """
    here, beside = code.index.reshape(2, -1)
    sure = code.certain.reshape(2, -1).all(axis=0)
    sure &= here != beside
    words = [to_gray(each[sure]) for each in (here, beside)]
    apart = np.abs(here - beside)[sure]
    # A table is faster than the sums that it is made of, twice for each pair of bits.
    index_of = from_gray(np.arange(2**code.bits))
    for one in range(code.bits):
        for other in range(one + 1, code.bits):
            first, second = code.bits - 1 - one, code.bits - 1 - other
            a, b = (index_of[_exchange_bits(word, first, second)] for word in words)
            change = np.abs(a - b) - apart
            nearer = np.count_nonzero(change < 0)
            if nearer >= _MIN_CROSSINGS and np.count_nonzero(change > 0) < _MAX_WORSENED_FRACTION * nearer:
                return one, other
    return None


def _exchange_bits(word: Integers, first: int, second: int) -> Integers:
    """Words with two of their bits, counted from the least significant one, in each other's place."""
    unlike = ((word >> first) ^ (word >> second)) & 1
    return np.asarray(word ^ (unlike << first) ^ (unlike << second))


@dataclass(frozen=True, slots=True)
class LineAgreement:
    """What lines say of the code at the sampled pixels.

    told : (n,) where they say anything; wrong : (n,) where they contradict the code. reversed : whether lines run
    through the cells against the code, as if they came in the opposite order.
    """

    told: SampleMask
    wrong: SampleMask
    reversed: bool


def compare_with_lines(
    code: DecodedCode,
    lines: Sequence[tuple[LineShift, Samples]],
    ref: ReferenceFrames,
    *,
    cell_px: int,
    offset_px: int,
    noise: float,
) -> LineAgreement:
    """Compare the phase of the lines at each pixel with the cell that the code gives.

    A single wrong bit, whichever it is, moves the index by an odd number of cells, and half a period where a cell is as
    wide as that: an error of any one frame of the code shows at every pixel where it turned the bit over.

    lines : the frames of one axis whose shifts divide their period evenly.
    """
    period_px, count = lines[0][0].period_px, len(lines)
    turn = 2j * np.pi / period_px
    waves = np.sum([frame * np.exp(turn * line.centre_px) for line, frame in lines], axis=0)
    clear = np.abs(waves) > np.maximum(_MIN_WAVE_SIGMAS * noise * (count / 2) ** 0.5, _MIN_WAVE * count * ref.contrast)
    centre_px = cell_px * code.index - offset_px + (cell_px - 1) / 2
    off_px = (np.angle(waves) / abs(turn) - centre_px + period_px / 2) % period_px - period_px / 2
    told = code.certain & clear
    wrong = told & (np.abs(off_px) > cell_px / 2 + period_px / 16)
    # The bit that changes at an edge of the cell swings least beside it: so it shows which edge a pixel is nearer to.
    swing = np.abs(code.differences) / ref.contrast
    before, after = (swing[_changing_bit(code, step), np.arange(len(code.index))] for step in (-1, 1))
    beside = told & (np.minimum(before, after) < _EDGE_SWING) & (np.abs(before - after) > _MIN_SWING_DIFFERENCE)
    against = (before < after) != (off_px < 0)
    turned = np.count_nonzero(beside) >= BAND_SAMPLES and np.mean(against[beside]) > _MIN_EXPLAINED_FRACTION
    return LineAgreement(told, wrong, bool(turned))


def _changing_bit(code: DecodedCode, step: int) -> Integers:
    """(n,) which bit, the most significant one first, differs between each cell and the one before or after it."""
    changed = to_gray(code.index) ^ to_gray(np.clip(code.index + step, 0, 2**code.bits - 1))
    return np.asarray(code.bits - 1 - np.log2(np.maximum(changed, 1)).astype(np.int64))


def find_faulty_bits(code: DecodedCode, wrong: SampleMask) -> tuple[int, ...]:
    """Which bits are to blame where lines contradict the code: those that, turned over there, bring pixels beside each
    other as close as they are elsewhere; all of them where none does.

    A bit that is turned over mirrors the index: cells run backwards there.
    """
    here, beside = code.index.reshape(2, -1)
    wrong_here, wrong_beside = wrong.reshape(2, -1)
    crossing = code.certain.reshape(2, -1).all(axis=0) & (here != beside)
    doubted = crossing & (wrong_here | wrong_beside)
    every = tuple(range(code.bits))
    if np.count_nonzero(doubted) < _MIN_CROSSINGS:
        return every
    sound = np.abs(here - beside)[crossing & ~doubted]
    close = max(1.0, float(np.percentile(sound, 90))) if len(sound) else 1.0
    closed = []
    for bit in every:
        mirror = 2 ** (code.bits - bit) - 1
        a, b = here ^ (mirror * wrong_here), beside ^ (mirror * wrong_beside)
        closed.append(float(np.mean(np.abs(a - b)[doubted] <= close)))
    most = max(closed)
    return (
        tuple(bit for bit in every if closed[bit] >= most - _BLAME_MARGIN) if most >= _MIN_EXPLAINED_FRACTION else every
    )


def reference_level_fault(
    white: Samples, black: Samples, lines: Sequence[Samples], *, threshold_dn: float, full_scale: int,
    row: NDArray[np.intp],
) -> str | None:  # fmt: skip
    """Lines that light half of their period are on average the middle of white and black, at pixels of the whole image:
    those that other tests ask were chosen by white and black, and damage may have chosen them.

    lines : by shift. threshold_dn : of light that a pixel gets from lines.
    """
    stack = np.stack(lines)
    if len(stack) % 2:
        average, reach = stack.mean(axis=0), np.ptp(stack, axis=0)
    else:
        # Lines and their inverses: one of them that was damaged says nothing of white and black.
        half = len(stack) // 2
        average = np.median(stack[:half] + stack[half:], axis=0) / 2
        second = np.sort(stack, axis=0)[[1, -2]]
        reach = second[1] - second[0]
    # What is clipped adds up to less.
    clear = stack.max(axis=0) < NEAR_SATURATION * full_scale
    clipped = white >= NEAR_SATURATION * full_scale
    lit = clear & (reach >= max(threshold_dn, _MIN_LINE_LIGHT * float(np.percentile(reach, 99))))
    told = ~clipped[lit]
    if np.count_nonzero(told) < BAND_SAMPLES:
        return None
    off = ((white + black - 2 * average) / np.maximum(reach, 1))[lit]
    usual = float(np.median(off[told]))
    slack = max(_REFERENCE_LEVEL_TOLERANCE, 6 * 1.4826 * float(np.median(np.abs(off - usual)[told])))
    # A white that is clipped is less than the lines foresee, never more.
    off[~told] = np.maximum(off[~told], usual)
    wrong = (np.abs(off - usual) > slack) | (
        np.minimum(white - average, average - black) < _MIN_REFERENCE_MARGIN * reach
    )[lit]
    where = describe_worst_lit(wrong, row[lit], whole=0.05, quarter=0.1)
    if where is None:
        return None
    return (
        f"{where} are not as far above the average of the line frames in white as below it in black: one of these two "
        "was damaged in transfer or shows another pattern; check the cable, and scan again"
    )


def predict_lines(
    code: DecodedCode, ref: ReferenceFrames, *, cell_px: int, offset_px: int, shift: int, period_px: int, width_px: int
) -> LineExpectation:
    """Turn decoded cells into the light of one line frame."""
    first_px = cell_px * code.index - offset_px
    inside_px = np.arange(cell_px)[:, np.newaxis]
    lit = (first_px + inside_px - shift) % period_px < width_px
    light = (np.count_nonzero(lit, axis=0) / cell_px).astype(np.float32)
    position = (first_px / period_px).astype(np.float32)
    position[~(code.certain & ref.judged)] = np.nan
    return LineExpectation(position, light)


def line_fault(
    frame: Samples,
    others: Sequence[Samples],
    ref: ReferenceFrames,
    expected: LineExpectation,
    *,
    noise: float,
    duty: float,
) -> tuple[bool, str | None]:
    """Compare a line frame with the Gray code and with the line frames before it.

    The frame must be bright where the code says that its lines are, and as bright in all as the others: together, n
    line frames of width w add up to w times white. Returns (whether the comparison could be made, what is wrong).

    duty : line width over period, the share of white that a line frame holds.
    """
    asked = ~np.isnan(expected.position)
    if not expected.is_testable(asked):
        return False, None
    share = _light_fraction(frame, ref, ref.judged)
    if share < 0.05 * duty:  # a soft scaler leaves a fifth of a narrow line, and less
        return (
            True,
            f"the frame holds {share:.1%} of white's light, lines should hold {duty:.1%}: it is dark; scan again",
        )
    typical = float(np.median([_light_fraction(other, ref, ref.judged) for other in others])) if others else share
    if not 0.4 * typical < share < 2.5 * typical:
        return True, (
            f"the frame holds {share:.1%} of white's light, the other line frames {typical:.1%}: it shows another "
            "pattern or was damaged; scan again"
        )
    rough = roughness_fault(frame, others, ref, noise=noise) if others else None
    if rough is not None:
        return True, rough
    # Lines that noise or blur hides cannot be judged. Sharp ones would vary by duty · (1 − duty).
    hidden = 0.03 * duty * (1 - duty) * float(np.mean(ref.contrast[ref.judged] ** 2))
    if variation(frame, ref) < max(3 * noise**2, hidden):
        return False, None
    # A sharp line of one position correlates with its cell, half a period wide, by about √duty.
    agreement, least = _correlation(frame, ref, expected.light, asked), 0.2 * duty**0.5
    if agreement < least:
        return True, (
            f"its lines are not where the Gray code says (correlation {agreement:.2f}, expected {least:.2f} or more): "
            "a bit is exchanged with its inverse, or the frame shows another pattern; scan again"
        )
    for band in range(BANDS):
        inside = asked & (ref.band == band)
        # A line at the border of its cell lights the next one nearly as much. Which of the two gets more goes by where
        # pixels happen to lie, and only over several lines is it that of the whole frame.
        if not expected.is_testable(inside) or expected.lines(inside) < _MIN_BAND_LINES:
            continue
        here = _correlation(frame, ref, expected.light, inside)
        # Half of the samples lie beside the others and say little more than these.
        chance = 5 * (2 / np.count_nonzero(inside)) ** 0.5
        if here < 0.35 * agreement and here < agreement - chance:
            return True, (
                f"in {describe_band(ref, band)} its lines are not where the Gray code says: the frame was damaged in "
                "transfer; check the cable, and scan again"
            )
    return True, None


def line_sum_fault(
    frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float, half: bool = False
) -> tuple[tuple[int, ...], str] | None:
    """Judge the sum of the n line frames of one axis, given by shift: those to blame and what is wrong, or None.

    Each place is lit by one frame as every other place is by another, so the sum is the same everywhere, also where a
    camera is not linear or a scaler blurs. To blame is a frame that the sum's error can be taken from with light left
    between black and white. half : lines light half of their period, and so much of it is in every sum that pixels
    which are as wide as a line differ less.
    """
    light = np.stack([ref.relative(frame) for frame in frames])
    total = light.sum(axis=0)
    off = total - np.median(total)
    spread = 1.4826 * float(np.median(np.abs(off)))
    slack = np.maximum(
        max(_HALF_LINE_SUM_TOLERANCE if half else _LINE_SUM_TOLERANCE, 6 * spread),
        8 * noise * len(frames) ** 0.5 / ref.contrast[ref.judged],
    )
    wrong = np.abs(off) > slack
    where = describe_worst_tested(wrong, ref, whole=0.1, quarter=0.15)
    if where is None:
        return None
    without = (light - off)[:, wrong]
    outside = np.mean((without < -slack[wrong]) | (without > 1 + slack[wrong]), axis=1)
    blamed = tuple(int(each) for each in np.flatnonzero(outside <= outside.min() + _BLAME_MARGIN))
    return blamed, (
        f"on {where} the line frames do not add up to what they do elsewhere: one of them was damaged in transfer or "
        "shows another pattern, or something moved; check the cable, and scan again"
    )


def line_shape_fault(
    lines: Sequence[LineShift], frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float
) -> tuple[int, str] | None:
    """Judge each line frame by the others: (which one shows something else, what is wrong), or None.

    The wave that all frames draw at a pixel, light over shift, has the same shape everywhere, at a place, height and
    level of its own. One frame off it is not where the others say; of three frames a wave tells nothing.

    lines, frames : by shift, of one axis; the shifts divide the period evenly.
    """
    count = len(frames)
    if count < _MIN_SHAPE_FRAMES:
        return None
    light = np.stack([ref.relative(frame) for frame in frames])
    shifts = np.exp(2j * np.pi / lines[0].period_px * np.array([line.centre_px for line in lines]))
    wave = shifts @ light * (2 / count)
    height = np.abs(wave)
    clear = height > _MIN_WAVE_HEIGHT
    if np.count_nonzero(clear) < BAND_SAMPLES:
        return None
    around = np.angle(wave / shifts[:, np.newaxis]) / (2 * np.pi) % 1
    bins = np.minimum((around * _SHAPE_BINS).astype(np.intp), _SHAPE_BINS - 1)
    swing = (light - light.mean(axis=0)) / np.maximum(height, _MIN_WAVE_HEIGHT)
    every = np.arange(_SHAPE_BINS)
    shape = np.array([_median_or_zero(swing[(bins == each) & clear]) for each in every])
    off = swing - shape[bins]
    # Within its bin an edge rises, and edges that are sharp differ by how pixels lie on them.
    rise = np.abs(np.roll(shape, -1) - np.roll(shape, 1))[bins] / 2
    spread = 1.4826 * np.array([_median_or_zero(np.abs(off[(bins == each) & clear])) for each in every])[bins]
    slack = np.maximum(
        np.maximum(_MIN_SHAPE_TOLERANCE + rise, _SHAPE_SPREADS * spread),
        5 * noise / (ref.contrast[ref.judged] * height + 1e-6),
    )
    wrong = (np.abs(off) > slack) & clear
    worst = int(np.argmax(np.count_nonzero(wrong, axis=1)))
    where = describe_worst_tested(wrong[worst], ref, whole=_MAX_ODD_FRACTION, quarter=_MAX_ODD_FRACTION_IN_BAND)
    if where is None:
        return None
    return worst, (
        f"on {where} its light is not what the other line frames draw: it was damaged in transfer or shows another "
        "pattern, or something moved; check the cable, and scan again"
    )


def _median_or_zero(values: Samples) -> float:
    return float(np.median(values)) if len(values) else 0.0


def check_line_order(frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float) -> tuple[bool, int | None]:
    """Judge the order of the n line frames of one axis, given by shift: (whether it shows, the first one out of place).

    Blurred lines overlap those of the next frame more than those of the one after it. Where lines are too sharp, or
    noise is too strong, nothing shows.
    """
    contrast = ref.contrast[ref.judged]
    rest = np.stack([frame[ref.judged] - ref.black[ref.judged] for frame in frames])
    rest -= rest @ contrast[:, np.newaxis] / np.dot(contrast, contrast) * contrast
    overlap = rest @ rest.T / rest.shape[1]
    count = len(frames)
    signal = float(np.median(np.diag(overlap))) - noise**2
    margin = 0.15 * signal
    if signal < 2 * noise**2 or count < 5:
        return False, None
    steps = np.arange(count)
    lead = overlap[steps, (steps + 1) % count] - overlap[steps, (steps + 2) % count]
    if lead.min() < -margin:
        return True, int((np.argmin(lead) + 1) % count)
    return bool(lead.min() > margin), None


def _light_fraction(frame: Samples, ref: ReferenceFrames, where: SampleMask) -> float:
    return float(np.sum((frame - ref.black)[where]) / np.sum(ref.contrast[where]))


def _correlation(frame: Samples, ref: ReferenceFrames, light: Samples, where: SampleMask) -> float:
    seen = (frame - ref.black)[where]
    rest = seen - np.sum(seen) / np.sum(ref.contrast[where]) * ref.contrast[where]
    wanted = light[where] - np.mean(light[where])
    power = float(np.dot(rest, rest)) * float(np.dot(wanted, wanted))
    return float(np.dot(rest, wanted)) / power**0.5 if power > 0 else 0.0
