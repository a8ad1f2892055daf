"""The pose of a device that was bumped, from the stripes of two cameras on a ball."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.model import Axis, FloatArray, Pinhole
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.pose_refinement import RefinedPose, refine_pose
from slrig.reconstruction.triangulation import triangulate_camera_projector
from tests.unit.reconstruction.builders import BALL, CAMERA, OTHER_CAMERA, PROJECTOR, seen_on_ball
from tests.unit.reconstruction.test_redundancy import turned

pytestmark = pytest.mark.slow  # kernels that only scans by two cameras need

TRUE = [CAMERA, OTHER_CAMERA, PROJECTOR]
COLUMNS = np.arange(90.0, 230.0, 10.0).tolist()
ROWS = np.arange(40.0, 200.0, 1.3)
GAP_PX = 4.0


def shifted(device: Pinhole, shift_mm: tuple[float, float, float]) -> Pinhole:
    return replace(device, translation_mm=device.translation_mm + np.array(shift_mm))


def refined(believed: list[Pinhole], moved: int, *, noise_px: float = 0.02) -> RefinedPose:
    stripes = [
        seen_on_ball(camera, COLUMNS, ROWS + 0.4 * number, sigma_px=noise_px, noise_px=noise_px, seed=number)
        for number, camera in enumerate(TRUE[:2])
    ]
    *cameras, projector = believed
    found = refine_pose(stripes, cameras, projector, Axis.COLUMN, moved, [(0, 1)], widest_gap_px=GAP_PX)
    assert found is not None
    return found


def from_the_ball_mm(devices: list[Pinhole], stripes: list[StripeEnsemble]) -> FloatArray:
    """(n,): distances of the points of both cameras from the ball."""
    *cameras, projector = devices
    parts = [
        triangulate_camera_projector(each, camera, projector, Axis.COLUMN)[0]
        for each, camera in zip(stripes, cameras, strict=True)
    ]
    return BALL.distance_mm(np.concatenate([part.points_mm for part in parts]))


@pytest.mark.parametrize("moved", [0, 1, 2])
@pytest.mark.parametrize("degrees", [(0.0, 0.05, 0.0), (0.1, 0.28, -0.05), (0.9, -1.6, 0.5)])
def test_the_device_that_was_turned_measures_the_ball_again(moved: int, degrees: tuple[float, float, float]) -> None:
    believed = [*TRUE]
    believed[moved] = turned(TRUE[moved], degrees=degrees)
    found = refined(believed, moved)
    assert found.is_small
    assert found.scatter_sigma == pytest.approx(1.0, abs=0.15)
    exact = [seen_on_ball(camera, COLUMNS, ROWS) for camera in TRUE[:2]]
    before = from_the_ball_mm(believed, exact)
    believed[moved] = found.pose
    # Along the stripes the pose is not known; where that moves the ball, it moves the whole of it.
    after = from_the_ball_mm(believed, exact)
    assert np.percentile(np.abs(after), 95) < 0.1 * np.percentile(np.abs(before), 95)


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_of_all_devices_the_one_that_was_turned_fits_best(moved: int) -> None:
    believed = [*TRUE]
    believed[moved] = turned(TRUE[moved], degrees=(0.4, 0.9, -0.3))
    left = [refined(believed, each, noise_px=0.005).scatter_sigma for each in range(3)]
    assert int(np.argmin(left)) == moved


def test_the_stated_covariance_is_that_of_repeated_measurements() -> None:
    believed = [CAMERA, shifted(OTHER_CAMERA, (0.5, 0.0, 0.3)), PROJECTOR]
    exact = [seen_on_ball(camera, COLUMNS, ROWS) for camera in TRUE[:2]]
    errors, stated = [], []
    for seed in range(10):
        stripes = [
            seen_on_ball(camera, COLUMNS, ROWS, sigma_px=0.05, noise_px=0.05, seed=2 * seed + number)
            for number, camera in enumerate(TRUE[:2])
        ]
        found = refine_pose(stripes, believed[:2], PROJECTOR, Axis.COLUMN, 1, [(0, 1)], widest_gap_px=GAP_PX)
        assert found is not None
        error = from_the_ball_mm([CAMERA, found.pose, PROJECTOR], exact)
        steps = np.linalg.cholesky(found.covariance[9:, 9:] + 1e-18 * np.eye(6)).T
        moved = [from_the_ball_mm([CAMERA, _with_step(found.pose, each), PROJECTOR], exact) - error for each in steps]
        half = len(error) // 2  # the points of the camera that was refined
        errors.append(error[half:])
        stated.append(np.sqrt((np.array(moved)[:, half:] ** 2).sum(axis=0)))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(stated, axis=0)
    assert 0.5 < np.median(ratio) < 1.5


def _with_step(device: Pinhole, step: FloatArray) -> Pinhole:
    """The device with a small rotation R' = exp([a]x) R and translation added."""
    x, y, z = step[:3]
    turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    u, _, vt = np.linalg.svd(turn @ device.rotation)
    return replace(device, rotation=u @ vt, translation_mm=device.translation_mm + step[3:])


def test_too_few_common_points_give_no_pose() -> None:
    stripes = [seen_on_ball(camera, [120.0], ROWS[:40]) for camera in TRUE[:2]]
    assert refine_pose(stripes, TRUE[:2], PROJECTOR, Axis.COLUMN, 1, [(0, 1)], widest_gap_px=GAP_PX) is None
