"""Where the markers of a ChArUco board stand, and which board's markers stand as some do."""

from __future__ import annotations

import cv2
import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.boards.artwork import charuco_board
from slrig.model import FloatArray, IntArray

_WIDTHS = range(3, 31)
_FEWEST = 6
_SAME = 0.1
"""Of a marker's side: what rests on the layout that the markers are printed in, lens and bow included. On the other
layout it is a quarter of a side and more, unless all markers in view lie in rows that are shifted alike."""


_OFF = 0.5
"""Of a marker's side: more than this rests only where the markers are another board's."""


def rest_px(places: FloatArray, points_px: FloatArray) -> float:
    """Median distance, px, of points from the one homography that fits them best; infinite where none does."""
    homography, _ = cv2.findHomography(places, points_px, cv2.LMEDS)
    if homography is None:
        return float("inf")
    seen = cv2.perspectiveTransform(places[:, None], homography)[:, 0]
    return float(np.median(np.linalg.norm(seen - points_px, axis=1)))


def stands_light_first(board: Board, ids: IntArray, outlines: FloatArray) -> bool | None:
    """Whether markers, (n,) with their outlines (n, 4, 2) px, stand as OpenCV before 4.6 printed this board, with a
    light square up and left of corner 0; None where they stand so in both layouts, a step of one square apart.

    With an odd number of rows of squares there is one layout.
    """
    if board.rows % 2 == 0:
        return False
    known = ids < (board.columns + 1) * (board.rows + 1) // 2
    side = float(np.median(np.linalg.norm(np.roll(outlines, 1, axis=1) - outlines, axis=2)))
    rests = []
    for light_first in (False, True):
        places = np.asarray(charuco_board(board, light_first=light_first).getObjPoints())[ids[known], :, :2]
        rests.append(_rms_px(places.reshape(-1, 2), outlines[known].reshape(-1, 2)))
    if max(rests) < _SAME * side:
        return None
    return rests[1] < min(rests[0], _OFF * side)


def fitting_width(ids: IntArray, outlines: FloatArray) -> int | None:
    """How many corners a row of the ChArUco board has whose markers stand as these, (n,) with their outlines
    (n, 4, 2) px; None where none does, or that is not clear.
    """
    middles = outlines.mean(axis=1)
    if len(ids) < _FEWEST:
        return None
    rests = {}
    for columns in _WIDTHS:
        row, column = _marker_places(columns + 1, int(ids.max()) + 1)
        rests[columns] = rest_px(np.column_stack([column, row])[ids].astype(np.float64), middles)
    best = min(rests, key=lambda columns: rests[columns])
    side = float(np.median(np.linalg.norm(np.roll(outlines, 1, axis=1) - outlines, axis=2)))
    return best if rests[best] < 0.15 * side else None


def _rms_px(places: FloatArray, points_px: FloatArray) -> float:
    """Rms distance, px, of all points from their homography. A median would not see the third that stands aside."""
    homography = cv2.findHomography(places, points_px)[0] if len(places) >= 4 else None
    if homography is None:
        return float("inf")
    off = cv2.perspectiveTransform(places.astype(np.float64)[:, None], homography)[:, 0] - points_px
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _marker_places(width: int, count: int) -> tuple[IntArray, IntArray]:
    """Row and column, in squares, of the first markers of a board this many squares wide: its light squares."""
    row, column = np.mgrid[: 2 * count // width + 2, :width]
    light = (row + column) % 2 == 1
    return row[light][:count].astype(np.int32), column[light][:count].astype(np.int32)
