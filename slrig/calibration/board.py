"""Calibration boards, and the observations of one in cameras and projector.

Frame of a board: in the plane of the print, origin at corner 0, x to the right, y down, z away from the viewer of the
print. Corners are numbered from left to right, then from top to bottom.
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

DEFAULT_DICTIONARY = "DICT_5X5_250"
"""OpenCV's marker dictionary of a ChArUco board, unless another one is named."""

MARKER_RATIO = 0.75
"""Default side of a marker over the side of a square."""

PRINT_SIGMA = 0.001
"""Relative standard deviation of a print's width and height without a certificate or a ruler reading: from dry to humid
air, bond paper grows by 0.1 to 0.4 %, of which the air in a room causes a part."""

_RULER_SIGMA_MM = 0.1
"""Standard deviation of a length read from a steel ruler, with an error of up to an eighth of a mm at each end."""
_MAX_RULER_MM = 300
_MAX_SCALE_ERROR = 0.05
"""Largest relative deviation of a printed scale. A larger one is a wrong reading."""

_MIN_MARKER_RATIO, _MAX_MARKER_RATIO = 0.1, 0.99
"""Limits of a marker's side over the square's. No camera reads smaller ones; larger ones touch each other."""

_MIN_CORNERS, _MAX_CORNERS = 3, 60
_MIN_SQUARE_MM, _MAX_SQUARE_MM = 0.1, 1000.0

COLUMN, ROW = 0, 1
"""Axis of a projector coordinate."""


class BoardKind(StrEnum):
    """Pattern of a board."""

    CHARUCO = "charuco"
    CHESSBOARD = "chessboard"
    CIRCLES = "circles"


class BoardShape(StrEnum):
    """Shape of the board in a solve. auto : flat, unless held-out poses are predicted better with a bent board."""

    AUTO = "auto"
    FLAT = "flat"
    BOWED = "bowed"


@dataclass(frozen=True, slots=True)
class Board:
    """A calibration board.

    columns, rows : inner corners of a ChArUco board or chessboard; of asymmetric circles, circles per row and rows
    (OpenCV's 4 x 11). square_mm : width of a square; of circles, the distance of neighbouring rows, half the distance
    of two circles in one row. marker_mm, dictionary : ChArUco boards only. square_sigma : relative standard deviation
    of the print's width, and independently of its height. aspect : height of a square over its width.

    Raises CalibrationError if a value is out of range.
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
            object.__setattr__(self, "marker_mm", MARKER_RATIO * self.square_mm)
        if charuco and self.dictionary is None:
            object.__setattr__(self, "dictionary", DEFAULT_DICTIONARY)
        faults = []
        if not (_MIN_CORNERS <= self.columns <= _MAX_CORNERS and _MIN_CORNERS <= self.rows <= _MAX_CORNERS):
            faults.append(
                f"expected {_MIN_CORNERS} to {_MAX_CORNERS} corners each way, found {self.columns} x {self.rows}"
            )
        if not _MIN_SQUARE_MM <= self.square_mm <= _MAX_SQUARE_MM:
            faults.append(f"square_mm: expected {_MIN_SQUARE_MM:g} to {_MAX_SQUARE_MM:g} mm, found {self.square_mm:g}")
        if not 0 < self.square_sigma <= _MAX_SCALE_ERROR:
            faults.append(
                f"square_sigma: expected a relative deviation above 0 and up to {_MAX_SCALE_ERROR:g}, 0.001 for a "
                f"print, found {self.square_sigma:g}"
            )
        if not abs(self.aspect - 1) <= 2 * _MAX_SCALE_ERROR:
            faults.append(f"aspect: expected a square's height over its width, about 1, found {self.aspect:g}")
        if charuco and not _MIN_MARKER_RATIO <= (self.marker_mm or 0) / self.square_mm <= _MAX_MARKER_RATIO:
            faults.append(
                f"marker_mm: expected {_MIN_MARKER_RATIO:g} to {_MAX_MARKER_RATIO:g} of the square's "
                f"{self.square_mm:g} mm, found {self.marker_mm:g}"
            )
        if not charuco and (self.marker_mm is not None or self.dictionary is not None):
            faults.append(f"marker_mm and dictionary belong to a ChArUco board, and this is a board of {self.kind}")
        if faults:
            message = "the board: " + "; ".join(faults)
            raise CalibrationError(message)

    @property
    def corner_count(self) -> int:
        """Number of corners (circles)."""
        return self.columns * self.rows

    @property
    def points_mm(self) -> FloatArray:
        """(n, 3) float64: every corner (centre of every circle) in the board's frame."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns)
        across = 2 * column + row % 2 if self.kind is BoardKind.CIRCLES else column
        flat = np.column_stack([across, self.aspect * row, np.zeros_like(row)])
        return np.asarray(flat * self.square_mm, dtype=np.float64)

    @property
    def print_mm(self) -> FloatArray:
        """(2, 2) float64: least and greatest (x, y) of the print, in the board's frame."""
        across = 2 * self.columns if self.kind is BoardKind.CIRCLES else self.columns
        return np.array([(-1.0, -1.0), (across, self.rows)]) * self.square_mm * [1.0, self.aspect]

    @property
    def print_size_mm(self) -> tuple[float, float]:
        """Width and height of the print."""
        width_mm, height_mm = (self.print_mm[1] - self.print_mm[0]).tolist()
        return width_mm, height_mm

    @property
    def rulers_mm(self) -> tuple[int, int]:
        """Lengths of the scales that `slrig calibrate board` prints below the board and left of it."""
        width_mm, height_mm = self.print_size_mm
        return _ruler_length_mm(width_mm), _ruler_length_mm(height_mm)

    def as_measured(self, across_mm: float, down_mm: float, /, *, square_sigma: float | None = None) -> Board:
        """The board in its printed size, from readings of the two printed scales from end to end.

        square_sigma : relative standard deviation of the readings; None: that of a steel ruler.

        Raises CalibrationError if a reading deviates from the printed length by more than any printer does.
        """
        faults = [
            f"the scale {where} the board is {printed_mm} mm long in print, read as {read_mm:g} mm"
            for where, printed_mm, read_mm in zip(
                ("below", "left of"), self.rulers_mm, (across_mm, down_mm), strict=True
            )
            if not abs(read_mm / printed_mm - 1) <= _MAX_SCALE_ERROR
        ]
        if faults:
            message = (
                f"{'; '.join(faults)}: read each from its first to its last tick; if it is right, print again at 100 %"
            )
            raise CalibrationError(message)
        width_scale, height_scale = across_mm / self.rulers_mm[0], down_mm / self.rulers_mm[1]
        ruler_sigma = float(np.sqrt(np.mean([(_RULER_SIGMA_MM / printed) ** 2 for printed in self.rulers_mm])))
        return replace(
            self,
            square_mm=self.square_mm * width_scale,
            marker_mm=None if self.marker_mm is None else self.marker_mm * width_scale,
            square_sigma=ruler_sigma if square_sigma is None else square_sigma,
            aspect=height_scale / width_scale,
        )

    @property
    def measured(self) -> bool:
        """True if its size was measured, False if it is that of the print file."""
        return self.square_sigma != PRINT_SIGMA or self.aspect != 1

    @property
    def title(self) -> str:
        """Kind, corners and square size.

        >>> Board(BoardKind.CHESSBOARD, 11, 8, 12.0).title
        'chessboard 11x8, 12 mm'
        """
        return f"{self.kind} {self.columns}x{self.rows}, {self.square_mm:g} mm"

    @property
    def description(self) -> str:
        """Full description, with markers.

        >>> Board(BoardKind.CHARUCO, 11, 8, 12.0).description
        'charuco, 11 x 8 inner corners, squares of 12 mm, markers of 9 mm from DICT_5X5_250'
        """
        if self.kind is BoardKind.CIRCLES:
            return f"circles, {self.columns} in each of {self.rows} rows, rows {self.square_mm:g} mm apart"
        markers = f", markers of {self.marker_mm:g} mm from {self.dictionary}" if self.marker_mm is not None else ""
        return f"{self.kind}, {self.columns} x {self.rows} inner corners, squares of {self.square_mm:g} mm{markers}"


