"""Where the markers of a ChArUco board stand, and which board's markers stand as some do."""

from __future__ import annotations

import cv2
import numpy as np

from slrig.model import FloatArray, IntArray

_WIDTHS = range(3, 31)
_FEWEST = 6


def rest_px(places: FloatArray, points_px: FloatArray) -> float:
    """Median distance, px, of points from the one homography that fits them best; infinite where none does."""
    homography, _ = cv2.findHomography(places, points_px, cv2.LMEDS)
    if homography is None:
        return float("inf")
    seen = cv2.perspectiveTransform(places[:, None], homography)[:, 0]
    return float(np.median(np.linalg.norm(seen - points_px, axis=1)))


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


def _marker_places(width: int, count: int) -> tuple[IntArray, IntArray]:
    """Row and column, in squares, of the first markers of a board this many squares wide: its light squares."""
    row, column = np.mgrid[: 2 * count // width + 2, :width]
    light = (row + column) % 2 == 1
    return row[light][:count].astype(np.int32), column[light][:count].astype(np.int32)
