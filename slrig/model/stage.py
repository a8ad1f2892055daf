"""A stage that turns an object: its axis, and the planes of it that are no part of the object."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slrig.model.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class StageAxis:
    """The axis that a stage turns about, in the calibration's world frame.

    point_mm : (3,), any point of it. direction : (3,), unit; angles count right-handed about it.
    """

    point_mm: FloatArray
    direction: FloatArray


@dataclass(frozen=True, slots=True)
class MeasuredAxis(StageAxis):
    """An axis, and how well it is known.

    covariance : (6, 6) float64, of the point (mm) and of the direction (rad), both across the axis: along it there is
    none.
    """

    covariance: FloatArray

    @property
    def point_sigma_mm(self) -> float:
        """Standard deviation of the point across the axis, rms of both directions."""
        return float(np.sqrt(max(np.trace(self.covariance[:3, :3]), 0.0) / 2))

    @property
    def direction_sigma_rad(self) -> float:
        """The same of the direction."""
        return float(np.sqrt(max(np.trace(self.covariance[3:, 3:]), 0.0) / 2))


class PlaneKind(StrEnum):
    """What a plane is: of the plate that the object stands on, square to the axis, or of anything else behind it."""

    PLATE = "plate"
    BACKDROP = "backdrop"


@dataclass(frozen=True, slots=True)
class StagePlane:
    """A plane of the empty stage, in the calibration's world frame; nothing of the object lies behind it.

    point_mm : (3,), the middle of what was seen of it. normal : (3,), unit, to the side it was seen from. sigma_mm :
    deviation of its surface from it; radius_mm : how far from the middle it was seen. margin_mm : what lies so near
    before it is cut away, too.
    """

    kind: PlaneKind
    point_mm: FloatArray
    normal: FloatArray
    sigma_mm: float
    radius_mm: float
    margin_mm: float
