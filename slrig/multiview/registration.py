"""Registration of several views into one frame: all pairs at once, weighted point-to-plane ICP.

The poses T_i minimise Σ ρ(r / σ) over the matches of all pairs of views (`slrig.multiview.matching`), with Huber's ρ,
by Gauss-Newton steps. Matches are found again after each step (Chen and Medioni 1992; for all views at once Pulli
1999). View 0 is fixed. The limit of the residuals begins at the error of the start and ends at four standard deviations
of all residuals. Along directions that the surfaces do not determine, the start's values are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray, Mesh
from slrig.multiview.markers import motion_jacobian
from slrig.multiview.matching import (
    NormalEquations,
    Pair,
    PointMatches,
    PreparedView,
    assemble_equations,
    inflation_factor,
    match_points,
    normal_equations,
    prepare_view,
    transform_points,
)

START_ERROR_MM = 3.0
"""Distance of a surface from its place at the start: a turntable's axis known to 0.5° and 1 mm gives 2 mm."""
_FIRST_SAMPLE, _SAMPLE = 2000, 8000  # vertices of a view that are matched, at first and then
_MIN_OVERLAP = 0.02
"""Share of the queried vertices with a match. Pairs with less are left out: many of their matches are wrong."""
_REACH_SIGMAS = 4.0
_NEAR_SIGMAS = 3.0  # robust σ of the scaled residuals below which views are near their final poses
_MEDIAN_PER_SIGMA = 0.6745  # median of absolute values over the standard deviation, for a normal distribution
_MAX_STEPS = 60
_MIN_STEP = 0.1  # mean square of a step, in standard deviations, at which the iteration ends
_MAX_MISFIT = 4.0  # robust σ of a view's scaled residuals above which its surface is not that of the others

_MIN_SHARE = 0.5  # share of the information along a direction that has to remain without the noise of the normals
_ROUNDING = 1e-9  # share of all information below which the rest is rounding
_MIN_PART = 0.5  # part of a free motion of all views that a view has to have in it to be named
_MISFIT_GROWTH = 0.2
"""Growth of the squared residuals that shows a displacement; new matches alone change them by half of that."""
_HALVINGS = 9
_MIN_TURN_PART = 0.1  # rotational part of a view's free motion below which it is a shift
_MIN_TURN = 0.1  # rotational part of a free motion of all views below which it only shifts them


class Motion(StrEnum):
    """Kind of a free motion."""

    TURN = "turn"
    SHIFT = "shift"


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """A motion of one view against the others that the surfaces do not determine: the start's value is kept.

    direction : (3,) float64, unit, of the axis or of the shift, and point_mm : (3,), on the axis, in the model's frame.
    free_mm : displacement, at the object's radius from the middle, at which the residuals begin to grow; infinite if
    they do not grow within the object's size.
    """

    view: int
    motion: Motion
    direction: FloatArray
    point_mm: FloatArray
    free_mm: float

    def __str__(self) -> str:
        x, y, z = self.direction
        along = f"along ({x:.2f}, {y:.2f}, {z:.2f})"
        if self.motion is Motion.SHIFT:
            return f"shift {along}"
        x, y, z = self.point_mm
        return f"turn about an axis {along} through ({x:.1f}, {y:.1f}, {z:.1f}) mm"


@dataclass(frozen=True, slots=True)
class PairFit:
    """Agreement of two views.

    overlap : share of their vertices that have a match in the other view. rms_mm, rms_over_sigma : of the residuals
    along the normal. closure_mm : rms displacement between this pair registered alone and with all others, the loop
    closure error.
    """

    first: int
    second: int
    overlap: float
    rms_mm: float
    rms_over_sigma: float
    closure_mm: float


@dataclass(frozen=True, slots=True)
class Registration:
    """Poses of views and their uncertainty.

    poses : (N, 4, 4) float64, from view coordinates to those of view 0. covariance : (6 (N - 1), 6 (N - 1)) float64, of
    a small rotation (rad) about `middle_mm` and a shift (mm) of it in the model's frame, view by view from 1 on. Along
    the columns of `free_directions` (6 (N - 1), f), orthonormal with rotations scaled by the radius, it is the start's
    covariance, or 0 if that is unknown. inflation : factor in the standard deviations for errors that neighbouring
    points share. sigma_mm : (N,) float64, rms standard deviation of the position of a view's vertices. radius_mm : rms
    distance of the object's surface from its middle.
    """

    poses: FloatArray
    covariance: FloatArray
    sigma_mm: FloatArray
    inflation: float
    middle_mm: FloatArray
    radius_mm: float
    pairs: tuple[PairFit, ...]
    free: tuple[FreeMotion, ...]
    free_directions: FloatArray
    steps: int


