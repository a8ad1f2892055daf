"""Stripes of one code linked into one curve, as section 2 of the paper has it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from slrig.model import Axis, FloatArray
from slrig.reconstruction.identification import CodedStripes
from slrig.reconstruction.linking import StripeEnsemble, _bend, _end_direction, link
from slrig.reconstruction.triangulation import camera_projector
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR, opencv_pixels, opencv_rays, stripes_of


def linked(*stripes: FloatArray, position_px: list[float] | None = None) -> StripeEnsemble:
    return link(CodedStripes(stripes_of(list(stripes)), np.array(position_px or [7.0] * len(stripes))))


def down(x: float, rows: range, *, lean: float = 0.0) -> FloatArray:
    """A stripe from top to bottom, leaning to the right."""
    return np.array([[x + lean * (row - rows[0]), float(row)] for row in rows])


def points_between(ensemble: StripeEnsemble) -> list[tuple[list[float], list[float]]]:
    """The two ends of each bridge."""
    at = np.flatnonzero(ensemble.bridge_after)
    return [(ensemble.points_px[i].tolist(), ensemble.points_px[i + 1].tolist()) for i in at]


UPPER, LOWER = down(10.0, range(0, 20)), down(10.0, range(30, 45))


@pytest.mark.parametrize("upper", [UPPER, UPPER[::-1]], ids=["down", "up"])
@pytest.mark.parametrize("lower", [LOWER, LOWER[::-1]], ids=["down", "up"])
@pytest.mark.parametrize("swapped", [False, True])
def test_two_stripes_are_joined_end_to_end_whichever_way_they_were_found(
    upper: FloatArray, lower: FloatArray, *, swapped: bool
) -> None:
    ensemble = linked(*((lower, upper) if swapped else (upper, lower)))
    np.testing.assert_array_equal(ensemble.points_px, np.concatenate([UPPER, LOWER]))
    assert points_between(ensemble) == [([10.0, 19.0], [10.0, 30.0])]
    assert ensemble.offsets.tolist() == [0, 35]
    assert ensemble.position_px.tolist() == [7.0]
    assert ensemble.stripe.tolist() == ([1] * 20 + [0] * 15 if swapped else [0] * 20 + [1] * 15)


@pytest.mark.parametrize(("mine", "theirs"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_each_of_the_four_joins_is_chosen_when_it_is_the_smoothest(mine: int, theirs: int) -> None:
    # Two arcs of one circle: the second lies beyond end `mine` of the first and turns its end `theirs` to it.
    def arc(first: float, last: float, count: int) -> FloatArray:
        angle = np.linspace(first, last, count)
        return np.stack([60 * np.cos(angle), 60 * np.sin(angle)], axis=1)

    a = arc(-0.2, 0.2, 30)
    b = arc(0.3, 0.6, 24) if mine == 1 else arc(-0.3, -0.6, 24)
    if theirs == 1:
        b = b[::-1].copy()
    ensemble = linked(a, b)
    joined = [list(pair) for pair in points_between(ensemble)]
    assert len(joined) == 1
    ends = [a[-1 if mine else 0].tolist(), b[-1 if theirs else 0].tolist()]
    assert sorted(joined[0]) == sorted(ends)
    steps = np.linalg.norm(np.diff(ensemble.points_px, axis=0), axis=1)
    assert np.sort(steps)[-2] < 1.0


COLUMN = 150.0


def lit_plate(depth_mm: float, rows: FloatArray) -> FloatArray:
    """(n, 2): pixels of one projector column on a plate at a depth, from top to bottom."""
    pixels = np.column_stack([np.full(len(rows), COLUMN), rows])
    rays = opencv_rays(PROJECTOR, pixels)
    reach = (depth_mm - PROJECTOR.centre_mm[2]) / rays[:, 2]
    return opencv_pixels(CAMERA, PROJECTOR.centre_mm + reach[:, None] * rays)


@pytest.mark.parametrize("step_mm", [-15.0, -5.0, 5.0, 15.0, 60.0])
@pytest.mark.parametrize("turned", [(), (0,), (1,), (0, 1)])
def test_one_light_on_a_step_makes_two_stripes_and_one_curve_along_its_sheet(
    step_mm: float, turned: tuple[int, ...]
) -> None:
    # Figure 2: the plane of light meets two surfaces; in the image the stripes lie beside one another.
    above, below = lit_plate(0.0, np.arange(20.0, 110.0, 0.4)), lit_plate(step_mm, np.arange(112.0, 230.0, 0.4))
    sideways = abs(below[0, 0] - above[-1, 0])
    assert sideways > 0.07 * abs(step_mm)
    stripes = [stripe[::-1].copy() if k in turned else stripe for k, stripe in enumerate((above, below))]
    ensemble = linked(*stripes, position_px=[COLUMN, COLUMN])
    np.testing.assert_array_equal(ensemble.points_px, np.concatenate([above, below]))
    assert np.flatnonzero(ensemble.bridge_after).tolist() == [len(above) - 1]
    # In space the curve runs down the sheet: every point at its own row of the projector, in order.
    sheet, _ = camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    assert len(sheet.points_mm) == len(ensemble.points_px)
    assert (np.diff(sheet.along_px) > 0).all()
    assert np.flatnonzero(sheet.bridge_after).tolist() == [len(above) - 1]


def test_a_cliff_can_mislead_the_papers_rule_and_the_light_sheet_knows_the_order() -> None:
    # The lower stripe lies so far aside that a line to its far end turns less than one to its near end.
    above, below = lit_plate(0.0, np.arange(20.0, 110.0, 0.4)), lit_plate(-60.0, np.arange(112.0, 230.0, 0.4))
    ensemble = linked(above, below, position_px=[COLUMN, COLUMN])
    np.testing.assert_array_equal(ensemble.points_px, curve_by_the_paper([above, below]).points)
    assert points_between(ensemble) == [(above[-1].tolist(), below[-1].tolist())]
    sheet, _ = camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    np.testing.assert_array_equal(sheet.pixels_px, np.concatenate([above, below]))
    assert np.flatnonzero(sheet.bridge_after).tolist() == [len(above) - 1]


def test_adjacent_pixels_of_two_stripes_may_be_far_apart_in_space_and_are_joined_by_a_bridge() -> None:
    # Figure 2 (b, c): the far plate's stripe ends beside the near one's; neighbours in the image, 60 mm apart in depth.
    near, far = lit_plate(-60.0, np.arange(20.0, 110.0, 0.4)), lit_plate(0.0, np.arange(110.4, 200.0, 0.4))
    sheet, _ = camera_projector(linked(near, far, position_px=[COLUMN] * 2), CAMERA, PROJECTOR, Axis.COLUMN)
    (at,) = np.flatnonzero(sheet.bridge_after)
    assert np.linalg.norm(sheet.points_mm[at + 1] - sheet.points_mm[at]) > 59


def test_figure_3_two_stripes_with_four_candidate_joins() -> None:
    # a falls to the left and b goes on to the right of its lower end: of the four joins a's last with b's first is
    # the smoothest, by the sums of the two angles of each.
    a = np.array([[10.0 - 0.02 * t * t / 10, float(t)] for t in range(30)])
    b = np.array([[9.0 + 0.3 * t, 38.0 + t] for t in range(20)])
    sums = {}
    for mine, point, facing in ((0, a[0], end_direction(a)), (1, a[-1], end_direction(a[::-1]))):
        for theirs, other, answering in ((0, b[0], end_direction(b)), (1, b[-1], end_direction(b[::-1]))):
            line = (other - point) / np.linalg.norm(other - point)
            sums[mine, theirs] = math.acos(facing @ line) + math.acos(-answering @ line)
    assert min(sums, key=lambda join: sums[join]) == (1, 0)
    assert sums[1, 0] < 0.5 < min(value for join, value in sums.items() if join != (1, 0))
    for first, second in ((a, b), (a[::-1].copy(), b), (a, b[::-1].copy()), (b, a)):
        np.testing.assert_array_equal(linked(first, second).points_px, np.concatenate([a, b]))


@pytest.mark.parametrize("gap", [0.0, 1e-9, 0.5, 1.0])
@pytest.mark.parametrize("turned", [(), (0,), (1,), (0, 1)])
def test_stripes_that_touch_are_joined_where_they_touch(gap: float, turned: tuple[int, ...]) -> None:
    upper, lower = down(10.0, range(0, 20), lean=0.1), down(11.9, range(19, 34), lean=0.1)
    lower[:, 1] += gap
    stripes = [stripe[::-1].copy() if k in turned else stripe for k, stripe in enumerate((upper, lower))]
    ensemble = linked(*stripes)
    np.testing.assert_array_equal(ensemble.points_px, np.concatenate([upper, lower]))
    assert points_between(ensemble) == [(upper[-1].tolist(), lower[0].tolist())]


def test_stripes_that_touch_in_a_fold_are_joined_elsewhere_if_that_is_smoother() -> None:
    # b begins where a ends, a turn of nearly 180°, runs back beside it and comes down again ahead of a's upper end.
    a = down(0.0, range(0, 30))
    arc = [[4.1 + 4 * math.cos(t), -8 - 4 * math.sin(t)] for t in np.linspace(0, math.pi, 14)]
    b = np.array([[0.0, 29.0], *([8.1 * t / 14, 29.0 - 37 * t / 14] for t in range(1, 14)), *arc])
    b = np.concatenate([b, [[0.1, -7.0 + 0.5 * t] for t in range(8)]])
    np.testing.assert_array_equal(linked(a, b).points_px, curve_by_the_paper([a, b]).points)
    assert points_between(linked(a, b)) in ([(a[0].tolist(), b[-1].tolist())], [(b[-1].tolist(), a[0].tolist())])


def test_pieces_of_one_line_that_interleave_with_another_codes_are_put_in_order() -> None:
    # Two codes broken into five pieces each, given in any order and any direction: each is one line again.
    rng = np.random.default_rng(12)
    bent = {code: np.array([[x + 4 * math.sin(y / 25), y] for y in range(100)]) for code, x in ((3.0, 0.0), (4.0, 3.0))}
    pieces = [(code, line[20 * k : 20 * k + 17]) for code, line in bent.items() for k in range(5)]
    for _ in range(20):
        order = rng.permutation(len(pieces))
        stripes = [pieces[k][1][:: rng.choice([-1, 1])].copy() for k in order]
        ensemble = linked(*stripes, position_px=[pieces[k][0] for k in order])
        wanted = np.concatenate([piece for _, piece in pieces])
        np.testing.assert_array_equal(ensemble.points_px, wanted)
        assert ensemble.bridge_after.sum() == 8


def test_a_stripe_beside_another_is_joined_where_the_curve_turns_least() -> None:
    # Figure 3: b lies to the right of a's lower end; joining a's lower end with b's upper one is smoothest.
    a, b = down(0.0, range(0, 30), lean=0.3), down(14.0, range(34, 60), lean=0.3)
    ensemble = linked(b, a)
    assert points_between(ensemble) == [(a[-1].tolist(), b[0].tolist())]


def test_the_nearest_centroid_comes_first_and_not_the_nearest_end() -> None:
    # c's end is 4 px from a's, its centroid far; b's centroid is nearer. a then b, and c joins at the far end of both.
    a, b, c = down(0.0, range(0, 30)), down(0.0, range(38, 46)), down(0.0, range(-90, -3))
    ensemble = linked(a, b, c)
    # The longest begins: c. Its nearest centroid is a's (14.5 against 41.5).
    np.testing.assert_array_equal(ensemble.points_px, np.concatenate([c, a, b]))
    # `far` and d are as long and d is higher, so d begins. far's end is 5 px from d's, and near's centroid is nearer.
    d, near, far = down(0.0, range(0, 30)), down(20.0, range(10, 20)), down(0.0, range(34, 64))
    wanted = curve_by_the_paper([far, near, d])
    assert wanted.joined == [2, 1, 0]
    np.testing.assert_array_equal(linked(far, near, d).points_px, wanted.points)


@pytest.mark.parametrize("seed", range(8))
def test_the_longest_stripe_begins_and_ties_go_to_the_topmost(seed: int) -> None:
    rng = np.random.default_rng(40 + seed)
    stripes = random_stripes(rng, lengths=[12, 12, 12, 12] if seed % 2 else [12, 9, 8, 13])
    first = int(np.argmin([stripe[:, 1].mean() for stripe in stripes])) if seed % 2 else 3
    wanted = curve_by_the_paper(stripes)
    assert wanted.joined[0] == first
    np.testing.assert_array_equal(linked(*stripes).points_px, wanted.points)


def test_which_stripe_begins_can_change_the_curve() -> None:
    stripes = random_stripes(np.random.default_rng(43), lengths=[12, 12, 12, 12])
    curves = [curve_by_the_paper(stripes, start=k).points for k in range(4)]
    assert not all((curve == curves[0]).all() for curve in curves)


def test_after_a_join_the_centroid_is_that_of_all_points() -> None:
    # Equation 2. a (20 points, y = 9.5) takes b (19 points, y = 39): the centroid goes to y = 23.9. Then d, at 57,
    # is nearer (33.1) than c, at -12 (35.9); from a's own centroid c would have been (21.5 against 47.5).
    a, b = down(0.0, range(0, 20)), down(0.0, range(30, 49))
    c, d = down(21.0, range(-14, -9)), down(6.0, range(55, 60))
    ensemble = linked(a, b, c, d)
    wanted = curve_by_the_paper([a, b, c, d])
    assert wanted.joined == [0, 1, 3, 2]
    np.testing.assert_array_equal(ensemble.points_px, wanted.points)


def test_the_curve_starts_at_its_upper_end() -> None:
    for stripe in (UPPER, UPPER[::-1].copy()):
        ensemble = linked(stripe)
        np.testing.assert_array_equal(ensemble.points_px, UPPER)
        assert not ensemble.bridge_after.any()


def test_codes_are_linked_apart_and_come_in_rising_order() -> None:
    stripes = [down(30.0, range(0, 10)), down(10.0, range(20, 30)), down(10.0, range(0, 10)), down(50.0, range(0, 5))]
    ensemble = linked(*stripes, position_px=[11.5, 3.5, 3.5, 19.5])
    assert ensemble.position_px.tolist() == [3.5, 11.5, 19.5]
    assert ensemble.offsets.tolist() == [0, 20, 30, 35]
    assert np.flatnonzero(ensemble.bridge_after).tolist() == [9]
    assert ensemble.stripe.tolist() == [2] * 10 + [1] * 10 + [0] * 10 + [3] * 5


def test_stripes_side_by_side_still_make_one_curve_of_all_their_points() -> None:
    # Interleaved in y, as at an overhang: the paper's rule has an answer, and every point is in it once.
    a, b, c = down(0.0, range(0, 40)), down(12.0, range(10, 50)), down(24.0, range(-5, 22))
    ensemble = linked(a, b, c)
    np.testing.assert_array_equal(ensemble.points_px, curve_by_the_paper([a, b, c]).points)
    everything = np.concatenate([a, b, c])
    assert sorted(map(tuple, ensemble.points_px.tolist())) == sorted(map(tuple, everything.tolist()))
    assert ensemble.bridge_after.sum() == 2
    changes = np.flatnonzero(np.diff(ensemble.stripe) != 0)
    assert changes.tolist() == np.flatnonzero(ensemble.bridge_after).tolist()


def test_points_keep_their_normals_and_deviations() -> None:
    chains = [LOWER[::-1].copy(), UPPER]
    angles = np.linspace(0, 1, 35)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    stripes = stripes_of(chains, normals=[normals[:15], normals[15:]])
    ensemble = link(CodedStripes(stripes, np.array([7.0, 7.0])))
    for point, normal, sigma in zip(ensemble.points_px, ensemble.normals, ensemble.sigma_px, strict=True):
        (source,) = np.flatnonzero((stripes.points_px == point).all(axis=1))
        np.testing.assert_array_equal(normal, stripes.normals[source])
        assert sigma == stripes.sigma_px[source]


def test_nothing_links_to_nothing() -> None:
    ensemble = link(CodedStripes(stripes_of([]), np.zeros(0)))
    assert ensemble.offsets.tolist() == [0]
    assert len(ensemble.position_px) == len(ensemble.points_px) == 0


def end_direction(points: FloatArray) -> FloatArray:
    """Equation 1 at the first point: λ falls evenly with the distance from the end, over at most ten points."""
    reach = min(10, len(points))
    steps = points[: reach - 1] - points[1:reach]
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    weighted = np.arange(reach - 1, 0, -1) @ steps
    return np.asarray(weighted / np.linalg.norm(weighted))


@pytest.mark.parametrize("count", [2, 3, 9, 10, 11, 30])
def test_the_direction_of_an_end_is_equation_1(count: int) -> None:
    points = np.cumsum(np.random.default_rng(count).normal([1.0, 0.4], 0.4, (count, 2)), axis=0)
    out = np.zeros(2)
    _end_direction(points, 0, 1, count, out)
    np.testing.assert_allclose(out, end_direction(points), atol=1e-12)
    _end_direction(points, count - 1, -1, count, out)
    np.testing.assert_allclose(out, end_direction(points[::-1]), atol=1e-12)


def test_a_lone_point_has_no_direction() -> None:
    out = np.zeros(2)
    _end_direction(np.array([[3.0, 4.0]]), 0, 1, 1, out)
    assert out.tolist() == [0.0, 0.0]


def test_the_bend_of_a_join_is_the_sum_of_its_two_angles() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        a, b = rng.uniform(-5, 5, (2, 2))
        first, second = rng.normal(0, 1, (2, 2))
        first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
        along = (b - a) / np.linalg.norm(b - a)
        wanted = math.acos(float(first @ along)) + math.acos(float(-(second @ along)))
        assert _bend(a, first, b, second) == pytest.approx(wanted, abs=1e-9)
    straight = _bend(np.zeros(2), np.array([1.0, 0.0]), np.array([3.0, 0.0]), np.array([-1.0, 0.0]))
    assert straight == 0.0


class Linked(NamedTuple):
    """The curve of one code, and the order in which its stripes were taken."""

    points: FloatArray
    joined: list[int]


def curve_by_the_paper(stripes: list[FloatArray], *, start: int | None = None) -> Linked:
    """The pseudocode of section 2, on lists of points."""
    left = dict(enumerate(stripes))
    if start is None:
        start = min(left, key=lambda k: (-len(left[k]), left[k][:, 1].mean()))
    curve = left.pop(start)
    taken = [start]
    # Directions stay those of the stripes whose ends they are.
    facing = [end_direction(curve), end_direction(curve[::-1])]
    centroid, weight = curve.mean(axis=0), len(curve)
    while left:
        near = min(left, key=lambda k: (float(((left[k].mean(axis=0) - centroid) ** 2).sum()), k))
        b = left.pop(near)
        taken.append(near)
        theirs = [end_direction(b), end_direction(b[::-1])]
        best = (math.inf, 0, 0)
        for i in range(2):
            for k in range(2):
                join = b[-k] - curve[-i]
                length = float(np.linalg.norm(join))
                # Ends that touch: the turn from one direction into the other.
                join = join / length if length else facing[i]
                bend = math.acos(np.clip(facing[i] @ join, -1, 1)) + math.acos(np.clip(-(theirs[k] @ join), -1, 1))
                best = min(best, (bend, i, k))
        _, i, k = best
        if i == 1:
            curve = np.concatenate([curve, b[::-1] if k == 1 else b])
        else:
            curve = np.concatenate([b if k == 1 else b[::-1], curve])
        facing[i] = theirs[1 - k]
        centroid = (weight * centroid + len(b) * b.mean(axis=0)) / (weight + len(b))
        weight += len(b)
    return Linked(curve if curve[0, 1] <= curve[-1, 1] else curve[::-1], taken)


def random_stripes(rng: np.random.Generator, *, lengths: list[int]) -> list[FloatArray]:
    """Wandering stripes anywhere, some found upwards."""
    stripes = []
    for count in lengths:
        steps = rng.normal([0.2, 1.0], 0.3) + rng.normal(0, 0.2, (count, 2))
        stripe = rng.uniform([0, 0], [60, 200]) + np.cumsum(steps, axis=0)
        stripes.append(stripe[::-1].copy() if rng.random() < 0.5 else stripe)
    return stripes


@pytest.mark.parametrize("seed", range(20))
def test_random_stripes_are_linked_as_the_paper_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stripes = random_stripes(rng, lengths=rng.integers(5, 40, rng.integers(2, 9)).tolist())
    ensemble = linked(*stripes)
    np.testing.assert_array_equal(ensemble.points_px, curve_by_the_paper(stripes).points)
    assert ensemble.bridge_after.sum() == len(stripes) - 1
    assert not ensemble.bridge_after[-1]
