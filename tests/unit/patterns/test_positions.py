"""The tables of positions, by brute force over small projectors, from the light that the patterns ask for."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import Axis, FloatArray, Gray, LineShift, Size
from slrig.patterns.codes import (
    MIN_BORDER_DISTANCE_PX,
    cell_count,
    cell_positions,
    edge_positions,
    gray_bits,
    gray_profile,
    index_of_word,
    line_positions,
    line_profile,
)

CODES = [(16, 1, 0), (37, 4, 0), (37, 4, 3), (40, 3, 7), (64, 2, 1), (50, 5, 0), (29, 1, 5), (61, 8, 2)]
AXES = pytest.mark.parametrize("axis", list(Axis))
EXTENTS = pytest.mark.parametrize(("extent_px", "cell_px", "offset_px"), CODES)


def size_of(axis: Axis, extent_px: int) -> Size:
    return Size(extent_px, 2) if axis is Axis.COLUMN else Size(2, extent_px)


def code_of(axis: Axis, extent_px: int, cell_px: int, offset_px: int, *, bit: int = 0) -> Gray:
    return Gray(axis, bit, gray_bits(extent_px, cell_px, offset_px), cell_px, offset_px)


def light_of_bits(code: Gray, size: Size) -> FloatArray:
    """(bits, extent) of 0 and 1: what each position shows."""
    return np.stack(
        [
            gray_profile(Gray(code.axis, bit, code.bits, code.cell_px, code.offset_px), size).ravel() / 255
            for bit in range(code.bits)
        ]
    )


def cells_shown(code: Gray, size: Size) -> list[int]:
    """The cell of each position, read from its light."""
    word = index_of_word(code)
    return [int(word[int("".join(str(int(lit)) for lit in bits), 2)]) for bits in light_of_bits(code, size).T]


def is_inside(centre_px: float, extent_px: int) -> bool:
    return MIN_BORDER_DISTANCE_PX <= centre_px <= extent_px - 1 - MIN_BORDER_DISTANCE_PX


def lit_runs(pattern: LineShift, size: Size) -> list[FloatArray]:
    """The positions of each lit line, read from the light."""
    lit = np.flatnonzero(line_profile(pattern, size).ravel())
    return np.split(lit.astype(np.float64), np.flatnonzero(np.diff(lit) > 1) + 1)


@AXES
@EXTENTS
def test_every_position_is_in_the_cell_of_its_code_word(
    axis: Axis, extent_px: int, cell_px: int, offset_px: int
) -> None:
    code, size = code_of(axis, extent_px, cell_px, offset_px), size_of(axis, extent_px)
    shown = cells_shown(code, size)
    assert shown == [(c + offset_px) // cell_px for c in range(extent_px)]
    assert cell_count(code, size) == shown[-1] + 1
    middles = cell_positions(code, size)
    assert len(middles) == cell_count(code, size)
    for cell in sorted(set(shown))[1:-1]:
        assert middles[cell] == np.mean([c for c in range(extent_px) if shown[c] == cell])


@AXES
@pytest.mark.parametrize(("period_px", "width_px"), [(4, 1), (6, 1), (8, 1), (8, 2), (7, 3), (9, 4)])
@pytest.mark.parametrize(("extent_px", "offset_px"), [(40, 0), (43, 0), (40, 3), (61, 11)])
def test_each_line_is_identified_by_its_cells(
    axis: Axis, period_px: int, width_px: int, extent_px: int, offset_px: int
) -> None:
    cell_px = period_px // 2
    code, size = code_of(axis, extent_px, cell_px, offset_px), size_of(axis, extent_px)
    lines = [LineShift(axis, shift, period_px, width_px) for shift in range(period_px)]
    table = line_positions(lines, code, size)
    shown, middles = cells_shown(code, size), cell_positions(code, size)
    assert table.shape == (period_px, cell_count(code, size))
    for frame, line in enumerate(lines):
        for run in lit_runs(line, size):
            centre = float(run.mean())
            whole = len(run) == width_px
            if not (whole and is_inside(centre, extent_px)):
                assert centre not in table[frame]
                continue
            # The cells under its centre: one, or the two on whose border it lies.
            own = {shown[int(np.floor(centre))], shown[int(np.ceil(centre))]}
            for cell in own:
                assert table[frame, cell] == centre
            # Both neighbours as far as they are nearer than half a period.
            for cell in {cell + step for cell in own for step in (-1, 1)} & set(range(table.shape[1])):
                if abs(middles[cell] - centre) < period_px / 2:
                    assert table[frame, cell] == centre


@AXES
@EXTENTS
def test_each_edge_is_named_by_the_cells_on_either_side_of_it(
    axis: Axis, extent_px: int, cell_px: int, offset_px: int
) -> None:
    code, size = code_of(axis, extent_px, cell_px, offset_px), size_of(axis, extent_px)
    table = edge_positions(code, size)
    light, shown = light_of_bits(code, size), cells_shown(code, size)
    assert table.shape == (code.bits, cell_count(code, size))
    seen = 0
    for bit in range(code.bits):
        edges = np.flatnonzero(np.diff(light[bit])) + 0.5
        for edge in edges:
            before, after = shown[int(edge - 0.5)], shown[int(edge + 0.5)]
            assert after == before + 1
            assert table[bit, before] == table[bit, after] == edge
            seen += 1
        # Every other cell names the nearest edge of its bit, or none where that lies off the projector.
        for cell in range(table.shape[1]):
            value = table[bit, cell]
            if np.isfinite(value):
                assert value in edges
                border = cell_px * (cell + 0.5) - offset_px - 0.5
                assert abs(value - border) <= np.abs(edges - border).min() + 1e-9
    assert seen == len(set(shown)) - 1


def test_an_edge_on_the_border_of_the_projector_is_no_edge() -> None:
    # 16 columns in cells of 4, offset 4: the edge of cells 0 and 1 lies at -0.5, before the first column.
    code, size = code_of(Axis.COLUMN, 16, 4, 4), Size(16, 1)
    table = edge_positions(code, size)
    assert np.isnan(table[2, 0])
    assert np.isnan(table[2, 1])
    assert table[1, 1] == table[1, 2] == 3.5


@pytest.mark.parametrize("bits", [1, 2, 5, 9])
def test_words_are_the_reflected_code(bits: int) -> None:
    words = [""]
    for _ in range(bits):
        words = ["0" + word for word in words] + ["1" + word for word in reversed(words)]
    table = index_of_word(Gray(Axis.COLUMN, 0, bits))
    assert table.dtype == np.int32
    assert [int(table[int(word, 2)]) for word in words] == list(range(2**bits))


def test_a_code_that_does_not_fit_the_projector_has_no_cells() -> None:
    with pytest.raises(PatternError, match="64 x 2"):
        cell_count(Gray(Axis.COLUMN, 0, 3), Size(64, 2))
