"""What poses cover, and what to move next: the advice is measured against what a solve makes of it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import PoseObservation
from slrig.calibration.poses.candidates import board_rotation
from slrig.calibration.poses.checks import judge_pose
from slrig.calibration.poses.coverage import GOALS, attitude, cells_of, coverage, full_turn_deg
from slrig.calibration.poses.next_move import Advice, _cells, _reach, next_move
from slrig.calibration.poses.rough import rig_guess
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose
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


def _shooting(board: Board = CHESSBOARD, *, only: tuple[str, ...] | None = None, seed: int = 1) -> Shooting:
    devices = {name: each for name, each in two_cameras_and_projector().items() if only is None or name in only}
    return Shooting(board, devices, seed=seed)


def _first(shooting: Shooting) -> list[PoseObservation]:
    return [shooting.shot(f"pose_{index:02d}", pose) for index, pose in enumerate(first_poses(shooting.board))]


def _followed(shooting: Shooting, advice: Advice) -> BoardPose:
    """The pose in the world of a person who does exactly what the outline in the picture shows."""
    assert advice.camera is not None
    assert advice.candidate is not None
    camera, board_pose = shooting.devices[advice.camera], advice.candidate.board_pose
    rotation = camera.rotation.T @ board_pose.rotation
    return BoardPose(rotation, camera.rotation.T @ (board_pose.translation_mm - camera.translation_mm))


def test_cells_count_points_where_they_lie() -> None:
    points_px = np.array([[-0.4, -0.4], [59.4, 0.0], [59.6, 0.0], [359.4, 239.4], [359.6, 0.0], [-0.6, 5.0]])
    cells = cells_of(points_px, Size(360, 240))
    assert cells[0, 0] == 2
    assert cells[0, 1] == 1
    assert cells[5, 5] == 1
    assert cells.sum() == 4


@pytest.mark.parametrize(
    ("tilt", "near"), [((30.0, 0.0), "top"), ((-30.0, 0.0), "bottom"), ((0.0, 30.0), "right"), ((0.0, -30.0), "left")]
)
def test_a_tilt_is_named_by_the_edge_that_comes_nearer(tilt: tuple[float, float], near: str) -> None:
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


def test_a_turn_is_clockwise_in_the_picture() -> None:
    board_pose = held(CHESSBOARD, in_plane_deg=30.0)
    assert attitude(board_pose, np.zeros(3)).turn_deg == pytest.approx(30.0)
    # y runs down: after a clockwise turn, the board's right end lies lower in the picture than its left one.
    ends = CHESSBOARD.points_mm[[0, 10]] @ board_pose.rotation.T
    assert ends[1, 1] > ends[0, 1]


def test_a_board_that_looks_the_same_after_half_a_turn_needs_no_such_turn() -> None:
    alike = Board(BoardKind.CHESSBOARD, 9, 7, 12.0)
    assert full_turn_deg(alike) == 180
    assert full_turn_deg(CHESSBOARD) == full_turn_deg(Board(BoardKind.CHARUCO, 9, 7, 12.0)) == 360
    for board, turns in ((alike, 1), (Board(BoardKind.CHARUCO, 9, 7, 12.0), 2)):
        shooting = _shooting(board, only=("left",))
        board_pose = [held(board, tilt=(20.0, 0.0)), held(board, tilt=(0.0, 20.0), in_plane_deg=180.0)]
        poses = [shooting.shot(f"pose_{index:02d}", each) for index, each in enumerate(board_pose)]
        assert coverage(poses, board, shooting.sizes).devices["left"].turns == turns


def test_the_guess_finds_the_devices_from_a_few_poses() -> None:
    shooting = _shooting()
    poses = _first(shooting)
    poses.append(shooting.shot("pose_03", held(CHESSBOARD, tilt=(-30.0, 15.0), middle_mm=(60.0, 40.0, 540.0))))
    guess = rig_guess(poses, CHESSBOARD, shooting.sizes)
    for name, guessed in guess.devices.items():
        truth = shooting.devices[name]
        assert guessed.matrix[0, 0] == pytest.approx(truth.matrix[0, 0], rel=0.03), name
        assert guessed.poses.keys() == {"pose_00", "pose_01", "pose_02", "pose_03"}
    # A lens shift beyond the image's edge is seen from the first poses on.
    assert guess.devices[PROJECTOR].matrix[1, 2] == pytest.approx(860, abs=40)
    way = guess.relative("left", "right")
    assert way is not None
    assert way.translation_mm == pytest.approx(shooting.devices["right"].translation_mm, abs=3.0)


def test_a_wide_lens_is_guessed_too() -> None:
    """A fit that starts from the usual lens alone ends at twice its focal length."""
    wide = device(Size(1280, 1024), 500.0, (650.0, 500.0), (0.0,) * 5, BoardPose(np.eye(3), np.zeros(3)))
    shooting = Shooting(CHESSBOARD, {"left": wide})
    tilts = ((0.0, 0.0), (25.0, 0.0), (0.0, -25.0), (-30.0, 15.0))
    poses = [
        shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, tilt=tilt, middle_mm=(0.0, 0.0, 200.0)))
        for index, tilt in enumerate(tilts)
    ]
    found = rig_guess(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert found.matrix[0, 0] == pytest.approx(500, rel=0.03)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_guess_holds_with_parallel_poses_and_with_none(count: int) -> None:
    shooting = _shooting(only=("left",))
    poses = [
        shooting.shot(f"pose_{index:02d}", held(CHESSBOARD, middle_mm=(20.0 * index, 0.0, 600.0)))
        for index in range(count)
    ]
    guess = rig_guess(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert np.isfinite(guess.information).all()
    assert guess.focal_sigma > 0.15
    found = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert np.isnan(found.distance_mm).all()
    assert next_move(poses, CHESSBOARD, shooting.sizes).words


def test_coverage_counts_cells_depths_tilts_and_turns() -> None:
    shooting = _shooting()
    board_pose = [
        held(CHESSBOARD),
        held(CHESSBOARD, tilt=(30.0, 0.0), middle_mm=(0.0, 0.0, 540.0)),
        held(CHESSBOARD, tilt=(-25.0, 30.0), in_plane_deg=90.0, middle_mm=(60.0, 0.0, 660.0)),
        held(CHESSBOARD, tilt=(0.0, -20.0), in_plane_deg=35.0, middle_mm=(0.0, 20.0, 605.0)),
        held(CHESSBOARD, tilt=(50.0, 5.0)),
    ]
    poses = [shooting.shot(f"pose_{index:02d}", each) for index, each in enumerate(board_pose)]
    left = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    assert left.depths == 3
    assert left.tilted == (2, 2)
    assert left.turns == 3
    assert left.distance_mm == pytest.approx((540.0, 660.0), rel=0.01)
    wanted = sum((cells_of(pose.views["left"].points_px, Size(1280, 1024)) > 0).astype(int) for pose in poses)
    assert np.array_equal(left.cells, wanted)
    assert left.share == pytest.approx((left.cells > 0).mean())


def test_coverage_of_a_projector_counts_only_what_a_camera_sees() -> None:
    devices = two_cameras_and_projector()
    whole = devices[PROJECTOR]
    # Twice as wide a picture from the same place: the cameras see only the middle of it.
    matrix = whole.matrix + np.array([[0, 0, 512], [0, 0, 384], [0, 0, 0]])
    wide = Pinhole(Size(2048, 1536), matrix, whole.distortion, whole.rotation, whole.translation_mm)
    shooting = Shooting(CHESSBOARD, {"left": devices["left"], PROJECTOR: wide})
    found = coverage(_first(shooting), CHESSBOARD, shooting.sizes).devices[PROJECTOR]
    assert 6 <= found.reachable.sum() <= 24
    assert found.share == pytest.approx((found.cells > 0).sum() / found.reachable.sum())


def test_open_goals_are_named() -> None:
    shooting = _shooting()
    found = coverage(_first(shooting), CHESSBOARD, shooting.sizes)
    text = "\n".join(found.missing)
    assert "3 of at least 12 poses" in text
    assert "camera 'left': 1 of 3 distances" in text
    assert "camera 'left': 1 of 3 angles in the board's plane" in text
    assert "80% wanted" in text


def test_nothing_shot_yet_says_how_to_begin() -> None:
    shooting = _shooting()
    advice = next_move([], CHESSBOARD, shooting.sizes)
    assert "middle of the picture of camera 'left'" in advice.words
    assert "projector" in advice.words
    assert not advice.enough


def test_advice_names_place_tilt_and_reason_and_shows_the_outline() -> None:
    shooting = _shooting()
    poses = _first(shooting)
    advice = next_move(poses, CHESSBOARD, shooting.sizes)
    assert "move the board to the" in advice.words
    assert "edge 30° towards the camera" in advice.words
    assert "not covered yet" in advice.words
    assert advice.camera is not None
    then = shooting.shot("pose_03", _followed(shooting, advice))
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
    shooting = _shooting(only=("left",))
    board_pose = [
        *first_poses(CHESSBOARD),
        held(CHESSBOARD, tilt=(-20.0, 10.0), middle_mm=(0.0, -20.0, 600.0)),
        held(CHESSBOARD, tilt=(15.0, 15.0), middle_mm=(15.0, 10.0, 605.0)),
    ]
    poses = [shooting.shot(f"pose_{index:02d}", each) for index, each in enumerate(board_pose)]
    advice = next_move(poses, CHESSBOARD, shooting.sizes)
    seeds = range(100, 106)
    without = np.sqrt((_errors_px(shooting, board_pose, seeds) ** 2).mean())
    lazy = held(CHESSBOARD, tilt=(15.0, -10.0), middle_mm=(-10.0, 15.0, 600.0))
    with_another = np.sqrt((_errors_px(shooting, [*board_pose, lazy], seeds) ** 2).mean())
    with_advice = np.sqrt((_errors_px(shooting, [*board_pose, _followed(shooting, advice)], seeds) ** 2).mean())
    assert with_advice < 0.6 * without
    assert with_advice < 0.7 * with_another
    # What it promised: the worst cell's own figure, both coordinates of it, within a factor of two of the truth.
    assert 0.5 < with_advice / (np.sqrt(2) * advice.expected_px["left"]) < 2
    assert advice.expected_px["left"] < advice.worst_px["left"]


def test_the_stated_uncertainty_is_that_of_repeated_solves() -> None:
    shooting = _shooting(only=("left",))
    random = np.random.default_rng(5)
    board_pose = [
        held(
            CHESSBOARD,
            tilt=(random.uniform(-35, 35), random.uniform(-35, 35)),
            middle_mm=(random.uniform(-60, 60), random.uniform(-50, 50), random.uniform(540, 660)),
        )
        for _ in range(8)
    ]
    poses = [shooting.shot(f"pose_{index:02d}", each) for index, each in enumerate(board_pose)]
    poses = [pose for pose in poses if pose.views]
    guess = rig_guess(poses, CHESSBOARD, shooting.sizes).devices["left"]
    stated = np.sqrt(2) * _cells(guess.information[None], _reach(guess)).max()
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
    shooting = _shooting(board, only=only)
    figures = {name: SHARP for name in only if name != PROJECTOR}
    random = np.random.default_rng(7)
    poses = _first(shooting)
    advice = next_move(poses, board, shooting.sizes)
    worst = [max(advice.worst_px.values())]
    while not advice.enough:
        assert len(poses) < 25
        assert sum(advice.expected_px.values()) < sum(advice.worst_px.values())
        exact = _followed(shooting, advice)
        # A hand is off by some millimetres and degrees; a little farther away, the board is still seen whole.
        loose = turned(*random.uniform(-3, 3, 3)) @ exact.rotation
        middle = exact.rotation @ board.points_mm.mean(axis=0) + exact.translation_mm
        by_hand = BoardPose(loose, middle * 1.03 - loose @ board.points_mm.mean(axis=0))
        pose = shooting.shot(f"pose_{len(poses):02d}", by_hand)
        answer = judge_pose(pose, figures, poses, board, shooting.sizes)
        assert answer.accepted, answer.refusals  # what is advised is never refused
        poses.append(pose)
        advice = answer.advice
        worst.append(max(advice.worst_px.values()))
    assert GOALS.fewest <= len(poses) <= 25
    found = coverage(poses, board, shooting.sizes)
    assert found.missing == ()
    assert advice.words.startswith("enough")
    for each in found.devices.values():
        assert each.share >= 0.8
    assert worst[-1] <= GOALS.sigma_px < worst[0]
