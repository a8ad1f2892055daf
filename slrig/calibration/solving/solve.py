"""The solve: from observations of a board to devices and their covariance, with checks of consistency."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.board import Board, BoardShape, Observations
from slrig.calibration.solution import CELLS, PROJECTOR, BoardSize, DeviceResiduals, Solution, device_title, scale_mode
from slrig.calibration.solving.adjustment import (
    AdjustmentProblem,
    Fit,
    ShapePrior,
    Weights,
    fit_geometry,
    flat_geometry,
    free_parameters,
    inlier_weights,
    normal_equations,
    normalised_residuals,
    robust_weights,
    solve_positive_definite,
)
from slrig.calibration.solving.covariance import (
    bend_prior,
    candidate_shapes,
    choose_shape,
    estimate_covariance,
    evaluate_held_out,
    inflate_by_held_out,
    make_folds,
    solve_halves,
)
from slrig.calibration.solving.initial import MIN_POSES, estimate_initial_values, estimate_projector
from slrig.calibration.solving.projection import (
    DEVICE,
    MIN_CORNERS,
    POSE,
    Geometry,
    collect_measurements,
    corner_residuals,
    find_groups,
    match_residuals,
    to_board_pose,
    to_pinhole,
)
from slrig.errors import SolveRefusedError
from slrig.model import LENS_TERMS, Calibration, FloatArray, IntArray, Size, calibration_faults

Progress = Callable[[str, float, str], None]
"""Called with the name of the stage, the completed fraction (0 to 1), and a description."""

_MATCHES_PER_VIEW, _TRIAL_MATCHES_PER_VIEW = 3000, 300
"""Maximum number of correspondences of each camera, pose and axis, for the result and for trials."""
_MAX_EXCESS_PX = 3.0
_MEDIAN = 0.6745  # of the absolute value of a standard normal

_GROUP_OUTLIER_SIGMAS = 6.0
_MIN_POSES_EACH_SIDE = 2
_MAX_MOVED_RESIDUAL = 0.82
"""A device moved if letting it move leaves at most this fraction of the rms residual."""
_SIMILAR_GAIN = 0.9

_TIMES_OTHERS = 2.5
_SPREADS_FROM_OTHERS = 6.0
_MIN_CONTRADICTION_PX = 0.05
"""Smaller deviations of a pose are within the accuracy of lens models."""
_MAX_EXCLUDED = 1 / 3

_STRETCH_TOLERANCE = 0.1  # of its own deviation
_MAX_STRETCH_ROUNDS = 4


def solve(
    observations: Observations, /, *, progress: Progress = lambda _stage, _share, _description: None,
    board_shape: BoardShape = BoardShape.AUTO,
) -> Solution:  # fmt: skip
    """Solve for devices, board poses and covariance by one bundle adjustment of all observations.

    The first camera's frame is the world. Every lens has all its terms, with a prior that holds those near 0 that the
    poses do not determine. Poses that contradict the others are left out. board_shape : whether the board may be bent
    and its corners off their nominal positions (`slrig.calibration.solving.covariance`).

    Raises
    ------
    SolveRefusedError
        The poses do not determine a calibration, or contradict one another; the message says which poses to shoot.
    """
    names = list(observations.cameras)
    _refuse_few(observations)
    progress("cameras", 0.0, f"each of {len(names)} cameras from {len(observations.poses)} poses")
    initial = estimate_initial_values(observations)
    measurements = collect_measurements(observations, initial.flipped, matches_per_view=_MATCHES_PER_VIEW)
    visible: NDArray[np.bool_] = np.asarray(np.isfinite(initial.poses).all(axis=1))
    poses = tuple(pose.name for pose in observations.poses)
    invisible = f"no camera saw {MIN_CORNERS} corners of the board or more; shoot it again with the board in view"
    outliers = {name: invisible for name, good in zip(poses, visible, strict=True) if not good}
    everything = AdjustmentProblem((*names,), poses, False, measurements.select_poses(visible))
    corners_only = replace(everything, measurements=everything.measurements.select_poses(visible, matches=False))
    geometry = flat_geometry(observations.board, initial.devices, initial.poses)
    shapes = candidate_shapes(observations.board, board_shape)
    # Fit the stretch first: a stretched print resembles a bent one, and its poses seem to contradict one another.
    fit, stretch = fit_stretch(corners_only, fit_geometry(corners_only, geometry), observations.board)
    if observations.projector is None:
        corners_only, fit = _choose_shape_and_poses(corners_only, fit.geometry, outliers, shapes)
    # With a projector all poses stay until then: its light shows which of two cameras moved.

    problem, sizes = corners_only, dict(observations.cameras)
    if observations.projector is not None:
        progress("projector", 0.15, "the projector, from the light on the board")
        sizes[PROJECTOR] = observations.projector
        matches = everything.measurements.select_poses(corners_only.used)
        problem = replace(everything, devices=(*names, PROJECTOR), with_projector=True, measurements=matches)
        trial = replace(problem, measurements=matches.thin(_TRIAL_MATCHES_PER_VIEW))
        cameras = fit.geometry.devices
        projector = estimate_projector(cameras, fit.geometry.poses, trial.measurements, observations.projector)
        geometry = replace(fit.geometry, devices=np.vstack([cameras, projector]))
        trial, fit = _choose_shape_and_poses(trial, geometry, outliers, shapes)
        problem = replace(problem.exclude_poses(~trial.used), prior=trial.prior)
    return _build_solution(observations, problem, fit, outliers, sizes, board_shape, stretch.value, progress)


def _refuse_few(observations: Observations) -> None:
    if not observations.cameras:
        message = "a calibration needs at least one camera, and there is none"
        raise SolveRefusedError(message)
    if len(observations.poses) < MIN_POSES:
        message = (
            f"a calibration needs at least {MIN_POSES} poses of the board, and there are {len(observations.poses)}; "
            "shoot 15 to 20, tilted differently, all over the image"
        )
        raise SolveRefusedError(message)


def _build_solution(
    observations: Observations, problem: AdjustmentProblem, fit: Fit, outliers: dict[str, str], sizes: dict[str, Size],
    board_shape: BoardShape, initial_stretch: float, progress: Progress,
) -> Solution:  # fmt: skip
    """Final adjustment of all observations, its covariance and residuals."""
    progress("adjustment", 0.5, "devices, poses and light together")
    board = observations.board
    fit = fit_geometry(problem, fit.geometry, correlated=True)
    fit, stretch = fit_stretch(problem, fit, board, initial_stretch, correlated=True)
    refuse_moved_device(problem, fit, free_parameters(problem, fit.geometry))
    progress("held out", 0.7, "residuals at poses held out from the solve")
    held_out_px = _held_out_px(problem, fit)
    progress("covariance", 0.85, "standard deviation of each parameter")
    bend = bend_prior(board, board_shape)
    covariance, bow = estimate_covariance(problem, fit, bend)
    covariance += np.outer(stretch.mode(), stretch.mode())
    devices = {
        name: to_pinhole(row, sizes[name]) for name, row in zip(problem.devices, fit.geometry.devices, strict=True)
    }
    used = [int(number) for number in np.flatnonzero(problem.used)]
    residuals = _device_residuals(problem, fit, sizes, held_out_px)
    in_order = [residuals[name] for name in problem.devices]
    progress("odd and even", 0.9, "half of the poses against the other half")
    calibration = Calibration({name: devices[name] for name in observations.cameras}, devices.get(PROJECTOR))
    _refuse_impossible(calibration)
    size = board_size(board, stretch)
    scale = size.scale_sigma * scale_mode(calibration)
    solution = Solution(
        calibration=calibration,
        # Held-out poses inflate the covariance from the poses, but not that of the scale, which poses do not determine.
        covariance=inflate_by_held_out(covariance, in_order) + np.outer(scale, scale),
        distortion=dict.fromkeys(problem.devices, LENS_TERMS),
        poses={problem.pose_names[number]: to_board_pose(fit.geometry.poses[number]) for number in used},
        outliers=outliers,
        residuals=residuals,
        board_shape_mm=None if problem.prior is None else fit.geometry.shape_mm(),
        bow=bow,
        size=size,
        halves=solve_halves(problem, fit, bend, in_order),
    )
    progress("done", 1.0, f"{len(used)} poses used, {len(outliers)} left out")
    return solution


def _refuse_impossible(calibration: Calibration) -> None:
    faults = calibration_faults(calibration)
    if faults:
        lines = "\n".join(f"  {fault}" for fault in faults)
        message = (
            "the poses lead to numbers that no rig has; shoot poses that reach the corners of every image, tilted "
            f"differently, and check that the board's sizes are in millimetres:\n{lines}"
        )
        raise SolveRefusedError(message)


def _held_out_px(problem: AdjustmentProblem, fit: Fit) -> dict[str, float]:
    """Rms residual of each device at held-out poses; empty if there are too few."""
    trial = replace(problem, measurements=problem.measurements.thin(_TRIAL_MATCHES_PER_VIEW))
    folds = make_folds(trial)
    if not folds:
        return {}
    initial = fit_geometry(trial, fit.geometry, rounds=1, noise=fit.noise)
    inliers = inlier_weights(initial.residuals, trial.deviations(fit.noise))
    evaluated = (problem.measurements, inlier_weights(fit.residuals, problem.deviations(fit.noise)))
    result = evaluate_held_out(trial, initial.geometry, fit.noise, folds, inliers, evaluated=evaluated)
    return dict(result.rms_px)


def _choose_shape_and_poses(
    problem: AdjustmentProblem, geometry: Geometry, outliers: dict[str, str], shapes: Sequence[ShapePrior | None]
) -> tuple[AdjustmentProblem, Fit]:
    """Choose the shape and leave out contradicting poses, in turns: these may have influenced the choice."""
    fit = None if len(shapes) == 1 else fit_geometry(problem, geometry)
    while True:
        if fit is not None:
            problem = replace(problem, prior=choose_shape(problem, fit, shapes))
        before = len(outliers)
        problem, fit = _exclude_contradicting_poses(problem, geometry, outliers)
        if len(shapes) == 1 or len(outliers) == before:
            return problem, fit


def _exclude_contradicting_poses(
    problem: AdjustmentProblem, geometry: Geometry, outliers: dict[str, str]
) -> tuple[AdjustmentProblem, Fit]:
    """Leave out the pose that contradicts the others most, one after another, until none does."""
    while True:
        fit = fit_geometry(problem, geometry)
        refuse_moved_device(problem, fit, free_parameters(problem, fit.geometry))
        worst = find_worst_pose(problem, fit)
        if worst is None:
            _refuse_contradiction(problem, fit)
            return problem, fit
        number, reason = worst
        outliers[problem.pose_names[number]] = reason
        if len(outliers) > max_excluded_poses(problem):
            listed = "; ".join(f"'{name}': {why}" for name, why in outliers.items())
            message = (
                f"{len(outliers)} of {len(problem.pose_names)} poses contradict the others, too many to know which are "
                f"right: {listed}. Check that board and devices do not move and that all poses are of one rig and board"
            )
            raise SolveRefusedError(message)
        mask = np.zeros(len(problem.pose_names), dtype=np.bool_)
        mask[number] = True
        problem, geometry = problem.exclude_poses(mask), fit.geometry
        if int(problem.used.sum()) < MIN_POSES:
            message = f"of {len(problem.pose_names)} poses fewer than {MIN_POSES} agree; shoot 15 to 20"
            raise SolveRefusedError(message)


def max_excluded_poses(problem: AdjustmentProblem) -> int:
    """Maximum number of poses to leave out; with more, the set itself is wrong."""
    return max(1, int(len(problem.pose_names) * _MAX_EXCLUDED))


def _refuse_contradiction(problem: AdjustmentProblem, fit: Fit) -> None:
    """Raise SolveRefusedError if no pose stands out because half of them contradict the other half."""
    for name, noise in zip(problem.devices, fit.noise, strict=True):
        if noise.excess_px > _MAX_EXCESS_PX:
            message = (
                f"the poses contradict one another: the residuals of '{name}' are {noise.excess_px:.0f} px, and a "
                "tenth of a pixel is usual; check that all poses are of this rig and of one board with the given size, "
                "and that board and devices do not move while a pose is shot"
            )
            raise SolveRefusedError(message)


def find_worst_pose(problem: AdjustmentProblem, fit: Fit, /) -> tuple[int, str] | None:
    """Find the pose that contradicts the others most: its number and the reason; None if all agree."""
    names, m = problem.pose_names, problem.measurements
    sizes = normalised_residuals(fit.residuals, problem.deviations(fit.noise))
    sizes_px = (np.hypot(*fit.residuals.corners.T), np.abs(fit.residuals.matches))
    worst: tuple[float, int, str] | None = None
    for device, name in enumerate(problem.devices):
        is_projector = problem.is_projector(device)
        kind = 1 if is_projector else 0
        pose = m.match_where[:, 1] if is_projector else m.corner_where[:, 1]
        own = np.ones(len(pose), dtype=np.bool_) if is_projector else m.corner_where[:, 0] == device
        median, median_px = np.full(len(names), np.nan), np.full(len(names), np.nan)
        for number in np.unique(pose[own]):
            rows = own & (pose == number)
            # Light whose ray misses the board counts as an infinite residual.
            median[number] = float(np.median(np.nan_to_num(sizes[kind][rows], nan=1e6)))
            median_px[number] = (
                float(np.nanmedian(sizes_px[kind][rows])) if np.isfinite(sizes_px[kind][rows]).any() else np.inf
            )
        if np.isfinite(median).sum() < 3:
            continue
        centre = float(np.nanmedian(median))
        spread = float(np.nanmedian(np.abs(median - centre))) / _MEDIAN
        bound = max(_TIMES_OTHERS * centre, centre + _SPREADS_FROM_OTHERS * spread)
        excess = np.where(median_px >= _MIN_CONTRADICTION_PX, np.nan_to_num(median / bound, nan=0.0), 0.0)
        number = int(np.argmax(excess))
        if excess[number] > 1 and (worst is None or excess[number] > worst[0]):
            reason = _contradiction_message(name, float(median_px[number]), float(np.nanmedian(median_px)))
            worst = (float(excess[number]), number, reason)
    return None if worst is None else (worst[1], worst[2])


def _contradiction_message(device: str, own_px: float, others_px: float) -> str:
    subject = "the projector's light is" if device == PROJECTOR else f"its corners in camera '{device}' are"
    return (
        f"{subject} {own_px:.2f} px from where the other poses put it (the others: {others_px:.2f} px); the board or a "
        "device moved while it was shot, or the board was detected wrongly; shoot it again"
    )


def refuse_moved_device(problem: AdjustmentProblem, fit: Fit, free: NDArray[np.bool_], /) -> None:
    """Raise SolveRefusedError if a device moved between two poses, with its name and the first pose after it."""
    moved = _find_moved_device(problem, fit, free)
    if moved is None:
        return
    devices, pose, remaining = moved
    first = problem.pose_names[pose]
    before = problem.pose_names[int(np.flatnonzero(problem.used[:pose])[-1])]
    titles = [device_title(name) for name in devices]
    subject = titles[0] if len(titles) == 1 else f"one of {' and '.join(titles)} (or both)"
    message = (
        f"{subject} moved between pose '{before}' and pose '{first}': a different position from '{first}' on reduces "
        f"the residuals by {1 - remaining:.0%}; fasten it, and shoot the poses again, or solve from the poses before "
        "or from those after alone"
    )
    raise SolveRefusedError(message)


def _find_moved_device(
    problem: AdjustmentProblem, fit: Fit, free: NDArray[np.bool_]
) -> tuple[list[str], int, float] | None:
    """Find the move of one device that explains most of the residuals; None if none explains enough.

    Return the devices of which one moved, the number of the first pose after it, and the fraction of the rms residual
    that remains with the device elsewhere in the later poses.
    """
    devices = len(problem.devices)
    used = np.flatnonzero(problem.used)
    if devices < 2 or len(used) < 2 * _MIN_POSES_EACH_SIDE:
        return None
    sigma = problem.deviations(fit.noise)
    inliers = _inliers_within_groups(problem, fit)
    size = normalised_residuals(fit.residuals, sigma)
    weight = (inliers[0] * sigma.corner_weight, inliers[1] * sigma.match_weight)
    matrices, gradients, squares = [], [], []
    m = problem.measurements
    for pose in used:
        mask = np.zeros(len(problem.pose_names), dtype=np.bool_)
        mask[pose] = True
        of_pose = (m.corner_where[:, 1] == pose, m.match_where[:, 1] == pose)
        weights = ((weight[0] / sigma.corners**2)[of_pose[0]], (weight[1] / sigma.matches**2)[of_pose[1]])
        matrix, gradient = normal_equations(fit.geometry, m.select_poses(mask), weights)
        matrices.append(matrix)
        gradients.append(gradient)
        corners, matches = (rows & (w > 0) for rows, w in zip(of_pose, weight, strict=True))
        squares.append(
            2 * float(np.sum(size[0][corners] ** 2 * weight[0][corners]))
            + float(np.sum(size[1][matches] ** 2 * weight[1][matches]))
        )
    every, pulls, square = np.array(matrices), np.array(gradients), np.array(squares)
    total = square.sum() - _explained_squares(every.sum(axis=0), pulls.sum(axis=0), free)
    gains = _move_gains(every, pulls, free, devices)
    device, after = np.unravel_index(int(np.argmax(gains)), gains.shape)
    best = float(gains[device, after])
    remaining = float(np.sqrt(max(total - best, 0.0) / total)) if total > 0 else 1.0
    if remaining > _MAX_MOVED_RESIDUAL:
        return None
    # A single contradicting pose among the last ones resembles a move; check that leaving it out does not explain as
    # much.
    for excluded in range(len(used)):
        rest = np.arange(len(used)) != excluded
        without = square[rest].sum() - _explained_squares(every[rest].sum(axis=0), pulls[rest].sum(axis=0), free)
        if total - without > best:
            return None
    # Several devices may explain it about equally well: with two devices, either does.
    names = [name for k, name in enumerate(problem.devices) if gains[k, after] >= _SIMILAR_GAIN * best]
    return names, int(used[after]), remaining


def _factor(matrix: FloatArray, free: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], FloatArray, Any] | None:
    """Cholesky factor of the free part of a matrix, with a unit diagonal: which rows it has, the scale, and the factor.
    None if the matrix is singular.
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


