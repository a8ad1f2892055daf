"""Poses that do not agree with the others: one that is off by itself, or all from one on, because a device moved.

A device that was moved between two poses stands elsewhere in all later ones. With the normal equations of each pose at
hand, one step of Newton's method tells what six more numbers, that device's pose from there on, would take off the sum
of squared residuals:

    gain = bᵀ S⁻¹ b,   S = D - Cᵀ H⁻¹ C,   b = g - Cᵀ H⁻¹ G,

with H and G of all poses, and D, C and g of the later poses by the moved device's pose (a score test, Rao 1948). It is
held against what the same step takes off without them, Gᵀ H⁻¹ G: a robust fit that gives the later poses up stands far
from the least squares of all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.solution import PROJECTOR, device_title
from slrig.calibration.solving.adjustment import Weights, normal_equations, sizes_of
from slrig.calibration.solving.measurements import groups
from slrig.calibration.solving.problem import Fit, Problem
from slrig.calibration.solving.projection import DEVICE
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray

_WITHIN_GROUP = 6.0
_LEAST_AFTER = 2
_BUMP_SHARE = 0.82
_ALIKE_GAIN = 0.9
_TIMES_OTHERS = 2.5
_SPREADS_FROM_OTHERS = 6.0
_LEAST_OFF_PX = 0.05
"""A pose that is off by less harms nothing, and lenses are not modelled better than that."""

_MOST_LEFT_OUT = 1 / 3
_MEDIAN = 0.6745


def refuse_bump(problem: Problem, fit: Fit, free: NDArray[np.bool_], /) -> None:
    """See that no device moved between two poses.

    Raises SolveRefusedError where one did, with its name and the pose from which on it stands elsewhere.
    """
    bump = _bump(problem, fit, free)
    if bump is None:
        return
    devices, pose, share = bump
    first = problem.pose_names[pose]
    before = problem.pose_names[int(np.flatnonzero(problem.used[:pose])[-1])]
    spoken = [device_title(name) for name in devices]
    who = spoken[0] if len(spoken) == 1 else f"one of {' and '.join(spoken)} (or both)"
    message = (
        f"{who} moved between pose '{before}' and pose '{first}': from '{first}' on the board is seen elsewhere than "
        f"the poses before say, and letting it stand elsewhere takes {1 - share:.0%} off the residuals; fasten "
        f"it, and shoot the poses anew, or solve from those before or from those after alone"
    )
    raise SolveRefusedError(message)


def _bump(problem: Problem, fit: Fit, free: NDArray[np.bool_]) -> tuple[list[str], int, float] | None:
    """The move that explains most, or None where none explains enough.

    The devices of which one moved, the number of the first pose after it, and the share of the rms that is left when
    the later poses may have that device elsewhere.
    """
    devices = len(problem.devices)
    used = np.flatnonzero(problem.used)
    if devices < 2 or len(used) < 2 * _LEAST_AFTER:
        return None
    sigma = problem.deviations(fit.noise)
    kept = _within_groups(problem, fit)
    size = sizes_of(fit.residuals, sigma)
    weight = (kept[0] * sigma.corner_weight, kept[1] * sigma.match_weight)
    matrices, gradients, squares = [], [], []
    m = problem.measurements
    for pose in used:
        mask = np.zeros(len(problem.pose_names), dtype=np.bool_)
        mask[pose] = True
        mine = (m.corner_where[:, 1] == pose, m.match_where[:, 1] == pose)
        weights = ((weight[0] / sigma.corners**2)[mine[0]], (weight[1] / sigma.matches**2)[mine[1]])
        matrix, gradient = normal_equations(fit.geometry, m.of_poses(mask), weights)
        matrices.append(matrix)
        gradients.append(gradient)
        told = [own & (w > 0) for own, w in zip(mine, weight, strict=True)]
        squares.append(
            2 * float(np.sum(size[0][told[0]] ** 2 * weight[0][told[0]]))
            + float(np.sum(size[1][told[1]] ** 2 * weight[1][told[1]]))
        )
    every, pulls, square = np.array(matrices), np.array(gradients), np.array(squares)
    total = square.sum() - _taken(every.sum(axis=0), pulls.sum(axis=0), free)
    gains = _gains(every, pulls, free, devices)
    device, after = np.unravel_index(int(np.argmax(gains)), gains.shape)
    best = float(gains[device, after])
    share = float(np.sqrt(max(total - best, 0.0) / total)) if total > 0 else 1.0
    if share > _BUMP_SHARE:
        return None
    # A pose that is off by itself, among the last ones, looks like half a move; without it nothing is left to explain.
    for alone in range(len(used)):
        rest = np.arange(len(used)) != alone
        left = square[rest].sum() - _taken(every[rest].sum(axis=0), pulls[rest].sum(axis=0), free)
        if total - left > best:
            return None
    # Which of several devices explains it as well: of two, either.
    correlated = [name for k, name in enumerate(problem.devices) if gains[k, after] >= _ALIKE_GAIN * best]
    return correlated, int(used[after]), share


def _factored(matrix: FloatArray, free: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], FloatArray, Any] | None:
    """Cholesky's factor of what is free of a matrix, scaled to a unit diagonal; which numbers these are, and the scale.
    None where it is singular.
    """
    free = free & (np.diagonal(matrix) > 0)
    inner = matrix[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diagonal(inner))
    inner = inner * np.outer(scale, scale)
    inner[np.diag_indices_from(inner)] += 1e-12
    try:
        return free, scale, cho_factor(inner)
    except LinAlgError:
        return None


def _taken(matrix: FloatArray, pull: FloatArray, free: NDArray[np.bool_]) -> float:
    """Gᵀ H⁻¹ G: what a step of Newton's method takes off a sum of squares; 0 where that is not told."""
    made = _factored(matrix, free)
    if made is None:
        return 0.0
    free, scale, factor = made
    return float(pull[free] * scale @ cho_solve(factor, pull[free] * scale))


