"""Stripe points moved to where the light of all frames puts them, and the check that this light was steady."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, Capture, FloatArray, LineShift, Pattern, Shot, Size
from slrig.patterns.positions import cell_positions, index_of_word, line_positions
from slrig.patterns.sequence import scan_patterns
from slrig.reconstruction.camera import CameraCurves, camera_curves
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.edges import beside_steps_px
from slrig.reconstruction.frames import axis_frames
from slrig.reconstruction.limits import CodeTables, Limits
from slrig.reconstruction.phase import PositionMap
from slrig.reconstruction.refinement import Refinement, refined
from slrig.reconstruction.stripes import LinePoints, chained
from tests.unit.reconstruction.builders import cells_of, grid, nearest_lines, seen_by_camera
from tests.unit.reconstruction.refining import fitted_points, line_crossings

SHAPE = (60, 80)
PROJECTOR = Size(160, 128)
LINES = tuple(LineShift(Axis.COLUMN, shift, 8, 1) for shift in range(8))
_, POSITION_OF = nearest_lines(LINES, 4, 400)
EVERYWHERE = np.ones(SHAPE, dtype=np.bool_)
Surface = Callable[[FloatArray, FloatArray], FloatArray]

SLOPES = pytest.mark.parametrize(
    ("slope", "angle_rad"),
    [(0.4, 0.0), (1.0, math.pi / 6), (1.0, math.pi / 4), (-0.8, 1.3), (1.2, math.pi / 2), (2.8, 0.2), (5.0, 0.5)],
)


def tilted(slope: float, angle_rad: float) -> Surface:
    return lambda x, y: np.asarray(700 + slope * (math.cos(angle_rad) * x + math.sin(angle_rad) * y))


def mapped(surface: Surface, *, noise: float = 0.0) -> tuple[PositionMap, CodeMap]:
    truth = surface(*grid(SHAPE))
    position = truth + noise * np.random.default_rng(3).normal(0, 1, SHAPE)
    sigma = np.full(SHAPE, max(noise, 1e-3), dtype=np.float32)
    return PositionMap(position.astype(np.float32), sigma), cells_of(truth, 4)


def points_at(points_px: FloatArray) -> LinePoints:
    count = len(points_px)
    return LinePoints(
        points_px, np.tile([1.0, 0.0], (count, 1)), np.linspace(0.5, 1.0, count), np.ones(count, dtype=np.bool_),
        np.full(count, 1.0),
    )  # fmt: skip


NONE = points_at(np.zeros((0, 2)))


def slope_by_the_rule(
    before: FloatArray, here: FloatArray, after: FloatArray, has_before: NDArray[np.bool_], has_after: NDArray[np.bool_]
) -> FloatArray:
    one_sided = np.where(has_after, after - here, np.where(has_before, here - before, np.nan))
    return np.asarray(np.where(has_before & has_after, (after - before) / 2, one_sided))


@SLOPES
@pytest.mark.parametrize("missing", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_every_pixel_that_a_line_crosses_is_a_start(slope: float, angle_rad: float, missing: float) -> None:
    here, code = mapped(tilted(slope, angle_rad), noise=0.01)
    rng = np.random.default_rng(4)
    usable = np.asarray(rng.random(SHAPE) >= missing)
    code = CodeMap(code.lowest, code.highest + (rng.random(SHAPE) < 0.1), code.refusal)
    frame, starts, targets = line_crossings(here, usable, code, POSITION_OF)
    p = here.position.astype(np.float64)
    inner = (slice(1, -1), slice(1, -1))
    left, right = (slice(1, -1), slice(None, -2)), (slice(1, -1), slice(2, None))
    above, below = (slice(None, -2), slice(1, -1)), (slice(2, None), slice(1, -1))
    gx = slope_by_the_rule(p[left], p[inner], p[right], usable[left], usable[right])
    gy = slope_by_the_rule(p[above], p[inner], p[below], usable[above], usable[below])
    found = {
        (int(k), float(target), round(float(at_x), 3), round(float(at_y), 3))
        for k, target, (at_x, at_y) in zip(frame, targets, starts, strict=True)
    }
    rows, columns = np.mgrid[1 : SHAPE[0] - 1, 1 : SHAPE[1] - 1]
    sure = possible = 0
    for k in range(8):
        line = POSITION_OF[k][code.lowest[inner]]
        one = usable[inner] & (line == POSITION_OF[k][code.highest[inner]])
        with np.errstate(divide="ignore", invalid="ignore"):
            dx, dy = (line - p[inner]) * gx / (gx**2 + gy**2), (line - p[inner]) * gy / (gx**2 + gy**2)
        across = np.maximum(np.abs(dx), np.abs(dy))
        mine = {each for each in found if each[0] == k}
        within = one & (across < 0.499)
        for y, x in zip(*np.nonzero(within), strict=True):
            wanted = (k, float(line[y, x]), columns[y, x] + dx[y, x], rows[y, x] + dy[y, x])
            assert any(
                each[1] == wanted[1] and abs(each[2] - wanted[2]) < 2e-3 and abs(each[3] - wanted[3]) < 2e-3
                for each in near(mine, wanted)
            )
        sure += int(within.sum())
        possible += int((one & (across < 0.8)).sum())
    # At half a pixel the neighbour has it, or both have.
    assert 200 < sure <= len(frame) <= possible
    assert (np.diff(frame) >= 0).all()


def near(
    found: set[tuple[int, float, float, float]], wanted: tuple[int, float, float, float]
) -> list[tuple[int, float, float, float]]:
    """Those of the set whose rounding to three digits is one of the few that can be meant."""
    steps = (-0.001, 0.0, 0.001)
    meant = [(wanted[0], wanted[1], round(wanted[2] + a, 3), round(wanted[3] + b, 3)) for a in steps for b in steps]
    return [each for each in meant if each in found]


def on_lines(refinement: Refinement, surface: Surface, slope: float) -> list[FloatArray]:
    """Distance of each frame's points from the nearest of its lines, camera pixels."""
    out = []
    for k, points in enumerate(refinement.points):
        away = surface(*points.points_px.T) - k
        out.append((away - 8 * np.rint(away / 8)) / slope)
    return out