def register_views(
    views: Sequence[Mesh],
    starts: Sequence[FloatArray] | FloatArray,
    *,
    names: Sequence[str] | None = None,
    start_error_mm: float = START_ERROR_MM,
    start_covariance: FloatArray | None = None,
) -> Registration:
    """Register views in the frame of the first.

    starts : a start pose (4, 4) for each view. names : of the views, for messages. start_error_mm : largest distance of
    a surface from its place at the start. start_covariance : (6 (N - 1), 6 (N - 1)), of a small rotation (rad) about
    the origin of the first view's frame and a shift (mm) of it, if known.

    Raises RegistrationRefusedError: a view overlaps no other, its surface does not agree with theirs, or the iteration
    does not converge.
    """
    names = names or [f"view {number}" for number in range(len(views))]
    if len(views) < 2:
        message = f"expected two views or more, found {len(views)}; scan the object from another side"
        raise RegistrationRefusedError(message)
    prepared = [prepare_view(view) for view in views]
    problem = _RegistrationProblem.from_starts(prepared, np.asarray(starts, dtype=np.float64), names)
    poses, matches, reach_mm, steps = _iterate(problem, start_error_mm)
    _require_agreement(matches, names)
    return _result(problem, poses, matches, reach_mm, steps, start_covariance)


@dataclass(frozen=True, slots=True)
class _RegistrationProblem:
    """Views, their start poses (N, 4, 4), and the object's middle (3,) and radius, which scale motions."""

    views: Sequence[PreparedView]
    starts: FloatArray
    names: Sequence[str]
    middle_mm: FloatArray
    radius_mm: float

    @classmethod
    def from_starts(
        cls, views: Sequence[PreparedView], starts: FloatArray, names: Sequence[str]
    ) -> _RegistrationProblem:
        for name, view in zip(names, views, strict=True):
            if not len(view.order):
                raise RegistrationRefusedError(
                    f"{name}: expected usable vertices, found none of its {len(view.points_mm)}: all are at the mesh's "
                    "boundary or are marked as clipped or grazed by light; scan it again"
                )
        starts = np.linalg.inv(starts[0]) @ starts
        samples = [view.points_mm[view.order[:_FIRST_SAMPLE]] for view in views]
        points = np.concatenate([transform_points(pose, each) for pose, each in zip(starts, samples, strict=True)])
        middle = points.mean(axis=0)
        return cls(views, starts, names, middle, float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())))

    def find_matches(
        self, pairs: Sequence[Pair], poses: FloatArray, reach_mm: float, max_count: int
    ) -> dict[Pair, PointMatches]:
        """Matches of the pairs that overlap."""
        found = {
            (i, j): match_points(
                self.views[i], self.views[j], (poses[i], poses[j]), reach_mm=reach_mm, max_count=max_count
            )
            for i, j in pairs
        }
        return {pair: each for pair, each in found.items() if len(each.sigma_mm) > _MIN_OVERLAP * each.queried}

    def equations(self, matches: Mapping[Pair, PointMatches]) -> NormalEquations:
        """Normal equations for the motions of all views but the first."""
        pairs = ((pair, normal_equations(each, self.middle_mm, self.radius_mm)) for pair, each in matches.items())
        return assemble_equations(pairs, len(self.views))

    def apply_motions(self, poses: FloatArray, motions: FloatArray) -> FloatArray:
        """Poses after motions (6 (N - 1),) of all views but the first."""
        by_view = np.append(np.zeros(6), motions).reshape(-1, 6)
        change = np.tile(np.eye(4), (len(poses), 1, 1))
        change[:, :3, :3] = Rotation.from_rotvec(by_view[:, :3] / self.radius_mm).as_matrix()
        change[:, :3, 3] = self.middle_mm + by_view[:, 3:] - change[:, :3, :3] @ self.middle_mm
        return change @ poses

    def motions_from_start(self, poses: FloatArray) -> FloatArray:
        """(6 (N - 1),): from the starts to these poses."""
        change = poses @ np.linalg.inv(self.starts)
        turns = self.radius_mm * Rotation.from_matrix(change[:, :3, :3]).as_rotvec()
        shifts = change[:, :3, :3] @ self.middle_mm + change[:, :3, 3] - self.middle_mm
        return np.hstack([turns, shifts])[1:].ravel()

    def motion_jacobians(self, points: FloatArray) -> FloatArray:
        """(n, 3, 6): displacement of points by a motion, dx = (ρ ω) × (x - middle) / ρ + t."""
        return motion_jacobian((points - self.middle_mm) / self.radius_mm)


