"""Patterns of Gray code, and the positions of its cells and of the edges between them.

Position c (a projector column or row) lies in cell i = ⌊(c + offset)/cell⌋, whose code word is that of
`slrig.model.patterns`. Bit 0 is the most significant.

Six columns, three bits, most significant first:

>>> from slrig.model import Axis, Gray, Size
>>> for bit in range(3):
...     print(gray_profile(Gray(Axis.COLUMN, bit, 3), Size(6, 4))[0] // 255)
[0 0 0 0 1 1]
[0 0 1 1 1 1]
[0 1 1 0 0 1]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slrig.errors import PatternError
from slrig.model import Axis, FloatArray, Gray, Size
from slrig.model.patterns import to_gray


def gray_bits(extent_px: int, cell_px: int, offset_px: int) -> int:
    """Return the fewest bits that give every cell touched by positions 0 … extent − 1 a code word of its own.

    >>> gray_bits(1280, 4, 0)
    9
    """
    if extent_px < 1 or cell_px < 1 or offset_px < 0:
        raise PatternError(
            "a Gray code needs extent_px ≥ 1, cell_px ≥ 1 and offset_px ≥ 0; found "
            f"{extent_px}, {cell_px} and {offset_px}"
        )
    return max(1, ((extent_px - 1 + offset_px) // cell_px).bit_length())


def require_addressable(pattern: Gray, size: Size) -> None:
    """Refuse a code that does not fit its projector.
    Raises PatternError: the code has too few words for the projector's cells, or the projector is so small that the
    most significant bit never changes on it.
    """
    extent_px = size.along(pattern.axis)
    needed = gray_bits(extent_px, pattern.cell_px, pattern.offset_px)
    if needed == pattern.bits:
        return
    code = f"a Gray code of {pattern.bits} bits with cells of {pattern.cell_px} px and offset {pattern.offset_px} px"
    if needed > pattern.bits:
        message = (
            f"{code} ends at {pattern.axis} {pattern.cell_px * 2**pattern.bits - pattern.offset_px - 1}, the projector "
            f"has {extent_px} {pattern.axis}s ({size}): use {needed} bits, or correct the projector's size"
        )
    else:
        message = (
            f"the projector is smaller than the code: {code} needs more than "
            f"{pattern.cell_px * 2 ** (pattern.bits - 1) - pattern.offset_px} {pattern.axis}s, the projector has "
            f"{extent_px} ({size}): use {needed} bits, or correct the projector's size (width before height)"
        )
    raise PatternError(message)


def gray_profile(pattern: Gray, size: Size) -> NDArray[np.uint8]:
    """Light of one Gray bit: (1, Wp) uint8 for columns, (Hp, 1) for rows; 255 is lit, 0 dark.
    Raises PatternError: the code does not fit the projector.
    """
    require_addressable(pattern, size)
    words = to_gray((np.arange(size.along(pattern.axis)) + pattern.offset_px) // pattern.cell_px)
    lit = (words >> (pattern.bits - 1 - pattern.bit) & 1) != int(pattern.inverted)
    return along_axis(lit, pattern.axis)


def along_axis(lit: NDArray[np.bool_], axis: Axis) -> NDArray[np.uint8]:
    """Spread a (n,) bool profile to (1, n) for columns or (n, 1) for rows, uint8, 255 where lit."""
    profile = np.where(lit, np.uint8(255), np.uint8(0))
    return profile[np.newaxis, :] if axis is Axis.COLUMN else profile[:, np.newaxis]


def cell_centre_px(index: ArrayLike, *, cell_px: int, offset_px: int) -> FloatArray:
    """Position of the middle of each cell: cell·i + (cell − 1)/2 − offset, float64.

    >>> cell_centre_px([0, 1], cell_px=4, offset_px=0)
    array([1.5, 5.5])
    """
    return np.asarray(cell_px * np.asarray(index, dtype=np.float64) + (cell_px - 1) / 2 - offset_px)


def edge_position_px(index: ArrayLike, *, cell_px: int, offset_px: int) -> FloatArray:
    """Position of the edge between cells i − 1 and i: cell·i − offset − ½, float64.

    Pixel centres lie at integers, so the edge between positions 3 and 4 is at 3.5.

    >>> edge_position_px([1, 2], cell_px=4, offset_px=0)
    array([3.5, 7.5])
    """
    return np.asarray(cell_px * np.asarray(index, dtype=np.float64) - offset_px - 0.5)


def edge_indices(bit: int, bits: int) -> tuple[int, int]:
    """(first, spacing) of the cells at whose lower edge this bit changes: 2^s and 2^(s+1), s = bits − 1 − bit.

    Every edge between two cells belongs to exactly one bit.

    >>> [edge_indices(bit, 3) for bit in range(3)]
    [(4, 8), (2, 4), (1, 2)]
    """
    if not 0 <= bit < bits:
        raise PatternError(f"a code of {bits} bits has bits 0 (most significant) to {bits - 1}; asked for bit {bit}")
    first = int(2 ** (bits - 1 - bit))
    return first, 2 * first
