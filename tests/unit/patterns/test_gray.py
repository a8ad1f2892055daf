"""Gray code against truths small enough to write down."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import Axis, Gray, Size
from slrig.model.gray_code import from_gray, to_gray
from slrig.patterns.gray import (
    cell_centre_px,
    edge_indices,
    gray_bits,
    gray_profile,
    require_addressable,
)


def test_three_bits_are_the_table_in_every_textbook() -> None:
    assert to_gray(np.arange(8)).tolist() == [0b000, 0b001, 0b011, 0b010, 0b110, 0b111, 0b101, 0b100]


def test_from_gray_undoes_to_gray_for_every_word_of_sixteen_bits() -> None:
    index = np.arange(2**16)
    assert (from_gray(to_gray(index)) == index).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.int64])
def test_from_gray_works_in_every_integer_width(dtype: type[np.generic]) -> None:
    index = np.arange(100, dtype=dtype)
    assert (from_gray(to_gray(index)) == index).all()


def test_a_profile_varies_along_its_axis_only() -> None:
    assert gray_profile(Gray(Axis.COLUMN, 0, 3), Size(8, 5)).shape == (1, 8)
    assert gray_profile(Gray(Axis.ROW, 0, 3), Size(5, 8)).shape == (8, 1)


def test_cell_and_offset_move_the_edges() -> None:
    # Cells of 2, offset 1: cells are [0], [1 2], [3 4], [5]; the last bit of their words is 0, 1, 1, 0.
    lit = gray_profile(Gray(Axis.COLUMN, 1, 2, cell_px=2, offset_px=1), Size(6, 1))[0]
    assert (lit // 255).tolist() == [0, 1, 1, 1, 1, 0]


def test_cell_centres_are_the_mean_of_their_positions() -> None:
    positions = np.arange(1, 10)  # whole cells of 3 when the offset is 2
    cells = (positions + 2) // 3
    for cell in np.unique(cells):
        assert cell_centre_px(cell, cell_px=3, offset_px=2) == positions[cells == cell].mean()


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
