"""What a person is told after a pose: each bad one is refused or warned of, with its cause and the cure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.board import Board
from slrig.calibration.observations import BoardView, PoseObservation, ViewFigures
from slrig.calibration.poses import checks
from slrig.calibration.poses.checks import PoseAnswer, check_same_devices, judge_pose
from slrig.calibration.solution import PROJECTOR, BoardPose
from slrig.errors import CalibrationError
from slrig.model import Size
from tests.unit.calibration.posed_boards import (
    CHARUCO,
    CHESSBOARD,
    SHARP,
    Shooting,
    first_poses,
    held,
    two_cameras_and_projector,
)

GOOD = held(CHESSBOARD, tilt=(-30.0, 10.0), middle_mm=(-60.0, -40.0, 570.0))
IN_PART = held(CHARUCO, tilt=(0.0, 25.0), middle_mm=(-60.0, 20.0, 580.0))
NAN = float("nan")


def shooting(*devices: str, board: Board = CHESSBOARD) -> Shooting:
    """A rig of these devices of two cameras and a projector."""
    every = two_cameras_and_projector()
    return Shooting(board, {name: every[name] for name in devices})


def shots(shooter: Shooting, poses: list[BoardPose]) -> list[PoseObservation]:
    return [shooter.shot(f"pose_{index:02d}", pose) for index, pose in enumerate(poses)]


@pytest.fixture
def without_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is said of the next pose, which takes longer than all checks."""
    monkeypatch.setattr(checks, "next_move", lambda *_, **__: None)


def judged(
    pose: PoseObservation, shooter: Shooting, earlier: list[PoseObservation], figures: ViewFigures = SHARP
) -> PoseAnswer:
    """The answer to a pose; figures : of the left camera."""
    return judge_pose(pose, {"left": figures, "right": SHARP}, earlier, shooter.board, shooter.sizes)


def test_a_good_pose_is_accepted_and_measured() -> None:
    shooter = shooting("left", "right", PROJECTOR)
    answer = judged(shooter.shot("pose_03", GOOD), shooter, shots(shooter, first_poses(CHESSBOARD)))
    assert answer.accepted
    assert answer.refusals == answer.warnings == ()
    assert answer.corners_found == {"left": 88, "right": 88}
    assert answer.corners_expected == 88
    sight = np.array([-60.0, -40.0, 570.0]) / np.linalg.norm([-60.0, -40.0, 570.0])
    steep_deg = np.degrees(np.arccos(abs(GOOD.rotation[:, 2] @ sight)))
    assert answer.tilt_deg["left"] == pytest.approx(steep_deg, abs=1.0)
    assert answer.distance_mm["left"] == pytest.approx(570.0, rel=0.01)
    assert answer.coverage.poses == ("pose_00", "pose_01", "pose_02", "pose_03")
    assert "move the board" in answer.advice.words


@pytest.mark.usefixtures("without_advice")
def test_a_first_pose_has_a_tilt_and_no_distance_while_the_focal_length_is_unknown() -> None:
    shooter = shooting("left", "right", PROJECTOR)
    facing = judged(shooter.shot("pose_00", held(CHESSBOARD)), shooter, [])
    assert facing.accepted
    assert np.isnan(facing.distance_mm["left"])
    assert facing.tilt_deg["left"] < 12
    steep = judged(shooter.shot("pose_00", held(CHESSBOARD, tilt=(68.0, 0.0))), shooter, [])
    assert any("too steeply" in words for words in steep.refusals)


@pytest.mark.usefixtures("without_advice")
@pytest.mark.parametrize(
    ("figures", "refusals", "warnings"),
    [
        (replace(SHARP, moved_px=1.3), ["saw the board move by 1.3 px", "let go of it"], []),
        (replace(SHARP, moved_px=float("inf")), ["in the first frame and not in a later one", "shoot again"], []),
        (replace(SHARP, sharpness_px=4.0), ["too blurred, 4.0 px", "focus"], []),
        (replace(SHARP, saturated=0.2), ["20.0% of the board's pixels saturated", "shorter time"], []),
        (replace(SHARP, contrast=0.04), ["too little light on the board, 4%", "longer time"], []),
        (replace(SHARP, decoded=0.1), ["decoded light on only 10%", "dim the room's light"], []),
        (replace(SHARP, moved_px=0.05), [], ["move by 0.05 px"]),
        (replace(SHARP, sharpness_px=2.0), [], ["blurred"]),
        (replace(SHARP, saturated=0.01), [], ["saturated"]),
        (replace(SHARP, contrast=0.15), [], ["too little light"]),
        (replace(SHARP, decoded=0.3), [], ["decoded light"]),
        (ViewFigures(NAN, NAN, NAN, NAN, NAN), [], []),
    ],
)
def test_how_a_pose_was_shot_refuses_or_warns_with_cause_and_cure(
    figures: ViewFigures, refusals: list[str], warnings: list[str]
) -> None:
    shooter = shooting("left")
    answer = judged(shooter.shot("pose_03", GOOD), shooter, shots(shooter, first_poses(CHESSBOARD)), figures)
    assert answer.accepted is not bool(refusals)
    for found, expected in ((answer.refusals, refusals), (answer.warnings, warnings)):
        assert len(found) == bool(expected)
        assert all(words in found[0] for words in expected)
        assert all(each.startswith("camera 'left'") for each in found)
    # What was refused is not counted as covered.
    assert len(answer.coverage.poses) == 3 + answer.accepted