@SLOPES
def test_points_of_the_filter_move_onto_their_lines_and_say_how_far(slope: float, angle_rad: float) -> None:
    surface = tilted(slope, angle_rad)
    here, code = mapped(surface, noise=0.002 * abs(slope))
    rng = np.random.default_rng(6)
    across = np.sign(slope) * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    frame, starts, targets = line_crossings(here, EVERYWHERE, code, POSITION_OF)
    inside = ((starts > 4) & (starts < [SHAPE[1] - 5, SHAPE[0] - 5])).all(axis=1)
    exact = starts - ((surface(*starts.T) - targets) / abs(slope))[:, None] * across
    planted = [0.0, 0.1, 0.0, -0.05, 0.0, 0.0, 0.0, 0.0]
    found = []
    for k, shift in enumerate(planted):
        mine = exact[(frame == k) & inside]
        found.append(points_at(mine + (shift + rng.normal(0, 0.02, len(mine)))[:, None] * across))
    found[5] = NONE
    refinement = refined([*found], here, EVERYWHERE, code, POSITION_OF)
    for k, misses in enumerate(on_lines(refinement, surface, slope)):
        assert len(misses) >= len(found[k].points_px)
        # Lines of other pixels that the code calls by the same cell are refused before; the rest is on its line.
        assert np.abs(misses).max() < 0.02
        if k == 5:
            assert np.isnan(refinement.disagreement_px[k])
        else:
            assert refinement.disagreement_px[k] == pytest.approx(-planted[k], abs=0.025)
        points = refinement.points[k]
        kept = len(found[k].points_px)
        np.testing.assert_array_equal(points.strength[:kept], found[k].strength)
        # Chains begin at what the filter found.
        assert points.strength[kept:].max(initial=0.0) < points.strength[:kept].min(initial=1.0)


