"""The constrained edge-flip rule against angles by arccos."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from slrig.meshing.flips import GAMMA, Constraint, constraint, prefers_flip
from slrig.model import FlipRule, FloatArray


def angle(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """∠abc."""
    u, v = a - b, c - b
    return math.acos(np.clip(float(u @ v) / math.sqrt(float(u @ u) * float(v @ v)), -1, 1))


def verdict(p: FloatArray, q: FloatArray, f: FloatArray, w: FloatArray) -> tuple[bool, float, str]:
    """Section 3.1 of the paper, word by word: flip, how far from the nearest threshold, and by which rule."""
    theta_pq = max(angle(f, p, w), angle(f, q, w))
    theta_fw = max(angle(p, f, q), angle(p, w, q))
    excess = theta_fw - theta_pq
    opposite = angle(p, f, q) + angle(p, w, q) - angle(f, p, w) - angle(f, q, w)
    margin = abs(abs(excess) - math.pi / 6)
    if excess > math.pi / 6:
        return True, margin, "forced"
    if -excess > math.pi / 6:
        return False, margin, "forbidden"
    return opposite > 0, min(margin, abs(opposite)), "delaunay"


def flips(points: FloatArray) -> bool:
    return bool(prefers_flip(points, 0, 1, 2, 3))


TETRAHEDRA = {
    "any": (1.0, 1.0, 1.0),
    "nearly flat": (1.0, 1.0, 0.05),
    "long": (8.0, 1.0, 0.3),
    "in a plane": (1.0, 1.0, 0.0),
}


@pytest.mark.parametrize("kind", TETRAHEDRA)
def test_the_verdict_is_that_of_the_angles(kind: str) -> None:
    rng = np.random.default_rng(17)
    rules: dict[tuple[str, bool], int] = {}
    for _ in range(800):
        points = rng.normal(0, 1, (4, 3)) * TETRAHEDRA[kind]
        wanted, margin, rule = verdict(*points)
        if margin < 1e-7:
            continue
        assert flips(points) == wanted
        rules[rule, wanted] = rules.get((rule, wanted), 0) + 1
    assert set(rules) == {("forced", True), ("forbidden", False), ("delaunay", True), ("delaunay", False)}
    assert min(rules.values()) > 10


def test_the_verdict_does_not_depend_on_size_place_or_turn() -> None:
    rng = np.random.default_rng(18)
    turn, _ = np.linalg.qr(rng.normal(0, 1, (3, 3)))
    for _ in range(100):
        points = rng.normal(0, 1, (4, 3))
        if verdict(*points)[1] > 1e-6:
            moved = 1e3 * points @ turn.T + [300.0, -200.0, 900.0]
            assert flips(np.ascontiguousarray(moved)) == flips(points)


def test_on_a_lattice_ties_keep_the_edge() -> None:
    corners = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float64)
    for scale in (1.0, 0.1, 1 / 3, 1e-6, 1e6):
        for offset in (0.0, 0.7, 1e3):
            square = corners * scale + offset * scale
            assert not flips(square)
            assert not prefers_flip(square, 2, 3, 0, 1)


def angled_kite(at_p: float, at_q: float, *, bend: float = 0.0, turn: float = 0.0) -> FloatArray:
    """p, q, f, w in a plane with these angles at p and q, pq its axis; wrapped round a cylinder of curvature `bend`."""
    height = 2 / (1 / math.tan(at_p / 2) + 1 / math.tan(at_q / 2))
    along = height / math.tan(at_p / 2) - 1
    flat = np.array([[-1.0, 0.0], [1.0, 0.0], [along, height], [along, -height]])
    x, y = (flat @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])).T
    if bend == 0:
        return np.stack([x, y, np.zeros(4)], axis=1)
    return np.stack([np.sin(bend * x) / bend, y, np.cos(bend * x) / bend], axis=1)


@pytest.mark.parametrize("bend", [0.0, 0.15, 0.3])
def test_gamma_overrules_delaunay_both_ways(bend: float) -> None:
    # Figure 5: on few samples of a cylinder the sums of angles prefer an edge that makes a sharp triangle.
    rng = np.random.default_rng(21)
    overruled = 0
    for _ in range(100):
        at_p = math.radians(rng.uniform(128, 150))
        at_q = rng.uniform(0.2, 0.95) * (math.pi - at_p)
        points = angled_kite(at_p, at_q, bend=bend, turn=rng.uniform(0, math.pi))
        wanted, margin, rule = verdict(*points)
        if margin < 1e-6 or rule != "forbidden" or not delaunay(points):
            continue
        assert not wanted
        assert not flips(points)
        assert prefers_flip(points, 2, 3, 0, 1)
        assert prefers_flip(points, 0, 1, 2, 3, *constraint(FlipRule.DELAUNAY))
        overruled += 1
    assert overruled > 25


@pytest.mark.parametrize("beyond", [-1e-9, 1e-9])
def test_gamma_is_thirty_degrees(beyond: float) -> None:
    assert pytest.approx(math.pi / 6) == GAMMA
    for at_q in np.radians(np.arange(5.0, 41.0)):
        # In a plane θ_fw = π - (at_p + at_q)/2, so θ_pq - θ_fw = γ + beyond at:
        at_p = (math.pi + GAMMA + beyond - at_q / 2) / 1.5
        points = angled_kite(at_p, at_q, turn=at_q)
        assert delaunay(points)
        # Beyond γ the largest angles decide against Delaunay, short of it Delaunay holds.
        assert flips(points) == (beyond < 0)
        assert bool(prefers_flip(points, 2, 3, 0, 1)) == (beyond > 0)


def delaunay(points: FloatArray) -> bool:
    p, q, f, w = points
    return angle(p, f, q) + angle(p, w, q) > angle(f, p, w) + angle(f, q, w)


def test_points_that_coincide_or_are_unmeasured_flip_nothing() -> None:
    for points in (
        np.zeros((4, 3)),
        np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]], dtype=np.float64),
        np.full((4, 3), np.nan),
    ):
        assert not flips(points)


def test_squares_on_a_cylinder_keep_the_edge_they_have() -> None:
    heights = np.arange(0, 6, 0.5)
    rulings = [np.stack([np.cos([t] * 12), np.sin([t] * 12), heights], axis=1) for t in (0.0, 0.4, 0.8)]
    for one, other in pairwise(rulings):
        for k in range(11):
            quad = np.stack([one[k], other[k + 1], one[k + 1], other[k]])
            assert not flips(quad)
            assert not prefers_flip(quad, 2, 3, 0, 1)


@pytest.mark.parametrize("kind", TETRAHEDRA)
def test_dyers_rule_compares_the_sums_alone(kind: str) -> None:
    rng = np.random.default_rng(22)
    verdicts = []
    dyer = constraint(FlipRule.DELAUNAY, 0.1)
    for _ in range(400):
        points = rng.normal(0, 1, (4, 3)) * TETRAHEDRA[kind]
        p, q, f, w = points
        margin = abs(angle(p, f, q) + angle(p, w, q) - angle(f, p, w) - angle(f, q, w))
        if margin < 1e-7:
            continue
        found = bool(prefers_flip(points, 0, 1, 2, 3, *dyer))
        assert found == delaunay(points)
        verdicts.append(found)
    assert 40 < sum(verdicts) < len(verdicts) - 40


@pytest.mark.parametrize("gamma", [0.0, 0.2, math.pi / 2, 2.5, math.pi])
def test_gamma_may_be_any_angle(gamma: float) -> None:
    rng = np.random.default_rng(23)
    constrained = constraint(FlipRule.CONSTRAINED, gamma)
    forced = 0
    for _ in range(300):
        points = rng.normal(0, 1, (4, 3)) * [4, 1, 0.3]
        p, q, f, w = points
        excess = max(angle(p, f, q), angle(p, w, q)) - max(angle(f, p, w), angle(f, q, w))
        if abs(abs(excess) - gamma) < 1e-7:
            continue
        wanted = excess > 0 if abs(excess) > gamma else delaunay(points)
        assert bool(prefers_flip(points, 0, 1, 2, 3, *constrained)) == wanted
        forced += abs(excess) > gamma
    assert (forced > 0) == (gamma < 3)


def test_the_constraint_is_that_of_the_paper_unless_told_otherwise() -> None:
    assert constraint(FlipRule.CONSTRAINED) == Constraint(math.cos(GAMMA), math.sin(GAMMA))
    assert constraint(FlipRule.DELAUNAY) == Constraint(-1.0, 0.0)
    for gamma in (-0.1, 3.2, math.nan):
        with pytest.raises(ValueError, match="angle from 0 to π radians"):
            constraint(FlipRule.CONSTRAINED, gamma)
