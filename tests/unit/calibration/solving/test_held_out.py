"""Poses that are held out, and the odd and even half of a solve: what each says without the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.solution import CELLS, LEAST_HALVED, DeviceResiduals
from slrig.calibration.solving.covariance import allowing_for
from slrig.calibration.solving.halves import halves_of
from slrig.calibration.solving.held_out import folds_of
from slrig.calibration.solving.parameters import difference
from slrig.calibration.solving.problem import Fit, Problem, fitted
from tests.unit.calibration.solving.test_adjustment import true_geometry
from tests.unit.calibration.synthetic import Recipe


def problem_of(recipe: Recipe) -> Problem:
    _, seen = true_geometry(recipe)
    names = tuple(f"pose {number}" for number in range(recipe.poses))
    return Problem(("left",), names, False, seen.of_poses(np.ones(recipe.poses, np.bool_), matches=False))


def test_each_pose_is_held_out_once() -> None:
    problem = problem_of(Recipe(poses=13, projector=False, side=4))
    folds = folds_of(problem)
    assert len(folds) == 5
    np.testing.assert_array_equal(np.sum(folds, axis=0), 1)


def test_three_poses_are_too_few_to_hold_any_out() -> None:
    assert folds_of(problem_of(Recipe(poses=3, projector=False, side=4))) == []


@pytest.mark.parametrize(
    ("ratios", "factor"),
    [((1.02, 4.5), 4.5), ((0.98, 0.9), 1.0), ((np.nan, np.nan), 1.0), ((1.5, np.nan), 1.5)],
)
def test_deviations_allow_for_the_residuals_of_held_out_poses(ratios: tuple[float, float], factor: float) -> None:
    devices = 15 * len(ratios)
    random = np.random.default_rng(1).normal(size=(devices, devices))
    covariance = random @ random.T
    no_map = np.zeros((CELLS, CELLS))
    residuals = [
        DeviceResiduals(0.2, 0.2, 0.2 * ratio, 100, 0, {}, no_map, np.zeros((CELLS, CELLS, 2)), no_map.astype(np.int32))
        for ratio in ratios
    ]
    allowed = allowing_for(covariance, residuals)
    np.testing.assert_allclose(np.sqrt(np.diagonal(allowed)), factor * np.sqrt(np.diagonal(covariance)))
    # Correlations stay: devices that err together are a small error between them.
    np.testing.assert_allclose(allowed / covariance, factor**2)


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
