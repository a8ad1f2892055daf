"""The solve: from observations of a board to devices, their covariance, and checks of consistency."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from slrig.calibration.board import Board, BoardShape
from slrig.calibration.observations import Observations
from slrig.calibration.solution import CELLS, PROJECTOR, BoardSize, DeviceResiduals, Solution, device_title, scale_mode
from slrig.calibration.solving.adjustment import (
    Fit,
    Prior,
    Problem,
    Weights,
    corner_terms,
    fitted,
    flat_geometry,
    free_of,
    kept_of,
    match_terms,
    normal_equations,
    sizes_of,
    solved,
    weights_of,
)
from slrig.calibration.solving.held_out import (
    allowing_for,
    bend_of,
    chosen_shape,
    covariance_of,
    folds_of,
    halves_of,
    held_out,
    shapes_of,
)
from slrig.calibration.solving.initial import LEAST_POSES, projector_start, start_of
from slrig.calibration.solving.projection import (
    DEVICE,
    LEAST_CORNERS,
    POSE,
    Geometry,
    groups,
    measured,
    to_board_pose,
    to_pinhole,
)
from slrig.errors import SolveRefusedError
from slrig.model import LENS_TERMS, Calibration, FloatArray, IntArray, Size

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


_SETTLED = 0.1  # of its own deviation
_MOST_TURNS = 4


@dataclass(frozen=True, slots=True)
class Stretch:
    """Of a print: value and deviation sigma, shares; by_device : (15 d,) float64, by how much one unit more of it would
    move the devices.
    """

    value: float
    sigma: float
    by_device: FloatArray

    def mode(self) -> FloatArray:
        """(15 d,) float64: by how much one deviation of it moves the devices."""
        return self.sigma * self.by_device


def stretched(geometry: Geometry, board: Board, stretch: float, /) -> Geometry:
    """The geometry with the corners of a board that is stretched so much."""
    return replace(geometry, points=board.points_mm[:, :2] * [1 + stretch / 2, 1 - stretch / 2])


def with_stretch(
    problem: Problem, fit: Fit, board: Board, value: float = 0.0, /, *, correlated: bool = False
) -> tuple[Fit, Stretch]:
    """The fit with the board stretched as its poses tell, and that stretch. value : the one that the fit has.

    Each round is one step of Gauss and Newton in the stretch and a whole fit of all else.
    """
    sigma = float(np.sqrt(2)) * board.square_sigma
    for _ in range(_MOST_TURNS):
        found = _told(problem, fit, value, sigma)
        if abs(found.value - value) <= _SETTLED * found.sigma:
            break
        value = found.value
        moved = stretched(fit.geometry, board, value)
        fit = fitted(problem, moved, rounds=2, correlated=correlated, noise=fit.noise)
    return fit, replace(found, value=value)


def size_of(board: Board, stretch: Stretch, /) -> BoardSize:
    """What is known of the size of a board whose stretch was found.

    Width and height are each off by `square_sigma`, which leaves their mean 1/√2 of it. Where they differ by more than
    that, the print is worse than was said, and its mean as unsure as half their difference.
    """
    scale = max(board.square_sigma / float(np.sqrt(2)), abs(stretch.value) / 2)
    return BoardSize(scale, stretch.value, stretch.sigma)


def _told(problem: Problem, fit: Fit, value: float, prior_sigma: float) -> Stretch:
    geometry, m, layout = fit.geometry, problem.measurements, fit.geometry.layout
    deviations = problem.deviations(fit.noise)
    weights = weights_of(fit.residuals, deviations, kept_of(fit.residuals, deviations))
    matrix, gradient = normal_equations(geometry, m, weights, prior=problem.prior)
    residual, rows = corner_terms(geometry, m, jacobian=True)
    corner = m.corner_where[:, 2]
    # By the corner's x and y, and so by d.
    by_corner = rows[:, :, DEVICE + POSE : DEVICE + POSE + 2]
    by_stretch = np.einsum("nkc,nc->nk", by_corner, geometry.points[corner] * [0.5, -0.5])
    weight = weights[0]
    column = np.zeros(layout.count)
    for run in groups(m.corner_where, columns=2):
        device, pose = m.corner_where[run.start, :2]
        shares = np.einsum("nki,nk,n->i", rows[run], by_stretch[run], weight[run])
        column[DEVICE * device : DEVICE * (device + 1)] += shares[:DEVICE]
        first = layout.first_pose + POSE * pose
        column[first : first + POSE] += shares[DEVICE : DEVICE + POSE]
        column[layout.first_bend :] += shares[DEVICE + POSE + 2 :]
    own = np.einsum("nki,nk,n->ni", by_corner, by_stretch, weight)
    np.add.at(column, layout.first_offset + 2 * corner[:, None] + np.arange(2), own)
    free = free_of(problem, geometry) & (np.diagonal(matrix) > 0)
    diagonal = np.sqrt(np.diagonal(matrix)[free])
    scaled = matrix[np.ix_(free, free)] / np.outer(diagonal, diagonal)
    by_free = solved(scaled, column[free] / diagonal) / diagonal
    moved = np.zeros(layout.count)
    moved[free] = -by_free
    information = float(weight @ (by_stretch**2).sum(axis=1)) - float(column[free] @ by_free) + 1 / prior_sigma**2
    pull = float(np.einsum("nk,nk,n->", by_stretch, np.nan_to_num(residual), weight)) - float(gradient[free] @ by_free)
    pull += value / prior_sigma**2
    return Stretch(value - pull / information, 1 / float(np.sqrt(information)), moved[: layout.first_pose])


Progress = Callable[[str, float, str], None]
"""Called with the stage's name, the share of the whole that is done (0 to 1), and words for a person."""


