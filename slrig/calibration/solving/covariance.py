"""Poses outside the solve: their residuals, the board's shape, halves of the poses, and the covariance.

The poses are dealt into folds. For each fold all others are adjusted; then the devices are held, the fold's board poses
are fitted to the cameras' corners alone, and all residuals of the fold are taken. All poses are of one board, so that
what its shape takes off the residuals of some poses it takes off those of others, too. A shape is kept when the loss
over all folds falls by more than MARGIN per term, in units of a squared deviation: a useless term lowers it by nothing,
and one that is known to n of its own deviations by about n².

There are three shapes, each a special case of the next: flat and as printed; bent; bent with every corner off its
printed place. Lens and shape can be confused where the board always stands at one place of the image; how far is in the
covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.board import Board, BoardShape
from slrig.calibration.solution import LEAST_HALVED, Bow, DeviceResiduals, Half
from slrig.calibration.solving.adjustment import (
    Deviations,
    DeviceNoise,
    Fit,
    Prior,
    Problem,
    Residuals,
    Weights,
    adjusted,
    deviations_of,
    fitted,
    free_of,
    in_shape,
    kept_of,
    losses_of,
    normal_equations,
    residuals_of,
    weights_of,
)
from slrig.calibration.solving.projection import BEND, DEVICE, Geometry, Measurements, difference
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, IntArray

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


FOLDS = 5
MARGIN = 4.0
"""What a term of a shape must take off the loss at held-out poses, in squared deviations."""
_TRIAL_STEPS = 15
"""Of Levenberg-Marquardt, where a model is only tried."""

LEAST_POSES = 4
"""With fewer poses none can be held out."""

_BEND_SIGMA = 0.01
"""Standard deviation of each number of a board's bend over half its extent: paper glued to a board bends less."""
_OFFSET_SIGMA_MM = 0.2
"""The same of a corner's offset along either axis: what printers and paper are off by within a page."""

_WORTH = (0, BEND, 2 * BEND)
"""How many terms each shape counts as. Offsets are many, and each is held near 0 by what is known of printers."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """At poses that were not seen: rms_px by device (cameras: of the distance; the projector: per coordinate), and loss
    by device, in squared deviations.
    """

    rms_px: Mapping[str, float]
    loss: Mapping[str, float]


def folds_of(problem: Problem) -> list[NDArray[np.bool_]]:
    """(m,) bool per fold: the poses of that fold, each in one; empty where there are too few to hold any out."""
    used = np.flatnonzero(problem.used)
    if len(used) < LEAST_POSES:
        return []
    folds = []
    parts = min(FOLDS, len(used))
    for part in range(parts):
        fold = np.zeros(len(problem.pose_names), dtype=np.bool_)
        fold[used[part::parts]] = True
        folds.append(fold)
    return folds


def held_out(
    problem: Problem, geometry: Geometry, noise: Sequence[DeviceNoise],
    folds: Sequence[NDArray[np.bool_]], kept: Weights, /, *, judged: tuple[Measurements, Weights] | None = None,
) -> HeldOut:  # fmt: skip
    """What is left at held-out poses, over all folds. geometry : the start, for all poses.

    kept : which observations count (`kept_of`). It is to be the same for all models that are compared: none is to gain
    by what it fits worst. judged : observations of the same poses that are judged at, instead of the problem's own.
    """
    trained_on = problem.measurements
    m, judged_kept = judged or (trained_on, kept)
    total = Residuals(np.full_like(m.corner_px, np.nan), np.full_like(m.match_px, np.nan))
    for fold in folds:
        rest = problem.without(fold)
        sigma = rest.deviations(noise)
        corners, matches = fold[trained_on.corner_where[:, 1]], fold[trained_on.match_where[:, 1]]
        trained = adjusted(
            geometry, rest.measurements, free_of(rest, geometry), sigma, prior=problem.prior,
            kept=(kept[0][~corners], kept[1][~matches]),
        )  # fmt: skip
        corners, matches = fold[m.corner_where[:, 1]], fold[m.match_where[:, 1]]
        own = m.of(corners, matches)
        left = residuals_of(_placed(problem, trained.geometry, own, fold, noise, judged_kept[0][corners]), own)
        total.corners[corners], total.matches[matches] = left.corners, left.matches
    sigma = deviations_of(m, noise, problem.with_projector)
    return _summed(problem, m.corner_where[:, 0], total, judged_kept, sigma)


def _placed(
    problem: Problem, geometry: Geometry, own: Measurements, fold: NDArray[np.bool_], noise: Sequence[DeviceNoise],
    kept: FloatArray,
) -> Geometry:  # fmt: skip
    """The fold's board poses, fitted to its corners with the devices held."""
    corners = own.of(np.ones(len(own.corner_px), dtype=np.bool_), np.zeros(len(own.match_px), dtype=np.bool_))
    free = np.zeros(geometry.layout.count, dtype=np.bool_)
    free[geometry.layout.first_pose : geometry.layout.first_offset] = np.repeat(fold, 6)
    sigma = deviations_of(corners, noise, problem.with_projector)
    return adjusted(geometry, corners, free, sigma, kept=(kept, np.zeros(0))).geometry


