"""Whether two cameras agree where both see the surface; where they do not, what that says of their error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slrig.model import FloatArray
from slrig.reconstruction.merging import MergedCurves
from slrig.reconstruction.redundancy import DEVIATIONS_PER_MEDIAN

FEWEST_POINTS = 100
"""That both have: with fewer they hardly see the same surface."""

MOST_OVER_SIGMA = 3.0
"""Beyond this the deviations that were stated do not explain what was found."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two cameras that contradict each other.

    apart_mm : median distance of their points of one projector ray, along it. over_sigma : their distances over what is
    stated for them, as a standard deviation: 1 for cameras that agree.
    """

    apart_mm: float
    over_sigma: float

    @property
    def sigma_mm(self) -> float:
        """What is to be added to a point's standard deviation, in squares.

        One of the two may be right, and the other off by all of the distance; nothing here tells which.
        """
        return self.apart_mm

    def __str__(self) -> str:
        return (
            f"the cameras contradict each other: they place the surface {self.apart_mm:.3f} mm apart (median), "
            f"{self.over_sigma:.1f} times what is stated for them. The standard deviations were widened by as much; "
            "a camera has moved or the calibration is wrong: verify it (slrig verify), and calibrate again"
        )


def disagreement(merged: MergedCurves, share_mm: FloatArray | None, /) -> Disagreement | None:
    """How far the cameras contradict each other; None where they agree, or hardly see the same.

    share_mm : (n,) float64, the calibration's part of each point's standard deviation, None where it states none.
    """
    apart = np.abs(merged.residual_mm)
    told = (merged.residual_sigma != 0) & np.isfinite(merged.residual_sigma)
    if np.count_nonzero(told) < FEWEST_POINTS:
        return None
    noise = apart[told] / np.abs(merged.residual_sigma[told])
    # Each of the two has the calibration's error.
    share = 0.0 if share_mm is None else 2**0.5 * float(np.median(share_mm))
    over = DEVIATIONS_PER_MEDIAN * float(np.median(apart[told] / np.hypot(noise, share)))
    return Disagreement(float(np.median(apart[told])), over) if over > MOST_OVER_SIGMA else None
