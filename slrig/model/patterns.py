"""Projector patterns, and the Gray code that they encode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slrig.errors import PatternError
from slrig.model.geometry import Axis, Pixels, Size

Integers = NDArray[np.integer[Any]]

MIN_LINE_STEPS = 3
"""Shifts of a line within a period: with two, the direction is ambiguous."""

MIN_SINE_PERIOD_PX = 4.0
"""Of a sinusoid: shorter ones are not sampled as such by whole pixels."""


def to_gray(index: ArrayLike) -> Integers:
    """Return the code word g = i ^ (i >> 1) of each cell index; integers of any shape.

    >>> [format(word, "03b") for word in to_gray([0, 1, 2, 3, 4, 5])]
    ['000', '001', '011', '010', '110', '111']
    """
    cells = np.asarray(index)
    return np.asarray(cells ^ (cells >> 1))


def from_gray(word: ArrayLike) -> Integers:
    """Return the cell index of each code word, inverting `to_gray`: bit s of i is the parity of g's bits from s on.

    >>> from_gray([0, 1, 3, 2, 6, 7])
    array([0, 1, 2, 3, 4, 5])
    """
    cells = np.array(word)
    # Prefix exclusive-or by doubling: after shifts of 1, 2, 4 … every bit is combined with all bits above it.
    shift = 1
    while shift < 8 * cells.itemsize:
        cells ^= cells >> shift
        shift *= 2
    return cells


def gray_index(lit: NDArray[np.bool_]) -> Integers:
    """Return the cell index of decoded bits: lit (bits, …) bool, most significant bit first.

    >>> gray_index(np.array([[False, True], [True, True], [False, True]]))
    array([3, 5])
    """
    weights = 2 ** np.arange(len(lit) - 1, -1, -1, dtype=np.int64)
    return from_gray(np.tensordot(weights, lit.astype(np.int64), axes=1))


class SequenceName(StrEnum):
    """Names of the predefined pattern sequences; `slrig.patterns.sequence.SEQUENCES` defines them."""

    FAST = "fast"
    STANDARD = "standard"
    ROBUST = "robust"
    PHASE = "phase"


@dataclass(frozen=True, slots=True)
class White:
    """Every projector pixel lit."""

    kind: Literal["white"] = "white"


@dataclass(frozen=True, slots=True)
class Black:
    """No projector pixel lit."""

    kind: Literal["black"] = "black"


@dataclass(frozen=True, slots=True)
class Primary:
    """Every projector pixel lit by one of the projector's own lights: red, green or blue."""

    colour: Literal["red", "green", "blue"]
    kind: Literal["primary"] = "primary"

    @property
    def description(self) -> str:
        """Description for messages."""
        return f"white in {self.colour} light"


