"""Detection of ChArUco boards and chessboards: found by OpenCV, refined by a fit."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardView
from slrig.calibration.detection.corners import GreyImage, RefinedCorners, fit_board_map, refine_corners
from slrig.calibration.detection.diagnosis import (
    MIN_FOUND_FRACTION,
    MIRROR_REMEDY,
    detect_light_first,
    detect_markers,
    explain_missing_board,
    explain_partial_board,
    homography_residual_px,
    identify_markers,
    marker_side_px,
    matching_columns,
    require_most_corners,
)
from slrig.calibration.detection.lattice import (
    Lattice,
    find_chessboard_lattice,
    grow_chessboard,
    has_half_turn_symmetry,
    has_markers,
    make_right_handed,
    neighbour_corners,
    orient_x_right,
)
from slrig.calibration.printing import charuco_board
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray, IntArray

_QUICK_PX = 800
_MIN_CHARUCO_CORNERS = 8
"""Fewest corners of a ChArUco board in view, over two rows and two columns at least."""
_MIN_MARKERS, _MIN_LAYOUT_MARKERS = 3, 8
_MARKER_RATIO_TOLERANCE = 0.06


def find_chessboard(grey: GreyImage, board: Board) -> BoardView:
    """Find a chessboard in an image. See `slrig.calibration.detection.detection.find_board`."""
    lattice = _find_lattice(grey, board)
    if lattice is None or not _is_whole_board(lattice, board):
        raise PoseRefusedError(_explain_chessboard(grey, board, lattice))
    if has_markers(grey.level, lattice):
        raise PoseRefusedError(_explain_markers(grey, board))
    rough_px = _order_corners(grey.level, board, lattice)
    refined = refine_corners(grey.level, board, np.arange(board.corner_count, dtype=np.int32), rough_px)
    return require_most_corners(grey, board, None if refined is None else refined.view, "corners")


def _find_lattice(grey: GreyImage, board: Board) -> Lattice | None:
    """The chessboard of the board's size if there is one, else any chessboard in view; None without one."""
    small, factor = grey.downscale(_QUICK_PX)
    lattice = _find_grid(grey, small, factor, board)
    if lattice is not None:
        return lattice
    any_lattice = find_chessboard_lattice(grey)
    if factor == 1.0 or (any_lattice is not None and _is_identified(grey, board, any_lattice)):
        return any_lattice
    # In the full image the detector takes as long as all steps before.
    return _find_grid(grey, grey.image_8bit, 1.0, board) or any_lattice


def _find_grid(grey: GreyImage, image: NDArray[np.uint8], scale: float, board: Board) -> Lattice | None:
    """The chessboard that contains a grid of the board's size; None without one. scale : of `image`.

    OpenCV also finds a grid of this size within a larger board and between the markers of a ChArUco board.
    """
    found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=0)
    if not found:
        return None
    # Pixel centres are at whole numbers at either scale.
    points = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    steps = np.argwhere(np.ones((board.rows, board.columns)))[:, ::-1].astype(np.int32)
    return grow_chessboard(grey.level, points, steps)


def _is_identified(grey: GreyImage, board: Board, lattice: Lattice) -> bool:
    """True if a lattice is certainly the board, or certainly another one."""
    return _is_whole_board(lattice, board) or has_markers(grey.level, lattice) or lattice.is_complete(grey.level)


def _is_whole_board(lattice: Lattice, board: Board) -> bool:
    """True if the lattice is the whole board, apart from a few corners inside it."""
    size = {lattice.columns, lattice.rows}
    return size == {board.columns, board.rows} and len(lattice.positions) >= MIN_FOUND_FRACTION * board.corner_count


def _order_corners(level: FloatArray, board: Board, lattice: Lattice) -> FloatArray:
    """(n, 2) float64: approximate position of every corner of the board, in the board's order."""
    board_map = lattice.board_map()
    if board_map is None:
        return np.full((board.corner_count, 2), np.nan)
    y, x = np.mgrid[: lattice.rows, : lattice.columns].astype(np.float64)
    grid = board_map(np.stack([x, y], axis=-1))
    if lattice.columns != board.columns:
        grid = grid.transpose(1, 0, 2)
    points_px = make_right_handed(grid).reshape(-1, 2)
    if has_half_turn_symmetry(board):
        return orient_x_right(points_px, board)
    return points_px if _first_is_dark(level, points_px.reshape(board.rows, board.columns, 2)) else points_px[::-1]