def _iterate(problem: _RegistrationProblem, reach_mm: float) -> tuple[FloatArray, dict[Pair, PointMatches], float, int]:
    """Final poses, the matches there, their reach, and the number of steps. Raises as `register_views`."""
    poses, sample, count = problem.starts, _FIRST_SAMPLE, len(problem.views)
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j]
    matches = problem.find_matches(pairs, poses, reach_mm, sample)
    step = np.zeros(6 * count - 6)
    for steps in range(1, _MAX_STEPS + 1):
        _require_overlap(matches, problem.names)
        step, size = _step(problem, poses, matches)
        poses = problem.apply_motions(poses, step)
        residual = np.concatenate([each.residual_mm for each in matches.values()])
        sigma = np.concatenate([each.sigma_mm for each in matches.values()])
        reach_mm = min(reach_mm, _REACH_SIGMAS * _robust_sigma(residual))
        converged = size < _MIN_STEP and sample == _SAMPLE
        # A small sample is enough as long as the views are far from their final poses.
        if sample < _SAMPLE and (size < 1 or _robust_sigma(residual / sigma) < _NEAR_SIGMAS):
            sample, pairs = _SAMPLE, list(matches)
        matches = problem.find_matches(pairs, poses, reach_mm, sample)
        if converged:
            _require_overlap(matches, problem.names)
            return poses, matches, reach_mm, steps
    moves = np.linalg.norm(step.reshape(-1, 6), axis=1)
    worst = int(np.argmax(moves)) + 1
    shared = sum(len(each.sigma_mm) for pair, each in matches.items() if worst in pair)
    raise RegistrationRefusedError(
        f"{problem.names[worst]}: expected poses that converge, found that it still moves by {moves.max():.3f} mm "
        f"after {_MAX_STEPS} steps, with {shared} matches. Scan more surface that others share, or leave it out"
    )


def _step(
    problem: _RegistrationProblem, poses: FloatArray, matches: Mapping[Pair, PointMatches]
) -> tuple[FloatArray, float]:
    """Motions of all views but the first, and their mean square in standard deviations.

    Along free directions poses return to those nearest to the start. Rotations come first: a turntable's angles are
    reliable, and its stated axis does not quite pass through an object's own.
    """
    equations = problem.equations(matches)
    known, free = _split_directions(equations)
    back = _return_to_start(free, problem.motions_from_start(poses))
    rest = known.T @ (equations.gradient + equations.information @ back)
    step = back - known @ np.linalg.solve(known.T @ equations.information @ known, rest)
    return step, float(step @ equations.information @ step / len(step))


def _split_directions(equations: NormalEquations) -> tuple[FloatArray, FloatArray]:
    """Orthonormal columns (p, p - f) that the surfaces determine, and (p, f) that they leave free."""
    value, vectors = np.linalg.eigh(equations.unbiased)
    apparent = np.einsum("ik,ij,jk->k", vectors, equations.information, vectors)
    free = value <= np.maximum(_MIN_SHARE * apparent, _ROUNDING * np.trace(equations.information))
    return vectors[:, ~free], vectors[:, free]


