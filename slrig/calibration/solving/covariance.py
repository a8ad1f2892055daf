"""Covariance of a solve, shape of the board, halves of the poses, and residuals at held-out poses.

Cross-validation divides the poses into folds. For each fold all other poses are adjusted; then the devices are held,
the fold's board poses are fitted to the cameras' corners alone, and all residuals of the fold are taken. A shape is
accepted if the loss over all folds falls by more than MARGIN per term, in squared deviations: a useless term does not
lower it, and a term that is known to n of its own deviations lowers it by about n².

There are three shapes, each a special case of the next: flat with nominal corners; bent; bent with an offset of each
corner. Lens and shape can be confused if the board is always at one place of the image; the covariance includes that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.board import Board, BoardShape
from slrig.calibration.solution import MIN_HALVED_POSES, Bow, DeviceResiduals, HalfSolution
from slrig.calibration.solving.adjustment import (
    AdjustmentProblem,
    Deviations,
    DeviceNoise,
    Fit,
    Residuals,
    ShapePrior,
    Weights,
    adjust,
    clear_unsolved_shape,
    compute_residuals,
    fit_geometry,
    free_parameters,
    inlier_weights,
    normal_equations,
    observation_deviations,
    robust_losses,
    robust_weights,
)
from slrig.calibration.solving.projection import BEND, DEVICE, Geometry, Measurements, device_difference
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, IntArray

MAX_FOCAL_DEVIATION = 0.05
"""Maximum standard deviation of a focal length, relative to it."""

FOLDS = 5
MARGIN = 4.0
"""Reduction of the loss at held-out poses that a term of a shape must bring, in squared deviations."""
_TRIAL_STEPS = 15
"""Maximum number of Levenberg-Marquardt steps for trying a shape."""

MIN_FOLDED_POSES = 4
"""With fewer poses none are held out."""

_BEND_SIGMA = 0.01
"""Prior standard deviation of each coefficient of the bend, relative to half the board's extent."""
_OFFSET_SIGMA_MM = 0.2
"""Prior standard deviation of a corner's offset along either axis, from the accuracy of printers and paper."""

_TERM_COUNTS = (0, BEND, 2 * BEND)
"""Number of terms that each shape counts as. Offsets are many, and their prior holds each near 0."""

_MATCHES_PER_VIEW = 1000
"""For halves: a third of those of the full solve. Neighbours err alike, so the covariance grows little."""
_HALF_ROUNDS = 2


def estimate_covariance(
    problem: AdjustmentProblem, fit: Fit, bend: ShapePrior | None, /
) -> tuple[FloatArray, Bow | None]:
    """Covariance of all devices' parameters, (15 d, 15 d), 0 for the world's pose; and the bow of the board.

    bend : prior of the board's bend; None for a board declared flat, whose bow is None.

    Raises SolveRefusedError if the poses leave a parameter undetermined, or determine a focal length too poorly.
    """
    devices, bend_covariance = _invert_normal_equations(problem, fit)
    _refuse_undetermined(problem, fit, devices)
    if problem.prior is not None or bend is None:
        return devices, None if bend is None else _estimate_bow(fit.geometry, bend_covariance, solved=True)
    # The board was solved as flat: add the uncertainty of its bend, and the change of the devices with a bent board.
    bent_problem, sigma = replace(problem, prior=bend), problem.deviations(fit.noise)
    bent = adjust(
        fit.geometry, problem.measurements, free_parameters(bent_problem, fit.geometry), sigma, prior=bend,
        inliers=inlier_weights(fit.residuals, sigma),
    )  # fmt: skip
    shift = device_difference(bent.geometry.devices, fit.geometry.devices).ravel()
    bent_fit = replace(fit, geometry=bent.geometry, residuals=bent.residuals)
    devices, bend_covariance = _invert_normal_equations(bent_problem, bent_fit)
    return devices + np.outer(shift, shift), _estimate_bow(bent.geometry, bend_covariance, solved=False)


