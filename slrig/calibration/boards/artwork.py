"""What of a board is dark: the shapes that a printer prints and that a mask leaves out, in the board's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.errors import CalibrationError
from slrig.model import FloatArray, IntArray

CIRCLE_RADIUS = 0.5
"""A printed circle's radius over `square_mm`, the distance of two rows. Detection takes circles of any radius."""

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name.upper() == name))
"""OpenCV's marker dictionaries, by name."""


@dataclass(frozen=True, slots=True)
class Artwork:
    """The dark shapes of a board. Everything else is paper.

    rectangles_mm : (n, 2, 2) float64, the least and the greatest (x, y) of each; group : (n,) int32, rising,
    rectangles of one number belong in one path, so that no seam shows where they touch: 0 the squares, then one number
    for each marker.
    circles_mm : (m, 3) float64, x, y, radius.
    """

    rectangles_mm: FloatArray
    group: IntArray
    circles_mm: FloatArray


def artwork(board: Board, *, light_first: bool = False) -> Artwork:
    """Every dark shape of a board: the squares (the one up and left of corner 0 is dark, unless `light_first`), the
    markers, the circles.

    Raises CalibrationError where OpenCV has no such dictionary, or it has fewer markers than the board needs.
    """
    no_rectangles, no_circles = np.zeros((0, 2, 2)), np.zeros((0, 3))
    if board.kind is BoardKind.CIRCLES:
        centres = board.points_mm[:, :2]
        radius = np.full((len(centres), 1), CIRCLE_RADIUS * board.square_mm)
        return Artwork(no_rectangles, np.zeros(0, dtype=np.int32), np.hstack([centres, radius]))
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    dark = (row + column) % 2 == int(light_first)
    least = np.column_stack([column[dark], row[dark]]) - 1.0
    shapes = [np.stack([least, least + 1], axis=1) * board.square_mm]
    if board.kind is BoardKind.CHARUCO:
        shapes += _markers(board, light_first)
    group = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(shape) for shape in shapes])
    return Artwork(np.concatenate(shapes), group, no_circles)


def charuco_board(board: Board, *, light_first: bool = False) -> Any:
    """OpenCV's own description of a ChArUco board: `cv2.aruco.CharucoBoard`, its origin one square up and left of ours.

    light_first : the layout of OpenCV before 4.6 (`setLegacyPattern`); another one only where the number of rows of
    squares is even.

    Raises CalibrationError where OpenCV has no such dictionary, or it has fewer markers than the board needs.
    """
    markers = marker_dictionary(str(board.dictionary))
    needed, held = (board.columns + 1) * (board.rows + 1) // 2, len(markers.bytesList)
    if needed > held:
        message = (
            f"the board: {board.title} needs {needed} markers and {board.dictionary} has {held}: "
            "take fewer corners, or a dictionary of more markers, DICT_5X5_1000 for one"
        )
        raise CalibrationError(message)
    squares = (board.columns + 1, board.rows + 1)
    described = cv2.aruco.CharucoBoard(squares, board.square_mm, float(board.marker_mm or 0), markers)
    described.setLegacyPattern(light_first)
    return described


def marker_dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers of this name: `cv2.aruco.Dictionary`.

    Raises CalibrationError where there is none of this name.
    """
    if name not in DICTIONARIES:
        message = f"the board: OpenCV has no dictionary {name!r}; it has {', '.join(DICTIONARIES)}"
        raise CalibrationError(message)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _markers(board: Board, light_first: bool) -> list[FloatArray]:
    """The dark cells of each marker, runs within a row joined: (n, 2, 2) float64 each, mm."""
    described = charuco_board(board, light_first=light_first)
    dictionary = described.getDictionary()
    cells = int(dictionary.markerSize) + 2
    shapes = []
    for number, corners in zip(described.getIds().ravel(), described.getObjPoints(), strict=True):
        dark: NDArray[np.bool_] = cv2.aruco.generateImageMarker(dictionary, int(number), cells) == 0
        origin = np.asarray(corners, dtype=np.float64)[0, :2] - board.square_mm
        runs = [(row, *run) for row in range(cells) for run in _runs(dark[row])]
        shape = np.array([[(first, row), (beyond, row + 1)] for row, first, beyond in runs], dtype=np.float64)
        shapes.append(origin + shape * (float(board.marker_mm or 0) / cells))
    return shapes


def _runs(dark: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The first cell of each run of dark cells, and the one beyond its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(np.int8)))
    return [(int(first), int(beyond)) for first, beyond in edges.reshape(-1, 2)]
