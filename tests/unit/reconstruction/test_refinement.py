"""Refinement of stripe points by the light of all frames, and the check that this light was steady."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slrig.model import Axis, FloatArray, IntArray, LineShift
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.phase import PositionMap, allocate_points, step_sigma_px
from slrig.reconstruction.refinement import Refinement, _allocate_marks, _find_crossings, refine_points
from slrig.reconstruction.stripes import LinePoints, chain_stripes
from tests.unit.reconstruction.builders import cells_of, grid, nearest_lines

SHAPE = (60, 80)
LINES = tuple(LineShift(Axis.COLUMN, shift, 8, 1) for shift in range(8))
_, POSITION_TABLE = nearest_lines(LINES, 4, 400)
EVERYWHERE = np.ones(SHAPE, dtype=np.bool_)
Surface = Callable[[FloatArray, FloatArray], FloatArray]

SLOPES = pytest.mark.parametrize(
    ("slope", "angle_rad"),
    [(0.4, 0.0), (1.0, math.pi / 4), (-0.8, 1.3), (2.8, 0.2)],
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


def line_crossings(
    seen: PositionMap, usable: NDArray[np.bool_], code: CodeMap, position_of: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Where lines cross pixels, by the position map alone: frame (n,) int32, starts_px (n, 2) and targets_px (n,)."""
    begun = _allocate_marks(len(position_of), usable.shape)
    return _find_crossings(seen, usable, code, position_of, 1, *begun, allocate_points(0), np.zeros(0))


NONE = points_at(np.zeros((0, 2)))


def slope_by_the_rule(
    before: FloatArray, here: FloatArray, after: FloatArray, has_before: NDArray[np.bool_], has_after: NDArray[np.bool_]
) -> FloatArray:
    one_sided = np.where(has_after, after - here, np.where(has_before, here - before, np.nan))
    return np.asarray(np.where(has_before & has_after, (after - before) / 2, one_sided))


@SLOPES
def test_every_pixel_that_a_line_crosses_is_a_start(slope: float, angle_rad: float) -> None:
    here, code = mapped(tilted(slope, angle_rad), noise=0.01)
    rng = np.random.default_rng(4)
    usable = np.asarray(rng.random(SHAPE) >= 0.3)
    code = CodeMap(code.lowest, code.highest + (rng.random(SHAPE) < 0.1), code.refusal)
    frame, starts, targets = line_crossings(here, usable, code, POSITION_TABLE)
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
        line = POSITION_TABLE[k][code.lowest[inner]]
        one = usable[inner] & (line == POSITION_TABLE[k][code.highest[inner]])
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
    frame, starts, targets = line_crossings(here, EVERYWHERE, code, POSITION_TABLE)
    inside = ((starts > 4) & (starts < [SHAPE[1] - 5, SHAPE[0] - 5])).all(axis=1)
    exact = starts - ((surface(*starts.T) - targets) / abs(slope))[:, None] * across
    planted = [0.0, 0.1, 0.0, -0.05, 0.0, 0.0, 0.0, 0.0]
    found = []
    for k, shift in enumerate(planted):
        mine = exact[(frame == k) & inside]
        found.append(points_at(mine + (shift + rng.normal(0, 0.02, len(mine)))[:, None] * across))
    found[5] = NONE
    refinement = refine_points([*found], here, EVERYWHERE, code, POSITION_TABLE, 1)
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


def test_a_sample_checks_the_light_and_the_map_gives_all_points() -> None:
    surface = tilted(0.9, 0.3)
    here, code = mapped(surface, noise=0.002)
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_TABLE)
    rows = (np.rint(starts[:, 1]) % 8 == 0) & (starts[:, 1] > 4) & (starts[:, 1] < SHAPE[0] - 5)
    across = np.array([math.cos(0.3), math.sin(0.3)])
    found = [points_at(starts[(frame == k) & rows] + 0.05 * (k == 2) * across) for k in range(8)]
    usable = EVERYWHERE.copy()
    usable[30:] = False
    held: list[str] = []
    sampled = refine_points(
        [*found], here, usable, code, POSITION_TABLE, 1, sampled=True, release_lines=lambda: held.append("given back")
    )
    assert held == ["given back"]
    assert sampled.disagreement_px[2] == pytest.approx(-0.05, abs=0.02)
    every = refine_points([NONE] * 8, here, usable, code, POSITION_TABLE, 1)
    for one, other, misses in zip(sampled.points, every.points, on_lines(sampled, surface, 0.9), strict=True):
        # Where a line passes between two pixels, one of them has the point; nowhere is none.
        assert np.max(cKDTree(one.points_px).query(other.points_px)[0]) < 1.0
        assert len(one.points_px) < 0.9 * len(other.points_px)
        assert np.abs(misses).max() < 0.02
        # Lines go on beyond the centre of the last usable pixel, and not beyond its border.
        assert other.points_px[:, 1].max() < 29.2 < one.points_px[:, 1].max() < 29.5


