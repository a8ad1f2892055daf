"""What light means: the projector position of a stripe or code edge, for every code cell its pixel may show.

These tables are all that the reconstruction needs to know of the patterns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Gray, IntArray, LineShift, Size
from slrig.model.patterns import from_gray
from slrig.patterns.gray import cell_centre_px, edge_indices, edge_position_px, require_addressable
from slrig.patterns.line_shift import is_whole, line_number, line_position_px

LEAST_FROM_BORDER_PX = 3.0
"""How far a line's centre has to be from the projector's first and last position, px: see `line_positions`."""


def index_of_word(pattern: Gray) -> IntArray:
    """(2^bits,) int32: the cell index of each code word."""
    return from_gray(np.arange(2**pattern.bits)).astype(np.int32)


def cell_count(pattern: Gray, size: Size) -> int:
    """How many cells the projector shows, counted from cell 0. Raises PatternError when the code does not fit it."""
    require_addressable(pattern, size)
    return (size.along(pattern.axis) - 1 + pattern.offset_px) // pattern.cell_px + 1


def cell_positions(pattern: Gray, size: Size) -> FloatArray:
    """(cells,) float64: the middle of each cell, px."""
    return cell_centre_px(np.arange(cell_count(pattern, size)), cell_px=pattern.cell_px, offset_px=pattern.offset_px)


def line_positions(lines: Sequence[LineShift], pattern: Gray, size: Size) -> FloatArray:
    """(frames, cells) float64: centre of the line that a stripe of this frame is when its pixel shows this cell, px.

    NaN where the projector's border cuts the line, or lies nearer than LEAST_FROM_BORDER_PX to its centre. There the
    phase of all frames lacks the light that it counts on from both sides, and white fades across the stripe that it
    normalises: the stripe is found outwards of its place. The phase is the argument of the sum of exp(2πi c/n) over the
    positions c whose light a pixel sees, so the lines' width does not matter. Measured on a rendered plane that is
    larger than the projector's field, SNR 40, bias / stated deviation in camera px of lines at 1 to 5 positions from
    the border's:

    ============  ================  =========  =========  =========  =========  =========
    lenses' blur  positions per px  1          2          3          4          5
    ============  ================  =========  =========  =========  =========  =========
    0.6 px        0.5               .042/.028  .003/.019  .000/.018  .001/.018  .001/.018
    0.6 px        1.3               .149/.043  .049/.028  .000/.023  .003/.010  .000/.008
    0.9 px        1.3               .558/.092  .129/.065  .013/.030  .011/.018  .003/.011
    0.6 px        2.0               .123/.036  .053/.022  .026/.016  .009/.015  .001/.014
    1.4 px        1.3               1.52/.108  .218/.031  .071/.031  .073/.038  .036/.022
    ============  ================  =========  =========  =========  =========  =========

    Leaving out 0, 1 and 2 is enough with lenses in focus and up to 1.5 positions per px. Beyond that a few more lines
    are biased by more than they state: how far the light of a position spreads is not known here.
    """
    middle = cell_positions(pattern, size)
    return np.stack([_line_positions(line, middle, size.along(pattern.axis)) for line in lines])


def _line_positions(line: LineShift, middle: FloatArray, extent_px: int) -> FloatArray:
    number = line_number(middle, line)
    position = line_position_px(number, line)
    inside = np.minimum(position, extent_px - 1 - position) >= LEAST_FROM_BORDER_PX
    return np.where(is_whole(number, line, extent_px) & inside, position, np.nan)


def edge_positions(pattern: Gray, size: Size) -> FloatArray:
    """(bits, cells) float64: the edge that a zero crossing of this bit is when its pixel shows this cell, px.

    A bit changes at every 2^(s+1)-th edge only, so the nearest of those is meant: cells i - 1 and i both name edge i.
    NaN where that edge lies on the projector's border or beyond.
    """
    cells = np.arange(cell_count(pattern, size))
    return np.stack([_edge_positions(pattern, bit, cells, size.along(pattern.axis)) for bit in range(pattern.bits)])


def _edge_positions(pattern: Gray, bit: int, cells: NDArray[np.int64], extent_px: int) -> FloatArray:
    first, spacing = edge_indices(bit, pattern.bits)
    index = first + spacing * np.maximum(np.floor((cells + 0.5 - first) / spacing + 0.5), 0)
    position = edge_position_px(index, cell_px=pattern.cell_px, offset_px=pattern.offset_px)
    inside = (position > 0) & (position < extent_px - 1)
    return np.where(inside, position, np.nan)
