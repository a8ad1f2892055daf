"""What holds for any rig: units do not matter, nor the order of poses; and derivatives are those of the residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.solving.projection import (
    corner_residuals,
    match_residuals,
    select_evenly,
)
from slrig.calibration.solving.solve import solve
from tests.unit.calibration.solving.test_adjustment import aside, true_geometry
from tests.unit.calibration.synthetic import Recipe, made

QUICK = Recipe(poses=5, side=10)


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10_000), bend=st.lists(st.floats(-3, 3), min_size=7, max_size=7))
def test_a_step_changes_residuals_by_its_derivative(seed: int, bend: list[float]) -> None:
    geometry, seen = true_geometry(Recipe(seed=seed % 7, poses=3, cameras=2, side=5))
    geometry = replace(aside(geometry, seed), bend=np.array(bend))
    step = np.random.default_rng(seed).normal(0, 1e-6, geometry.layout.count)
    step[geometry.layout.first_offset :] = 0
    ahead, behind = geometry.apply_step(step), geometry.apply_step(-step)
    layout = geometry.layout
    residual, rows = corner_residuals(geometry, seen, jacobian=True)
    place = np.hstack([
        15 * seen.corner_where[:, :1] + np.arange(15), layout.first_pose + 6 * seen.corner_where[:, 1:2] + np.arange(6)
    ])  # fmt: skip
    change = np.einsum("nki,ni->nk", rows[:, :, :21], step[place])
    by_number = (
        corner_residuals(ahead, seen, jacobian=False)[0] - corner_residuals(behind, seen, jacobian=False)[0]
    ) / 2
    good = np.isfinite(residual)
    np.testing.assert_allclose(change[good], by_number[good], atol=1e-7)
    residual, rows = match_residuals(geometry, seen, jacobian=True)
    place = np.hstack([
        15 * seen.match_where[:, :1] + np.arange(15),
        np.tile(15 * (layout.devices - 1) + np.arange(15), (len(residual), 1)),
        layout.first_pose + 6 * seen.match_where[:, 1:2] + np.arange(6),
    ])  # fmt: skip
    change = np.einsum("ni,ni->n", rows[:, :36], step[place])
    by_number = (match_residuals(ahead, seen, jacobian=False)[0] - match_residuals(behind, seen, jacobian=False)[0]) / 2
    good = np.isfinite(residual)
    assert good.any()
    np.testing.assert_allclose(change[good], by_number[good], atol=1e-6)


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(share=st.floats(0.2, 5.0))
def test_the_board_s_unit_scales_lengths_and_nothing_else(share: float) -> None:
    observations, _ = made(replace(QUICK, seed=1))
    scaled = replace(observations, board=Board(BoardKind.CHESSBOARD, 11, 8, 12.0 * share))
    first, second = solve(observations).calibration, solve(scaled).calibration
    assert first.projector is not None
    assert second.projector is not None
    np.testing.assert_allclose(first.projector.matrix, second.projector.matrix, atol=0.05)
    np.testing.assert_allclose(first.projector.translation_mm * share, second.projector.translation_mm, rtol=2e-3)


@given(
    count=st.integers(0, 400), limit=st.integers(1, 300), width=st.floats(0, 500), seed=st.integers(0, 99)
)  # fmt: skip
def test_a_spread_has_as_many_as_it_may_and_none_twice(count: int, limit: int, width: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(0, 1, (count, 2)) * [width, 100]
    kept = select_evenly(points, limit)
    assert len(kept) == min(count, limit)
    assert len(set(kept.tolist())) == len(kept)
