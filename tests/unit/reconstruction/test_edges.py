"""The dense position map, and pixels beside shadows and depth steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, LineShift, Refusal
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.edges import EdgeLimits, _bend_kernel, _phase_kernel, dense_position, near_edges
from slrig.reconstruction.frames import AxisFrames
from tests.unit.reconstruction.builders import code_frames, grid

SHAPE = (30, 40)
CELL_PX = 4
CELL_POSITION = CELL_PX * np.arange(40, dtype=np.float64) + (CELL_PX - 1) / 2
LIMITS = EdgeLimits()


def line_frames(
    position_px: FloatArray, *, period_px: int = 8, width_px: int = 1, frames: int | None = None
) -> AxisFrames:
    """What a camera sees of each line frame: a bar of `width_px`, blurred, at every period."""
    patterns = tuple(LineShift(Axis.COLUMN, k, period_px, width_px) for k in range(frames or period_px))
    images = []
    for pattern in patterns:
        light = np.zeros(SHAPE)
        for part in range(width_px):
            apart = position_px - pattern.shift - part
            apart -= period_px * np.rint(apart / period_px)
            light += np.exp(-(apart**2) / 2)
        images.append(10 + 150 * light)
    dark = np.full(SHAPE, 10, dtype=np.float32)
    return code_frames(
        bits=np.zeros((1, *SHAPE), dtype=np.float32), white=dark + 150, black=dark,
        lines=np.array(images, dtype=np.float32), line_patterns=patterns,
    )  # fmt: skip


def code_of(position_px: FloatArray, *, off_by: int = 0) -> CodeMap:
    """The cell that each pixel shows; NaN is refused."""
    lit = np.isfinite(position_px)
    cell = np.where(lit, np.floor((np.nan_to_num(position_px) + 0.5) / CELL_PX) + off_by, -1).astype(np.int32)
    return CodeMap(cell, cell.copy(), np.where(lit, 0, int(Refusal.NOT_LIT)).astype(np.uint8))


@pytest.mark.parametrize("width_px", [1, 2])
@pytest.mark.parametrize("off_by", [0, 1, -1])
def test_phase_gives_the_position_within_the_period_and_code_the_period(width_px: int, off_by: int) -> None:
    x, y = grid(SHAPE)
    position = 20.0 + 1.37 * x + 0.21 * y
    # A code that is one cell off near a cell's own edge does no harm: ± 1.5 px of the middle are within half a period.
    inside = (
        np.abs((position + 0.5) / CELL_PX % 1 - (0.2 if off_by < 0 else 0.8)) < 0.2 if off_by else np.ones(SHAPE, bool)
    )
    found = dense_position(line_frames(position, width_px=width_px), code_of(position, off_by=off_by), CELL_POSITION)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[inside], position[inside], atol=0.02)


def test_refused_pixels_have_no_position() -> None:
    x, _ = grid(SHAPE)
    position = 20.0 + x
    position[:, 10:15] = np.nan
    found = dense_position(line_frames(20.0 + x), code_of(position), CELL_POSITION)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(position))


def test_without_line_frames_the_middle_of_the_code_interval_stands() -> None:
    lowest = np.array([[3, 4, -1]], dtype=np.int32)
    highest = np.array([[3, 5, -1]], dtype=np.int32)
    code = CodeMap(lowest, highest, np.array([[0, 0, 3]], dtype=np.uint8))
    dark = np.zeros((1, 3), dtype=np.float32)
    frames = code_frames(bits=dark[None], white=dark, black=dark)
    np.testing.assert_array_equal(dense_position(frames, code, CELL_POSITION), [[13.5, 19.5, np.nan]])


def test_too_few_line_frames_have_no_phase() -> None:
    x, _ = grid(SHAPE)
    position = 20.0 + x
    found = dense_position(line_frames(position, frames=5), code_of(position), CELL_POSITION)
    assert set(np.unique(found)) <= set(CELL_POSITION)


def test_the_phase_is_that_of_the_first_fourier_term() -> None:
    rng = np.random.default_rng(3)
    lines = rng.uniform(0, 200, (8, 6, 7)).astype(np.float32)
    middle = rng.uniform(0, 100, (6, 7))
    middle[2, 3] = np.nan
    angle = 2 * np.pi / 8 * (np.arange(8) + 0.5)
    found = _phase_kernel(lines, np.cos(angle), np.sin(angle), 8.0, middle)
    phase = np.angle(np.tensordot(np.exp(1j * angle), lines.astype(np.float64), axes=1)) * 8 / (2 * np.pi)
    np.testing.assert_allclose(found, phase + 8 * np.rint((middle - phase) / 8), rtol=0, atol=1e-4)


def bends_by_the_rule(position: NDArray[np.float32], limit: float, share: float) -> NDArray[np.bool_]:
    """Second differences in four directions, by slices."""
    p = position
    out = np.zeros(p.shape, dtype=np.bool_)
    middle = p[1:-1, 1:-1]
    ends = [
        (p[1:-1, :-2], p[1:-1, 2:]), (p[:-2, 1:-1], p[2:, 1:-1]), (p[:-2, :-2], p[2:, 2:]), (p[:-2, 2:], p[2:, :-2])
    ]  # fmt: skip
    for before, after in ends:
        bend = np.abs(before - 2 * middle + after)
        out[1:-1, 1:-1] |= (bend > limit) & (bend > share * np.abs(after - before))
    return out


def test_bends_are_second_differences_that_the_slope_does_not_explain() -> None:
    rng = np.random.default_rng(5)
    x, y = grid(SHAPE)
    position = (20 + 2 * x + rng.choice([0, 0, 0.4, 3.0], SHAPE) * rng.normal(0, 1, SHAPE)).astype(np.float32)
    position[rng.random(SHAPE) < 0.05] = np.nan
    found = _bend_kernel(position, 0.9, 0.5)
    wanted = bends_by_the_rule(position, 0.9, 0.5)
    np.testing.assert_array_equal(found, wanted)
    assert 50 < wanted.sum() < 1000
    assert not np.isnan(y).any()


def steps(
    position: FloatArray, *, unlit: NDArray[np.bool_] | None = None, resolution_px: float = 0.0
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    dark = np.zeros(SHAPE, dtype=np.bool_) if unlit is None else unlit
    return near_edges(position.astype(np.float32), dark, resolution_px, LIMITS)


@pytest.mark.parametrize("slope", [0.2, 1.0, 3.0])
def test_a_smooth_surface_has_no_edges(slope: float) -> None:
    x, y = grid(SHAPE)
    shadow, step = steps(20 + slope * x + 0.02 * (x - 20) ** 2 + 0.3 * y)
    assert not shadow.any()
    assert not step.any()


def test_a_depth_step_is_marked_to_two_pixels_either_side() -> None:
    x, _ = grid(SHAPE)
    shadow, step = steps(np.where(x < 20, 20 + x, 27 + x))
    assert not shadow.any()
    # Columns 19 and 20 bend; two more on either side are near. The outermost rows see no bend of their own.
    assert np.flatnonzero(step[15]).tolist() == [17, 18, 19, 20, 21, 22]


def test_a_hole_in_a_smooth_surface_is_no_depth_step() -> None:
    x, _ = grid(SHAPE)
    position = 20 + 1.2 * x
    position[:, 20] = np.nan
    position[10, 5] = np.nan
    assert not steps(position)[1].any()


def test_a_surface_seen_at_a_grazing_angle_is_no_step() -> None:
    # The position runs by 4 to 7 px per pixel: it bends by more than 0.9 px, and by less than half of its slope.
    x, _ = grid(SHAPE)
    assert not steps(20 + 4 * x + 0.6 * np.maximum(x - 20, 0) ** 1.6)[1].any()


def test_a_coarse_map_needs_a_higher_step() -> None:
    x, _ = grid(SHAPE)
    cells = CELL_PX * np.floor((20 + x) / CELL_PX)
    assert steps(cells)[1].any()
    assert not steps(cells, resolution_px=CELL_PX)[1].any()
    assert steps(np.where(x < 20, cells, cells + 20), resolution_px=CELL_PX)[1][15, 18:22].all()


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
