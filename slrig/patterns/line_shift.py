"""Line shift: n frames, each lighting every n-th projector line, together lighting every position equally often.

Frame k lights position c when (c − k) mod n < width (J. Gühring, ISPRS XIX B5, 2000). A Gray code of cells no wider
than half a period tells the lines of one frame apart; where a stripe lies inside its cell does not matter.

>>> from slrig.model import Axis, LineShift, Size
>>> for shift in range(4):
...     print(line_profile(LineShift(Axis.COLUMN, shift, 4), Size(8, 1))[0] // 255)
[1 0 0 0 1 0 0 0]
[0 1 0 0 0 1 0 0]
[0 0 1 0 0 0 1 0]
[0 0 0 1 0 0 0 1]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slrig.errors import PatternError
from slrig.model import FloatArray, LineShift, Size
from slrig.patterns.gray import along_axis


def line_profile(pattern: LineShift, size: Size) -> NDArray[np.uint8]:
    """Light of one line frame: (1, Wp) uint8 for columns, (Hp, 1) for rows; 255 is lit, 0 dark.
    Raises PatternError: the projector is shorter than one period.
    """
    extent_px = size.along(pattern.axis)
    if extent_px < pattern.period_px:
        raise PatternError(
            f"the projector is smaller than one period of the line shift: it has {extent_px} {pattern.axis}s ({size}), "
            f"the period is {pattern.period_px} px; choose a shorter period, or correct the projector's size"
        )
    lit = (np.arange(extent_px) - pattern.shift) % pattern.period_px < pattern.line_width_px
    return along_axis(lit, pattern.axis)


def line_number(code_centre_px: ArrayLike, pattern: LineShift) -> NDArray[np.int64]:
    """Which line of the frame a stripe is: j = round((x − centre_k)/n), x the middle of its Gray cell.

    Right as long as the cell that was read lies nearer than n/2 to the line: with cells of ⌊n/2⌋ a code edge may be
    off by n/4.

    code_centre_px : middle of the decoded cell, cell·i + (cell − 1)/2 − offset (`gray.cell_centre_px`); any shape,
    finite. Returns integers of the same shape; −1 or `line_count` and above mean a line that the projector cuts or does
    not have.

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
    """Return how many whole lines the frame has on a projector of this extent; they are numbered from 0.

    >>> from slrig.model import Axis, LineShift
    >>> line_count(LineShift(Axis.COLUMN, 7, 8, line_width_px=2), 16)
    1
    """
    return max(0, (extent_px - pattern.line_width_px - pattern.shift) // pattern.period_px + 1)


def is_whole(number: ArrayLike, pattern: LineShift, extent_px: int) -> NDArray[np.bool_]:
    """Whether each line j lies on the projector in its full width. A line cut by the border has another centre."""
    lines = np.asarray(number)
    return np.asarray((lines >= 0) & (lines < line_count(pattern, extent_px)))
