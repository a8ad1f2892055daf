"""The axis of a stage that turns an object."""

from __future__ import annotations

from dataclasses import dataclass

from slrig.model.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class StageAxis:
    """The axis that a stage turns about, in the calibration's world frame.

    point_mm : (3,), any point of it. direction : (3,), unit; angles count right-handed about it.
    """

    point_mm: FloatArray
    direction: FloatArray
