"""From what a scan asks for to the patterns it plays, and from patterns to light."""

from __future__ import annotations

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
    Size,
    White,
    diagnostic_bits,
    diagnostic_line_pairs,
)
from slrig.patterns.codes import gray_bits, gray_profile, line_profile

GRAY_ONLY_CELL_PX = 2
"""Where edges are all that is measured, those of 1 px blur into one another at one or two camera pixels to a cell. Of
the rendered plane the rms is 19.2 µm with cells of 1 px and 4.2 µm with 2; behind a scaler 24.5 and 4.2. Of the demo's
scene it is 19.1, 13.5 and 14.3 µm with 1, 2 and 3 px, and 2 px cover most."""


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """What a named sequence plays.

    period_px : of the lines; steps : into how many shifts the period is divided, None for one of each pixel.
    line_width_px : None for half of the period. inverses : whether each bit is followed by its inverse. closing : how
    many of white and black end the sequence.
    """

    period_px: int
    steps: int | None
    line_width_px: int | None
    inverses: bool
    closing: int


SEQUENCES: Mapping[SequenceName, SequenceOptions] = {
    SequenceName.FAST: SequenceOptions(period_px=6, steps=3, line_width_px=None, inverses=False, closing=0),
    SequenceName.STANDARD: SequenceOptions(period_px=8, steps=None, line_width_px=None, inverses=False, closing=1),
    SequenceName.ROBUST: SequenceOptions(period_px=8, steps=None, line_width_px=None, inverses=True, closing=2),
}
"""Chosen by `tests/bench/line_sweep.py` and proven by `tests/bench/fault_campaign.py`; `slrig/scan/README.md` has what
each costs and gives.
"""


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

    White, black; for columns, then for rows, as far as they are asked for, code and lines; white, black again, as far
    as `closing` says. What tells how a camera sees comes first, `diagnostic_bits` and without inverses
    `diagnostic_line_pairs`, so that stripes are found while the bits come that only number them.

    size : the projector. line_shift : False leaves the line frames out: a Gray-only scan. period_px : n. steps : the
    number of line frames, which divide the period evenly; None stands for n. line_width_px : of a line; None stands for
    ⌊n/2⌋: of all widths it has the strongest first harmonic at a given exposure, 4/π of a sine's, and frames half a
    period apart are each other's inverse. gray_cell_px : None stands for ⌊n/2⌋, or `GRAY_ONLY_CELL_PX` without line
    shift. gray_offset_px : added to a position before it is cut into cells: moves the cell edges. rows, columns : the
    axes to play. inverses : each bit is followed by its inverse. coloured_light : white in red, green and blue as well,
    each between two of the last frames of code: so an old frame in the place of any of them, or of the one after it,
    does not pass for it.

    Raises PatternError: a code that cannot tell the lines of one frame apart, steps that do not divide the period, or a
    pattern that does not fit the projector.

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
    ends: tuple[Pattern, ...] = (White(), Black())
    middle: list[Pattern] = []
    for axis in [each for each, played in ((Axis.COLUMN, columns), (Axis.ROW, rows)) if played]:
        shifts = range(0, period_px, period_px // steps) if line_shift else ()
        lines = [LineShift(axis, shift, period_px, width_px) for shift in shifts]
        first = list(chain.from_iterable(diagnostic_line_pairs(lines)))
        code = _gray_patterns(axis, size.along(axis), cell_px, gray_offset_px, inverses=inverses)
        telling = diagnostic_bits(code[0].bits)
        middle += [each for each in code if each.bit in telling]
        middle += [*first, *(line for line in lines if line not in first)] if not inverses else lines
        middle += [each for each in code if each.bit not in telling]
    if coloured_light:
        between = [at for at, pair in enumerate(pairwise(middle), 1) if all(isinstance(each, Gray) for each in pair)]
        for light, at in zip((Primary("blue"), Primary("green"), Primary("red")), reversed(between), strict=False):
            middle.insert(at, light)
    return (*ends, *middle, *ends[:closing])


def _gray_patterns(axis: Axis, extent_px: int, cell_px: int, offset_px: int, *, inverses: bool) -> list[Gray]:
    bits = gray_bits(extent_px, cell_px, offset_px)
    kinds = (False, True) if inverses else (False,)
    return [Gray(axis, bit, bits, cell_px, offset_px, inverted) for bit in range(bits) for inverted in kinds]


def united(sequences: Sequence[PatternSequence]) -> PatternSequence:
    """Return every pattern of some sequences once, in the order in which they come: what lights alike is one pattern.
    Raises PatternError: there are none, or they are for different projectors.
    """
    sizes = {sequence.projector for sequence in sequences}
    if len(sizes) != 1:
        raise PatternError(f"asked to unite patterns for one projector, found {len(sizes)}; encode them for one size")
    kept: dict[tuple[tuple[int, ...], bytes], tuple[Pattern, NDArray[np.uint8]]] = {}
    for sequence in sequences:
        for pattern, light in zip(sequence.patterns, sequence.profiles, strict=True):
            kept.setdefault((light.shape, light.tobytes()), (pattern, light))
    patterns, profiles = zip(*kept.values(), strict=True)
    return PatternSequence(sizes.pop(), patterns, profiles)


def profile(pattern: Pattern, size: Size) -> NDArray[np.uint8]:
    """Light of one pattern: (1, 1), (1, Wp) or (Hp, 1) uint8. Raises PatternError when it does not fit."""
    match pattern:
        case White() | Primary():
            return np.full((1, 1), 255, dtype=np.uint8)
        case Black():
            return np.zeros((1, 1), dtype=np.uint8)
        case Gray():
            return gray_profile(pattern, size)
        case LineShift():
            return line_profile(pattern, size)


def encode(patterns: Sequence[Pattern], size: Size) -> PatternSequence:
    """Turn patterns into light for a projector of this size; a few kilobytes, since each varies along one axis only.
    Raises PatternError: the list is empty, or a pattern does not fit the projector.
    """
    if not patterns:
        raise PatternError("a sequence needs at least one pattern, found none; see scan_patterns")
    return PatternSequence(size, tuple(patterns), tuple(profile(pattern, size) for pattern in patterns))