@SLOPES
@pytest.mark.parametrize("share", [0.0, pytest.param(0.5, marks=pytest.mark.slow), 1.0])
def test_no_pixel_holds_two_points_of_one_line(slope: float, angle_rad: float, share: float) -> None:
    here, code = mapped(tilted(slope, angle_rad), noise=0.03)
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_OF)
    rng = np.random.default_rng(7)
    # A filter gives a pixel no more than one point.
    pixels = np.rint(starts).astype(int) @ [1, 1000] + 1_000_000 * frame
    _, first = np.unique(pixels, return_index=True)
    first = first[rng.random(len(first)) < share]
    found = [points_at(starts[first][frame[first] == k]) for k in range(8)]
    stripes = chained(refined([*found], here, EVERYWHERE, code, POSITION_OF).points, SHAPE)
    frame = np.repeat(stripes.frame, np.diff(stripes.offsets))
    at = np.column_stack([np.rint(stripes.points_px).astype(int), frame])
    assert len(at) > 1400
    assert np.unique(at, axis=0, return_counts=True)[1].max() == 1
    # Nor do the points of a stripe crowd: two pixels that a line passes between have one point, nearly always.
    steps = np.linalg.norm(np.diff(stripes.points_px, axis=0), axis=1)
    steps = np.delete(steps, stripes.offsets[1:-1] - 1)
    assert np.mean(steps < 0.35) < 0.025


@pytest.mark.parametrize(("slope", "angle_rad"), [(2.8, 0.0), (3.5, 0.4), (2.8, math.pi / 2), (-3.0, 0.2)])
def test_squeezed_stripes_that_no_filter_tells_apart_are_added(slope: float, angle_rad: float) -> None:
    surface = tilted(slope, angle_rad)
    here, code = mapped(surface, noise=0.02)
    x, y = grid(SHAPE)
    refinement = refined([NONE] * 8, here, EVERYWHERE, code, POSITION_OF)
    truth = surface(x, y)
    inner = np.zeros(SHAPE, dtype=np.bool_)
    inner[4:-4, 4:-4] = True
    for k, (points, misses) in enumerate(zip(refinement.points, on_lines(refinement, surface, slope), strict=True)):
        assert np.abs(misses).max() < 0.05
        held = np.zeros(SHAPE, dtype=np.bool_)
        columns, rows = np.rint(points.points_px).astype(int).T
        held[rows, columns] = True
        away = (truth - k + 4) % 8 - 4
        crossed = np.abs(away) < 0.4 * abs(slope) * max(abs(math.cos(angle_rad)), abs(math.sin(angle_rad)))
        assert held[crossed & inner].mean() > 0.97
        assert points.strong.mean() > 0.9
    assert np.isnan(refinement.disagreement_px).all()


@pytest.mark.parametrize("moved", [True, False])
def test_points_are_held_once(*, moved: bool) -> None:
    here, code = mapped(tilted(0.9, 0.3))
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_OF)
    given = [points_at(starts[frame == k]) for k in range(8)]
    found = given.copy()
    limit_px = math.inf if moved else -1.0
    refinement = refined(found, here, EVERYWHERE, code, POSITION_OF, largest_disagreement_px=limit_px)
    assert found == []
    assert refinement.moved == moved
    assert len(refinement.points) == 8
    assert all(one is other for one, other in zip(refinement.points, given, strict=True)) != moved


def test_mixed_light_and_pixels_of_two_lines_give_no_points() -> None:
    here, code = mapped(tilted(0.9, 0.3))
    x, y = grid(SHAPE)
    usable = ~np.asarray((x >= 30) & (x < 36))
    two = (y >= 20) & (y < 24)
    code = CodeMap(np.where(two, code.lowest - 2, code.lowest).astype(np.int32), code.highest, code.refusal)
    frame, starts, _ = line_crossings(here, EVERYWHERE, cells_of(here.position.astype(np.float64), 4), POSITION_OF)
    found = [points_at(starts[frame == k]) for k in range(8)]
    refinement = refined([*found], here, usable, code, POSITION_OF)
    lost = 0
    for k, points in enumerate(refinement.points):
        columns, rows = np.rint(points.points_px).astype(int).T
        assert usable[rows, columns].all()
        began = np.rint(found[k].points_px).astype(int)
        single = POSITION_OF[k][code.lowest] == POSITION_OF[k][code.highest]
        lost += int((~single[began[:, 1], began[:, 0]]).sum())
        # A start one pixel off may still end there.
        assert (~single[rows, columns]).mean() < 0.03
    assert lost > 100


