"""Pictures of a calibration as arrays, (H, W, 3) uint8, red, green, blue: coverage, and a pose's corners."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.observations import BoardView
from slrig.calibration.poses.coverage import DeviceCoverage
from slrig.calibration.poses.light_view import within
from slrig.calibration.solution import CELLS
from slrig.model import FloatArray, Pixels, Size

Picture = NDArray[np.uint8]
"""(H, W, 3) uint8: red, green, blue."""

WIDTH_PX = 640
_PAPER = (250, 250, 248)
_LINE = (205, 205, 200)
_INK = (40, 44, 52)
_UNREACHABLE = (232, 230, 226)
_COVERED = ((224, 240, 226), (36, 128, 84))
_ACCENT = (230, 120, 0)
_MANY = 6
_DARK = 330
_MOST_POINTS = 250


def coverage_picture(
    covered: DeviceCoverage,
    points_px: Sequence[FloatArray],
    size: Size,
    *,
    outline_px: FloatArray | None = None,
) -> Picture:
    """Return the image's cells, the darker the more poses cover them, and the corners of every pose in its own colour.

    points_px : by pose, (n, 2). outline_px : (4, 2), where the board should go next, drawn as a frame; its corner 0 is
    marked.
    """
    across, down = _extent(size, WIDTH_PX)
    picture, scale = np.full((down, across, 3), _PAPER, dtype=np.uint8), WIDTH_PX / size.width_px
    for row, column, box in _cell_boxes(picture):
        count = int(covered.cells[row, column])
        if count:
            colour = _between(*_COVERED, min(count, _MANY) / _MANY)
        else:
            colour = _PAPER if covered.reachable[row, column] else _UNREACHABLE
        cv2.rectangle(picture, *box, colour, -1)
    for _, _, (start, end) in _cell_boxes(picture):
        cv2.rectangle(picture, start, (end[0] + 1, end[1] + 1), _LINE, 1)
    for row, column, (corner, _) in _cell_boxes(picture):
        _text(picture, str(int(covered.cells[row, column])), (corner[0] + 4, corner[1] + 13))
    for index, points in enumerate(points_px):
        colour = _pose_colour(index)
        shown = points[within(points, size)]
        for point in _scaled(shown[:: 1 + len(shown) // _MOST_POINTS], scale):
            cv2.circle(picture, point, 2, colour, -1, cv2.LINE_AA)
    if outline_px is not None and len(outline_px):
        corners = _scaled(outline_px, scale)
        cv2.polylines(picture, [np.array(corners)], True, _ACCENT, 2, cv2.LINE_AA)
        cv2.circle(picture, corners[0], 6, _ACCENT, -1, cv2.LINE_AA)
    return picture


def pose_picture(image: Pixels, view: BoardView | None, board: Board, *, width_px: int = WIDTH_PX) -> Picture:
    """Return a camera's frame with the corners that were found: rows in one colour each, corner 0 in a ring.

    image : (H, W) or (H, W, 3) blue, green, red, of 8 or 16 bit, stretched so that its brightest percent is white.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = Size(grey.shape[1], grey.shape[0])
    scale = width_px / size.width_px
    small = cv2.resize(grey, _extent(size, width_px), interpolation=cv2.INTER_AREA).astype(np.float64)
    white = max(1.0, float(np.percentile(small, 99)))
    flat = np.clip(small * (235 / white), 0, 255).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(flat[:, :, None], 3, axis=2))
    if view is None or not len(view.corner):
        return picture
    row = view.corner // board.columns
    points = _scaled(view.points_px, scale)
    for index, point in enumerate(points):
        colour = _pose_colour(int(row[index]))
        if index and row[index] == row[index - 1]:
            cv2.line(picture, points[index - 1], point, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, point, 3, colour, 1, cv2.LINE_AA)
    if view.corner[0] == 0:
        cv2.circle(picture, points[0], 8, _ACCENT, 2, cv2.LINE_AA)
    return picture


def _extent(size: Size, width_px: int) -> tuple[int, int]:
    return width_px, max(1, round(size.height_px * width_px / size.width_px))


def _cell_boxes(picture: Picture) -> list[tuple[int, int, tuple[tuple[int, int], tuple[int, int]]]]:
    """Return row, column and two opposite corners, (x, y), of every cell."""
    down = np.linspace(0, picture.shape[0], CELLS + 1).round().astype(int).tolist()
    across = np.linspace(0, picture.shape[1], CELLS + 1).round().astype(int).tolist()
    return [
        (row, column, ((across[column], down[row]), (across[column + 1] - 1, down[row + 1] - 1)))
        for row in range(CELLS)
        for column in range(CELLS)
    ]


def _scaled(points_px: FloatArray, scale: float) -> list[tuple[int, int]]:
    """Return pixel coordinates of a sheet, from coordinates whose pixel centres are at whole numbers."""
    placed = ((points_px + 0.5) * scale - 0.5) if scale != 1.0 else points_px
    return [(round(float(x)), round(float(y))) for x, y in placed]


def _between(low: tuple[int, int, int], high: tuple[int, int, int], share: float) -> tuple[int, int, int]:
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(low, high, strict=True))
    return red, green, blue


def _pose_colour(index: int) -> tuple[int, int, int]:
    """A colour per pose or row: hues a golden angle apart, so that neighbours differ."""
    hue = np.array([[[round(index * 137.5) % 360 / 2, 200, 190]]], dtype=np.uint8)
    red, green, blue = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def _text(picture: Picture, words: str, place: tuple[int, int]) -> None:
    """Write words, light where the paper under them is dark."""
    under = picture[max(place[1] - 6, 0), min(place[0], picture.shape[1] - 1)]
    colour = _PAPER if int(under.sum()) < _DARK else _INK
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