def _first_is_dark(level: FloatArray, grid: FloatArray) -> bool:
    """True if the square below and right of corner 0, and so the one up and left of it, is dark."""
    centres = np.round((grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4).astype(np.int64)
    height, width = level.shape
    found = level[np.clip(centres[..., 1], 0, height - 1), np.clip(centres[..., 0], 0, width - 1)]
    row, column = np.indices(found.shape)
    even = (row + column) % 2 == 0
    return bool(np.median(found[even]) < np.median(found[~even]))


def _explain_chessboard(grey: GreyImage, board: Board, lattice: Lattice | None) -> str:
    """Describe why this chessboard is not found, with the chessboard in view, if any."""
    if lattice is None:
        return explain_missing_board(grey, board)
    if has_markers(grey.level, lattice):
        return _explain_markers(grey, board)
    clipped_sides = lattice.clipped_sides(grey.level.shape)
    if lattice.may_be_part_of(board) and (clipped_sides or not lattice.is_complete(grey.level)):
        extent = f"{lattice.columns} x {lattice.rows}"
        part = f"{len(lattice.positions)} of the {board.corner_count} corners, in a grid of {extent},"
        return explain_partial_board(part, clipped_sides, is_dark=lattice.has_dark_side(grey.level))
    return (
        f"another board: expected {board.columns} x {board.rows} inner corners, found a chessboard of "
        f"{lattice.size_text}: use the other board, or give the corners of this one as {setting('corners')} (those "
        "inside, where four squares meet)"
    )


def _explain_markers(grey: GreyImage, board: Board) -> str:
    markers = identify_markers(grey)
    found = f"the markers of a ChArUco board ({markers.dictionary})" if markers else "something printed in its squares"
    return (
        f"another board: expected a {board.title}, found a chessboard with {found}: give {setting('kind')} "
        "charuco, or use a plain chessboard"
    )


def find_charuco(grey: GreyImage, board: Board) -> BoardView:
    """Find a ChArUco board in an image. See `slrig.calibration.detection.detection.find_board`."""
    outlines, ids = detect_markers(grey.image_8bit, str(board.dictionary))
    if len(ids) < _MIN_MARKERS:
        raise PoseRefusedError(_explain_missing_charuco(grey, board))
    light_first = detect_light_first(board, ids, outlines)
    if light_first is None:
        raise PoseRefusedError(_explain_few_corners(grey, board, 0, len(ids)))
    layout = charuco_board(board, light_first=light_first)
    _reject_other_board(board, layout, ids, outlines)
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(
        grey.image_8bit, markerCorners=list(outlines.astype(np.float32)[:, None]), markerIds=ids[:, None]
    )
    found = 0 if numbers is None else len(numbers)
    if found < 4:
        raise PoseRefusedError(_explain_few_corners(grey, board, found, len(ids)))
    rough_px = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    refined = refine_corners(grey.level, board, np.asarray(numbers).ravel(), rough_px, light_first=light_first)
    previous_count = 0
    while refined is not None and len(refined.view.corner) > previous_count:
        previous_count = len(refined.view.corner)
        refined = _add_neighbours(grey.level, board, refined)
    corner = np.zeros(0, dtype=np.int32) if refined is None else refined.view.corner
    spans = [len(np.unique(each)) for each in np.divmod(corner, board.columns)]
    if refined is None or len(corner) < _MIN_CHARUCO_CORNERS or min(spans) < 2:
        raise PoseRefusedError(_explain_few_corners(grey, board, len(corner), len(ids)))
    return refined.view


def _add_neighbours(level: FloatArray, board: Board, refined: RefinedCorners) -> RefinedCorners:
    """Add the neighbours of found corners whose own markers are clipped or unreadable, where a fit finds them."""
    neighbours = neighbour_corners(refined.view.corner, board.columns, board.rows)
    predicted = refined.board_map((board.points_mm[:, :2] / board.square_mm)[neighbours])
    height, width = level.shape
    inside = ((predicted > 4) & (predicted < np.array([width, height]) - 5)).all(axis=1)
    if not inside.any():
        return refined
    corner = np.concatenate([refined.view.corner, neighbours[inside]])
    rough_px = np.concatenate([refined.view.points_px, predicted[inside]])
    extended = refine_corners(level, board, corner, rough_px, light_first=refined.view.light_first)
    if extended is None:
        return refined
    # Accept a predicted corner only if its fit is about as good as those of the found ones.
    is_old = np.isin(extended.view.corner, refined.view.corner)
    valid = is_old | (extended.view.sigma_px < 3 * np.median(refined.view.sigma_px))
    view = extended.view
    view = BoardView(view.corner[valid], view.points_px[valid], view.sigma_px[valid], view.light_first)
    return RefinedCorners(view, extended.board_map, extended.blur_px[valid])


def _reject_other_board(board: Board, layout: Any, ids: IntArray, outlines: FloatArray) -> None:
    """Raise PoseRefusedError unless the markers in view have the positions and the size of the board's."""
    marker_count = (board.columns + 1) * (board.rows + 1) // 2
    is_foreign = ids >= marker_count
    if is_foreign.sum() >= 2 or (is_foreign.any() and len(ids) < _MIN_LAYOUT_MARKERS):
        message = (
            f"another board: {board.title} has the markers 0 to {marker_count - 1} of {board.dictionary}, and marker "
            f"{ids.max()} is in view{_suggest_corners(board, ids, outlines)}"
        )
        raise PoseRefusedError(message)
    if len(ids) < _MIN_LAYOUT_MARKERS:
        return
    ids, outlines = ids[~is_foreign], outlines[~is_foreign]
    positions = (np.asarray(layout.getObjPoints(), dtype=np.float64)[ids, :, :2] / board.square_mm).mean(axis=1)
    centres = outlines.mean(axis=1)
    if homography_residual_px(positions, centres) > 0.3 * marker_side_px(outlines):
        message = (
            f"another board: the markers of {board.dictionary} in view are not in the order of a {board.title}"
            f"{_suggest_corners(board, ids, outlines)}"
        )
        raise PoseRefusedError(message)
    board_map = fit_board_map(positions, centres)
    if board_map is None:
        return
    square_px = np.sqrt(np.abs(np.linalg.det(board_map.jacobian(positions, step=0.05))))
    x, y = outlines[..., 0], outlines[..., 1]
    area_px = np.abs(0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1))
    ratio = float(np.median(np.sqrt(area_px) / square_px))
    expected = float(board.marker_mm or 0) / board.square_mm
    if abs(ratio - expected) > _MARKER_RATIO_TOLERANCE + 1.5 / float(np.median(square_px)):
        message = (
            f"another board: expected markers {expected:.2f} of a square wide ({board.title}, markers of "
            f"{board.marker_mm:g} mm), found {ratio:.2f}: measure both and give {setting('square_mm')} and "
            f"{setting('marker_mm')}"
        )
        raise PoseRefusedError(message)


