"""Two calibrations compared: a change that was made is found again, in its size and in its σ."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.calibration.displacement import rigid_free, without_rigid_motion
from slrig.calibration.judging.comparison import comparison
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size, Solved

SIGMA = np.array([0.5, 0.5, 0.8, 0.8, *[1e-4] * 5, *[1e-4] * 3, *[0.02] * 3])


def device(size: Size, focal_px: float, rotation: FloatArray, centre_mm: FloatArray) -> Pinhole:
    matrix = np.array([[focal_px, 0, size.width_px / 2], [0, focal_px, size.height_px / 2], [0, 0, 1.0]])
    distortion = np.array([-0.1, 0.05, 0.0, 0.0, 0.0])
    return Pinhole(size, matrix, distortion, rotation, -rotation @ centre_mm)


def rig(*, solved: bool = True) -> Calibration:
    """Two cameras and a projector, converging on a volume about 600 mm away; the first camera's frame is the world."""
    turn = [Rotation.from_euler("y", angle, degrees=True).as_matrix() for angle in (-15.0, -8.0)]
    size = Size(1280, 1024)
    cameras = {
        "left": device(size, 1900.0, np.eye(3), np.zeros(3)),
        "right": device(size, 1890.0, turn[0], np.array([160.0, 0.0, 0.0])),
    }
    projector = device(Size(1280, 800), 1600.0, turn[1], np.array([80.0, 60.0, 0.0]))
    covariance = np.diag(np.concatenate([SIGMA, SIGMA, SIGMA]) ** 2)
    covariance[9:15] = covariance[:, 9:15] = 0.0
    volume = np.array([[-80.0, -60.0, 550.0], [80.0, 60.0, 650.0]])
    found = Solved("a", "2026-11-22T10:00:00+00:00", covariance, volume, 0.01)
    return Calibration(cameras, projector, found if solved else None)


def with_right(calibration: Calibration, **changes: Any) -> Calibration:
    cameras = {**calibration.cameras, "right": replace(calibration.cameras["right"], **changes)}
    return replace(calibration, cameras=cameras)


def test_calibration_is_the_same_as_itself() -> None:
    found = comparison(rig(), rig())
    assert found.missing == ()
    assert found.moved_rms_mm == found.moved_most_mm == found.turn_deg == found.shift_mm == 0
    assert found.words[0].startswith("Points in the working volume move by 0 mm rms, by 0 mm at most, besides a turn")
    assert set(found.devices) == {"left", "right", "projector"}
    for each in found.devices.values():
        assert each.focal_percent.value == each.principal_px.value == 0
        assert "no more than chance" in each.focal_percent.words
    assert found.devices["left"].rotation_deg is None


def test_a_longer_focal_length_is_reported_in_percent_and_sigmas() -> None:
    matrix = rig().cameras["right"].matrix.copy()
    matrix[0, 0] *= 1.002
    matrix[1, 1] *= 1.002
    right = comparison(rig(), with_right(rig(), matrix=matrix)).devices["right"]
    assert right.focal_percent.value == pytest.approx(0.2)
    # The mean of fx and fy, each known to 0.5 px in both solves.
    assert right.focal_percent.sigma == pytest.approx(100 / 1890 * 0.5, rel=1e-3)
    assert right.focal_percent.sigmas == pytest.approx(3.78 / 0.5, rel=1e-3)
    assert "camera 'right': the focal length differs by +0.2 %, 7.6 σ: a real change." in right.focal_percent.words


def test_turn_and_baseline_are_reported_with_their_deviations() -> None:
    before = rig().cameras["right"]
    turn = Rotation.from_rotvec([0.0, np.radians(0.05), 0.0]).as_matrix()
    found = comparison(
        rig(), with_right(rig(), rotation=turn @ before.rotation, translation_mm=turn @ before.translation_mm)
    )
    right = found.devices["right"]
    assert right.rotation_deg is not None
    assert right.baseline_mm is not None
    assert right.rotation_deg.value == pytest.approx(0.05)
    assert right.rotation_deg.sigma == pytest.approx(np.degrees(1e-4) * np.sqrt(2), rel=1e-6)
    assert right.baseline_mm.value == pytest.approx(0.0, abs=1e-9)
    moved = comparison(rig(), with_right(rig(), translation_mm=before.translation_mm * 1.001)).devices["right"]
    assert moved.baseline_mm is not None
    assert moved.baseline_mm.value == pytest.approx(0.16)
    assert moved.baseline_mm.sigma == pytest.approx(0.02 * np.sqrt(2), rel=1e-6)


