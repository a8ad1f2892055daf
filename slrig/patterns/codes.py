"""Patterns of Gray code and shifted lines, and the positions of cells, edges and lines.

Position c (a projector column or row) is in cell i = ⌊(c + offset)/cell⌋, whose code word is that of
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

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slrig.errors import PatternError
from slrig.model import Axis, FloatArray, Gray, IntArray, LineShift, Sine, Size, from_gray, to_gray

MIN_BORDER_DISTANCE_PX = 3.0
"""Least distance of a line's centre from the projector's first and last position, px: see `line_positions`."""


def gray_bits(extent_px: int, cell_px: int, offset_px: int) -> int:
    """Return the least number of bits with a code word for every cell of positions 0 … extent − 1.

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
    """Check that a code fits its projector.

    Raises PatternError if the code has too few words for the projector's cells, or the most significant bit never
    changes on a projector this small.
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

    Raises PatternError if the code does not fit the projector.
    """
    require_addressable(pattern, size)
    words = to_gray((np.arange(size.along(pattern.axis)) + pattern.offset_px) // pattern.cell_px)
    lit = (words >> (pattern.bits - 1 - pattern.bit) & 1) != int(pattern.inverted)
    return along_axis(lit, pattern.axis)


def along_axis(light: NDArray[np.bool_ | np.float64], axis: Axis) -> NDArray[np.uint8]:
    """Spread a (n,) profile, 0 dark to 1 lit, to (1, n) for columns or (n, 1) for rows, uint8, 0 dark to 255 lit."""
    profile: NDArray[np.uint8] = np.rint(np.round(255.0 * light, 9)).astype(np.uint8)
    return profile[np.newaxis, :] if axis is Axis.COLUMN else profile[:, np.newaxis]


def cell_centre_px(index: ArrayLike, *, cell_px: int, offset_px: int) -> FloatArray:
    """Position of the middle of each cell: cell·i + (cell − 1)/2 − offset, float64.

    >>> cell_centre_px([0, 1], cell_px=4, offset_px=0)
    array([1.5, 5.5])
    """
    return np.asarray(cell_px * np.asarray(index, dtype=np.float64) + (cell_px - 1) / 2 - offset_px)


def edge_position_px(index: ArrayLike, *, cell_px: int, offset_px: int) -> FloatArray:
    """Position of the edge between cells i − 1 and i: cell·i − offset − ½, float64.

    Pixel centres are integers, so the edge between positions 3 and 4 is at 3.5.

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
        raise PatternError(f"a code of {bits} bits has bits 0 (most significant) to {bits - 1}; found bit {bit}")
    first = int(2 ** (bits - 1 - bit))
    return first, 2 * first


def line_profile(pattern: LineShift, size: Size) -> NDArray[np.uint8]:
    """Light of one line frame: (1, Wp) uint8 for columns, (Hp, 1) for rows; 255 is lit, 0 dark.

    Raises PatternError if the projector is shorter than one period.
    """
    extent_px = size.along(pattern.axis)
    if extent_px < pattern.period_px:
        raise PatternError(
            f"the projector is smaller than one period of the line shift: it has {extent_px} {pattern.axis}s ({size}), "
            f"the period is {pattern.period_px} px; choose a shorter period, or correct the projector's size"
        )
    lit = (np.arange(extent_px) - pattern.shift) % pattern.period_px < pattern.line_width_px
    return along_axis(lit, pattern.axis)


def sine_profile(pattern: Sine, size: Size) -> NDArray[np.uint8]:
    """Light of one frame of a sinusoid: (1, Wp) uint8 for columns, (Hp, 1) for rows; 255 is lit, 0 dark.

    >>> from slrig.model import Axis, Sine, Size
    >>> sine_profile(Sine(Axis.COLUMN, 8.0, 0, 4), Size(8, 1))
    array([[255, 218, 128,  37,   0,  37, 128, 218]], dtype=uint8)
    """
    turns = np.arange(size.along(pattern.axis)) / pattern.period_px - pattern.shift / pattern.steps
    return along_axis(0.5 + 0.5 * np.cos(2 * np.pi * turns), pattern.axis)


def line_number(code_centre_px: ArrayLike, pattern: LineShift) -> NDArray[np.int64]:
    """Number of the line of a stripe: j = round((x − centre_k)/n), x the middle of its Gray cell.

    It is correct if the decoded cell is closer than n/2 to the line: with cells of ⌊n/2⌋ a code edge may be off by n/4.

    code_centre_px : middle of the decoded cell, cell·i + (cell − 1)/2 − offset (`cell_centre_px`); any shape, finite.
    Returns integers of the same shape; −1 or `line_count` and above mean a line that is cut by the projector's
    border or outside.

    >>> from slrig.model import Axis, LineShift
    >>> line_number([1.5, 9.5], LineShift(Axis.COLUMN, 1, 8))
    array([0, 1])
    """
    steps = (np.asarray(code_centre_px, dtype=np.float64) - pattern.centre_px) / pattern.period_px
    return np.rint(steps).astype(np.int64)


def line_position_px(number: ArrayLike, pattern: LineShift) -> FloatArray:
    """Position of the centre of line j: n·j + centre_k, float64.

    >>> from slrig.model import Axis, LineShift
    >>> line_position_px([0, 1], LineShift(Axis.COLUMN, 1, 8, line_width_px=2))
    array([1.5, 9.5])
    """
    return np.asarray(pattern.period_px * np.asarray(number, dtype=np.float64) + pattern.centre_px)


def line_count(pattern: LineShift, extent_px: int) -> int:
    """Return the number of whole lines of the frame on a projector of this extent; they are numbered from 0.

    >>> from slrig.model import Axis, LineShift
    >>> line_count(LineShift(Axis.COLUMN, 7, 8, line_width_px=2), 16)
    1
    """
    return max(0, (extent_px - pattern.line_width_px - pattern.shift) // pattern.period_px + 1)


def is_whole(number: ArrayLike, pattern: LineShift, extent_px: int) -> NDArray[np.bool_]:
    """True for each line j that is on the projector in its full width. A line cut by the border has another centre."""
    lines = np.asarray(number)
    return np.asarray((lines >= 0) & (lines < line_count(pattern, extent_px)))


def index_of_word(pattern: Gray) -> IntArray:
    """(2^bits,) int32: cell index of each code word."""
    return from_gray(np.arange(2**pattern.bits)).astype(np.int32)


def cell_count(pattern: Gray, size: Size) -> int:
    """Number of cells of the projector, from cell 0. Raises PatternError if the code does not fit it."""
    require_addressable(pattern, size)
    return (size.along(pattern.axis) - 1 + pattern.offset_px) // pattern.cell_px + 1


def cell_positions(pattern: Gray, size: Size) -> FloatArray:
    """(cells,) float64: middle of each cell, px."""
    return cell_centre_px(np.arange(cell_count(pattern, size)), cell_px=pattern.cell_px, offset_px=pattern.offset_px)


def line_positions(lines: Sequence[LineShift], pattern: Gray, size: Size) -> FloatArray:
    """(frames, cells) float64: centre of the line of a stripe in this frame at a pixel of this cell, px.

    NaN where the projector's border cuts the line, or is closer than MIN_BORDER_DISTANCE_PX to its centre. There the
    phase of all frames lacks light from one side, and white fades across the stripe: the stripe is displaced outwards.
    The phase is the argument of the sum of exp(2πi c/n) over the positions c whose light a pixel sees, so the width of
    lines does not matter. The limit is chosen for lenses in focus and up to 1.5 positions per camera px; at higher
    densities or with more blur, a few more lines are biased.
    """
    middle = cell_positions(pattern, size)
    return np.stack([_line_positions(line, middle, size.along(pattern.axis)) for line in lines])


def _line_positions(line: LineShift, middle: FloatArray, extent_px: int) -> FloatArray:
    number = line_number(middle, line)
    position = line_position_px(number, line)
    inside = np.minimum(position, extent_px - 1 - position) >= MIN_BORDER_DISTANCE_PX
    return np.where(is_whole(number, line, extent_px) & inside, position, np.nan)


def edge_positions(pattern: Gray, size: Size) -> FloatArray:
    """(bits, cells) float64: edge of a zero crossing of this bit at a pixel of this cell, px.

    A bit changes only at every 2^(s+1)-th edge, so the closest of those is meant: cells i - 1 and i both mean edge i.
    NaN if that edge is on the projector's border or beyond.
    """
    cells = np.arange(cell_count(pattern, size))
    return np.stack([_edge_positions(pattern, bit, cells, size.along(pattern.axis)) for bit in range(pattern.bits)])


def _edge_positions(pattern: Gray, bit: int, cells: NDArray[np.int64], extent_px: int) -> FloatArray:
    first, spacing = edge_indices(bit, pattern.bits)
    index = first + spacing * np.maximum(np.floor((cells + 0.5 - first) / spacing + 0.5), 0)
    position = edge_position_px(index, cell_px=pattern.cell_px, offset_px=pattern.offset_px)
    inside = (position > 0) & (position < extent_px - 1)
    return np.where(inside, position, np.nan)