def _suggest_corners(board: Board, ids: IntArray, outlines: FloatArray) -> str:
    """Describe the remedy for another board with these markers."""
    columns = matching_columns(ids, outlines)
    if columns == board.rows != board.columns:
        return (
            f": the board in view has {board.rows} corners in a row and {board.columns} rows: swap them, "
            f"{setting('corners')} {board.rows}x{board.columns}"
        )
    hint = "" if columns in (None, board.columns) else f" (they fit a board with {columns} corners in a row)"
    return f"{hint}: give that board's {setting('corners')}, or use the other one"


def _explain_few_corners(grey: GreyImage, board: Board, corners: int, markers: int) -> str:
    return (
        f"too little of the {board.title}: found {markers} of its markers and {corners} of its corners, expected "
        f"{_MIN_CHARUCO_CORNERS} corners or more over two rows and two columns: bring more of it into view; if all of "
        f"it is in view: {grey.likely_cause()}"
    )


def _explain_missing_charuco(grey: GreyImage, board: Board) -> str:
    """Describe why this ChArUco board is not found, and what to do."""
    _, mirrored = detect_markers(np.ascontiguousarray(grey.image_8bit[:, ::-1]), str(board.dictionary))
    count = len(np.unique(mirrored))
    if count >= _MIN_MARKERS:
        return (
            f"a mirrored print: {count} markers of {board.dictionary} can be read only with left and right swapped: "
            f"{MIRROR_REMEDY}"
        )
    return explain_missing_board(grey, board)