def _explained_squares(matrix: FloatArray, pull: FloatArray, free: NDArray[np.bool_]) -> float:
    """Gᵀ H⁻¹ G: reduction of a sum of squares by a Newton step; 0 if H is singular."""
    factored = _factor(matrix, free)
    if factored is None:
        return 0.0
    free, scale, factor = factored
    return float(pull[free] * scale @ cho_solve(factor, pull[free] * scale))


def _move_gains(matrices: FloatArray, gradients: FloatArray, free: NDArray[np.bool_], devices: int) -> FloatArray:
    """(devices, poses): reduction of the sum of squares by a move of a device before a pose; 0 if undetermined."""
    gains = np.zeros((devices, len(matrices)))
    factored = _factor(matrices.sum(axis=0), free)
    if factored is None:
        return gains
    free, scale, factor = factored
    pull = gradients.sum(axis=0)[free] * scale
    for after in range(_MIN_POSES_EACH_SIDE, len(matrices) - _MIN_POSES_EACH_SIDE + 1):
        later, later_pull = matrices[after:].sum(axis=0), gradients[after:].sum(axis=0)
        for device in range(devices):
            own = np.arange(DEVICE * device + 9, DEVICE * device + DEVICE)
            mixed = later[np.ix_(free, own)] * scale[:, None]
            solved = cho_solve(factor, mixed)
            square = later[np.ix_(own, own)]
            reduced = square - mixed.T @ solved
            reduced_pull = later_pull[own] - solved.T @ pull
            unit = 1 / np.sqrt(np.maximum(np.diagonal(square), 1e-300))
            values, vectors = np.linalg.eigh(reduced * np.outer(unit, unit))
            # Leave out moves that the board's poses can follow.
            along = vectors.T @ (reduced_pull * unit)
            gains[device, after] = float(np.sum(np.where(values > 1e-9, along**2 / np.maximum(values, 1e-9), 0.0)))
    return gains


