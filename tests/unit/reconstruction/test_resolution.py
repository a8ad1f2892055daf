"""Finest bits that a camera resolves, block by block."""

from __future__ import annotations

from itertools import groupby, pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, Gray, Size
from slrig.patterns.codes import gray_profile
from slrig.reconstruction.decoding import (
    BLOCK_PX,
    CodeMap,
    _cells_per_block,
    _count_passages,
    _follow_neighbours,
    unresolved_bits,
    unresolved_lines,
)
from slrig.reconstruction.frames import AxisFrames

PROJECTOR = Size(1024, 32)
BITS = 10


def frames(column: NDArray[np.float64], *, noise: float = 1.0, down: bool = False) -> AxisFrames:
    """What a camera sees whose pixels show these projector columns, (H, W), each the mean light of what it covers."""
    rng = np.random.default_rng(3)
    wide = np.maximum(np.abs(np.gradient(column, axis=1)), 0.5)
    seen = []
    for inverted in (False, True):
        for bit in range(BITS):
            profile = gray_profile(Gray(Axis.COLUMN, bit, BITS, inverted=inverted), PROJECTOR)[0] / 255.0
            total = np.concatenate([[0.0], np.cumsum(profile)])
            ends = (np.interp(column + sign * wide / 2 + 0.5, np.arange(len(total)), total) for sign in (1, -1))
            light = np.subtract(*ends) / wide
            seen.append(10 + 150 * light + rng.normal(0, noise, column.shape))
    images = np.array(seen, dtype=np.float32)
    white, black = np.full(column.shape, 160, np.float32), np.full(column.shape, 10, np.float32)
    if down:
        images, white, black = np.swapaxes(images, 1, 2), white.T, black.T
    images = np.ascontiguousarray(images)
    gray = Gray(Axis.COLUMN, 0, BITS)
    none = np.zeros((0, *white.shape), np.float32)
    return AxisFrames(Axis.COLUMN, white, black, images[:BITS], images[BITS:], gray, none, (), 255.0)


