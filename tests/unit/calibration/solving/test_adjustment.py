"""The bundle adjustment, its robust weights, and the deviations that it works with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.solving.adjustment import CAUCHY, Deviations, Prior, adjusted, kept_of, losses_of, residuals_of
from slrig.calibration.solving.measurements import Measurements, measured
from slrig.calibration.solving.parameters import Geometry, difference, pose_row
from slrig.calibration.solving.problem import DeviceNoise, deviations_of, flat_geometry, noise_of, with_design_effect
from slrig.model import FloatArray
from tests.unit.calibration.solving.test_projection import row_of
from tests.unit.calibration.synthetic import Recipe, board_poses, made

QUIET = Recipe(poses=6, cameras=2, side=12, corner_px=0.0, match_px=0.0, alike_px=0.0, outlying=0.0)


def true_geometry(recipe: Recipe) -> tuple[Geometry, Measurements]:
    observations, truth = made(recipe)
    devices = [*truth.cameras.values(), *([truth.projector] if truth.projector else [])]
    poses = board_poses(recipe, np.random.default_rng(recipe.seed))
    geometry = flat_geometry(
        recipe.board, np.array([row_of(one) for one in devices]), np.array([pose_row(*pose) for pose in poses])
    )
    return geometry, measured(observations, {}, matches_per_view=2000)


def unit(seen: Measurements, sigma_px: float = 0.05) -> Deviations:
    corners, matches = np.full(len(seen.corner_px), sigma_px), np.full(len(seen.match_px), sigma_px)
    return Deviations(corners, matches, np.ones(len(corners)), np.ones(len(matches)))


def all_free(geometry: Geometry, *, shape: bool = False) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    count = len(geometry.poses)
    return geometry.layout.free(np.ones(count, np.bool_), bend=shape, offsets=shape)


def aside(geometry: Geometry, seed: int = 0) -> Geometry:
    """The same, everything that may move moved by a good deal."""
    layout = geometry.layout
    step = np.zeros(layout.count)
    scale = np.tile([20, 20, 20, 20, 0.02, 0.02, 1e-3, 1e-3, 0, 0.01, 0.01, 0.01, 3, 3, 3.0], layout.devices)
    scale[9:15] = 0
    step[: layout.first_pose] = scale
    step[layout.first_pose : layout.first_offset] = np.tile([0.01, 0.01, 0.01, 2, 2, 4.0], layout.poses)
    return geometry.moved(step * np.random.default_rng(seed).uniform(-1, 1, layout.count))


def test_a_geometry_that_was_moved_aside_comes_back() -> None:
    geometry, seen = true_geometry(QUIET)
    made_ = adjusted(aside(geometry), seen, all_free(geometry), unit(seen))
    assert made_.settled
    off = difference(made_.geometry.devices, geometry.devices)
    # What is known of lenses beforehand draws the third radial term, and with it the rest, by a little.
    assert np.abs(off[:, :4]).max() < 2e-3
    assert np.abs(off[:, 12:]).max() < 1e-3
    np.testing.assert_allclose(made_.geometry.poses, geometry.poses, atol=1e-3)


def test_what_is_not_free_stays() -> None:
    geometry, seen = true_geometry(QUIET)
    free = np.zeros(geometry.layout.count, dtype=np.bool_)
    free[0] = True
    start = aside(geometry)
    end = adjusted(start, seen, free, unit(seen, 10.0)).geometry
    moved = np.flatnonzero(difference(end.devices, start.devices).ravel())
    assert moved.tolist() == [0]
    np.testing.assert_array_equal(end.poses, start.poses)


def test_a_lens_of_which_nothing_is_seen_is_straight() -> None:
    geometry, seen = true_geometry(QUIET)
    lenses = np.zeros(geometry.layout.count, dtype=np.bool_)
    lenses[[15 * device + term for device in range(len(geometry.devices)) for term in range(4, 9)]] = True
    nothing = (np.zeros(len(seen.corner_px)), np.zeros(len(seen.match_px)))
    end = adjusted(geometry, seen, lenses, unit(seen), kept=nothing).geometry
    assert np.abs(geometry.devices[:, 4:9]).max() > 0.01
    assert np.abs(end.devices[:, 4:9]).max() < 1e-4


def test_outliers_have_no_weight() -> None:
    geometry, seen = true_geometry(replace(QUIET, outlying=0.1, corner_px=0.02))
    corners = seen.corner_px.copy()
    corners[::25] += 7.0
    seen = replace(seen, corner_px=corners)
    made_ = adjusted(aside(geometry), seen, all_free(geometry), unit(seen))
    kept = kept_of(made_.residuals, unit(seen))
    assert (kept[0][::25] == 0).all()
    assert 0.08 < (kept[1] == 0).mean() < 0.12
    assert np.abs(difference(made_.geometry.devices, geometry.devices)[:, :2]).max() < 1.0


def test_a_loss_is_a_square_where_it_is_small_and_grows_slowly_where_it_is_large() -> None:
    geometry, seen = true_geometry(QUIET)
    left = residuals_of(geometry, seen)
    matches = np.full_like(left.matches, 0.05 * 1e-3)
    matches[0] = 0.05 * 100 * CAUCHY
    _, losses = losses_of(replace(left, matches=matches), unit(seen))
    assert losses[1] == pytest.approx(1e-6, rel=1e-3)
    assert losses[0] == pytest.approx(CAUCHY**2 * np.log1p(1e4))


@pytest.mark.slow
def test_the_board_s_shape_is_found_if_it_is_free() -> None:
    rng = np.random.default_rng(8)
    offsets = np.column_stack([rng.normal(0, 0.05, (88, 2)), np.zeros(88)])
    recipe = Recipe(poses=10, side=20, corner_px=0.02, match_px=0.02, alike_px=0.0, outlying=0.0, bow_mm=1.0)
    geometry, seen = true_geometry(replace(recipe, offsets_mm=offsets))
    flat = adjusted(geometry, seen, all_free(geometry), unit(seen, 0.02))
    shaped = adjusted(geometry, seen, all_free(geometry, shape=True), unit(seen, 0.02), prior=Prior(0.2, 0.2))

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    assert rms(shaped.residuals.corners) < 0.023
    assert rms(flat.residuals.corners) > 4 * rms(shaped.residuals.corners)
    assert shaped.geometry.bend[0] == pytest.approx(1.0, abs=0.05)
    # Where the print lies, how it is turned and how large it is, is no error of its shape.
    points = geometry.points - geometry.points.mean(axis=0)
    basis = np.column_stack([
        np.tile([1.0, 0.0], 88), np.tile([0.0, 1.0], 88), (points @ [[0, 1], [-1, 0]]).ravel(), points.ravel()
    ])  # fmt: skip
    true = offsets[:, :2].ravel() - basis @ np.linalg.lstsq(basis, offsets[:, :2].ravel(), rcond=None)[0]
    assert np.corrcoef(true, shaped.geometry.offsets.ravel())[0, 1] > 0.99


@pytest.mark.parametrize("share", [0.4, 1.0, 3.0])
def test_deviations_fit_the_residuals_whatever_was_stated(share: float) -> None:
    recipe = Recipe(poses=8, side=30, corner_px=0.06, match_px=0.05, alike_px=0.0, stated_share=share)
    geometry, seen = true_geometry(recipe)
    left = residuals_of(geometry, seen)
    sigma = deviations_of(seen, noise_of(left, seen, 2, True), True)
    # The poses here are true and not fitted, and what a fit would take is made up for: 4 % of 1408 coordinates.
    assert float(np.median(sigma.corners)) == pytest.approx(0.06, rel=0.08)
    assert float(np.median(sigma.matches)) == pytest.approx(0.05, rel=0.03)


def test_errors_that_neighbours_share_count_for_less() -> None:
    def weight(alike_px: float) -> float:
        geometry, seen = true_geometry(Recipe(poses=8, side=40, match_px=0.05, alike_px=alike_px))
        left = residuals_of(geometry, seen)
        noise = noise_of(left, seen, 2, True)
        return with_design_effect(noise, geometry, left, seen, True)[-1].design_effect

    assert weight(0.0) < 1.8
    assert weight(0.05) > 3.0


def test_a_print_that_is_off_counts_for_less() -> None:
    offsets = np.column_stack([np.random.default_rng(9).normal(0, 0.03, (88, 2)), np.zeros(88)])
    for shape, least, most in ((None, 1.0, 1.6), (offsets, 3.0, 20.0)):
        geometry, seen = true_geometry(Recipe(poses=12, side=4, offsets_mm=shape))
        left = residuals_of(geometry, seen)
        noise = with_design_effect(noise_of(left, seen, 2, True), geometry, left, seen, True)
        assert least <= noise[0].design_effect < most


def test_worth_takes_weight_and_makes_no_outliers() -> None:
    geometry, seen = true_geometry(Recipe(poses=4, side=12))
    one, four = (DeviceNoise(1.0, 0.0, design_effect) for design_effect in (1.0, 4.0))
    left = residuals_of(geometry, seen)
    plain, less = deviations_of(seen, [one, one], True), deviations_of(seen, [four, four], True)
    for a, b in zip(kept_of(left, plain), kept_of(left, less), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(losses_of(left, plain), losses_of(left, less), strict=True):
        np.testing.assert_allclose(a, 4 * b)
