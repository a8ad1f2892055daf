"""Chessboards: the grid by OpenCV's sector detector (`findChessboardCornersSB`), the corners by a fit."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.boards.chess_lattice import chessboard_lattice, grown_lattice, holds_markers
from slrig.calibration.boards.corner_fit import placed_corners
from slrig.calibration.boards.grey import Grey
from slrig.calibration.boards.lattice import Lattice, half_turn_looks_same, pointing_right, right_handed
from slrig.calibration.boards.sightings import half_words, markers_seen, nothing_words, unclear_words
from slrig.calibration.observations import BoardView
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray

_QUICK_PX = 800
_LEAST_FOUND = 0.8


def chessboard_view(grey: Grey, board: Board) -> BoardView:
    """See `slrig.calibration.boards.detection.find_board`."""
    lattice = _lattice(grey, board)
    if lattice is None or not _is_all_of(lattice, board):
        raise PoseRefusedError(_cause(grey, board, lattice))
    if holds_markers(grey.level, lattice):
        raise PoseRefusedError(_with_markers(grey, board))
    rough_px = _numbered(grey.level, board, lattice)
    placed = placed_corners(grey.level, board, np.arange(board.corner_count, dtype=np.int32), rough_px)
    found = 0 if placed is None else len(placed.view.corner)
    if placed is None or found < _LEAST_FOUND * board.corner_count:
        raise PoseRefusedError(unclear_words(grey, board, found, "corners"))
    return placed.view


def _lattice(grey: Grey, board: Board) -> Lattice | None:
    """The chessboard in view, of the size asked for if there is one; None where there is none at all."""
    small, factor = grey.reduced(_QUICK_PX)
    lattice = _grid(grey, small, factor, board)
    if lattice is not None:
        return lattice
    seen = chessboard_lattice(grey)
    if factor == 1.0 or (seen is not None and _is_known(grey, board, seen)):
        return seen
    # In the whole image the detector takes as long as all that is before it.
    return _grid(grey, grey.eight, 1.0, board) or seen


def _grid(grey: Grey, image: NDArray[np.uint8], scale: float, board: Board) -> Lattice | None:
    """The grid of this size with all that it goes on into, None where there is none. scale : of `image`.

    OpenCV finds a grid of the size asked for in a larger board, and between the markers of a ChArUco board, too.
    """
    found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=0)
    if not found:
        return None
    # A pixel's centre is at a whole number at either scale.
    points = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    steps = np.argwhere(np.ones((board.rows, board.columns)))[:, ::-1].astype(np.int32)
    return grown_lattice(grey.level, points, steps)


def _is_known(grey: Grey, board: Board, lattice: Lattice) -> bool:
    """Whether a lattice is the board, or without doubt another one."""
    return _is_all_of(lattice, board) or holds_markers(grey.level, lattice) or lattice.complete(grey.level)


def _is_all_of(lattice: Lattice, board: Board) -> bool:
    """Whether the lattice is the whole board, but for a few corners within it."""
    size = {lattice.columns, lattice.rows}
    return size == {board.columns, board.rows} and len(lattice.places) >= _LEAST_FOUND * board.corner_count


def _numbered(level: FloatArray, board: Board, lattice: Lattice) -> FloatArray:
    """(n, 2) float64: about where every corner of the board lies, in the board's own order."""
    board_map = lattice.board_map()
    if board_map is None:
        return np.full((board.corner_count, 2), np.nan)
    y, x = np.mgrid[: lattice.rows, : lattice.columns].astype(np.float64)
    grid = board_map(np.stack([x, y], axis=-1))
    if lattice.columns != board.columns:
        grid = grid.transpose(1, 0, 2)
    points_px = right_handed(grid).reshape(-1, 2)
    if half_turn_looks_same(board):
        return pointing_right(points_px, board)
    return points_px if _first_is_dark(level, points_px.reshape(board.rows, board.columns, 2)) else points_px[::-1]


def _first_is_dark(level: FloatArray, grid: FloatArray) -> bool:
    """Whether the square below and right of corner 0, and with it the one above and left, is dark."""
    middles = np.round((grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4).astype(np.int64)
    height, width = level.shape
    found = level[np.clip(middles[..., 1], 0, height - 1), np.clip(middles[..., 0], 0, width - 1)]
    row, column = np.indices(found.shape)
    even = (row + column) % 2 == 0
    return bool(np.median(found[even]) < np.median(found[~even]))


def _cause(grey: Grey, board: Board, seen: Lattice | None) -> str:
    """Why this chessboard is not found, with the chessboard that is seen."""
    if seen is None:
        return nothing_words(grey, board)
    if holds_markers(grey.level, seen):
        return _with_markers(grey, board)
    sides = seen.cut_sides(grey.level.shape)
    if seen.fits_in(board) and (sides or not seen.complete(grey.level)):
        part = f"{len(seen.places)} of the {board.corner_count} corners, in a grid of {seen.columns} x {seen.rows},"
        return half_words(part, sides, dark=seen.dark_beyond(grey.level))
    return (
        f"another board: expected {board.columns} x {board.rows} inner corners, found a chessboard of "
        f"{max(seen.columns, seen.rows)} x {min(seen.columns, seen.rows)}: take the other board, or give its corners "
        f"as {setting('corners')} (those inside, where four squares meet)"
    )


def _with_markers(grey: Grey, board: Board) -> str:
    markers = markers_seen(grey)
    found = f"the markers of a ChArUco board ({markers.dictionary})" if markers else "something printed in its squares"
    return (
        f"another board: expected a {board.title}, found a chessboard with {found}: give {setting('kind')} "
        "charuco, or put the chessboard there"
    )
