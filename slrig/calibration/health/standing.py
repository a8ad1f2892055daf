"""Where a board stood in several poses, by a calibration that is known, and how well all of that is known together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.calibration.board import Board
from slrig.calibration.health.equations import equations
from slrig.calibration.observations import PoseObservation
from slrig.model import Calibration, FloatArray


class BoardPoses(NamedTuple):
    """Poses of a board. names : of the m poses. poses : (m, 4, 4) float64, board to world. covariance : (6 m, 6 m)
    float64, of a small turn (rad, R' = exp([turn]x) R) and the translation (mm), pose by pose.
    """

    names: tuple[str, ...]
    poses: FloatArray
    covariance: FloatArray


def board_poses(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> BoardPoses:
    """The board's poses by least squares, with the calibration's own error, which all of them share.

    A pose's own unknowns (errors its observations share) are solved for beside it and eliminated (Schur), so that the
    equations of all poses together stay small.

    Raises CalibrationError where no camera of the calibration sees enough of the board.
    """
    each = [equations([pose], board, calibration) for pose in poses]
    modes, size = each[0].modes.shape[1], 6 * len(each)
    information, pull = np.zeros((size + modes,) * 2), np.zeros(size + modes)
    information[size:, size:] = np.eye(modes)
    for number, found in enumerate(each):
        rows = np.hstack([found.by_pose, found.by_device @ found.modes])
        own = found.shared.T @ found.shared + np.eye(found.shared.shape[1])
        # What the shared errors explain of each column, and of what is left.
        taken = np.linalg.solve(own, found.shared.T @ np.column_stack([rows, found.left]))
        reduced = rows.T @ (np.column_stack([rows, found.left]) - found.shared @ taken)
        where = np.r_[6 * number : 6 * number + 6, size : size + modes]
        information[np.ix_(where, where)] += reduced[:, :-1]
        pull[where] += reduced[:, -1]
    # Turns are of 1e-5 rad and modes of 1: scaled, the inverse keeps its digits.
    scale = 1 / np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    moves = (covariance @ pull)[:size].reshape(-1, 6)
    placed = np.tile(np.eye(4), (len(each), 1, 1))
    for pose, found, move in zip(placed, each, moves, strict=True):
        (standing,) = found.standing.values()
        pose[:3, :3] = Rotation.from_rotvec(move[:3]).as_matrix() @ standing.rotation
        pose[:3, 3] = standing.translation_mm + move[3:]
    return BoardPoses(tuple(pose.name for pose in poses), placed, covariance[:size, :size])
