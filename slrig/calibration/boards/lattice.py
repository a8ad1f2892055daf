"""A part of a grid that is in view, whatever its size: how far it reaches, and whether the image's border cuts it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.board_map import fitted_map
from slrig.model import FloatArray, IntArray

_MARGIN = 1.3
"""Where to look for the paper about a chessboard, in squares from its outermost corners."""
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

    def complete(self, level: FloatArray) -> bool:
        """Whether a chessboard ends on all four sides: beyond its outermost squares lies paper as light as its light
        squares. False where it cannot be told.
        """
        board_map = fitted_map(self.places.astype(np.float64), self.points_px)
        if board_map is None:
            return False
        inside = _line(np.arange(self.columns - 1) + 0.5, np.arange(self.rows - 1) + 0.5)
        squares = levels_at(level, board_map(inside))
        low, high = np.nanpercentile(squares, [10, 90])
        x, y = np.arange(self.columns + 1) - 0.5, np.arange(self.rows + 1) - 0.5
        lines = (
            _line(np.array([-_MARGIN]), y),
            _line(np.array([self.columns - 1 + _MARGIN]), y),
            _line(x, np.array([-_MARGIN])),
            _line(x, np.array([self.rows - 1 + _MARGIN])),
        )
        light = [levels_at(level, board_map(line)) > low + 0.7 * (high - low) for line in lines]
        return all(float(side.mean()) > 0.85 for side in light)

    def cut_sides(self, shape: tuple[int, ...]) -> list[str]:
        """The sides of the image of this shape (H, W) beyond which the grid would go on: left, right, upper, lower."""
        board_map = fitted_map(self.places.astype(np.float64), self.points_px)
        if board_map is None:
            return []
        least, most = self.places.min(axis=0), self.places.max(axis=0)
        x, y = np.arange(least[0], most[0] + 1.0), np.arange(least[1], most[1] + 1.0)
        lines = (
            _line(np.array([least[0] - _BEYOND]), y),
            _line(np.array([most[0] + _BEYOND]), y),
            _line(x, np.array([least[1] - _BEYOND])),
            _line(x, np.array([most[1] + _BEYOND])),
        )
        sides = []
        for line in lines:
            beyond = board_map(line)
            height, width = shape[:2]
            outside = {
                "left": beyond[:, 0] < 0,
                "right": beyond[:, 0] > width - 1,
                "upper": beyond[:, 1] < 0,
                "lower": beyond[:, 1] > height - 1,
            }
            side = max(outside, key=lambda name: float(outside[name].mean()))
            if outside[side].mean() > 0.5 and side not in sides:
                sides.append(side)
        return sides


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