def test_points_beside_a_step_stay_and_state_what_light_of_the_other_side_does() -> None:
    here, code = mapped(tilted(1.0, 0.0), noise=0.01)
    step = np.zeros(SHAPE, dtype=np.bool_)
    step[:, 40] = True
    usable = ~step
    plain = refined([NONE] * 8, here, usable, code, POSITION_OF)
    stated = refined([NONE] * 8, here, usable, code, POSITION_OF, displaced_px=beside_steps_px(step))
    beside = 0
    for one, other in zip(plain.points, stated.points, strict=True):
        np.testing.assert_array_equal(one.points_px, other.points_px)
        np.testing.assert_array_equal(one.strength, other.strength)
        off = np.abs(np.rint(one.points_px[:, 0]) - 40)
        more = np.sqrt(np.maximum(other.sigma_px**2 - one.sigma_px**2, 0))
        np.testing.assert_allclose(more, np.select([off == 1, off == 2], [0.04, 0.015], 0.0), atol=1e-6)
        beside += int((off == 1).sum())
    assert beside > 10


def test_points_too_coarse_to_use_are_left_out() -> None:
    here, code = mapped(tilted(0.9, 0.3), noise=0.3)
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_OF)
    found = [points_at(starts[frame == k]) for k in range(8)]
    every = refined([*found], here, EVERYWHERE, code, POSITION_OF)
    fewer = refined([*found], here, EVERYWHERE, code, POSITION_OF, coarsest_px=0.15)
    assert 0 < sum(len(each.points_px) for each in fewer.points) < sum(len(each.points_px) for each in every.points)
    assert max(each.sigma_px.max() for each in fewer.points) < 0.15
    assert max(each.sigma_px.max() for each in every.points) < 0.5


def test_what_is_skipped_as_already_there_is_there() -> None:
    """Points and crossings refined by themselves, and each crossing kept unless its pixel holds a point."""
    surface = tilted(1.1, 0.4)
    here, code = mapped(surface, noise=0.05)
    usable = np.asarray(np.random.default_rng(8).random(SHAPE) > 0.05)
    frame, starts, targets = line_crossings(here, usable, code, POSITION_OF)
    drawn = np.random.default_rng(9).random(len(frame)) < 0.6
    found = [points_at(starts[drawn & (frame == k)]) for k in range(8)]
    refinement = refined([*found], here, usable, code, POSITION_OF)
    for k, points in enumerate(refinement.points):
        mine = frame == k
        ended, _, sigma_px, good, _ = fitted_points(here, usable, starts[mine], targets[mine])
        wanted = {tuple(each) for each in np.rint(ended[good & (sigma_px < 0.5)]).astype(int)}
        assert {tuple(each) for each in np.rint(points.points_px).astype(int)} == wanted


def column_patterns(axis: Axis = Axis.COLUMN) -> tuple[Pattern, ...]:
    shown = scan_patterns(
        PROJECTOR, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0,
        rows=axis is Axis.ROW,
    )  # fmt: skip
    return tuple(each for each in shown if getattr(each, "axis", axis) is axis)


def walked(capture: Capture, *, axis: Axis = Axis.COLUMN, limits: Limits | None = None) -> CameraCurves:
    frames = axis_frames(capture, "eye", axis)
    tables = CodeTables(
        index_of_word(frames.gray), cell_positions(frames.gray, PROJECTOR),
        line_positions(frames.line_patterns, frames.gray, PROJECTOR),
    )  # fmt: skip
    return camera_curves(frames, tables, limits or Limits(), entered=lambda _: None)