def _inliers_within_groups(problem: AdjustmentProblem, fit: Fit) -> Weights:
    """1 for inliers among the residuals of their own camera and pose, even if those are off as a whole; else 0."""
    m = problem.measurements
    inliers = (np.zeros(len(m.corner_px)), np.zeros(len(m.match_px)))
    corner = np.hypot(*fit.residuals.corners.T)
    for where, columns, size, target in (
        (m.corner_where, 2, corner, inliers[0]),
        (m.match_where, 3, np.abs(fit.residuals.matches), inliers[1]),
    ):
        for rows in find_groups(where, columns=columns):
            own = size[rows]
            if np.isfinite(own).any():
                target[rows] = own <= _GROUP_OUTLIER_SIGMAS / _MEDIAN * np.nanmedian(own)
    return inliers


@dataclass(frozen=True, slots=True)
class StretchEstimate:
    """Stretch of a print: value and standard deviation sigma, relative; by_device : (15 d,) float64, derivative of the
    devices' parameters by it.
    """

    value: float
    sigma: float
    by_device: FloatArray

    def mode(self) -> FloatArray:
        """(15 d,) float64: change of the devices by one standard deviation of the stretch."""
        return self.sigma * self.by_device


def fit_stretch(
    problem: AdjustmentProblem, fit: Fit, board: Board, value: float = 0.0, /, *, correlated: bool = False
) -> tuple[Fit, StretchEstimate]:
    """Estimate the board's stretch and fit the geometry with it. value : stretch of the given fit.

    Each round is one Gauss-Newton step in the stretch and a complete fit of all else.
    """
    sigma = float(np.sqrt(2)) * board.square_sigma
    for _ in range(_MAX_STRETCH_ROUNDS):
        estimate = _estimate_stretch(problem, fit, value, sigma)
        if abs(estimate.value - value) <= _STRETCH_TOLERANCE * estimate.sigma:
            break
        value = estimate.value
        geometry = replace(fit.geometry, points=board.points_mm[:, :2] * [1 + value / 2, 1 - value / 2])
        fit = fit_geometry(problem, geometry, rounds=2, correlated=correlated, noise=fit.noise)
    return fit, replace(estimate, value=value)