@dataclass(frozen=True, slots=True)
class Gray:
    """One bit of a Gray code: lights position c when bit `bits - 1 - bit` of gray(⌊(c + offset_px)/cell_px⌋) is 1."""

    axis: Axis
    bit: int
    bits: int
    cell_px: int = 1
    offset_px: int = 0
    inverted: bool = False
    kind: Literal["gray"] = "gray"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 24 or not 0 <= self.bit < self.bits or self.cell_px < 1 or self.offset_px < 0:
            raise PatternError(
                f"gray pattern: need 1 ≤ bits ≤ 24, 0 ≤ bit < bits, cell_px ≥ 1, offset_px ≥ 0; found bit {self.bit} "
                f"of {self.bits}, cell {self.cell_px} px, offset {self.offset_px} px"
            )

    @property
    def inverse(self) -> Gray:
        """The same bit with lit and dark exchanged."""
        return replace(self, inverted=not self.inverted)

    @property
    def as_lines(self) -> LineShift | None:
        """The identical line pattern, half as wide as its period; None for the first bit, which lights one side."""
        if self.bit == 0:
            return None
        run_px = self.cell_px << (self.bits - self.bit)
        shift = (run_px // 2 - self.offset_px + run_px * self.inverted) % (2 * run_px)
        return LineShift(self.axis, shift, 2 * run_px, run_px)


@dataclass(frozen=True, slots=True)
class LineShift:
    """One frame of shifted lines: lights position c when (c - shift) mod period < line width."""

    axis: Axis
    shift: int
    period_px: int
    line_width_px: int = 1
    kind: Literal["line_shift"] = "line_shift"

    def __post_init__(self) -> None:
        if self.period_px < 4 or not 0 <= self.shift < self.period_px or not 1 <= self.line_width_px < self.period_px:
            raise PatternError(
                "line shift pattern: need period ≥ 4, 0 ≤ shift < period, 1 ≤ line width < period; found shift "
                f"{self.shift}, period {self.period_px}, width {self.line_width_px}"
            )

    @property
    def centre_px(self) -> float:
        """Position of the first line's centre: shift + (width - 1)/2."""
        return self.shift + (self.line_width_px - 1) / 2

    @property
    def is_half_lit(self) -> bool:
        """True if the lines are half as wide as their period."""
        return 2 * self.line_width_px == self.period_px

    @property
    def inverse(self) -> LineShift | None:
        """The lines with lit and dark exchanged; None unless they are half as wide as their period."""
        return replace(self, shift=(self.shift + self.line_width_px) % self.period_px) if self.is_half_lit else None


@dataclass(frozen=True, slots=True)
class Sine:
    """One frame of a shifted sinusoid: lights position c by ½ + ½ cos 2π(c/period_px − shift/steps).

    steps : equal parts of the period in which `shift` counts; 1 for a period that is played without shifts.
    """

    axis: Axis
    period_px: float
    shift: int
    steps: int
    kind: Literal["sine"] = "sine"

    def __post_init__(self) -> None:
        if not self.period_px >= MIN_SINE_PERIOD_PX or self.steps < 1 or not 0 <= self.shift < self.steps:
            raise PatternError(
                f"sine pattern: need period ≥ {MIN_SINE_PERIOD_PX:g} px, steps ≥ 1, 0 ≤ shift < steps; found period "
                f"{self.period_px:g} px, shift {self.shift} of {self.steps} steps"
            )

    @property
    def inverse(self) -> Sine | None:
        """The sinusoid half a period further; None if that is not a whole number of steps."""
        if self.steps % 2:
            return None
        return replace(self, shift=(self.shift + self.steps // 2) % self.steps)


def sine_groups(patterns: Sequence[Sine]) -> list[list[int]]:
    """Return the indices of the frames of each period with three or more shifts, the finest period first.

    Such frames alone give level, modulation and phase of a pixel.
    """
    periods = sorted({each.period_px for each in patterns})
    members = [[i for i, each in enumerate(patterns) if each.period_px == period] for period in periods]
    return [each for each in members if len({patterns[i].shift / patterns[i].steps for i in each}) >= MIN_LINE_STEPS]


def has_even_shifts(lines: Sequence[LineShift]) -> bool:
    """True if the shifts divide the period evenly into three or more steps. lines : sorted by shift."""
    count = len(lines)
    if count < MIN_LINE_STEPS or lines[0].period_px % count:
        return False
    step_px = lines[0].period_px // count
    return all(line.shift == k * step_px and line.period_px == lines[0].period_px for k, line in enumerate(lines))


def coarse_bit_count(bits: int) -> int:
    """Return how many of the first bits are coarse: few pixels are at their edges, so that the others show the noise.

    Half of the bits, at least three, which a variance needs.
    """
    return max(3, bits // 2)


def diagnostic_bits(bits: int) -> tuple[int, ...]:
    """Return the bits that characterise a camera as well as all bits do: the coarse ones, which show the noise, and the
    two finest, whose edges show compression and a non-linear response.
    """
    return tuple(sorted({*range(min(coarse_bit_count(bits), bits)), *range(max(bits - 2, 0), bits)}))


def diagnostic_line_pairs(lines: Sequence[LineShift]) -> tuple[tuple[LineShift, LineShift], ...]:
    """Return two pairs of lines and their inverses, about a quarter of a period apart, that characterise a camera:
    where one pair has edges, the other has none. Empty without such pairs.

    lines : of one axis, period and width.
    """
    available = set(lines)
    candidates = [(line, line.inverse) for line in sorted(lines, key=lambda each: each.shift)[: len(lines) // 2]]
    pairs = [(line, inverse) for line, inverse in candidates if inverse in available and inverse is not None]
    return (pairs[0], pairs[len(pairs) // 2]) if len(pairs) > 1 else ()


Pattern = White | Black | Primary | Gray | LineShift | Sine


@dataclass(frozen=True, slots=True)
class PatternSequence:
    """Patterns in display order, with the image of each.

    profiles : one (1, Wp), (Hp, 1) or (1, 1) uint8 array for each pattern, which varies along one axis only; `image`
    broadcasts it to the projector's size.
    """

    projector: Size
    patterns: tuple[Pattern, ...]
    profiles: tuple[Pixels, ...]

    def __post_init__(self) -> None:
        if len(self.patterns) != len(self.profiles):
            message = f"a sequence needs one profile per pattern, found {len(self.patterns)} and {len(self.profiles)}"
            raise ValueError(message)
        for profile in self.profiles:
            np.broadcast_shapes(profile.shape, self.projector.shape)

    def __len__(self) -> int:
        return len(self.patterns)

    def image(self, index: int) -> Pixels:
        """(Hp, Wp) uint8, a read-only view: the image of pattern `index`."""
        return np.broadcast_to(self.profiles[index], self.projector.shape)
