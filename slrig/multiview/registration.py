"""Several views of one object into one frame: all pairs at once, point to plane, each residual over its own deviation.

The poses T_i minimise Σ ρ(r / σ) over the matches of all pairs of views (`slrig.multiview.matching`), Huber's ρ, by
Gauss and Newton's steps; matches are looked for again after each step (Chen and Medioni 1992; for all views at once
Pulli 1999). View 0 stands still. A match's residual may be as large as the start's error at first, and no larger than
four deviations of all residuals then. Directions that no surface tells of are held as the start has them.
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
from slrig.multiview.markers import moved_by
from slrig.multiview.matching import Matches, Side, Terms, assembled, inflation, matched, moved, side_of, terms_of

_LEAST_SHARE = 0.5
"""Of the information along a direction, what both surfaces have to agree on."""
_ROUNDING = 1e-9
"""Of all information: less than this is rounding."""
_LEAST_PART = 0.5
"""Of a free motion of all views, what one view has to have in it to be named."""
_TELLING = 0.2
"""Residuals whose squares grow by this share say that the view is elsewhere; matches anew change them by a tenth."""
_HALVINGS = 9
_NO_TURN = 0.1
"""The part of a motion that is a turn, below which it is a shift."""


class Motion(StrEnum):
    """What kind of motion is free."""

    TURN = "turn"
    SHIFT = "shift"


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """A motion of one view against the others that its surface does not tell of; it is held as the start has it.

    direction : (3,) float64, unit, of the axis or of the shift, and point_mm : (3,), on the axis, in the model's frame.
    free_mm : how far it may go, at the object's radius from the middle, before the residuals tell; infinite where they
    do not at any place of the object.
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


def directions(terms: Terms) -> tuple[FloatArray, FloatArray]:
    """Orthonormal columns (p, p - f) that the surfaces determine, and (p, f) that they leave free."""
    value, vectors = np.linalg.eigh(terms.agreed)
    apparent = np.einsum("ik,ij,jk->k", vectors, terms.information, vectors)
    free = value <= np.maximum(_LEAST_SHARE * apparent, _ROUNDING * np.trace(terms.information))
    return vectors[:, ~free], vectors[:, free]


