"""One camera calibrated alone: solved from made-up poses, shown on screen and page, and of no use to scans."""

from __future__ import annotations

import io
import json
from functools import cache

import numpy as np
import pytest
from rich.console import Console

from slrig.bundle.calibration_file import check_rays
from slrig.calibrate.pose_judging import judgement, summary
from slrig.calibrate.report import report_html
from slrig.calibrate.solving import CalibrationResult, ReadPose, solve_poses
from slrig.calibrate.tools import Setting
from slrig.calibration.board import BoardShape
from slrig.calibration.health.verifying import verify_by_board
from slrig.calibration.judging.comparison import comparison
from slrig.calibration.observations import ViewFigures
from slrig.cli.calibration_screen import tell_result
from slrig.errors import CalibrationError
from slrig.model import Calibration, Size
from tests.unit.calibrate.test_report import Page
from tests.unit.calibration.synthetic import CHESSBOARD, Recipe, made

SIZE = Size(1280, 1024)
FIGURES = ViewFigures(moved_px=0.01, saturated=0.0, contrast=0.6, sharpness_px=1.1, decoded=float("nan"))


@cache
def poses() -> tuple[tuple[ReadPose, ...], Calibration]:
    """Poses of a board that one camera saw in white light, and that camera."""
    observations, truth = made(Recipe(poses=8, projector=False, seed=4))
    return tuple(ReadPose(pose, {"left": FIGURES}) for pose in observations.poses), truth


@cache
def result() -> CalibrationResult:
    return solve_poses(CHESSBOARD, {"left": SIZE}, None, poses()[0], board_shape=BoardShape.FLAT)


def test_the_camera_is_known_with_its_deviations() -> None:
    found, true = result().calibration, poses()[1].cameras["left"]
    assert found.projector is None
    assert found.solved is not None
    assert found.solved.covariance.shape == (15, 15)
    assert found.solved.expected_error_mm == result().expected.point_mm > 0
    sigma = np.sqrt(np.diag(found.solved.covariance))
    for row, place in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
        assert abs(found.cameras["left"].matrix[place] - true.matrix[place]) < 3.5 * sigma[row]


def test_the_error_is_said_to_be_across_the_line_of_sight() -> None:
    verdict = result().verdict
    assert "a point of known distance is expected within" in verdict.summary
    assert "mm across the line of sight (1 in" in verdict.summary
    assert verdict.summary.endswith("that takes a projector or a second camera, calibrated with it")
    (error,) = (each for each in verdict.judged if each.figure == "error")
    assert "off across the line of sight by the calibration; twice that" in error.words
    assert "noise of the light" not in error.words


def test_what_is_not_known_is_null_in_json_and_no_number_on_screen_and_page() -> None:
    document = summary(result())
    json.dumps(document, allow_nan=False)
    expected = document["expected"]
    assert expected["across"] is True
    assert [expected[name] for name in ("noise_mm", "total_mm", "length_share")] == [None] * 3
    assert document["baselines"] == []
    assert 0 < document["odd_even"]["ratio"] < 3
    stream = io.StringIO()
    tell_result(document, Console(file=stream, width=200))
    shown = [line.rstrip() for line in stream.getvalue().splitlines()]
    assert any(line.endswith("(1 σ) across the line of sight by the calibration") for line in shown)
    page = Page(report_html(result(), poses()[0], board=CHESSBOARD, title="one camera"))
    assert page.number("point_mm") == pytest.approx(result().expected.point_mm, rel=5e-3)
    assert not {"noise_mm", "total_mm", "length_mm_per_m"} & set(page.figures)
    words = " ".join(" ".join(page.words).split())
    assert "Expected error across the line of sight" in words
    assert "by how much a point of known distance may lie wrong across the line of sight there" in words
    for text in (stream.getvalue(), words):
        assert not {"nan", "inf", "none"} & set(text.lower().split())


def test_each_pose_is_judged_without_a_word_of_light() -> None:
    setting = Setting(CHESSBOARD, {"left": SIZE}, None)
    found = judgement(poses()[0][5], poses()[0][:5], setting)
    assert found.refusals == ()
    assert found.standing is not None
    words = json.dumps([found.answer, found.standing.coverage, found.standing.next_move], allow_nan=False)
    assert "projector" not in words
    first = judgement(poses()[0][0], (), setting)
    assert first.standing is not None
    assert "projector" not in json.dumps(first.standing.next_move)


def test_it_is_no_calibration_for_scans_and_is_compared_by_its_lens() -> None:
    with pytest.raises(CalibrationError) as refusal:
        check_rays(result().calibration, ["left", "right"], "calibration 3f2a")
    assert str(refusal.value) == (
        "calibration 3f2a: expected a calibration with two rays for each point, found that of camera 'left' alone, "
        "without a projector: it tells no depth, and cannot scan; calibrate the camera together with the projector or "
        "with a second camera"
    )
    with pytest.raises(CalibrationError, match="one of camera 'left' alone: calibrate it again"):
        verify_by_board([poses()[0][0].observation], CHESSBOARD, result().calibration)
    found = comparison(result().calibration, result().calibration)
    assert found.words[0].endswith("they have one device in common, and a point takes two.")
    assert found.devices["left"].focal_percent.value == 0
