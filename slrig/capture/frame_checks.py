"""Checks of sampled pixels: pure functions of vectors that return a fault description or None.

All vectors contain the same n sampled pixels of one camera: (n,) float32, in digital numbers (DN). `u` is a frame on
the scale on which the black frame is 0 and the white frame is 1. Checks use `ReferenceFrames.tested` pixels only: lit,
not saturated, and of these the half with the highest contrast, so that noise has little influence.

`FrameVerifier` turns the faults into `Contradiction`s between frames of one camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.model import Black, Gray, Integers, LineShift, Pattern, Primary, Sine, Size, White, gray_index, to_gray

Samples = NDArray[np.float32]
SampleMask = NDArray[np.bool_]

BANDS = 12
"""Number of horizontal bands that are checked separately, because an interrupted transfer damages rows."""

NOISE_FLOOR_DN = 0.3
"""Standard deviation of rounding to whole numbers, 1/√12, which is the minimum for any camera."""

BAND_SAMPLES = 300
"""Minimum number of samples to check a band separately."""

NEAR_SATURATION = 0.97
"""Fraction of full scale above which a sample counts as saturated, because some sensors saturate below full scale."""

CHECK_CABLE = "check the cable"
"""Words of all faults that chance causes."""

_MIN_LIT_SAMPLES = 40
_OVEREXPOSED = 0.5
"""Of the lit samples, saturated in white. Most of the others lie at edges, or noise hides that they are clipped."""

_MAX_CHANGE, _MAX_CHANGED_FRACTION = 0.1, 0.01  # of the range of a frame; of the pixels

_REPEAT_TOLERANCE = 0.02
"""Fraction of a frame's own variation. Lines blurred to three times their width differ by more from step to step."""

_EDGE_PX = 8.0
"""Width of an edge blurred by a scaler, projector pixels: ± 2 standard deviations of a Gaussian of 2 px."""

_EVEN_SPREAD = 0.08
"""Relative spread of an even change of light; damage and other patterns have a larger one."""

_ROUGHNESS_RATIO, _ROUGHNESS_MARGIN = 1.25, 0.15
"""Tolerances of roughness, chosen above that of a projector with dithering. Random bytes have a third of full scale."""

_MIN_LINE_SWING = 0.5
"""Of white, over all line frames: a wall at a grazing view shows coarse bits where it shows no lines."""

_NOISE_ROUGHNESS = 1.5
"""Two samples of normal noise differ by 1.13 standard deviations on average."""

_STEEPEST_GAMMA = 2.4
"""Gamma of displays, ITU-R BT.1886."""

_SIGNAL = np.linspace(0.5, 1.0, 257)
_SWING = _SIGNAL**_STEEPEST_GAMMA - (1 - _SIGNAL) ** _STEEPEST_GAMMA
_SUM = _SIGNAL**_STEEPEST_GAMMA + (1 - _SIGNAL) ** _STEEPEST_GAMMA

_LINE_SUM_TOLERANCE = 0.25
"""Relative to white; sums of sharp lines on pixels as wide as a line differ by less."""

_HALF_LINE_SUM_TOLERANCE = 0.08
"""The same for lines of half their period."""

_MIN_CROSSINGS = 12  # pairs across an edge, for a median of their steps
_MIN_SPAN_PERIODS = 3  # between the 5th and the 95th percentile of the positions
_MIN_BAND_LINES = 4
_BLAME_MARGIN = 0.1  # of the wrong pixels, between frames that count as equally suspect
_MIN_EXPLAINED_FRACTION = 0.5  # of the wrong pixels, for a single bit to be the cause
_MIN_SHAPE_FRAMES = 5  # three line frames determine a wave's position, height and level without redundancy
_MIN_WAVE_HEIGHT = 0.15  # relative to white − black; sharp lines have 0.64
_SHAPE_BINS = 32
_SHAPE_SPREADS, _MIN_SHAPE_TOLERANCE = 6.0, 0.15  # the latter relative to the wave's height
_MAX_ODD_FRACTION, _MAX_ODD_FRACTION_IN_BAND = 0.05, 0.15  # of the tested pixels
_EDGE_SWING, _MIN_SWING_DIFFERENCE = 0.8, 0.2  # swing of a bit near its edge, relative to white − black
_MIN_WAVE_SIGMAS = 5.0
_MIN_WAVE = 0.03  # relative to white − black, for each line; sharp lines have 0.32
_MIN_LINE_LIGHT = 0.1  # relative to the 99th percentile
_REFERENCE_LEVEL_TOLERANCE, _MIN_REFERENCE_MARGIN = 0.3, 0.15  # relative to the swing of the lines at a pixel
_RESPONSES = (1.0, 1.5, 2.0, 2.5)  # powers that make a camera's image linear


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Frames of one camera that cannot all show what they should.

    where : camera and pattern of the frame that revealed it. cause : the fault and the remedy. suspects : patterns
    whose frames it concerns. further_suspects : patterns to blame if it remains after the suspects were captured again:
    those that the check depends on and that no other frame has confirmed. is_doubt : the frames differ in light, as an
    unusual rig or scene may cause it; none of them is proven wrong. wrong : those of the suspects that are proven
    wrong.
    """

    camera: str
    where: str
    cause: str
    suspects: tuple[int, ...]
    further_suspects: tuple[int, ...] = ()
    is_doubt: bool = False
    wrong: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.where}: {self.cause}"


def describe_pattern(index: int, pattern: Pattern) -> str:
    """Return a description of a pattern of a sequence.

    >>> from slrig.model import Axis
    >>> describe_pattern(7, Gray(Axis.COLUMN, 2, 9, inverted=True))
    'pattern 7 (column Gray bit 2 of 9, inverse)'
    """
    description: str
    match pattern:
        case White() | Black():
            description = pattern.kind
        case Primary():
            description = pattern.description
        case Gray():
            description = (
                f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverted else ''}"
            )
        case LineShift():
            description = f"{pattern.axis} lines, shift {pattern.shift} of {pattern.period_px}"
        case Sine():
            description = (
                f"{pattern.axis} sinusoid of {pattern.period_px:g} px, shift {pattern.shift} of {pattern.steps}"
            )
    return f"pattern {index} ({description})"


def describe_frame(camera: str, index: int, pattern: Pattern) -> str:
    """Return a description of a camera's frame of a pattern."""
    return f"camera '{camera}', {describe_pattern(index, pattern)}"


