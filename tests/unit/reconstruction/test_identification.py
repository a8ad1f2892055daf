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
from slrig.reconstruction.identification import NumberedStripes, identify_stripes
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
) -> tuple[NumberedStripes, NDArray[np.uint8]]:
    code = CodeMap(seen.lowest, seen.highest, seen.refusal)
    return identify_stripes(stripes, code, positions, seen.near_shadow, seen.near_step, shortest_points=shortest)


def runs(coded: NumberedStripes) -> list[tuple[float, list[int]]]:
    """(position, rows) of each stripe."""
    edges = coded.stripes.offsets
    rows = np.rint(coded.stripes.points_px[:, 1]).astype(int)
    return [
        (float(position), rows[a:b].tolist())
        for position, a, b in zip(coded.position_px, edges[:-1], edges[1:], strict=True)
    ]


def column(refusal: NDArray[np.uint8], count: int) -> list[Refusal]:
    return [Refusal(int(value)) for value in refusal[:count, 2]]


NONE, STRAY = Refusal.NONE, Refusal.STRAY_CODE
STRIPES: dict[str, tuple[Sequence[Shown], list[tuple[float, list[int]]], list[Refusal]]] = {
    "two cells of one line": ([2] * 6 + [3] * 6, [(11.5, [*range(12)])], [NONE] * 12),
    "a change of the line": ([1] * 7 + [2] * 8, [(3.5, [*range(7)]), (11.5, [*range(7, 15)])], [NONE] * 15),
    "intervals within one line and across two": (
        [(2, 3)] * 6 + [(3, 4)] * 2 + [3] * 6, [(11.5, [*range(6), *range(8, 14)])],
        [NONE] * 6 + [Refusal.AMBIGUOUS_LINE] * 2 + [NONE] * 6,
    ),
    "a stray point": ([2] * 6 + [4] + [2] * 7, [(11.5, [*range(6), *range(7, 14)])], [NONE] * 6 + [STRAY] + [NONE] * 7),
    "the longest gap": (
        [2] * 6 + [4] * LONGEST_GAP + [2] * 7, [(11.5, [*range(6), *range(6 + LONGEST_GAP, 13 + LONGEST_GAP)])],
        [NONE] * 6 + [STRAY] * LONGEST_GAP + [NONE] * 7,
    ),
    "a longer gap": (
        [2] * 6 + [4] * (LONGEST_GAP + 1) + [2] * 7,
        [(11.5, [*range(6)]), (11.5, [*range(7 + LONGEST_GAP, 14 + LONGEST_GAP)])],
        [NONE] * 6 + [STRAY] * (LONGEST_GAP + 1) + [NONE] * 7,
    ),
    "a refused pixel keeps its own cause": (
        [2] * 6 + [Refusal.AMBIGUOUS_BIT, 4] + [2] * 6, [(11.5, [*range(6), *range(8, 14)])],
        [NONE] * 6 + [Refusal.AMBIGUOUS_BIT, STRAY] + [NONE] * 6,
    ),
    "a line cut by the projector's border": ([6] * 8 + [(5, 6)] * 2, [], [Refusal.BEYOND_PROJECTOR] * 10),
}  # fmt: skip


@pytest.mark.parametrize("case", STRIPES)
def test_a_stripe_takes_the_positions_that_its_pixels_show(case: str) -> None:
    cells, wanted, causes = STRIPES[case]
    coded, refusal = numbered(image(cells), stripes_of([down(range(len(cells)))]))
    assert runs(coded) == wanted
    assert column(refusal, len(cells)) == causes


def test_points_near_a_shadow_and_on_a_step_are_refused_for_that() -> None:
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


@pytest.mark.parametrize("seed", range(20))
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
    before = [array.copy() for array in seen]
    coded, got = numbered(seen, stripes)
    for array, earlier in zip(seen, before, strict=True):
        np.testing.assert_array_equal(array, earlier)
    rows = np.rint(stripes.points_px[:, 1]).astype(int)
    assert runs(coded) == [(position, rows[run].tolist()) for position, run in wanted]
    np.testing.assert_array_equal(got, refusal)
