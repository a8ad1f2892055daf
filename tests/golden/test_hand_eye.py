"""Hand-eye calibration of rendered pictures of a board that a robot holds, from frames to hand_eye.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from simulated_rig.scene import rotation_matrix
from simulated_rig.staging import SceneController
from slrig.bundle import write_calibration
from slrig.calibrate.hand_eye import read_hand_eye
from tests.rendered_boards import board_head, board_options, rendered_poses
from tests.unit.calibration.robot_cells import NOISE, error_of, pose
from tests.unit.command import done
from tests.unit.test_cli_hand_eye import write_csv

BOARD = ("--corners", "6x4", "--square-mm", 26, "--marker-mm", 20, "--dictionary", "DICT_4X4_50", "--board", "charuco")
POSES = range(8)


@pytest.mark.slow
def test_rig_is_found_before_a_robot_that_holds_the_board(tmp_path: Path) -> None:
    options = board_options(cameras=2)
    rendered_poses(tmp_path / "poses", options, poses=POSES)
    head = board_head(tmp_path / "head", options)
    write_calibration(tmp_path / "rig.json", head.exact_calibration)
    assert isinstance(head.positioner, SceneController)
    script, random = head.positioner._script.poses, np.random.default_rng(1)
    rig, flange_to_board = (
        pose([-100.0, 20.0, 15.0], [900.0, 250.0, 640.0]),
        pose([10.0, 80.0, 3.0], [20.0, -30.0, 95.0]),
    )
    robot = []
    for number in POSES:
        board = np.eye(4)
        board[:3, :3], board[:3, 3] = rotation_matrix(script[number].rotation_deg), script[number].position_mm
        at = rig @ board @ np.linalg.inv(flange_to_board)
        told = pose(random.normal(0, NOISE[1], 3), [0.0, 0.0, 0.0]) @ at
        told[:3, 3] = at[:3, 3] + random.normal(0, NOISE[0], 3)
        robot.append(told)
    poses = write_csv(tmp_path / "robot.csv", tuple(f"pose_{number:02d}" for number in POSES), np.array(robot))
    done(
        "calibrate", "hand-eye", poses, tmp_path / "poses", "--kind", "fixed", "--calibration", tmp_path / "rig.json",
        *BOARD, "--output", tmp_path / "hand_eye.json",
    )  # fmt: skip
    found = read_hand_eye(tmp_path / "hand_eye.json")
    error = error_of(np.array(found.rig), rig)
    assert np.all(np.abs(error) < 3.5 * np.sqrt(np.diagonal(found.covariance)))
    assert np.linalg.norm(error[3:]) < 0.4
    assert not found.left_out