@dataclass(frozen=True, slots=True)
class Lighting:
    """Lighting of the whole image, measured from white and black.

    lit : fraction of the image that the projector lights. threshold_dn : minimum of white − black for a lit pixel.
    saturated : fraction of the lit pixels that are near full scale in white.
    """

    lit: float
    threshold_dn: float
    saturated: float

    def explain(self, fault: str) -> str:
        """Return a fault of frames that are not proven damaged, after overexposure where that can be the cause."""
        if self.saturated < _OVEREXPOSED:
            return fault
        return (
            f"the white frame is saturated on {self.saturated:.0%} of what the projector lights: shorten the exposure "
            f"or lower the gain. If it stays: {fault}"
        )


@dataclass(frozen=True, slots=True)
class ReferenceFrames:
    """One camera's first white and black frames at the sampled pixels.

    contrast : white − black, at least 1. lit : pixels that the projector lights; tested : pixels that the checks use.
    row : (n,) image row; band : (n,) index of one of `BANDS` bands with equal numbers of samples.
    """

    white: Samples
    black: Samples
    contrast: Samples
    lit: SampleMask
    tested: SampleMask
    row: NDArray[np.intp]
    band: NDArray[np.intp]

    def relative(self, frame: Samples) -> Samples:
        """Return u = (frame − black)/(white − black) at the tested pixels."""
        return np.asarray((frame - self.black)[self.tested] / self.contrast[self.tested])


def measure_lighting(white: Samples, black: Samples, *, full_scale: int, row: NDArray[np.intp]) -> Lighting | str:
    """Compare white with black. Return the lighting, or a description of the fault and its remedy."""
    contrast = white - black
    high, low = float(np.percentile(contrast, 99.5)), -float(np.percentile(contrast, 0.5))
    # Outside the projector's light, contrast is noise around zero, which its lower tail measures.
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
            "reports; set its input to normal polarity, check its latency, and scan again"
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
    return Lighting(float(np.mean(lit)), threshold, float(np.mean(white[lit] >= NEAR_SATURATION * full_scale)))


def build_reference(
    white: Samples, black: Samples, *, threshold_dn: float, full_scale: int, row: NDArray[np.intp]
) -> ReferenceFrames:
    """Choose the pixels to test among the samples, at least one of which must be lit and not saturated."""
    contrast = white - black
    lit = contrast >= threshold_dn
    usable = lit & (white < full_scale)
    # Noise can move a clipped sample below full scale, and half of its light then appears as more than half.
    clear = usable & (white < NEAR_SATURATION * full_scale)
    if np.count_nonzero(clear) >= BAND_SAMPLES * BANDS:
        usable = clear
    tested = usable & (contrast >= np.median(contrast[usable]))
    return ReferenceFrames(white, black, np.maximum(contrast, np.float32(1)), lit, tested, row, assign_bands(row))


def assign_bands(row: NDArray[np.intp]) -> NDArray[np.intp]:
    """Assign rows to bands of equal numbers of samples."""
    return np.searchsorted(np.quantile(row, np.arange(1, BANDS) / BANDS), row, side="right")


def _find_darker_band(contrast: Samples, high: float, row: NDArray[np.intp]) -> str | None:
    """Describe the band in which white − black is far below zero, which light cannot cause; None if there is none."""
    band = assign_bands(row)
    # Noise of the median band, because damage does not affect all bands.
    lower = [float(np.percentile(contrast[band == b], 2.0)) for b in range(BANDS) if (band == b).any()]
    noise = max(0.0, -float(np.median(lower)) / 2.05)
    wrong = contrast < -max(3.0, 0.25 * high, 6 * noise)
    return _describe_worst(wrong, band, row, max_total=0.05, max_in_band=0.1, unit="pixels")


def pair_noise_dn(bit: Samples, inverse: Samples, ref: ReferenceFrames, *, sums: Sequence[Samples] = ()) -> float:
    """Return the noise of one frame, DN: bit + inverse − white − black has the noise of four frames.

    sums : bit + inverse of other pairs, which replace white + black if that gives less noise. Otherwise damage of white
    or black would count as noise and hide all other faults.
    """
    pair = bit + inverse
    return min(_noise_from_four_frames((pair - other)[ref.tested]) for other in (ref.white + ref.black, *sums))


def bit_noise_dn(bit: Samples, ref: ReferenceFrames) -> float:
    """Return the noise of one frame, DN, from a bit with few edges, which equals white where it is lit and black
    elsewhere.
    """
    above, below = bit - ref.white, bit - ref.black
    nearer = np.where(np.abs(above) < np.abs(below), above, below)[ref.tested]
    # The difference has the noise of two frames in place of four.
    return max(NOISE_FLOOR_DN, _noise_from_four_frames(nearer) * math.sqrt(2))


