"""What a person is told after a pose: each bad one is refused or warned of, with its cause and the cure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.observations import BoardView, PoseObservation, ViewFigures
from slrig.calibration.poses.checks import PoseAnswer, check_same_devices, judge_pose
from slrig.calibration.solution import PROJECTOR
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

BOTH = {"left": SHARP, "right": SHARP}


@pytest.fixture
def shooting() -> Shooting:
    return Shooting(CHESSBOARD, two_cameras_and_projector())


@pytest.fixture
def earlier(shooting: Shooting) -> list[PoseObservation]:
    return [shooting.shot(f"pose_{index:02d}", pose) for index, pose in enumerate(first_poses(CHESSBOARD))]


@pytest.fixture
def pose(shooting: Shooting) -> PoseObservation:
    return shooting.shot("pose_03", held(CHESSBOARD, tilt=(-30.0, 10.0), middle_mm=(-60.0, -40.0, 570.0)))


def _answer(
    shooting: Shooting,
    pose: PoseObservation,
    earlier: list[PoseObservation],
    left: ViewFigures = SHARP,
) -> PoseAnswer:
    return judge_pose(pose, {"left": left, "right": SHARP}, earlier, shooting.board, shooting.sizes)


def test_a_good_pose_is_accepted_and_measured(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation]
) -> None:
    answer = _answer(shooting, pose, earlier)
    assert answer.accepted
    assert answer.refusals == answer.warnings == ()
    assert answer.corners_found == {"left": 88, "right": 88}
    assert answer.corners_expected == 88
    board_pose = held(CHESSBOARD, tilt=(-30.0, 10.0), middle_mm=(-60.0, -40.0, 570.0))
    sight = np.array([-60.0, -40.0, 570.0]) / np.linalg.norm([-60.0, -40.0, 570.0])
    steep_deg = np.degrees(np.arccos(abs(board_pose.rotation[:, 2] @ sight)))
    assert answer.tilt_deg["left"] == pytest.approx(steep_deg, abs=1.0)
    assert answer.distance_mm["left"] == pytest.approx(570.0, rel=0.01)
    assert answer.coverage.poses == ("pose_00", "pose_01", "pose_02", "pose_03")
    assert "move the board" in answer.advice.words


def test_the_first_pose_has_no_distance_while_the_focal_length_is_unknown(shooting: Shooting) -> None:
    answer = _answer(shooting, shooting.shot("pose_00", held(CHESSBOARD)), [])
    assert answer.accepted
    assert np.isnan(answer.distance_mm["left"])
    assert answer.tilt_deg["left"] < 12  # told without a focal length


@pytest.mark.parametrize(
    ("figures", "cause", "cure"),
    [
        (replace(SHARP, moved_px=1.3), "saw the board move by 1.3 px", "let go of it"),
        (replace(SHARP, moved_px=float("inf")), "in the first frame and not in a later one", "shoot again"),
        (replace(SHARP, sharpness_px=4.0), "too blurred, 4.0 px", "focus"),
        (replace(SHARP, saturated=0.2), "20.0% of the board's pixels saturated", "shorter time"),
        (replace(SHARP, contrast=0.04), "too little light on the board, 4%", "longer time"),
        (replace(SHARP, decoded=0.1), "decoded light on only 10%", "dim the room's light"),
    ],
)
def test_a_badly_shot_pose_is_refused_with_its_cause_and_cure(
    shooting: Shooting,
    pose: PoseObservation,
    earlier: list[PoseObservation],
    figures: ViewFigures,
    cause: str,
    cure: str,
) -> None:
    answer = _answer(shooting, pose, earlier, figures)
    assert not answer.accepted
    assert len(answer.refusals) == 1
    assert answer.refusals[0].startswith("camera 'left'")
    assert cause in answer.refusals[0]
    assert cure in answer.refusals[0]
    # What was refused is not counted as covered.
    assert answer.coverage.poses == ("pose_00", "pose_01", "pose_02")


@pytest.mark.parametrize(
    ("figures", "cause"),
    [
        (replace(SHARP, moved_px=0.05), "move by 0.05 px"),
        (replace(SHARP, sharpness_px=2.0), "blurred"),
        (replace(SHARP, saturated=0.01), "saturated"),
        (replace(SHARP, contrast=0.15), "too little light"),
        (replace(SHARP, decoded=0.3), "decoded light"),
    ],
)
def test_a_pose_that_could_be_better_is_accepted_with_a_warning(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation], figures: ViewFigures, cause: str
) -> None:
    answer = _answer(shooting, pose, earlier, figures)
    assert answer.accepted
    assert len(answer.warnings) == 1
    assert cause in answer.warnings[0]


def test_what_was_not_measured_refuses_nothing(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation]
) -> None:
    nan = float("nan")
    answer = _answer(shooting, pose, earlier, ViewFigures(nan, nan, nan, nan, nan))
    assert answer.accepted
    assert answer.warnings == ()


def test_the_same_pose_twice_is_refused_and_names_the_other(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    again = shooting.shot("pose_03", first_poses(CHESSBOARD)[1])
    answer = _answer(shooting, again, earlier)
    assert not answer.accepted
    assert any("the same as pose_01" in words for words in answer.refusals)


def test_a_pose_near_an_earlier_one_is_warned_of(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    near = held(CHESSBOARD, tilt=(20.0, 0.0), middle_mm=(15.0, 5.0, 590.0))
    answer = _answer(shooting, shooting.shot("pose_03", near), earlier)
    assert answer.accepted
    assert any("nearly the same as pose_01" in words for words in answer.warnings)


def test_a_board_seen_too_steeply_is_refused(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    steep = shooting.shot("pose_03", held(CHESSBOARD, tilt=(66.0, 0.0), middle_mm=(0.0, 0.0, 600.0)))
    answer = _answer(shooting, steep, earlier)
    assert not answer.accepted
    assert any("too steeply, 66°" in words and "tilt it back" in words for words in answer.refusals)


def test_a_steep_first_pose_is_refused_before_any_focal_length_is_known(shooting: Shooting) -> None:
    steep = shooting.shot("pose_00", held(CHESSBOARD, tilt=(68.0, 0.0), middle_mm=(0.0, 0.0, 600.0)))
    assert any("too steeply" in words for words in _answer(shooting, steep, []).refusals)


def test_a_board_too_small_in_the_picture_is_refused(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    far = shooting.shot("pose_03", held(CHESSBOARD, tilt=(20.0, 20.0), middle_mm=(0.0, 0.0, 1600.0)))
    answer = _answer(shooting, far, earlier)
    assert not answer.accepted
    assert any("small" in words and "bring it nearer" in words for words in answer.refusals)


def test_too_few_corners_are_refused(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    partial = Shooting(CHARUCO, shooting.devices)
    pose = partial.shot("pose_03", held(CHARUCO, tilt=(0.0, 25.0), middle_mm=(-60.0, 20.0, 580.0)))
    view = pose.views["left"]
    few = BoardView(view.corner[:9], view.points_px[:9], view.sigma_px[:9])
    answer = _answer(partial, replace(pose, views={**pose.views, "left": few}), earlier)
    assert not answer.accepted
    assert any("sees 9 of the board's 88 corners, too few: show more" in words for words in answer.refusals)


def test_a_part_of_the_board_is_warned_of(shooting: Shooting, earlier: list[PoseObservation]) -> None:
    partial = Shooting(CHARUCO, shooting.devices)
    pose = partial.shot("pose_03", held(CHARUCO, tilt=(0.0, 25.0), middle_mm=(-60.0, 20.0, 580.0)))
    view = pose.views["left"]
    part = BoardView(view.corner[:33], view.points_px[:33], view.sigma_px[:33])
    answer = _answer(partial, replace(pose, views={**pose.views, "left": part}), earlier)
    assert answer.accepted
    assert any("33 of the board's 88" in words for words in answer.warnings)


def test_a_pose_that_one_camera_misses_is_warned_of(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation]
) -> None:
    answer = _answer(shooting, replace(pose, views={"left": pose.views["left"]}), earlier)
    assert answer.accepted
    assert any("camera 'right' does not see the board" in words for words in answer.warnings)


def test_a_board_in_no_camera_is_refused(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation]
) -> None:
    answer = _answer(shooting, replace(pose, views={}), earlier)
    assert not answer.accepted
    assert any("no camera sees the board" in words for words in answer.refusals)


def test_a_board_without_light_is_refused_where_a_projector_is_calibrated(
    shooting: Shooting, pose: PoseObservation, earlier: list[PoseObservation]
) -> None:
    dark = replace(pose, correspondences={})
    assert any("no light of the projector" in words for words in _answer(shooting, dark, earlier).refusals)
    cameras = {name: size for name, size in shooting.sizes.items() if name != PROJECTOR}
    assert judge_pose(dark, BOTH, earlier, CHESSBOARD, cameras).accepted


def test_a_board_parallel_to_all_earlier_ones_is_warned_of_and_a_tilted_one_is_not(shooting: Shooting) -> None:
    places = [(0.0, 0.0, 600.0), (50.0, 30.0, 560.0), (-50.0, -30.0, 640.0)]
    poses = [shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, middle_mm=each)) for index, each in enumerate(places)]
    answer = _answer(shooting, poses[2], poses[:2])
    assert answer.accepted
    assert any("parallel to all 2 earlier poses" in words and "tilt" in words for words in answer.warnings)
    tilted = shooting.shot("pose_03", held(CHESSBOARD, tilt=(25.0, 0.0)))
    assert not any("parallel" in words for words in _answer(shooting, tilted, poses).warnings)


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
