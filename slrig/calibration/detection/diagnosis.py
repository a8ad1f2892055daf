"""Reasons why a board is not found, and the layout of the markers of a ChArUco board in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.corners import GreyImage
from slrig.calibration.detection.lattice import find_chessboard_lattice, find_circle_lattice, has_markers
from slrig.calibration.printing import charuco_board, marker_dictionary
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray, IntArray

_LARGEST_DICTIONARIES = (
    "DICT_5X5_250",
    "DICT_4X4_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_MIP_36H12",
    "DICT_APRILTAG_36H11",
)
"""One dictionary of each usual family, the most usual first. The smaller dictionaries of a family begin with the same
markers. Detection time grows with the size."""
_FAMILY_PREFIXES = tuple(f"DICT_{n}X{n}_" for n in (4, 5, 6, 7))
MIN_FOUND_FRACTION = 0.8
"""Least fraction of the corners of a chessboard or of the circles that must be found."""
_MIN_MARKERS, _MIN_UNORDERED_MARKERS = 4, 12
_SEARCH_PX = 1280
_COLUMN_RANGE = range(3, 31)
_MIN_LAYOUT_MARKERS = 6
_SAME_LAYOUT_RESIDUAL = 0.1
"""Residual over a marker's side below which markers fit their printed layout, lens and bow included. On the other
layout it is a quarter or more, unless all markers in view are in rows with the same shift."""
_MAX_LAYOUT_RESIDUAL = 0.5
"""A greater residual over a marker's side means that the markers belong to another board."""

MIRROR_REMEDY = "print the file again without mirroring, and look at it from its printed side, not through a mirror"


@dataclass(frozen=True, slots=True)
class MarkerSet:
    """Markers of one dictionary in view: its name, the number of different markers, and the greatest marker number."""

    dictionary: str
    count: int
    max_id: int


def identify_markers(grey: GreyImage, *, excluded: str | None = None) -> MarkerSet | None:
    """Identify the markers in view: of the first dictionary with a dozen of them in the layout of a ChArUco board, else
    of the dictionary with most of them; None unless they are in that layout or a dozen, as single ones may be
    misreadings.

    excluded : a dictionary whose family is left out.
    """
    image, _ = grey.downscale(_SEARCH_PX)
    family = None if excluded is None else _dictionary_family(excluded)
    best: MarkerSet | None = None
    for name in _LARGEST_DICTIONARIES:
        if _dictionary_family(name) == family:
            continue
        outlines, ids = detect_markers(image, name)
        count = len(np.unique(ids))
        if count < _MIN_MARKERS or (best is not None and count <= best.count):
            continue
        ordered = matching_columns(ids, outlines) is not None
        if count >= _MIN_UNORDERED_MARKERS or ordered:
            best = MarkerSet(name, count, int(ids.max()))
        if count >= _MIN_UNORDERED_MARKERS and ordered:
            break
    return best


def detect_markers(image: Any, dictionary: str) -> tuple[FloatArray, IntArray]:
    """Outlines (n, 4, 2) float64, px, and numbers (n,) int32 of the markers of a dictionary in view."""
    outlines, numbers, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary)).detectMarkers(image)
    ids = np.zeros(0, dtype=np.int32) if numbers is None else np.asarray(numbers, dtype=np.int32).ravel()
    return np.asarray(outlines, dtype=np.float64).reshape(-1, 4, 2), ids


def _dictionary_family(dictionary: str) -> str:
    """Prefix of the dictionaries that begin with the same markers as this one."""
    return next((prefix for prefix in _FAMILY_PREFIXES if dictionary.startswith(prefix)), dictionary)


def explain_other_board(grey: GreyImage, board: Board) -> str | None:
    """Describe a board of another kind or with other markers in view, and what to do; None where there is none."""
    lattice = find_chessboard_lattice(grey) if board.kind is not BoardKind.CHESSBOARD else None
    # Six dictionaries take longer than all other checks, so a plain chessboard is checked first.
    is_plain = lattice is not None and not has_markers(grey.level, lattice)
    markers = None if is_plain else identify_markers(grey, excluded=board.dictionary)
    if markers is not None and board.kind is BoardKind.CHARUCO:
        return (
            f"another board: expected markers of {board.dictionary}, found {markers.count} of {markers.dictionary} or "
            f"a smaller dictionary of its family: give that one as {setting('dictionary')}, or use the other board"
        )
    if markers is not None:
        kind = BoardKind.CHARUCO
        found = f"the markers of a ChArUco board ({markers.dictionary}, greatest number {markers.max_id})"
    elif lattice is not None:
        kind, found = BoardKind.CHESSBOARD, f"a chessboard of {lattice.size_text} inner corners"
    # Squares are round in a blurred image.
    elif board.kind is BoardKind.CIRCLES or grey.is_blurred() or find_circle_lattice(grey) is None:
        return None
    else:
        kind, found = BoardKind.CIRCLES, "rows of circles"
    expected = board.title if board.kind is BoardKind.CIRCLES else f"a {board.title}"
    return f"another board: expected {expected}, found {found}: give {setting('kind')} {kind}, or use the other board"