@SLOPES
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_no_pixel_holds_two_points_of_one_line(slope: float, angle_rad: float, share: float) -> None:
    here, code = mapped(tilted(slope, angle_rad), noise=0.03)
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_TABLE)
    rng = np.random.default_rng(7)
    # A filter gives a pixel no more than one point.
    pixels = np.rint(starts).astype(int) @ [1, 1000] + 1_000_000 * frame
    _, first = np.unique(pixels, return_index=True)
    first = first[rng.random(len(first)) < share]
    found = [points_at(starts[first][frame[first] == k]) for k in range(8)]
    stripes = chain_stripes(refine_points([*found], here, EVERYWHERE, code, POSITION_TABLE, 1).points, SHAPE)
    frame = np.repeat(stripes.frame, np.diff(stripes.offsets))
    at = np.column_stack([np.rint(stripes.points_px).astype(int), frame])
    assert len(at) > 1400
    assert np.unique(at, axis=0, return_counts=True)[1].max() == 1
    # Nor do the points of a stripe crowd: two pixels that a line passes between have one point, nearly always.
    steps = np.linalg.norm(np.diff(stripes.points_px, axis=0), axis=1)
    steps = np.delete(steps, stripes.offsets[1:-1] - 1)
    assert np.mean(steps < 0.35) < 0.025


@pytest.mark.parametrize(("slope", "angle_rad"), [(2.8, 0.0), (3.5, 0.4), (2.8, math.pi / 2), (-3.0, 0.2)])
def test_squeezed_stripes_that_no_filter_resolves_are_added(slope: float, angle_rad: float) -> None:
    surface = tilted(slope, angle_rad)
    here, code = mapped(surface, noise=0.02)
    x, y = grid(SHAPE)
    refinement = refine_points([NONE] * 8, here, EVERYWHERE, code, POSITION_TABLE, 1)
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


@pytest.mark.parametrize("accepted", [True, False])
def test_points_are_stored_once(*, accepted: bool) -> None:
    here, code = mapped(tilted(0.9, 0.3))
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_TABLE)
    given = [points_at(starts[frame == k]) for k in range(8)]
    found = given.copy()
    limit_px = math.inf if accepted else -1.0
    refinement = refine_points(found, here, EVERYWHERE, code, POSITION_TABLE, 1, max_disagreement_px=limit_px)
    assert found == []
    assert refinement.accepted == accepted
    assert len(refinement.points) == 8
    assert all(one is other for one, other in zip(refinement.points, given, strict=True)) != accepted


def test_mixed_light_and_pixels_of_two_lines_give_no_points() -> None:
    here, code = mapped(tilted(0.9, 0.3))
    x, y = grid(SHAPE)
    usable = ~np.asarray((x >= 30) & (x < 36))
    two = (y >= 20) & (y < 24)
    code = CodeMap(np.where(two, code.lowest - 2, code.lowest).astype(np.int32), code.highest, code.refusal)
    frame, starts, _ = line_crossings(here, EVERYWHERE, cells_of(here.position.astype(np.float64), 4), POSITION_TABLE)
    found = [points_at(starts[frame == k]) for k in range(8)]
    refinement = refine_points([*found], here, usable, code, POSITION_TABLE, 1)
    lost = 0
    for k, points in enumerate(refinement.points):
        columns, rows = np.rint(points.points_px).astype(int).T
        assert usable[rows, columns].all()
        began = np.rint(found[k].points_px).astype(int)
        single = POSITION_TABLE[k][code.lowest] == POSITION_TABLE[k][code.highest]
        lost += int((~single[began[:, 1], began[:, 0]]).sum())
        # A start one pixel off may still end there.
        assert (~single[rows, columns]).mean() < 0.03
    assert lost > 100


def test_points_next_to_a_step_state_the_error_by_light_of_the_other_side() -> None:
    here, code = mapped(tilted(1.0, 0.0), noise=0.01)
    step = np.zeros(SHAPE, dtype=np.bool_)
    step[:, 40] = True
    usable = ~step
    plain = refine_points([NONE] * 8, here, usable, code, POSITION_TABLE, 1)
    stated = refine_points([NONE] * 8, here, usable, code, POSITION_TABLE, 1, extra_sigma_px=step_sigma_px(step))
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
    frame, starts, _ = line_crossings(here, EVERYWHERE, code, POSITION_TABLE)
    found = [points_at(starts[frame == k]) for k in range(8)]
    every = refine_points([*found], here, EVERYWHERE, code, POSITION_TABLE, 1)
    fewer = refine_points([*found], here, EVERYWHERE, code, POSITION_TABLE, 1, coarsest_px=0.15)
    assert 0 < sum(len(each.points_px) for each in fewer.points) < sum(len(each.points_px) for each in every.points)
    assert max(each.sigma_px.max() for each in fewer.points) < 0.15
    assert max(each.sigma_px.max() for each in every.points) < 0.5