_MATCHES_PER_VIEW, _TRIAL_MATCHES_PER_VIEW = 3000, 300
"""At most as many correspondences of each camera, pose and axis, spread over its image, go into the result, and into
what is tried on the way."""
_MOST_EXCESS_PX = 3.0


def solve(
    observations: Observations, /, *, progress: Progress = lambda _stage, _share, _words: None,
    board_shape: BoardShape = BoardShape.AUTO,
) -> Solution:  # fmt: skip
    """Devices, the board's poses, and the covariance, by one bundle adjustment of all that was seen.

    The first camera's frame is the world. Every lens has all its terms, held near 0 as lenses are where the poses tell
    nothing of one; poses that contradict the others are left out, by name. board_shape : whether the board may be bent
    and its corners off their printed places (`slrig.calibration.solving.held_out`).

    Raises
    ------
    SolveRefusedError
        The poses do not determine a calibration, or contradict one another; the words say what to shoot.
    """
    names = list(observations.cameras)
    _refuse_few(observations)
    progress("cameras", 0.0, f"each of {len(names)} cameras from {len(observations.poses)} poses")
    start = start_of(observations)
    measurements = measured(observations, start.flipped, matches_per_view=_MATCHES_PER_VIEW)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(start.poses).all(axis=1))
    poses = tuple(pose.name for pose in observations.poses)
    unseen = f"no camera saw {LEAST_CORNERS} corners of the board or more; shoot it again with the board in view"
    outliers = {name: unseen for name, good in zip(poses, seen, strict=True) if not good}
    everything = Problem((*names,), poses, False, measurements.of_poses(seen))
    corners_only = replace(everything, measurements=everything.measurements.of_poses(seen, matches=False))
    geometry = flat_geometry(observations.board, start.devices, start.poses)
    shapes = shapes_of(observations.board, board_shape)
    # A stretched print would be taken for a bent one, and poses for contradicting.
    fit, stretch = with_stretch(corners_only, fitted(corners_only, geometry), observations.board)
    if observations.projector is None:
        corners_only, fit = _agreeing_in_shape(corners_only, fit.geometry, outliers, shapes)
    # Else light tells which of two cameras moved; until then all poses stay in.

    problem, sizes = corners_only, dict(observations.cameras)
    trial = problem
    if observations.projector is not None:
        progress("projector", 0.15, "the projector, from the light on the board")
        sizes[PROJECTOR] = observations.projector
        matches = everything.measurements.of_poses(corners_only.used)
        problem = replace(everything, devices=(*names, PROJECTOR), with_projector=True, measurements=matches)
        trial = replace(problem, measurements=matches.thinned(_TRIAL_MATCHES_PER_VIEW))
        beam = projector_start(fit.geometry.devices, fit.geometry.poses, trial.measurements, observations.projector)
        joined = replace(fit.geometry, devices=np.vstack([fit.geometry.devices, beam]))
        trial, fit = _agreeing_in_shape(trial, joined, outliers, shapes)
        problem = replace(problem.without(~trial.used), prior=trial.prior)
    return _finished(observations, problem, fit, outliers, sizes, board_shape, stretch.value, progress)


