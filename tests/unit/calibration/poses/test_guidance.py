"""Coverage by poses and advice on the next one, measured against the result of a solve; acceptance of a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind, BoardView, PoseObservation, ViewQuality
from slrig.calibration.poses import checks
from slrig.calibration.poses.checks import PoseAssessment, check_pose, check_same_devices, draw_coverage, draw_pose
from slrig.calibration.poses.guidance import (
    GOALS,
    Advice,
    _cell_sigma_px,
    _lens_sensitivity,
    advise_pose,
    attitude,
    board_rotation,
    count_per_cell,
    coverage,
    symmetry_angle_deg,
)
from slrig.calibration.poses.initial import estimate_rig
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose
from slrig.errors import CalibrationError
from slrig.model import FloatArray, Pinhole, Size
from tests.unit.calibration.posed_boards import (
    CHARUCO,
    CHESSBOARD,
    SHARP,
    Shooting,
    device,
    first_poses,
    held,
    turned,
    two_cameras_and_projector,
)


def rig_of(*devices: str, board: Board = CHESSBOARD) -> Shooting:
    """A rig of these devices, or of two cameras and a projector."""
    every = two_cameras_and_projector()
    return Shooting(board, {name: every[name] for name in devices or every})


def shots(shooter: Shooting, poses: Sequence[BoardPose]) -> list[PoseObservation]:
    return [shooter.shot(f"pose_{index:02d}", pose) for index, pose in enumerate(poses)]


def _first_observations(shooter: Shooting) -> list[PoseObservation]:
    return shots(shooter, first_poses(shooter.board))


def _advised_pose(shooting: Shooting, advice: Advice) -> BoardPose:
    """The pose in the world that follows the advice exactly."""
    assert advice.camera is not None
    assert advice.candidate is not None
    camera, board_pose = shooting.devices[advice.camera], advice.candidate.board_pose
    rotation = camera.rotation.T @ board_pose.rotation
    return BoardPose(rotation, camera.rotation.T @ (board_pose.translation_mm - camera.translation_mm))


def test_points_are_counted_per_cell() -> None:
    points_px = np.array([[-0.4, -0.4], [59.4, 0.0], [59.6, 0.0], [359.4, 239.4], [359.6, 0.0], [-0.6, 5.0]])
    cells = count_per_cell(points_px, Size(360, 240))
    assert cells[0, 0] == 2
    assert cells[0, 1] == 1
    assert cells[5, 5] == 1
    assert cells.sum() == 4


@pytest.mark.parametrize(
    ("tilt", "near"), [((30.0, 0.0), "top"), ((-30.0, 0.0), "bottom"), ((0.0, 30.0), "right"), ((0.0, -30.0), "left")]
)
def test_the_sign_of_a_tilt_is_that_of_the_nearer_edge(tilt: tuple[float, float], near: str) -> None:
    board_pose = held(CHESSBOARD, tilt=tilt)
    found = attitude(board_pose, CHESSBOARD.points_mm.mean(axis=0))
    assert found.tilt_deg == pytest.approx(tilt, abs=1e-6)
    depth = (CHESSBOARD.points_mm @ board_pose.rotation.T + board_pose.translation_mm)[:, 2].reshape(8, 11)
    edges = {
        "top": depth[0].mean(),
        "bottom": depth[-1].mean(),
        "left": depth[:, 0].mean(),
        "right": depth[:, -1].mean(),
    }
    assert min(edges, key=lambda name: float(edges[name])) == near
    assert np.allclose(board_rotation(tilt, 20.0), turned(*tilt, 20.0))


def test_a_turn_is_clockwise_in_the_image() -> None:
    board_pose = held(CHESSBOARD, in_plane_deg=30.0)
    assert attitude(board_pose, np.zeros(3)).turn_deg == pytest.approx(30.0)
    # y runs down: after a clockwise turn, the board's right end lies lower in the picture than its left one.
    ends = CHESSBOARD.points_mm[[0, 10]] @ board_pose.rotation.T
    assert ends[1, 1] > ends[0, 1]


def test_a_half_turn_does_not_count_for_a_symmetric_board() -> None:
    alike = Board(BoardKind.CHESSBOARD, 9, 7, 12.0)
    assert symmetry_angle_deg(alike) == 180
    assert symmetry_angle_deg(CHESSBOARD) == symmetry_angle_deg(Board(BoardKind.CHARUCO, 9, 7, 12.0)) == 360
    for board, turns in ((alike, 1), (Board(BoardKind.CHARUCO, 9, 7, 12.0), 2)):
        shooting = rig_of("left", board=board)
        board_pose = [held(board, tilt=(20.0, 0.0)), held(board, tilt=(0.0, 20.0), in_plane_deg=180.0)]
        poses = shots(shooting, board_pose)
        assert coverage(poses, board, shooting.sizes).devices["left"].turns == turns


def test_devices_are_estimated_from_a_few_poses() -> None:
    shooting = rig_of()
    poses = _first_observations(shooting)
    poses.append(shooting.shot("pose_03", held(CHESSBOARD, tilt=(-30.0, 15.0), middle_mm=(60.0, 40.0, 540.0))))
    rig = estimate_rig(poses, CHESSBOARD, shooting.sizes)
    for name, guessed in rig.devices.items():
        truth = shooting.devices[name]
        assert guessed.matrix[0, 0] == pytest.approx(truth.matrix[0, 0], rel=0.03), name
        assert guessed.poses.keys() == {"pose_00", "pose_01", "pose_02", "pose_03"}
    # A lens shift beyond the image's edge is seen from the first poses on.
    assert rig.devices[PROJECTOR].matrix[1, 2] == pytest.approx(860, abs=40)
    way = rig.relative_pose("left", "right")
    assert way is not None
    assert way.translation_mm == pytest.approx(shooting.devices["right"].translation_mm, abs=3.0)


def test_a_wide_lens_is_estimated() -> None:
    """A fit that starts from the usual lens alone ends at twice its focal length."""
    wide = device(Size(1280, 1024), 500.0, (650.0, 500.0), (0.0,) * 5, BoardPose(np.eye(3), np.zeros(3)))
    shooting = Shooting(CHESSBOARD, {"left": wide})
    tilts = ((0.0, 0.0), (25.0, 0.0), (0.0, -25.0), (-30.0, 15.0))
    poses = shots(shooting, [held(CHESSBOARD, tilt=tilt, middle_mm=(0.0, 0.0, 200.0)) for tilt in tilts])
    found = estimate_rig(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert found.matrix[0, 0] == pytest.approx(500, rel=0.03)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_an_estimate_exists_for_parallel_poses_and_for_none(count: int) -> None:
    shooting = rig_of("left")
    poses = shots(shooting, [held(CHESSBOARD, middle_mm=(20.0 * index, 0.0, 600.0)) for index in range(count)])
    rig = estimate_rig(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert np.isfinite(rig.information).all()
    assert rig.focal_sigma > 0.15
    found = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert np.isnan(found.distance_mm).all()
    assert advise_pose(poses, CHESSBOARD, shooting.sizes).text


def test_coverage_counts_cells_depths_tilts_and_turns() -> None:
    shooting = rig_of()
    board_pose = [
        held(CHESSBOARD),
        held(CHESSBOARD, tilt=(30.0, 0.0), middle_mm=(0.0, 0.0, 540.0)),
        held(CHESSBOARD, tilt=(-25.0, 30.0), in_plane_deg=90.0, middle_mm=(60.0, 0.0, 660.0)),
        held(CHESSBOARD, tilt=(0.0, -20.0), in_plane_deg=35.0, middle_mm=(0.0, 20.0, 605.0)),
        held(CHESSBOARD, tilt=(50.0, 5.0)),
    ]
    poses = shots(shooting, board_pose)
    left = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert left.depths == 3
    assert left.tilted == (2, 2)
    assert left.turns == 3
    assert left.distance_mm == pytest.approx((540.0, 660.0), rel=0.01)
    wanted = sum((count_per_cell(pose.views["left"].points_px, Size(1280, 1024)) > 0).astype(int) for pose in poses)
    assert np.array_equal(left.cells, wanted)
    assert left.share == pytest.approx((left.cells > 0).mean())


def test_coverage_of_a_projector_counts_only_what_a_camera_sees() -> None:
    devices = two_cameras_and_projector()
    whole = devices[PROJECTOR]
    # Twice as wide a picture from the same place: the cameras see only the middle of it.
    matrix = whole.matrix + np.array([[0, 0, 512], [0, 0, 384], [0, 0, 0]])
    wide = Pinhole(Size(2048, 1536), matrix, whole.distortion, whole.rotation, whole.translation_mm)
    shooting = Shooting(CHESSBOARD, {"left": devices["left"], PROJECTOR: wide})
    found = coverage(_first_observations(shooting), CHESSBOARD, shooting.sizes).devices[PROJECTOR]
    assert 6 <= found.reachable.sum() <= 24
    assert found.share == pytest.approx((found.cells > 0).sum() / found.reachable.sum())


def test_open_goals_are_named() -> None:
    shooting = rig_of()
    found = coverage(_first_observations(shooting), CHESSBOARD, shooting.sizes)
    text = "\n".join(found.missing)
    assert "3 of at least 12 poses" in text
    assert "camera 'left': 1 of 3 distances" in text
    assert "camera 'left': 1 of 3 angles in the board's plane" in text
    assert "80% wanted" in text


def test_advice_before_the_first_pose() -> None:
    shooting = rig_of()
    advice = advise_pose([], CHESSBOARD, shooting.sizes)
    assert "middle of the image of camera 'left'" in advice.text
    assert "projector" in advice.text
    assert not advice.enough


def test_advice_names_place_tilt_and_reason_with_an_outline() -> None:
    shooting = rig_of()
    poses = _first_observations(shooting)
    advice = advise_pose(poses, CHESSBOARD, shooting.sizes)
    assert "move the board to the" in advice.text
    assert "edge 30° towards the camera" in advice.text
    assert "not covered yet" in advice.text
    assert advice.camera is not None
    then = shooting.shot("pose_03", _advised_pose(shooting, advice))
    outer = then.views[advice.camera].points_px[[0, 10, 87, 77]]
    assert np.abs(outer - advice.outline_px).max() < 40  # the guess from three poses is rough
    assert (advice.outline_px > 0).all()
    assert (advice.outline_px < [1280, 1024]).all()


def _errors_px(shooting: Shooting, board_pose: list[BoardPose], seeds: range) -> FloatArray:
    """(seeds,) the worst cell's error of OpenCV's own calibration, px, after the best rigid motion of the camera.

    Straight from solves with other noise each time: nothing of the advice's covariances is in it.
    """
    truth = shooting.devices["left"]
    across, down = np.meshgrid((np.arange(CELLS) + 0.5) * 1280 / CELLS, (np.arange(CELLS) + 0.5) * 1024 / CELLS)
    pixels = np.column_stack([across.ravel(), down.ravel()])
    rays = cv2.undistortPoints(pixels[:, None], truth.matrix, truth.distortion)[:, 0]
    space = np.concatenate([np.column_stack([rays, np.ones(36)]) * depth for depth in (520.0, 600.0, 680.0)])
    board_mm = shooting.board.points_mm.astype(np.float32)
    worst = []
    for seed in seeds:
        again = Shooting(shooting.board, {"left": truth}, seed=seed)
        views = [again.shot("pose", pose).views["left"] for pose in board_pose]
        flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
        points = [view.points_px.astype(np.float32) for view in views]
        boards = [board_mm[view.corner] for view in views]
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            boards, points, (1280, 1024), truth.matrix.copy(), truth.distortion.copy(), flags=flags
        )
        still = np.zeros(3), np.zeros(3)
        _, turn, shift = cv2.solvePnP(
            space, np.tile(pixels, (3, 1)), matrix, distortion, *still, useExtrinsicGuess=True
        )
        found, _ = cv2.projectPoints(space, turn, shift, matrix, distortion)
        error = np.linalg.norm(found[:, 0] - np.tile(pixels, (3, 1)), axis=1).reshape(3, 36)
        worst.append(np.sqrt((error**2).mean(axis=0)).max())
    return np.array(worst)


def test_the_advised_pose_lowers_the_real_error_of_the_worst_cell_more_than_one_like_the_last() -> None:
    shooting = rig_of("left")
    board_pose = [
        *first_poses(CHESSBOARD),
        held(CHESSBOARD, tilt=(-20.0, 10.0), middle_mm=(0.0, -20.0, 600.0)),
        held(CHESSBOARD, tilt=(15.0, 15.0), middle_mm=(15.0, 10.0, 605.0)),
    ]
    poses = shots(shooting, board_pose)
    advice = advise_pose(poses, CHESSBOARD, shooting.sizes)
    seeds = range(100, 106)
    without = np.sqrt((_errors_px(shooting, board_pose, seeds) ** 2).mean())
    lazy = held(CHESSBOARD, tilt=(15.0, -10.0), middle_mm=(-10.0, 15.0, 600.0))
    with_another = np.sqrt((_errors_px(shooting, [*board_pose, lazy], seeds) ** 2).mean())
    with_advice = np.sqrt((_errors_px(shooting, [*board_pose, _advised_pose(shooting, advice)], seeds) ** 2).mean())
    assert with_advice < 0.6 * without
    assert with_advice < 0.7 * with_another
    # What it promised: the worst cell's own figure, both coordinates of it, within a factor of two of the truth.
    assert 0.5 < with_advice / (np.sqrt(2) * advice.expected_px["left"]) < 2
    assert advice.expected_px["left"] < advice.worst_px["left"]


def test_the_stated_uncertainty_is_that_of_repeated_solves() -> None:
    shooting = rig_of("left")
    random = np.random.default_rng(5)
    board_pose = [
        held(
            CHESSBOARD,
            tilt=(random.uniform(-35, 35), random.uniform(-35, 35)),
            middle_mm=(random.uniform(-60, 60), random.uniform(-50, 50), random.uniform(540, 660)),
        )
        for _ in range(8)
    ]
    poses = shots(shooting, board_pose)
    poses = [pose for pose in poses if pose.views]
    rig = estimate_rig(poses, CHESSBOARD, shooting.sizes).devices["left"]
    stated = np.sqrt(2) * _cell_sigma_px(rig.information[None], _lens_sensitivity(rig)).max()
    found = np.sqrt(
        (
            _errors_px(shooting, [each for each in board_pose if shooting.shot("x", each).views], range(200, 210)) ** 2
        ).mean()
    )
    assert 0.6 < found / stated < 1.6


ALL = tuple(two_cameras_and_projector())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("board", "only"),
    [
        pytest.param(board, only, id=f"{board.kind}, {', '.join(only)}")
        for board in (CHESSBOARD, CHARUCO)
        for only in (ALL, ("left",), ("left", PROJECTOR))
    ],
)
def test_following_the_advice_from_three_poses_leads_to_a_complete_set(board: Board, only: tuple[str, ...]) -> None:
    shooting = rig_of(*only, board=board)
    figures = {name: SHARP for name in only if name != PROJECTOR}
    random = np.random.default_rng(7)
    poses = _first_observations(shooting)
    advice = advise_pose(poses, board, shooting.sizes)
    worst = [max(advice.worst_px.values())]
    while not advice.enough:
        assert len(poses) < 25
        assert sum(advice.expected_px.values()) < sum(advice.worst_px.values())
        exact = _advised_pose(shooting, advice)
        # A hand is off by some millimetres and degrees; a little farther away, the board is still seen whole.
        loose = turned(*random.uniform(-3, 3, 3)) @ exact.rotation
        middle = exact.rotation @ board.points_mm.mean(axis=0) + exact.translation_mm
        held_pose = BoardPose(loose, middle * 1.03 - loose @ board.points_mm.mean(axis=0))
        pose = shooting.shot(f"pose_{len(poses):02d}", held_pose)
        answer = check_pose(pose, figures, poses, board, shooting.sizes)
        assert answer.accepted, answer.refusals  # what is advised is never refused
        poses.append(pose)
        advice = answer.advice
        worst.append(max(advice.worst_px.values()))
    assert GOALS.min_poses <= len(poses) <= 25
    found = coverage(poses, board, shooting.sizes)
    assert found.missing == ()
    assert advice.text.startswith("enough")
    for each in found.devices.values():
        assert each.share >= 0.8
    assert worst[-1] <= GOALS.max_sigma_px < worst[0]


# ---- Checks of a pose: a bad one is refused or warned of, with cause and remedy


GOOD = held(CHESSBOARD, tilt=(-30.0, 10.0), middle_mm=(-60.0, -40.0, 570.0))
IN_PART = held(CHARUCO, tilt=(0.0, 25.0), middle_mm=(-60.0, 20.0, 580.0))
NAN = float("nan")


@pytest.fixture
def without_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    """No advice, which takes longer than all checks."""
    monkeypatch.setattr(checks, "advise_pose", lambda *_, **__: None)


def check(
    pose: PoseObservation, shooter: Shooting, earlier: list[PoseObservation], figures: ViewQuality = SHARP
) -> PoseAssessment:
    """Check a pose; figures : of the left camera."""
    return check_pose(pose, {"left": figures, "right": SHARP}, earlier, shooter.board, shooter.sizes)


def test_a_good_pose_is_accepted_and_measured() -> None:
    shooter = rig_of("left", "right", PROJECTOR)
    answer = check(shooter.shot("pose_03", GOOD), shooter, _first_observations(shooter))
    assert answer.accepted
    assert answer.refusals == answer.warnings == ()
    assert answer.corners_found == {"left": 88, "right": 88}
    assert answer.corners_expected == 88
    sight = np.array([-60.0, -40.0, 570.0]) / np.linalg.norm([-60.0, -40.0, 570.0])
    steep_deg = np.degrees(np.arccos(abs(GOOD.rotation[:, 2] @ sight)))
    assert answer.tilt_deg["left"] == pytest.approx(steep_deg, abs=1.0)
    assert answer.distance_mm["left"] == pytest.approx(570.0, rel=0.01)
    assert answer.coverage.poses == ("pose_00", "pose_01", "pose_02", "pose_03")
    assert "move the board" in answer.advice.text


@pytest.mark.usefixtures("without_advice")
def test_a_first_pose_has_a_tilt_and_no_distance_while_the_focal_length_is_unknown() -> None:
    shooter = rig_of("left", "right", PROJECTOR)
    facing = check(shooter.shot("pose_00", held(CHESSBOARD)), shooter, [])
    assert facing.accepted
    assert np.isnan(facing.distance_mm["left"])
    assert facing.tilt_deg["left"] < 12
    steep = check(shooter.shot("pose_00", held(CHESSBOARD, tilt=(68.0, 0.0))), shooter, [])
    assert any("too steeply" in text for text in steep.refusals)


@pytest.mark.usefixtures("without_advice")
@pytest.mark.parametrize(
    ("figures", "refusals", "warnings"),
    [
        (replace(SHARP, moved_px=1.3), ["saw the board move by 1.3 px", "release it"], []),
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
        (ViewQuality(NAN, NAN, NAN, NAN, NAN), [], []),
    ],
)
def test_image_quality_refuses_or_warns_with_cause_and_remedy(
    figures: ViewQuality, refusals: list[str], warnings: list[str]
) -> None:
    shooter = rig_of("left")
    answer = check(shooter.shot("pose_03", GOOD), shooter, _first_observations(shooter), figures)
    assert answer.accepted is not bool(refusals)
    for found, expected in ((answer.refusals, refusals), (answer.warnings, warnings)):
        assert len(found) == bool(expected)
        assert all(text in found[0] for text in expected)
        assert all(each.startswith("camera 'left'") for each in found)
    # What was refused is not counted as covered.
    assert len(answer.coverage.poses) == 3 + answer.accepted


@pytest.mark.usefixtures("without_advice")
@pytest.mark.parametrize(
    ("pose", "corners", "accepted", "parts"),
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
def test_the_board_s_attitude_refuses_or_warns(pose: BoardPose, corners: int, accepted: bool, parts: list[str]) -> None:
    shooter = rig_of("left", board=CHESSBOARD if corners == 88 else CHARUCO)
    shot = shooter.shot("pose_03", pose)
    whole = shot.views["left"]
    view = BoardView(whole.corner[:corners], whole.points_px[:corners], whole.sigma_px[:corners])
    answer = check(replace(shot, views={"left": view}), shooter, _first_observations(shooter))
    assert answer.accepted is accepted
    messages = answer.warnings if accepted else answer.refusals
    assert any(all(part in each for part in parts) for each in messages), messages


@pytest.mark.usefixtures("without_advice")
def test_a_board_that_not_every_device_sees_is_warned_of_or_refused() -> None:
    shooter = rig_of("left", "right", PROJECTOR)
    pose, earlier = shooter.shot("pose_03", GOOD), _first_observations(shooter)
    missed = check(replace(pose, views={"left": pose.views["left"]}), shooter, earlier)
    assert missed.accepted
    assert any("camera 'right' does not see the board" in text for text in missed.warnings)
    nowhere = check(replace(pose, views={}), shooter, earlier)
    assert not nowhere.accepted
    assert any("no camera sees the board" in text for text in nowhere.refusals)
    dark = replace(pose, correspondences={})
    assert any("no light of the projector" in text for text in check(dark, shooter, earlier).refusals)
    # Where no projector is calibrated, none is needed.
    assert check(dark, rig_of("left", "right"), earlier).accepted


@pytest.mark.usefixtures("without_advice")
def test_a_board_parallel_to_all_earlier_ones_is_warned_of_and_a_tilted_one_is_not() -> None:
    shooter = rig_of("left")
    places = [(0.0, 0.0, 600.0), (50.0, 30.0, 560.0), (-50.0, -30.0, 640.0)]
    poses = shots(shooter, [held(CHESSBOARD, middle_mm=each) for each in places])
    answer = check(poses[2], shooter, poses[:2])
    assert answer.accepted
    assert any("parallel to all 2 earlier poses" in text and "tilt" in text for text in answer.warnings)
    tilted = shooter.shot("pose_03", held(CHESSBOARD, tilt=(25.0, 0.0)))
    assert not any("parallel" in text for text in check(tilted, shooter, poses).warnings)


def test_a_capture_from_another_rig_is_named_with_all_its_differences() -> None:
    rig = {"left": Size(1280, 1024), "right": Size(1280, 1024), PROJECTOR: Size(1024, 768)}
    check_same_devices("pose_04", dict(rig), rig)
    other = {"left": Size(1920, 1080), "middle": Size(1280, 1024), PROJECTOR: Size(1280, 800)}
    with pytest.raises(CalibrationError, match="pose_04 was captured with another rig") as caught:
        check_same_devices("pose_04", other, rig)
    text = str(caught.value)
    assert "expected 1280 x 1024 pixels of camera 'left', found 1920 x 1080" in text
    assert "of the projector, found 1280 x 800" in text
    assert "camera 'right' is missing" in text
    assert "camera 'middle' is not one of the rig's" in text


# ---- Pictures of a calibration: what is drawn lies where it should


SIZE = Size(1280, 1024)


def _cell(picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], row: int, column: int) -> list[int]:
    """The colour of a cell: the most frequent one in it."""
    height, width = 512 / 6, 640 / 6
    part = picture[round(row * height) + 3 : round((row + 1) * height) - 3]
    part = part[:, round(column * width) + 3 : round((column + 1) * width) - 3]
    colours, counts = np.unique(part.reshape(-1, 3), axis=0, return_counts=True)
    return [int(each) for each in colours[counts.argmax()]]


@pytest.mark.slow
def test_a_coverage_picture_fills_covered_cells_and_draws_the_outline() -> None:
    shooting = rig_of()
    tilts = ((0.0, 0.0), (20.0, 0.0))
    poses = shots(shooting, [held(CHESSBOARD, tilt=tilt, middle_mm=(-60.0, -50.0, 700.0)) for tilt in tilts])
    found = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    points = [pose.views["left"].points_px for pose in poses]
    plain = draw_coverage(found, points, SIZE)
    assert plain.shape == (512, 640, 3)
    assert plain.dtype == np.uint8
    for row in range(6):
        for column in range(6):
            red, green, _ = _cell(plain, row, column)
            assert (green - red > 10) == bool(found.cells[row, column]), (row, column)
    outline = np.array([[900.0, 700.0], [1200.0, 700.0], [1200.0, 900.0], [900.0, 900.0]])
    guided = draw_coverage(found, points, SIZE, outline_px=outline)
    changed = np.argwhere((guided != plain).any(axis=2))
    # Half as large as the image: the frame and its marked corner lie at half the coordinates.
    assert changed[:, 1].min() == pytest.approx(450, abs=8)
    assert changed[:, 1].max() == pytest.approx(600, abs=8)
    assert changed[:, 0].min() == pytest.approx(350, abs=8)
    assert changed[:, 0].max() == pytest.approx(450, abs=8)


@pytest.mark.parametrize("colour", [False, True])
def test_a_pose_picture_marks_the_corners_on_the_stretched_frame(colour: bool) -> None:
    view = rig_of().shot("pose_00", held(CHESSBOARD)).views["left"]
    frame = np.full(SIZE.shape, 400, dtype=np.uint16)  # of a 12-bit camera, dark
    frame[500, 600] = 4000
    image = np.repeat(frame[:, :, None], 3, axis=2) if colour else frame
    bare = draw_pose(image, None, CHESSBOARD)
    assert bare.shape == (512, 640, 3)
    assert int(np.median(bare)) == 235
    marked = draw_pose(image, view, CHESSBOARD)
    changed = np.argwhere((marked != bare).any(axis=2))[:, ::-1]
    for point in view.points_px / 2:
        assert np.abs(changed - point).max(axis=1).min() < 5
    assert changed[:, 0].min() > view.points_px[:, 0].min() / 2 - 12
