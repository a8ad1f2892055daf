"""From what was seen of a board to the devices of a rig, and how well each number of them is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import BoardShape
from slrig.calibration.observations import Observations
from slrig.calibration.solution import PROJECTOR, Solution
from slrig.calibration.solving.adjustment import Prior, kept_of
from slrig.calibration.solving.consistency import most_left_out, refuse_bump, worst_pose
from slrig.calibration.solving.covariance import allowing_for, covariance_of
from slrig.calibration.solving.deviations import deviations_of
from slrig.calibration.solving.held_out import LADDER, chosen_terms, folds_of, held_out
from slrig.calibration.solving.held_out import LEAST_POSES as LEAST_HELD_OUT
from slrig.calibration.solving.initial import LEAST_POSES, start_of
from slrig.calibration.solving.initial_projector import projector_start
from slrig.calibration.solving.leftovers import residuals_of_devices
from slrig.calibration.solving.measurements import LEAST_CORNERS, measured
from slrig.calibration.solving.parameters import Geometry, to_board_pose, to_pinhole
from slrig.calibration.solving.problem import Fit, Problem, Terms, fitted, flat_geometry, free_of
from slrig.calibration.solving.shape import bend_of, chosen_shape, shapes_of
from slrig.errors import SolveRefusedError
from slrig.model import Calibration, Size

Progress = Callable[[str, float, str], None]
"""Called with the stage's name, the share of the whole that is done (0 to 1), and words for a person."""


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """matches_per_view, trial_matches_per_view : at most as many correspondences of each camera, pose and axis, spread
    over its image, go into the result, and into what is tried on the way. folds : of held-out poses. margin : what a
    lens term must take off the loss at held-out poses, in squared deviations (`slrig.calibration.solving.held_out`).
    board_shape : whether the board may be bent and its corners off their printed places
    (`slrig.calibration.solving.shape`).
    """

    matches_per_view: int = 3000
    trial_matches_per_view: int = 300
    folds: int = 5
    margin: float = 4.0
    board_shape: BoardShape = BoardShape.AUTO


_DEFAULT = SolveOptions()
_MOST_EXCESS_PX = 3.0


def _silent(stage: str, share: float, words: str) -> None:
    del stage, share, words


def solve(observations: Observations, /, *, progress: Progress = _silent, options: SolveOptions = _DEFAULT) -> Solution:
    """Devices, the board's poses, and the covariance, by one bundle adjustment of all that was seen.

    The first camera's frame is the world. With enough poses the lens terms of each device are those that held-out poses
    are better with; poses that contradict the others are left out, by name.

    Raises
    ------
    SolveRefusedError
        The poses do not determine a calibration, or contradict one another; the words say what to shoot.
    """
    names = list(observations.cameras)
    _refuse_few(observations)
    progress("cameras", 0.0, f"each of {len(names)} cameras from {len(observations.poses)} poses")
    start = start_of(observations)
    measurements = measured(observations, start.flipped, matches_per_view=options.matches_per_view)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(start.poses).all(axis=1))
    poses = tuple(pose.name for pose in observations.poses)
    outliers = {name: _unseen() for name, good in zip(poses, seen, strict=True) if not good}
    everything = Problem((*names,), poses, False, measurements.of_poses(seen))
    corners_only = replace(everything, measurements=everything.measurements.of_poses(seen, matches=False))
    # Poses are compared under a lens that can be right: with one that cannot, those at the image's border are off.
    terms = dict.fromkeys([*names, PROJECTOR], LADDER[-2] if int(seen.sum()) >= LEAST_HELD_OUT else LADDER[1])
    geometry = flat_geometry(observations.board, start.devices, start.poses)
    shapes = shapes_of(observations.board, options.board_shape)
    if observations.projector is None:
        corners_only, fit = _agreeing_in_shape(corners_only, geometry, terms, outliers, shapes, options)
    else:
        # Light tells which of two cameras moved; until then all poses stay in.
        fit = fitted(corners_only, geometry, terms)

    problem, sizes = corners_only, dict(observations.cameras)
    trial = problem
    if observations.projector is not None:
        progress("projector", 0.15, "the projector, from the light on the board")
        sizes[PROJECTOR] = observations.projector
        matches = everything.measurements.of_poses(corners_only.used)
        problem = replace(everything, devices=(*names, PROJECTOR), with_projector=True, measurements=matches)
        trial = replace(problem, measurements=matches.thinned(options.trial_matches_per_view))
        beam = projector_start(fit.geometry.devices, fit.geometry.poses, trial.measurements, observations.projector)
        joined = replace(fit.geometry, devices=np.vstack([fit.geometry.devices, beam]))
        trial, fit = _agreeing_in_shape(trial, joined, terms, outliers, shapes, options)
        problem = replace(problem.without(~trial.used), prior=trial.prior)

    def tell(device: str, rung: int) -> None:
        done = (trial.devices.index(device) + rung / len(LADDER)) / len(trial.devices)
        words = f"which lens terms {device!r} is better with at held-out poses ({rung + 1}/{len(LADDER)})"
        progress("lenses", 0.25 + 0.45 * done, words)

    chosen = chosen_terms(trial, fit, margin=options.margin, folds=options.folds, tell=tell)
    return _finished(observations, problem, fit, chosen, outliers, sizes, options, progress)


