"""The axis of a turntable from synthetic poses of a board with known noise, and its updates by models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.calibration.board import DEFAULT_BOARD
from slrig.errors import TurntableRefusedError
from slrig.model import FloatArray, MeasuredAxis, update_axis
from slrig.multiview.turntable import BoardAxis, axis_from_board
from tests.core import parametrize_core

POINT_MM = np.array([12.0, 60.0, 480.0])
DIRECTION = np.array([0.05, -0.93, -0.36]) / np.linalg.norm([0.05, -0.93, -0.36])
SIX_DEG = np.array([0.0, 35.0, 70.0, 115.0, 150.0, 190.0])
NOISE = np.repeat([2e-4, 0.03], 3)
"""Of a pose: rad, mm."""


def shot(
    angles_deg: FloatArray, seed: int = 0, slipped: tuple[slice, float] = (slice(0), 0.0)
) -> tuple[list[str], FloatArray, FloatArray]:
    """Poses of the board on a turntable with noise, some slipped by mm along the board; and their covariance."""
    rng = np.random.default_rng(seed)
    first = np.eye(4)
    first[:3, :3] = Rotation.from_euler("xyz", [70, 10, 4], degrees=True).as_matrix()
    first[:3, 3] = POINT_MM + np.array([-60.0, 20.0, -30.0])
    poses = np.tile(np.eye(4), (len(angles_deg), 1, 1))
    shift = np.zeros(len(angles_deg))
    shift[slipped[0]] = slipped[1]
    # One error is common to all poses, as that of a calibration is.
    common = np.array([0, 0, 0, 0.2, -0.3, 0.5]) * rng.normal()
    for pose, angle, along in zip(poses, angles_deg, shift, strict=True):
        turn = Rotation.from_rotvec(np.deg2rad(angle) * DIRECTION).as_matrix()
        error = NOISE * rng.normal(size=6) + common
        stood = first[:3, 3] + along * first[:3, 0]
        pose[:3, :3] = Rotation.from_rotvec(error[:3]).as_matrix() @ turn @ first[:3, :3]
        pose[:3, 3] = turn @ (stood - POINT_MM) + POINT_MM + error[3:]
    each = np.diag(NOISE**2)
    shared = np.outer([0, 0, 0, 0.2, -0.3, 0.5], [0, 0, 0, 0.2, -0.3, 0.5])
    covariance = np.asarray(np.kron(np.eye(len(poses)), each) + np.kron(np.ones((len(poses),) * 2), shared), np.float64)
    return [f"pose {number}" for number in range(1, len(angles_deg) + 1)], poses, covariance


def axis_found(angles_deg: FloatArray, seed: int = 0, stated: FloatArray | None = None) -> BoardAxis:
    return axis_from_board(*shot(angles_deg, seed), DEFAULT_BOARD.points_mm, stated)


def off(found: MeasuredAxis, covariance: FloatArray) -> float:
    """Squared distance from the truth over its deviation, for each of an axis' four numbers."""
    across = np.linalg.svd(found.direction[None])[2][1:]
    along = found.direction @ (found.point_mm - POINT_MM) / (found.direction @ DIRECTION)
    errors = np.concatenate([
        across @ (found.point_mm - POINT_MM - along * DIRECTION), across @ (found.direction - DIRECTION)
    ])  # fmt: skip
    known = np.kron(np.eye(2), across)
    return float(errors @ np.linalg.solve(known @ covariance @ known.T, errors)) / 4


def test_the_error_of_the_axis_is_as_stated() -> None:
    squares = []
    for seed in range(20):
        found = axis_found(SIX_DEG, seed).axis
        squares.append(off(found.measured_axis, found.covariance))
    assert 0.7 < np.mean(squares) < 1.5


def test_residuals_are_the_noise_and_errors_those_of_the_stated_angles() -> None:
    found = axis_found(SIX_DEG, stated=SIX_DEG + np.array([0, 0.5, 0, 0, 0, 0]))
    assert max(found.residual_mm.values()) < 0.1
    assert list(found.angles_deg.values()) == pytest.approx((SIX_DEG + 180) % 360 - 180, abs=0.1)
    assert found.errors_deg["pose 2"] == pytest.approx(-0.5 * 5 / 6, abs=0.1)


def test_the_sense_of_stated_angles_is_that_of_the_axis() -> None:
    assert axis_found(SIX_DEG).axis.direction @ DIRECTION > 0.99
    assert axis_found(SIX_DEG, stated=-SIX_DEG).axis.direction @ DIRECTION < -0.99


@parametrize_core(
    ("angles_deg", "slipped", "words"),
    [
        (SIX_DEG[:2], (slice(0), 0.0), "found 2"),
        (SIX_DEG * 0.05, (slice(0), 0.0), r"found 9\.\d° over 6 poses"),
        (SIX_DEG, (slice(3, 4), 0.6), "slipped in 'pose 4'"),
        (SIX_DEG, (slice(3, None), 0.6), "slipped between 'pose 3' and 'pose 4'"),
        (SIX_DEG, (slice(1, None, 2), 3.0), "off by .* mm rms, 'pose"),
    ],
    core=[0, 2],
)
def test_poses_that_determine_no_axis_are_refused(
    angles_deg: FloatArray, slipped: tuple[slice, float], words: str
) -> None:
    with pytest.raises(TurntableRefusedError, match=words):
        axis_from_board(*shot(angles_deg, 1, slipped), DEFAULT_BOARD.points_mm)


def measured(
    offset_mm: float, tilt_rad: float, sigma_mm: float, sigma_rad: float, along_mm: float = 0.0
) -> MeasuredAxis:
    """An axis with an error, and its uncertainty at a point along it."""
    across = np.linalg.svd(DIRECTION[None])[2][1:]
    direction = DIRECTION + tilt_rad * across[0]
    direction /= np.linalg.norm(direction)
    known = across.T @ across
    covariance = np.kron(np.diag([sigma_mm**2, sigma_rad**2]), known)
    return MeasuredAxis(POINT_MM + offset_mm * across[0] + along_mm * direction, direction, covariance)


def test_models_improve_the_axis_by_their_covariance() -> None:
    found = update_axis(measured(0.1, 0.0, 0.1, 1e-3), measured(-0.01, 1e-4, 0.01, 1e-4, along_mm=80.0))
    assert found.agrees
    # At its point the new axis is off by -0.002 mm, and 50 mm on by 0.005 mm more.
    assert found.moved_mm == pytest.approx(0.107, abs=1e-4)
    across = np.linalg.svd(DIRECTION[None])[2][1:]
    place = across @ (found.axis.point_mm - POINT_MM)
    assert np.linalg.norm(place) < 0.02
    assert np.sqrt(np.trace(found.axis.covariance[:3, :3]) / 2) == pytest.approx(0.01, rel=0.1)


def test_an_axis_elsewhere_leaves_the_record_unchanged() -> None:
    record = measured(0.0, 0.0, 0.02, 1e-4)
    found = update_axis(record, measured(0.5, 0.0, 0.01, 1e-4))
    assert not found.agrees
    assert found.axis is record
    assert found.sigmas > 10


def test_a_record_follows_a_turntable_that_drifts() -> None:
    record = measured(0.0, 0.0, 0.005, 5e-5)
    for number in range(60):
        found = update_axis(record, measured(0.004 * number, 0.0, 0.005, 5e-5))
        assert found.agrees, number
        record = found.axis
    across = np.linalg.svd(DIRECTION[None])[2][1:]
    assert np.linalg.norm(across @ (record.point_mm - POINT_MM)) == pytest.approx(0.004 * 59, abs=0.02)
