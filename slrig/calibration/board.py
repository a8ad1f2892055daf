"""Calibration boards: what is printed on them, and where each of their corners lies.

A board's own frame lies in its plane: the origin at corner 0, x to the right and y down as one looks at the print, z
away from the one who looks. Corners count from left to right, then from top to bottom.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.model import FloatArray, IntArray, Size

DICTIONARY = "DICT_5X5_250"
"""The markers of a ChArUco board, unless another dictionary of OpenCV is named."""

MARKER_SHARE = 0.75
"""A marker's side over the square that it lies in, unless given."""

PRINT_SIGMA = 0.001
"""Standard deviation of a print's width and of its height, over themselves, unless a certificate or a ruler says more:
from dry to humid air bond paper grows by 0.1 to 0.2 % along its grain and by 0.2 to 0.4 % across it (usual figures of
paper makers), and a room's air holds a part of that."""

_READING_MM = 0.1
"""Standard deviation of a length as a steel ruler tells it: an eighth of a mm either way at each end, evenly spread."""
_LONGEST_RULER_MM = 300
_MOST_OFF = 0.05
"""A scale that is read as further off its print was not read at its ends."""

_LEAST_MARKER, _MOST_MARKER = 0.1, 0.99
"""Of a square's side. Smaller ones no camera reads; larger ones touch, and to OpenCV's 32 bits are the square."""

_FEWEST, _MOST = 3, 60
_LEAST_MM, _MOST_MM = 0.1, 1000.0


class BoardKind(StrEnum):
    """What is printed."""

    CHARUCO = "charuco"
    CHESSBOARD = "chessboard"
    CIRCLES = "circles"


class BoardShape(StrEnum):
    """What a solve takes the board for. auto : flat, unless held-out poses are better with a bent one."""

    AUTO = "auto"
    FLAT = "flat"
    BOWED = "bowed"


@dataclass(frozen=True, slots=True)
class Board:
    """A board. A frozen value that travels from a request to the solve.

    columns, rows : inner corners of a ChArUco board or chessboard; of asymmetric circles, the circles of one row, and
    the rows (OpenCV's 4 x 11). square_mm : side of a square; of circles, the distance of two neighbouring rows, which
    is half of that of two circles in one row. marker_mm, dictionary : of a ChArUco board only. square_sigma : standard
    deviation of the print's width, and independently of its height, over themselves. aspect : a square's height over
    its width; square_mm is its width.

    Raises
    ------
    CalibrationError
        No such board can be printed or told apart.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None
    square_sigma: float = PRINT_SIGMA
    aspect: float = 1.0

    def __post_init__(self) -> None:
        charuco = self.kind is BoardKind.CHARUCO
        if charuco and self.marker_mm is None:
            object.__setattr__(self, "marker_mm", MARKER_SHARE * self.square_mm)
        if charuco and self.dictionary is None:
            object.__setattr__(self, "dictionary", DICTIONARY)
        faults = []
        if not (_FEWEST <= self.columns <= _MOST and _FEWEST <= self.rows <= _MOST):
            faults.append(f"expected {_FEWEST} to {_MOST} corners each way, found {self.columns} x {self.rows}")
        if not _LEAST_MM <= self.square_mm <= _MOST_MM:
            faults.append(f"square_mm: expected {_LEAST_MM:g} to {_MOST_MM:g} mm, found {self.square_mm:g}")
        if not 0 < self.square_sigma <= _MOST_OFF:
            faults.append(
                f"square_sigma: expected a share of a square's side above 0 and up to {_MOST_OFF:g}, 0.001 for a "
                f"print, found {self.square_sigma:g}"
            )
        if not abs(self.aspect - 1) <= 2 * _MOST_OFF:
            faults.append(f"aspect: expected a square's height over its width, about 1, found {self.aspect:g}")
        if charuco and not _LEAST_MARKER <= (self.marker_mm or 0) / self.square_mm <= _MOST_MARKER:
            faults.append(
                f"marker_mm: expected {_LEAST_MARKER:g} to {_MOST_MARKER:g} of the square's {self.square_mm:g} mm, "
                f"found {self.marker_mm:g}"
            )
        if not charuco and (self.marker_mm is not None or self.dictionary is not None):
            faults.append(f"marker_mm and dictionary belong to a ChArUco board, and this is a board of {self.kind}")
        if faults:
            message = "the board: " + "; ".join(faults)
            raise CalibrationError(message)

    @property
    def corner_count(self) -> int:
        """How many corners (circles) there are."""
        return self.columns * self.rows

    @property
    def points_mm(self) -> FloatArray:
        """(n, 3) float64: every corner (the centre of every circle) in the board's frame."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns)
        across = 2 * column + row % 2 if self.kind is BoardKind.CIRCLES else column
        flat = np.column_stack([across, self.aspect * row, np.zeros_like(row)])
        return np.asarray(flat * self.square_mm, dtype=np.float64)

    @property
    def print_mm(self) -> FloatArray:
        """(2, 2) float64: the least and the greatest (x, y) of what is printed, in the board's frame."""
        across = 2 * self.columns if self.kind is BoardKind.CIRCLES else self.columns
        return np.array([(-1.0, -1.0), (across, self.rows)]) * self.square_mm * [1.0, self.aspect]

    @property
    def rulers_mm(self) -> tuple[int, int]:
        """Lengths of the scales that are printed below the board and left of it, as `slrig calibrate board` does."""
        wide_mm, high_mm = (self.print_mm[1] - self.print_mm[0]).tolist()
        return _ruler_mm(wide_mm), _ruler_mm(high_mm)

    def as_read(self, across_mm: float, down_mm: float, /, *, square_sigma: float | None = None) -> Board:
        """The board as its print turned out, by what is read from end to end of the two printed scales.

        square_sigma : how sure the readings are; None takes them for those of a steel ruler.

        Raises
        ------
        CalibrationError
            A reading is further off than any printer is.
        """
        faults = [
            f"the scale {where} the board is {printed_mm} mm long in print, read as {read_mm:g} mm"
            for where, printed_mm, read_mm in zip(
                ("below", "left of"), self.rulers_mm, (across_mm, down_mm), strict=True
            )
            if not abs(read_mm / printed_mm - 1) <= _MOST_OFF
        ]
        if faults:
            message = (
                f"{'; '.join(faults)}: read each from its first to its last tick; print again at 100 % if it is so"
            )
            raise CalibrationError(message)
        wide, high = (read / printed for read, printed in zip((across_mm, down_mm), self.rulers_mm, strict=True))
        marker_mm = None if self.marker_mm is None else self.marker_mm * wide
        by_ruler = float(np.sqrt(np.mean([(_READING_MM / printed) ** 2 for printed in self.rulers_mm])))
        sigma = by_ruler if square_sigma is None else square_sigma
        return replace(
            self, square_mm=self.square_mm * wide, marker_mm=marker_mm, square_sigma=sigma, aspect=high / wide
        )

    @property
    def title(self) -> str:
        """A few words for it.

        >>> Board(BoardKind.CHESSBOARD, 11, 8, 12.0).title
        'chessboard 11x8, 12 mm'
        """
        return f"{self.kind} {self.columns}x{self.rows}, {self.square_mm:g} mm"

    @property
    def description(self) -> str:
        """What it is, in full.

        >>> Board(BoardKind.CHARUCO, 11, 8, 12.0).description
        'charuco, 11 x 8 inner corners, squares of 12 mm, markers of 9 mm from DICT_5X5_250'
        """
        if self.kind is BoardKind.CIRCLES:
            return f"circles, {self.columns} in each of {self.rows} rows, rows {self.square_mm:g} mm apart"
        markers = f", markers of {self.marker_mm:g} mm from {self.dictionary}" if self.marker_mm is not None else ""
        return f"{self.kind}, {self.columns} x {self.rows} inner corners, squares of {self.square_mm:g} mm{markers}"


