"""Pixels near shadows and depth steps."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import FloatArray
from slrig.reconstruction.phase import EdgeLimits, PositionMap, near_edges, near_shadows, near_shadows_by_blur
from tests.unit.reconstruction.builders import grid

SHAPE = (30, 40)
CELL_PX = 4
LIMITS = EdgeLimits()


def bends_by_the_rule(seen: PositionMap, limits: EdgeLimits) -> NDArray[np.bool_]:
    """Second differences in four directions, by slices; a pixel without a deviation counts as sure."""
    p, s = seen.position, np.nan_to_num(seen.sigma)
    out = np.zeros(p.shape, dtype=np.bool_)
    here = (slice(1, -1), slice(1, -1))
    ends = [
        ((slice(1, -1), slice(None, -2)), (slice(1, -1), slice(2, None))),
        ((slice(None, -2), slice(1, -1)), (slice(2, None), slice(1, -1))),
        ((slice(None, -2), slice(None, -2)), (slice(2, None), slice(2, None))),
        ((slice(None, -2), slice(2, None)), (slice(2, None), slice(None, -2))),
    ]
    for before, after in ends:
        bend = np.abs(p[before] - 2 * p[here] + p[after])
        deviation = np.sqrt(s[before] ** 2 + 4 * s[here] ** 2 + s[after] ** 2)
        steep = bend > limits.bend_share * np.abs(p[after] - p[before])
        out[here] |= (bend > limits.bend_px + limits.bend_sigma * deviation) & steep
    return out


def test_bends_are_second_differences_that_neither_slope_nor_noise_explains() -> None:
    rng = np.random.default_rng(5)
    x, _ = grid(SHAPE)
    position = (20 + 2 * x + rng.choice([0, 0, 0.4, 3.0], SHAPE) * rng.normal(0, 1, SHAPE)).astype(np.float32)
    position[rng.random(SHAPE) < 0.05] = np.nan
    sigma = rng.choice([0.02, 0.3, np.nan], SHAPE, p=[0.6, 0.3, 0.1]).astype(np.float32)
    alone = replace(LIMITS, depth_px=0.5)
    _, found = near_edges(PositionMap(position, sigma), np.zeros(SHAPE, dtype=np.bool_), 0.0, alone)
    wanted = bends_by_the_rule(PositionMap(position, sigma), alone)
    np.testing.assert_array_equal(found, wanted)
    sure = bends_by_the_rule(PositionMap(position, np.zeros_like(sigma)), alone)
    assert 50 < wanted.sum() < sure.sum() < 1000


def test_a_filter_keeps_clear_by_its_own_reach_and_by_more_where_stripes_are_wide() -> None:
    for blur_px, reach_px in ((0.4, 2.0), (1.0, 2.0), (1.6, 3.2)):
        limits = LIMITS.for_filters(blur_px)
        assert limits.shadow_px == limits.depth_px == pytest.approx(reach_px)
        assert replace(limits, shadow_px=LIMITS.shadow_px, depth_px=LIMITS.depth_px) == LIMITS
    assert replace(LIMITS, filter_px=3.0).for_filters(2.0).depth_px == pytest.approx(6.0)


def steps(
    position: FloatArray,
    *,
    unlit: NDArray[np.bool_] | None = None,
    resolution_px: float = 0.0,
    limits: EdgeLimits = LIMITS,
    sigma: float = 0.0,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    dark = np.zeros(SHAPE, dtype=np.bool_) if unlit is None else unlit
    seen = PositionMap(position.astype(np.float32), np.full(SHAPE, sigma, dtype=np.float32))
    return near_edges(seen, dark, resolution_px, limits)


@pytest.mark.parametrize("slope", [0.2, 1.0, 3.0])
def test_a_smooth_surface_has_no_edges(slope: float) -> None:
    x, y = grid(SHAPE)
    shadow, step = steps(20 + slope * x + 0.02 * (x - 20) ** 2 + 0.3 * y)
    assert not shadow.any()
    assert not step.any()


@pytest.mark.parametrize("sigma", [0.0, math.nan, 0.3])
def test_a_depth_step_is_marked_on_both_sides(sigma: float) -> None:
    x, _ = grid(SHAPE)
    shadow, step = steps(np.where(x < 20, 20 + x, 27 + x), sigma=sigma)
    assert not shadow.any()
    # Columns 19 and 20 bend. The outermost rows see no bend of their own.
    assert np.flatnonzero(step[15]).tolist() == [19, 20]
    # A filter keeps two more pixels clear on either side.
    _, wide = steps(np.where(x < 20, 20 + x, 27 + x), sigma=sigma, limits=LIMITS.for_filters(1.0))
    assert np.flatnonzero(wide[15]).tolist() == [17, 18, 19, 20, 21, 22]


@pytest.mark.parametrize("rise", [-9.0, -3.0, 2.5, 20.0])
def test_a_slanted_depth_step_leaves_no_way_through_it(rise: float) -> None:
    x, y = grid(SHAPE)
    far = np.asarray(x + 0.8 * y > 31)
    _, step = steps(20 + x + rise * far)
    # Walking from one side to the other by any of the eight neighbours passes a marked pixel.
    _, label = cv2.connectedComponents((~step[1:-1, 1:-1]).astype(np.uint8), connectivity=8)
    left, right = set(np.unique(label[(~far)[1:-1, 1:-1]])), set(np.unique(label[far[1:-1, 1:-1]]))
    assert left & right <= {0}
    assert step.mean() < 0.15


def test_a_coarse_map_needs_a_higher_step() -> None:
    x, _ = grid(SHAPE)
    cells = CELL_PX * np.floor((20 + x) / CELL_PX)
    assert steps(cells)[1].any()
    assert not steps(cells, resolution_px=CELL_PX)[1].any()
    cliff = np.where(x < 20, cells, cells + 20)
    assert np.flatnonzero(steps(cliff, resolution_px=CELL_PX)[1][15]).tolist() == [19, 20]
    wide = steps(cliff, resolution_px=CELL_PX, limits=LIMITS.for_filters(1.0))[1]
    assert np.flatnonzero(wide[15]).tolist() == list(range(17, 23))


def test_the_border_of_a_shadow_is_marked_to_two_pixels() -> None:
    x, y = grid(SHAPE)
    shadow, step = steps(20 + x, unlit=np.asarray(x > 30))
    assert np.flatnonzero(shadow[15]).tolist() == list(range(29, 40))
    assert not step.any()
    corner, _ = steps(20 + x, unlit=np.asarray((x > 30) & (y > 20)))
    expected = [[bool(math.hypot(max(31 - c, 0), max(21 - r, 0)) <= 2) for c in range(40)] for r in range(30)]
    np.testing.assert_array_equal(corner, expected)


def test_unlit_specks_are_dust_and_not_shadow() -> None:
    x, _ = grid(SHAPE)
    unlit = np.zeros(SHAPE, dtype=np.bool_)
    unlit[5, 5] = unlit[20, 20] = unlit[21, 21] = unlit[22, 20] = True
    assert not steps(20 + x, unlit=unlit)[0].any()
    unlit[20, 22] = True
    shadow = steps(20 + x, unlit=unlit)[0]
    assert shadow[20, 20]
    assert shadow[22, 22]
    assert not shadow[5, 5]


def test_shadows_reach_further_by_a_camera_out_of_focus() -> None:
    unlit = np.zeros((40, 40), dtype=np.bool_)
    unlit[:, :10] = True
    usual = near_shadows(unlit, EdgeLimits())
    assert near_shadows_by_blur(0.65, usual, unlit, EdgeLimits()) is usual
    wider = near_shadows_by_blur(1.5, usual, unlit, EdgeLimits())
    assert (usual.sum(axis=1) == 12).all()
    assert (wider.sum(axis=1) == 14).all()