def explain_missing_board(grey: GreyImage, board: Board) -> str:
    """Describe why nothing of the board is in view."""
    return explain_other_board(grey, board) or f"no {board.title} found: {grey.likely_cause()}"


def explain_partial_board(part: str, clipped_sides: list[str], *, is_dark: bool = False) -> str:
    """Describe that only a part of the board is found, and what to do.

    clipped_sides : sides of the image beyond which the board continues; is_dark : it is dark beyond the part.
    """
    if is_dark:
        return (
            f"half a board: only {part} are found, and it is dark beyond them: most likely the projector's image ends "
            "on the board: bring all of the board into its light; if it is lit, remove what covers the board"
        )
    if clipped_sides:
        return (
            f"half a board: only {part} are in view, the rest is beyond the image's {' and '.join(clipped_sides)} "
            "side: move the whole board into view, or use a ChArUco board, which may reach out of it"
        )
    return (
        f"half a board: only {part} are found, though the image does not end there: remove what covers the rest or "
        f"its reflection; if there is none, this is another board and {setting('corners')} is wrong"
    )


def require_most_corners(grey: GreyImage, board: Board, view: BoardView | None, what: str) -> BoardView:
    """Return the view. Raises PoseRefusedError if it has too few of the board's corners or circles."""
    count = 0 if view is None else len(view.corner)
    if view is None or count < MIN_FOUND_FRACTION * board.corner_count:
        message = (
            f"{board.title}: its grid is in view, but only {count} of its {board.corner_count} {what} are clear "
            f"enough to be measured: {grey.likely_cause()}"
        )
        raise PoseRefusedError(message)
    return view


def homography_residual_px(positions: FloatArray, points_px: FloatArray, *, median: bool = True) -> float:
    """Median distance, px, of points from the homography that fits them best; infinite where there is none.

    Without `median`, the rms distance of all points, which also shows outliers that a median ignores.
    """
    method = cv2.LMEDS if median else 0
    homography = cv2.findHomography(positions, points_px, method)[0] if len(positions) >= 4 else None
    if homography is None:
        return float("inf")
    residual = cv2.perspectiveTransform(positions.astype(np.float64)[:, None], homography)[:, 0] - points_px
    return float(np.median(np.linalg.norm(residual, axis=1)) if median else np.sqrt((residual**2).sum(axis=1).mean()))


def marker_side_px(outlines: FloatArray) -> float:
    """Median side of markers with these outlines, (n, 4, 2) px."""
    return float(np.median(np.linalg.norm(np.roll(outlines, 1, axis=1) - outlines, axis=2)))


def detect_light_first(board: Board, ids: IntArray, outlines: FloatArray) -> bool | None:
    """True if markers, (n,) with outlines (n, 4, 2) px, have the layout of OpenCV before 4.6, with a light square up
    and left of corner 0; None where they fit both layouts. An odd number of rows of squares has only one layout.
    """
    if board.rows % 2 == 0:
        return False
    known = ids < (board.columns + 1) * (board.rows + 1) // 2
    side = marker_side_px(outlines)
    residuals = []
    for light_first in (False, True):
        positions = np.asarray(charuco_board(board, light_first=light_first).getObjPoints())[ids[known], :, :2]
        residuals.append(homography_residual_px(positions.reshape(-1, 2), outlines[known].reshape(-1, 2), median=False))
    if max(residuals) < _SAME_LAYOUT_RESIDUAL * side:
        return None
    return residuals[1] < min(residuals[0], _MAX_LAYOUT_RESIDUAL * side)


def matching_columns(ids: IntArray, outlines: FloatArray) -> int | None:
    """Corners per row of the ChArUco board that fits markers, (n,) with outlines (n, 4, 2) px; None if unclear."""
    centres = outlines.mean(axis=1)
    if len(ids) < _MIN_LAYOUT_MARKERS:
        return None
    residuals = {}
    for columns in _COLUMN_RANGE:
        # Markers are in the light squares, counted row by row.
        row, column = np.mgrid[: 2 * (int(ids.max()) + 1) // (columns + 1) + 2, : columns + 1]
        light = (row + column) % 2 == 1
        squares = np.column_stack([column[light], row[light]])[ids].astype(np.float64)
        residuals[columns] = homography_residual_px(squares, centres)
    best_columns = min(residuals, key=lambda columns: residuals[columns])
    return best_columns if residuals[best_columns] < 0.15 * marker_side_px(outlines) else None
