"""What it takes to say of a frame that it is not what it claims: words for patterns, and contradictions as values."""

from __future__ import annotations

from dataclasses import dataclass

from slrig.model import Black, Gray, LineShift, Pattern, White


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
        case Gray():
            words = f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverted else ''}"
        case LineShift():
            words = f"{pattern.axis} lines, shift {pattern.shift} of {pattern.period_px}"
    return f"pattern {index} ({words})"


def place(camera: str, index: int, pattern: Pattern) -> str:
    """Words for a camera's frame of a pattern."""
    return f"camera '{camera}', {named(index, pattern)}"
