"""Stripes numbered by the code at their pixels, and cut where it changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray, Refusal
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.identification import CodedStripes, identify
from slrig.reconstruction.stripes import Stripes
from tests.unit.reconstruction.builders import stripes_of

ROWS, COLUMNS = 40, 6
# One frame whose lines lie at 3.5, 11.5, 19.5 px, each spanning two cells; the border cuts the line of cell 6.
POSITIONS = np.array([[3.5, 3.5, 11.5, 11.5, 19.5, 19.5, np.nan]])
LONGEST_GAP = 3


# A cell, an interval of cells, a cause of refusal, or None: a pixel beside a shadow.
Shown = int | tuple[int, int] | Refusal | None


class Image(NamedTuple):
    """What a stripe straight down column 2 meets, row by row."""

    lowest: IntArray
    highest: IntArray
    refusal: NDArray[np.uint8]
    near_shadow: NDArray[np.bool_]
    near_step: NDArray[np.bool_]


def image(cells: Sequence[Shown]) -> Image:
    """Cells (or intervals, or causes of refusal) by row; None: beside a shadow."""
    lowest: IntArray = np.full((ROWS, COLUMNS), -1, dtype=np.int32)
    highest = lowest.copy()
    refusal = np.full((ROWS, COLUMNS), int(Refusal.NOT_LIT), dtype=np.uint8)
    shadow = np.zeros((ROWS, COLUMNS), dtype=np.bool_)
    for row, cell in enumerate(cells):
        if isinstance(cell, Refusal):
            refusal[row, 2] = cell
            continue
        low, high = cell if isinstance(cell, tuple) else (cell or 0, cell or 0)
        lowest[row, 2], highest[row, 2], refusal[row, 2] = low, high, 0
        shadow[row, 2] = cell is None
    return Image(lowest, highest, refusal, shadow, np.zeros_like(shadow))


def down(rows: range) -> FloatArray:
    return np.array([[2.2, row + 0.1] for row in rows])


def numbered(
    seen: Image, stripes: Stripes, *, shortest: int = 5, positions: FloatArray = POSITIONS
) -> tuple[CodedStripes, NDArray[np.uint8]]:
    code = CodeMap(seen.lowest, seen.highest, seen.refusal)
    return identify(stripes, code, positions, seen.near_shadow, seen.near_step, shortest_points=shortest)


def runs(coded: CodedStripes) -> list[tuple[float, list[int]]]:
    """(position, rows) of each stripe."""
    edges = coded.stripes.offsets
    rows = np.rint(coded.stripes.points_px[:, 1]).astype(int)
    return [
        (float(position), rows[a:b].tolist())
        for position, a, b in zip(coded.position_px, edges[:-1], edges[1:], strict=True)
    ]


def column(refusal: NDArray[np.uint8], count: int) -> list[Refusal]:
    return [Refusal(int(value)) for value in refusal[:count, 2]]


def test_a_stripe_takes_the_position_its_pixels_show() -> None:
    coded, refusal = numbered(image([2] * 6 + [3] * 6), stripes_of([down(range(12))]))
    assert runs(coded) == [(11.5, list(range(12)))]
    assert column(refusal, 12) == [Refusal.NONE] * 12


def test_a_chain_is_cut_where_the_position_changes() -> None:
    coded, refusal = numbered(image([1] * 7 + [2] * 8), stripes_of([down(range(15))]))
    assert runs(coded) == [(3.5, list(range(7))), (11.5, list(range(7, 15)))]
    assert column(refusal, 15) == [Refusal.NONE] * 15


def test_an_interval_within_one_line_has_one_mind_and_one_across_two_lines_has_two() -> None:
    coded, refusal = numbered(image([(2, 3)] * 6 + [(3, 4)] * 2 + [3] * 6), stripes_of([down(range(14))]))
    assert runs(coded) == [(11.5, [0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13])]
    assert column(refusal, 14) == [Refusal.NONE] * 6 + [Refusal.AMBIGUOUS_LINE] * 2 + [Refusal.NONE] * 6


@pytest.mark.parametrize("gap", [1, LONGEST_GAP, LONGEST_GAP + 1])
def test_stray_points_are_passed_over_when_the_run_goes_on_soon(gap: int) -> None:
    cells: Sequence[Shown] = [2] * 6 + [4] * gap + [2] * 7
    coded, refusal = numbered(image(cells), stripes_of([down(range(13 + gap))]))
    before, after = list(range(6)), list(range(6 + gap, 13 + gap))
    assert runs(coded) == ([(11.5, before + after)] if gap <= LONGEST_GAP else [(11.5, before), (11.5, after)])
    assert column(refusal, 13 + gap) == [Refusal.NONE] * 6 + [Refusal.STRAY_CODE] * gap + [Refusal.NONE] * 7


def test_a_refused_pixel_in_a_run_keeps_its_own_cause() -> None:
    coded, refusal = numbered(image([2] * 6 + [Refusal.AMBIGUOUS_BIT, 4] + [2] * 6), stripes_of([down(range(14))]))
    assert runs(coded) == [(11.5, [0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13])]
    assert column(refusal, 14)[6:8] == [Refusal.AMBIGUOUS_BIT, Refusal.STRAY_CODE]


def test_a_line_cut_by_the_projectors_border_is_beyond_it() -> None:
    coded, refusal = numbered(image([6] * 8 + [(5, 6)] * 2), stripes_of([down(range(10))]))
    assert runs(coded) == []
    assert column(refusal, 10) == [Refusal.BEYOND_PROJECTOR] * 10


def test_points_beside_a_shadow_and_on_a_step_are_refused_for_that() -> None:
    seen = image([2] * 6 + [None] * 3 + [2] * 6)
    seen.near_step[[6, 14], 2] = True
    coded, refusal = numbered(seen, stripes_of([down(range(15))]))
    assert runs(coded) == [(11.5, [0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13])]
    # A point with both causes has the first of the walk.
    assert column(refusal, 15)[6:9] == [Refusal.SHADOW_EDGE] * 3
    assert column(refusal, 15)[14] is Refusal.DEPTH_EDGE


def test_a_short_stripe_is_refused_and_a_short_piece_of_a_long_one_is_stray() -> None:
    seen = image([2] * 4 + [Refusal.NOT_LIT] * 2 + [4] * 8 + [2] * 4)
    coded, refusal = numbered(seen, stripes_of([down(range(4)), down(range(6, 18))]))
    assert runs(coded) == [(19.5, list(range(6, 14)))]
    assert column(refusal, 4) == [Refusal.SHORT_STRIPE] * 4
    assert column(refusal, 18)[14:] == [Refusal.STRAY_CODE] * 4


def test_each_frame_has_its_own_lines() -> None:
    positions = np.array([[1.0] * 7, [2.0] * 7, [3.0] * 7])
    coded, _ = numbered(
        image([2] * 20), stripes_of([down(range(8)), down(range(8, 16))], frame=[2, 0]), positions=positions
    )
    assert runs(coded) == [(3.0, list(range(8))), (1.0, list(range(8, 16)))]
    assert coded.stripes.frame.tolist() == [2, 0]


def test_points_keep_their_normals_and_deviations() -> None:
    chain = down(range(12))
    angles = np.linspace(0, 1, 12)
    stripes = stripes_of([chain], normals=[np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    coded, _ = numbered(image([2] * 5 + [4] + [2] * 6), stripes)
    kept = [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    np.testing.assert_array_equal(coded.stripes.normals, stripes.normals[kept])
    np.testing.assert_array_equal(coded.stripes.sigma_px, stripes.sigma_px[kept])


def test_no_stripes_stay_no_stripes() -> None:
    coded, refusal = numbered(image([2] * 4), stripes_of([]))
    assert len(coded.stripes) == 0
    assert coded.position_px.shape == (0,)
    assert refusal.shape == (ROWS, COLUMNS)


def by_the_rules(
    seen: Image, stripes: Stripes, shortest: int
) -> tuple[list[tuple[float, list[int]]], NDArray[np.uint8]]:
    """Runs (position, point indices) and refusals, in plain Python."""
    refusal = seen.refusal.copy()
    pixels = [(round(y), round(x)) for x, y in stripes.points_px]
    position: list[float] = []
    for s in range(len(stripes)):
        for pixel in pixels[stripes.offsets[s] : stripes.offsets[s + 1]]:
            ends = [POSITIONS[stripes.frame[s], seen.lowest[pixel]], POSITIONS[stripes.frame[s], seen.highest[pixel]]]
            cause = Refusal.NONE
            if seen.lowest[pixel] < 0:
                cause = Refusal(int(refusal[pixel]))
            elif any(math.isnan(end) for end in ends):
                cause = Refusal.BEYOND_PROJECTOR
            elif ends[0] != ends[1]:
                cause = Refusal.AMBIGUOUS_LINE
            elif seen.near_shadow[pixel]:
                cause = Refusal.SHADOW_EDGE
            elif seen.near_step[pixel]:
                cause = Refusal.DEPTH_EDGE
            refusal[pixel] = cause
            position.append(math.nan if cause else float(ends[0]))
    kept: list[tuple[float, list[int]]] = []
    for s in range(len(stripes)):
        chain = list(range(stripes.offsets[s], stripes.offsets[s + 1]))
        while chain:
            if math.isnan(position[chain[0]]):
                chain.pop(0)
                continue
            whole = len(chain) == stripes.offsets[s + 1] - stripes.offsets[s]
            here = position[chain[0]]
            run: list[int] = []
            while any(position[i] == here for i in chain[: LONGEST_GAP + 1]):
                i = chain.pop(0)
                if position[i] == here:
                    run.append(i)
                elif not math.isnan(position[i]):
                    refusal[pixels[i]] = Refusal.STRAY_CODE
            if len(run) >= shortest:
                kept.append((here, run))
            else:
                for i in run:
                    refusal[pixels[i]] = Refusal.SHORT_STRIPE if whole and not chain else Refusal.STRAY_CODE
    return kept, refusal


@pytest.mark.parametrize("seed", range(30))
def test_runs_and_refusals_are_those_of_the_rules(seed: int) -> None:
    rng = np.random.default_rng(seed)
    choices: list[Shown] = [
        0, 1, 2, 3, 4, 5, 6, (0, 1), (1, 2), (5, 6), None, Refusal.AMBIGUOUS_BIT,
    ]  # fmt: skip
    cells: list[Shown] = []
    while len(cells) < ROWS:
        cells += [choices[rng.integers(len(choices))]] * int(rng.choice([1, 2, 3, 6, 9]))
    seen = image(cells[:ROWS])
    seen.near_step[rng.integers(0, ROWS, 2), 2] = True
    cuts = sorted(rng.choice(np.arange(3, ROWS - 3), 2, replace=False).tolist())
    stripes = stripes_of([down(range(a, b)) for a, b in zip([0, *cuts], [*cuts, ROWS], strict=True)])
    wanted, refusal = by_the_rules(seen, stripes, 5)
    coded, got = numbered(seen, stripes)
    rows = np.rint(stripes.points_px[:, 1]).astype(int)
    assert runs(coded) == [(position, rows[run].tolist()) for position, run in wanted]
    np.testing.assert_array_equal(got, refusal)


def test_the_code_map_is_left_alone() -> None:
    seen = image([2] * 6 + [4] + [2] * 6)
    before = [array.copy() for array in seen]
    numbered(seen, stripes_of([down(range(13))]))
    for array, earlier in zip(seen, before, strict=True):
        np.testing.assert_array_equal(array, earlier)
