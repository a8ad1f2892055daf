"""The bundle adjustment, its robust weights, and the deviations that it works with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.board import COLUMN, Board, BoardKind, Observations
from slrig.calibration.solving.adjustment import (
    CAUCHY,
    Deviations,
    DeviceNoise,
    add_design_effects,
    adjust,
    compute_residuals,
    estimate_noise,
    flat_geometry,
    inlier_weights,
    observation_deviations,
    robust_losses,
)
from slrig.calibration.solving.initial import (
    InitialValues,
    estimate_initial_values,
    estimate_projector,
    intersect_board,
)
from slrig.calibration.solving.projection import (
    Geometry,
    Measurements,
    collect_measurements,
    device_difference,
    pose_row,
)
from slrig.errors import SolveRefusedError
from slrig.model import Calibration
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
    return geometry, collect_measurements(observations, {}, matches_per_view=2000)


def unit(seen: Measurements, sigma_px: float = 0.05) -> Deviations:
    corners, matches = np.full(len(seen.corner_px), sigma_px), np.full(len(seen.match_px), sigma_px)
    return Deviations(corners, matches, np.ones(len(corners)), np.ones(len(matches)))


def all_free(geometry: Geometry) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return geometry.layout.free_mask(np.ones(len(geometry.poses), np.bool_), bend=False, offsets=False)


def aside(geometry: Geometry, seed: int = 0) -> Geometry:
    """The same, everything that may move moved by a good deal."""
    layout = geometry.layout
    step = np.zeros(layout.count)
    scale = np.tile([20, 20, 20, 20, 0.02, 0.02, 1e-3, 1e-3, 0, 0.01, 0.01, 0.01, 3, 3, 3.0], layout.devices)
    scale[9:15] = 0
    step[: layout.first_pose] = scale
    step[layout.first_pose : layout.first_offset] = np.tile([0.01, 0.01, 0.01, 2, 2, 4.0], layout.poses)
    return geometry.apply_step(step * np.random.default_rng(seed).uniform(-1, 1, layout.count))


def test_a_geometry_that_was_moved_aside_comes_back() -> None:
    geometry, seen = true_geometry(QUIET)
    made_ = adjust(aside(geometry), seen, all_free(geometry), unit(seen))
    assert made_.converged
    off = device_difference(made_.geometry.devices, geometry.devices)
    # What is known of lenses beforehand draws the third radial term, and with it the rest, by a little.
    assert np.abs(off[:, :4]).max() < 2e-3
    assert np.abs(off[:, 12:]).max() < 1e-3
    np.testing.assert_allclose(made_.geometry.poses, geometry.poses, atol=1e-3)


def test_what_is_not_free_stays() -> None:
    geometry, seen = true_geometry(QUIET)
    free = np.zeros(geometry.layout.count, dtype=np.bool_)
    free[0] = True
    start = aside(geometry)
    end = adjust(start, seen, free, unit(seen, 10.0)).geometry
    moved = np.flatnonzero(device_difference(end.devices, start.devices).ravel())
    assert moved.tolist() == [0]
    np.testing.assert_array_equal(end.poses, start.poses)


def test_a_lens_of_which_nothing_is_seen_is_straight() -> None:
    geometry, seen = true_geometry(QUIET)
    lenses = np.zeros(geometry.layout.count, dtype=np.bool_)
    lenses[[15 * device + term for device in range(len(geometry.devices)) for term in range(4, 9)]] = True
    nothing = (np.zeros(len(seen.corner_px)), np.zeros(len(seen.match_px)))
    end = adjust(geometry, seen, lenses, unit(seen), inliers=nothing).geometry
    assert np.abs(geometry.devices[:, 4:9]).max() > 0.01
    assert np.abs(end.devices[:, 4:9]).max() < 1e-4


def test_outliers_have_no_weight() -> None:
    geometry, seen = true_geometry(replace(QUIET, outlying=0.1, corner_px=0.02))
    corners = seen.corner_px.copy()
    corners[::25] += 7.0
    seen = replace(seen, corner_px=corners)
    made_ = adjust(aside(geometry), seen, all_free(geometry), unit(seen))
    kept = inlier_weights(made_.residuals, unit(seen))
    assert (kept[0][::25] == 0).all()
    assert 0.08 < (kept[1] == 0).mean() < 0.12
    assert np.abs(device_difference(made_.geometry.devices, geometry.devices)[:, :2]).max() < 1.0


def test_a_loss_is_a_square_where_it_is_small_and_grows_slowly_where_it_is_large() -> None:
    geometry, seen = true_geometry(QUIET)
    left = compute_residuals(geometry, seen)
    matches = np.full_like(left.matches, 0.05 * 1e-3)
    matches[0] = 0.05 * 100 * CAUCHY
    _, losses = robust_losses(replace(left, matches=matches), unit(seen))
    assert losses[1] == pytest.approx(1e-6, rel=1e-3)
    assert losses[0] == pytest.approx(CAUCHY**2 * np.log1p(1e4))


@pytest.mark.parametrize("share", [0.4, 1.0, 3.0])
def test_deviations_fit_the_residuals_whatever_was_stated(share: float) -> None:
    recipe = Recipe(poses=8, side=30, corner_px=0.06, match_px=0.05, alike_px=0.0, stated_share=share)
    geometry, seen = true_geometry(recipe)
    left = compute_residuals(geometry, seen)
    sigma = observation_deviations(seen, estimate_noise(left, seen, 2, True), True)
    # The poses here are true and not fitted, and what a fit would take is made up for: 4 % of 1408 coordinates.
    assert float(np.median(sigma.corners)) == pytest.approx(0.06, rel=0.08)
    assert float(np.median(sigma.matches)) == pytest.approx(0.05, rel=0.03)


def test_errors_that_neighbours_share_count_for_less() -> None:
    def weight(alike_px: float) -> float:
        geometry, seen = true_geometry(Recipe(poses=8, side=40, match_px=0.05, alike_px=alike_px))
        left = compute_residuals(geometry, seen)
        noise = estimate_noise(left, seen, 2, True)
        return add_design_effects(noise, geometry, left, seen, True)[-1].design_effect

    assert weight(0.0) < 1.8
    assert weight(0.05) > 3.0


def test_a_print_that_is_off_counts_for_less() -> None:
    offsets = np.column_stack([np.random.default_rng(9).normal(0, 0.03, (88, 2)), np.zeros(88)])
    for shape, least, most in ((None, 1.0, 1.6), (offsets, 3.0, 20.0)):
        geometry, seen = true_geometry(Recipe(poses=12, side=4, offsets_mm=shape))
        left = compute_residuals(geometry, seen)
        noise = add_design_effects(estimate_noise(left, seen, 2, True), geometry, left, seen, True)
        assert least <= noise[0].design_effect < most


def test_worth_takes_weight_and_makes_no_outliers() -> None:
    geometry, seen = true_geometry(Recipe(poses=4, side=12))
    one, four = (DeviceNoise(1.0, 0.0, design_effect) for design_effect in (1.0, 4.0))
    left = compute_residuals(geometry, seen)
    plain, less = observation_deviations(seen, [one, one], True), observation_deviations(seen, [four, four], True)
    for a, b in zip(inlier_weights(left, plain), inlier_weights(left, less), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(robust_losses(left, plain), robust_losses(left, less), strict=True):
        np.testing.assert_allclose(a, 4 * b)


# ---- Starts of a solve: cameras by Zhang's method, how they stand to one another, and the projector from its light


SYMMETRIC = Board(BoardKind.CHESSBOARD, 10, 8, 12.0)


def lit(recipe: Recipe) -> tuple[Observations, Calibration, InitialValues, Measurements]:
    observations, truth = made(recipe)
    start = estimate_initial_values(observations)
    return observations, truth, start, collect_measurements(observations, start.flipped, matches_per_view=500)


def test_cameras_start_near_the_truth() -> None:
    observations, truth = made(Recipe(poses=10, cameras=3, projector=False, side=4))
    start = estimate_initial_values(observations)
    for row, camera in zip(start.devices, truth.cameras.values(), strict=True):
        np.testing.assert_allclose(row[:2], np.diag(camera.matrix)[:2], rtol=0.01)
        np.testing.assert_allclose(row[18:], camera.translation_mm, atol=6.0)
        np.testing.assert_allclose(row[9:18].reshape(3, 3), camera.rotation, atol=0.02)


def test_views_that_are_counted_from_the_other_end_are_found() -> None:
    flipped = (("right", 1), ("right", 4), ("left", 6))
    observations, _ = made(Recipe(poses=10, cameras=2, projector=False, board=SYMMETRIC, flipped=flipped))
    found = {number for (camera, number), turned in estimate_initial_values(observations).flipped.items() if turned}
    assert found == {1, 4, 6}, "the second camera's views that disagree with the first's"


def test_a_board_with_different_ends_is_never_turned() -> None:
    observations, _ = made(Recipe(poses=6, cameras=2, projector=False))
    assert not any(estimate_initial_values(observations).flipped.values())


def test_a_camera_that_shares_poses_with_others_only_is_tied_through_them() -> None:
    observations, truth = made(Recipe(poses=12, cameras=3, projector=False, side=4))
    # The far camera never sees a pose that the left one sees.
    poses = [
        replace(pose, views={k: v for k, v in pose.views.items() if k != ("left" if number % 2 else "far")})
        for number, pose in enumerate(observations.poses)
    ]
    start = estimate_initial_values(replace(observations, poses=tuple(poses)))
    np.testing.assert_allclose(start.devices[2, 18:], truth.cameras["far"].translation_mm, atol=10.0)
    assert np.isfinite(start.poses).all()


def test_a_camera_that_shares_no_pose_is_named() -> None:
    observations, _ = made(Recipe(poses=12, cameras=2, projector=False, side=4))
    poses = [
        replace(pose, views={k: v for k, v in pose.views.items() if k == ("left" if number % 2 else "right")})
        for number, pose in enumerate(observations.poses)
    ]
    with pytest.raises(SolveRefusedError, match="camera 'right' never saw the board in the same pose as 'left'"):
        estimate_initial_values(replace(observations, poses=tuple(poses)))


@pytest.mark.parametrize("seed", range(3))
def test_parallel_boards_are_refused_with_the_tilts_that_are_missing(seed: int) -> None:
    observations, _ = made(Recipe(seed=seed, poses=8, projector=False, most_tilt_deg=0.5))
    with pytest.raises(SolveRefusedError, match=r"parallel.*20° to 40° to the left and to the right"):
        estimate_initial_values(observations)


@pytest.mark.parametrize("seed", range(3))
def test_boards_of_ordinary_tilts_are_not_refused(seed: int) -> None:
    estimate_initial_values(made(Recipe(seed=seed, poses=8, projector=False, most_tilt_deg=20.0))[0])


@pytest.mark.parametrize("lens_shift", [False, True])
@pytest.mark.parametrize("outlying", [0.0, 0.15])
def test_the_projector_starts_near_the_truth(lens_shift: bool, outlying: float) -> None:
    observations, truth, start, matches = lit(Recipe(poses=8, side=24, lens_shift=lens_shift, outlying=outlying))
    assert truth.projector is not None
    assert observations.projector is not None
    row = estimate_projector(start.devices, start.poses, matches, observations.projector)
    assert truth.projector.size.height_px > 765
    np.testing.assert_allclose(row[:2], np.diag(truth.projector.matrix)[:2], rtol=0.05)
    np.testing.assert_allclose(row[2:4], truth.projector.matrix[:2, 2], atol=120)
    np.testing.assert_allclose(row[18:], truth.projector.translation_mm, atol=25)


def test_points_of_the_light_lie_on_the_board() -> None:
    _, _, start, matches = lit(Recipe(poses=4, side=10))
    points = intersect_board(start.devices, start.poses, matches)
    board = start.poses[matches.match_where[:, 1]]
    height = np.einsum("ni,ni->n", board[:, [2, 5, 8]], points - board[:, 9:])
    np.testing.assert_allclose(height, 0, atol=1e-9)


def test_light_of_one_axis_alone_is_refused() -> None:
    observations, _, start, matches = lit(Recipe(poses=4, side=20))
    assert observations.projector is not None
    columns = matches.select(np.ones(len(matches.corner_px), np.bool_), matches.match_where[:, 2] == COLUMN)
    with pytest.raises(SolveRefusedError, match="both are needed"):
        estimate_projector(start.devices, start.poses, columns, observations.projector)


def test_a_mirrored_projector_is_refused() -> None:
    observations, _, start, matches = lit(Recipe(poses=8, side=20))
    assert observations.projector is not None
    columns = matches.match_where[:, 2] == COLUMN
    mirrored = np.where(columns, observations.projector.width_px - 1 - matches.match_px, matches.match_px)
    with pytest.raises(SolveRefusedError, match="mirror"):
        estimate_projector(start.devices, start.poses, replace(matches, match_px=mirrored), observations.projector)