def board_size(board: Board, stretch: StretchEstimate, /) -> BoardSize:
    """Relative error of the size of a board with this stretch.

    Width and height each have the standard deviation `square_sigma`, so their mean has 1/√2 of it. If they differ by
    more than that, the print is worse than stated, and the deviation of the mean is half their difference.
    """
    scale = max(board.square_sigma / float(np.sqrt(2)), abs(stretch.value) / 2)
    return BoardSize(scale, stretch.value, stretch.sigma)


def _estimate_stretch(problem: AdjustmentProblem, fit: Fit, value: float, prior_sigma: float) -> StretchEstimate:
    geometry, m, layout = fit.geometry, problem.measurements, fit.geometry.layout
    deviations = problem.deviations(fit.noise)
    weights = robust_weights(fit.residuals, deviations, inlier_weights(fit.residuals, deviations))
    matrix, gradient = normal_equations(geometry, m, weights, prior=problem.prior)
    residual, rows = corner_residuals(geometry, m, jacobian=True)
    corner = m.corner_where[:, 2]
    # Derivatives by the corner's x and y, and so by the stretch.
    by_corner = rows[:, :, DEVICE + POSE : DEVICE + POSE + 2]
    by_stretch = np.einsum("nkc,nc->nk", by_corner, geometry.points[corner] * [0.5, -0.5])
    weight = weights[0]
    column = np.zeros(layout.count)
    for group in find_groups(m.corner_where, columns=2):
        device, pose = m.corner_where[group.start, :2]
        terms = np.einsum("nki,nk,n->i", rows[group], by_stretch[group], weight[group])
        column[DEVICE * device : DEVICE * (device + 1)] += terms[:DEVICE]
        first = layout.first_pose + POSE * pose
        column[first : first + POSE] += terms[DEVICE : DEVICE + POSE]
        column[layout.first_bend :] += terms[DEVICE + POSE + 2 :]
    own = np.einsum("nki,nk,n->ni", by_corner, by_stretch, weight)
    np.add.at(column, layout.first_offset + 2 * corner[:, None] + np.arange(2), own)
    # Eliminate all other parameters.
    free = free_parameters(problem, geometry) & (np.diagonal(matrix) > 0)
    diagonal = np.sqrt(np.diagonal(matrix)[free])
    scaled = matrix[np.ix_(free, free)] / np.outer(diagonal, diagonal)
    by_free = solve_positive_definite(scaled, column[free] / diagonal) / diagonal
    change = np.zeros(layout.count)
    change[free] = -by_free
    information = float(weight @ (by_stretch**2).sum(axis=1)) - float(column[free] @ by_free) + 1 / prior_sigma**2
    pull = float(np.einsum("nk,nk,n->", by_stretch, np.nan_to_num(residual), weight)) - float(gradient[free] @ by_free)
    pull += value / prior_sigma**2
    return StretchEstimate(value - pull / information, 1 / float(np.sqrt(information)), change[: layout.first_pose])