def _noise_from_four_frames(rest: Samples) -> float:
    # Spread whole numbers over their rounding interval for a finer median.
    rest = rest + np.linspace(-0.5, 0.5, len(rest), dtype=np.float32)
    spread = 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
    return max(NOISE_FLOOR_DN, math.sqrt(max(spread**2 - 1 / 12, 0.0)) / 2)


def range_fault(frame: Samples, ref: ReferenceFrames, *, noise: float | None) -> str | None:
    """Check that a frame is not darker than black or brighter than white, which indicates damage.

    noise : DN; None widens the tolerance.
    """
    u = ref.relative(frame)
    slack = np.maximum(0.3, 6 * noise / ref.contrast[ref.tested]) if noise is not None else np.float32(0.6)
    outside = (u < -slack) | (u > 1 + slack)
    worst = describe_worst_tested(outside, ref, max_total=0.05)
    if worst is None:
        return None
    return (
        f"{worst} lie outside the range between the black and the white frame: the frame was damaged in transfer, the "
        f"room's light changed, the projector's light is later than reported, or {describe_contrast(ref)}; check the "
        "cable, the light and the projector's latency, and scan again"
    )


def is_partly_lit(frame: Samples, ref: ReferenceFrames) -> bool:
    """True if the mean light of a frame is clearly between black and white."""
    u = ref.relative(frame)
    return bool(0.005 < np.average(u, weights=ref.contrast[ref.tested]) < 0.985)


def variation(frame: Samples, ref: ReferenceFrames) -> float:
    """Return the mean square residual, DN², of a frame after the best fit of black + a · (white − black)."""
    contrast, light_dn = ref.contrast[ref.tested], (frame - ref.black)[ref.tested]
    fraction = float(np.dot(contrast, light_dn) / np.dot(contrast, contrast))
    return float(np.mean((light_dn - fraction * contrast) ** 2))


def find_repeated(
    frame: Samples, earlier: Sequence[Samples], ref: ReferenceFrames, *, noise: float, factor: float
) -> int | None:
    """Return the index of an earlier frame from which this one differs by noise only; None if there is none.

    Frames may rightly be equal if the visible part of the pattern is constant, so a frame counts as repeated only if
    its own variation is `factor` times the noise variance.
    """
    if not earlier or variation(frame, ref) < factor * noise**2:
        return None
    here = frame[ref.tested]
    distance = [float(np.mean((here - other[ref.tested]) ** 2)) for other in earlier]
    nearest = int(np.argmin(distance))
    # The noise is that of bright pixels; a camera with a display gamma has several times as much in dark ones.
    limit = max(6 * noise**2, _REPEAT_TOLERANCE * variation(frame, ref))
    return nearest if distance[nearest] < limit else None


@dataclass(frozen=True, slots=True)
class FrameDrift:
    """Difference between two frames of one pattern.

    light_change : median difference relative to white − black; light_limit : its tolerance. changed_fraction : fraction
    of pixels that changed by much more.
    """

    light_change: float
    light_limit: float
    changed_fraction: float


def measure_drift(first: Samples, repeat: Samples, ref: ReferenceFrames, *, noise: float | None) -> FrameDrift:
    """Compare two frames of one pattern. noise : DN; None estimates it from their difference."""
    contrast, change = ref.contrast[ref.tested], (repeat - first)[ref.tested]
    light = float(np.median(change / contrast))
    rest = np.abs(change - light * contrast)
    if noise is None:
        noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(rest)) / 2**0.5)
    changed = float(np.mean(rest > np.maximum(0.3 * contrast, 8 * noise)))
    # In weak light, the half of the pixels with the highest contrast is selected by noise and is darker when repeated.
    return FrameDrift(light, 0.1 + 1.5 * noise / float(np.median(contrast)), changed)


def drift_fault(drift: FrameDrift) -> str | None:
    """Check that the light changed by less than 10 % of white, and that at most 5 % of the pixels changed."""
    if drift.changed_fraction > 0.05:
        return (
            f"{drift.changed_fraction:.0%} of the pixels changed since this pattern was first shown: the object, the "
            "projector or a camera moved; hold them still, and scan again"
        )
    if abs(drift.light_change) > drift.light_limit:
        return (
            f"the light changed by {drift.light_change:+.0%} of white since this pattern was first shown: let the lamp "
            "warm up, switch off automatic exposure and dynamic contrast, keep the room's light steady, and scan again"
        )
    return None


def reference_change_fault(
    first: Samples,
    repeat: Samples,
    contrasts: tuple[Samples, Samples],
    *,
    threshold_dn: float,
    noise: float | None,
    row: NDArray[np.intp],
) -> str | None:
    """Compare two white or two black frames wherever one of them indicates light of the projector.

    All other checks use pixels that the first two frames selected, and damage may have affected that selection.

    contrasts : white − black with the first and with the second of the two frames, at pixels of the whole image.
    """
    contrast = np.maximum(*contrasts)
    lit = contrast >= threshold_dn
    if np.count_nonzero(lit) < BAND_SAMPLES:
        return None
    change = np.abs(repeat - first)[lit]
    if noise is None:
        noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(change)) / 2**0.5)
    wrong = change > np.maximum(0.3 * contrast[lit], 8 * noise)
    where = _describe_worst(wrong, assign_bands(row[lit]), row[lit], max_total=0.05, max_in_band=0.15)
    if where is None:
        return None
    return (
        f"{where} changed since this pattern was first shown: the object, the projector or a camera moved, or one of "
        "the two frames was damaged or shows another pattern; hold them still, check the cable, and scan again"
    )