def _gains(matrices: FloatArray, gradients: FloatArray, free: NDArray[np.bool_], devices: int) -> FloatArray:
    """(devices, poses): what a move of a device before a pose takes off the sum of squares; 0 where not told."""
    gains = np.zeros((devices, len(matrices)))
    made = _factored(matrices.sum(axis=0), free)
    if made is None:
        return gains
    free, scale, factor = made
    pull = gradients.sum(axis=0)[free] * scale
    for after in range(_LEAST_AFTER, len(matrices) - _LEAST_AFTER + 1):
        later, pulled = matrices[after:].sum(axis=0), gradients[after:].sum(axis=0)
        for device in range(devices):
            own = np.arange(DEVICE * device + 9, DEVICE * device + DEVICE)
            crossed = later[np.ix_(free, own)] * scale[:, None]
            solved = cho_solve(factor, crossed)
            square = later[np.ix_(own, own)]
            left = square - crossed.T @ solved
            pull_left = pulled[own] - solved.T @ pull
            unit = 1 / np.sqrt(np.maximum(np.diagonal(square), 1e-300))
            values, vectors = np.linalg.eigh(left * np.outer(unit, unit))
            # A move that the poses of the board can follow is none that can be told.
            along = vectors.T @ (pull_left * unit)
            gains[device, after] = float(np.sum(np.where(values > 1e-9, along**2 / np.maximum(values, 1e-9), 0.0)))
    return gains


def _within_groups(problem: Problem, fit: Fit) -> Weights:
    """1 for what is not far off among its own camera and pose, whether or not these are off as a whole; else 0."""
    m = problem.measurements
    kept = (np.zeros(len(m.corner_px)), np.zeros(len(m.match_px)))
    corner = np.hypot(*fit.residuals.corners.T)
    for where, columns, size, into in (
        (m.corner_where, 2, corner, kept[0]),
        (m.match_where, 3, np.abs(fit.residuals.matches), kept[1]),
    ):
        for rows in groups(where, columns=columns):
            here = size[rows]
            if np.isfinite(here).any():
                into[rows] = here <= _WITHIN_GROUP / _MEDIAN * np.nanmedian(here)
    return kept


def worst_pose(problem: Problem, fit: Fit, /) -> tuple[int, str] | None:
    """The pose that lies farthest from what the others say, and the reason in words; None where all agree."""
    names, m = problem.pose_names, problem.measurements
    sigma = problem.deviations(fit.noise)
    size = sizes_of(fit.residuals, sigma)
    pixels = (np.hypot(*fit.residuals.corners.T), np.abs(fit.residuals.matches))
    worst: tuple[float, int, str] | None = None
    for device, name in enumerate(problem.devices):
        beam = problem.beam(device)
        kind = 1 if beam else 0
        pose = m.match_where[:, 1] if beam else m.corner_where[:, 1]
        mine = np.ones(len(pose), dtype=np.bool_) if beam else m.corner_where[:, 0] == device
        median, median_px = np.full(len(names), np.nan), np.full(len(names), np.nan)
        for number in np.unique(pose[mine]):
            rows = mine & (pose == number)
            # Light that misses the board altogether is as far off as can be.
            median[number] = float(np.median(np.nan_to_num(size[kind][rows], nan=1e6)))
            median_px[number] = (
                float(np.nanmedian(pixels[kind][rows])) if np.isfinite(pixels[kind][rows]).any() else np.inf
            )
        if np.isfinite(median).sum() < 3:
            continue
        middle = float(np.nanmedian(median))
        spread = float(np.nanmedian(np.abs(median - middle))) / _MEDIAN
        bound = max(_TIMES_OTHERS * middle, middle + _SPREADS_FROM_OTHERS * spread)
        excess = np.where(median_px >= _LEAST_OFF_PX, np.nan_to_num(median / bound, nan=0.0), 0.0)
        number = int(np.argmax(excess))
        if excess[number] > 1 and (worst is None or excess[number] > worst[0]):
            reason = _reason(name, float(median_px[number]), float(np.nanmedian(median_px)))
            worst = (float(excess[number]), number, reason)
    return None if worst is None else (worst[1], worst[2])


def _reason(device: str, own_px: float, others_px: float) -> str:
    what = "the projector's light lies" if device == PROJECTOR else f"its corners in camera '{device}' lie"
    return (
        f"{what} {own_px:.2f} px from where the other poses put it (the others: {others_px:.2f} px); the board or a "
        "device moved while it was shot, or the board was read wrongly; shoot it again"
    )


def most_left_out(problem: Problem) -> int:
    """How many poses may be left out before it is the set that is wrong."""
    return max(1, int(len(problem.pose_names) * _MOST_LEFT_OUT))
