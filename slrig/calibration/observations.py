"""What one pose of the board gives a solve: its corners in each camera, and the projector's light on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.model import FloatArray, IntArray, Size

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