def sloped(slope: float, angle_rad: float, shape: tuple[int, int] = (100, 120)) -> FloatArray:
    x, y = grid(shape)
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.asarray(64 + slope * (cosine * (x - shape[1] / 2) + sine * (y - shape[0] / 2)))


def with_light_changed(capture: Capture, shift: int, *, offset: float = 0.0, gain: float = 1.0) -> Capture:
    """The same frames, with the light of one line frame changed."""

    def changed(shot: Shot) -> Shot:
        pattern = capture.patterns[shot.pattern]
        if not isinstance(pattern, LineShift) or pattern.shift != shift:
            return shot
        counts = np.clip(np.rint(shot.image * gain + offset), 0, 255)
        return replace(shot, image=counts.astype(shot.image.dtype))

    return replace(capture, shots=tuple(map(changed, capture.shots)))


def misses_px(curves: CameraCurves, slope: float, angle_rad: float, shape: tuple[int, int] = (100, 120)) -> FloatArray:
    ensemble = curves.ensemble
    line = np.repeat(ensemble.position_px, np.diff(ensemble.offsets))
    x, y = ensemble.points_px.T
    at = 64 + slope * (math.cos(angle_rad) * (x - shape[1] / 2) + math.sin(angle_rad) * (y - shape[0] / 2))
    return np.asarray((at - line) / slope)


@pytest.mark.parametrize("axis", list(Axis))
@pytest.mark.parametrize("angle_rad", [0.0, math.pi / 6, math.pi / 2, math.pi, -2.5])
def test_stripes_of_any_direction_and_axis_are_refined(angle_rad: float, axis: Axis) -> None:
    slope = 0.9
    capture = seen_by_camera(sloped(slope, angle_rad), column_patterns(axis), PROJECTOR, axis=axis, blur_px=0.8)
    curves = walked(capture, axis=axis)
    assert curves.refined
    errors = misses_px(curves, slope, angle_rad)
    assert len(errors) > 8000
    # Beside the projector's border the light of the lines that it has no room for is missing.
    line = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
    within = (line >= 3) & (line <= (PROJECTOR.along(axis) - 4))
    assert np.sqrt(np.mean(errors**2)) < 0.02
    assert abs(errors.mean()) < 0.002
    assert np.abs(errors[within]).max() < 0.09
    assert np.abs(errors).max() < 0.25
    assert np.sqrt(np.mean((errors / curves.ensemble.sigma_px) ** 2)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("slope", [0.5, 0.8, 1.2, 1.6])
def test_refined_points_are_no_worse_than_those_of_their_own_frame(slope: float) -> None:
    capture = seen_by_camera(sloped(slope, 0.2), column_patterns(), PROJECTOR, blur_px=0.9 * slope, noise=1.5)
    rms = []
    # This camera has no blur that would mix the albedo of neighbouring pixels.
    for limits in (Limits(camera_blur_px=0.0), Limits(largest_disagreement_px=-1.0)):
        curves = walked(capture, limits=limits)
        # Where the filter's window is whole; beside the image's border only a fit gives points.
        at = curves.ensemble.points_px
        inside = ((at > 12) & (at < [107, 87])).all(axis=1)
        assert inside.sum() > 3000
        rms.append(float(np.sqrt(np.mean(misses_px(curves, slope, 0.2)[inside] ** 2))))
    assert rms[0] < 1.1 * rms[1]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("slope", "noise"), [(0.6, 0.8), (0.9, 4.0), (1.4, 2.0)])
def test_steady_light_is_never_called_unsteady(slope: float, noise: float, seed: int) -> None:
    position = sloped(slope, 0.3 * seed)
    capture = seen_by_camera(position, column_patterns(), PROJECTOR, noise=noise, seed=seed, blur_px=0.7)
    curves = walked(capture)
    assert curves.refined
    assert np.nanmax(np.abs(curves.disagreement_px)) < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_a_small_thing_in_steady_light_is_refined_as_a_large_one(seed: int) -> None:
    x, y = grid((100, 120))
    position = np.where(np.hypot(x - 60, y - 50) < 12, sloped(0.6, 0.2), np.nan)
    capture = seen_by_camera(
        position, column_patterns(), PROJECTOR, noise=1.0, seed=seed, blur_px=0.5, smear_px=0.8, white=90.0
    )
    curves = walked(capture)
    assert len(curves.ensemble.points_px) > 150
    assert curves.refined


