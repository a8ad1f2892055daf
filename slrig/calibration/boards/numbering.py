"""Which corner is number 0, where a print looks the same from more than one side.

- A ChArUco board has one numbering: its markers say which.
- A chessboard whose columns and rows of corners add up to an odd number (11 x 8) has one: the square up and left of
  corner 0 is dark. If they add up to an even number (7 x 9), it looks the same after half a turn; with as many columns
  as rows, and an even number of both, after every quarter turn.
- Asymmetric circles have one numbering with an odd number of rows (4 x 11); with an even number they look the same
  after half a turn.

A mirrored chessboard is a chessboard, and mirrored circles with an odd number of rows are such circles: every corner
has its place by the same numbers, and nothing goes wrong. Mirrored circles with an even number of rows, and a mirrored
ChArUco board, are other boards and are refused.

Where a print looks the same from two sides, an image alone cannot tell them apart. Poses of one camera do no harm by
that: the board's own place is solved anew in each. Two cameras and a projector that see one pose must agree, though:
the solve tries `equivalent_views` of every camera but the first and keeps what fits.
"""

from __future__ import annotations

import numpy as np

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import BoardView
from slrig.model import FloatArray, IntArray


def half_turn_looks_same(board: Board) -> bool:
    """Whether half a turn of the print changes nothing that can be seen."""
    if board.kind is BoardKind.CHESSBOARD:
        return (board.columns + board.rows) % 2 == 0
    return board.kind is BoardKind.CIRCLES and board.rows % 2 == 0


def quarter_turn_looks_same(board: Board) -> bool:
    """Whether a quarter turn of the print changes nothing that can be seen."""
    return board.kind is BoardKind.CHESSBOARD and board.columns == board.rows and board.columns % 2 == 0


def turned_half(view: BoardView, board: Board) -> BoardView:
    """The same corners numbered from the other end of the print: number k becomes n - 1 - k.

    This turns the board's frame by half about the middle of its corners: what was at (x, y) in it is then at
    (X - x, Y - y), X and Y the greatest coordinates of any corner. Light on the board has no numbers.

    Raises
    ------
    ValueError
        Half a turn of this board can be seen.
    """
    if not half_turn_looks_same(board):
        message = f"{board.title} looks different after half a turn: it has one numbering"
        raise ValueError(message)
    return _renumbered(view, board.corner_count - 1 - view.corner)


def equivalent_views(view: BoardView, board: Board) -> tuple[BoardView, ...]:
    """Every numbering that the image allows, the given one first: 1, 2 or 4."""
    views = [view]
    if half_turn_looks_same(board):
        views.append(turned_half(view, board))
    if quarter_turn_looks_same(board):
        row, column = np.divmod(view.corner, board.columns)
        quarter = _renumbered(view, column * board.columns + (board.rows - 1 - row))
        views += [quarter, turned_half(quarter, board)]
    return tuple(views)


def pointing_right(points_px: FloatArray, board: Board) -> FloatArray:
    """All corners of a print that looks the same from several sides, (n, 2), in the order in which x points most to the
    right in the image.
    """
    everything = np.arange(board.corner_count, dtype=np.int32)
    whole = BoardView(everything, points_px, np.zeros(len(points_px)))
    views = equivalent_views(whole, board)
    across = [_towards(view.points_px, board) for view in views]
    best = max(range(len(views)), key=lambda index: (round(float(across[index][0]), 9), float(across[index][1])))
    return views[best].points_px


def _towards(points_px: FloatArray, board: Board) -> FloatArray:
    """(2,) float64: direction of the board's x axis in the image, of length 1."""
    grid = points_px.reshape(board.rows, board.columns, 2)
    towards = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    return np.asarray(towards / max(float(np.hypot(*towards)), 1e-12))


def _renumbered(view: BoardView, corner: IntArray) -> BoardView:
    order = np.argsort(corner)
    return BoardView(corner[order].astype(np.int32), view.points_px[order], view.sigma_px[order], view.light_first)
