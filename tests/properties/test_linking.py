"""The whole linking procedure of section 2 against the paper's pseudocode, in plain Python on complex numbers."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from slrig.reconstruction.identification import NumberedStripes, link_stripes
from tests.unit.reconstruction.builders import stripes_of

# A choice between two that are closer than this is one of rounding.
CLOSE = 1e-7
POINTS_AT_AN_END = 10

Stripe = list[complex]


@dataclass
class Growing:
    """The curve so far: its points, the stripe of each, the outward directions of its two ends, its centroid."""

    points: Stripe
    stripes: list[int]
    directions: list[complex]
    centroid: complex


def direction_of_end(stripe: Stripe) -> complex:
    """Equation 1 at the first point: Σ λ_t v_t over the r − 1 steps of the r points next to the end, of unit length."""
    r = min(POINTS_AT_AN_END, len(stripe))
    total = 0j
    for t in range(1, r):
        step = stripe[t - 1] - stripe[t]
        total += (r - t) * step / abs(step)
    return total / abs(total) if total else 0j


def angle(a: complex, b: complex) -> float:
    """Between two directions, 0 to π; a right angle to none."""
    return abs(cmath.phase(a * b.conjugate())) if a and b else math.pi / 2


def linked_by_the_paper(stripes: list[Stripe]) -> tuple[Stripe, list[int], list[bool]]:
    """Points, the stripe of each, and where bridges are. Draws that hang on rounding are left to `assume`."""
    centroids = [sum(stripe) / len(stripe) for stripe in stripes]
    start = unique_least([(-float(len(s)), c.imag) for s, c in zip(stripes, centroids, strict=True)])
    curve = Growing(
        list(stripes[start]), [start] * len(stripes[start]),
        [direction_of_end(stripes[start]), direction_of_end(stripes[start][::-1])], centroids[start],
    )  # fmt: skip
    left = [k for k in range(len(stripes)) if k != start]
    while left:
        near = left.pop(unique_least([(abs(centroids[k] - curve.centroid),) for k in left]))
        _take(curve, near, stripes[near], centroids[near])
    ends = unique_least([(point.imag,) for point in (curve.points[0], curve.points[-1])])
    if ends == 1 and len(curve.points) > 1:
        curve.points.reverse()
        curve.stripes.reverse()
    changes = [a != b for a, b in zip(curve.stripes, [*curve.stripes[1:], curve.stripes[-1]], strict=True)]
    return curve.points, curve.stripes, changes


def _take(curve: Growing, number: int, stripe: Stripe, centroid: complex) -> None:
    """Join the stripe at the best of the four pairs of ends; equation 2 with the point numbers before the join."""
    joins = []
    for mine in (0, -1):
        for theirs in (0, -1):
            line = stripe[theirs] - curve.points[mine]
            facing = direction_of_end(stripe if theirs == 0 else stripe[::-1])
            # Between ends that touch there is no line: the turn from one direction into the other, which the two angles
            # add up to for the best of lines.
            bend = angle(curve.directions[mine], line) + angle(facing, -line)
            joins.append((bend if line else angle(curve.directions[mine], -facing), mine, theirs))
    best = unique_least([(bend,) for bend, _, _ in joins])
    _, mine, theirs = joins[best]
    u, v = len(curve.points), len(stripe)
    far = direction_of_end(stripe[::-1] if theirs == 0 else stripe)
    if mine == -1:
        curve.points += stripe if theirs == 0 else stripe[::-1]
        curve.stripes += [number] * v
    else:
        curve.points[:0] = stripe if theirs == -1 else stripe[::-1]
        curve.stripes[:0] = [number] * v
    curve.directions[mine] = far
    curve.centroid = (u * curve.centroid + v * centroid) / (u + v)


def unique_least(keys: list[tuple[float, ...]]) -> int:
    """The index of the least key, compared place by place; refuses a draw whose least is not clear of the next."""
    order = sorted(range(len(keys)), key=lambda k: keys[k])
    if len(order) > 1:
        first, second = keys[order[0]], keys[order[1]]
        assume(next((b - a for a, b in zip(first, second, strict=True) if b != a), 0.0) > CLOSE)
    return order[0]


finite = st.floats(-1, 1, allow_subnormal=False)


@st.composite
def stripes(draw: st.DrawFn) -> list[Stripe]:
    """Up to eight arcs of one to forty points, running any way, near or beside or across one another."""
    found = []
    for _ in range(draw(st.integers(1, 8))):
        count = draw(st.integers(1, 40))
        start = complex(100 * draw(finite), 200 * draw(finite))
        heading, bend = math.pi * draw(finite), 0.1 * draw(finite)
        spacing = 1 + 0.4 * draw(finite)
        steps = (spacing * cmath.exp(1j * (heading + bend * k + 0.3 * math.sin(7.1 * k))) for k in range(count - 1))
        points = [start]
        for step in steps:
            points.append(points[-1] + step)
        found.append(points)
    return found


# Ends that touch, of which one is in line with the other and far from the rest.
@example(
    [[0j, -1 + 1.2246467991473532e-16j, -1.9761823382088286 - 0.21695170561473867j], [0j, 1 + 0j],
     [100 + 0j, 101 + 0j, 101.97618233820883 + 0.2169517056147391j, 102.93169360911546 + 0.5119062973240536j]]
)  # fmt: skip
# Ends a denormal number apart: the square of their distance underflows, the distance does not.
@example(
    [[200j, 1 + 200j], [0j, 1 + 0j], [0j, 1.4 + 0j], [0j, 1 + 0j, 1.9761823382088286 + 0.2169517056147391j],
     [-2.0826390966750035e-292j, 6.123233995736766e-17 + 1j]]
)  # fmt: skip
@settings(deadline=None, max_examples=100)
@given(stripes())
def test_linking_is_the_papers_procedure(drawn: list[Stripe]) -> None:
    points, numbers, bridges = linked_by_the_paper(drawn)
    chains = [np.array([[point.real, point.imag] for point in stripe]) for stripe in drawn]
    ensemble = link_stripes(NumberedStripes(stripes_of(chains), np.full(len(chains), 7.0)))
    assert ensemble.points_px.tolist() == [[point.real, point.imag] for point in points]
    assert ensemble.stripe.tolist() == numbers
    assert ensemble.bridge_after.tolist() == bridges
    assert sum(bridges) == len(drawn) - 1


@settings(deadline=None, max_examples=25)
@given(stripes(), st.integers(0, 2**32 - 1))
def test_a_curve_does_not_depend_on_the_order_or_the_direction_in_which_stripes_were_found(
    drawn: list[Stripe], seed: int
) -> None:
    linked_by_the_paper(drawn)  # leaves out the draws that hang on rounding
    rng = np.random.default_rng(seed)
    shuffled = [drawn[k][:: rng.choice([-1, 1])] for k in rng.permutation(len(drawn))]
    curves = []
    for each in (drawn, shuffled):
        chains = [np.array([[point.real, point.imag] for point in stripe]) for stripe in each]
        curves.append(link_stripes(NumberedStripes(stripes_of(chains), np.full(len(chains), 7.0))))
    np.testing.assert_array_equal(curves[0].points_px, curves[1].points_px)
    np.testing.assert_array_equal(curves[0].bridge_after, curves[1].bridge_after)
