"""Stripes of one code linked into one curve, as section 2 of the paper has it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from slrig.model import FloatArray
from slrig.reconstruction.identification import CodedStripes
from slrig.reconstruction.linking import StripeEnsemble, _bend, _end_direction, link
from tests.unit.reconstruction.builders import stripes_of


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
    # Interleaved in y, as at an overhang: the order is a matter of taste, completeness is not.
    a, b, c = down(0.0, range(0, 40)), down(12.0, range(10, 50)), down(24.0, range(-5, 22))
    ensemble = linked(a, b, c)
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
                join = join / np.linalg.norm(join)
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