def _finished(
    observations: Observations, problem: Problem, fit: Fit, terms: Terms, outliers: dict[str, str],
    sizes: dict[str, Size], options: SolveOptions, progress: Progress,
) -> Solution:  # fmt: skip
    progress("adjustment", 0.7, "devices, poses and light together")
    fit = fitted(problem, fit.geometry, terms, correlated=True)
    refuse_bump(problem, fit, free_of(problem, fit.geometry, terms))
    progress("held out", 0.85, "poses that the solve has not seen")
    held = _held_out_px(problem, fit, terms, options)
    progress("covariance", 0.95, "how well each number is known")
    known = covariance_of(problem, fit, terms, bend_of(observations.board, options.board_shape))
    devices = {
        name: to_pinhole(row, sizes[name]) for name, row in zip(problem.devices, fit.geometry.devices, strict=True)
    }
    used = [int(number) for number in np.flatnonzero(problem.used)]
    residuals = residuals_of_devices(problem, fit, sizes, held)
    solution = Solution(
        calibration=Calibration({name: devices[name] for name in observations.cameras}, devices.get(PROJECTOR)),
        covariance=allowing_for(known.devices, [residuals[name] for name in problem.devices]),
        distortion={name: terms[name] for name in problem.devices},
        poses={problem.pose_names[number]: to_board_pose(fit.geometry.poses[number]) for number in used},
        outliers=outliers,
        residuals=residuals,
        board_shape_mm=None if problem.prior is None else fit.geometry.shape_mm(),
        bow=known.bow,
    )
    progress("done", 1.0, f"{len(used)} poses used, {len(outliers)} left out")
    return solution


def _held_out_px(problem: Problem, fit: Fit, terms: Terms, options: SolveOptions) -> dict[str, float]:
    trial = replace(problem, measurements=problem.measurements.thinned(options.trial_matches_per_view))
    dealt = folds_of(trial, options.folds)
    if not dealt:
        return {}
    start = fitted(trial, fit.geometry, terms, rounds=1, noise=fit.noise)
    kept = kept_of(start.residuals, deviations_of(trial.measurements, fit.noise, trial.with_projector))
    counted = kept_of(fit.residuals, deviations_of(problem.measurements, fit.noise, problem.with_projector))
    judged = (problem.measurements, counted)
    return dict(held_out(trial, start.geometry, terms, fit.noise, dealt, kept, judged=judged).rms_px)


def _agreeing_in_shape(
    problem: Problem, geometry: Geometry, terms: Terms, outliers: dict[str, str], shapes: Sequence[Prior | None],
    options: SolveOptions,
) -> tuple[Problem, Fit]:  # fmt: skip
    """The same as `_agreeing`, of a board of the shape that held-out poses are best with."""
    chosen = {name: terms[name] for name in problem.devices}
    fit = None if len(shapes) == 1 else fitted(problem, geometry, chosen)
    while True:
        if fit is not None:
            shape = chosen_shape(problem, fit, chosen, shapes, margin=options.margin, folds=options.folds)
            problem = replace(problem, prior=shape)
        before = len(outliers)
        problem, fit = _agreeing(problem, geometry, terms, outliers)
        # A pose that contradicts the others may have had its say in the choice.
        if len(shapes) == 1 or len(outliers) == before:
            return problem, fit


def _agreeing(problem: Problem, geometry: Geometry, terms: Terms, outliers: dict[str, str]) -> tuple[Problem, Fit]:
    """Leave out one pose after another that contradicts the rest; what is left agrees."""
    chosen = {name: terms[name] for name in problem.devices}
    while True:
        fit = fitted(problem, geometry, chosen)
        refuse_bump(problem, fit, free_of(problem, fit.geometry, chosen))
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


def _unseen() -> str:
    return f"no camera saw {LEAST_CORNERS} corners of the board or more; shoot it again with the board in view"
