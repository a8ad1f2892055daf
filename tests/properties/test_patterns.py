"""What holds for every projector, cell, offset, period and line width."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.model import Axis, Gray, LineShift, Size
from slrig.model.patterns import gray_index, to_gray
from slrig.patterns.codes import (
    cell_centre_px,
    gray_bits,
    gray_profile,
    is_whole,
    line_count,
    line_number,
    line_position_px,
    line_profile,
)

few = settings(max_examples=30)


class Code(NamedTuple):
    """A Gray code on a projector of some extent."""

    extent_px: int
    cell_px: int
    offset_px: int
    axis: Axis

    @property
    def size(self) -> Size:
        return Size(self.extent_px, 3) if self.axis is Axis.COLUMN else Size(3, self.extent_px)

    @property
    def bits(self) -> int:
        return gray_bits(self.extent_px, self.cell_px, self.offset_px)


codes = st.builds(Code, st.integers(1, 2500), st.integers(1, 40), st.integers(0, 900), st.sampled_from(Axis))


@st.composite
def lines(draw: st.DrawFn) -> tuple[LineShift, int]:
    period_px = draw(st.integers(4, 40))
    pattern = LineShift(
        draw(st.sampled_from(Axis)),
        draw(st.integers(0, period_px - 1)),
        period_px,
        draw(st.integers(1, period_px - 1)),
    )
    return pattern, draw(st.integers(period_px, 2000))


def size_of(pattern: LineShift, extent_px: int) -> Size:
    return Size(extent_px, 2) if pattern.axis is Axis.COLUMN else Size(2, extent_px)


@few
@given(codes)
def test_decoding_undoes_encoding(code: Code) -> None:
    lit = np.stack(
        [
            gray_profile(Gray(code.axis, bit, code.bits, code.cell_px, code.offset_px), code.size).ravel() > 0
            for bit in range(code.bits)
        ]
    )
    expected = (np.arange(code.extent_px) + code.offset_px) // code.cell_px
    assert (gray_index(lit) == expected).all()


@few
@given(codes)
def test_neighbouring_positions_differ_in_at_most_one_bit_and_cells_in_exactly_one(code: Code) -> None:
    cells = (np.arange(code.extent_px) + code.offset_px) // code.cell_px
    words = to_gray(cells)
    changed = np.array([int(word).bit_count() for word in words[1:] ^ words[:-1]], dtype=int)
    assert (changed == np.diff(cells)).all()


@few
@given(lines())
def test_every_position_is_lit_by_line_width_of_the_n_frames(drawn: tuple[LineShift, int]) -> None:
    pattern, extent_px = drawn
    lit = sum(
        (
            line_profile(
                LineShift(pattern.axis, shift, pattern.period_px, pattern.line_width_px), size_of(pattern, extent_px)
            ).astype(int)
            // 255
            for shift in range(pattern.period_px)
        ),
        np.zeros(1, dtype=int),
    )
    assert (lit == pattern.line_width_px).all()


@few
@given(lines())
def test_whole_lines_are_those_lit_in_full_width_about_their_centre(drawn: tuple[LineShift, int]) -> None:
    pattern, extent_px = drawn
    light = line_profile(pattern, size_of(pattern, extent_px)).ravel() > 0
    count = line_count(pattern, extent_px)
    numbers = np.arange(-2, count + 3)
    whole = numbers[is_whole(numbers, pattern, extent_px)]
    assert whole.tolist() == list(range(count))
    first = line_position_px(whole, pattern) - (pattern.line_width_px - 1) / 2
    for start in first:
        assert light[int(start) : int(start) + pattern.line_width_px].all()
    # Nothing is lit beyond them but what the border has cut: less than a line at either end.
    assert 0 <= light.sum() - count * pattern.line_width_px <= 2 * (pattern.line_width_px - 1)


@few
@given(lines(), st.integers(0, 60), st.data())
def test_the_line_number_survives_a_code_edge_that_is_off_by_less_than_a_quarter_period(
    drawn: tuple[LineShift, int], offset_px: int, data: st.DataObject
) -> None:
    pattern, extent_px = drawn
    cell_px = pattern.period_px // 2
    numbers = np.arange(line_count(pattern, extent_px))
    limit = pattern.period_px / 4 - 1e-6
    error_px = data.draw(st.floats(-limit, limit))
    # A cell edge displaced by the error is a line seen displaced the other way. Positions are pixels: the light of
    # position c spans c − ½ to c + ½.
    seen_px = line_position_px(numbers, pattern) + error_px
    cells = np.floor((seen_px + 0.5 + offset_px) / cell_px)
    centres = cell_centre_px(cells, cell_px=cell_px, offset_px=offset_px)
    assert (line_number(centres, pattern) == numbers).all()
