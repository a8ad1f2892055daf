"""The odd and the even poses of a solve, each adjusted apart, from which a person sees what an error is worth.

Both halves have the board's shape and the outlying poses of the whole solve, whose result they start
from: what is compared is the numbers, not the choices. Neither sees an observation of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slrig.calibration.solution import LEAST_HALVED, DeviceResiduals, Half
from slrig.calibration.solving.adjustment import Prior
from slrig.calibration.solving.covariance import allowing_for, covariance_of
from slrig.calibration.solving.parameters import difference
from slrig.calibration.solving.problem import Fit, Problem, fitted
from slrig.errors import SolveRefusedError

_MATCHES_PER_VIEW = 1000
"""A third of those of the whole solve, at a third of the time, make a half 3 % less sure: neighbours err alike."""
_ROUNDS = 2


def halves_of(
    problem: Problem, fit: Fit, bend: Prior | None, residuals: Sequence[DeviceResiduals], /
) -> tuple[Half, ...]:
    """The odd poses and the even ones, counted in order among those that were used.

    problem, fit, residuals : of the whole solve. bend : as `covariance_of` takes it. Empty where there are fewer
    than `LEAST_HALVED` poses, or one half alone leaves a number open.
    """
    used = np.flatnonzero(problem.used)
    if len(used) < LEAST_HALVED:
        return ()
    thin = replace(problem, measurements=problem.measurements.thinned(_MATCHES_PER_VIEW))
    found = []
    for first in (0, 1):
        others = np.zeros(len(problem.pose_names), dtype=np.bool_)
        others[used[1 - first :: 2]] = True
        half = thin.without(others)
        try:
            part = fitted(half, fit.geometry, rounds=_ROUNDS, correlated=True, noise=fit.noise)
            covariance, _ = covariance_of(half, part, bend)
        except SolveRefusedError:
            return ()
        names = tuple(problem.pose_names[number] for number in used[first::2])
        change = difference(part.geometry.devices, fit.geometry.devices).ravel()
        found.append(Half(names, change, allowing_for(covariance, residuals)))
    return tuple(found)