def _summed(problem: Problem, camera: IntArray, left: Residuals, kept: Weights, sigma: Deviations) -> HeldOut:
    corner_loss, match_loss = losses_of(left, sigma)
    rms, loss = {}, {}
    for device, name in enumerate(problem.devices):
        if problem.beam(device):
            mine = (kept[1] > 0) & np.isfinite(match_loss)
            rms[name] = _rms(left.matches[mine])
            loss[name] = float(np.sum(match_loss[mine]))
        else:
            mine = (camera == device) & (kept[0] > 0) & np.isfinite(corner_loss)
            rms[name] = _rms(np.hypot(*left.corners[mine].T))
            loss[name] = float(np.sum(corner_loss[mine]))
    return HeldOut(rms, loss)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def loss_of(left: Residuals, sigma: Deviations, kept: Weights) -> float:
    """The loss of all that counts, in squared deviations."""
    return sum(float(np.nansum(loss[k > 0])) for loss, k in zip(losses_of(left, sigma), kept, strict=True))


def shapes_of(board: Board, asked: BoardShape) -> tuple[Prior | None, ...]:
    """The shapes that may be chosen, the simplest first; None is flat."""
    bend = bend_of(board, asked)
    if bend is None:
        return (None,)
    bent = (bend, replace(bend, offset_sigma_mm=_OFFSET_SIGMA_MM))
    return bent if asked is BoardShape.BOWED else (None, *bent)


def bend_of(board: Board, asked: BoardShape) -> Prior | None:
    """What is known beforehand of a board's bend; None where a person said that it is flat."""
    if asked is BoardShape.FLAT:
        return None
    return Prior(_BEND_SIGMA * float(np.ptp(board.points_mm[:, :2], axis=0).max()) / 2)


def chosen_shape(problem: Problem, fit: Fit, shapes: Sequence[Prior | None], /) -> Prior | None:
    """The shape that poses are better with by more than MARGIN per term, in squared deviations: both those that it is
    fitted to and those held out. The simplest where none can be held out.

    shapes : the simplest first.
    """
    dealt = folds_of(problem)
    if len(shapes) == 1 or not dealt:
        return shapes[0]
    richest = fitted(replace(problem, prior=shapes[-1]), fit.geometry, rounds=2, correlated=True, noise=fit.noise)
    sigma = problem.deviations(richest.noise)
    kept = kept_of(richest.residuals, sigma)
    losses: list[float] = []
    seen: list[float] = []
    best = 0
    for rung, shape in enumerate(shapes):
        trial = replace(problem, prior=shape)
        start = in_shape(richest.geometry, trial)
        free = free_of(trial, start)
        tried = adjusted(start, problem.measurements, free, sigma, prior=shape, kept=kept, most_steps=_TRIAL_STEPS)
        seen.append(loss_of(tried.residuals, sigma, kept))
        losses.append(sum(held_out(trial, tried.geometry, richest.noise, dealt, kept).loss.values()))
        # Of few poses, those held out lie far from what the others determine, and their loss is a matter of luck: a
        # shape that is there is seen by the poses that it is fitted to as well.
        enough = MARGIN * (_WORTH[rung] - _WORTH[best])
        if min(losses[best] - losses[rung], seen[best] - seen[rung]) > enough:
            best = rung
    return shapes[best]
