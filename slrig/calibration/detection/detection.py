"""A calibration board in an image: its corners, each with its deviation, or the cause why there are none; and masks of
its print and its paper.

Grids and markers are found by OpenCV, on an image brought to 8 bits; every corner and circle is then placed by a fit to
its own pixels of the image as it is (`slrig.calibration.detection.corners`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.chessboard import charuco_view, chessboard_view
from slrig.calibration.detection.circles import circle_blur_px, circles_again, circles_view
from slrig.calibration.detection.corners import BoardMap, Grey, fitted_map, placed_corners
from slrig.calibration.printing import artwork
from slrig.model import FloatArray

Mask = NDArray[np.bool_]

_BITS = 4
"""`cv2.fillPoly` takes places in sixteenths of a pixel."""
_ALONG = 8
"""Points along each side of a square or of the outline per square, as lenses bend them."""

_FINDERS = {
    BoardKind.CHARUCO: charuco_view, BoardKind.CHESSBOARD: chessboard_view, BoardKind.CIRCLES: circles_view
}  # fmt: skip


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

    A board that looks the same after half a turn (`slrig.calibration.detection.lattice`) is numbered so that its
    x axis points to the right in this image; another camera, or a board held the other way round, may then give the
    other numbering of the same print.

    A coordinate's deviation is sqrt(e^2 (J^T J)^-1 + floor^2), with e the rms residual of the corner's own fit and J
    the derivative of its model, so that noise, contrast, blur and size of the squares are all in it; the floor stands
    for what a fit cannot see of itself (FLOOR_PX in `slrig.calibration.detection.corners`).

    Raises
    ------
    PoseRefusedError
        The board is not there, or not wholly, or is another one: the message says which, and what to do.
    """
    grey = Grey.of(image, full_scale)
    return _FINDERS[board.kind](grey, board)


def board_region(view: BoardView, board: Board, shape: tuple[int, int], /) -> Mask:
    """(H, W) bool: the pixels of the print, from the outermost squares' outer edges (`Board.print_mm`) inwards.

    Raises ValueError where the view's corners determine no map: fewer than four, or all on one line.
    """
    return _region(_map(view, board), board, shape)


def light_squares(view: BoardView, board: Board, shape: tuple[int, int], /) -> Mask:
    """(H, W) bool: the pixels of the print that are paper: light squares, white cells of markers, what is between
    circles. A pixel that an edge passes counts as dark.
    """
    board_map = _map(view, board)
    return _region(board_map, board, shape) & ~_dark(board_map, view, board, shape)


def square_interior(view: BoardView, board: Board, shape: tuple[int, int], /, *, margin_px: float) -> Mask:
    """(H, W) bool: the pixels of the print farther than `margin_px` from every edge of light and dark and from the
    print's own border, be they light or dark. With `light_squares` it gives the paper that no edge's blur reaches.
    """
    board_map = _map(view, board)
    region, dark = _region(board_map, board, shape), _dark(board_map, view, board, shape)
    far = np.zeros(shape, dtype=bool)
    for part in (region & dark, region & ~dark):
        # A ring of nothing about the image, so that its border is no edge of the print.
        padded = np.pad(part.astype(np.uint8), 1, mode="edge")
        distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        # Half a pixel from centre to edge, and half a pixel that a shape may be off as it is drawn.
        far |= distance > margin_px + 1.0
    return far


def blur_sigma_px(image: NDArray[Any], view: BoardView, board: Board, /, *, full_scale: float) -> float:
    """Standard deviation of the blur across the board's edges, px, the pixel's own extent included: the median over
    all corners (circles) of the blur that fits each one best. NaN where none could be fitted.
    """
    level = image.astype(np.float64) / full_scale
    if board.kind is BoardKind.CIRCLES:
        blur = circle_blur_px(level, view, board)
    else:
        placed = placed_corners(level, board, view.corner, view.points_px, light_first=view.light_first)
        blur = np.zeros(0) if placed is None else placed.blur_px
    blur = blur[np.isfinite(blur)]
    return float(np.median(blur)) if len(blur) else float("nan")


def _map(view: BoardView, board: Board) -> BoardMap:
    board_map = fitted_map(board.points_mm[view.corner, :2], view.points_px)
    if board_map is None:
        message = f"{len(view.corner)} corners of a {board.title} determine no map into the image"
        raise ValueError(message)
    return board_map


def _region(board_map: BoardMap, board: Board, shape: tuple[int, int]) -> Mask:
    count = _ALONG * (max(board.columns, board.rows) + 2)
    (left, top), (right, bottom) = board.print_mm
    return _filled(board_map, [_outline(left, top, right, bottom, count)], shape)


def _dark(board_map: BoardMap, view: BoardView, board: Board, shape: tuple[int, int]) -> Mask:
    drawn = artwork(board, light_first=view.light_first)
    outlines = [
        _outline(left, top, right, bottom, _ALONG if group == 0 else 1)
        for ((left, top), (right, bottom)), group in zip(drawn.rectangles_mm, drawn.group, strict=True)
    ]
    angle = np.arange(48) * (2 * np.pi / 48)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    outlines += [np.array([x, y]) + radius * ring for x, y, radius in drawn.circles_mm]
    return _filled(board_map, outlines, shape)


def _outline(left: float, top: float, right: float, bottom: float, count: int) -> FloatArray:
    """(4 count, 2) float64: points along the sides of a rectangle."""
    corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)], dtype=np.float64)
    share = (np.arange(count) / count)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides)


def _filled(board_map: BoardMap, outlines: list[FloatArray], shape: tuple[int, int]) -> Mask:
    """(H, W) bool: the pixels within outlines on the board, mm."""
    mask = np.zeros(shape, dtype=np.uint8)
    height, width = shape
    for outline in outlines:
        seen = np.clip(board_map(outline), [-width, -height], [2 * width, 2 * height])
        cv2.fillPoly(mask, [np.round(seen * (1 << _BITS)).astype(np.int32)], 1, cv2.LINE_8, _BITS)
    return mask.astype(bool)