def are_exposures_alike(first: Samples, again: Samples) -> bool:
    """True if two exposures of one pattern differ by noise only, at pixels of the whole image."""
    change = np.abs(again - first)
    noise = max(NOISE_FLOOR_DN, 1.4826 * float(np.median(change)))
    limit = max(8 * noise, _MAX_CHANGE * float(np.ptp(np.percentile(first, (1, 99)))))
    return bool(np.mean(change > limit) < _MAX_CHANGED_FRACTION)


def describe_worst_tested(
    wrong: SampleMask, ref: ReferenceFrames, *, max_total: float, max_in_band: float = 0.25
) -> str | None:
    """Describe the wrong tested pixels; None below `max_total` of all and below `max_in_band` of each band."""
    return _describe_worst(
        wrong, ref.band[ref.tested], ref.row[ref.tested], max_total=max_total, max_in_band=max_in_band
    )


def describe_worst_lit(
    wrong: SampleMask, row: NDArray[np.intp], *, max_total: float, max_in_band: float = 0.25
) -> str | None:
    """Describe wrong lit pixels in these rows, as `describe_worst_tested`."""
    return _describe_worst(wrong, assign_bands(row), row, max_total=max_total, max_in_band=max_in_band)


def _describe_worst(
    wrong: SampleMask,
    band: NDArray[np.intp],
    row: NDArray[np.intp],
    *,
    max_total: float,
    max_in_band: float = 0.25,
    unit: str = "lit pixels",
) -> str | None:
    """Describe the wrong pixels: None below `max_total` of all and below `max_in_band` of every band."""
    total = float(np.mean(wrong))
    if total > max_total:
        return f"{total:.0%} of the {unit}"
    counts = np.bincount(band, minlength=BANDS)
    fractions = np.bincount(band, weights=wrong, minlength=BANDS) / np.maximum(counts, 1)
    fractions[counts < BAND_SAMPLES // 4] = 0.0
    top = int(np.argmax(fractions))
    inside = row[band == top]
    return f"{fractions[top]:.0%} of the {unit} in {describe_rows(inside)}" if fractions[top] > max_in_band else None


def describe_contrast(ref: ReferenceFrames) -> str:
    """Describe the case in which noise causes the fault."""
    return (
        f"noise hides the pattern (white − black is {float(np.median(ref.contrast[ref.tested])):.0f} DN: if that is "
        "little, lengthen the exposure)"
    )


def describe_band(ref: ReferenceFrames, band: int) -> str:
    """Describe the rows of a band."""
    return describe_rows(ref.row[ref.band == band])


def describe_rows(row: NDArray[np.intp]) -> str:
    """Describe the range of some rows."""
    return f"rows {row.min()} to {row.max()}"


def pair_fault(bit: Samples, inverse: Samples, ref: ReferenceFrames, *, noise: float, run_px: int) -> str | None:
    """Check that a bit and its inverse add up to white and black, because light is additive.

    The tolerances allow for noise, for a non-linear camera, whose blurred edges add up to more than white, and for a
    projector with a scaler. A scaler blurs pixel values before gamma turns them into light, so that both frames are
    dark at an edge; a pair may fall short by as much as its own difference explains (`_min_pair_sum`). run_px : length
    of the bit's runs of equal projector pixels, which determines the fraction of the image at edges.
    """
    u, v = ref.relative(bit), ref.relative(inverse)
    excess = u + v - 1
    slack = np.clip(8 * max(noise, pair_noise_dn(bit, inverse, ref)) / ref.contrast[ref.tested], 0.2, 0.5)
    above = excess > 0.8
    at_edges = min(1.0, _EDGE_PX / run_px)
    dark = _dark_band_mask(u, v, ref)
    for one, other in ((bit, inverse), (inverse, bit)):
        fault = roughness_fault(one, [other], ref, noise=noise)
        if fault is not None:
            return fault
    worst = describe_worst_tested(above | dark | (u + v < _min_pair_sum(np.abs(u - v)) - slack), ref, max_total=0.1)
    if worst is None and at_edges < 1.0:
        wrong = above | (excess < -slack)
        worst = describe_worst_tested(wrong, ref, max_total=0.1 + at_edges, max_in_band=0.25 + at_edges)
    if worst is None:
        return None
    if are_alike(bit, inverse, ref):
        return f"the frame and its inverse show the same on {worst}: one of them is stale; scan again"
    total = float(np.median(u + v))
    if float(np.median(np.abs(u + v - total))) < _EVEN_SPREAD * total:
        return (
            f"the frame and its inverse have {total:.0%} of the light of white and black, evenly on all of the "
            "image: the exposure or the lamp changed since: switch off automatic exposure and gain, dynamic contrast "
            "and power saving, and scan again"
        )
    return (
        f"the frame and its inverse do not add up to white and black on {worst}: one of them shows another pattern or "
        f"was damaged, or something moved, or {describe_contrast(ref)}; scan again"
    )


def are_alike(bit: Samples, inverse: Samples, ref: ReferenceFrames) -> bool:
    """True if a frame and its inverse show nearly the same on most of the tested pixels."""
    return bool(np.median(np.abs((bit - inverse)[ref.tested]) / ref.contrast[ref.tested]) < 0.25)


def _dark_band_mask(u: Samples, v: Samples, ref: ReferenceFrames) -> SampleMask:
    """Mask of pixels in bands where one frame of a pair has almost no light and the other does not compensate for it.

    The blur of a scaler, in contrast, affects both frames equally.
    """
    band = ref.band[ref.tested]
    counts = np.bincount(band, minlength=BANDS)
    means = np.stack([np.bincount(band, weights=each, minlength=BANDS) for each in (u, v)]) / np.maximum(counts, 1)
    dark = (means.sum(axis=0) < 0.8) & (means.min(axis=0) < 0.3 * means.max(axis=0))
    return np.asarray(dark[band], dtype=np.bool_)


def _min_pair_sum(swing: Samples) -> Samples:
    """Return the smallest sum of a bit and its inverse whose difference is `swing`, all on the scale of `u`.

    Where a blurred bit has the pixel value s, its inverse has 1 - s: they differ by s^g - (1 - s)^g and add up to s^g +
    (1 - s)^g, which is smallest for the steepest gamma g.
    """
    return np.asarray(np.interp(swing, _SWING, _SUM), dtype=np.float32)


def roughness_fault(
    frame: Samples, others: Sequence[Samples], ref: ReferenceFrames, *, noise: float, by_lines: bool = False
) -> str | None:
    """Describe a band in which a frame is rougher than each frame of equally fine patterns: it was damaged there.

    Roughness is the mean difference of adjacent pixels. It is the same in a bit and its inverse, and in all line
    frames, for any response of camera and projector. Lit areas may be rougher than dark ones, by their noise and by
    unevenness of white itself. by_lines : a bit is compared with lines, where the camera resolves these.
    """
    roughness, light = _roughness(frame, ref)
    # The few pixels that overexposure leaves may all lie at one edge, which some of the other frames have as well.
    typical = np.max([_roughness(each, ref)[0] for each in others], axis=0)
    if by_lines:
        swing = np.ptp([(each - ref.black) / ref.contrast for each in others], axis=0)
        counts = np.bincount(ref.band[ref.tested], minlength=BANDS)
        resolved = np.bincount(ref.band[ref.tested], swing[ref.tested], BANDS) >= _MIN_LINE_SWING * np.maximum(
            counts, 1
        )
        typical = np.where(resolved, typical, np.nan)
    hidden = _NOISE_ROUGHNESS * noise / float(np.median(ref.contrast[ref.tested]))
    excess = roughness - _ROUGHNESS_RATIO * typical - _ROUGHNESS_MARGIN * (1 + np.clip(light, 0, 1)) - hidden
    worst = int(np.nanargmax(np.append(excess, 0.0)))
    if worst == BANDS:
        return None
    return (
        f"in {describe_band(ref, worst)} adjacent pixels differ by {roughness[worst]:.0%} of white, and by "
        f"{typical[worst]:.0%} in frames of equally fine patterns: the frame was damaged in transfer; check the cable, "
        "and scan again"
    )


def _roughness(frame: Samples, ref: ReferenceFrames) -> tuple[Samples, Samples]:
    """(BANDS,) float32 each: mean difference of adjacent pixels, and mean light; NaN with few tested pixels."""
    light, neighbour = ((frame - ref.black) / ref.contrast).reshape(2, -1)
    both = ref.tested.reshape(2, -1).all(axis=0)
    band = ref.band.reshape(2, -1)[0][both]
    counts = np.bincount(band, minlength=BANDS).astype(np.float32)
    counts[counts < BAND_SAMPLES // 8] = np.nan
    roughness, mean = (
        np.bincount(band, weights=each[both], minlength=BANDS) / counts
        for each in (np.abs(light - neighbour), (light + neighbour) / 2)
    )
    return roughness.astype(np.float32), mean.astype(np.float32)


@dataclass(frozen=True, slots=True)
class DecodedCode:
    """Gray code at the sampled pixels.

    index : (n,) int64, cell index. certain : (n,) bool, True if all bits are unambiguous. differences : (bits, n)
    float32, of each bit and its inverse.
    """

    index: Integers
    certain: SampleMask
    bits: int
    differences: Samples


def decode_samples(differences: Sequence[Samples], ref: ReferenceFrames) -> DecodedCode:
    """Decode one vector bit − inverse (or 2·bit − white − black) for each bit, most significant first."""
    stack = np.stack(differences)
    certain = ref.lit & (np.abs(stack) > 0.2 * ref.contrast).all(axis=0)
    return DecodedCode(gray_index(stack > 0), certain, len(stack), stack)


def within_the_light(
    ref: ReferenceFrames, code: DecodedCode, gray: Gray, line: LineShift, projector: Size | None
) -> ReferenceFrames:
    """Leave out pixels within a period of the ends of the projector's image, which see a part of a line where others
    see all of it: in an overexposed image many of the others are clipped. Without the projector's size, keep all.
    """
    if projector is None:
        return ref
    first_px = gray.cell_px * code.index - gray.offset_px
    inner = (first_px >= line.period_px) & (first_px + gray.cell_px <= projector.along(line.axis) - line.period_px)
    tested = ref.tested & (inner | ~code.certain)
    return replace(ref, tested=tested) if np.count_nonzero(tested) >= BAND_SAMPLES else ref


@dataclass(frozen=True, slots=True)
class LineExpectation:
    """Predicted light of one line frame.

    position : (n,) float32, decoded position in periods, NaN where it is uncertain or not tested. light : (n,) float32,
    fraction of the decoded cell that the frame lights, 0 to 1.
    """

    position: Samples
    light: Samples

    def is_testable(self, mask: SampleMask) -> bool:
        """True if the pixels of a mask, all of them certain, are enough and cover several lines."""
        if np.count_nonzero(mask) < BAND_SAMPLES:
            return False
        low, high = np.percentile(self.position[mask], (5, 95))
        # A line that straddles two cells of half a period lights all cells equally.
        return bool(high - low >= _MIN_SPAN_PERIODS and np.ptp(self.light[mask]) > 0)


@dataclass(frozen=True, slots=True)
class LineAgreement:
    """Comparison of the code with the lines at the sampled pixels.

    compared : (n,) bool, pixels with a clear phase; wrong : (n,) bool, pixels where phase and code contradict.
    is_reversed : True if the line frames appear to come in the opposite order.
    """

    compared: SampleMask
    wrong: SampleMask
    is_reversed: bool


def compare_with_lines(
    code: DecodedCode, gray: Gray, lines: Sequence[tuple[LineShift, Samples]], ref: ReferenceFrames, *, noise: float
) -> LineAgreement:
    """Compare the phase of the lines at each pixel with its decoded cell.

    A single wrong bit moves the index by an odd number of cells, which is half a period for cells of that width. So a
    wrong frame of the code is visible at every pixel whose bit it changed.

    gray : any bit of the code. lines : frames of one axis with evenly spaced shifts.
    """
    cell_px = gray.cell_px
    period_px, count = lines[0][0].period_px, len(lines)
    turn = 2j * np.pi / period_px
    waves = np.sum([frame * np.exp(turn * line.centre_px) for line, frame in lines], axis=0)
    clear = np.abs(waves) > np.maximum(_MIN_WAVE_SIGMAS * noise * (count / 2) ** 0.5, _MIN_WAVE * count * ref.contrast)
    centre_px = cell_px * code.index - gray.offset_px + (cell_px - 1) / 2
    off_px = (np.angle(waves) / abs(turn) - centre_px + period_px / 2) % period_px - period_px / 2
    compared = code.certain & clear
    wrong = compared & (np.abs(off_px) > cell_px / 2 + period_px / 16)
    # Near an edge of a cell, the bit that changes there has the smallest swing, which shows the edge that is closer.
    swing = np.abs(code.differences) / ref.contrast
    before, after = (swing[_changing_bit(code, step), np.arange(len(code.index))] for step in (-1, 1))
    near_edge = compared & (np.minimum(before, after) < _EDGE_SWING) & (np.abs(before - after) > _MIN_SWING_DIFFERENCE)
    against = (before < after) != (off_px < 0)
    is_reversed = np.count_nonzero(near_edge) >= BAND_SAMPLES and np.mean(against[near_edge]) > _MIN_EXPLAINED_FRACTION
    return LineAgreement(compared, wrong, bool(is_reversed))


def _changing_bit(code: DecodedCode, step: int) -> Integers:
    """(n,): index of the bit, most significant first, that differs between each cell and the previous or next one."""
    changed = to_gray(code.index) ^ to_gray(np.clip(code.index + step, 0, 2**code.bits - 1))
    return np.asarray(code.bits - 1 - np.log2(np.maximum(changed, 1)).astype(np.int64))


def find_faulty_bits(code: DecodedCode, wrong: SampleMask) -> tuple[int, ...]:
    """Return the bits whose inversion explains a contradiction of lines and code; all bits if none does.

    Inverting a bit mirrors the index, so that cells run backwards. The faulty bit is the one whose inversion at the
    wrong pixels brings neighbours as close together as they are elsewhere.
    """
    index, neighbour = code.index.reshape(2, -1)
    wrong_index, wrong_neighbour = wrong.reshape(2, -1)
    crossing = code.certain.reshape(2, -1).all(axis=0) & (index != neighbour)
    disputed = crossing & (wrong_index | wrong_neighbour)
    all_bits = tuple(range(code.bits))
    if np.count_nonzero(disputed) < _MIN_CROSSINGS:
        return all_bits
    undisputed = np.abs(index - neighbour)[crossing & ~disputed]
    limit = max(1.0, float(np.percentile(undisputed, 90))) if len(undisputed) else 1.0
    explained = []
    for bit in all_bits:
        mirror = 2 ** (code.bits - bit) - 1
        a, b = index ^ (mirror * wrong_index), neighbour ^ (mirror * wrong_neighbour)
        explained.append(float(np.mean(np.abs(a - b)[disputed] <= limit)))
    best = max(explained)
    return (
        tuple(bit for bit in all_bits if explained[bit] >= best - _BLAME_MARGIN)
        if best >= _MIN_EXPLAINED_FRACTION
        else all_bits
    )


def reference_level_fault(
    white: Samples, black: Samples, lines: Sequence[Samples], *, threshold_dn: float, full_scale: int,
    row: NDArray[np.intp],
) -> str | None:  # fmt: skip
    """Check white and black against line frames that light half of their period, whose mean is halfway between the two.

    It uses pixels of the whole image, because white and black select the pixels of all other checks, and damage may
    have affected that selection. lines : sorted by shift. threshold_dn : minimum light that a pixel gets from lines.
    """
    stack = np.stack(lines)
    swing = _average_and_swing(stack)[1]
    # Clipped samples add up to less.
    unclipped_lines = stack.max(axis=0) < NEAR_SATURATION * full_scale
    lit = unclipped_lines & (swing >= max(threshold_dn, _MIN_LINE_LIGHT * float(np.percentile(swing, 99))))
    unclipped = (white < NEAR_SATURATION * full_scale)[lit]
    if np.count_nonzero(unclipped) < BAND_SAMPLES:
        return None
    frames = np.maximum(np.stack([white, black, *stack])[:, lit] / np.float32(full_scale), 0)
    # Of a camera that compresses bright light, it depends on how well lines are resolved. In linear light it does not.
    levels = (_level_of(np.asarray(frames**power, np.float32), unclipped) for power in _RESPONSES)
    off, wrong, usual = min(levels, key=lambda level: abs(level[2]))
    slack = max(_REFERENCE_LEVEL_TOLERANCE, 6 * 1.4826 * float(np.median(np.abs(off - usual)[unclipped])))
    # A clipped white is darker than the lines predict, never brighter.
    off[~unclipped] = np.maximum(off[~unclipped], usual)
    wrong |= np.abs(off - usual) > slack
    where = describe_worst_lit(wrong, row[lit], max_total=0.05, max_in_band=0.1)
    if where is None:
        return None
    return (
        f"{where} are not as far above the mean of the line frames in white as below it in black: one of these two was "
        "damaged in transfer or shows another pattern; check the cable, and scan again"
    )


def _level_of(frames: Samples, unclipped: SampleMask) -> tuple[Samples, SampleMask, float]:
    """Return how far white and black are from twice the mean of the lines, relative to their swing; the mask of pixels
    where one of the two is not clearly beyond that mean; and the median of the former. frames : white, black, lines.
    """
    white, black = frames[:2]
    average, swing = _average_and_swing(frames[2:])
    off = np.asarray((white + black - 2 * average) / np.maximum(swing, np.float32(1e-6)))
    wrong = np.asarray(np.minimum(white - average, average - black) < _MIN_REFERENCE_MARGIN * swing)
    return off, wrong, float(np.median(off[unclipped]))


def _average_and_swing(lines: Samples) -> tuple[Samples, Samples]:
    if len(lines) % 2:
        return lines.mean(axis=0), np.ptp(lines, axis=0)
    # Use the median over lines and their inverses, to ignore a single damaged line frame.
    half = len(lines) // 2
    second = np.sort(lines, axis=0)[[1, -2]]
    return np.median(lines[:half] + lines[half:], axis=0) / 2, second[1] - second[0]


def predict_lines(code: DecodedCode, gray: Gray, line: LineShift, ref: ReferenceFrames) -> LineExpectation:
    """Predict the light of one line frame from the decoded cells. gray : any bit of the code."""
    first_px = gray.cell_px * code.index - gray.offset_px
    inside_px = np.arange(gray.cell_px)[:, np.newaxis]
    lit = (first_px + inside_px - line.shift) % line.period_px < line.line_width_px
    light = (np.count_nonzero(lit, axis=0) / gray.cell_px).astype(np.float32)
    position = (first_px / line.period_px).astype(np.float32)
    position[~(code.certain & ref.tested)] = np.nan
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
    """Compare a line frame with the Gray code and with the earlier line frames.

    The frame must be bright where the code places its lines, and contain as much light as the others. Returns (True if
    the comparison was possible, fault or None).

    duty : line width over period, the fraction of white in a line frame.
    """
    tested = ~np.isnan(expected.position)
    if not expected.is_testable(tested):
        return False, None
    fraction = _light_fraction(frame, ref, ref.tested)
    if fraction < 0.05 * duty:  # a soft scaler leaves a fifth of a narrow line, and less
        return (
            True,
            f"the frame holds {fraction:.1%} of white's light, lines should hold {duty:.1%}: it is dark; scan again",
        )
    typical = float(np.median([_light_fraction(other, ref, ref.tested) for other in others])) if others else fraction
    if not 0.4 * typical < fraction < 2.5 * typical:
        return True, (
            f"the frame holds {fraction:.1%} of white's light, the other line frames {typical:.1%}: it shows another "
            "pattern or was damaged; scan again"
        )
    # A lamp that flickers makes all of a frame brighter, and so its steps.
    matched = np.asarray(ref.black + (frame - ref.black) * np.float32(typical / fraction), dtype=np.float32)
    roughness = roughness_fault(matched, others, ref, noise=noise) if others else None
    if roughness is not None:
        return True, roughness
    # Lines hidden by noise or blur cannot be checked. Sharp ones would vary by duty · (1 − duty).
    hidden = 0.03 * duty * (1 - duty) * float(np.mean(ref.contrast[ref.tested] ** 2))
    if variation(frame, ref) < max(3 * noise**2, hidden):
        return False, None
    # A sharp line of one position correlates with its cell, half a period wide, by about √duty.
    correlation, min_correlation = _correlation(frame, ref, expected.light, tested), 0.2 * duty**0.5
    if correlation < min_correlation:
        return True, (
            f"its lines are not where the Gray code says (correlation {correlation:.2f}, expected "
            f"{min_correlation:.2f} or more): a bit is exchanged with its inverse, or the frame shows another pattern; "
            "scan again"
        )
    for band in range(BANDS):
        inside = tested & (ref.band == band)
        # A line at the border of its cell lights the next cell almost equally; only over several lines is the ratio
        # independent of the positions of pixels.
        if not expected.is_testable(inside) or len(np.unique(np.floor(expected.position[inside]))) < _MIN_BAND_LINES:
            continue
        band_correlation = _correlation(frame, ref, expected.light, inside)
        # Half of the samples are neighbours of the others and add little information.
        chance = 5 * (2 / np.count_nonzero(inside)) ** 0.5
        if band_correlation < 0.35 * correlation and band_correlation < correlation - chance:
            return True, (
                f"in {describe_band(ref, band)} its lines are not where the Gray code says: the frame was damaged in "
                "transfer; check the cable, and scan again"
            )
    return True, None


def line_sum_fault(
    frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float, half: bool = False
) -> tuple[tuple[int, ...], str] | None:
    """Check the sum of the n line frames of one axis: (indices of suspect frames, fault), or None. frames : sorted by
    shift.

    Each pixel is lit by one frame as every other pixel is by another, so the sum is the same everywhere, also with a
    scaler, or a non-linear camera that sees the lines equally sharp. A frame is suspect if subtracting the error of the
    sum from it leaves its light between black and white. half : the lines light half of their period; then all sums
    contain so much light that pixels as wide as a line differ less, and the sum of white tells the camera's response.
    """
    powers = _RESPONSES if half else (1.0,)
    light = min(
        (_linear_light(frames, ref, power) for power in powers),
        key=lambda each: abs(np.median(each.sum(axis=0)) - len(frames) / 2),
    )
    total = light.sum(axis=0)
    off = total - np.median(total)
    spread = 1.4826 * float(np.median(np.abs(off)))
    slack = np.maximum(
        max(_HALF_LINE_SUM_TOLERANCE if half else _LINE_SUM_TOLERANCE, 6 * spread),
        8 * noise * len(frames) ** 0.5 / ref.contrast[ref.tested],
    )
    wrong = np.abs(off) > slack
    where = describe_worst_tested(wrong, ref, max_total=0.1, max_in_band=0.15)
    if where is None:
        return None
    without = (light - off)[:, wrong]
    outside = np.mean((without < -slack[wrong]) | (without > 1 + slack[wrong]), axis=1)
    blamed = tuple(int(each) for each in np.flatnonzero(outside <= outside.min() + _BLAME_MARGIN))
    return blamed, (
        f"on {where} the line frames do not add up to what they do elsewhere: one of them was damaged in transfer or "
        "shows another pattern, or something moved; check the cable, and scan again"
    )


def _linear_light(frames: Sequence[Samples], ref: ReferenceFrames, power: float) -> Samples:
    """(n, tested): each frame's part of white, both raised to a power."""
    white, black, *light = (np.maximum(each[ref.tested], 0) ** power for each in (ref.white, ref.black, *frames))
    return np.asarray((np.stack(light) - black) / np.maximum(white - black, 1), dtype=np.float32)


def line_shape_fault(
    lines: Sequence[LineShift], frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float
) -> tuple[int, str] | None:
    """Check each line frame against the others: (index of the deviating frame, fault), or None.

    The light of a pixel as a function of shift has the same shape everywhere, up to position, height and level. With
    three frames there is no redundancy.

    lines, frames : of one axis, sorted by shift, evenly spaced.
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
    # An edge rises within its bin, and sharp edges differ with the position of pixels on them.
    rise = np.abs(np.roll(shape, -1) - np.roll(shape, 1))[bins] / 2
    spread = 1.4826 * np.array([_median_or_zero(np.abs(off[(bins == each) & clear])) for each in every])[bins]
    slack = np.maximum(
        np.maximum(_MIN_SHAPE_TOLERANCE + rise, _SHAPE_SPREADS * spread),
        5 * noise / (ref.contrast[ref.tested] * height + 1e-6),
    )
    wrong = (np.abs(off) > slack) & clear
    worst = int(np.argmax(np.count_nonzero(wrong, axis=1)))
    where = describe_worst_tested(wrong[worst], ref, max_total=_MAX_ODD_FRACTION, max_in_band=_MAX_ODD_FRACTION_IN_BAND)
    if where is None:
        return None
    return worst, (
        f"on {where} its light does not fit the other line frames: it was damaged in transfer or shows another "
        "pattern, or something moved; check the cable, and scan again"
    )


def _median_or_zero(values: Samples) -> float:
    return float(np.median(values)) if len(values) else 0.0


def check_line_order(frames: Sequence[Samples], ref: ReferenceFrames, *, noise: float) -> tuple[bool, int | None]:
    """Check the order of the n line frames of one axis: (True if it is measurable, index of the first misplaced frame
    or None).

    Blurred lines overlap those of the next frame more than those of the one after. With sharp lines or strong noise the
    order is not measurable. frames : sorted by shift.
    """
    contrast = ref.contrast[ref.tested]
    rest = np.stack([frame[ref.tested] - ref.black[ref.tested] for frame in frames])
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


def _light_fraction(frame: Samples, ref: ReferenceFrames, mask: SampleMask) -> float:
    return float(np.sum((frame - ref.black)[mask]) / np.sum(ref.contrast[mask]))


def _correlation(frame: Samples, ref: ReferenceFrames, light: Samples, mask: SampleMask) -> float:
    light_dn = (frame - ref.black)[mask]
    rest = light_dn - np.sum(light_dn) / np.sum(ref.contrast[mask]) * ref.contrast[mask]
    expected = light[mask] - np.mean(light[mask])
    power = float(np.dot(rest, rest)) * float(np.dot(expected, expected))
    return float(np.dot(rest, expected)) / power**0.5 if power > 0 else 0.0
