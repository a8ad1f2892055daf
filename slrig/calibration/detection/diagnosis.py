"""What is in view where the board asked for is not, in words, and where the markers of a ChArUco board stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.detection.corners import Grey
from slrig.calibration.detection.lattice import chessboard_lattice, circle_lattice, holds_markers
from slrig.calibration.printing import charuco_board, marker_dictionary
from slrig.errors import setting
from slrig.model import FloatArray, IntArray

_FAMILIES = (
    "DICT_5X5_250",
    "DICT_4X4_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_MIP_36H12",
    "DICT_APRILTAG_36H11",
)
"""One dictionary of each usual family, whose smaller ones begin with the same markers: the usual ones first. Each costs
time by its size."""
_PREFIXED = tuple(f"DICT_{n}X{n}_" for n in (4, 5, 6, 7))
_FEWEST_MARKERS, _FEWEST_UNORDERED = 4, 12
_SEARCH_PX = 1280
_WIDTHS = range(3, 31)
_FEWEST_FITTED = 6
_SAME = 0.1
"""Of a marker's side: what rests on the layout that the markers are printed in, lens and bow included. On the other
layout it is a quarter of a side and more, unless all markers in view lie in rows that are shifted alike."""
_OFF = 0.5
"""Of a marker's side: more than this rests only where the markers are another board's."""

UNMIRRORED = "print the file again without mirroring, and look at it from its printed side, not through a mirror"
"""What to do about a mirrored print."""


@dataclass(frozen=True, slots=True)
class MarkersSeen:
    """Markers of one dictionary: its name, how many different ones, the greatest number."""

    dictionary: str
    count: int
    greatest: int


def markers_seen(grey: Grey, *, but: str | None = None) -> MarkersSeen | None:
    """The markers of the first dictionary of which a dozen are in view and stand as on a ChArUco board; otherwise of
    the one with the most of them. None unless they stand so, or are a dozen: single markers are read into anything.

    but : a dictionary that is known not to be the one; its family is left out.
    """
    image, _ = grey.reduced(_SEARCH_PX)
    names = [name for name in _FAMILIES if but is None or _family(name) != _family(but)]
    best: MarkersSeen | None = None
    for name in names:
        outlines, ids = markers_in(image, name)
        count = len(np.unique(ids))
        if count < _FEWEST_MARKERS or (best is not None and count <= best.count):
            continue
        ordered = fitting_width(ids, outlines) is not None
        if count >= _FEWEST_UNORDERED or ordered:
            best = MarkersSeen(name, count, int(ids.max()))
        if count >= _FEWEST_UNORDERED and ordered:
            break
    return best


def markers_in(image: Any, dictionary: str) -> tuple[FloatArray, IntArray]:
    """Outlines (n, 4, 2) float64, px, and numbers (n,) int32 of the markers of a dictionary that are in view."""
    outlines, numbers, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary)).detectMarkers(image)
    ids = np.zeros(0, dtype=np.int32) if numbers is None else np.asarray(numbers, dtype=np.int32).ravel()
    return np.asarray(outlines, dtype=np.float64).reshape(-1, 4, 2), ids


def _family(dictionary: str) -> str:
    """The family of a dictionary: those of one family begin with the same markers."""
    return next((prefix for prefix in _PREFIXED if dictionary.startswith(prefix)), dictionary)


def other_words(grey: Grey, board: Board) -> str | None:
    """That a board of another kind or other markers than asked for is in view, and what to do; None where none is."""
    found, kind = None, ""
    chess = chessboard_lattice(grey) if board.kind is not BoardKind.CHESSBOARD else None
    # Six dictionaries take longer than all else together, so a chessboard with nothing in its squares comes first.
    plain = chess is not None and not holds_markers(grey.level, chess)
    markers = None if plain else markers_seen(grey, but=board.dictionary)
    if markers is not None and board.kind is BoardKind.CHARUCO:
        return (
            f"another board: expected markers of {board.dictionary}, found {markers.count} of {markers.dictionary} or "
            f"a smaller dictionary of its family: give that one as {setting('dictionary')}, or take the other board"
        )
    if markers is not None:
        kind = "charuco"
        found = f"the markers of a ChArUco board ({markers.dictionary}, number {markers.greatest} the greatest)"
    elif chess is not None:
        kind = "chessboard"
        found = f"a chessboard of {max(chess.columns, chess.rows)} x {min(chess.columns, chess.rows)} inner corners"
    # In a blurred image squares are round.
    if (
        found is None
        and board.kind is not BoardKind.CIRCLES
        and not grey.blurred()
        and circle_lattice(grey) is not None
    ):
        kind, found = "circles", "rows of circles"
    if found is None:
        return None
    expected = board.title if board.kind is BoardKind.CIRCLES else f"a {board.title}"
    return f"another board: expected {expected}, found {found}: give {setting('kind')} {kind}, or take the other board"


def nothing_words(grey: Grey, board: Board) -> str:
    """Why the board is not found where nothing of it is in view."""
    return other_words(grey, board) or f"no {board.title} found: {grey.likely_cause()}"


def half_words(part: str, sides: list[str], *, dark: bool = False) -> str:
    """That only a part of the board is found, and what to do. sides : of the image, beyond which the board goes on;
    dark : whether it is dark beyond that part.
    """
    if dark:
        return (
            f"half a board: only {part} are found, and beyond them it is dark: most likely the projector's picture "
            "ends on the board: bring all of the board into its light; if it is, take away what covers the board"
        )
    if sides:
        return (
            f"half a board: only {part} are in view, the rest is beyond the image's {' and '.join(sides)} side: move "
            "the board fully into view, or use a ChArUco board, which may reach out of it"
        )
    return (
        f"half a board: only {part} are found, though the image does not end there: take away what covers the rest or "
        f"throws a reflection on it; if nothing does, this is another board and {setting('corners')} is wrong"
    )


def unclear_words(grey: Grey, board: Board, found: int, what: str) -> str:
    """That the board is in view, and too few of its corners or circles can be placed."""
    return (
        f"{board.title}: its grid is in view, but only {found} of its {board.corner_count} {what} are clear enough to "
        f"be placed: {grey.likely_cause()}"
    )


def rest_px(places: FloatArray, points_px: FloatArray, *, median: bool = True) -> float:
    """Median distance, px, of points from the one homography that fits them best; infinite where none does.

    Without `median`, the rms distance of all from theirs: a median would not see the third that stands aside.
    """
    homography = cv2.findHomography(places, points_px, cv2.LMEDS if median else 0)[0] if len(places) >= 4 else None
    if homography is None:
        return float("inf")
    off = cv2.perspectiveTransform(places.astype(np.float64)[:, None], homography)[:, 0] - points_px
    return float(np.median(np.linalg.norm(off, axis=1)) if median else np.sqrt((off**2).sum(axis=1).mean()))


def side_px(outlines: FloatArray) -> float:
    """The usual side of markers with these outlines, (n, 4, 2) px."""
    return float(np.median(np.linalg.norm(np.roll(outlines, 1, axis=1) - outlines, axis=2)))


def stands_light_first(board: Board, ids: IntArray, outlines: FloatArray) -> bool | None:
    """Whether markers, (n,) with their outlines (n, 4, 2) px, stand as OpenCV before 4.6 printed this board, with a
    light square up and left of corner 0; None where they stand so in both layouts, a step of one square apart.

    With an odd number of rows of squares there is one layout.
    """
    if board.rows % 2 == 0:
        return False
    known = ids < (board.columns + 1) * (board.rows + 1) // 2
    side = side_px(outlines)
    rests = []
    for light_first in (False, True):
        places = np.asarray(charuco_board(board, light_first=light_first).getObjPoints())[ids[known], :, :2]
        rests.append(rest_px(places.reshape(-1, 2), outlines[known].reshape(-1, 2), median=False))
    if max(rests) < _SAME * side:
        return None
    return rests[1] < min(rests[0], _OFF * side)


def fitting_width(ids: IntArray, outlines: FloatArray) -> int | None:
    """How many corners a row of the ChArUco board has whose markers stand as these, (n,) with their outlines
    (n, 4, 2) px; None where none does, or that is not clear.
    """
    middles = outlines.mean(axis=1)
    if len(ids) < _FEWEST_FITTED:
        return None
    rests = {}
    for columns in _WIDTHS:
        row, column = _marker_places(columns + 1, int(ids.max()) + 1)
        rests[columns] = rest_px(np.column_stack([column, row])[ids].astype(np.float64), middles)
    best = min(rests, key=lambda columns: rests[columns])
    side = side_px(outlines)
    return best if rests[best] < 0.15 * side else None


def _marker_places(width: int, count: int) -> tuple[IntArray, IntArray]:
    """Row and column, in squares, of the first markers of a board this many squares wide: its light squares."""
    row, column = np.mgrid[: 2 * count // width + 2, :width]
    light = (row + column) % 2 == 1
    return row[light][:count].astype(np.int32), column[light][:count].astype(np.int32)