def _finished(
    observations: Observations, problem: Problem, fit: Fit, outliers: dict[str, str], sizes: dict[str, Size],
    board_shape: BoardShape, stretch_before: float, progress: Progress,
) -> Solution:  # fmt: skip
    progress("adjustment", 0.5, "devices, poses and light together")
    board = observations.board
    fit = fitted(problem, fit.geometry, correlated=True)
    fit, stretch = with_stretch(problem, fit, board, stretch_before, correlated=True)
    refuse_bump(problem, fit, free_of(problem, fit.geometry))
    progress("held out", 0.7, "poses that the solve has not seen")
    held = _held_out_px(problem, fit)
    progress("covariance", 0.85, "how well each number is known")
    bend = bend_of(board, board_shape)
    covariance, bow = covariance_of(problem, fit, bend)
    covariance += np.outer(stretch.mode(), stretch.mode())
    devices = {
        name: to_pinhole(row, sizes[name]) for name, row in zip(problem.devices, fit.geometry.devices, strict=True)
    }
    used = [int(number) for number in np.flatnonzero(problem.used)]
    residuals = _residuals(problem, fit, sizes, held)
    left = [residuals[name] for name in problem.devices]
    progress("odd and even", 0.9, "half of the poses against the other half")
    calibration = Calibration({name: devices[name] for name in observations.cameras}, devices.get(PROJECTOR))
    size = size_of(board, stretch)
    scale = size.scale_sigma * scale_mode(calibration)
    solution = Solution(
        calibration=calibration,
        # Of what the poses tell, held-out poses say how much more it is; of the scale no pose says anything.
        covariance=allowing_for(covariance, left) + np.outer(scale, scale),
        distortion=dict.fromkeys(problem.devices, LENS_TERMS),
        poses={problem.pose_names[number]: to_board_pose(fit.geometry.poses[number]) for number in used},
        outliers=outliers,
        residuals=residuals,
        board_shape_mm=None if problem.prior is None else fit.geometry.shape_mm(),
        bow=bow,
        size=size,
        halves=halves_of(problem, fit, bend, left),
    )
    progress("done", 1.0, f"{len(used)} poses used, {len(outliers)} left out")
    return solution


def _held_out_px(problem: Problem, fit: Fit) -> dict[str, float]:
    trial = replace(problem, measurements=problem.measurements.thinned(_TRIAL_MATCHES_PER_VIEW))
    dealt = folds_of(trial)
    if not dealt:
        return {}
    start = fitted(trial, fit.geometry, rounds=1, noise=fit.noise)
    kept = kept_of(start.residuals, trial.deviations(fit.noise))
    counted = kept_of(fit.residuals, problem.deviations(fit.noise))
    judged = (problem.measurements, counted)
    return dict(held_out(trial, start.geometry, fit.noise, dealt, kept, judged=judged).rms_px)


def _agreeing_in_shape(
    problem: Problem, geometry: Geometry, outliers: dict[str, str], shapes: Sequence[Prior | None]
) -> tuple[Problem, Fit]:
    """The same as `_agreeing`, of a board of the shape that held-out poses are best with."""
    fit = None if len(shapes) == 1 else fitted(problem, geometry)
    while True:
        if fit is not None:
            problem = replace(problem, prior=chosen_shape(problem, fit, shapes))
        before = len(outliers)
        problem, fit = _agreeing(problem, geometry, outliers)
        # A pose that contradicts the others may have had its say in the choice.
        if len(shapes) == 1 or len(outliers) == before:
            return problem, fit


