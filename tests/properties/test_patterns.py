"""What holds for every projector, cell, offset, period and line width."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.model import Axis, Gray, LineShift, Sine, Size
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
from slrig.patterns.sequence import encode, phase_patterns
from slrig.patterns.sine_positions import sine_periods_px, sine_position_px, sine_turns

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


sines = st.tuples(st.integers(1, 3000), st.integers(4, 64))


@few
@given(sines, st.integers(3, 8), st.sampled_from(Axis))
def test_played_sinusoids_number_every_position(drawn: tuple[int, int], steps: int, axis: Axis) -> None:
    extent_px, period_px = drawn
    size = Size(extent_px, 1) if axis is Axis.COLUMN else Size(1, extent_px)
    patterns = phase_patterns(
        size, period_px=period_px, steps=steps, rows=axis is Axis.ROW, columns=axis is Axis.COLUMN
    )
    light = np.array([profile.ravel() for profile in encode(patterns[2:], size).profiles], np.float64)
    periods_px = [each.period_px for each in patterns if isinstance(each, Sine) and each.shift == 0]
    found = sine_position_px([sine_turns(each) for each in light.reshape(3, steps, -1)], periods_px, extent_px)
    # All that is lost is the rounding to 8 bits.
    np.testing.assert_allclose(found.position_px, np.arange(extent_px), atol=0.003 * period_px)
    assert found.residual_turns.max() < 0.003


@few
@given(sines, st.integers(0, 2**32 - 1))
def test_phases_are_numbered_rightly_however_they_err_within_the_margin(drawn: tuple[int, int], seed: int) -> None:
    extent_px, period_px = drawn
    random = np.random.default_rng(seed)
    periods_px = np.array(sine_periods_px(extent_px, period_px))
    position_px = random.uniform(0, extent_px - 1, 2000)
    error = random.normal(size=(3, 2000))
    count = max(3, -(-extent_px // period_px) + 1)
    error *= 0.33 / np.sqrt(count) / np.linalg.norm(error, axis=0)
    found = sine_position_px(position_px / periods_px[:, None] + error, periods_px, extent_px)
    assert np.abs(found.position_px - position_px).max() < period_px / 2


def test_a_phase_that_is_unknown_has_no_position() -> None:
    found = sine_position_px([[np.nan, 0.0], [0.0, 0.0], [0.0, 0.0]], sine_periods_px(640, 12), 640)
    assert np.isnan(found.position_px).tolist() == np.isnan(found.residual_turns).tolist() == [True, False]
