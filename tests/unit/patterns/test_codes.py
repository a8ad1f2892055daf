"""Gray code and line shift against truths small enough to write down; properties are in tests/properties."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import Axis, Gray, LineShift, Size
from slrig.model.patterns import from_gray, to_gray
from slrig.patterns.codes import (
    edge_indices,
    gray_bits,
    gray_profile,
    is_whole,
    line_count,
    line_profile,
    require_addressable,
)


def test_three_bits_are_the_table_in_every_textbook() -> None:
    assert to_gray(np.arange(8)).tolist() == [0b000, 0b001, 0b011, 0b010, 0b110, 0b111, 0b101, 0b100]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.int64])
def test_from_gray_undoes_to_gray_in_every_integer_width(dtype: type[np.generic]) -> None:
    index = np.arange(2**8 if dtype is np.uint8 else 2**16, dtype=dtype)
    assert (from_gray(to_gray(index)) == index).all()


def test_a_profile_varies_along_its_axis_only() -> None:
    assert gray_profile(Gray(Axis.COLUMN, 0, 3), Size(8, 5)).shape == (1, 8)
    assert gray_profile(Gray(Axis.ROW, 0, 3), Size(5, 8)).shape == (8, 1)


def test_cell_and_offset_move_the_edges() -> None:
    # Cells of 2, offset 1: cells are [0], [1 2], [3 4], [5]; the last bit of their words is 0, 1, 1, 0.
    lit = gray_profile(Gray(Axis.COLUMN, 1, 2, cell_px=2, offset_px=1), Size(6, 1))[0]
    assert (lit // 255).tolist() == [0, 1, 1, 1, 1, 0]


@pytest.mark.parametrize(
    ("extent_px", "cell_px", "offset_px", "bits"),
    [(1, 1, 0, 1), (2, 1, 0, 1), (3, 1, 0, 2), (1024, 1, 0, 10), (1025, 1, 0, 11), (1024, 4, 0, 8), (1280, 1, 384, 11)],
)
def test_bits_needed(extent_px: int, cell_px: int, offset_px: int, bits: int) -> None:
    assert gray_bits(extent_px, cell_px, offset_px) == bits


@pytest.mark.parametrize(("extent_px", "cell_px", "offset_px"), [(0, 1, 0), (8, 0, 0), (8, 1, -1)])
def test_bits_of_an_impossible_code_are_refused(extent_px: int, cell_px: int, offset_px: int) -> None:
    with pytest.raises(PatternError, match=r"cell_px ≥ 1"):
        gray_bits(extent_px, cell_px, offset_px)


def test_a_projector_larger_than_the_code_is_refused_with_the_bits_it_needs() -> None:
    with pytest.raises(PatternError, match=r"ends at column 255.*1024 columns.*use 10 bits"):
        require_addressable(Gray(Axis.COLUMN, 0, 8), Size(1024, 768))


def test_a_projector_smaller_than_the_code_is_refused_with_both_numbers() -> None:
    with pytest.raises(PatternError, match=r"smaller than the code.*more than 1024 rows.*has 768.*use 10 bits"):
        gray_profile(Gray(Axis.ROW, 0, 11), Size(1024, 768))


@pytest.mark.parametrize("bit", [-1, 3])
def test_edges_of_a_bit_that_does_not_exist_are_refused(bit: int) -> None:
    with pytest.raises(PatternError, match=r"bits 0 \(most significant\) to 2"):
        edge_indices(bit, 3)


def test_lines_lie_along_rows_for_the_row_axis() -> None:
    profile = line_profile(LineShift(Axis.ROW, 1, 4), Size(3, 6))
    assert profile.shape == (6, 1)
    assert (profile[:, 0] // 255).tolist() == [0, 1, 0, 0, 0, 1]


def test_a_wide_line_at_the_border_is_cut() -> None:
    pattern = LineShift(Axis.COLUMN, 7, 8, line_width_px=2)
    lit = np.flatnonzero(line_profile(pattern, Size(16, 1))[0])
    # The line at 7 and 8 is whole; those at −1 and 0 and at 15 and 16 are cut.
    assert lit.tolist() == [0, 7, 8, 15]
    assert is_whole([-1, 0, 1], pattern, 16).tolist() == [False, True, False]
    assert line_count(pattern, 16) == 1
    assert line_count(pattern, 17) == 2


def test_a_projector_shorter_than_a_period_is_refused() -> None:
    with pytest.raises(PatternError, match=r"has 6 columns.*period is 8 px"):
        line_profile(LineShift(Axis.COLUMN, 0, 8), Size(6, 100))
