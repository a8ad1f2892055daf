"""What a scan plays, and the light of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from typing import Any

import pytest

from slrig.errors import PatternError
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Primary, Sine, Size, White
from slrig.patterns.sequence import encode, merge_sequences, phase_patterns, scan_patterns


def patterns_of(
    size: Size,
    *,
    line_shift: bool = True,
    period_px: int = 8,
    gray_cell_px: int | None = None,
    rows: bool = False,
    coloured_light: bool = False,
) -> tuple[Pattern, ...]:
    return scan_patterns(
        size,
        line_shift=line_shift,
        period_px=period_px,
        line_width_px=1,
        gray_cell_px=gray_cell_px,
        gray_offset_px=0,
        rows=rows,
        coloured_light=coloured_light,
    )


def test_white_and_black_open_and_close_bits_with_their_inverses_and_each_shift_once() -> None:
    patterns = patterns_of(Size(64, 48), period_px=5)
    assert patterns[:2] == patterns[-2:] == (White(), Black())
    bits = [pattern for pattern in patterns if isinstance(pattern, Gray)]
    # Most significant first, in cells of half a period.
    assert [(pattern.bit, pattern.inverted) for pattern in bits] == [(b, i) for b in range(5) for i in (False, True)]
    assert {(pattern.bits, pattern.cell_px) for pattern in bits} == {(5, 2)}
    lines = [pattern for pattern in patterns if isinstance(pattern, LineShift)]
    assert lines == [LineShift(Axis.COLUMN, shift, 5) for shift in range(5)]
    alone = patterns_of(Size(64, 48), line_shift=False)
    assert alone == tuple(pattern for pattern in patterns if not isinstance(pattern, LineShift))


def test_response_patterns_come_first_and_the_remaining_bits_last() -> None:
    patterns = [pattern for pattern in patterns_of(Size(1024, 192), rows=True) if isinstance(pattern, Gray | LineShift)]
    played = [f"{pattern.axis} {pattern.bit if isinstance(pattern, Gray) else 'lines'}" for pattern in patterns]
    assert [each for each, _ in groupby(played)] == [
        *(f"column {each}" for each in (0, 1, 2, 3, 6, 7, "lines", 4, 5)),
        *(f"row {each}" for each in (0, 1, 2, 4, 5, "lines", 3)),
    ]
    for bit in (pattern for pattern in patterns if isinstance(pattern, Gray) and not pattern.inverted):
        assert patterns[patterns.index(bit) + 1] == replace(bit, inverted=True)


def test_rows_follow_columns_with_bits_of_their_own() -> None:
    axes = [pattern.axis for pattern in patterns_of(Size(64, 30), rows=True) if isinstance(pattern, Gray | LineShift)]
    assert axes == [Axis.COLUMN] * (2 * 4 + 8) + [Axis.ROW] * (2 * 3 + 8)


@pytest.mark.parametrize("options", [{}, {"line_shift": False}])
def test_coloured_white_is_between_code_frames(options: Any) -> None:
    patterns = patterns_of(Size(64, 48), coloured_light=True, **options)
    at = [index for index, pattern in enumerate(patterns) if isinstance(pattern, Primary)]
    assert [patterns[index] for index in at] == [Primary("red"), Primary("green"), Primary("blue")]
    for index in at:
        assert all(isinstance(patterns[index + step], Gray) for step in (-1, 1))
    rest = tuple(pattern for pattern in patterns if not isinstance(pattern, Primary))
    assert rest == patterns_of(Size(64, 48), **options)
    assert encode([Primary("red")], Size(64, 48)).profiles[0].tolist() == [[255]]


def test_sinusoids_follow_white_and_black_period_by_period_in_all_their_shifts() -> None:
    patterns = phase_patterns(Size(64, 48), period_px=9, steps=3, rows=True, coloured_light=True)
    at = [index for index, pattern in enumerate(patterns) if isinstance(pattern, Primary)]
    for index in at:
        assert all(isinstance(patterns[index + step], Sine) for step in (-1, 1))
    sines = [pattern for pattern in patterns if isinstance(pattern, Sine)]
    assert patterns[:2] == (White(), Black())
    assert len(patterns) == 2 + len(at) + len(sines) == 2 + 3 + 2 * 3 * 3
    assert [each.axis for each in sines] == [Axis.COLUMN] * 9 + [Axis.ROW] * 9
    assert [each.shift for each in sines] == [0, 1, 2] * 6
    assert len({(each.axis, each.period_px) for each in sines}) == 6
    with pytest.raises(PatternError, match="in 2 steps has no phase"):
        phase_patterns(Size(64, 48), period_px=9, steps=2, rows=False)


def test_a_cell_wider_than_half_a_period_is_refused() -> None:
    with pytest.raises(PatternError, match=r"cell of 5 px.*8 px apart.*gray_cell_px ≤ 4"):
        patterns_of(Size(64, 48), gray_cell_px=5)


def test_images_are_spread_from_profiles_and_cannot_be_written() -> None:
    size = Size(64, 48)
    sequence = encode(patterns_of(size, rows=True), size)
    assert {sequence.image(index).shape for index in range(len(sequence))} == {(48, 64)}
    assert (sequence.image(0) == 255).all()
    assert not sequence.image(1).any()
    assert not sequence.image(2).flags.writeable


def test_an_empty_sequence_is_refused() -> None:
    with pytest.raises(PatternError, match="at least one pattern"):
        encode((), Size(64, 48))


def test_a_pattern_for_another_projector_is_refused() -> None:
    with pytest.raises(PatternError, match="smaller than the code"):
        encode(patterns_of(Size(1024, 768)), Size(64, 48))


def test_sequences_are_united_with_each_light_once_in_the_order_it_comes() -> None:
    size = Size(64, 48)
    columns, both = (encode(patterns_of(size, rows=rows), size) for rows in (False, True))
    fine = encode(patterns_of(size, line_shift=False, gray_cell_px=1), size)
    whole = merge_sequences([columns, both, fine])
    assert whole.patterns[:18] == columns.patterns[:18]
    lights = [whole.image(index).tobytes() for index in range(len(whole))]
    assert len(set(lights)) == len(lights)
    for each in (columns, both, fine):
        assert {each.image(index).tobytes() for index in range(len(each))} <= set(lights)
    # Coarse bits of a fine code light as those of a coarse one: only the two finest, with their inverses, are new.
    assert len(whole) == len(both) - 2 + 4


def test_sequences_of_different_projectors_are_not_united() -> None:
    with pytest.raises(PatternError, match="found 2"):
        merge_sequences([encode((White(),), size) for size in (Size(64, 48), Size(64, 30))])
    with pytest.raises(PatternError, match="found 0"):
        merge_sequences([])