@pytest.mark.parametrize("seed", range(4))
def test_noise_on_a_dark_thing_is_no_unsteady_light(seed: int) -> None:
    # Ten grey levels of contrast.
    position = sloped(0.9, 0.2)
    curves = walked(
        seen_by_camera(position, column_patterns(), PROJECTOR, noise=0.8, seed=seed, blur_px=0.6, white=12.0)
    )
    assert len(curves.ensemble.points_px) > 500
    assert curves.refined


@pytest.mark.parametrize("shift", [0, 3, 7])
@pytest.mark.parametrize(("offset", "gain"), [(4.0, 1.0), (-6.0, 1.0), (0.0, 0.7), (3.0, 1.2)])
def test_light_that_changes_in_one_frame_leaves_each_stripe_as_its_own_frame_shows_it(
    shift: int, offset: float, gain: float
) -> None:
    slope = 0.7
    steady = seen_by_camera(sloped(slope, 0.3), column_patterns(), PROJECTOR, blur_px=0.7)
    capture = with_light_changed(steady, shift, offset=offset, gain=gain)
    curves = walked(capture)
    assert not curves.refined
    assert np.nanmax(np.abs(curves.disagreement_px)) > 0.03
    unrefined = walked(capture, limits=Limits(largest_disagreement_px=-1.0))
    for name in ("points_px", "normals", "sigma_px", "offsets", "position_px", "bridge_after", "stripe"):
        np.testing.assert_array_equal(getattr(curves.ensemble, name), getattr(unrefined.ensemble, name))
    np.testing.assert_array_equal(curves.refusal, unrefined.refusal)
    # What stays of the change is what it does to its own frame's stripes.
    assert np.sqrt(np.mean(misses_px(curves, slope, 0.3) ** 2)) < 0.03
    trusting = walked(capture, limits=Limits(largest_disagreement_px=math.inf))
    assert trusting.refined
    assert np.sqrt(np.mean(misses_px(trusting, slope, 0.3) ** 2)) > 0.03


def test_a_camera_of_deep_samples_sees_the_same() -> None:
    shallow = seen_by_camera(sloped(0.9, 0.3), column_patterns(), PROJECTOR, blur_px=0.8, noise=1.0)
    deep = tuple(replace(shot, image=shot.image.astype(np.uint16) * np.uint16(64)) for shot in shallow.shots)
    camera = replace(shallow.cameras["eye"], bit_depth=14)
    ours = walked(shallow)
    other = walked(replace(shallow, cameras={"eye": camera}, shots=deep))
    assert ours.refined
    assert other.refined
    assert len(other.ensemble.points_px) == pytest.approx(len(ours.ensemble.points_px), rel=0.01)
    assert np.sqrt(np.mean(misses_px(other, 0.9, 0.3) ** 2)) < 0.02


def test_without_one_shift_stripes_stand_as_their_frames_show_them() -> None:
    every = seen_by_camera(sloped(0.9, 0.3), column_patterns(), PROJECTOR, blur_px=0.8)
    kept = [i for i, p in enumerate(every.patterns) if not isinstance(p, LineShift) or p.shift != 5]
    shots = tuple(replace(s, pattern=kept.index(s.pattern)) for s in every.shots if s.pattern in kept)
    curves = walked(replace(every, patterns=tuple(every.patterns[i] for i in kept), shots=shots))
    assert not curves.refined
    assert len(curves.disagreement_px) == 0
    assert {int(p) % 8 for p in curves.ensemble.position_px} == {0, 1, 2, 3, 4, 6, 7}
    assert np.sqrt(np.mean(misses_px(curves, 0.9, 0.3) ** 2)) < 0.03
