"""From the poses of a board to a calibration with its error and its verdict: where the rooms of calibration meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slrig.calibration.figures import ViewFigures
from slrig.calibration.observations import PoseObservation
from slrig.calibration.solution import ExpectedError, Solution
from slrig.model import Calibration


@dataclass(frozen=True, slots=True)
class ReadPose:
    """One pose, as it was read: its observation, and how well each camera saw it."""

    observation: PoseObservation
    figures: Mapping[str, ViewFigures]


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A solved calibration with all that is told of it. `calibration` carries its own error (`solved`)."""

    solution: Solution
    calibration: Calibration
    expected: ExpectedError
