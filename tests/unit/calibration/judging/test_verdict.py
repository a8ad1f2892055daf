"""The verdict on a solve: each cause is named with its figure, its limit and what to do; the worst one decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.judging.comparison import check_scale
from slrig.calibration.judging.verdict import LIMITS, Grade, Verdict, verdict
from slrig.calibration.poses.coverage import coverage
from slrig.calibration.solution import (
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    Bow,
    DeviceResiduals,
    ExpectedError,
    Solution,
)
from slrig.model import Calibration, FloatArray, Pinhole
from tests.unit.calibration.posed_boards import CHESSBOARD, Shooting, held, two_cameras_and_projector

EACH = len(PARAMETERS)
EXPECTED = ExpectedError(
    np.array([[-100.0, -80.0, 500.0], [100.0, 80.0, 700.0]]),
    0.01,
    0.02,
    0.0224,
    5e-5,
    np.zeros((1, 3)),
    np.full(1, 0.01),
)
"""In a volume of 325 mm across its diagonal."""


def _residuals(rms_px: float = 0.08) -> DeviceResiduals:
    poses = {f"pose_{index:02d}": rms_px * (0.9 + 0.02 * index) for index in range(12)}
    return DeviceResiduals(
        rms_px, 0.8 * rms_px, 1.1 * rms_px, 1056, 3, poses,
        np.full((6, 6), rms_px), np.full((6, 6, 2), 0.1 * rms_px), np.full((6, 6), 100, dtype=np.int32),
    )  # fmt: skip


def _covariance(devices: int = 3) -> FloatArray:
    sigma = np.array([0.8, 0.8, 0.9, 0.9, 1e-3, 5e-3, 1e-4, 1e-4, 0.0, 4e-4, 4e-4, 1e-4, 0.05, 0.05, 0.1])
    return np.diag(np.tile(sigma**2, devices))


def _solution() -> Solution:
    devices = two_cameras_and_projector()
    calibration = Calibration({name: devices[name] for name in ("left", "right")}, devices[PROJECTOR])
    poses = {f"pose_{index:02d}": BoardPose(np.eye(3), np.array([10.0 * index, 0.0, 600.0])) for index in range(12)}
    residuals = {name: _residuals() for name in devices}
    return Solution(calibration, _covariance(), dict.fromkeys(devices, ("k1", "k2")), poses, {}, residuals)


def _with(solution: Solution, name: str, residuals: DeviceResiduals) -> Solution:
    return replace(solution, residuals={**solution.residuals, name: residuals})


def _says(found: Verdict, *words: str) -> bool:
    return any(all(word in reason for word in words) for reason in found.reasons)


def test_a_sound_calibration_is_good_and_says_what_was_judged() -> None:
    found = verdict(_solution(), EXPECTED)
    assert found.grade is Grade.GOOD
    assert found.reasons == ()
    assert found.summary.startswith("good: a scanned point is expected within 0.01 mm (1 in 32,4")
    assert {each.figure for each in found.judged} >= {
        "error_share", "poses", "camera_rms_px", "projector_rms_px", "held_out", "stated_ratio", "principal_sigma_px",
        "focal_sigma_share",
    }  # fmt: skip
    assert all(each.words for each in found.judged)


def test_a_camera_with_a_large_rms_names_the_pose_to_look_at_first() -> None:
    residuals = _residuals(0.31)
    bad = replace(residuals, pose_rms_px={**residuals.pose_rms_px, "pose_07": 0.9})
    found = verdict(_with(_solution(), "left", bad), EXPECTED)
    assert found.grade is Grade.USABLE
    assert _says(found, "camera 'left' has 0.31 px rms", "usual is 0.05–0.2", "look at pose_07 first (0.9 px)")


@pytest.mark.parametrize(("rms_px", "grade"), [(0.19, Grade.GOOD), (0.5, Grade.USABLE), (2.0, Grade.DO_NOT_USE)])
def test_the_worst_reason_decides(rms_px: float, grade: Grade) -> None:
    found = verdict(_with(_solution(), "right", _residuals(rms_px)), EXPECTED)
    assert found.grade is grade
    assert found.judged[0].grade is grade


def test_a_projector_has_its_own_limit() -> None:
    assert verdict(_with(_solution(), PROJECTOR, _residuals(0.28)), EXPECTED).grade is Grade.GOOD
    found = verdict(_with(_solution(), PROJECTOR, _residuals(5.0)), EXPECTED)
    assert found.grade is Grade.DO_NOT_USE
    assert _says(found, "the projector has 5 px rms", "usual is 0.1–0.3", "refresh period")


def test_a_lens_fitted_to_too_few_poses_is_told_by_the_held_out_ones() -> None:
    bad = replace(_residuals(), held_out_rms_px=0.16)
    found = verdict(_with(_solution(), "left", bad), EXPECTED)
    assert _says(found, "camera 'left'", "2.00 × its own", "at most 1.3 ×", "add poses")
    worse = replace(_residuals(), held_out_rms_px=0.4)
    assert verdict(_with(_solution(), "left", worse), EXPECTED).grade is Grade.DO_NOT_USE
    unknown = replace(_residuals(), held_out_rms_px=float("nan"))
    found = verdict(_with(_solution(), "left", unknown), EXPECTED)
    assert found.grade is Grade.USABLE
    assert _says(found, "too few poses to keep some from the solve")


def test_the_expected_error_is_told_in_mm_and_as_a_fraction_of_the_diagonal() -> None:
    found = verdict(_solution(), replace(EXPECTED, point_mm=0.06, total_mm=0.063))
    assert found.grade is Grade.USABLE
    assert _says(found, "0.06 mm off by the calibration (0.063 mm with", "1 in 5,416", "325 mm", "1 in 10,000")
    far = verdict(_solution(), replace(EXPECTED, point_mm=0.5))
    assert far.grade is Grade.DO_NOT_USE
    lengths = verdict(_solution(), replace(EXPECTED, length_share=4e-4))
    assert _says(lengths, "half the volume's diagonal", "0.065 mm wrong", "1 in 5,000")
    unknown = verdict(_solution(), None)
    assert unknown.grade is Grade.USABLE
    assert _says(unknown, "could not be told")


def test_few_poses_and_poses_left_out_are_named() -> None:
    solution = _solution()
    few = dict(list(solution.poses.items())[:6])
    found = verdict(replace(solution, poses=few), EXPECTED)
    assert found.grade is Grade.USABLE
    assert _says(found, "6 poses used", "20 to 30 are usual")
    assert verdict(replace(solution, poses=dict(list(few.items())[:3])), EXPECTED).grade is Grade.DO_NOT_USE
    out = verdict(replace(solution, outliers={"pose_12": "the board moved by 3 px"}), EXPECTED)
    assert out.grade is Grade.USABLE
    assert _says(out, "1 of 13 poses left out (pose_12: the board moved by 3 px)")
    many = {f"bad_{index}": "it moved" for index in range(5)}
    assert verdict(replace(solution, outliers=many), EXPECTED).grade is Grade.DO_NOT_USE


def test_a_principal_point_that_is_not_known_is_told_with_its_axis() -> None:
    covariance = _covariance()
    covariance[2 * EACH + 3, 2 * EACH + 3] = 9.0**2
    found = verdict(replace(_solution(), covariance=covariance), EXPECTED)
    assert found.grade is Grade.USABLE
    assert _says(found, "the projector: the principal row is 860.0 ± 9 px", "about the horizontal axis")
    covariance = _covariance()
    covariance[0, 0] = 12.0**2
    found = verdict(replace(_solution(), covariance=covariance), EXPECTED)
    assert _says(found, "camera 'left': the focal length is 2100.0 ± 12 px", "±0.1% is well", "other distances")


def test_light_that_is_worse_than_its_noise_points_to_the_cause() -> None:
    bad = replace(_residuals(0.25), stated_rms_px=0.05)
    found = verdict(_with(_solution(), PROJECTOR, bad), EXPECTED)
    assert _says(found, "the projector is 5.0 × as far off as the noise", "gamma")
    fine = replace(_residuals(0.09), stated_rms_px=0.005)  # far above the noise, and as good as any
    assert verdict(_with(_solution(), "left", fine), EXPECTED).grade is Grade.GOOD
    bad = replace(_residuals(0.15), stated_rms_px=0.05)
    assert _says(verdict(_with(_solution(), "left", bad), EXPECTED), "camera 'left' is 3.0 ×", "bent board")


def test_outlying_observations_and_leaning_residuals_are_told_with_their_place() -> None:
    bad = replace(_residuals(), outlying=100)
    assert _says(verdict(_with(_solution(), "left", bad), EXPECTED), "9.5% of 1056 observations are outlying")
    residuals = _residuals()
    mean = residuals.map_mean_px.copy()
    mean[5, 0] = (0.15, 0.0)
    found = verdict(_with(_solution(), "left", replace(residuals, map_mean_px=mean)), EXPECTED)
    assert _says(found, "in the lower left corner the residuals lean by 0.15 px", "add poses there")
    # Next to nothing was seen there: a mean of ten residuals tells nothing.
    count = residuals.map_count.copy()
    count[5, 0] = 10
    assert (
        verdict(_with(_solution(), "left", replace(residuals, map_mean_px=mean, map_count=count)), EXPECTED).grade
        is Grade.GOOD
    )


def test_a_border_that_no_corner_reached_leaves_the_distortion_open_there() -> None:
    shooting = Shooting(CHESSBOARD, two_cameras_and_projector())
    poses = [
        shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, tilt=(tilt, 0.0), middle_mm=(0.0, 0.0, 700.0)))
        for index, tilt in enumerate((0.0, 20.0, -20.0))
    ]
    found = verdict(_solution(), EXPECTED, coverage(poses, CHESSBOARD, shooting.sizes))
    assert found.grade is Grade.DO_NOT_USE
    assert _says(
        found, "camera 'left': 100% of the cells along the image's border", "distortion is not determined there"
    )


def test_a_bent_board_is_told() -> None:
    shape = np.zeros((88, 3))
    shape[:, 0] = 0.06
    bowed = replace(_solution(), board_shape_mm=shape, bow=Bow(0.412, 0.021, solved=True))
    found = verdict(bowed, EXPECTED)
    assert _says(found, "bowed, 0.412 ± 0.021 mm", "0.06 mm off their printed places", "up to 0.2 mm is well", "glass")
    assert found.grade is Grade.USABLE


def test_a_bow_that_chance_explains_is_told_and_held_against_nothing() -> None:
    found = verdict(replace(_solution(), bow=Bow(0.5, 0.4, solved=False)), EXPECTED)
    assert found.grade is Grade.GOOD
    (judged,) = (each for each in found.judged if each.figure == "bend_mm")
    assert "flat as far as the poses tell: 0.50 ± 0.40 mm" in judged.words
    # Where a person said that the board is flat, nobody looked.
    assert not [each for each in verdict(_solution(), EXPECTED).judged if each.figure == "bend_mm"]


def test_every_limit_has_a_source_and_grades_in_order() -> None:
    for limit in LIMITS.values():
        assert limit.source
        assert limit.good < limit.usable
        assert limit.grade(limit.good) is Grade.GOOD
        assert limit.grade(float("nan")) is Grade.USABLE


def _scaled(device: Pinhole, factor: float) -> Pinhole:
    return replace(device, translation_mm=factor * device.translation_mm)


def test_a_wrong_square_size_is_named_with_the_size_that_the_squares_have() -> None:
    solution = _solution()
    devices = {**solution.calibration.cameras}
    projector = solution.calibration.projector
    assert projector is not None
    # Printed at 96 %, and said to be 12 mm: the new solve makes everything 1 / 0.96 as large.
    wrong = Calibration({name: _scaled(each, 1 / 0.96) for name, each in devices.items()}, _scaled(projector, 1 / 0.96))
    found = check_scale(replace(solution, calibration=wrong), solution.calibration, CHESSBOARD)
    assert len(found) == 1
    assert "4.2% larger" in found[0]
    assert "squares measure 11.52 mm instead of 12 mm" in found[0]
    assert "measure the printed ruler" in found[0]
    slightly = Calibration({name: _scaled(each, 1.004) for name, each in devices.items()}, _scaled(projector, 1.004))
    assert check_scale(replace(solution, calibration=slightly), solution.calibration, CHESSBOARD) == ()


def test_a_rebuilt_rig_is_not_taken_for_a_wrong_square_size() -> None:
    solution = _solution()
    projector = solution.calibration.projector
    assert projector is not None
    moved = replace(projector, translation_mm=projector.translation_mm * 1.1)
    rebuilt = Calibration(solution.calibration.cameras, moved)
    found = check_scale(replace(solution, calibration=rebuilt), solution.calibration, CHESSBOARD)
    assert len(found) == 1
    assert "the rig was rebuilt, or a device was bumped" in found[0]
    assert "camera 'left' to the projector" in found[0]


def test_a_scale_that_the_solve_itself_does_not_know_is_not_blamed_on_the_board() -> None:
    solution = _solution()
    projector = solution.calibration.projector
    assert projector is not None
    cameras = {name: _scaled(each, 1.02) for name, each in solution.calibration.cameras.items()}
    wrong = replace(solution, calibration=Calibration(cameras, _scaled(projector, 1.02)))
    assert check_scale(wrong, solution.calibration, CHESSBOARD)
    assert check_scale(replace(wrong, covariance=_covariance() * 30.0**2), solution.calibration, CHESSBOARD) == ()
    other = Calibration({"middle": projector}, None)
    (words,) = check_scale(solution, other, CHESSBOARD)
    assert "the scale is not checked: that takes two devices which the earlier calibration has too, found no" in words