def _device_residuals(
    problem: AdjustmentProblem, fit: Fit, sizes: dict[str, Size], held_out_px: dict[str, float]
) -> dict[str, DeviceResiduals]:
    """Residuals of each device: figures, by pose, and maps over its image."""
    m = problem.measurements
    inliers = inlier_weights(fit.residuals, problem.deviations(fit.noise))
    residuals = {}
    for device, name in enumerate(problem.devices):
        held_out = held_out_px.get(name, np.nan)
        if problem.is_projector(device):
            good = inliers[1] > 0
            vectors = np.full((len(m.match_px), 2), np.nan)
            axis = m.match_where[:, 2]
            vectors[np.arange(len(axis)), axis] = fit.residuals.matches
            pixels = np.column_stack([_predicted_coordinates(problem, fit, 0), _predicted_coordinates(problem, fit, 1)])
            residuals[name] = _summarise(
                problem, pixels, vectors, m.match_sigma**2, m.match_where[:, 1], good, sizes[name], held_out
            )
        else:
            own = m.corner_where[:, 0] == device
            good = inliers[0][own] > 0
            residuals[name] = _summarise(
                problem, m.corner_px[own], fit.residuals.corners[own], 2 * m.corner_sigma[own] ** 2,
                m.corner_where[own, 1], good, sizes[name], held_out,
            )  # fmt: skip
    return residuals


