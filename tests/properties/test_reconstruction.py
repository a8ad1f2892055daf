"""What holds for every device, line, chain, curve and stripe, whatever the numbers."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.model import Axis, FloatArray, Gray, IntArray, LineShift, Pinhole, Refusal, Size
from slrig.patterns.gray import gray_bits
from slrig.patterns.positions import LEAST_FROM_BORDER_PX, cell_count, edge_positions, index_of_word, line_positions
from slrig.reconstruction.chaining import _LONGEST_STEP_PX, chain_points
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.identification import CodedStripes, identify
from slrig.reconstruction.linking import link
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.optics import project, rays
from slrig.reconstruction.stripes import StripeLimits, chained, edge_points, stripe_points
from slrig.reconstruction.triangulation import camera_projector, ordered_along_sheet, selected
from tests.unit.reconstruction.builders import (
    CAMERA,
    PROJECTOR,
    Sphere,
    code_frames,
    ensemble_of,
    gaussian_stripe,
    grid,
    lit_rows,
    looking,
    opencv_pixels,
    stripes_of,
)

small = st.floats(-1.0, 1.0)
# The first call of a kernel compiles it.
unhurried = settings(deadline=None)
few = settings(deadline=None, max_examples=30)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def devices(draw: st.DrawFn) -> Pinhole:
    """Lenses of every make, as long as they do not fold within the image."""
    return looking(
        (200 * draw(small), 100 * draw(small), -500 + 100 * draw(small)), (20 * draw(small), 0.0, 0.0),
        size=Size(640, 480), focal_px=(1100 + 300 * draw(small), 1100 + 300 * draw(small)),
        distortion=(0.3 * draw(small), 0.1 * draw(small), 3e-3 * draw(small), 3e-3 * draw(small), 0.0),
        roll_rad=draw(small),
    )  # fmt: skip


@unhurried
@given(devices(), seeds)
def test_a_ray_projects_back_to_its_pixel(device: Pinhole, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform([0, 0], [639, 479], (20, 2))
    again = project(device, device.centre_mm + 500 * rays(device, pixels))
    np.testing.assert_allclose(again, pixels, atol=1e-7)


@unhurried
@given(seeds, st.integers(1, 7), st.booleans())
def test_every_pixel_has_an_interval_or_one_cause(seed: int, bits: int, paired: bool) -> None:
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (2 * bits + 2, 5, 7)).astype(np.float32)
    frames = code_frames(
        bits=images[:bits], inverses=images[bits : 2 * bits] if paired else None, white=images[-2], black=images[-1]
    )
    cells = int(rng.integers(1, 2**bits + 1))
    words = index_of_word(Gray(Axis.COLUMN, 0, bits))
    code = decode(frames, NoiseModel(2.0, 0.01), words, cells, DecodingLimits())
    decoded = code.refusal == Refusal.NONE
    assert ((code.lowest >= 0) == decoded).all()
    assert ((code.highest >= 0) == decoded).all()
    assert (code.highest[decoded] >= code.lowest[decoded]).all()
    assert (code.highest[decoded] - code.lowest[decoded] <= DecodingLimits().widest_interval).all()
    assert (code.highest[decoded] < cells).all()
    assert set(np.unique(code.refusal)) <= {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(np.isnan(code.centre()), ~decoded)


@few
@given(st.floats(0, math.pi), st.floats(-6, 6), st.floats(0.9, 1.8), st.booleans())
def test_straight_stripes_and_edges_are_found_where_they_are(
    angle_rad: float, offset_px: float, width_px: float, edge: bool
) -> None:
    x, y = grid((50, 50))
    nx, ny = math.cos(angle_rad), math.sin(angle_rad)
    distance = (x - 25) * nx + (y - 25) * ny - offset_px
    light = np.tanh(distance / width_px).astype(np.float32) if edge else gaussian_stripe(distance, width_px)
    find = edge_points if edge else stripe_points
    noise, lit = np.full((50, 50), 1e-3, dtype=np.float32), np.ones((50, 50), dtype=np.bool_)
    stripes = chained([find(light, noise, lit, StripeLimits(), sigma_px=1.2)], light.shape)
    assert len(stripes) == 1
    errors = (stripes.points_px - 25) @ [nx, ny] - offset_px
    assert np.abs(errors).max() < 0.01
    assert np.isfinite(stripes.sigma_px).all()
    np.testing.assert_allclose(np.linalg.norm(stripes.normals, axis=1), 1.0, atol=1e-9)


@unhurried
@given(seeds, st.integers(0, 300))
def test_chains_use_points_once_in_short_steps(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, [39, 29], (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count) if seed % 2 else rng.normal(0, 0.4, count)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    strength = rng.uniform(0, 1, count)
    strong = rng.random(count) < 0.5
    before = points.copy(), normals.copy(), strength.copy()
    order, offsets = chain_points(points, normals, strength, strong, (30, 40))
    assert len(set(order.tolist())) == len(order) == offsets[-1]
    assert offsets[0] == 0
    assert (np.diff(offsets) >= 2).all()
    for a, b in pairwise(offsets):
        assert strong[order[a:b]].any()
        assert np.linalg.norm(np.diff(points[order[a:b]], axis=0), axis=1).max() <= _LONGEST_STEP_PX
    for array, earlier in zip((points, normals, strength), before, strict=True):
        np.testing.assert_array_equal(array, earlier)


@unhurried
@given(seeds, st.integers(1, 8))
def test_runs_are_long_enough_and_of_one_position(seed: int, shortest: int) -> None:
    rng = np.random.default_rng(seed)
    lowest: IntArray = rng.integers(-1, 4, (40, 4)).astype(np.int32)
    highest = np.where(lowest >= 0, np.minimum(lowest + (rng.random((40, 4)) < 0.2), 4), -1).astype(np.int32)
    refusal = np.where(lowest < 0, int(Refusal.NOT_LIT), 0).astype(np.uint8)
    positions = np.array([[1.5, 1.5, 5.5, 5.5, np.nan]])
    chains = [np.array([[column + 0.1, row] for row in range(40)]) for column in range(4)]
    near = np.asarray(rng.random((40, 4)) < 0.05)
    code = CodeMap(lowest, highest, refusal)
    coded, after = identify(stripes_of(chains), code, positions, near, near, shortest_points=shortest)
    assert (np.diff(coded.stripes.offsets) >= shortest).all()
    assert set(coded.position_px.tolist()) <= {1.5, 5.5}
    columns, rows = np.rint(coded.stripes.points_px).astype(int).T
    shown = positions[0, lowest[rows, columns]]
    np.testing.assert_array_equal(shown, np.repeat(coded.position_px, np.diff(coded.stripes.offsets)))
    # Every other point has a cause, and a cause that was there stays.
    kept = np.zeros((40, 4), dtype=np.bool_)
    kept[rows, columns] = True
    assert ((after == 0) == kept).all()
    assert (after[refusal > 0] == refusal[refusal > 0]).all()


@unhurried
@given(seeds, st.integers(0, 12))
def test_linking_keeps_every_point_once_and_every_stripe_whole(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    chains = [
        rng.uniform(0, 300, 2) + np.cumsum(rng.normal([0, 1], 0.5, (int(rng.integers(2, 20)), 2)), axis=0)
        for _ in range(count)
    ]
    position = rng.integers(0, 4, count).astype(np.float64)
    ensemble = link(CodedStripes(stripes_of(chains), position))
    assert ensemble.position_px.tolist() == sorted(set(position.tolist()))
    assert len(ensemble.points_px) == sum(map(len, chains))
    for number, points in enumerate(chains):
        mine = np.flatnonzero(ensemble.stripe == number)
        assert np.diff(mine).tolist() == [1] * (len(points) - 1)
        found = ensemble.points_px[mine]
        assert (found == points).all() or (found == points[::-1]).all()
    changes = np.diff(ensemble.stripe, append=-1) != 0
    changes[ensemble.offsets[1:] - 1] = False
    np.testing.assert_array_equal(ensemble.bridge_after, changes)
    heads, tails = ensemble.points_px[ensemble.offsets[:-1], 1], ensemble.points_px[ensemble.offsets[1:] - 1, 1]
    assert (heads <= tails).all()


@few
@given(seeds, st.floats(40, 280), st.floats(180, 2000))
def test_what_the_camera_sees_of_a_ball_is_triangulated_onto_it(seed: int, column_px: float, radius_mm: float) -> None:
    ball = Sphere((0.0, 0.0, radius_mm), radius_mm)
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.uniform(90, 150, 30))
    points = lit_rows(column_px, rows, ball)
    ensemble = ensemble_of([opencv_pixels(CAMERA, points)], [column_px])
    curves, _ = camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    assert len(curves.points_mm) == len(points)
    np.testing.assert_allclose(curves.points_mm, points, atol=1e-6)
    # Leaving points out or ordering again changes no point.
    keep = np.asarray(rng.random(len(points)) < 0.6)
    fewer = ordered_along_sheet(selected(curves, keep))
    np.testing.assert_array_equal(fewer.points_mm, curves.points_mm[keep])
    assert not fewer.bridge_after.any()


@st.composite
def projectors(draw: st.DrawFn) -> tuple[Gray, list[LineShift], Size]:
    period_px = draw(st.integers(4, 20))
    extent_px = draw(st.integers(2 * period_px, 400))
    axis = draw(st.sampled_from(Axis))
    offset_px, width_px = draw(st.integers(0, 60)), draw(st.integers(1, period_px - 1))
    cell_px = max(1, period_px // 2)
    code = Gray(axis, 0, gray_bits(extent_px, cell_px, offset_px), cell_px, offset_px)
    size = Size(extent_px, 2) if axis is Axis.COLUMN else Size(2, extent_px)
    return code, [LineShift(axis, shift, period_px, width_px) for shift in range(period_px)], size


@unhurried
@given(projectors())
def test_every_whole_line_away_from_the_border_is_named_by_its_own_cell(
    drawn: tuple[Gray, list[LineShift], Size],
) -> None:
    code, lines, size = drawn
    table = line_positions(lines, code, size)
    extent_px = size.along(code.axis)
    for frame, line in enumerate(lines):
        first = np.arange(line.shift, extent_px - line.line_width_px + 1, line.period_px)
        centres = first + (line.line_width_px - 1) / 2
        centres = centres[np.minimum(centres, extent_px - 1 - centres) >= LEAST_FROM_BORDER_PX]
        cells = (np.floor(centres + 0.5).astype(int) + code.offset_px) // code.cell_px
        np.testing.assert_array_equal(table[frame, cells], centres)
        named = table[frame][np.isfinite(table[frame])]
        assert set(named.tolist()) <= set(centres.tolist())


@unhurried
@given(projectors())
def test_every_edge_is_named_by_both_its_cells_in_one_bit(drawn: tuple[Gray, list[LineShift], Size]) -> None:
    code, _, size = drawn
    table = edge_positions(code, size)
    cells = cell_count(code, size)
    edges: FloatArray = code.cell_px * np.arange(1.0, cells) - code.offset_px - 0.5
    for cell, edge in enumerate(edges, start=1):
        if 0 < edge < size.along(code.axis) - 1:
            both = (table[:, cell - 1] == edge) & (table[:, cell] == edge)
            assert both.sum() == 1
