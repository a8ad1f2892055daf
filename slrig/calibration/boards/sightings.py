"""What else may be in view where the board asked for is not: other chessboards, other markers, other circles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slrig.calibration.board import BoardKind
from slrig.calibration.boards.artwork import marker_dictionary
from slrig.calibration.boards.blobs import circle_lattice
from slrig.calibration.boards.chess_lattice import chessboard_lattice
from slrig.calibration.boards.grey import Grey
from slrig.calibration.boards.marker_layout import fitting_width
from slrig.errors import setting

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
    names = [name for name in _FAMILIES if but is None or family(name) != family(but)]
    best: MarkersSeen | None = None
    for name in names:
        outlines, numbers, _ = cv2.aruco.ArucoDetector(marker_dictionary(name)).detectMarkers(image)
        ids = np.zeros(0, dtype=np.int32) if numbers is None else np.asarray(numbers).ravel()
        count = len(np.unique(ids))
        if count < _FEWEST_MARKERS or (best is not None and count <= best.count):
            continue
        ordered = fitting_width(ids, np.asarray(outlines, dtype=np.float64).reshape(-1, 4, 2)) is not None
        if count >= _FEWEST_UNORDERED or ordered:
            best = MarkersSeen(name, count, int(ids.max()))
        if count >= _FEWEST_UNORDERED and ordered:
            break
    return best


def marker_numbers(image: Any, dictionary: str) -> Any:
    """(n,) int: numbers of the markers of a dictionary that are in view."""
    detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), cv2.aruco.DetectorParameters())
    _, numbers, _ = detector.detectMarkers(image)
    return np.zeros(0, dtype=int) if numbers is None else np.asarray(numbers).ravel()


def family(dictionary: str) -> str:
    """The family of a dictionary: those of one family begin with the same markers."""
    return next((prefix for prefix in _PREFIXED if dictionary.startswith(prefix)), dictionary)


def describe_other(grey: Grey, asked: BoardKind) -> str | None:
    """A board of another kind than the one asked for, in words; None where none is in view."""
    markers = markers_seen(grey) if asked is not BoardKind.CHARUCO else None
    if markers is not None:
        return (
            f"the markers of a ChArUco board ({markers.dictionary}, number {markers.greatest} the greatest): "
            f"give {setting('kind')} charuco, or take the other board"
        )
    chess = chessboard_lattice(grey) if asked is not BoardKind.CHESSBOARD else None
    if chess is not None:
        return (
            f"a chessboard of {max(chess.columns, chess.rows)} x {min(chess.columns, chess.rows)} inner corners: "
            f"give {setting('kind')} chessboard, or take the other board"
        )
    # In a blurred image squares are round.
    circles = circle_lattice(grey) if asked is not BoardKind.CIRCLES and not grey.blurred() else None
    if circles is not None:
        return f"rows of circles: give {setting('kind')} circles, or take the other board"
    return None