def free_motions(
    free: FloatArray, middle_mm: FloatArray, radius_mm: float, misfit: Callable[[int, FloatArray], float]
) -> list[FreeMotion]:
    """What each view may do, in the words of turns and shifts.

    free : (6 (N - 1), f), see `directions`. misfit : mean square of residuals over their deviations of a view after a
    motion (6,) of it.
    """
    found = []
    for view, mine in enumerate(np.split(free, len(free) // 6), start=1):
        left, size, _ = np.linalg.svd(mine, full_matrices=False)
        span = left[:, size > _LEAST_PART]
        # Shifts are what is left of the free motions when all turns among them are taken out.
        _, turning, right = np.linalg.svd(span[:3])
        turning = np.append(turning, np.zeros(span.shape[1]))[: span.shape[1]]
        for each, turned in zip((span @ right.T).T, turning, strict=True):
            kind = Motion.TURN if turned > _NO_TURN else Motion.SHIFT
            vector = each[:3] if kind is Motion.TURN else each[3:]
            length = np.linalg.norm(vector)
            # An axis has two directions: the one whose largest part is positive.
            direction = vector / length * np.sign(vector[np.abs(vector).argmax()])
            # x moves by ω × (x - middle) + t, not at all at middle + ω × t / ω².
            aside = radius_mm * np.cross(each[:3], each[3:]) / length**2 if kind is Motion.TURN else np.zeros(3)
            reach = _extent_mm(partial(misfit, view), each, radius_mm)
            found.append(FreeMotion(view, kind, direction, middle_mm + aside, reach))
    return found


def _extent_mm(misfit: Callable[[FloatArray], float], motion: FloatArray, radius_mm: float) -> float:
    """How far a motion goes, both ways, until the squared residuals have grown by `_TELLING`."""
    least = (1 + _TELLING) * misfit(np.zeros(6))
    for doublings in range(_HALVINGS + 1):
        step_mm = radius_mm * 2.0 ** (doublings - _HALVINGS)
        if min(misfit(step_mm * motion), misfit(-step_mm * motion)) > least:
            return step_mm
    return float("inf")


START_ERROR_MM = 3.0
"""How far a surface may be from where the start puts it: a stage's axis known to 0.5° and 1 mm gives 2 mm."""
_FIRST_SAMPLE, _SAMPLE = 2000, 8000
"""Vertices of a view that matches are looked for, while residuals are those of the start, and then."""
_LEAST_OVERLAP = 0.02
"""Of the vertices asked for: pairs with fewer matches are left out. They hold little, and much of it is wrong."""
_REACH_SIGMAS = 4.0
_NEAR_SIGMAS = 3.0
"""Of residuals, by their median, within which views are about where they belong."""
_MEDIAN = 0.6745
"""Median of absolute values over the standard deviation, of a normal distribution."""
_MOST_STEPS = 60
_LEAST_STEP = 0.1
"""Squared, in deviations of a parameter if all matches were independent, which are three to six times too small."""
_MOST_MISFIT = 4.0
"""Residuals over their deviations, by the median, beyond which a view's surface is not that of the others: rendered
scans of calibrated rigs have 1 to 2."""

_LEAST_TURN = 0.1
"""The part of a free motion of all views that is a turn, below which it only shifts them: noise mixes in less."""

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class PairFit:
    """How two views agree. overlap : share of their vertices that have a match in the other one.

    rms_mm, rms_over_sigma : residuals along the normal. closure_mm : rms distance by which this pair alone would put
    its views elsewhere than all pairs together do: the error of closure of its loops.
    """

    first: int
    second: int
    overlap: float
    rms_mm: float
    rms_over_sigma: float
    closure_mm: float


@dataclass(frozen=True, slots=True)
class Registration:
    """Where views belong.

    poses : (N, 4, 4) float64, view coordinates to those of view 0. covariance : (6 (N - 1), 6 (N - 1)) float64, of a
    small turn (rad) about `middle_mm` and a shift (mm) of it in the model's frame, view by view from 1 on; along free
    motions it is what the start's own is, and 0 where that is not known: `held` (6 (N - 1), f) has them as columns,
    orthonormal where turns count at the object's radius. inflation : factor in its deviations for errors that
    neighbouring points share. sigma_mm : (N,) float64, rms standard deviation of where a view's vertices are put.
    radius_mm : rms distance of the object's surface from its middle.
    """

    poses: FloatArray
    covariance: FloatArray
    sigma_mm: FloatArray
    inflation: float
    middle_mm: FloatArray
    radius_mm: float
    pairs: tuple[PairFit, ...]
    free: tuple[FreeMotion, ...]
    held: FloatArray
    steps: int


def registered(
    views: Sequence[Mesh],
    starts: Sequence[FloatArray] | FloatArray,
    *,
    names: Sequence[str] | None = None,
    start_error_mm: float = START_ERROR_MM,
    start_covariance: FloatArray | None = None,
) -> Registration:
    """Put views into the frame of the first. starts : a pose (4, 4) for each, near where it belongs.

    names : of the views, for messages. start_error_mm : how far a surface may lie from where its start puts it.
    start_covariance : (6 (N - 1), 6 (N - 1)), of a small turn (rad) about the origin of the first view's frame and a
    shift (mm) of it, where it is known how well the starts are.

    Raises
    ------
    RegistrationRefusedError
        A view overlaps no other, its surface does not agree with theirs, or the steps do not come to an end.
    """
    names = names or [f"view {number}" for number in range(len(views))]
    if len(views) < 2:
        message = f"expected two views or more to put into one frame, found {len(views)}; scan the object turned"
        raise RegistrationRefusedError(message)
    problem = _problem([side_of(view) for view in views], np.asarray(starts, dtype=np.float64), names)
    poses, matches, reach_mm, steps = _settled(problem, start_error_mm)
    _require_agreement(matches, names)
    return _result(problem, poses, matches, reach_mm, steps, start_covariance)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Views, their starts (N, 4, 4), and the measure of motions: the object's middle (3,) and radius."""

    sides: Sequence[Side]
    starts: FloatArray
    names: Sequence[str]
    middle_mm: FloatArray
    radius_mm: float

    def matches(self, pairs: Sequence[Pair], poses: FloatArray, reach_mm: float, most: int) -> dict[Pair, Matches]:
        """Those of the pairs that overlap."""
        found = {
            (i, j): matched(self.sides[i], self.sides[j], (poses[i], poses[j]), reach_mm=reach_mm, most=most)
            for i, j in pairs
        }
        return {pair: each for pair, each in found.items() if len(each.sigma_mm) > _LEAST_OVERLAP * each.asked}

    def terms(self, matches: Mapping[Pair, Matches]) -> Terms:
        """Of the motions of all views but the first."""
        each = ((pair, terms_of(found, self.middle_mm, self.radius_mm)) for pair, found in matches.items())
        return assembled(each, len(self.sides))

    def stepped(self, poses: FloatArray, motions: FloatArray) -> FloatArray:
        """Poses after motions (6 (N - 1),) of all views but the first."""
        each = np.append(np.zeros(6), motions).reshape(-1, 6)
        change = np.tile(np.eye(4), (len(poses), 1, 1))
        change[:, :3, :3] = Rotation.from_rotvec(each[:, :3] / self.radius_mm).as_matrix()
        change[:, :3, 3] = self.middle_mm + each[:, 3:] - change[:, :3, :3] @ self.middle_mm
        return change @ poses

    def motions(self, poses: FloatArray) -> FloatArray:
        """(6 (N - 1),): from the starts to these poses."""
        change = poses @ np.linalg.inv(self.starts)
        turns = self.radius_mm * Rotation.from_matrix(change[:, :3, :3]).as_rotvec()
        shifts = change[:, :3, :3] @ self.middle_mm + change[:, :3, 3] - self.middle_mm
        return np.hstack([turns, shifts])[1:].ravel()


def _problem(sides: Sequence[Side], starts: FloatArray, names: Sequence[str]) -> _Problem:
    for name, side in zip(names, sides, strict=True):
        if not len(side.order):
            message = f"{name}: none of its {len(side.points_mm)} vertices can be used: all lie at the mesh's boundary "
            raise RegistrationRefusedError(message + "or are marked as clipped or grazed by light; scan it again.")
    starts = np.linalg.inv(starts[0]) @ starts
    placed = np.concatenate(
        [moved(pose, side.points_mm[side.order[:_FIRST_SAMPLE]]) for pose, side in zip(starts, sides, strict=True)]
    )
    middle = placed.mean(axis=0)
    return _Problem(sides, starts, names, middle, float(np.sqrt(((placed - middle) ** 2).sum(axis=1).mean())))


def _settled(problem: _Problem, reach_mm: float) -> tuple[FloatArray, dict[Pair, Matches], float, int]:
    """Poses at rest, the matches there, how far those reach, and the number of steps. Raises as `registered`."""
    poses, most, count = problem.starts, _FIRST_SAMPLE, len(problem.sides)
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j]
    matches = problem.matches(pairs, poses, reach_mm, most)
    step = np.zeros(6 * count - 6)
    for steps in range(1, _MOST_STEPS + 1):
        _require_overlap(matches, problem.names)
        step, size = _step(problem, poses, matches)
        poses = problem.stepped(poses, step)
        residual = np.concatenate([each.residual_mm for each in matches.values()])
        sigma = np.concatenate([each.sigma_mm for each in matches.values()])
        reach_mm = min(reach_mm, _REACH_SIGMAS * _deviation(residual))
        at_rest = size < _LEAST_STEP and most == _SAMPLE
        # Few vertices do as long as all of them tell the same, that the views are elsewhere.
        if most < _SAMPLE and (size < 1 or _deviation(residual / sigma) < _NEAR_SIGMAS):
            most, pairs = _SAMPLE, list(matches)
        matches = problem.matches(pairs, poses, reach_mm, most)
        if at_rest:
            _require_overlap(matches, problem.names)
            return poses, matches, reach_mm, steps
    raise RegistrationRefusedError(_unended(problem, matches, step))


def _step(problem: _Problem, poses: FloatArray, matches: Mapping[Pair, Matches]) -> tuple[FloatArray, float]:
    """Motions of all views but the first, and their mean square in deviations, by the information that there is.

    Along free motions poses go back to where they are nearest to the start: turns as the start has them first of all,
    since it is angles that a stage tells, and an axis that it is told does not quite go through the object's own.
    """
    terms = problem.terms(matches)
    known, free = directions(terms)
    back = _back(free, problem.motions(poses))
    rest = known.T @ (terms.gradient + terms.information @ back)
    step = back - known @ np.linalg.solve(known.T @ terms.information @ known, rest)
    return step, float(step @ terms.information @ step / len(step))


def _back(free: FloatArray, motions: FloatArray) -> FloatArray:
    """Along the columns of `free` (p, f), from motions (p,) or (p, k) to where turns are least, and then shifts are.

    The two are told apart first: a shift that noise gives a little turn would else go far to undo a turn by it.
    """
    turns = np.tile(np.repeat([True, False], 3), len(motions) // 6)
    _, size, right = np.linalg.svd(free[turns])
    turning = free @ right[: np.count_nonzero(size > _LEAST_TURN)].T
    shifting = free @ right[np.count_nonzero(size > _LEAST_TURN) :].T
    back = np.zeros_like(motions)
    for columns, part in ((turning, turns), (shifting, ~turns)):
        back -= columns @ np.linalg.lstsq(columns[part], (motions + back)[part], rcond=None)[0]
    return back


def _held_covariance(known: FloatArray, free: FloatArray, start: FloatArray, problem: _Problem) -> FloatArray:
    """(p, p): of motions (mm), what the start's error leaves in poses that are held as the start has them.

    Surfaces take from an error e of the start what they tell of, K e; poses then go back along free motions to where
    they are nearest to the start.
    """
    about = np.block([[problem.radius_mm * np.eye(3), np.zeros((3, 3))], [moved_by(problem.middle_mm)]])
    to_motions = np.kron(np.eye(len(start) // 6), about)
    taken = -known @ known.T
    left = np.eye(len(start)) + taken + _back(free, taken)
    return np.asarray(left @ to_motions @ start @ to_motions.T @ left.T)


def _deviation(residual: FloatArray) -> float:
    return float(np.median(np.abs(residual)) / _MEDIAN)


def _require_overlap(matches: Mapping[Pair, Matches], names: Sequence[str]) -> None:
    """Raises RegistrationRefusedError: a view is not joined to the first by pairs that overlap."""
    ends = np.array(list(matches), dtype=np.int64).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(names), len(names)))
    group = connected_components(graph, directed=False)[1]
    apart = [name for name, mine in zip(names, group, strict=True) if mine != group[0]]
    if apart:
        others = "any other" if len(apart) == len(names) - 1 else f"those that overlap {names[0]}"
        message = (
            f"{', '.join(apart)}: expected to share more than {_LEAST_OVERLAP:.0%} of the surface with other views, "
            f"found no view among {others} that it does. Check the angle, its sign and the axis, allow for a larger "
            "error of the start, or scan between them"
        )
        raise RegistrationRefusedError(message)


def _require_agreement(matches: Mapping[Pair, Matches], names: Sequence[str]) -> None:
    """Raises RegistrationRefusedError: residuals of a view's pairs are beyond what deviations may be wrong by."""
    misfit = []
    for view in range(len(names)):
        mine = [each.residual_mm / each.sigma_mm for pair, each in matches.items() if view in pair]
        misfit.append(_deviation(np.concatenate(mine)))
    worst = int(np.argmax(misfit))
    if misfit[worst] > _MOST_MISFIT:
        message = (
            f"{names[worst]}: expected a surface that agrees with the other views to {_MOST_MISFIT:g} standard "
            f"deviations, found {misfit[worst]:.1f}. The object moved or bends, or its start is wrong: check the angle "
            "and the axis, or leave this view out"
        )
        raise RegistrationRefusedError(message)


def _unended(problem: _Problem, matches: Mapping[Pair, Matches], step: FloatArray) -> str:
    moves = np.linalg.norm(step.reshape(-1, 6), axis=1)
    worst = int(np.argmax(moves)) + 1
    shared = sum(len(each.sigma_mm) for pair, each in matches.items() if worst in pair)
    return (
        f"{problem.names[worst]}: expected poses that come to rest, found that it still moves by {moves.max():.3f} mm "
        f"after {_MOST_STEPS} steps, held by {shared} matches. Scan more of what it shares with others, or leave it out"
    )


def _result(
    problem: _Problem,
    poses: FloatArray,
    matches: Mapping[Pair, Matches],
    reach_mm: float,
    steps: int,
    start_covariance: FloatArray | None,
) -> Registration:
    terms = problem.terms(matches)
    known, free = directions(terms)
    # By the agreed information: noise of the normals holds nothing.
    covariance = known @ np.linalg.inv(known.T @ terms.agreed @ known) @ known.T
    factor = inflation(matches, len(poses), problem.middle_mm, problem.radius_mm, covariance)
    covariance *= factor**2
    if start_covariance is not None:
        covariance += _held_covariance(known, free, start_covariance, problem)
    scale = np.tile(np.repeat([1 / problem.radius_mm, 1.0], 3), len(poses) - 1)

    def misfit(view: int, motion: FloatArray) -> float:
        """Mean square of a view's residuals over their deviations after a motion of it; infinite without a match."""
        motions = np.zeros((len(poses) - 1, 6))
        motions[view - 1] = motion
        mine = [pair for pair in matches if view in pair]
        tried = problem.matches(mine, problem.stepped(poses, motions.ravel()), reach_mm, _FIRST_SAMPLE)
        scaled = [each.residual_mm / each.sigma_mm for each in tried.values()]
        return float(np.mean(np.concatenate(scaled) ** 2)) if scaled else float("inf")

    return Registration(
        poses=poses,
        covariance=covariance * scale[:, None] * scale,
        sigma_mm=_displacement_sigma_mm(problem, poses, covariance),
        inflation=factor,
        middle_mm=problem.middle_mm,
        radius_mm=problem.radius_mm,
        pairs=tuple(_pair_fits(problem, matches)),
        free=tuple(free_motions(free, problem.middle_mm, problem.radius_mm, misfit)),
        held=free,
        steps=steps,
    )


def _displacement_sigma_mm(problem: _Problem, poses: FloatArray, covariance: FloatArray) -> FloatArray:
    """(N,): square root of the mean of tr(J C Jᵀ) over the points of each view. covariance : of motions, mm²."""
    sigma = np.zeros(len(poses))
    for view in range(1, len(poses)):
        side, mine = problem.sides[view], slice(6 * view - 6, 6 * view)
        points = moved(poses[view], side.points_mm[side.order[:_FIRST_SAMPLE]])
        rows = _rows(points, problem)
        sigma[view] = np.sqrt(np.einsum("nai,ij,naj->", rows, covariance[mine, mine], rows) / len(rows))
    return sigma


def _rows(points: FloatArray, problem: _Problem) -> FloatArray:
    """(n, 3, 6): how points move with a motion, dx = (ρ ω) × (x - middle) / ρ + t."""
    return moved_by((points - problem.middle_mm) / problem.radius_mm)


def _pair_fits(problem: _Problem, matches: Mapping[Pair, Matches]) -> list[PairFit]:
    fits = []
    for i, j in sorted({(min(pair), max(pair)) for pair in matches}):
        both = {pair: matches[pair] for pair in ((i, j), (j, i)) if pair in matches}
        residual = np.concatenate([each.residual_mm for each in both.values()])
        sigma = np.concatenate([each.sigma_mm for each in both.values()])
        asked = sum(len(problem.sides[view].order[:_SAMPLE]) for view in (i, j))
        # The pair alone: the first of the two stands still, and takes the place of view 0.
        alone = {(int(pair[0] == j), int(pair[1] == j)): each for pair, each in both.items()}
        terms = assembled([(p, terms_of(each, problem.middle_mm, problem.radius_mm)) for p, each in alone.items()], 2)
        known = directions(terms)[0]
        motion = -known @ np.linalg.solve(known.T @ terms.information @ known, known.T @ terms.gradient)
        apart = _rows(np.concatenate([each.at_mm for each in both.values()]), problem) @ motion
        fits.append(
            PairFit(
                first=i,
                second=j,
                overlap=len(residual) / asked,
                rms_mm=float(np.sqrt(np.mean(residual**2))),
                rms_over_sigma=float(np.sqrt(np.mean((residual / sigma) ** 2))),
                closure_mm=float(np.sqrt((apart**2).sum(axis=1).mean())),
            )
        )
    return fits
