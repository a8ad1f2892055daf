"""The patterns of live depth: fine ones whose phase gives the position, and coarse ones that number its periods."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from slrig.devices import ProjectorInfo
from slrig.errors import PatternError
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Sine, Size, White, has_even_shifts

STEPS = 4
"""Shifts of a sinusoid. Three would do in a linear world; with four the second harmonic, which the projector's gamma
adds, does not reach the phase, and contradicts no pixel that stands still."""

PERIODS = 32
"""Fine periods across the projector: more are finer, and need a coarse phase with less noise to be numbered."""

_LEAST_PERIOD_PX = 8.0  # of a sinusoid that cameras resolve
_MARGIN = 1.06  # of the coarse period over the projector's extent, so that noise wraps no phase at its ends
_LINE_PERIOD_PX, _LINE_STEPS, _LINE_WIDTH_PX = 12, 6, 5
"""Of binary lines. Six steps keep harmonics 2 to 4 from the phase, and 5 of 12 pixels make little of the fifth."""

_CELL_PX = 6


@dataclass(frozen=True, slots=True)
class LivePlan:
    """Patterns of one cycle, in the order of play. fine, coarse, bits : their indices; the periods of the fine ones are
    numbered by a coarse sinusoid or by the bits of a Gray code. levels : white and black, between which a bit is lit;
    empty where the mean of the fine patterns is half-way.
    """

    axis: Axis
    patterns: tuple[Pattern, ...]
    fine: tuple[int, ...]
    coarse: tuple[int, ...] = ()
    bits: tuple[int, ...] = ()
    levels: tuple[int, ...] = ()

    @property
    def fine_px(self) -> float:
        """Period of the fine patterns, projector px."""
        pattern = self.patterns[self.fine[0]]
        return float(pattern.period_px) if isinstance(pattern, Sine | LineShift) else math.nan

    @property
    def coarse_px(self) -> float:
        """Period of the coarse sinusoid, projector px; NaN with a Gray code."""
        pattern = self.patterns[self.coarse[0]] if self.coarse else None
        return float(pattern.period_px) if isinstance(pattern, Sine) else math.nan

    def angle(self, index: int) -> float:
        """Phase, rad, at which a fine or coarse pattern is brightest."""
        pattern = self.patterns[index]
        if isinstance(pattern, Sine):
            return 2 * math.pi * pattern.shift / pattern.steps
        if isinstance(pattern, LineShift):
            return 2 * math.pi * pattern.centre_px / pattern.period_px
        message = f"pattern {index} of a live sequence has no phase"
        raise ValueError(message)


def live_plan(projector: ProjectorInfo, axis: Axis) -> LivePlan:
    """Return the patterns of an axis that this projector can repeat.

    Sinusoids where it shows shades of grey, else lines and Gray code; of a recording, what it has.

    Raises PatternError: a recording has no such patterns.
    """
    if projector.recorded:
        return _recorded_plan(projector, axis)
    return _sine_plan(projector.size, axis) if projector.shades else _line_plan(projector.size, axis)


def _sine_plan(size: Size, axis: Axis) -> LivePlan:
    extent_px = size.along(axis)
    fine_px, coarse_px = max(extent_px / PERIODS, _LEAST_PERIOD_PX), extent_px * _MARGIN
    patterns = [Sine(axis, period_px, shift, STEPS) for period_px in (fine_px, coarse_px) for shift in range(STEPS)]
    return LivePlan(axis, tuple(patterns), tuple(range(STEPS)), tuple(range(STEPS, 2 * STEPS)))


def _line_plan(size: Size, axis: Axis) -> LivePlan:
    bits = max(1, math.ceil(math.log2(size.along(axis) / _CELL_PX)))
    step_px = _LINE_PERIOD_PX // _LINE_STEPS
    lines = [LineShift(axis, step_px * k, _LINE_PERIOD_PX, _LINE_WIDTH_PX) for k in range(_LINE_STEPS)]
    code = [Gray(axis, bit, bits, _CELL_PX) for bit in range(bits)]
    count = len(lines)
    return LivePlan(axis, (*lines, *code), tuple(range(count)), bits=tuple(range(count, count + bits)))


def _recorded_plan(projector: ProjectorInfo, axis: Axis) -> LivePlan:
    sines: dict[float, list[Sine]] = defaultdict(list)
    lines: dict[tuple[int, int], list[LineShift]] = defaultdict(list)
    code: dict[tuple[int, int, int], list[Gray]] = defaultdict(list)
    for pattern in dict.fromkeys(projector.recorded):
        if isinstance(pattern, Sine) and pattern.axis is axis:
            sines[pattern.period_px].append(pattern)
        elif isinstance(pattern, LineShift) and pattern.axis is axis:
            lines[pattern.period_px, pattern.line_width_px].append(pattern)
        elif isinstance(pattern, Gray) and pattern.axis is axis and not pattern.inverted:
            code[pattern.bits, pattern.cell_px, pattern.offset_px].append(pattern)
    groups = [sorted(each, key=lambda sine: sine.shift) for each in sines.values()]
    whole = sorted((each for each in groups if len(each) == each[0].steps > 2), key=lambda each: each[0].period_px)
    even = [group for each in lines.values() if has_even_shifts(group := sorted(each, key=lambda line: line.shift))]
    codes = [sorted(each, key=lambda gray: gray.bit) for key, each in code.items() if len(each) == key[0]]
    fine: Sequence[Sine | LineShift] = whole[0] if whole else min(even, key=lambda each: each[0].period_px, default=())
    references: list[Pattern] = [pattern for pattern in (White(), Black()) if pattern in projector.recorded]
    if fine:
        period_px = fine[0].period_px
        narrow = isinstance(fine[0], LineShift) and not fine[0].is_half_lit
        for bits in codes:
            if 2 * bits[0].cell_px <= period_px and (not narrow or len(references) == 2):
                levels = references if narrow else []
                count, end = len(fine), len(fine) + len(bits)
                return LivePlan(
                    axis, (*fine, *bits, *levels), tuple(range(count)), bits=tuple(range(count, end)),
                    levels=tuple(range(end, end + len(levels))),
                )  # fmt: skip
        if whole and whole[-1][0].period_px >= projector.size.along(axis):
            count, both = len(fine), (*fine, *whole[-1])
            return LivePlan(axis, both, tuple(range(count)), tuple(range(count, len(both))))
    message = (
        f"live depth repeats three or more shifts of one period and what numbers the periods, {axis} patterns, and the "
        f"recording of '{projector.name}' has none that do: record a scan with lines or two sinusoids along that axis"
    )
    raise PatternError(message)
