"""Corners of ChArUco boards and chessboards: found by OpenCV, placed by a fit."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardView
from slrig.calibration.detection.corners import Grey, PlacedCorners, fitted_map, placed_corners
from slrig.calibration.detection.diagnosis import (
    UNMIRRORED,
    fitting_width,
    half_words,
    markers_in,
    markers_seen,
    nothing_words,
    rest_px,
    side_px,
    stands_light_first,
    unclear_words,
)
from slrig.calibration.detection.lattice import (
    Lattice,
    beside,
    chessboard_lattice,
    grown_lattice,
    half_turn_looks_same,
    holds_markers,
    pointing_right,
    right_handed,
)
from slrig.calibration.printing import charuco_board
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray, IntArray

_QUICK_PX = 800
_LEAST_FOUND = 0.8


def chessboard_view(grey: Grey, board: Board) -> BoardView:
    """See `slrig.calibration.detection.detection.find_board`."""
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


FEWEST_CORNERS = 8
"""Corners that a part of a ChArUco board must show, over two rows and two columns at least."""

_FEWEST_MARKERS, _FEWEST_TO_JUDGE = 3, 8
_SHARE_OFF = 0.06


def charuco_view(grey: Grey, board: Board) -> BoardView:
    """See `slrig.calibration.detection.detection.find_board`."""
    outlines, ids = markers_in(grey.eight, str(board.dictionary))
    if len(ids) < _FEWEST_MARKERS:
        raise PoseRefusedError(_nothing(grey, board))
    light_first = stands_light_first(board, ids, outlines)
    if light_first is None:
        raise PoseRefusedError(_few(grey, board, 0, len(ids)))
    printed = charuco_board(board, light_first=light_first)
    _refuse_another(board, printed, ids, outlines)
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(printed).detectBoard(
        grey.eight, markerCorners=list(outlines.astype(np.float32)[:, None]), markerIds=ids[:, None]
    )
    found = 0 if numbers is None else len(numbers)
    if found < 4:
        raise PoseRefusedError(_few(grey, board, found, len(ids)))
    corner = np.asarray(numbers).ravel().astype(np.int32)
    order = np.argsort(corner)
    rough = np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]
    placed = placed_corners(grey.level, board, corner[order], rough, light_first=light_first)
    before = 0
    while placed is not None and len(placed.view.corner) > before:
        before = len(placed.view.corner)
        placed = _with_neighbours(grey.level, board, placed)
    if placed is None or not _spread(board, placed.view.corner):
        raise PoseRefusedError(_few(grey, board, 0 if placed is None else len(placed.view.corner), len(ids)))
    return placed.view


def _with_neighbours(level: FloatArray, board: Board, placed: PlacedCorners) -> PlacedCorners:
    """With those corners beside found ones whose own markers were cut off or unreadable, where a fit finds them."""
    near = beside(placed.view.corner, board.columns, board.rows)
    guessed = placed.board_map((board.points_mm[:, :2] / board.square_mm)[near])
    height, width = level.shape
    inside = ((guessed > 4) & (guessed < np.array([width, height]) - 5)).all(axis=1)
    if not inside.any():
        return placed
    corner = np.concatenate([placed.view.corner, near[inside]])
    rough = np.concatenate([placed.view.points_px, guessed[inside]])
    order = np.argsort(corner)
    more = placed_corners(level, board, corner[order], rough[order], light_first=placed.view.light_first)
    if more is None:
        return placed
    # A guess is worth as much as what was found only where its fit is as good as theirs.
    known = np.isin(more.view.corner, placed.view.corner)
    good = known | (more.view.sigma_px < 3 * np.median(placed.view.sigma_px))
    seen = more.view
    view = BoardView(seen.corner[good], seen.points_px[good], seen.sigma_px[good], seen.light_first)
    return PlacedCorners(view, more.board_map, more.blur_px[good])


def _spread(board: Board, corner: IntArray) -> bool:
    row, column = np.divmod(corner, board.columns)
    return len(corner) >= FEWEST_CORNERS and len(np.unique(row)) > 1 and len(np.unique(column)) > 1


def _refuse_another(board: Board, printed: Any, ids: IntArray, outlines: FloatArray) -> None:
    """Raise PoseRefusedError unless the markers in view stand where this board has them, in their size."""
    most = (board.columns + 1) * (board.rows + 1) // 2
    foreign = ids >= most
    if foreign.sum() >= 2 or (foreign.any() and len(ids) < _FEWEST_TO_JUDGE):
        width = fitting_width(ids, outlines)
        message = (
            f"another board: {board.title} has the markers 0 to {most - 1} of {board.dictionary}, and marker "
            f"{ids.max()} is in view{_remedy(board, width)}"
        )
        raise PoseRefusedError(message)
    if len(ids) < _FEWEST_TO_JUDGE:
        return
    ids, outlines = ids[~foreign], outlines[~foreign]
    places = np.asarray(printed.getObjPoints(), dtype=np.float64)[ids, :, :2] / board.square_mm
    middles = outlines.mean(axis=1)
    if rest_px(places.mean(axis=1), middles) > 0.3 * side_px(outlines):
        width = fitting_width(ids, outlines)
        message = (
            f"another board: the markers of {board.dictionary} in view do not stand in the order of a {board.title}"
            f"{_remedy(board, width)}"
        )
        raise PoseRefusedError(message)
    board_map = fitted_map(places.mean(axis=1), middles)
    if board_map is None:
        return
    slope = np.sqrt(np.abs(np.linalg.det(board_map.jacobian(places.mean(axis=1), step=0.05))))
    share = float(np.median(np.sqrt(np.abs(_area(outlines))) / slope))
    expected = float(board.marker_mm or 0) / board.square_mm
    if abs(share - expected) > _SHARE_OFF + 1.5 / float(np.median(slope)):
        message = (
            f"another board: its markers are {share:.2f} of a square wide, and those of a {board.title} with markers "
            f"of {board.marker_mm:g} mm are {expected:.2f}: measure both and give "
            f"{setting('square_mm')} and {setting('marker_mm')}"
        )
        raise PoseRefusedError(message)


def _area(outlines: FloatArray) -> FloatArray:
    """(n,) float64: area of each quadrilateral, px^2, negative where it runs the other way round."""
    x, y = outlines[..., 0], outlines[..., 1]
    return np.asarray(0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1))


def _remedy(board: Board, width: int | None) -> str:
    """What to do about another board, whose rows have so many corners, None where that is not known."""
    if width == board.rows != board.columns:
        return (
            f": the board in view has {board.rows} corners in a row and {board.columns} rows, not the other way round: "
            f"turn them round, {setting('corners')} {board.rows}x{board.columns}"
        )
    said = "" if width in (None, board.columns) else f" (they fit a board with {width} corners in a row)"
    return f"{said}: give that board's {setting('corners')}, or take the other one"


def _few(grey: Grey, board: Board, corners: int, markers: int) -> str:
    return (
        f"too little of the {board.title}: {markers} of its markers and {corners} of its corners are clear in the "
        f"image, {FEWEST_CORNERS} corners over two rows and two columns are the least: bring more of it into view; "
        f"if all of it is: {grey.likely_cause()}"
    )


def _nothing(grey: Grey, board: Board) -> str:
    """Why this ChArUco board is not found."""
    _, mirrored = markers_in(np.ascontiguousarray(grey.eight[:, ::-1]), str(board.dictionary))
    count = len(np.unique(mirrored))
    if count >= _FEWEST_MARKERS:
        return (
            f"a mirrored print: {count} markers of {board.dictionary} can be read only with left and right changed "
            f"over: {UNMIRRORED}"
        )
    return nothing_words(grey, board)
