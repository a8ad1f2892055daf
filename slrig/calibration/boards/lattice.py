"""A grid of corners in view, whatever its size: how far it reaches, where the image cuts it, which corner is number 0.

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
the solve tries both ends of a view of every camera but the first and keeps what fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.board_map import BoardMap, fitted_map
from slrig.calibration.observations import BoardView
from slrig.model import FloatArray, IntArray

_MARGIN = 1.3
"""Where to look for the paper about a chessboard, in squares from its outermost corners."""
_LIGHT, _DARK = 0.7, 0.2
"""Grey levels of lit paper, at least, and of what no light falls on, at most, between dark and light squares."""
_BEYOND = 1.8
"""A grid is cut off where the squares about its next corner would not all lie in the image."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """A grid in view. columns, rows : its extent, of circles in steps of half their distance within a row;
    points_px : (n, 2) float64; places : (n, 2) int, the column and row of each.
    """

    columns: int
    rows: int
    points_px: FloatArray
    places: IntArray

    def fits_in(self, board: Board) -> bool:
        """Whether it may be a part of the board, in either direction."""
        wanted = (2 * board.columns if board.kind is BoardKind.CIRCLES else board.columns, board.rows)
        seen = (self.columns, self.rows)
        return any(a <= wanted[0] and b <= wanted[1] for a, b in (seen, seen[::-1]))

    def board_map(self) -> BoardMap | None:
        """The map of places into the image; None where the points determine none."""
        return fitted_map(self.places.astype(np.float64), self.points_px)

    def complete(self, level: FloatArray) -> bool:
        """Whether a chessboard ends on all four sides: beyond its outermost squares lies paper as light as its light
        squares. False where it cannot be told.
        """
        return all(float((side > _LIGHT).mean()) > 0.85 for side in self._beyond(level))

    def dark_beyond(self, level: FloatArray) -> bool:
        """Whether next to no light falls beyond one of a chessboard's sides. Of more squares half would be dark."""
        return any(float((side < _DARK).mean()) > 0.6 for side in self._beyond(level))

    def _beyond(self, level: FloatArray) -> list[FloatArray]:
        """(n,) float64 for each of the four sides: grey levels beyond the outermost squares of a chessboard, 0 as its
        dark squares and 1 as its light ones; NaN outside the image, and for all where it cannot be told.
        """
        board_map = self.board_map()
        if board_map is None:
            return [np.full(1, np.nan)]
        inside = _line(np.arange(self.columns - 1) + 0.5, np.arange(self.rows - 1) + 0.5)
        low, high = np.nanpercentile(levels_at(level, board_map(inside)), [10, 90])
        x, y = np.arange(self.columns + 1) - 0.5, np.arange(self.rows + 1) - 0.5
        last = np.array([self.columns - 1, self.rows - 1])
        lines = _around(np.zeros(2) - _MARGIN, last + _MARGIN, x, y)
        return [(levels_at(level, board_map(line)) - low) / max(high - low, 1e-9) for line in lines]

    def cut_sides(self, shape: tuple[int, ...]) -> list[str]:
        """The sides of the image of this shape (H, W) beyond which the grid would go on: left, right, upper, lower."""
        board_map = self.board_map()
        if board_map is None:
            return []
        least, most = self.places.min(axis=0), self.places.max(axis=0)
        x, y = np.arange(least[0], most[0] + 1.0), np.arange(least[1], most[1] + 1.0)
        height, width = shape[:2]
        sides = []
        for line in _around(least - _BEYOND, most + _BEYOND, x, y):
            beyond_x, beyond_y = board_map(line).T
            outside = {
                "left": beyond_x < 0, "right": beyond_x > width - 1,
                "upper": beyond_y < 0, "lower": beyond_y > height - 1,
            }  # fmt: skip
            side = max(outside, key=lambda name: float(outside[name].mean()))
            if outside[side].mean() > 0.5 and side not in sides:
                sides.append(side)
        return sides


def _around(least: FloatArray, most: FloatArray, x: NDArray[Any], y: NDArray[Any]) -> list[FloatArray]:
    """Four lines of places (n, 2): at the least and the greatest x, then at the least and the greatest y."""
    ends = np.stack([least, most])
    return [_line(at, y) for at in ends[:, :1]] + [_line(x, at) for at in ends[:, 1:]]


def _line(x: NDArray[Any], y: NDArray[Any]) -> FloatArray:
    """(n, 2) float64: every x with every y."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)


def right_handed(grid: FloatArray) -> FloatArray:
    """A grid of points (rows, columns, 2) with x turning to y clockwise, as on a print that is looked at: its rows in
    the other order if they did not.
    """
    across, down = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    return grid[::-1] if across[0] * down[1] - across[1] * down[0] < 0 else grid


def levels_at(level: FloatArray, places_px: FloatArray) -> FloatArray:
    """(...) float64: grey levels at places (..., 2) by the nearest pixel, NaN outside the image."""
    x, y = np.round(places_px[..., 0]), np.round(places_px[..., 1])
    height, width = level.shape
    inside: NDArray[np.bool_] = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    found = level[np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)]
    return np.asarray(np.where(inside, found, np.nan))


def beside(corner: IntArray, columns: int, rows: int) -> IntArray:
    """Numbers of the corners that are the neighbours of these on a board, diagonal ones too, and not among them."""
    known = np.zeros((rows, columns), dtype=np.uint8)
    known.ravel()[corner] = 1
    near = np.asarray(cv2.dilate(known, np.ones((3, 3), dtype=np.uint8)))
    return np.flatnonzero((near > known).ravel()).astype(np.int32)


def half_turn_looks_same(board: Board) -> bool:
    """Whether half a turn of the print changes nothing that can be seen."""
    if board.kind is BoardKind.CHESSBOARD:
        return (board.columns + board.rows) % 2 == 0
    return board.kind is BoardKind.CIRCLES and board.rows % 2 == 0


def turned_half(view: BoardView, board: Board) -> BoardView:
    """The same corners numbered from the other end of the print: number k becomes n - 1 - k.

    This turns the board's frame by half about the middle of its corners: what was at (x, y) in it is then at
    (X - x, Y - y), X and Y the greatest coordinates of any corner. Light on the board has no numbers.

    Raises ValueError where half a turn of this board can be seen.
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
    if board.kind is BoardKind.CHESSBOARD and board.columns == board.rows and board.columns % 2 == 0:
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
