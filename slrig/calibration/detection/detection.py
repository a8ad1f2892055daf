"""Detection of a calibration board in an image, and masks of its print and paper.

OpenCV finds grids and markers in an 8-bit copy of the image; a fit to the pixels of the original image then refines
every corner and circle (`slrig.calibration.detection.corners`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.chessboard import find_charuco, find_chessboard
from slrig.calibration.detection.circles import circle_blur_px, find_circles, refine_circles_view
from slrig.calibration.detection.corners import BoardMap, GreyImage, fit_board_map, refine_corners
from slrig.calibration.printing import artwork
from slrig.model import FloatArray

Mask = NDArray[np.bool_]

_SUBPIXEL_BITS = 4
"""Fractional bits of coordinates for `cv2.fillPoly`."""
_POINTS_PER_SIDE = 8
"""Points per square along the sides of a square or of the outline, because lenses bend them."""

_FINDERS = {
    BoardKind.CHARUCO: find_charuco, BoardKind.CHESSBOARD: find_chessboard, BoardKind.CIRCLES: find_circles
}  # fmt: skip


def refine_view(image: NDArray[Any], view: BoardView, board: Board, /, *, full_scale: float) -> BoardView:
    """Refine the corners of a view in another image in which the board is at almost the same position.

    Corners whose fit fails are left out. image, full_scale : as in `find_board`.
    """
    grey = GreyImage.from_pixels(image, full_scale)
    if board.kind is BoardKind.CIRCLES:
        return refine_circles_view(grey, board, view)
    refined = refine_corners(grey.level, board, view.corner, view.points_px, light_first=view.light_first)
    return BoardView.empty() if refined is None else refined.view


def find_board(image: NDArray[Any], board: Board, /, *, full_scale: float) -> BoardView:
    """Find the corners of the board in an image, numbered as in `Board`.

    image : (H, W) uint8, uint16 or float, a frame in even light or the mean of several; full_scale : grey level at
    which the camera clips. A chessboard and circles must be in view as a whole; a ChArUco board may reach out of the
    image. Corners whose fit fails (dirt, a finger) are left out.

    A board with symmetry (see `slrig.calibration.detection.lattice`) is numbered so that its x axis points to the right
    in this image; another camera, or a board held upside down, may give another numbering of the same print.

    The standard deviation of a coordinate is sqrt(e^2 (J^T J)^-1 + floor^2), with e the rms residual of the corner's
    fit, J the derivative of its model and floor SIGMA_FLOOR_PX. It contains noise, contrast, blur and the size of the
    squares.

    Raises
    ------
    PoseRefusedError
        The board is not in view, only partly in view, or another one; the message says which, and what to do.
    """
    return _FINDERS[board.kind](GreyImage.from_pixels(image, full_scale), board)


def board_mask(view: BoardView, board: Board, shape: tuple[int, int], /) -> Mask:
    """(H, W) bool: pixels of the print, up to the outer edges of the outermost squares (`Board.print_mm`).

    Raises ValueError where the view's corners determine no map: fewer than four, or all on one line.
    """
    return _print_mask(_view_map(view, board), board, shape)


def paper_mask(view: BoardView, board: Board, shape: tuple[int, int], /) -> Mask:
    """(H, W) bool: pixels of the print that are paper: light squares, white cells of markers, the space between
    circles. A pixel on an edge counts as dark.
    """
    board_map = _view_map(view, board)
    return _print_mask(board_map, board, shape) & ~_dark_mask(board_map, view, board, shape)


def interior_mask(view: BoardView, board: Board, shape: tuple[int, int], /, *, margin_px: float) -> Mask:
    """(H, W) bool: pixels of the print farther than `margin_px` from every edge of light and dark and from the border
    of the print. With `paper_mask` it gives the paper that no edge blur reaches.
    """
    board_map = _view_map(view, board)
    region, dark = _print_mask(board_map, board, shape), _dark_mask(board_map, view, board, shape)
    far = np.zeros(shape, dtype=bool)
    for part in (region & dark, region & ~dark):
        # Padded, so that the image border does not count as an edge of the print.
        padded = np.pad(part.astype(np.uint8), 1, mode="edge")
        distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        # Half a pixel from a pixel's centre to its edge, and half a pixel of drawing error.
        far |= distance > margin_px + 1.0
    return far


def measure_blur_px(image: NDArray[Any], view: BoardView, board: Board, /, *, full_scale: float) -> float:
    """Standard deviation of the blur across the board's edges, px, the pixel's own extent included: median over all
    corners (circles). NaN where no fit succeeds.
    """
    level = image.astype(np.float64) / full_scale
    if board.kind is BoardKind.CIRCLES:
        blur = circle_blur_px(level, view, board)
    else:
        refined = refine_corners(level, board, view.corner, view.points_px, light_first=view.light_first)
        blur = np.zeros(0) if refined is None else refined.blur_px
    blur = blur[np.isfinite(blur)]
    return float(np.median(blur)) if len(blur) else float("nan")


def _view_map(view: BoardView, board: Board) -> BoardMap:
    board_map = fit_board_map(board.points_mm[view.corner, :2], view.points_px)
    if board_map is None:
        message = f"{len(view.corner)} corners of a {board.title} determine no map into the image"
        raise ValueError(message)
    return board_map


def _print_mask(board_map: BoardMap, board: Board, shape: tuple[int, int]) -> Mask:
    count = _POINTS_PER_SIDE * (max(board.columns, board.rows) + 2)
    (left, top), (right, bottom) = board.print_mm
    return _fill_outlines(board_map, [_rectangle_outline(left, top, right, bottom, count)], shape)


def _dark_mask(board_map: BoardMap, view: BoardView, board: Board, shape: tuple[int, int]) -> Mask:
    art = artwork(board, light_first=view.light_first)
    outlines = [
        _rectangle_outline(left, top, right, bottom, _POINTS_PER_SIDE if group == 0 else 1)
        for ((left, top), (right, bottom)), group in zip(art.rectangles_mm, art.group, strict=True)
    ]
    angle = np.arange(48) * (2 * np.pi / 48)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    outlines += [np.array([x, y]) + radius * ring for x, y, radius in art.circles_mm]
    return _fill_outlines(board_map, outlines, shape)


def _rectangle_outline(left: float, top: float, right: float, bottom: float, count: int) -> FloatArray:
    """(4 count, 2) float64: points along the sides of a rectangle."""
    corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)], dtype=np.float64)
    share = (np.arange(count) / count)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides)


def _fill_outlines(board_map: BoardMap, outlines: list[FloatArray], shape: tuple[int, int]) -> Mask:
    """(H, W) bool: pixels inside outlines on the board, mm."""
    mask = np.zeros(shape, dtype=np.uint8)
    height, width = shape
    for outline in outlines:
        mapped = np.clip(board_map(outline), [-width, -height], [2 * width, 2 * height])
        cv2.fillPoly(mask, [np.round(mapped * (1 << _SUBPIXEL_BITS)).astype(np.int32)], 1, cv2.LINE_8, _SUBPIXEL_BITS)
    return mask.astype(bool)
