"""The odd and the even poses of a solve: each half is what its own poses give, and nothing of the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slrig.calibration.solution import LEAST_HALVED
from slrig.calibration.solving.halves import halves_of
from slrig.calibration.solving.parameters import difference
from slrig.calibration.solving.problem import Fit, Problem, fitted
from tests.unit.calibration.solving.test_adjustment import true_geometry
from tests.unit.calibration.synthetic import Recipe


def whole(poses: int) -> tuple[Problem, Fit]:
    geometry, seen = true_geometry(Recipe(poses=poses, side=12, seed=2))
    problem = Problem(("left", "projector"), tuple(f"pose {number}" for number in range(poses)), True, seen)
    return problem, fitted(problem, geometry, correlated=True)


def test_a_half_is_what_its_poses_give_from_wherever_it_starts() -> None:
    problem, fit = whole(9)
    halves = halves_of(problem, fit, None, ())
    assert [half.poses for half in halves] == [tuple(f"pose {n}" for n in range(first, 9, 2)) for first in (0, 1)]
    for first, half in enumerate(halves):
        others = np.arange(9) % 2 != first
        moved = fit.geometry.devices.copy()
        moved[:, :4] *= 1.002
        alone = fitted(problem.without(others), replace(fit.geometry, devices=moved), correlated=True)
        change = difference(alone.geometry.devices, fit.geometry.devices).ravel()
        sigma = np.sqrt(np.diagonal(half.covariance))
        known = sigma > 0
        # They settle on which observations are outlying by themselves.
        assert np.abs((half.change - change)[known] / sigma[known]).max() < 0.2


def test_a_half_sees_nothing_of_the_other() -> None:
    problem, fit = whole(8)
    m = problem.measurements
    even = m.corner_where[:, 1] % 2 == 1
    wrong = replace(problem, measurements=replace(m, corner_px=m.corner_px + 3.0 * even[:, None]))
    before, after = (halves_of(each, fit, None, ()) for each in (problem, wrong))
    np.testing.assert_array_equal(before[0].change, after[0].change)
    np.testing.assert_array_equal(before[0].covariance, after[0].covariance)
    assert np.abs(after[1].change - before[1].change).max() > 1


def test_too_few_poses_are_not_halved() -> None:
    problem, fit = whole(LEAST_HALVED)
    assert len(halves_of(problem, fit, None, ())) == 2
    left_out = np.arange(LEAST_HALVED) == 3
    assert halves_of(problem.without(left_out), fit, None, ()) == ()
