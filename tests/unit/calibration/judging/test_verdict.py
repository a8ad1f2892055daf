"""The verdict on a solve: each cause is named with its figure, its limit and what to do; the worst one decides."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slrig.calibration.judging.board_size import ScaleCheck
from slrig.calibration.judging.grades import Grade
from slrig.calibration.judging.verdict import LIMITS, Verdict, verdict
from slrig.calibration.poses.coverage import Coverage, coverage
from slrig.calibration.solution import (
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    Bow,
    DeviceResiduals,
    ExpectedError,
    Solution,
)
from slrig.model import Calibration, FloatArray
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


def judged(
    solution: Solution, expected: ExpectedError | None = EXPECTED, covered: Coverage | None = None, **asked: Any
) -> Verdict:
    return verdict(solution, expected, covered, board=CHESSBOARD, **asked)


def _says(found: Verdict, *words: str) -> bool:
    return any(all(word in reason for word in words) for reason in found.reasons)


def _remarks(found: Verdict, *words: str) -> bool:
    return found.grade is Grade.GOOD and any(all(word in remark for word in words) for remark in found.remarks)


def test_a_sound_calibration_is_good_and_says_what_was_judged() -> None:
    found = judged(_solution())
    assert found.grade is Grade.GOOD
    assert found.reasons == found.remarks == ()
    assert found.summary.startswith("good: a scanned point is expected within 0.01 mm (1 in 32,4")
    assert found.summary.endswith("twice that is no more than the 0.16 mm that are wanted")
    assert {each.figure for each in found.judged} >= {
        "error", "poses", "camera_rms_px", "projector_rms_px", "held_out", "stated_ratio", "principal_sigma_px",
        "focal_sigma_share",
    }  # fmt: skip
    assert all(each.words for each in found.judged)


def test_a_camera_with_a_large_rms_names_the_pose_to_look_at_first() -> None:
    residuals = _residuals(0.31)
    bad = replace(residuals, pose_rms_px={**residuals.pose_rms_px, "pose_07": 0.9})
    found = judged(_with(_solution(), "left", bad))
    assert _remarks(found, "camera 'left' has 0.31 px rms", "usual is 0.05–0.2", "look at pose_07 first (0.9 px)")


@pytest.mark.parametrize(("rms_px", "grade"), [(0.19, Grade.GOOD), (0.5, Grade.GOOD), (2.0, Grade.DO_NOT_USE)])
def test_the_worst_reason_decides(rms_px: float, grade: Grade) -> None:
    found = judged(_with(_solution(), "right", _residuals(rms_px)))
    assert found.grade is grade
    assert found.judged[0].grade is grade
    assert any("its verdict is not to use it" in words for words in found.unattended) is (grade is Grade.DO_NOT_USE)


def test_a_projector_has_its_own_limit() -> None:
    assert judged(_with(_solution(), PROJECTOR, _residuals(0.28))).remarks == ()
    found = judged(_with(_solution(), PROJECTOR, _residuals(5.0)))
    assert found.grade is Grade.DO_NOT_USE
    assert _says(found, "the projector has 5 px rms", "usual is 0.1–0.3", "refresh period")


def test_held_out_poses_show_a_lens_fitted_to_too_few() -> None:
    bad = replace(_residuals(), held_out_rms_px=0.16)
    found = judged(_with(_solution(), "left", bad))
    assert _remarks(found, "camera 'left'", "2.00 × its own", "at most 1.3 ×", "add poses")
    worse = replace(_residuals(), held_out_rms_px=0.4)
    assert judged(_with(_solution(), "left", worse)).grade is Grade.DO_NOT_USE
    # Poor beside the rest, and still no more than is usual.
    small = replace(_residuals(0.05), held_out_rms_px=0.19)
    assert _remarks(judged(_with(_solution(), "left", small)), "3.80 × its own")
    unknown = replace(_residuals(), held_out_rms_px=float("nan"))
    found = judged(_with(_solution(), "left", unknown))
    assert found.grade is Grade.USABLE
    assert _says(found, "too few poses to keep some from the solve")


def test_the_grade_follows_the_millimetres_that_are_wanted() -> None:
    found = judged(_solution(), replace(EXPECTED, point_mm=0.1, total_mm=0.102))
    assert found.grade is Grade.USABLE
    assert _says(found, "0.1 mm off by the calibration (0.1 mm with", "0.2 mm, wanted are 0.16 mm", "add poses")
    assert judged(_solution(), replace(EXPECTED, point_mm=0.1), wanted_mm=0.21).grade is Grade.GOOD
    assert judged(_solution(), wanted_mm=0.019).grade is Grade.USABLE
    assert judged(_solution(), wanted_mm=0.009).grade is Grade.DO_NOT_USE
    lengths = judged(_solution(), replace(EXPECTED, length_share=4e-4))
    assert "a length of 162 mm 0.065 mm wrong" in lengths.judged[0].words
    unknown = judged(_solution(), None)
    assert unknown.grade is Grade.USABLE
    assert _says(unknown, "could not be told")


def test_a_board_that_limits_the_error_is_named_with_what_to_do() -> None:
    found = judged(_solution(), replace(EXPECTED, board_mm=0.009))
    assert _remarks(found, "limited by the board, whose size makes 0.009 mm of it", "measure both rulers")
    assert "by the size of the board most of all" in found.summary
    poor = judged(_solution(), replace(EXPECTED, board_mm=0.009), wanted_mm=0.015)
    assert poor.grade is Grade.USABLE
    assert _says(poor, "limited by the board", "--square-sigma")
    assert judged(_solution(), replace(EXPECTED, board_mm=0.005)).remarks == ()


def test_a_wrong_scale_keeps_a_calibration_from_being_good_and_from_the_clock() -> None:
    agrees = ScaleCheck(True, 1e-4, 1e-4, ())
    assert judged(_solution(), scale=agrees).unattended == ()
    words = "everything is 0.90% larger than in the earlier calibration"
    found = judged(_solution(), scale=ScaleCheck(True, 0.009, 1e-4, (words,)))
    assert (found.grade, found.reasons, found.unattended) == (Grade.USABLE, (words,), (words,))


def test_few_poses_and_poses_left_out_are_named() -> None:
    solution = _solution()
    few = dict(list(solution.poses.items())[:6])
    assert _remarks(judged(replace(solution, poses=few)), "6 poses used", "20 to 30 are usual")
    assert judged(replace(solution, poses=dict(list(few.items())[:3]))).grade is Grade.DO_NOT_USE
    out = judged(replace(solution, outliers={"pose_12": "the board moved by 3 px"}))
    assert _remarks(out, "1 of 13 poses left out (pose_12: the board moved by 3 px)")
    many = {f"bad_{index}": "it moved" for index in range(5)}
    assert judged(replace(solution, outliers=many)).grade is Grade.DO_NOT_USE


def test_an_unsure_principal_point_is_named_with_its_axis() -> None:
    covariance = _covariance()
    covariance[2 * EACH + 3, 2 * EACH + 3] = 9.0**2
    found = judged(replace(_solution(), covariance=covariance))
    assert _remarks(found, "the projector: the principal row is 860.0 ± 9 px", "about the horizontal axis")
    covariance = _covariance()
    covariance[0, 0] = 12.0**2
    found = judged(replace(_solution(), covariance=covariance))
    assert _remarks(found, "camera 'left': the focal length is 2100.0 ± 12 px", "±0.1% is well", "other distances")


def test_light_that_is_worse_than_its_noise_points_to_the_cause() -> None:
    bad = replace(_residuals(0.25), stated_rms_px=0.05)
    found = judged(_with(_solution(), PROJECTOR, bad))
    assert _remarks(found, "the projector is 5.0 × as far off as the noise", "gamma")
    fine = replace(_residuals(0.09), stated_rms_px=0.005)  # far above the noise, and as good as any
    assert judged(_with(_solution(), "left", fine)).remarks == ()
    bad = replace(_residuals(0.15), stated_rms_px=0.05)
    assert _remarks(judged(_with(_solution(), "left", bad)), "camera 'left' is 3.0 ×", "bent board")


def test_outlying_observations_and_leaning_residuals_are_named_with_their_place() -> None:
    bad = replace(_residuals(), outlying=100)
    assert _remarks(judged(_with(_solution(), "left", bad)), "9.5% of 1056 observations are outlying")
    assert judged(_with(_solution(), "left", replace(bad, outlying=200))).grade is Grade.DO_NOT_USE
    residuals = _residuals()
    mean = residuals.map_mean_px.copy()
    mean[5, 0] = (0.15, 0.0)
    found = judged(_with(_solution(), "left", replace(residuals, map_mean_px=mean)))
    assert _remarks(found, "in the lower left corner the residuals lean by 0.15 px", "add poses there")
    # Next to nothing was seen there: a mean of ten residuals tells nothing.
    count = residuals.map_count.copy()
    count[5, 0] = 10
    unseen = replace(residuals, map_mean_px=mean, map_count=count)
    assert judged(_with(_solution(), "left", unseen)).remarks == ()


def test_a_border_that_no_corner_reached_leaves_the_distortion_open_there() -> None:
    shooting = Shooting(CHESSBOARD, two_cameras_and_projector())
    poses = [
        shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, tilt=(tilt, 0.0), middle_mm=(0.0, 0.0, 700.0)))
        for index, tilt in enumerate((0.0, 20.0, -20.0))
    ]
    found = judged(_solution(), EXPECTED, coverage(poses, CHESSBOARD, shooting.sizes))
    words = "camera 'left': 100% of the cells along the image's border", "distortion is not determined there"
    assert _remarks(found, *words)


def test_a_bent_board_is_named() -> None:
    shape = np.zeros((88, 3))
    shape[:, 0] = 0.06
    bowed = replace(_solution(), board_shape_mm=shape, bow=Bow(0.412, 0.021, solved=True))
    words = "bowed, 0.412 ± 0.021 mm", "0.06 mm off their printed places", "up to 0.2 mm is well", "glass"
    assert _remarks(judged(bowed), *words)


def test_a_bow_within_chance_is_reported_and_lowers_no_grade() -> None:
    found = judged(replace(_solution(), bow=Bow(0.5, 0.4, solved=False)))
    assert found.remarks == ()
    (bend,) = (each for each in found.judged if each.figure == "bend_mm")
    assert "flat as far as the poses tell: 0.50 ± 0.40 mm" in bend.words
    # Where a person said that the board is flat, nobody looked.
    assert not [each for each in judged(_solution()).judged if each.figure == "bend_mm"]


def test_every_limit_has_a_source_and_grades_in_order() -> None:
    for limit in LIMITS.values():
        assert limit.source
        assert limit.good < limit.most
        assert limit.grade(limit.good) is Grade.GOOD
        assert limit.grade(float("nan")) is Grade.USABLE