def ramp(*columns_per_px: float, rows: int = 128, width: int = 192) -> NDArray[np.float64]:
    """Projector columns that pass at one rate in the upper part of an image, at another below."""
    parts = [
        np.broadcast_to(100.3 + rate * np.arange(width), (rows // len(columns_per_px), width))
        for rate in columns_per_px
    ]
    return np.concatenate(parts)


LIT = np.ones((128, 192), dtype=np.bool_)


@pytest.mark.parametrize(
    ("columns_per_px", "bits"), [(0.3, 0), (0.8, 0), (1.4, 1), (2.6, 2), (6.7, 3), (8.4, 4), (12.0, 4)]
)
def test_a_bit_is_resolved_where_two_of_its_edges_have_two_pixels(columns_per_px: float, bits: int) -> None:
    seen = ramp(columns_per_px, width=min(192, int(900 / columns_per_px)))
    assert (unresolved_bits(frames(seen), np.ones(seen.shape, dtype=np.bool_)) == bits).mean() > 0.95


def test_the_width_of_a_stripe_counts_across_it() -> None:
    # Down the columns slanted stripes are 20 times as wide.
    seen = ramp(1.4) + 0.07 * np.arange(128)[:, None]
    assert (unresolved_bits(frames(seen), LIT) == 1).mean() > 0.95


def test_a_bit_that_hardly_swings_is_unresolved_however_right_it_is() -> None:
    seen = frames(ramp(0.5), noise=0.0)
    assert seen.inverses is not None
    for images in (seen.bits, seen.inverses):
        images[-1][:] = 85 + 0.04 * (images[-1] - 85)
    assert (unresolved_bits(seen, LIT) == 1).all()


def test_a_block_is_judged_as_its_neighbours_are() -> None:
    counts = np.array([[3, 3, 3, 1], [3, 0, 3, 1], [3, 3, 3, 1], [0, 0, 1, 1]], dtype=np.uint8)
    judged = counts > 0
    judged[1, 1] = True
    found = _follow_neighbours(counts, judged)
    assert found.tolist() == [[3, 3, 3, 1], [3, 3, 3, 1], [3, 3, 3, 1], [3, 3, 1, 1]]
    assert not _follow_neighbours(np.zeros_like(counts), np.zeros_like(judged)).any()


def test_a_bit_in_noise_is_unresolved_for_any_width_of_cells() -> None:
    seen = frames(ramp(0.3))
    assert seen.inverses is not None
    rng = np.random.default_rng(0)
    for images in (seen.bits, seen.inverses):
        images[-1][:] = 85 + rng.normal(0, 2, LIT.shape)
    assert (unresolved_bits(seen, LIT) == 1).all()


def test_each_part_of_an_image_has_its_own_whichever_way_stripes_run() -> None:
    found = unresolved_bits(frames(ramp(0.6, 1.4)), LIT)
    assert (found[: 64 - BLOCK_PX] == 0).all()
    assert (found[64 + BLOCK_PX :] == 1).all()
    lying = frames(ramp(0.6, 1.4), down=True)
    np.testing.assert_array_equal(found, unresolved_bits(lying, LIT.T.copy()).T)


def test_light_from_elsewhere_leaves_no_bits_out() -> None:
    seen = frames(ramp(0.5))
    assert seen.inverses is not None
    rng = np.random.default_rng(0)
    for image in (*seen.bits, *seen.inverses):
        image[:] = 85 + rng.normal(0, 2, image.shape)
    assert not unresolved_bits(seen, LIT).any()


def test_the_tally_is_that_of_plain_python() -> None:
    rng = np.random.default_rng(7)
    index = np.cumsum(rng.choice([-1, 0, 1, 2], (BLOCK_PX, 3 * BLOCK_PX), p=[0.1, 0.5, 0.3, 0.1]), axis=1) % 1024
    word = (index ^ (index >> 1)).astype(np.int32)
    lit = rng.random(word.shape) < 0.97
    for finest in (0, 1, 2):
        expected = np.zeros((4, 1, 3), dtype=np.int64)
        for y in range(BLOCK_PX):
            cells = [int(index[y, x]) >> (finest + 1) if lit[y, x] else -1 for x in range(word.shape[1])]
            runs = [
                (cell, [x for _, x in group])
                for cell, group in groupby(zip(cells, range(len(cells)), strict=True), key=lambda each: each[0])
            ]
            for before, (cell, pixels), after in zip(runs, runs[1:], runs[2:], strict=False):
                if min(before[0], cell, after[0]) < 0 or (before[0] < cell) != (cell < after[0]):
                    continue
                halves = [int(index[y, x]) >> finest & 1 for x in pixels]
                steps = [b - a for a, b in pairwise(halves) if a != b]
                block = (pixels[0] + pixels[-1]) // 2 // BLOCK_PX
                several = len(pixels) > 1
                right = several and steps == [1 if before[0] < cell else -1]
                expected[:, 0, block] += (1, len(pixels), several, right)
        np.testing.assert_array_equal(_count_passages(word, lit, finest), expected)


def lines_of(column: NDArray[np.float64], period_px: float) -> tuple[CodeMap, NDArray[np.float64]]:
    """The code of cells of 4 columns that pixels of these columns show, and a point on each row where a line passes."""
    cell = np.floor(column / 4).astype(np.int32)
    points = []
    for y, row in enumerate(column / period_px):
        places = np.arange(np.ceil(row[0]), row[-1])
        points += [(x, y) for x in np.interp(places, row, np.arange(len(row)))]
    return CodeMap(cell, cell, np.zeros(cell.shape, dtype=np.uint8)), np.array(points)


@pytest.mark.parametrize("down", [False, True])
def test_lines_are_unresolved_with_less_than_half_of_their_points(down: bool) -> None:
    code, points = lines_of(ramp(0.7, rows=192, width=256), 1.0)
    some = np.random.default_rng(1).random(len(points))
    kept = np.where(points[:, 0] < 128, some < 0.7, some < 0.3)
    if down:
        points = points[:, ::-1]
        code = CodeMap(code.lowest.T.copy(), code.highest.T.copy(), code.refusal.T.copy())
    every = np.ones(code.refusal.shape, dtype=np.bool_)
    assert unresolved_lines(points, code, every, 4.0) is None
    assert unresolved_lines(points[kept], code, every, 4.0 / 3) is None
    lost = unresolved_lines(points[kept], code, every, 4.0)
    assert lost is not None
    lost = lost.T if down else lost
    assert not lost[:, : 128 - BLOCK_PX].any()
    assert lost[:, 128 + BLOCK_PX :].all()
    assert unresolved_lines(points[kept], code, ~every, 4.0) is None


@pytest.mark.parametrize("down", [False, True])
def test_cells_passed_are_counted_in_each_block(*, down: bool) -> None:
    rng = np.random.default_rng(2)
    shape = 310, 100  # more rows of blocks than are worked on at once
    steps = rng.choice([0, 1, 2, 18], shape, p=[0.5, 0.2, 0.2, 0.1])
    twice = np.cumsum(steps, axis=0 if down else 1).astype(np.int32)
    refusal = rng.choice([0, 3], shape, p=[0.9, 0.1]).astype(np.uint8)
    usable = rng.random(shape) < 0.95
    known = usable & (refusal == 0)
    expected = np.zeros((2, 10, 4))
    for y, x in np.argwhere(known):
        for way, (above, left) in enumerate(((y, x - 1), (y - 1, x))):
            if min(above, left) >= 0 and known[above, left]:
                step = abs(int(twice[y, x]) - int(twice[above, left])) / 2
                expected[way, y // BLOCK_PX, x // BLOCK_PX] += step if step <= 2 else 0
    passed = _cells_per_block(CodeMap(twice // 2, twice - twice // 2, refusal), usable)
    np.testing.assert_array_equal(passed, expected.max(axis=0))