def _return_to_start(free: FloatArray, motions: FloatArray) -> FloatArray:
    """Move along the columns of `free` (p, f), from motions (p,) or (p, k), to the smallest turns, and then shifts.

    Turns and shifts are separated first: else a shift with a little rotation by noise would go far to undo a turn.
    """
    turns = np.tile(np.repeat([True, False], 3), len(motions) // 6)
    _, size, right = np.linalg.svd(free[turns])
    turning = free @ right[: np.count_nonzero(size > _MIN_TURN)].T
    shifting = free @ right[np.count_nonzero(size > _MIN_TURN) :].T
    back = np.zeros_like(motions)
    for columns, part in ((turning, turns), (shifting, ~turns)):
        back -= columns @ np.linalg.lstsq(columns[part], (motions + back)[part], rcond=None)[0]
    return back


def _robust_sigma(residual: FloatArray) -> float:
    return float(np.median(np.abs(residual)) / _MEDIAN_PER_SIGMA)


def _require_overlap(matches: Mapping[Pair, PointMatches], names: Sequence[str]) -> None:
    """Raises RegistrationRefusedError: no chain of overlapping pairs connects a view to the first."""
    ends = np.array(list(matches), dtype=np.int64).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(names), len(names)))
    group = connected_components(graph, directed=False)[1]
    apart = [name for name, own in zip(names, group, strict=True) if own != group[0]]
    if apart:
        others = "another view" if len(apart) == len(names) - 1 else f"a view that overlaps {names[0]}"
        message = (
            f"{', '.join(apart)}: expected to share more than {_MIN_OVERLAP:.0%} of the surface with {others}, found "
            "less. Check the angle, its sign and the axis, allow for a larger error of the start, or scan between them"
        )
        raise RegistrationRefusedError(message)


def _require_agreement(matches: Mapping[Pair, PointMatches], names: Sequence[str]) -> None:
    """Raises RegistrationRefusedError: the scaled residuals of a view's pairs exceed `_MAX_MISFIT`."""
    misfit = []
    for view in range(len(names)):
        scaled = [each.residual_mm / each.sigma_mm for pair, each in matches.items() if view in pair]
        misfit.append(_robust_sigma(np.concatenate(scaled)))
    worst = int(np.argmax(misfit))
    if misfit[worst] > _MAX_MISFIT:
        message = (
            f"{names[worst]}: expected a surface that agrees with the other views to {_MAX_MISFIT:g} standard "
            f"deviations, found {misfit[worst]:.1f}. The object moved or bends, or its start is wrong: check the angle "
            "and the axis, or leave this view out"
        )
        raise RegistrationRefusedError(message)


def _result(
    problem: _RegistrationProblem,
    poses: FloatArray,
    matches: Mapping[Pair, PointMatches],
    reach_mm: float,
    steps: int,
    start_covariance: FloatArray | None,
) -> Registration:
    equations = problem.equations(matches)
    known, free = _split_directions(equations)
    # By the unbiased information: noise of the normals determines nothing.
    covariance = known @ np.linalg.inv(known.T @ equations.unbiased @ known) @ known.T
    factor = inflation_factor(matches, len(poses), problem.middle_mm, problem.radius_mm, covariance)
    covariance *= factor**2
    if start_covariance is not None:
        covariance += _covariance_from_start(known, free, start_covariance, problem)
    scale = np.tile(np.repeat([1 / problem.radius_mm, 1.0], 3), len(poses) - 1)

    def misfit(view: int, motion: FloatArray) -> float:
        """Mean square of a view's scaled residuals after a motion of it; infinite without a match."""
        motions = np.zeros((len(poses) - 1, 6))
        motions[view - 1] = motion
        pairs = [pair for pair in matches if view in pair]
        found = problem.find_matches(pairs, problem.apply_motions(poses, motions.ravel()), reach_mm, _FIRST_SAMPLE)
        scaled = [each.residual_mm / each.sigma_mm for each in found.values()]
        return float(np.mean(np.concatenate(scaled) ** 2)) if scaled else float("inf")

    return Registration(
        poses=poses,
        covariance=covariance * scale[:, None] * scale,
        sigma_mm=_displacement_sigma_mm(problem, poses, covariance),
        inflation=factor,
        middle_mm=problem.middle_mm,
        radius_mm=problem.radius_mm,
        pairs=tuple(_pair_fits(problem, matches)),
        free=tuple(_free_motions(free, problem.middle_mm, problem.radius_mm, misfit)),
        free_directions=free,
        steps=steps,
    )


