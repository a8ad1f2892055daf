"""The verdict on a solve: each cause is named with its figure, its limit and what to do; the worst one decides."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slrig.calibration.judgement import (
    LIMITS,
    Grade,
    ScaleCheck,
    Verdict,
    check_scale,
    grade_board_size,
    judge_calibration,
    unattended_faults,
)
from slrig.calibration.poses.guidance import Coverage, coverage
from slrig.calibration.solution import (
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    BoardSize,
    Bow,
    DeviceResiduals,
    ExpectedError,
    Solution,
    scale_mode,
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
    return judge_calibration(solution, expected, covered, board=CHESSBOARD, **asked)


def _says(found: Verdict, *words: str) -> bool:
    return any(all(word in reason for word in words) for reason in found.reasons)


def _remarks(found: Verdict, *words: str) -> bool:
    return found.grade is Grade.GOOD and any(all(word in remark for word in words) for remark in found.remarks)


def test_a_sound_calibration_is_good_and_says_what_was_judged() -> None:
    found = judged(_solution())
    assert found.grade is Grade.GOOD
    assert found.reasons == found.remarks == ()
    assert found.summary.startswith("good: the expected error of a scanned point is 0.01 mm (1 in 32,4")
    assert found.summary.endswith("within the limit of 0.081 mm")
    assert {each.figure for each in found.figures} >= {
        "error", "poses", "camera_rms_px", "projector_rms_px", "held_out", "stated_ratio", "principal_sigma_px",
        "focal_sigma_share",
    }  # fmt: skip
    assert all(each.message for each in found.figures)


POSES = dict(list(_solution().poses.items())[:6])
WORST = {**_residuals(0.31).pose_rms_px, "pose_07": 0.9}
FAR_OFF = replace(_residuals(0.25), stated_rms_px=0.05)
SHAPE = np.full((88, 3), [0.06, 0.0, 0.0])
BENT = replace(_solution(), board_shape_mm=SHAPE, bow=Bow(0.412, 0.021, solved=True))


def _known(parameter: int, sigma: float) -> Solution:
    """A solution of which one parameter has this deviation."""
    covariance = _covariance()
    covariance[parameter, parameter] = sigma**2
    return replace(_solution(), covariance=covariance)


def _left(rms_px: float = 0.08, **changes: Any) -> Solution:
    return _with(_solution(), "left", replace(_residuals(rms_px), **changes))


@pytest.mark.parametrize(
    ("solution", "words"),
    [
        (_left(0.31, pose_rms_px=WORST), r"'left' has 0.31 px rms.*usual is 0.05–0.2.*check pose_07 first .0.9 px"),
        (replace(_solution(), poses=POSES), "6 poses used.*20 to 30 are usual"),
        (replace(_solution(), outliers={"pose_12": "it moved"}), r"1 of 13 poses left out \(pose_12: it moved\)"),
        (_known(2 * EACH + 3, 9.0), "projector: the principal row is 860.0 ± 9 px.*about the horizontal axis"),
        (_known(0, 12.0), "'left': the focal length is 2100.0 ± 12 px.*±0.1% is good.*other distances"),
        (_with(_solution(), PROJECTOR, FAR_OFF), "the projector: residuals are 5.0 × as large as the noise.*gamma"),
        (_left(0.15, stated_rms_px=0.05), "camera 'left': residuals are 3.0 ×.*bent board"),
        (BENT, "bowed, 0.412 ± 0.021 mm.*0.06 mm off their nominal positions.*up to 0.2 mm is good.*glass"),
        (_left(outlying=100), "9.5% of 1056 observations are outliers"),
        (_left(held_out_rms_px=0.16), "camera 'left'.*2.00 × its own.*at most 1.3 ×.*add poses"),
        # Poor beside the rest, and still no more than is usual.
        (_left(0.05, held_out_rms_px=0.19), "3.80 × its own"),
    ],
)
def test_what_is_not_as_usual_is_named_with_its_place(solution: Solution, words: str) -> None:
    found = judged(solution)
    assert found.grade is Grade.GOOD
    assert any(re.search(words, remark) for remark in found.remarks), found.remarks


@pytest.mark.parametrize(
    "solution",
    [
        replace(_solution(), poses=dict(list(POSES.items())[:3])),
        replace(_solution(), outliers={f"bad_{index}": "it moved" for index in range(5)}),
        _left(held_out_rms_px=0.4),
        _left(outlying=200),
    ],
    ids=["three poses", "five left out", "held out", "outlying"],
)
def test_what_is_far_from_usual_is_not_to_be_used(solution: Solution) -> None:
    assert judged(solution).grade is Grade.DO_NOT_USE


@pytest.mark.parametrize(("rms_px", "grade"), [(0.19, Grade.GOOD), (0.5, Grade.GOOD), (2.0, Grade.DO_NOT_USE)])
def test_the_worst_reason_decides(rms_px: float, grade: Grade) -> None:
    found = judged(_with(_solution(), "right", _residuals(rms_px)))
    assert found.grade is grade
    assert found.figures[0].grade is grade
    assert any("its verdict is not to use it" in words for words in found.unattended) is (grade is Grade.DO_NOT_USE)


def test_a_projector_has_its_own_limit() -> None:
    assert judged(_with(_solution(), PROJECTOR, _residuals(0.28))).remarks == ()
    found = judged(_with(_solution(), PROJECTOR, _residuals(5.0)))
    assert found.grade is Grade.DO_NOT_USE
    assert _says(found, "the projector has 5 px rms", "usual is 0.1–0.3", "refresh period")


def test_missing_held_out_poses_make_it_usable_only() -> None:
    found = judged(_left(held_out_rms_px=float("nan")))
    assert found.grade is Grade.USABLE
    assert _says(found, "too few poses to hold some out from the solve")


def test_the_grade_follows_the_millimetres_that_are_wanted() -> None:
    found = judged(_solution(), replace(EXPECTED, point_mm=0.1, total_mm=0.102))
    assert found.grade is Grade.USABLE
    assert _says(found, "0.1 mm off by the calibration (0.1 mm with", "0.2 mm, wanted are 0.16 mm", "add poses")
    assert judged(_solution(), replace(EXPECTED, point_mm=0.1), tolerance_mm=0.21).grade is Grade.GOOD
    assert judged(_solution(), tolerance_mm=0.019).grade is Grade.USABLE
    assert judged(_solution(), tolerance_mm=0.009).grade is Grade.DO_NOT_USE
    lengths = judged(_solution(), replace(EXPECTED, length_share=4e-4))
    assert "a length of 162 mm 0.065 mm wrong" in lengths.figures[0].message
    unknown = judged(_solution(), None)
    assert unknown.grade is Grade.USABLE
    assert _says(unknown, "the error of a scan is unknown")


def test_a_board_that_limits_the_error_is_named_with_what_to_do() -> None:
    found = judged(_solution(), replace(EXPECTED, board_mm=0.009))
    assert _remarks(found, "limited by the board, whose size contributes 0.009 mm", "measure both rulers")
    assert "mostly from the board's size" in found.summary
    poor = judged(_solution(), replace(EXPECTED, board_mm=0.009), tolerance_mm=0.015)
    assert poor.grade is Grade.USABLE
    assert _says(poor, "limited by the board", "--square-sigma")
    assert judged(_solution(), replace(EXPECTED, board_mm=0.005)).remarks == ()


def test_a_wrong_scale_keeps_a_calibration_from_being_good_and_from_the_clock() -> None:
    agrees = ScaleCheck(True, 1e-4, 1e-4, ())
    assert judged(_solution(), scale=agrees).unattended == ()
    words = "everything is 0.90% larger than in the earlier calibration"
    found = judged(_solution(), scale=ScaleCheck(True, 0.009, 1e-4, (words,)))
    assert (found.grade, found.reasons, found.unattended) == (Grade.USABLE, (words,), (words,))


def test_leaning_residuals_are_named_with_their_place() -> None:
    residuals = _residuals()
    mean, count = residuals.map_mean_px.copy(), residuals.map_count.copy()
    mean[5, 0] = (0.15, 0.0)
    found = judged(_left(map_mean_px=mean))
    assert _remarks(found, "in the lower left corner the mean residual is 0.15 px", "add poses there")
    # Next to nothing was seen there: a mean of ten residuals tells nothing.
    count[5, 0] = 10
    assert judged(_left(map_mean_px=mean, map_count=count)).remarks == ()
    # Far above the noise, and as good as any.
    assert judged(_left(0.09, stated_rms_px=0.005)).remarks == ()


def test_a_border_that_no_corner_reached_leaves_the_distortion_open_there() -> None:
    shooting = Shooting(CHESSBOARD, two_cameras_and_projector())
    poses = [
        shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, tilt=(tilt, 0.0), middle_mm=(0.0, 0.0, 700.0)))
        for index, tilt in enumerate((0.0, 20.0, -20.0))
    ]
    found = judged(_solution(), EXPECTED, coverage(poses, CHESSBOARD, shooting.sizes))
    words = "camera 'left': 100% of the cells along the image's border", "distortion is not determined there"
    assert _remarks(found, *words)


def test_a_bow_within_chance_is_reported_and_lowers_no_grade() -> None:
    found = judged(replace(_solution(), bow=Bow(0.5, 0.4, solved=False)))
    assert found.remarks == ()
    (bend,) = (each for each in found.figures if each.figure == "bend_mm")
    assert "flat as far as the poses determine: 0.50 ± 0.40 mm" in bend.message
    # Where a person said that the board is flat, nobody looked.
    assert not [each for each in judged(_solution()).figures if each.figure == "bend_mm"]


def test_every_limit_has_a_source_and_grades_in_order() -> None:
    for limit in LIMITS.values():
        assert limit.source
        assert limit.good < limit.usable
        assert limit.grade(limit.good) is Grade.GOOD
        assert limit.grade(float("nan")) is Grade.USABLE


# ---- What is said of a board's size: its scale against an earlier calibration, its stretch, and who may put it in use


_SIGMA = np.tile([0.8, 0.8, 0.9, 0.9, 1e-3, 5e-3, 1e-4, 1e-4, 0.0, 4e-6, 4e-6, 4e-6, 0.01, 0.01, 0.01], 3)


def _bare(covariance: FloatArray | None = None) -> Solution:
    devices = two_cameras_and_projector()
    calibration = Calibration({name: devices[name] for name in ("left", "right")}, devices[PROJECTOR])
    return Solution(calibration, np.diag(_SIGMA**2) if covariance is None else covariance, {}, {}, {}, {})


def _enlarged(calibration: Calibration, factor: float) -> Calibration:
    cameras = {
        name: replace(each, translation_mm=factor * each.translation_mm) for name, each in calibration.cameras.items()
    }
    assert calibration.projector is not None
    projector = replace(calibration.projector, translation_mm=factor * calibration.projector.translation_mm)
    return Calibration(cameras, projector)


@pytest.mark.parametrize("factor", [1 / 0.96, 1.01, 0.991, 1.002])
def test_a_wrong_square_size_is_named_with_the_size_that_the_squares_have(factor: float) -> None:
    solution = _bare()
    found = check_scale(
        replace(solution, calibration=_enlarged(solution.calibration, factor)), solution.calibration, CHESSBOARD
    )
    assert found.change == pytest.approx(factor - 1, rel=1e-6)
    (words,) = found.messages
    assert f"everything is {abs(factor - 1):.2%} {'larger' if factor > 1 else 'smaller'}" in words
    assert f"squares measure {12 / factor:.5g} mm instead of 12 mm" in words
    assert "measure both rulers" in words
    (judged,) = grade_board_size(solution, found)
    assert (judged.grade, judged.figure) == (Grade.USABLE, "scale")


def test_a_tenth_of_a_per_cent_is_what_a_rig_may_do_by_itself() -> None:
    solution = _bare()
    slightly = replace(solution, calibration=_enlarged(solution.calibration, 1.0009))
    found = check_scale(slightly, solution.calibration, CHESSBOARD)
    assert (found.checked, found.messages) == (True, ())
    assert found.change == pytest.approx(9e-4, rel=1e-6)
    assert 0 < found.sigma < 3e-4


def test_a_scale_that_the_solve_itself_does_not_know_is_not_blamed_on_the_board() -> None:
    solution = _bare()
    wrong = replace(solution, calibration=_enlarged(solution.calibration, 1.01))
    assert check_scale(wrong, solution.calibration, CHESSBOARD).messages
    unsure = replace(wrong, covariance=wrong.covariance * 60.0**2)
    assert check_scale(unsure, solution.calibration, CHESSBOARD).messages == ()


def test_how_sure_a_board_s_size_is_hides_no_change_of_it() -> None:
    # The deviation by the board's own size is in the covariance, and is as large as the change that is looked for.
    solution = _bare()
    wrong = replace(solution, calibration=_enlarged(solution.calibration, 1.01), size=BoardSize(0.01))
    mode = 0.01 * scale_mode(wrong.calibration)
    unsure = replace(wrong, covariance=wrong.covariance + np.outer(mode, mode))
    found = check_scale(unsure, solution.calibration, CHESSBOARD)
    assert found.messages
    assert found.sigma == pytest.approx(check_scale(wrong, solution.calibration, CHESSBOARD).sigma, abs=2e-4)


def test_the_deviation_of_a_distance_is_that_of_drawn_devices() -> None:
    random = np.random.default_rng(2)
    root = random.normal(size=(45, 45)) * 1e-3
    solution = _bare(root @ root.T)
    found = check_scale(solution, solution.calibration, CHESSBOARD)
    drawn = []
    devices = [*solution.calibration.cameras.values(), solution.calibration.projector]
    for _ in range(4000):
        step = (root @ random.normal(size=45)).reshape(3, 15)
        centres = []
        for device, change in zip(devices, step, strict=True):
            assert device is not None
            x, y, z = change[9:12]
            turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            centres.append(-(turn @ device.rotation).T @ (device.translation_mm + change[12:]))
        drawn.append([np.linalg.norm(centres[a] - centres[b]) for a, b in ((0, 1), (0, 2), (1, 2))])
    shares = np.std(drawn, axis=0) / np.mean(drawn, axis=0)
    assert found.sigma == pytest.approx(shares.max(), rel=0.06)


def test_a_rebuilt_rig_is_not_taken_for_a_wrong_square_size() -> None:
    solution = _bare()
    projector = solution.calibration.projector
    assert projector is not None
    moved = replace(projector, translation_mm=projector.translation_mm * 1.1)
    rebuilt = Calibration(solution.calibration.cameras, moved)
    (words,) = check_scale(replace(solution, calibration=rebuilt), solution.calibration, CHESSBOARD).messages
    assert "the rig was rebuilt, or a device was bumped" in words
    assert "camera 'left' to the projector" in words


def test_without_a_common_distance_the_scale_is_not_checked() -> None:
    solution = _bare()
    assert solution.calibration.projector is not None
    other = Calibration({"middle": solution.calibration.projector}, None)
    found = check_scale(solution, other, CHESSBOARD)
    assert not found.checked
    assert "the scale is not checked: expected two devices in common with the earlier calibration, found no" in str(
        found.messages
    )


@pytest.mark.parametrize(("stretch", "words"), [(0.002, "0.20% ± 0.01% wider than it is high"), (-0.002, "higher")])
def test_a_stretched_print_is_named(stretch: float, words: str) -> None:
    solution = replace(_bare(), size=BoardSize(0.001, stretch, 1e-4))
    (judged,) = grade_board_size(solution, None)
    assert judged.grade is Grade.USABLE
    assert words in judged.message
    assert "measure both rulers" in judged.message
    small = replace(solution, size=BoardSize(0.001, stretch / 2.1, 1e-4))
    unsure = replace(solution, size=BoardSize(0.001, stretch, 5e-4))
    assert not [*grade_board_size(small, None), *grade_board_size(unsure, None)]


def test_a_schedule_puts_a_calibration_in_use_only_if_its_scale_is_vouched_for() -> None:
    solution, agrees = _bare(), ScaleCheck(True, 1e-4, 1e-4, ())
    assert unattended_faults(solution, CHESSBOARD, agrees) == ()
    (words,) = unattended_faults(solution, CHESSBOARD, None)
    assert "the scale is not verified" in words
    certified = replace(CHESSBOARD, square_sigma=1e-4)
    assert unattended_faults(solution, certified, None) == ()
    assert unattended_faults(solution, CHESSBOARD.as_measured(*CHESSBOARD.rulers_mm), None) == ()
    wrong = ScaleCheck(True, 0.009, 1e-4, ("everything is 0.90% larger",))
    assert unattended_faults(solution, certified, wrong) == ("everything is 0.90% larger",)
    stretched = replace(solution, size=BoardSize(0.001, 0.002, 1e-4))
    assert "wider" in str(unattended_faults(stretched, certified, agrees))
