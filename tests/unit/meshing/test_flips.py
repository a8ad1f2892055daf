"""The constrained edge-flip rule against angles by arccos."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from slrig.meshing.flips import GAMMA, Constraint, constraint, prefers_flip
from slrig.model import FlipRule, FloatArray
from tests.core import parametrize_core


def angle(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """∠abc."""
    u, v = a - b, c - b
    return math.acos(np.clip(float(u @ v) / math.sqrt(float(u @ u) * float(v @ v)), -1, 1))


def verdict(
    p: FloatArray, q: FloatArray, f: FloatArray, w: FloatArray, gamma: float = math.pi / 6
) -> tuple[bool, float, str]:
    """Section 3.1 of the paper, word by word: flip, how far from the nearest threshold, and by which rule.

    With γ = π the sums of angles decide alone, as by Dyer's rule.
    """
    theta_pq = max(angle(f, p, w), angle(f, q, w))
    theta_fw = max(angle(p, f, q), angle(p, w, q))
    excess = theta_fw - theta_pq
    opposite = angle(p, f, q) + angle(p, w, q) - angle(f, p, w) - angle(f, q, w)
    margin = abs(abs(excess) - gamma)
    if excess > gamma:
        return True, margin, "forced"
    if -excess > gamma:
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


GAMMAS = [math.pi / 6, 0.2, math.pi / 2, 2.5]


@pytest.mark.parametrize("kind", TETRAHEDRA)
@parametrize_core("gamma", GAMMAS, core=[0, 1])
@pytest.mark.parametrize("rule", FlipRule)
def test_the_verdict_is_that_of_the_angles(kind: str, gamma: float, rule: FlipRule) -> None:
    rng = np.random.default_rng(17)
    constrained = rule is FlipRule.CONSTRAINED
    rules: dict[tuple[str, bool], int] = {}
    for _ in range(150):
        points = rng.normal(0, 1, (4, 3)) * TETRAHEDRA[kind]
        p, q, f, w = points
        wanted, margin, by = verdict(p, q, f, w, gamma if constrained else math.pi)
        if margin < 1e-7:
            continue
        assert bool(prefers_flip(points, 0, 1, 2, 3, *constraint(rule, gamma))) == wanted
        rules[by, wanted] = rules.get((by, wanted), 0) + 1
    seen = {("delaunay", True), ("delaunay", False)}
    if constrained and gamma < 1:
        seen |= {("forced", True), ("forbidden", False)}
    assert seen <= set(rules)
    assert min(rules[each] for each in seen) > 5


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


def angled_kite(at_p: float, at_q: float, turn: float) -> FloatArray:
    """p, q, f, w in a plane with these angles at p and q, pq its axis, turned."""
    height = 2 / (1 / math.tan(at_p / 2) + 1 / math.tan(at_q / 2))
    along = height / math.tan(at_p / 2) - 1
    flat = np.array([[-1.0, 0.0], [1.0, 0.0], [along, height], [along, -height]])
    x, y = (flat @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])).T
    return np.stack([x, y, np.zeros(4)], axis=1)


@pytest.mark.parametrize("beyond", [-1e-9, 1e-9])
def test_gamma_is_thirty_degrees(beyond: float) -> None:
    assert pytest.approx(math.pi / 6) == GAMMA
    for at_q in np.radians(np.arange(5.0, 41.0)):
        # In a plane θ_fw = π - (at_p + at_q)/2, so θ_pq - θ_fw = γ + beyond at:
        at_p = (math.pi + GAMMA + beyond - at_q / 2) / 1.5
        points = angled_kite(at_p, at_q, at_q)
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


def test_the_constraint_is_that_of_the_paper_unless_told_otherwise() -> None:
    assert constraint(FlipRule.CONSTRAINED) == Constraint(math.cos(GAMMA), math.sin(GAMMA))
    assert constraint(FlipRule.DELAUNAY) == Constraint(-1.0, 0.0)
    for gamma in (-0.1, 3.2, math.nan):
        with pytest.raises(ValueError, match="angle from 0 to π radians"):
            constraint(FlipRule.CONSTRAINED, gamma)
