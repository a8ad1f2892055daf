"""Scripted poses: made-up series, the positioner, and the world that follows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead
from simulated_rig.movements import PoseSeries, generate_poses
from simulated_rig.optics import image_positions
from simulated_rig.options import HeadOptions
from simulated_rig.scene import PrintedBoard, rotation_matrix
from slrig.calibration.board import Board as Designed
from slrig.calibration.board import BoardKind
from slrig.errors import ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray, Pixels
from tests.core import parametrize_core
from tests.rendered_boards import board_head, board_options, board_scene
from tests.unit.simulated_rig.building import FACING_PLATE, coarser, corners_in_world_mm, frames_of, small_head

CHESSBOARD = PrintedBoard.model_validate(
    {"shape": "board", "kind": "chessboard", "columns": 8, "rows": 5, "square_mm": 20.0, "margin_mm": 8.0}
)
OPTIONS = HeadOptions.model_validate(board_options(cameras=2))
DEVICES = [each.pinhole() for each in (*OPTIONS.camera, OPTIONS.projector)]
ONE = {"position_mm": [0.0, 0.0, 20.0], "rotation_deg": [20.0, 0.0, 5.0], "name": "middle"}
TWO = {"position_mm": [15.0, -10.0, 40.0], "rotation_deg": [0.0, -25.0, 0.0]}


def head_of(folder: Path, scene: str | None = None, times: int = 2, **options: Any) -> SimulatedHead:
    """A head before a board, with so many times fewer pixels each way."""
    return board_head(folder, coarser(board_options(**options), times), scene)


def white(head: SimulatedHead) -> Pixels:
    """One white frame. Frames of a head are numbered, and their noise with them."""
    return frames_of(head, 0, camera="left")[0].image


def board_depth_mm(head: SimulatedHead, position: FloatArray, rotation: FloatArray) -> FloatArray:
    """(H, W) float64: the depth of a board's plane along the first camera's rays."""
    eye = head.exact_calibration.cameras["left"]
    normal = eye.rotation @ rotation[:, 2]
    at = eye.rotation @ position + eye.translation_mm
    v, u = np.mgrid[: eye.size.height_px, : eye.size.width_px]
    # The few pixels about the principal point, where distortion is next to nothing.
    rays = np.stack(
        [(u - eye.matrix[0, 2]) / eye.matrix[0, 0], (v - eye.matrix[1, 2]) / eye.matrix[1, 1], np.ones(u.shape)], -1
    )
    return np.asarray((normal @ at) / (rays @ normal), np.float64)


def test_a_series_repeats_with_its_seed_and_differs_with_another() -> None:
    series = PoseSeries(count=6, seed=3, depth_mm=(-40.0, 60.0), edge_px=3.0)
    poses = generate_poses(series, CHESSBOARD, DEVICES)
    assert [pose.name for pose in poses] == [f"pose {number}" for number in range(1, 7)]
    assert generate_poses(series, CHESSBOARD, DEVICES) == poses
    assert generate_poses(series.model_copy(update={"seed": 4}), CHESSBOARD, DEVICES) != poses


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_a_series_is_a_good_script(seed: int) -> None:
    series = PoseSeries(count=20, seed=seed, tilt_deg=(15.0, 40.0), depth_mm=(-60.0, 80.0), edge_px=3.0)
    poses = generate_poses(series, CHESSBOARD, DEVICES[:1] + DEVICES[2:])
    eye, lamp = DEVICES[0], DEVICES[2]
    away = -(eye.centre_mm + lamp.centre_mm) / 2
    away /= np.linalg.norm(away)
    normals = np.array([rotation_matrix(pose.rotation_deg)[:, 2] for pose in poses])
    tilts = np.rad2deg(np.arccos(normals @ away))
    assert tilts.min() > 14.9
    assert tilts.max() < 40.1
    assert np.ptp(tilts) > 18
    # Tilted every way: to the left and right, and up and down.
    leaning = normals - np.outer(normals @ away, away)
    for axis in (0, 1):
        assert leaning[:, axis].max() > np.sin(np.deg2rad(20))
        assert leaning[:, axis].min() < -np.sin(np.deg2rad(20))
    depths = np.array([pose.position_mm for pose in poses]) @ away
    assert np.ptp(depths) > 100
    seen = {"eye": np.zeros((4, 4), int), "lamp": np.zeros((4, 4), int)}
    for pose in poses:
        for name, device in (("eye", eye), ("lamp", lamp)):
            corners = image_positions(corners_in_world_mm(CHESSBOARD, pose.position_mm, pose.rotation_deg), device)
            extent = np.array([device.size.width_px, device.size.height_px])
            assert ((corners > 3) & (corners < extent - 4)).all()
            columns, rows = (corners / extent * 4).astype(int).T
            np.add.at(seen[name], (rows, columns), 1)
    for count in seen.values():
        assert (count > 0).mean() > 0.9


def test_a_board_that_does_not_fit_is_refused() -> None:
    huge = CHESSBOARD.model_copy(update={"square_mm": 60.0})
    with pytest.raises(ConfigError, match=r"pose 1 of 4.*does not fit.*smaller"):
        generate_poses(PoseSeries(count=4), huge, DEVICES)


@parametrize_core("table", [{"tilt_deg": [30.0, 10.0]}, {"tilt_deg": [10.0, 80.0]}, {"depth_mm": [5.0, 4.0]}])
def test_a_series_with_crossed_bounds_is_refused(tmp_path: Path, table: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="minimum <= maximum"):
        head_of(tmp_path, poses=table)


def test_listed_poses_come_before_made_up_ones_and_the_first_is_taken_at_the_start(tmp_path: Path) -> None:
    head = head_of(tmp_path, pose=[ONE, TWO], poses={"count": 3, "edge_px": 3.0})
    assert head.positioner is not None
    assert list(head.positioner.poses) == ["middle", "pose 2", "pose 1", "pose 2", "pose 3"]
    first = white(head)
    head.positioner.move(1)
    other = white(head)
    head.positioner.move(0)
    again = white(head)
    assert np.abs(first.astype(int) - again).mean() < 3
    assert np.abs(first.astype(int) - other).mean() > 10


@pytest.mark.slow
def test_a_pose_looks_the_same_however_it_was_reached(tmp_path: Path) -> None:
    walked, straight = (head_of(tmp_path / str(k), pose=[ONE, TWO]) for k in range(2))
    for head, path in ((walked, (1, 0, 1)), (straight, (1,))):
        assert head.positioner is not None
        for index in path:
            head.positioner.move(index)
    np.testing.assert_array_equal(white(walked), white(straight))


def test_the_truth_follows_the_pose(tmp_path: Path) -> None:
    head = head_of(tmp_path, times=1, pose=[ONE, TWO])
    assert head.positioner is not None
    before = head.truth()
    assert head.truth() is before
    head.positioner.move(1)
    after = head.truth()
    for truth, pose in ((before, ONE), (after, TWO)):
        expected = board_depth_mm(head, np.array(pose["position_mm"]), rotation_matrix(tuple(pose["rotation_deg"])))  # type: ignore[arg-type]
        near = np.s_[122:131, 156:166]
        np.testing.assert_allclose(truth.cameras["left"].depth_mm[near], expected[near], atol=0.002)
    assert not np.array_equal(before.surface.vertices_mm, after.surface.vertices_mm)


def test_the_designed_frame_of_a_pose_has_its_origin_at_corner_0() -> None:
    pose = generate_poses(PoseSeries(count=1, edge_px=3.0), CHESSBOARD, DEVICES)[0]
    rotation = rotation_matrix(pose.rotation_deg)
    # Of the designed board, whose origin is corner 0: X_world = R X + t.
    translation = np.array(pose.position_mm) - rotation @ np.array([*CHESSBOARD.middle_mm, 0.0])
    designed = Designed(BoardKind.CHESSBOARD, 8, 5, 20.0).points_mm
    placed = corners_in_world_mm(CHESSBOARD, pose.position_mm, pose.rotation_deg)
    np.testing.assert_allclose(designed @ rotation.T + translation, placed, atol=1e-9)


def test_any_object_can_take_poses(tmp_path: Path) -> None:
    scene = FACING_PLATE.replace("[[object]]", '[[object]]\nname = "plate"')
    poses = [{"object": "plate", "position_mm": [0.0, 0.0, depth]} for depth in (0.0, 30.0)]
    head = small_head(tmp_path, scene, pose=poses)
    assert head.positioner is not None
    depth = head.truth().cameras["eye"].depth_mm[24, 32]
    head.positioner.move(1)
    assert head.truth().cameras["eye"].depth_mm[24, 32] - depth == pytest.approx(30.0, rel=0.05)


def test_the_positioner_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    positioner = head_of(tmp_path, poses=None, pose=[ONE, TWO]).positioner
    assert positioner is not None
    for index in (-1, 2):
        with pytest.raises(UnsupportedByDeviceError, match="0 to 1: middle, pose 2"):
            positioner.move(index)
    positioner.close()
    positioner.close()
    with pytest.raises(DeviceStateError, match="closed"):
        positioner.move(0)


@pytest.mark.parametrize(
    ("scene", "options", "words"),
    [
        (FACING_PLATE, {}, "the scene has none"),
        (FACING_PLATE, {"poses": None, "pose": [ONE]}, "pose 1: .object. is missing"),
        (None, {"pose": [ONE, TWO | {"object": "tablet"}]}, "pose 2: unknown object 'tablet'.*board.*wall"),
        (None, {"pose": [{"rotation_deg": [0.0, 0.0, 0.0]}]}, "position_mm"),
        (board_scene("chessboard", more="glitter = true"), {}, "glitter"),
    ],
)
def test_scripts_that_do_not_fit_their_scene_are_refused(
    tmp_path: Path, scene: str | None, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=f"(?s){words}"):
        head_of(tmp_path, scene, **options)
