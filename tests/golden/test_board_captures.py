"""The chessboard of the real captures: found in every pose, and as good as its camera's own model fits it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.detection import blur_sigma_px, find_board
from slrig.calibration.boards.lattice import equivalent_views

pytestmark = pytest.mark.shared

BOARD = Board(BoardKind.CHESSBOARD, 7, 9, 75.0)


def white_frame(folder: Path) -> NDArray[np.uint8]:
    """The white frame of a bundle, alone."""
    told = json.loads((folder / "bundle.json").read_text())
    frame = next(each for each in told["frames"] if told["patterns"][each["pattern"]]["kind"] == "white")
    return np.asarray(cv2.imread(str(folder / frame["file"]), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


@pytest.mark.slow
def test_the_real_board_is_found_in_all_poses_and_fits_a_camera(shared: Path) -> None:
    places, points = [], []
    for pose in range(4):
        white = white_frame(shared / "captures" / "boards" / f"pose_{pose}")
        view = find_board(white, BOARD, full_scale=255)
        assert len(view.corner) == BOARD.corner_count
        assert len(equivalent_views(view, BOARD)) == 2
        # What the fit at each corner says of itself; the print's own waves are larger and not in it.
        assert view.sigma_px.max() < 0.02
        assert 0.6 < blur_sigma_px(white, view, BOARD, full_scale=255) < 0.9
        places.append(BOARD.points_mm[view.corner].astype(np.float32))
        points.append(view.points_px.astype(np.float32))
    rms, *_ = cv2.calibrateCamera(places, points, (1280, 1024), None, None, flags=cv2.CALIB_FIX_K3)
    assert rms < 0.22
