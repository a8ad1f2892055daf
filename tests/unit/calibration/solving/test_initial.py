"""Starts of a solve: cameras by Zhang's method, how they stand to one another, and the projector from its light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import COLUMN, Observations
from slrig.calibration.solving.initial import Start, start_of
from slrig.calibration.solving.initial_projector import met_points, projector_start
from slrig.calibration.solving.measurements import Measurements, measured
from slrig.errors import SolveRefusedError
from slrig.model import Calibration
from tests.unit.calibration.synthetic import Recipe, made

SYMMETRIC = Board(BoardKind.CHESSBOARD, 10, 8, 12.0)


def lit(recipe: Recipe) -> tuple[Observations, Calibration, Start, Measurements]:
    observations, truth = made(recipe)
    start = start_of(observations)
    return observations, truth, start, measured(observations, start.flipped, matches_per_view=500)


def test_cameras_start_near_the_truth() -> None:
    observations, truth = made(Recipe(poses=10, cameras=3, projector=False, side=4))
    start = start_of(observations)
    for row, camera in zip(start.devices, truth.cameras.values(), strict=True):
        np.testing.assert_allclose(row[:2], np.diag(camera.matrix)[:2], rtol=0.01)
        np.testing.assert_allclose(row[18:], camera.translation_mm, atol=6.0)
        np.testing.assert_allclose(row[9:18].reshape(3, 3), camera.rotation, atol=0.02)


def test_views_that_are_counted_from_the_other_end_are_found() -> None:
    flipped = (("right", 1), ("right", 4), ("left", 6))
    observations, _ = made(Recipe(poses=10, cameras=2, projector=False, board=SYMMETRIC, flipped=flipped))
    found = {number for (camera, number), turned in start_of(observations).flipped.items() if turned}
    assert found == {1, 4, 6}, "the second camera's views that disagree with the first's"


def test_a_board_with_different_ends_is_never_turned() -> None:
    observations, _ = made(Recipe(poses=6, cameras=2, projector=False))
    assert not any(start_of(observations).flipped.values())


def test_a_camera_that_shares_poses_with_others_only_is_tied_through_them() -> None:
    observations, truth = made(Recipe(poses=12, cameras=3, projector=False, side=4))
    # The far camera never sees a pose that the left one sees.
    poses = [
        replace(pose, views={k: v for k, v in pose.views.items() if k != ("left" if number % 2 else "far")})
        for number, pose in enumerate(observations.poses)
    ]
    start = start_of(replace(observations, poses=tuple(poses)))
    np.testing.assert_allclose(start.devices[2, 18:], truth.cameras["far"].translation_mm, atol=10.0)
    assert np.isfinite(start.poses).all()


def test_a_camera_that_shares_no_pose_is_named() -> None:
    observations, _ = made(Recipe(poses=12, cameras=2, projector=False, side=4))
    poses = [
        replace(pose, views={k: v for k, v in pose.views.items() if k == ("left" if number % 2 else "right")})
        for number, pose in enumerate(observations.poses)
    ]
    with pytest.raises(SolveRefusedError, match="camera 'right' never saw the board in the same pose as 'left'"):
        start_of(replace(observations, poses=tuple(poses)))


@pytest.mark.parametrize("seed", range(3))
def test_parallel_boards_are_refused_with_the_tilts_that_are_missing(seed: int) -> None:
    observations, _ = made(Recipe(seed=seed, poses=8, projector=False, most_tilt_deg=0.5))
    with pytest.raises(SolveRefusedError, match=r"parallel.*20° to 40° to the left and to the right"):
        start_of(observations)


@pytest.mark.parametrize("seed", range(3))
def test_boards_of_ordinary_tilts_are_not_refused(seed: int) -> None:
    start_of(made(Recipe(seed=seed, poses=8, projector=False, most_tilt_deg=20.0))[0])


def test_a_pose_seen_by_no_camera_has_no_start() -> None:
    observations, _ = made(Recipe(poses=6, projector=False))
    poses = (replace(observations.poses[0], views={}), *observations.poses[1:])
    start = start_of(replace(observations, poses=poses))
    assert np.isnan(start.poses[0]).all()
    assert np.isfinite(start.poses[1:]).all()


@pytest.mark.parametrize("lens_shift", [False, True])
@pytest.mark.parametrize("outlying", [0.0, 0.15])
def test_the_projector_starts_near_the_truth(lens_shift: bool, outlying: float) -> None:
    observations, truth, start, matches = lit(Recipe(poses=8, side=24, lens_shift=lens_shift, outlying=outlying))
    assert truth.projector is not None
    assert observations.projector is not None
    row = projector_start(start.devices, start.poses, matches, observations.projector)
    assert truth.projector.size.height_px > 765
    np.testing.assert_allclose(row[:2], np.diag(truth.projector.matrix)[:2], rtol=0.05)
    np.testing.assert_allclose(row[2:4], truth.projector.matrix[:2, 2], atol=120)
    np.testing.assert_allclose(row[18:], truth.projector.translation_mm, atol=25)


def test_points_of_the_light_lie_on_the_board() -> None:
    _, _, start, matches = lit(Recipe(poses=4, side=10))
    points = met_points(start.devices, start.poses, matches)
    board = start.poses[matches.match_where[:, 1]]
    height = np.einsum("ni,ni->n", board[:, [2, 5, 8]], points - board[:, 9:])
    np.testing.assert_allclose(height, 0, atol=1e-9)


def test_light_of_one_axis_alone_is_refused() -> None:
    observations, _, start, matches = lit(Recipe(poses=4, side=20))
    assert observations.projector is not None
    columns = matches.of(np.ones(len(matches.corner_px), np.bool_), matches.match_where[:, 2] == COLUMN)
    with pytest.raises(SolveRefusedError, match="both are needed"):
        projector_start(start.devices, start.poses, columns, observations.projector)


def test_a_mirrored_projector_is_refused() -> None:
    observations, _, start, matches = lit(Recipe(poses=8, side=20))
    assert observations.projector is not None
    columns = matches.match_where[:, 2] == COLUMN
    mirrored = np.where(columns, observations.projector.width_px - 1 - matches.match_px, matches.match_px)
    with pytest.raises(SolveRefusedError, match="mirror"):
        projector_start(start.devices, start.poses, replace(matches, match_px=mirrored), observations.projector)