def test_points_move_by_what_a_longer_baseline_makes_of_them() -> None:
    """A baseline of every device longer by a share makes everything larger by it, and points move in proportion."""
    share = 1.001
    first = rig()
    assert first.projector is not None
    cameras = {name: replace(each, translation_mm=each.translation_mm * share) for name, each in first.cameras.items()}
    second = Calibration(
        cameras, replace(first.projector, translation_mm=first.projector.translation_mm * share), first.solved
    )
    found = comparison(first, second)
    # The middle of the volume moves away, by 0.6 mm, and the rest about it: the farthest point is a corner.
    assert found.shift_mm == pytest.approx((share - 1) * 600, rel=1e-4)
    assert found.turn_deg < 1e-6
    assert found.moved_most_mm == pytest.approx((share - 1) * np.linalg.norm([80, 60, 50]), rel=1e-4)
    assert found.moved_rms_mm < found.moved_most_mm
    assert f"by {found.moved_most_mm:.3g} mm at most, besides a turn of" in found.words[0]
    assert "and a shift of 0.6 mm that all of them share" in found.words[0]


def test_a_motion_of_all_points_is_no_change_of_shape_however_large() -> None:
    random = np.random.default_rng(4)
    places = random.uniform([-80, -60, 550], [80, 60, 650], (200, 3))
    turn = Rotation.from_rotvec([0.2, -0.7, 0.4])
    strain = np.array([0.01, 0.0, 0.0]) * ((places - places.mean(axis=0)) / 80) ** 2
    moved = places.mean(axis=0) + turn.apply(places - places.mean(axis=0)) + [30.0, -20.0, 7.0]
    left, motion = without_rigid_motion(places, moved)
    assert np.abs(left).max() < 1e-10
    assert motion.turn_deg == pytest.approx(np.degrees(turn.magnitude()))
    assert motion.shift_mm == pytest.approx(np.linalg.norm([30.0, -20.0, 7.0]))
    # What is left of a small strain is what the least squares of a small motion leaves of it.
    small, _ = without_rigid_motion(places, places + strain)
    assert small == pytest.approx(rigid_free(places, strain[:, :, None])[:, :, 0], abs=1e-6)


def test_world_frame_makes_no_difference() -> None:
    """An imported calibration may have its world anywhere."""
    first = rig(solved=False)
    assert first.projector is not None
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    shift = np.array([5.0, -7.0, 300.0])

    def moved(each: Pinhole) -> Pinhole:
        rotation = each.rotation @ turn
        return replace(each, rotation=rotation, translation_mm=each.translation_mm + rotation @ shift)

    second = Calibration({name: moved(each) for name, each in first.cameras.items()}, moved(first.projector))
    found = comparison(rig(), second)
    assert found.moved_most_mm < 1e-6
    right = found.devices["right"]
    assert right.rotation_deg is not None
    assert right.rotation_deg.value < 1e-5
    assert np.isnan(right.rotation_deg.sigma)
    assert "how sure that is, is not known" in right.rotation_deg.words
    nowhere = comparison(first, second)
    assert np.isnan(nowhere.moved_rms_mm)
    assert "neither calibration names a working volume" in nowhere.words[0]


def test_device_that_only_one_has_is_named() -> None:
    first = rig()
    second = Calibration({"left": first.cameras["left"]}, first.projector)
    found = comparison(first, second)
    assert found.missing == ("right",)
    assert set(found.devices) == {"left", "projector"}
    assert any("Only one of them has right" in words for words in found.words)


def test_calibrations_of_two_rigs_are_refused() -> None:
    first = rig()
    other = Calibration({"top": first.cameras["left"]}, first.projector)
    with pytest.raises(CalibrationError, match=r"one has left, right, the other top"):
        comparison(first, other)
    smaller = with_right(first)
    smaller = replace(
        smaller, cameras={**smaller.cameras, "right": replace(smaller.cameras["right"], size=Size(640, 512))}
    )
    with pytest.raises(CalibrationError, match="right has 1280 x 1024 pixels in one and 640 x 512 in the other"):
        comparison(first, smaller)