def _agreeing(problem: Problem, geometry: Geometry, outliers: dict[str, str]) -> tuple[Problem, Fit]:
    """Leave out one pose after another that contradicts the rest; what is left agrees."""
    while True:
        fit = fitted(problem, geometry)
        refuse_bump(problem, fit, free_of(problem, fit.geometry))
        found = worst_pose(problem, fit)
        if found is None:
            _refuse_contradiction(problem, fit)
            return problem, fit
        number, reason = found
        outliers[problem.pose_names[number]] = reason
        if len(outliers) > most_left_out(problem):
            told = "; ".join(f"'{name}': {why}" for name, why in outliers.items())
            message = (
                f"{len(outliers)} of {len(problem.pose_names)} poses contradict the others, too many for either to be "
                f"believed: {told}. See that board and devices stand still and that all poses are of one rig and board"
            )
            raise SolveRefusedError(message)
        mask = np.zeros(len(problem.pose_names), dtype=np.bool_)
        mask[number] = True
        problem, geometry = problem.without(mask), fit.geometry
        if int(problem.used.sum()) < LEAST_POSES:
            message = f"of {len(problem.pose_names)} poses fewer than {LEAST_POSES} agree; shoot 15 to 20"
            raise SolveRefusedError(message)


def _refuse_contradiction(problem: Problem, fit: Fit) -> None:
    """Where half of the poses contradict the other half, none of them stands out."""
    for name, noise in zip(problem.devices, fit.noise, strict=True):
        if noise.excess_px > _MOST_EXCESS_PX:
            message = (
                f"the poses contradict one another: '{name}' is left with {noise.excess_px:.0f} px on the usual place, "
                "where a tenth of one is usual; see that all poses are of this rig and of one board, of the size that "
                "was given, and that board and devices stand still while a pose is shot"
            )
            raise SolveRefusedError(message)


def _refuse_few(observations: Observations) -> None:
    if not observations.cameras:
        message = "a calibration takes at least one camera, and there is none"
        raise SolveRefusedError(message)
    if len(observations.poses) < LEAST_POSES:
        message = (
            f"a calibration needs {LEAST_POSES} poses of the board at the very least, and there are "
            f"{len(observations.poses)}; shoot 15 to 20, tilted differently, all over the image"
        )
        raise SolveRefusedError(message)


def _residuals(
    problem: Problem, fit: Fit, sizes: dict[str, Size], held_out_px: dict[str, float]
) -> dict[str, DeviceResiduals]:
    """What is left at each device, for people: figures, by pose, and maps over its image."""
    m = problem.measurements
    kept = kept_of(fit.residuals, problem.deviations(fit.noise))
    found = {}
    for device, name in enumerate(problem.devices):
        held = held_out_px.get(name, np.nan)
        if problem.beam(device):
            good = kept[1] > 0
            vectors = np.full((len(m.match_px), 2), np.nan)
            axis = m.match_where[:, 2]
            vectors[np.arange(len(axis)), axis] = fit.residuals.matches
            places = np.column_stack([_shown(problem, fit, 0), _shown(problem, fit, 1)])
            found[name] = _summed(
                problem, places, vectors, m.match_sigma**2, m.match_where[:, 1], good, sizes[name], held
            )
        else:
            mine = m.corner_where[:, 0] == device
            good = kept[0][mine] > 0
            found[name] = _summed(
                problem, m.corner_px[mine], fit.residuals.corners[mine], 2 * m.corner_sigma[mine] ** 2,
                m.corner_where[mine, 1], good, sizes[name], held,
            )  # fmt: skip
    return found


def _shown(problem: Problem, fit: Fit, axis: int) -> FloatArray:
    """(k,) float64: the projector coordinate that each lit pixel should show."""
    m = problem.measurements
    where = m.match_where.copy()
    where[:, 2] = axis
    from_zero = replace(m, match_where=where, match_px=np.zeros_like(m.match_px))
    return match_terms(fit.geometry, from_zero, jacobian=False)[0]


def _summed(
    problem: Problem, places: FloatArray, vectors: FloatArray, variance: FloatArray, pose: IntArray,
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
    cell = np.clip((np.nan_to_num(places) + 0.5) / extent * CELLS, 0, CELLS - 1).astype(np.int32)
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
