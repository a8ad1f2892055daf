"""From what was seen of a board to the devices of a rig, and how well each number of them is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import BoardShape
from slrig.calibration.observations import Observations
from slrig.calibration.solution import CELLS, PROJECTOR, DeviceResiduals, Solution, scale_mode
from slrig.calibration.solving.adjustment import Prior, kept_of, match_terms
from slrig.calibration.solving.consistency import most_left_out, refuse_bump, worst_pose
from slrig.calibration.solving.covariance import allowing_for, covariance_of
from slrig.calibration.solving.halves import halves_of
from slrig.calibration.solving.held_out import bend_of, chosen_shape, folds_of, held_out, shapes_of
from slrig.calibration.solving.initial import LEAST_POSES, start_of
from slrig.calibration.solving.initial_projector import projector_start
from slrig.calibration.solving.measurements import LEAST_CORNERS, measured
from slrig.calibration.solving.parameters import Geometry, to_board_pose, to_pinhole
from slrig.calibration.solving.problem import Fit, Problem, fitted, flat_geometry, free_of
from slrig.calibration.solving.stretch import size_of, with_stretch
from slrig.errors import SolveRefusedError
from slrig.model import Calibration, FloatArray, IntArray, Size
from slrig.model.lens import LENS_TERMS

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
