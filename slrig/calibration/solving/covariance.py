"""How well each number of the devices is known: the inverse of the normal equations, poses and shape marginalised.

Weights are those of the last adjustment, deviations those that residuals bear out and that allow for neighbours that
err alike (`slrig.calibration.solving.problem`). The robust weights lose about a tenth of the information of normal
errors where the estimate itself loses a twentieth, so that deviations are rather a few per cent too large than too
small.

The bend of a board that nobody said is flat, and that was left out, was set to 0, not known to be 0. So the covariance
is that of the solve with it, plus the square of the shift by which leaving it out moved the rest: what an estimate is
wrong by is its distance from that solve, and what that solve is wrong by.

Where few poses leave a lens to bend between them, residuals are small at the poses that were seen and large at others,
and a covariance that comes from the former is too small. Poses that were held out tell by how much: `allowing_for`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.solution import Bow, DeviceResiduals
from slrig.calibration.solving.adjustment import Prior, adjusted, kept_of, normal_equations, weights_of
from slrig.calibration.solving.parameters import Geometry, difference
from slrig.calibration.solving.problem import Fit, Problem, free_of
from slrig.calibration.solving.projection import BEND, DEVICE
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray

LEAST_KNOWN = 0.05
"""The greatest deviation of a focal length, over it, with which a calibration still is one."""


def covariance_of(problem: Problem, fit: Fit, bend: Prior | None, /) -> tuple[FloatArray, Bow | None]:
    """Covariance of all devices' parameters, (15 d, 15 d), 0 for the world's pose; and the bow of the board.

    bend : what is known beforehand of the board's bend; None if it is known to be flat, and the bow is None too.

    Raises SolveRefusedError where the poses leave a number open, or a focal length all but open.
    """
    devices, bent = _inverse(problem, fit)
    _refuse_open(problem, fit, devices)
    if problem.prior is not None or bend is None:
        return devices, None if bend is None else _bow_of(fit.geometry, bent, solved=True)
    open_problem, sigma = replace(problem, prior=bend), problem.deviations(fit.noise)
    wide = adjusted(
        fit.geometry, problem.measurements, free_of(open_problem, fit.geometry), sigma, prior=bend,
        kept=kept_of(fit.residuals, sigma),
    )  # fmt: skip
    shift = difference(wide.geometry.devices, fit.geometry.devices).ravel()
    devices, bent = _inverse(open_problem, replace(fit, geometry=wide.geometry, residuals=wide.residuals))
    return devices + np.outer(shift, shift), _bow_of(wide.geometry, bent, solved=False)


def allowing_for(covariance: FloatArray, residuals: Sequence[DeviceResiduals], /) -> FloatArray:
    """The covariance, (15 d, 15 d) float64, with all deviations as many times as large as residuals are larger at
    held-out poses than at those that were seen, of the device where that is most.

    One factor for all: devices err together, and a point by a hundredth of what each of them does. A solve that holds
    no poses out tells nothing of this, and its covariance stays.
    """
    ratios = [left.held_out_rms_px / left.rms_px for left in residuals]
    return covariance * max([1.0, *(ratio for ratio in ratios if np.isfinite(ratio))]) ** 2


def _inverse(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Covariance of the devices, (15 d, 15 d), and of the bend, (7, 7), which is 0 where it is held."""
    sigma = problem.deviations(fit.noise)
    kept = kept_of(fit.residuals, sigma)
    weights = weights_of(fit.residuals, sigma, kept)
    matrix = normal_equations(fit.geometry, problem.measurements, weights, prior=problem.prior)[0]
    # A pose of which everything is outlying has no say, and nothing to say.
    free = free_of(problem, fit.geometry) & (np.diagonal(matrix) > 0)
    matrix = matrix[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diagonal(matrix))
    try:
        factor = cho_factor(matrix * np.outer(scale, scale))
    except LinAlgError as error:
        message = (
            f"the {int(problem.used.sum())} poses leave the calibration open: another one fits them as well; "
            "shoot more, at several distances, tilted by 20° to 40° to all sides"
        )
        raise SolveRefusedError(message) from error
    layout = fit.geometry.layout
    place = np.flatnonzero(free)
    mine = (place < layout.first_pose) | (place >= layout.first_bend)
    unit = np.eye(len(place))[:, mine]
    found = cho_solve(factor, unit)[mine] * np.outer(scale[mine], scale[mine])
    # Devices first, then the bend: poses and offsets lie between them.
    into = np.where(place < layout.first_pose, place, place - layout.first_bend + layout.first_pose)[mine]
    covariance = np.zeros((layout.first_pose + BEND,) * 2)
    covariance[np.ix_(into, into)] = (found + found.T) / 2
    return covariance[: layout.first_pose, : layout.first_pose], covariance[layout.first_pose :, layout.first_pose :]


def _refuse_open(problem: Problem, fit: Fit, covariance: FloatArray) -> None:
    for device, name in enumerate(problem.devices):
        for axis in (0, 1):
            focal = fit.geometry.devices[device, axis]
            sigma = float(np.sqrt(covariance[DEVICE * device + axis, DEVICE * device + axis]))
            if not sigma <= LEAST_KNOWN * focal:
                message = (
                    f"'{name}': the {int(problem.used.sum())} poses determine its focal length to {sigma / focal:.0%} "
                    f"only; {LEAST_KNOWN:.0%} is the most that is of use: shoot more poses, tilted by 20° to 40° to "
                    "the left, to the right, up and down"
                )
                raise SolveRefusedError(message)


def _bow_of(geometry: Geometry, covariance: FloatArray, /, *, solved: bool) -> Bow:
    """How far the corners lie out of the plane that fits them best: from the lowest to the highest.

    covariance : (7, 7) float64, of the bend, mm².
    """
    basis = geometry.bend_basis()
    plane = np.column_stack([np.ones(len(basis)), geometry.points - geometry.frame[:2]])
    basis = basis - plane @ np.linalg.lstsq(plane, basis, rcond=None)[0]
    height = basis @ geometry.bend
    across = basis[int(np.argmax(height))] - basis[int(np.argmin(height))]
    return Bow(float(np.ptp(height)), float(np.sqrt(max(across @ covariance @ across, 0.0))), solved)
