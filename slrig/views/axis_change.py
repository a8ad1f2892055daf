"""The axis of a stage from one measurement of it to the next. Loads no kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slrig.model import FloatArray, MeasuredAxis, StageAxis

FAR_MM = 50.0
"""How far from the object's middle, along the axis, a difference of two axes is told."""
MOST_SIGMAS = 5.0
"""Of the distance of two axes in all four of their numbers: as rare (5e-5) as 4 standard deviations in one."""
_DRIFT_MM, _DRIFT_RAD = 0.005, 5e-5
"""What a rig moves against its stage from one model to the next: 1 K over 0.2 m of aluminium, and that over 0.1 m."""


class Noted(NamedTuple):
    """What an axis that was found anew says of the one on record.

    axis : both in one, by their covariances; the one on record where they are too far apart. moved_mm : how far they
    are apart, at most, up to 50 mm either way of the new one's point along it; moved_deg : their angle; sigmas : their
    distance over its deviation, in all four numbers of an axis.
    """

    axis: MeasuredAxis
    moved_mm: float
    moved_deg: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        """Whether they are one axis."""
        return self.sigmas <= MOST_SIGMAS


def noted(record: MeasuredAxis, found: MeasuredAxis) -> Noted:
    """Improve an axis by another measurement of it (Kalman's filter, the axis drifting a little in between)."""
    way = record.direction
    sense = 1.0 if found.direction @ way > 0 else -1.0
    base = record.point_mm + way * (way @ (found.point_mm - record.point_mm))
    across = np.linalg.svd(way[None])[2][1:]
    drift = np.diag([_DRIFT_MM**2] * 2 + [_DRIFT_RAD**2] * 2)
    _, before = _in(StageAxis(base, way), across, record)
    difference, of_found = _in(StageAxis(base, way), across, found)
    before = before + drift
    gain = before @ np.linalg.inv(before + of_found)
    offset, tilt = difference[:2], difference[2:]
    ends = [float(np.linalg.norm(offset + s * tilt)) for s in (-FAR_MM, FAR_MM)]
    sigmas = float(np.sqrt(difference @ np.linalg.solve(before + of_found, difference)))
    axis = record
    if sigmas <= MOST_SIGMAS:
        change = gain @ difference
        direction = way + change[2:] @ across
        known = (np.eye(4) - gain) @ before
        spread = np.kron(np.eye(2), across.T)
        axis = MeasuredAxis(
            base + change[:2] @ across, direction / np.linalg.norm(direction), spread @ known @ spread.T
        )
    angle = np.arccos(np.clip(sense * (found.direction @ way), -1.0, 1.0))
    return Noted(axis, max(ends), float(np.rad2deg(angle)), sigmas)


def _in(base: StageAxis, across: FloatArray, axis: MeasuredAxis) -> tuple[FloatArray, FloatArray]:
    """(4,), (4, 4): where an axis crosses the plane through `base` square to it, along `across` (2, 3), mm, and its
    slopes there; and their covariance.
    """
    slope = axis.direction / (axis.direction @ base.direction)
    along = (base.point_mm - axis.point_mm) @ base.direction
    there = np.kron([[1.0, along], [0.0, 1.0]], across)
    numbers = np.concatenate([across @ (axis.point_mm + along * slope - base.point_mm), across @ slope])
    return numbers, there @ axis.covariance @ there.T