def inflate_by_held_out(covariance: FloatArray, residuals: Sequence[DeviceResiduals], /) -> FloatArray:
    """Scale the covariance (15 d, 15 d) by the largest ratio, squared, of held-out to own rms residuals of a device.

    One factor for all: errors of devices are correlated, and a point's error is about a hundredth of theirs. Without
    held-out poses the covariance stays.
    """
    ratios = [each.held_out_rms_px / each.rms_px for each in residuals]
    return covariance * max([1.0, *(ratio for ratio in ratios if np.isfinite(ratio))]) ** 2


def _invert_normal_equations(problem: AdjustmentProblem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Covariance of the devices, (15 d, 15 d), and of the bend, (7, 7), which is 0 if it is not solved for."""
    sigma = problem.deviations(fit.noise)
    inliers = inlier_weights(fit.residuals, sigma)
    weights = robust_weights(fit.residuals, sigma, inliers)
    matrix = normal_equations(fit.geometry, problem.measurements, weights, prior=problem.prior)[0]
    # The diagonal of a pose without inliers is 0.
    free = free_parameters(problem, fit.geometry) & (np.diagonal(matrix) > 0)
    matrix = matrix[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diagonal(matrix))
    try:
        factor = cho_factor(matrix * np.outer(scale, scale))
    except LinAlgError as error:
        message = (
            f"the {int(problem.used.sum())} poses leave the calibration open: other parameters fit them as well; "
            "shoot more poses, at several distances, tilted by 20° to 40° to all sides"
        )
        raise SolveRefusedError(message) from error
    layout = fit.geometry.layout
    index = np.flatnonzero(free)
    # Devices first, then the bend: poses and offsets are between them in the parameter vector.
    chosen = (index < layout.first_pose) | (index >= layout.first_bend)
    unit = np.eye(len(index))[:, chosen]
    inverse = cho_solve(factor, unit)[chosen] * np.outer(scale[chosen], scale[chosen])
    target = np.where(index < layout.first_pose, index, index - layout.first_bend + layout.first_pose)[chosen]
    covariance = np.zeros((layout.first_pose + BEND,) * 2)
    covariance[np.ix_(target, target)] = (inverse + inverse.T) / 2
    return covariance[: layout.first_pose, : layout.first_pose], covariance[layout.first_pose :, layout.first_pose :]


def _refuse_undetermined(problem: AdjustmentProblem, fit: Fit, covariance: FloatArray) -> None:
    """Raise SolveRefusedError if the poses determine a focal length too poorly."""
    for device, name in enumerate(problem.devices):
        for axis in (0, 1):
            focal = fit.geometry.devices[device, axis]
            sigma = float(np.sqrt(covariance[DEVICE * device + axis, DEVICE * device + axis]))
            if not sigma <= MAX_FOCAL_DEVIATION * focal:
                message = (
                    f"'{name}': the {int(problem.used.sum())} poses determine its focal length to {sigma / focal:.0%} "
                    f"only, and at most {MAX_FOCAL_DEVIATION:.0%} are allowed: shoot more poses, tilted by 20° to 40° "
                    "to the left, to the right, up and down"
                )
                raise SolveRefusedError(message)


def _estimate_bow(geometry: Geometry, covariance: FloatArray, /, *, solved: bool) -> Bow:
    """Distance from the lowest to the highest corner, measured from the plane that fits all corners.

    covariance : (7, 7) float64, of the bend, mm².
    """
    basis = geometry.bend_basis()
    plane = np.column_stack([np.ones(len(basis)), geometry.points - geometry.frame[:2]])
    basis = basis - plane @ np.linalg.lstsq(plane, basis, rcond=None)[0]
    height = basis @ geometry.bend
    extremes = basis[int(np.argmax(height))] - basis[int(np.argmin(height))]
    return Bow(float(np.ptp(height)), float(np.sqrt(max(extremes @ covariance @ extremes, 0.0))), solved)


def solve_halves(
    problem: AdjustmentProblem, fit: Fit, bend: ShapePrior | None, residuals: Sequence[DeviceResiduals], /
) -> tuple[HalfSolution, ...]:
    """Solve the odd and the even used poses separately.

    problem, fit, residuals : of the full solve. bend : see `estimate_covariance`. Empty if there are fewer than
    `MIN_HALVED_POSES` poses, or one half leaves a parameter undetermined.
    """
    used = np.flatnonzero(problem.used)
    if len(used) < MIN_HALVED_POSES:
        return ()
    thinned = replace(problem, measurements=problem.measurements.thin(_MATCHES_PER_VIEW))
    halves = []
    for first in (0, 1):
        others = np.zeros(len(problem.pose_names), dtype=np.bool_)
        others[used[1 - first :: 2]] = True
        half = thinned.exclude_poses(others)
        try:
            half_fit = fit_geometry(half, fit.geometry, rounds=_HALF_ROUNDS, correlated=True, noise=fit.noise)
            covariance, _ = estimate_covariance(half, half_fit, bend)
        except SolveRefusedError:
            return ()
        names = tuple(problem.pose_names[number] for number in used[first::2])
        change = device_difference(half_fit.geometry.devices, fit.geometry.devices).ravel()
        halves.append(HalfSolution(names, change, inflate_by_held_out(covariance, residuals)))
    return tuple(halves)


@dataclass(frozen=True, slots=True)
class HeldOutResiduals:
    """Residuals at held-out poses, by device. rms_px : cameras of the distance, the projector per coordinate; loss : in
    squared deviations.
    """

    rms_px: Mapping[str, float]
    loss: Mapping[str, float]


def make_folds(problem: AdjustmentProblem) -> list[NDArray[np.bool_]]:
    """Divide the poses into folds, (m,) bool each; empty if there are too few to hold any out."""
    used = np.flatnonzero(problem.used)
    if len(used) < MIN_FOLDED_POSES:
        return []
    folds = []
    count = min(FOLDS, len(used))
    for number in range(count):
        fold = np.zeros(len(problem.pose_names), dtype=np.bool_)
        fold[used[number::count]] = True
        folds.append(fold)
    return folds


def evaluate_held_out(
    problem: AdjustmentProblem, geometry: Geometry, noise: Sequence[DeviceNoise], folds: Sequence[NDArray[np.bool_]],
    inliers: Weights, /, *, evaluated: tuple[Measurements, Weights] | None = None,
) -> HeldOutResiduals:  # fmt: skip
    """Residuals at held-out poses over all folds. geometry : initial values for all poses.

    inliers : observations that count (`inlier_weights`), the same for all models that are compared, so that none gains
    by excluding its worst residuals. evaluated : observations of the same poses at which residuals are taken; the
    problem's own by default.
    """
    training = problem.measurements
    m, evaluated_inliers = evaluated or (training, inliers)
    total = Residuals(np.full_like(m.corner_px, np.nan), np.full_like(m.match_px, np.nan))
    for fold in folds:
        rest = problem.exclude_poses(fold)
        sigma = rest.deviations(noise)
        corners, matches = fold[training.corner_where[:, 1]], fold[training.match_where[:, 1]]
        trained = adjust(
            geometry, rest.measurements, free_parameters(rest, geometry), sigma, prior=problem.prior,
            inliers=(inliers[0][~corners], inliers[1][~matches]),
        )  # fmt: skip
        corners, matches = fold[m.corner_where[:, 1]], fold[m.match_where[:, 1]]
        own = m.select(corners, matches)
        posed = _fit_fold_poses(problem, trained.geometry, own, fold, noise, evaluated_inliers[0][corners])
        residuals = compute_residuals(posed, own)
        total.corners[corners], total.matches[matches] = residuals.corners, residuals.matches
    sigma = observation_deviations(m, noise, problem.with_projector)
    return _summarise(problem, m.corner_where[:, 0], total, evaluated_inliers, sigma)


def _fit_fold_poses(
    problem: AdjustmentProblem, geometry: Geometry, own: Measurements, fold: NDArray[np.bool_],
    noise: Sequence[DeviceNoise], inliers: FloatArray,
) -> Geometry:  # fmt: skip
    """Fit the fold's board poses to its corners, with the devices held."""
    corners = own.select(np.ones(len(own.corner_px), dtype=np.bool_), np.zeros(len(own.match_px), dtype=np.bool_))
    free = np.zeros(geometry.layout.count, dtype=np.bool_)
    free[geometry.layout.first_pose : geometry.layout.first_offset] = np.repeat(fold, 6)
    sigma = observation_deviations(corners, noise, problem.with_projector)
    return adjust(geometry, corners, free, sigma, inliers=(inliers, np.zeros(0))).geometry


def _summarise(
    problem: AdjustmentProblem, camera: IntArray, residuals: Residuals, inliers: Weights, sigma: Deviations
) -> HeldOutResiduals:
    corner_loss, match_loss = robust_losses(residuals, sigma)
    rms, loss = {}, {}
    for device, name in enumerate(problem.devices):
        if problem.is_projector(device):
            own = (inliers[1] > 0) & np.isfinite(match_loss)
            rms[name] = _rms(residuals.matches[own])
            loss[name] = float(np.sum(match_loss[own]))
        else:
            own = (camera == device) & (inliers[0] > 0) & np.isfinite(corner_loss)
            rms[name] = _rms(np.hypot(*residuals.corners[own].T))
            loss[name] = float(np.sum(corner_loss[own]))
    return HeldOutResiduals(rms, loss)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def total_loss(residuals: Residuals, sigma: Deviations, inliers: Weights) -> float:
    """Loss of all inliers, in squared deviations."""
    losses = robust_losses(residuals, sigma)
    return sum(float(np.nansum(loss[own > 0])) for loss, own in zip(losses, inliers, strict=True))


def candidate_shapes(board: Board, requested: BoardShape) -> tuple[ShapePrior | None, ...]:
    """Shapes to choose from, the simplest first; None is flat."""
    bend = bend_prior(board, requested)
    if bend is None:
        return (None,)
    bent = (bend, replace(bend, offset_sigma_mm=_OFFSET_SIGMA_MM))
    return bent if requested is BoardShape.BOWED else (None, *bent)


def bend_prior(board: Board, requested: BoardShape) -> ShapePrior | None:
    """Prior of a board's bend; None if the board was declared flat."""
    if requested is BoardShape.FLAT:
        return None
    return ShapePrior(_BEND_SIGMA * float(np.ptp(board.points_mm[:, :2], axis=0).max()) / 2)


def choose_shape(problem: AdjustmentProblem, fit: Fit, shapes: Sequence[ShapePrior | None], /) -> ShapePrior | None:
    """Choose the shape that lowers the loss by more than MARGIN per term at both fitted and held-out poses.

    shapes : the simplest first; it is the choice if no poses can be held out.
    """
    folds = make_folds(problem)
    if len(shapes) == 1 or not folds:
        return shapes[0]
    richest = fit_geometry(replace(problem, prior=shapes[-1]), fit.geometry, rounds=2, correlated=True, noise=fit.noise)
    sigma = problem.deviations(richest.noise)
    inliers = inlier_weights(richest.residuals, sigma)
    held_out: list[float] = []
    fitted: list[float] = []
    best = 0
    for number, shape in enumerate(shapes):
        trial = replace(problem, prior=shape)
        start = clear_unsolved_shape(richest.geometry, trial)
        free = free_parameters(trial, start)
        adjusted = adjust(
            start, problem.measurements, free, sigma, prior=shape, inliers=inliers, max_steps=_TRIAL_STEPS
        )
        fitted.append(total_loss(adjusted.residuals, sigma, inliers))
        result = evaluate_held_out(trial, adjusted.geometry, richest.noise, folds, inliers)
        held_out.append(sum(result.loss.values()))
        # With few poses, the others determine those held out poorly, and their loss is a matter of chance. A
        # real shape also lowers the loss at the poses that it is fitted to.
        margin = MARGIN * (_TERM_COUNTS[number] - _TERM_COUNTS[best])
        if min(held_out[best] - held_out[number], fitted[best] - fitted[number]) > margin:
            best = number
    return shapes[best]
