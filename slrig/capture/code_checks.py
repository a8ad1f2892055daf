"""What sampled pixels say about the Gray code and the line frames together: codes without gaps, lines where the code
puts them, and line frames in order. Vectors as in `slrig.capture.checks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.capture.checks import BAND_SAMPLES, BANDS, Chosen, Reference, Samples, rows_of, variation, worst_judged
from slrig.capture.pair_checks import rougher
from slrig.model.gray_code import Integers, gray_index, to_gray

_CROSSINGS = 12
_SPAN_PERIODS = 3
_BAND_LINES = 4

_LEAST_SUM_OFF = 0.25
"""Of white: sums of line frames that differ by less are those of sharp lines on pixels as wide as theirs."""

_AS_MUCH_TO_BLAME = 0.1


@dataclass(frozen=True, slots=True)
class Code:
    """Gray code read at the sampled pixels. index : (n,) int64, cell index; sure : every bit is beyond doubt."""

    index: Integers
    sure: Chosen
    bits: int


def read_code(differences: Sequence[Samples], ref: Reference) -> Code:
    """Decode: one vector bit − inverse (or 2·bit − white − black) per bit, most significant first."""
    stack = np.stack(differences)
    sure = ref.lit & (np.abs(stack) > 0.2 * ref.contrast).all(axis=0)
    return Code(gray_index(stack > 0), sure, len(stack))


def swapped_bit(code: Code) -> int | None:
    """Which bit was exchanged with its inverse, told from where more significant bits change.

    The first half of the sampled pixels lie beside the second half. Two pixels beside each other have close indices,
    also where a coarse bit changes, unless a finer bit is inverted: that mirrors the indices within each of its
    blocks, and mirroring them back closes the gap. What this cannot see: an exchange of the most significant bit, which
    mirrors everything and leaves no gap, and of the last two or three, whose gap is as small as a common step. Line
    frames show these (`line_fault`).
    """
    here, beside = code.index.reshape(2, -1)
    sure = code.sure.reshape(2, -1).all(axis=0)
    if not sure.any():
        return None
    here, beside = here[sure], beside[sure]
    step = max(1.0, float(np.percentile(np.abs(here - beside), 75)))
    words = to_gray(here) ^ to_gray(beside)
    for coarse in range(code.bits - 1):
        # Pairs whose most significant difference is this bit.
        crossing = words >> (code.bits - 1 - coarse) == 1
        if np.count_nonzero(crossing) < _CROSSINGS:
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

    def tells(self, where: Chosen) -> bool:
        """Whether these pixels, all of them sure, are enough of them and see several lines."""
        if np.count_nonzero(where) < BAND_SAMPLES:
            return False
        near, far = np.percentile(self.position[where], (5, 95))
        # A line that straddles two cells of half a period lights all cells alike.
        return bool(far - near >= _SPAN_PERIODS and np.ptp(self.light[where]) > 0)

    def lines(self, where: Chosen) -> int:
        """How many periods these pixels, all of them sure, lie in."""
        return len(np.unique(np.floor(self.position[where])))


def expect_lines(
    code: Code, ref: Reference, *, cell_px: int, offset_px: int, shift: int, period_px: int, width_px: int
) -> LineExpectation:
    """Turn decoded cells into the light of one line frame."""
    first_px = cell_px * code.index - offset_px
    inside_px = np.arange(cell_px)[:, np.newaxis]
    lit = (first_px + inside_px - shift) % period_px < width_px
    light = (np.count_nonzero(lit, axis=0) / cell_px).astype(np.float32)
    position = (first_px / period_px).astype(np.float32)
    position[~(code.sure & ref.judged)] = np.nan
    return LineExpectation(position, light)


def line_fault(
    frame: Samples, others: Sequence[Samples], ref: Reference, expected: LineExpectation, *, noise: float, duty: float
) -> tuple[bool, str | None]:
    """Compare a line frame with the Gray code and with the line frames before it.

    The frame must be bright where the code says that its lines are, and as bright in all as the others: together, n
    line frames of width w add up to w times white. Returns (whether the comparison could be made, what is wrong).

    duty : line width over period, the share of white that a line frame holds.
    """
    asked = ~np.isnan(expected.position)
    if not expected.tells(asked):
        return False, None
    share = _share(frame, ref, ref.judged)
    if share < 0.05 * duty:  # a soft scaler leaves a fifth of a narrow line, and less
        return (
            True,
            f"the frame holds {share:.1%} of white's light, lines should hold {duty:.1%}: it is dark; scan again",
        )
    typical = float(np.median([_share(other, ref, ref.judged) for other in others])) if others else share
    if not 0.4 * typical < share < 2.5 * typical:
        return True, (
            f"the frame holds {share:.1%} of white's light, the other line frames {typical:.1%}: it shows another "
            "pattern or was damaged; scan again"
        )
    rough = rougher(frame, others, ref, noise=noise) if others else None
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
        if not expected.tells(inside) or expected.lines(inside) < _BAND_LINES:
            continue
        here = _correlation(frame, ref, expected.light, inside)
        # Half of the samples lie beside the others and say little more than these.
        chance = 5 * (2 / np.count_nonzero(inside)) ** 0.5
        if here < 0.35 * agreement and here < agreement - chance:
            return True, (
                f"in {rows_of(ref, band)} its lines are not where the Gray code says: the frame was damaged in "
                "transfer; check the cable, and scan again"
            )
    return True, None


def line_sum(frames: Sequence[Samples], ref: Reference, *, noise: float) -> tuple[tuple[int, ...], str] | None:
    """Judge the sum of the n line frames of one axis, given by shift: those to blame and what is wrong, or None.

    Each place is lit by one frame as every other place is by another, so the sum is the same everywhere, also where a
    camera is not linear or a scaler blurs. To blame is a frame that the sum's error can be taken from with light left
    between black and white.
    """
    light = np.stack([ref.relative(frame) for frame in frames])
    total = light.sum(axis=0)
    off = total - np.median(total)
    spread = 1.4826 * float(np.median(np.abs(off)))
    slack = np.maximum(max(_LEAST_SUM_OFF, 6 * spread), 8 * noise * len(frames) ** 0.5 / ref.contrast[ref.judged])
    wrong = np.abs(off) > slack
    where = worst_judged(wrong, ref, whole=0.1)
    if where is None:
        return None
    without = (light - off)[:, wrong]
    outside = np.mean((without < -slack[wrong]) | (without > 1 + slack[wrong]), axis=1)
    blamed = tuple(int(each) for each in np.flatnonzero(outside <= outside.min() + _AS_MUCH_TO_BLAME))
    return blamed, (
        f"on {where} the line frames do not add up to what they do elsewhere: one of them was damaged in transfer or "
        "shows another pattern, or something moved; check the cable, and scan again"
    )


def line_order(frames: Sequence[Samples], ref: Reference, *, noise: float) -> tuple[bool, int | None]:
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


def _share(frame: Samples, ref: Reference, where: Chosen) -> float:
    return float(np.sum((frame - ref.black)[where]) / np.sum(ref.contrast[where]))


def _correlation(frame: Samples, ref: Reference, light: Samples, where: Chosen) -> float:
    seen = (frame - ref.black)[where]
    rest = seen - np.sum(seen) / np.sum(ref.contrast[where]) * ref.contrast[where]
    wanted = light[where] - np.mean(light[where])
    power = float(np.dot(rest, rest)) * float(np.dot(wanted, wanted))
    return float(np.dot(rest, wanted)) / power**0.5 if power > 0 else 0.0