def _ruler_mm(room_mm: float) -> int:
    """How long a scale is that has so much room: whole centimetres, if there is one."""
    return min(_LONGEST_RULER_MM, 10 * math.floor(room_mm / 10)) if room_mm >= 10 else math.floor(room_mm)


USUAL_BOARD = Board(BoardKind.CHARUCO, 11, 8, 12.0)
"""The board that is meant where none is named: 12 x 9 squares, which fit on A4 and letter paper with their rulers."""


COLUMN, ROW = 0, 1
"""Which projector coordinate a correspondence has."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """The corners of the board that one camera sees.

    corner : (n,) int32, their numbers, rising; points_px : (n, 2) float64; sigma_px : (n,) float64, the standard
    deviation of each coordinate as the detector states it. light_first : the square up and left of corner 0 is light,
    as OpenCV before 4.6 printed ChArUco boards with an even number of rows of squares.
    """

    corner: IntArray
    points_px: FloatArray
    sigma_px: FloatArray
    light_first: bool = False

    def __post_init__(self) -> None:
        count = len(self.corner)
        if self.points_px.shape != (count, 2) or self.sigma_px.shape != (count,):
            message = f"a view of {count} corners, {self.points_px.shape} points and {self.sigma_px.shape} deviations"
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Where camera pixels on the board get their light from: one projector coordinate each.

    pixels_px : (n, 2) float64, (x, y) in the camera; axis : (n,) uint8, COLUMN or ROW; position_px : (n,) float64, that
    coordinate of the projector pixel; sigma_px : (n,) float64, its standard deviation from noise, projector pixels.
    A pixel whose both coordinates are known comes twice.
    """

    pixels_px: FloatArray
    axis: NDArray[np.uint8]
    position_px: FloatArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        count = len(self.axis)
        if self.pixels_px.shape != (count, 2) or self.position_px.shape != (count,) or self.sigma_px.shape != (count,):
            message = (
                f"correspondences: {count} axes, {self.pixels_px.shape} pixels, {self.position_px.shape} positions"
            )
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """How well one camera saw the board in one pose. NaN where a figure could not be measured.

    moved_px : greatest rms distance of the corners from where the first frame has them; inf where the board is lost.
    saturated : share of the board's pixels that are clipped in the white frame.
    contrast : of the board's light squares, white minus black (the projector's light), median, as a share of full
    scale; where no projector was used, light squares minus dark ones.
    sharpness_px : standard deviation of the blur across the edges of the board's squares, in camera pixels.
    decoded : share of the board's lit pixels whose light was decoded along both axes; NaN without a projector.
    """

    moved_px: float
    saturated: float
    contrast: float
    sharpness_px: float
    decoded: float


@dataclass(frozen=True, slots=True)
class PoseObservation:
    """One pose of the board. `views` and `correspondences` are by camera; the latter are none without a projector."""

    name: str
    views: Mapping[str, BoardView]
    correspondences: Mapping[str, Correspondences] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Observations:
    """All poses of one board before one rig: what a solve takes. `projector` is None where none is calibrated.

    The first of `cameras` is the one whose frame becomes the world.
    """

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None
    poses: tuple[PoseObservation, ...]