def _ruler_length_mm(space_mm: float) -> int:
    """Length of the scale that fits in a space: whole centimetres from 10 mm on."""
    return min(_MAX_RULER_MM, 10 * math.floor(space_mm / 10)) if space_mm >= 10 else math.floor(space_mm)


DEFAULT_BOARD = Board(BoardKind.CHARUCO, 11, 8, 12.0)
"""12 x 9 squares of 12 mm, which fit on A4 and letter paper with their scales."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """Corners of the board in one camera's image.

    corner : (n,) int32, numbers in ascending order; points_px : (n, 2) float64; sigma_px : (n,) float64, standard
    deviation of a coordinate, from the detector. light_first : the square up and left of corner 0 is light, as in
    ChArUco boards of OpenCV before 4.6 with an even number of rows of squares.
    """

    corner: IntArray
    points_px: FloatArray
    sigma_px: FloatArray
    light_first: bool = False

    @classmethod
    def empty(cls) -> BoardView:
        """A view without corners."""
        return cls(np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0))

    def __post_init__(self) -> None:
        count = len(self.corner)
        if self.points_px.shape != (count, 2) or self.sigma_px.shape != (count,):
            shapes = f"{self.points_px.shape} and {self.sigma_px.shape}"
            message = f"expected points_px ({count}, 2) and sigma_px ({count},) for {count} corners, found {shapes}"
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Projector coordinates of camera pixels on the board, one coordinate each.

    pixels_px : (n, 2) float64, (x, y) in the camera; axis : (n,) uint8, COLUMN or ROW; position_px : (n,) float64, that
    coordinate in the projector; sigma_px : (n,) float64, its standard deviation from noise, projector pixels. A pixel
    with both coordinates appears twice.
    """

    pixels_px: FloatArray
    axis: NDArray[np.uint8]
    position_px: FloatArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        count = len(self.axis)
        if self.pixels_px.shape != (count, 2) or self.position_px.shape != (count,) or self.sigma_px.shape != (count,):
            shapes = f"{self.pixels_px.shape}, {self.position_px.shape} and {self.sigma_px.shape}"
            message = f"expected pixels_px, position_px and sigma_px of length {count}, found {shapes}"
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class ViewQuality:
    """Image quality of the board in one camera and pose. NaN where not measured.

    moved_px : greatest rms displacement of the corners from the first frame; inf where the board is lost.
    saturated : fraction of the board's pixels that are clipped in the white frame.
    contrast : median of white minus black on the board's light squares over full scale; without a projector, light
    squares minus dark ones.
    sharpness_px : standard deviation of the blur across the edges of the squares, camera pixels.
    decoded : fraction of the board's lit pixels that were decoded along both axes; NaN without a projector.
    """

    moved_px: float
    saturated: float
    contrast: float
    sharpness_px: float
    decoded: float


@dataclass(frozen=True, slots=True)
class PoseObservation:
    """One pose of the board. views, correspondences : by camera; the latter are empty without a projector."""

    name: str
    views: Mapping[str, BoardView]
    correspondences: Mapping[str, Correspondences] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Observations:
    """All poses of one board in one rig: the input of a solve. projector : None where none is calibrated.

    The frame of the first camera becomes the world.
    """

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None
    poses: tuple[PoseObservation, ...]