def _predicted_coordinates(problem: AdjustmentProblem, fit: Fit, axis: int) -> FloatArray:
    """(k,) float64: predicted projector coordinate of each lit pixel along one axis."""
    m = problem.measurements
    where = m.match_where.copy()
    where[:, 2] = axis
    from_zero = replace(m, match_where=where, match_px=np.zeros_like(m.match_px))
    return match_residuals(fit.geometry, from_zero, jacobian=False)[0]


def _summarise(
    problem: AdjustmentProblem, pixels: FloatArray, vectors: FloatArray, variance: FloatArray, pose: IntArray,
    good: NDArray[np.bool_], size: Size, held_out_px: float,
) -> DeviceResiduals:  # fmt: skip
    square = np.nansum(vectors**2, axis=1)
    by_pose = {
        problem.pose_names[number]: float(np.sqrt(np.mean(square[good & (pose == number)])))
        for number in np.unique(pose[good])
    }
    rms = np.full((CELLS, CELLS), np.nan)
    mean = np.full((CELLS, CELLS, 2), np.nan)
    count = np.zeros((CELLS, CELLS), dtype=np.int32)
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip((np.nan_to_num(pixels) + 0.5) / extent * CELLS, 0, CELLS - 1).astype(np.int32)
    for y in range(CELLS):
        for x in range(CELLS):
            here = good & (cell[:, 0] == x) & (cell[:, 1] == y)
            count[y, x] = here.sum()
            if count[y, x]:
                rms[y, x] = np.sqrt(np.mean(square[here]))
                for axis in (0, 1):
                    values = vectors[here, axis]
                    if np.isfinite(values).any():
                        mean[y, x, axis] = np.nanmean(values)
    return DeviceResiduals(
        rms_px=float(np.sqrt(np.mean(square[good]))) if good.any() else np.nan,
        stated_rms_px=float(np.sqrt(np.mean(variance[good]))) if good.any() else np.nan,
        held_out_rms_px=held_out_px,
        count=int(good.sum()),
        outlying=int((~good).sum()),
        pose_rms_px=by_pose,
        map_rms_px=rms,
        map_mean_px=mean,
        map_count=count,
    )
