"""Pattern sequences: the patterns of a scan by its options, and the light of patterns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import (
    MIN_LINE_STEPS,
    Axis,
    Black,
    Gray,
    LineShift,
    Pattern,
    PatternSequence,
    Primary,
    SequenceName,
    Sine,
    Size,
    White,
    diagnostic_bits,
    diagnostic_line_pairs,
)
from slrig.patterns.codes import gray_bits, gray_profile, line_profile, sine_profile
from slrig.patterns.sine_positions import sine_periods_px

CROSS_LINE_WIDTH_PX = 16
"""Chosen: a calibration that predicts the nearest edge to half of it numbers the edges."""
GRAY_ONLY_CELL_PX = 2
"""Chosen: without lines edges are all that is measured, and those of cells of 1 px blur into each other."""


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """Patterns of a named sequence.

    period_px : of the lines, or of the shortest sinusoid; steps : number of shifts of a period, None for one per pixel.
    line_width_px : None for half of the period. inverses : True if each bit is followed by its inverse. closing :
    number of white and black frames at the end. sines : True for sinusoids in place of code and lines.
    """

    period_px: int
    steps: int | None
    line_width_px: int | None
    inverses: bool
    closing: int
    sines: bool = False


SEQUENCES: Mapping[SequenceName, SequenceOptions] = {
    SequenceName.FAST: SequenceOptions(period_px=6, steps=3, line_width_px=None, inverses=False, closing=0),
    SequenceName.STANDARD: SequenceOptions(period_px=8, steps=None, line_width_px=None, inverses=False, closing=1),
    SequenceName.ROBUST: SequenceOptions(period_px=8, steps=None, line_width_px=None, inverses=True, closing=2),
    # Four steps: each frame has its inverse, and the harmonics that gamma adds hardly reach the phase. Three take less
    # time where gamma is known or fitted.
    SequenceName.PHASE: SequenceOptions(
        period_px=8, steps=4, line_width_px=None, inverses=False, closing=0, sines=True
    ),
}
"""`slrig/scan/README.md` lists the reasons for them, with costs and results."""


def scan_patterns(
    size: Size,
    *,
    line_shift: bool,
    period_px: int,
    steps: int | None = None,
    line_width_px: int | None,
    gray_cell_px: int | None,
    gray_offset_px: int,
    rows: bool,
    columns: bool = True,
    coloured_light: bool = False,
    inverses: bool = True,
    closing: int = 2,
) -> tuple[Pattern, ...]:
    """List the patterns of one scan in the order of play.

    White, black; code and lines of the requested axes, columns first; white and black again, by `closing`. Patterns
    that show the response of the camera come first, `diagnostic_bits` and without inverses `diagnostic_line_pairs`, so
    that stripes can be located while the remaining bits, which only number them, are played.

    size : of the projector. line_shift : False for a scan without line frames. period_px : n. steps : number of line
    frames, which divide the period evenly; None for n. line_width_px : of a line; None for ⌊n/2⌋, the width with the
    strongest first harmonic at a given exposure, 4/π of a sine's, for which frames half a period apart are inverse to
    each other. gray_cell_px : None for ⌊n/2⌋, or `GRAY_ONLY_CELL_PX` without line shift. gray_offset_px : added to a
    position before division into cells; moves the cell edges. rows, columns : axes to play. inverses : follow each bit
    by its inverse. coloured_light : add white in red, green and blue, each between two of the last code frames, so that
    a stale frame cannot pass for one of them or for the next.

    Raises PatternError if the code cannot distinguish the lines of one frame, steps do not divide the period, or a
    pattern does not fit the projector.

    >>> options = dict(line_width_px=None, gray_cell_px=None, gray_offset_px=0, rows=False)
    >>> patterns = scan_patterns(Size(1280, 800), line_shift=True, period_px=8, **options)
    >>> len(patterns), patterns[2]
    (30, Gray(axis=<Axis.COLUMN: 'column'>, bit=0, bits=9, cell_px=4, offset_px=0, inverted=False, kind='gray'))
    """
    cell_px = gray_cell_px if gray_cell_px is not None else (period_px // 2 if line_shift else GRAY_ONLY_CELL_PX)
    if line_shift and 2 * cell_px > period_px:
        raise PatternError(
            f"a Gray cell of {cell_px} px cannot number lines that are {period_px} px apart: a cell edge that is "
            f"slightly off moves a stripe by a whole period; use gray_cell_px ≤ {period_px // 2} or a longer period"
        )
    steps = period_px if steps is None else steps
    if line_shift and (steps < MIN_LINE_STEPS or period_px % steps):
        raise PatternError(
            f"lines {period_px} px apart cannot be shifted in {steps} equal steps of whole pixels; use a number from "
            f"{MIN_LINE_STEPS} on that divides the period, or a period that is a multiple of "
            f"{max(steps, MIN_LINE_STEPS)}"
        )
    width_px = line_width_px if line_width_px is not None else period_px // 2
    reference: tuple[Pattern, ...] = (White(), Black())
    body: list[Pattern] = []
    for axis in [each for each, played in ((Axis.COLUMN, columns), (Axis.ROW, rows)) if played]:
        shifts = range(0, period_px, period_px // steps) if line_shift else ()
        lines = [LineShift(axis, shift, period_px, width_px) for shift in shifts]
        first = list(chain.from_iterable(diagnostic_line_pairs(lines)))
        code = _gray_patterns(axis, size.along(axis), cell_px, gray_offset_px, inverses=inverses)
        diagnostic = diagnostic_bits(code[0].bits)
        body += [each for each in code if each.bit in diagnostic]
        body += [*first, *(line for line in lines if line not in first)] if not inverses else lines
        body += [each for each in code if each.bit not in diagnostic]
    if coloured_light:
        _insert_lights(body)
    return (*reference, *body, *reference[:closing])


def phase_patterns(
    size: Size, *, period_px: float, steps: int | None, rows: bool, columns: bool = True, coloured_light: bool = False
) -> tuple[Pattern, ...]:
    """List the patterns of one scan by sinusoids in the order of play.

    White, black; of each requested axis, columns first, three sinusoids in all their shifts, whose periods number every
    position of the axis; see `sine_periods_px`.

    size : of the projector. period_px : of the shortest sinusoid. steps : shifts of each; None for one per pixel.
    coloured_light : as of `scan_patterns`.

    Raises PatternError if there are too few steps, or the period is too short.

    >>> patterns = phase_patterns(Size(1280, 800), period_px=12, steps=4, rows=False)
    >>> len(patterns), patterns[2]
    (14, Sine(axis=<Axis.COLUMN: 'column'>, period_px=12.0, shift=0, steps=4, kind='sine'))
    """
    steps = math.ceil(period_px) if steps is None else steps
    if steps < MIN_LINE_STEPS:
        raise PatternError(
            f"a sinusoid in {steps} steps has no phase: use {MIN_LINE_STEPS} or more; with 4 the projector's gamma "
            "hardly matters"
        )
    body: list[Pattern] = [
        Sine(axis, each_px, shift, steps)
        for axis, played in ((Axis.COLUMN, columns), (Axis.ROW, rows))
        if played
        for each_px in sine_periods_px(size.along(axis), period_px)
        for shift in range(steps)
    ]
    if coloured_light:
        _insert_lights(body)
    return (White(), Black(), *body)


def with_cross_lines(patterns: Sequence[Pattern], axis: Axis) -> tuple[Pattern, ...]:
    """Insert one frame of lines along an axis that is not played otherwise, which tests the calibration.

    It follows the first two frames, white and black.
    """
    lines = LineShift(axis, 0, 2 * CROSS_LINE_WIDTH_PX, CROSS_LINE_WIDTH_PX)
    return (*patterns[:2], lines, *patterns[2:])


def _insert_lights(body: list[Pattern]) -> None:
    """Insert white in red, green and blue, each between two of the last frames of code or of sinusoids."""
    gaps = [
        index for index, pair in enumerate(pairwise(body), 1) if all(isinstance(each, Gray | Sine) for each in pair)
    ]
    for light, index in zip((Primary("blue"), Primary("green"), Primary("red")), reversed(gaps), strict=False):
        body.insert(index, light)


def _gray_patterns(axis: Axis, extent_px: int, cell_px: int, offset_px: int, *, inverses: bool) -> list[Gray]:
    bits = gray_bits(extent_px, cell_px, offset_px)
    kinds = (False, True) if inverses else (False,)
    return [Gray(axis, bit, bits, cell_px, offset_px, inverted) for bit in range(bits) for inverted in kinds]


def merge_sequences(sequences: Sequence[PatternSequence]) -> PatternSequence:
    """Return every pattern of some sequences once, in order of appearance; patterns with the same light are one.

    Raises PatternError if there are none, or they are for different projectors.
    """
    sizes = {sequence.projector for sequence in sequences}
    if len(sizes) != 1:
        raise PatternError(f"expected patterns for one projector, found {len(sizes)}; encode them for one size")
    unique: dict[tuple[tuple[int, ...], bytes], tuple[Pattern, NDArray[np.uint8]]] = {}
    for sequence in sequences:
        for pattern, light in zip(sequence.patterns, sequence.profiles, strict=True):
            unique.setdefault((light.shape, light.tobytes()), (pattern, light))
    patterns, profiles = zip(*unique.values(), strict=True)
    return PatternSequence(sizes.pop(), patterns, profiles)


def profile(pattern: Pattern, size: Size) -> NDArray[np.uint8]:
    """Light of one pattern: (1, 1), (1, Wp) or (Hp, 1) uint8. Raises PatternError if it does not fit."""
    match pattern:
        case White() | Primary():
            return np.full((1, 1), 255, dtype=np.uint8)
        case Black():
            return np.zeros((1, 1), dtype=np.uint8)
        case Gray():
            return gray_profile(pattern, size)
        case LineShift():
            return line_profile(pattern, size)
        case Sine():
            return sine_profile(pattern, size)


def encode(patterns: Sequence[Pattern], size: Size) -> PatternSequence:
    """Encode patterns as light for a projector of this size; a few kilobytes, since each varies along one axis only.

    Raises PatternError if the list is empty, or a pattern does not fit the projector.
    """
    if not patterns:
        raise PatternError("a sequence needs at least one pattern, found none; see scan_patterns")
    return PatternSequence(size, tuple(patterns), tuple(profile(pattern, size) for pattern in patterns))
