"""Poses that are held out, and what they say of deviations."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.calibration.solution import CELLS, DeviceResiduals
from slrig.calibration.solving.covariance import allowing_for
from slrig.calibration.solving.held_out import folds_of
from slrig.calibration.solving.problem import Problem
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
def test_deviations_allow_for_what_is_left_at_poses_that_were_not_seen(
    ratios: tuple[float, float], factor: float
) -> None:
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
