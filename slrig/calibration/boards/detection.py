"""A calibration board in an image: its corners, each with its deviation, or the cause why there are none.

Grids and markers are found by OpenCV, on an image brought to 8 bits; every corner and circle is then placed by a fit to
its own pixels of the image as it is (`slrig.calibration.boards.corner_fit`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.board_masks import blur_sigma_px, board_region, light_squares, square_interior
from slrig.calibration.boards.chessboard import chessboard_view
from slrig.calibration.boards.circles import circles_again, circles_view
from slrig.calibration.boards.corner_fit import placed_corners
from slrig.calibration.boards.grey import Grey
from slrig.calibration.boards.markers import charuco_view
from slrig.calibration.boards.numbering import equivalent_views, turned_half
from slrig.calibration.observations import BoardView

__all__ = [
    "blur_sigma_px",
    "board_region",
    "equivalent_views",
    "find_board",
    "light_squares",
    "placed_again",
    "square_interior",
    "turned_half",
]

_FINDERS = {
    BoardKind.CHARUCO: charuco_view,
    BoardKind.CHESSBOARD: chessboard_view,
    BoardKind.CIRCLES: circles_view,
}


def placed_again(image: NDArray[Any], view: BoardView, board: Board, /, *, full_scale: float) -> BoardView:
    """The corners of a view placed anew in another image, in which the board stands where it stood, all but exactly.

    Those that cannot be placed are left out. image, full_scale : as of `find_board`.
    """
    grey = Grey.of(image, full_scale)
    if board.kind is BoardKind.CIRCLES:
        return circles_again(grey, board, view)
    placed = placed_corners(grey.level, board, view.corner, view.points_px, light_first=view.light_first)
    if placed is None:
        return BoardView(np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0))
    return placed.view


def find_board(image: NDArray[Any], board: Board, /, *, full_scale: float) -> BoardView:
    """The corners of the board in an image, numbered as `Board` says.

    image : (H, W) uint8, uint16 or float, a frame in even light or the mean of several; full_scale : the grey level at
    which the camera clips. A chessboard and circles are found whole or not at all; a ChArUco board may reach out of the
    image. A corner that cannot be placed (dirt, a finger) is left out.

    A board that looks the same turned by half a turn (see `slrig.calibration.boards.numbering`) is numbered so that its
    x axis points to the right in this image; another camera, or a board held the other way round, may then give the
    other numbering of the same print.

    A coordinate's deviation is sqrt(e^2 (J^T J)^-1 + floor^2), with e the rms residual of the corner's own fit and J
    the derivative of its model, so that noise, contrast, blur and size of the squares are all in it; the floor stands
    for what a fit cannot see of itself (FLOOR_PX in `slrig.calibration.boards.corner_fit`).

    Raises
    ------
    PoseRefusedError
        The board is not there, or not wholly, or is another one: the message says which, and what to do.
    """
    grey = Grey.of(image, full_scale)
    return _FINDERS[board.kind](grey, board)