@pytest.mark.usefixtures("without_advice")
@pytest.mark.parametrize(
    ("pose", "corners", "accepted", "words"),
    [
        (first_poses(CHESSBOARD)[1], 88, False, ["the same as pose_01"]),
        (held(CHESSBOARD, tilt=(20.0, 0.0), middle_mm=(15.0, 5.0, 590.0)), 88, True, ["nearly the same as pose_01"]),
        (held(CHESSBOARD, tilt=(66.0, 0.0)), 88, False, ["too steeply, 66°", "tilt it back"]),
        (
            held(CHESSBOARD, tilt=(20.0, 20.0), middle_mm=(0.0, 0.0, 1600.0)),
            88,
            False,
            ["small", "bring it nearer"],
        ),
        (IN_PART, 9, False, ["sees 9 of the board's 88 corners, too few: show more"]),
        (IN_PART, 33, True, ["33 of the board's 88"]),
    ],
    ids=["same", "near", "steep", "small", "few corners", "a part"],
)
def test_how_a_board_is_held_refuses_or_warns(pose: BoardPose, corners: int, accepted: bool, words: list[str]) -> None:
    shooter = shooting("left", board=CHESSBOARD if corners == 88 else CHARUCO)
    shot = shooter.shot("pose_03", pose)
    whole = shot.views["left"]
    view = BoardView(whole.corner[:corners], whole.points_px[:corners], whole.sigma_px[:corners])
    answer = judged(replace(shot, views={"left": view}), shooter, shots(shooter, first_poses(CHESSBOARD)))
    assert answer.accepted is accepted
    told = answer.warnings if accepted else answer.refusals
    assert any(all(part in each for part in words) for each in told), told


@pytest.mark.usefixtures("without_advice")
def test_a_board_that_not_every_device_sees_is_warned_of_or_refused() -> None:
    shooter = shooting("left", "right", PROJECTOR)
    pose, earlier = shooter.shot("pose_03", GOOD), shots(shooter, first_poses(CHESSBOARD))
    missed = judged(replace(pose, views={"left": pose.views["left"]}), shooter, earlier)
    assert missed.accepted
    assert any("camera 'right' does not see the board" in words for words in missed.warnings)
    nowhere = judged(replace(pose, views={}), shooter, earlier)
    assert not nowhere.accepted
    assert any("no camera sees the board" in words for words in nowhere.refusals)
    dark = replace(pose, correspondences={})
    assert any("no light of the projector" in words for words in judged(dark, shooter, earlier).refusals)
    # Where no projector is calibrated, none is needed.
    assert judged(dark, shooting("left", "right"), earlier).accepted


@pytest.mark.usefixtures("without_advice")
def test_a_board_parallel_to_all_earlier_ones_is_warned_of_and_a_tilted_one_is_not() -> None:
    shooter = shooting("left")
    places = [(0.0, 0.0, 600.0), (50.0, 30.0, 560.0), (-50.0, -30.0, 640.0)]
    poses = shots(shooter, [held(CHESSBOARD, middle_mm=each) for each in places])
    answer = judged(poses[2], shooter, poses[:2])
    assert answer.accepted
    assert any("parallel to all 2 earlier poses" in words and "tilt" in words for words in answer.warnings)
    tilted = shooter.shot("pose_03", held(CHESSBOARD, tilt=(25.0, 0.0)))
    assert not any("parallel" in words for words in judged(tilted, shooter, poses).warnings)


def test_a_capture_from_another_rig_is_named_with_all_its_differences() -> None:
    rig = {"left": Size(1280, 1024), "right": Size(1280, 1024), PROJECTOR: Size(1024, 768)}
    check_same_devices("pose_04", dict(rig), rig)
    other = {"left": Size(1920, 1080), "middle": Size(1280, 1024), PROJECTOR: Size(1280, 800)}
    with pytest.raises(CalibrationError, match="pose_04 was captured with another rig") as caught:
        check_same_devices("pose_04", other, rig)
    words = str(caught.value)
    assert "camera 'left' has 1920 x 1080 pixels, expected 1280 x 1024" in words
    assert "the projector has 1280 x 800 pixels" in words
    assert "camera 'right' is missing" in words
    assert "camera 'middle' is not one of the rig's" in words
