"""The real board captures: where their light comes from, and the calibration that they give.

Asked for: camera at most 0.22 px, projector 0.16 px at sub-pixel code edges, stereo 0.20 px, the principal row with its
deviation. Four poses, Gray code only, by somebody else (kamino410/procam-calibration).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import COLUMN, ROW, Correspondences
from slrig.calibration.solution import PARAMETERS, PROJECTOR
from slrig.model import FloatArray
from slrig.sessions.calibration.pose_frames import bundle_device_sizes
from slrig.sessions.calibration.pose_reading import read_pose
from slrig.sessions.calibration.solving import CalibrationResult, ReadPose, solve_poses

BOARD = Board(BoardKind.CHESSBOARD, 7, 9, 75.0)
POSES = ("pose_0", "pose_1", "pose_2", "pose_3")


@pytest.fixture(scope="module")
def poses(shared: Path) -> list[ReadPose]:
    return [read_pose(shared / "captures" / "boards" / name, BOARD, name) for name in POSES]


@pytest.fixture(scope="module")
def result(shared: Path, poses: list[ReadPose]) -> CalibrationResult:
    sizes = bundle_device_sizes(shared / "captures" / "boards" / POSES[0])
    cameras = {name: size for name, size in sizes.items() if name != PROJECTOR}
    return solve_poses(BOARD, cameras, sizes[PROJECTOR], poses)


def off_sheet_px(light: Correspondences, axis: int) -> FloatArray:
    """How far the light of one axis is from a smooth sheet, projector px: a polynomial of fourth degree in the pixel.

    A flat board seen through two lenses is one; nothing that varies from square to square, or from code to code, is.
    """
    chosen = light.axis == axis
    x, y = ((light.pixels_px[chosen] - (640.0, 512.0)) / 640.0).T
    terms = np.column_stack([x**i * y**j for i in range(5) for j in range(5 - i)])
    fitted = np.linalg.lstsq(terms, light.position_px[chosen], rcond=None)[0]
    return np.asarray(terms @ fitted - light.position_px[chosen])


@pytest.mark.parametrize("number", range(len(POSES)))
def test_light_of_the_real_boards_lies_on_smooth_sheets(poses: list[ReadPose], number: int) -> None:
    light = poses[number].observation.light["cam0"]
    for axis in (COLUMN, ROW):
        off = off_sheet_px(light, axis)
        assert len(off) > 2000
        assert np.sqrt(np.mean(off**2)) <= 0.16
        assert (np.abs(off) > 2).mean() < 0.001


def test_the_real_boards_give_the_calibration_that_is_asked_for(result: CalibrationResult) -> None:
    camera, projector = result.solution.residuals["cam0"], result.solution.residuals[PROJECTOR]
    assert camera.rms_px <= 0.22
    assert projector.rms_px <= 0.16
    # As a stereo calibration counts: all corners of both devices together, two coordinates each.
    assert result.solution.stereo_rms_px <= 0.20
    assert result.solution.outliers == {}


def test_the_projectors_lens_is_shifted_and_its_row_is_known_so_well(result: CalibrationResult) -> None:
    projector = result.calibration.projector
    assert projector is not None
    row = len(PARAMETERS) + PARAMETERS.index("cy")
    sigma_px = float(np.sqrt(result.solution.covariance[row, row]))
    # Below the 768 rows of its image; others found 860 to 877.
    assert projector.matrix[1, 2] > projector.size.height_px
    assert 1 < sigma_px < 30
    assert abs(projector.matrix[1, 2] - 868.5) < 3 * sigma_px
    assert abs(projector.matrix[0, 0] - 1890) < 30
    assert abs(result.calibration.cameras["cam0"].matrix[0, 0] - 3450) < 60
    assert result.calibration.solved is not None
