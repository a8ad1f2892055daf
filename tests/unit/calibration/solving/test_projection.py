"""Kernels of the solve: against OpenCV's projection, numbers for derivatives, and numpy's linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.solving.adjustment import flat_geometry, solve_positive_definite
from slrig.calibration.solving.projection import (
    Geometry,
    Measurements,
    collect_measurements,
    corner_residuals,
    device_difference,
    device_row,
    find_groups,
    match_residuals,
    pose_row,
    select_evenly,
    to_pinhole,
    weighted_blocks,
)
from slrig.model import FloatArray, Pinhole
from tests.unit.calibration.synthetic import Recipe, board_poses, made

EXACT = Recipe(
    poses=3, cameras=2, side=8, corner_px=0.0, match_px=0.0, alike_px=0.0, outlying=0.0, bow_mm=1.7, most_tilt_deg=30.0
)


def row_of(device: Pinhole) -> FloatArray:
    return device_row(device.matrix, device.distortion, device.rotation, device.translation_mm)


@pytest.fixture(scope="module")
def exact() -> tuple[Geometry, Measurements]:
    """The true geometry of a rig with a bowed board, and what it sees without noise."""
    observations, truth = made(EXACT)
    assert truth.projector is not None
    devices = np.array([row_of(device) for device in (*truth.cameras.values(), truth.projector)])
    poses = np.array([pose_row(*pose) for pose in board_poses(EXACT, np.random.default_rng(EXACT.seed))])
    geometry = flat_geometry(EXACT.board, devices, poses)
    bend = np.zeros(7)
    bend[0] = EXACT.bow_mm
    return replace(geometry, bend=bend), collect_measurements(observations, {}, matches_per_view=100)


def test_corners_and_light_fall_where_opencv_says(exact: tuple[Geometry, Measurements]) -> None:
    geometry, seen = exact
    corners, _ = corner_residuals(geometry, seen, jacobian=False)
    matches, _ = match_residuals(geometry, seen, jacobian=False)
    assert len(corners) > 400
    assert len(matches) > 500
    np.testing.assert_allclose(corners, 0, atol=1e-8)
    np.testing.assert_allclose(matches, 0, atol=1e-7)


def test_derivatives_are_those_of_the_residuals(exact: tuple[Geometry, Measurements]) -> None:
    geometry, everything = exact
    seen = everything.select(
        np.arange(len(everything.corner_px)) % 17 == 0, np.arange(len(everything.match_px)) % 11 == 0
    )
    rng = np.random.default_rng(3)
    geometry = replace(
        geometry, bend=rng.normal(0, 0.5, 7), offsets=rng.normal(0, 0.05, geometry.offsets.shape),
    )  # fmt: skip
    geometry.devices[:, 8] = 0.02
    layout = geometry.layout
    _, corner_rows = corner_residuals(geometry, seen, jacobian=True)
    _, match_rows = match_residuals(geometry, seen, jacobian=True)
    corners, matches = np.zeros((len(corner_rows), 2, layout.count)), np.zeros((len(match_rows), layout.count))
    for i, (camera, pose, corner) in enumerate(seen.corner_where):
        place = np.concatenate([
            15 * camera + np.arange(15), layout.first_pose + 6 * pose + np.arange(6),
            layout.first_offset + 2 * corner + np.arange(2), np.arange(layout.first_bend, layout.count),
        ])  # fmt: skip
        corners[i][:, place] = corner_rows[i]
    for i, (camera, pose, _) in enumerate(seen.match_where):
        place = np.concatenate([
            15 * camera + np.arange(15), 15 * (layout.devices - 1) + np.arange(15),
            layout.first_pose + 6 * pose + np.arange(6), np.arange(layout.first_bend, layout.count),
        ])  # fmt: skip
        matches[i][place] = match_rows[i]
    step = 1e-5
    for k in range(layout.count):
        one = np.zeros(layout.count)
        one[k] = step
        ahead, behind = geometry.apply_step(one), geometry.apply_step(-one)
        for terms, rows in ((corner_residuals, corners), (match_residuals, matches)):
            by_number = (terms(ahead, seen, jacobian=False)[0] - terms(behind, seen, jacobian=False)[0]) / (2 * step)
            size = max(float(np.abs(by_number).max()), 1e-3)
            np.testing.assert_allclose(rows[..., k], by_number, atol=2e-5 * size, err_msg=f"parameter {k}")


def test_light_that_misses_the_board_has_no_residual(exact: tuple[Geometry, Measurements]) -> None:
    geometry, seen = exact
    away = geometry.poses.copy()
    away[:, 9:] *= -1
    assert np.isnan(match_residuals(replace(geometry, poses=away), seen, jacobian=False)[0]).all()
    assert np.isnan(corner_residuals(replace(geometry, poses=away), seen, jacobian=False)[0]).all()


def test_blocks_are_weighed_sums_of_their_rows() -> None:
    rng = np.random.default_rng(1)
    rows, residual, weight = rng.normal(size=(50, 9)), rng.normal(size=50), rng.uniform(size=50)
    weight[7], rows[7], residual[7] = 0.0, np.nan, np.nan
    blocks, pulls = weighted_blocks(rows, residual, weight, np.array([0, 20, 20, 50]))
    for block, pull, run in zip(blocks, pulls, (slice(0, 20), slice(20, 20), slice(20, 50)), strict=True):
        good = np.flatnonzero(weight[run] > 0) + run.start
        np.testing.assert_allclose(block, rows[good].T @ (rows[good] * weight[good, None]), atol=1e-12)
        np.testing.assert_allclose(pull, rows[good].T @ (weight[good] * residual[good]), atol=1e-12)


def test_many_rows_are_summed_the_same_in_several_threads() -> None:
    rng = np.random.default_rng(2)
    rows, residual, weight = rng.normal(size=(60_000, 5)), rng.normal(size=60_000), rng.uniform(size=60_000)
    blocks, _ = weighted_blocks(rows, residual, weight, np.arange(0, 60_001, 3000))
    np.testing.assert_allclose(blocks.sum(axis=0), rows.T @ (rows * weight[:, None]), rtol=1e-10)


def test_small_systems_are_solved_as_numpy_does() -> None:
    rng = np.random.default_rng(4)
    half = rng.normal(size=(80, 60))
    matrix, right = half.T @ half + np.eye(60), rng.normal(size=60)
    np.testing.assert_allclose(solve_positive_definite(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
    matrix[3, 3] = -1.0
    assert np.isnan(solve_positive_definite(matrix, right)).all()


def test_a_step_leads_from_one_geometry_to_the_other(exact: tuple[Geometry, Measurements]) -> None:
    geometry, _ = exact
    step = np.zeros(geometry.layout.count)
    step[: geometry.layout.first_pose] = np.random.default_rng(5).normal(0, 0.01, geometry.layout.first_pose)
    found = device_difference(geometry.apply_step(step).devices, geometry.devices)
    np.testing.assert_allclose(found.ravel(), step[: geometry.layout.first_pose], atol=1e-9)


def test_a_row_is_the_device_that_it_was_made_of() -> None:
    device = next(iter(made(EXACT)[1].cameras.values()))
    again = to_pinhole(row_of(device), device.size)
    np.testing.assert_array_equal(again.matrix, device.matrix)
    np.testing.assert_array_equal(again.distortion, device.distortion)


def test_light_is_thinned_evenly_and_always_alike() -> None:
    points = np.random.default_rng(6).uniform(0, 100, (20_000, 2))
    points[:15_000] *= 0.2
    kept = select_evenly(points, 500)
    np.testing.assert_array_equal(kept, select_evenly(points, 500))
    assert len(kept) == 500
    quarters = np.histogram2d(points[kept, 0], points[kept, 1], bins=2)[0]
    assert quarters.min() > 90, "most points lie in one corner, those that are kept do not"


def test_measurements_lie_in_runs_of_one_camera_and_pose(exact: tuple[Geometry, Measurements]) -> None:
    _, seen = exact
    runs = find_groups(seen.match_where)
    assert len(runs) == 2 * 3 * 2
    assert len({tuple(seen.match_where[run.start]) for run in runs}) == len(runs)
    thin = seen.thin(20)
    assert [run.stop - run.start for run in find_groups(thin.match_where)] == [20] * len(runs)
