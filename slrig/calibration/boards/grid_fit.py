"""Corners of squares, roughly known, placed by a fit to their own pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.board_map import BoardMap, fitted_map
from slrig.calibration.boards.corner_fit import FittedPlaces, fitted_corners, patch_offsets
from slrig.calibration.observations import BoardView
from slrig.model import FloatArray, IntArray

FLOOR_PX = 0.003
"""Least deviation of a coordinate: what remains on noiseless renderings of tilted, distorted, shaded boards."""

_LEAST_HALF_PX, _MOST_HALF_PX = 3, 12
_SHARE = 0.45
_LEAST_SIDE_PX = 4.0
_WORST_SIGMA_PX = 0.5
_ASIDE_PX = 1.5


@dataclass(frozen=True, slots=True)
class PlacedCorners:
    """Corners that were placed: the view, the map that they follow, and the blur at each, (n,) float64 px."""

    view: BoardView
    board_map: BoardMap
    blur_px: FloatArray


def placed_corners(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, *, light_first: bool = False
) -> PlacedCorners | None:
    """Corners of a chessboard or ChArUco board from rough places: those that a fit could place. None if too few.

    level : (H, W) float64; corner : (n,) int32, rising; rough_px : (n, 2) float64; light_first : as of `BoardView`.
    """
    squares = board.points_mm[:, :2] / board.square_mm
    for again in (False, True):
        board_map = fitted_map(squares[corner], rough_px)
        if board_map is None:
            return None
        fit = _fit(level, board, corner, rough_px, board_map, light_first)
        if fit is None:
            return None
        good = np.isfinite(fit.sigma_px) & (fit.sigma_px < _WORST_SIGMA_PX)
        corner, rough_px = corner[good], fit.points_px[good]
        sigma, blur = fit.sigma_px[good], fit.blur_px[good]
        if len(corner) < 4:
            return None
        keep = _on_the_map(squares[corner], rough_px)
        corner, rough_px, sigma, blur = corner[keep], rough_px[keep], sigma[keep], blur[keep]
        if keep.all() or again:
            break
    final = fitted_map(squares[corner], rough_px)
    if final is None:
        return None
    view = BoardView(corner.astype(np.int32), rough_px, np.hypot(sigma, FLOOR_PX), light_first)
    return PlacedCorners(view, final, blur)


def _on_the_map(squares: FloatArray, points_px: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which points lie where their neighbours say, within a few times the usual distance."""
    keep = np.ones(len(points_px), dtype=bool)
    for _ in range(3):
        board_map = fitted_map(squares[keep], points_px[keep])
        if board_map is None:
            break
        aside = np.linalg.norm(points_px - board_map(squares), axis=1)
        now = aside < max(_ASIDE_PX, 5 * float(np.median(aside[keep])))
        if (now == keep).all():
            break
        keep = now
    return keep


def _fit(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, board_map: BoardMap, light_first: bool
) -> FittedPlaces | None:
    """The fit at each corner; None where squares would be smaller than can be told, or the map has a fold in them."""
    squares = board.points_mm[corner, :2] / board.square_mm
    slope = board_map.jacobian(squares, step=0.05)
    area = np.linalg.det(slope)
    if not np.isfinite(slope).all() or np.median(np.abs(area)) < _LEAST_SIDE_PX**2:
        return None
    # A corner where the map is folded is none; any square stands in for its own.
    folded = np.abs(area) < 0.1 * np.median(np.abs(area))
    slope[folded] = slope[int(np.argmax(~folded))]
    sides = np.linalg.norm(slope, axis=1)
    half_px = int(np.clip(np.round(_SHARE * np.median(sides.min(axis=1))), _LEAST_HALF_PX, _MOST_HALF_PX))
    offsets = patch_offsets(half_px) + (np.round(rough_px) - rough_px)[:, None]
    # Places of the pixels from the corner, in squares; straight within so short a way.
    local = np.einsum("nij,nmj->nmi", np.linalg.inv(slope), offsets)
    usable = np.abs(local).max(axis=-1) < _SHARE
    if board.kind is BoardKind.CHARUCO:
        inset = (1 - float(board.marker_mm or 0) / board.square_mm) / 2
        clear = (np.abs(local) - inset) * sides[:, None]
        # Of the two squares on this diagonal, light or dark by the corner's number, only the light ones hold a marker.
        row, column = np.divmod(corner, board.columns)
        same_sign = (local[..., 0] > 0) == (local[..., 1] > 0)
        light = same_sign == ((row + column) % 2 != int(light_first))[:, None]
        usable &= ~(light & (clear.min(axis=-1) > -1.0))
    edges = slope.transpose(0, 2, 1) / sides[..., None]
    return fitted_corners(level, rough_px, edges, usable, half_px=half_px)