def _covariance_from_start(
    known: FloatArray, free: FloatArray, start: FloatArray, problem: _RegistrationProblem
) -> FloatArray:
    """(p, p): covariance of motions (mm) that the error of the start leaves along free directions.

    The surfaces remove the part K e of the start's error e; then poses return along free directions to those nearest to
    the start.
    """
    about = np.block([[problem.radius_mm * np.eye(3), np.zeros((3, 3))], [motion_jacobian(problem.middle_mm)]])
    to_motions = np.kron(np.eye(len(start) // 6), about)
    removed = -known @ known.T
    remaining = np.eye(len(start)) + removed + _return_to_start(free, removed)
    return np.asarray(remaining @ to_motions @ start @ to_motions.T @ remaining.T)


def _displacement_sigma_mm(problem: _RegistrationProblem, poses: FloatArray, covariance: FloatArray) -> FloatArray:
    """(N,): square root of the mean of tr(J C Jᵀ) over the points of each view. covariance : of motions, mm²."""
    sigma = np.zeros(len(poses))
    for number in range(1, len(poses)):
        view, own = problem.views[number], slice(6 * number - 6, 6 * number)
        points = transform_points(poses[number], view.points_mm[view.order[:_FIRST_SAMPLE]])
        rows = problem.motion_jacobians(points)
        sigma[number] = np.sqrt(np.einsum("nai,ij,naj->", rows, covariance[own, own], rows) / len(rows))
    return sigma


def _pair_fits(problem: _RegistrationProblem, matches: Mapping[Pair, PointMatches]) -> list[PairFit]:
    fits = []
    for i, j in sorted({(min(pair), max(pair)) for pair in matches}):
        both = {pair: matches[pair] for pair in ((i, j), (j, i)) if pair in matches}
        residual = np.concatenate([each.residual_mm for each in both.values()])
        sigma = np.concatenate([each.sigma_mm for each in both.values()])
        queried = sum(len(problem.views[view].order[:_SAMPLE]) for view in (i, j))
        # The pair alone: its first view is fixed and takes the place of view 0.
        alone = [
            ((int(pair[0] == j), int(pair[1] == j)), normal_equations(each, problem.middle_mm, problem.radius_mm))
            for pair, each in both.items()
        ]
        equations = assemble_equations(alone, 2)
        known = _split_directions(equations)[0]
        motion = -known @ np.linalg.solve(known.T @ equations.information @ known, known.T @ equations.gradient)
        midpoints = np.concatenate([each.midpoints_mm for each in both.values()])
        apart = problem.motion_jacobians(midpoints) @ motion
        rms_mm, rms = float(np.sqrt(np.mean(residual**2))), float(np.sqrt(np.mean((residual / sigma) ** 2)))
        closure_mm = float(np.sqrt((apart**2).sum(axis=1).mean()))
        fits.append(PairFit(i, j, len(residual) / queried, rms_mm, rms, closure_mm))
    return fits


def _free_motions(
    free: FloatArray, middle_mm: FloatArray, radius_mm: float, misfit: Callable[[int, FloatArray], float]
) -> list[FreeMotion]:
    """Describe the free motions of each view as turns and shifts.

    free : (6 (N - 1), f), see `_split_directions`. misfit : mean square of a view's scaled residuals after a motion
    (6,) of it.
    """
    found = []
    for view, own in enumerate(np.split(free, len(free) // 6), start=1):
        left, size, _ = np.linalg.svd(own, full_matrices=False)
        span = left[:, size > _MIN_PART]
        # Shifts are the free motions that remain when all turns among them are taken out.
        _, turning, right = np.linalg.svd(span[:3])
        turning = np.append(turning, np.zeros(span.shape[1]))[: span.shape[1]]
        for each, turn in zip((span @ right.T).T, turning, strict=True):
            kind = Motion.TURN if turn > _MIN_TURN_PART else Motion.SHIFT
            vector = each[:3] if kind is Motion.TURN else each[3:]
            length = np.linalg.norm(vector)
            # An axis has two directions: choose the one whose largest component is positive.
            direction = vector / length * np.sign(vector[np.abs(vector).argmax()])
            # x moves by ω × (x - middle) + t, not at all at middle + ω × t / ω².
            aside = radius_mm * np.cross(each[:3], each[3:]) / length**2 if kind is Motion.TURN else np.zeros(3)
            reach = _extent_mm(partial(misfit, view), each, radius_mm)
            found.append(FreeMotion(view, kind, direction, middle_mm + aside, reach))
    return found


def _extent_mm(misfit: Callable[[FloatArray], float], motion: FloatArray, radius_mm: float) -> float:
    """Displacement along a motion, both ways, at which the squared residuals have grown by `_MISFIT_GROWTH`."""
    limit = (1 + _MISFIT_GROWTH) * misfit(np.zeros(6))
    for doublings in range(_HALVINGS + 1):
        step_mm = radius_mm * 2.0 ** (doublings - _HALVINGS)
        if min(misfit(step_mm * motion), misfit(-step_mm * motion)) > limit:
            return step_mm
    return float("inf")
