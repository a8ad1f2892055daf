"""The axis of a turntable from a session's poses. Run by the worker and by `slrig turntable axis`."""

from __future__ import annotations

from collections.abc import Sequence

from slrig.calibration import Board, PoseObservation
from slrig.calibration.health.drift import estimate_board_poses
from slrig.model import Calibration
from slrig.multiview import BoardAxis, axis_from_board


def axis_of_poses(
    poses: Sequence[PoseObservation],
    board: Board,
    calibration: Calibration,
    angles_deg: Sequence[float] | None = None,
) -> BoardAxis:
    """The axis that a board was turned about. angles_deg : where the turntable says that it stood, pose by pose.

    Raises
    ------
    CalibrationError
        The calibration is of other cameras than saw the board.
    TurntableRefusedError
        As `axis_from_board` does.
    """
    known = estimate_board_poses(poses, board, calibration)
    return axis_from_board(known.names, known.poses, known.covariance, board.points_mm, angles_deg)
