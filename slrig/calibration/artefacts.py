"""Which points of a scan lie on an artefact, the sphere or plane fitted to them, and the decision.

After VDI/VDE 2634 part 2 and ISO 10360-13; no conformity is claimed. A sphere or plane is fitted by least squares of
the distances to it; at most three points in a thousand, those that lie furthest off, are left out, and how many is
said. All else that was measured on the artefact counts, at a rim and at a grazing view as elsewhere: whoever scans a
part gets those points, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import NothingToReconstructError
from slrig.model import FloatArray

REJECTED_SHARE = 0.003
"""At most this share of the points is left out (VDI/VDE 2634-2)."""

FEWEST_POINTS = 100
_DISPERSED = 0.95
_MOST_VOTES = 20_000
_VOTE_REACH = 0.08  # of the radius: how far the centres that single normals point at may lie from one another
_SHELL = 0.05  # of the radius: what lies nearer to the sphere is taken for a part of it
_SLAB = 0.01  # of the plane's length: as for the sphere
_ROUNDS = 4
_TRIALS = 200
_TILT_COSINE = np.cos(np.deg2rad(15.0))
_TURNED_COSINE = np.cos(np.deg2rad(45.0))
"""What faces so differently is another thing that touches the artefact: a rod or a foot of up to half a ball's radius
leaves the ball at 60 degrees or more. Noise turns few points so far, and how many is said."""


@dataclass(frozen=True, slots=True)
class FittedSphere:
    """A sphere fitted to points. centre_mm : (3,); distances_mm : (n,) of the points kept, outwards positive."""

    centre_mm: FloatArray
    radius_mm: float
    distances_mm: FloatArray
    rejected: int


@dataclass(frozen=True, slots=True)
class FittedPlane:
    """A plane fitted to points. normal : (3,), unit; distances_mm : (n,) of the points kept, along it."""

    centre_mm: FloatArray
    normal: FloatArray
    distances_mm: FloatArray
    rejected: int


class OnArtefact(NamedTuple):
    """Indices of the points on an artefact, (n,), and how many more lie as near to it, but face quite differently."""

    points: NDArray[np.intp]
    turned: int


class Decision(StrEnum):
    """Whether an error keeps to its limit, given how well it is known (ISO 14253-1)."""

    PASSES = "passes"
    FAILS = "fails"
    UNDECIDED = "undecided"


def decision(error_mm: float, limit_mm: float, uncertainty_mm: float) -> Decision:
    """Passes if |error| is below the limit by the expanded uncertainty (k = 2), fails if above it by as much.

    >>> decision(-0.012, 0.02, 0.003).value, decision(0.019, 0.02, 0.003).value, decision(0.03, 0.02, 0.003).value
    ('passes', 'undecided', 'fails')
    """
    if abs(error_mm) <= limit_mm - uncertainty_mm:
        return Decision.PASSES
    return Decision.FAILS if abs(error_mm) > limit_mm + uncertainty_mm else Decision.UNDECIDED


def fitted_sphere(points_mm: FloatArray) -> FittedSphere:
    """Least squares of the radial distances, radius free; points (n, 3) mm. Raises NothingToReconstructError."""
    _require_enough(points_mm, "a sphere")
    centre, radius = _sphere(points_mm)
    kept = _kept(np.linalg.norm(points_mm - centre, axis=1) - radius)
    centre, radius = _sphere(points_mm[kept])
    distances = np.linalg.norm(points_mm[kept] - centre, axis=1) - radius
    return FittedSphere(centre, radius, distances, int((~kept).sum()))


def fitted_plane(points_mm: FloatArray) -> FittedPlane:
    """Least squares of the distances; points (n, 3) mm. Raises NothingToReconstructError."""
    _require_enough(points_mm, "a plane")
    centre, normal = _plane(points_mm)
    kept = _kept((points_mm - centre) @ normal)
    centre, normal = _plane(points_mm[kept])
    return FittedPlane(centre, normal, (points_mm[kept] - centre) @ normal, int((~kept).sum()))


def dispersion_mm(distances_mm: FloatArray) -> float:
    """The width of the narrowest shell that holds 95 % of the distances (D95 %, ISO 10360-13)."""
    rising = np.sort(distances_mm)
    inside = int(np.ceil(_DISPERSED * len(rising)))
    return float((rising[inside - 1 :] - rising[: len(rising) - inside + 1]).min())


def _sphere(points_mm: FloatArray) -> tuple[FloatArray, float]:
    # The algebraic sphere, |p|² = 2 c·p + (r² - |c|²), about the middle, is near enough to start from.
    middle = points_mm.mean(axis=0)
    about = points_mm - middle
    system = np.column_stack([2 * about, np.ones(len(about))])
    solved = np.linalg.lstsq(system, (about**2).sum(axis=1), rcond=None)[0]
    start = np.append(solved[:3], np.sqrt(max(solved[3] + solved[:3] @ solved[:3], 1e-12)))

    def distances(parameters: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(about - parameters[:3], axis=1) - parameters[3])

    def slopes(parameters: FloatArray) -> FloatArray:
        outwards = about - parameters[:3]
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        return np.column_stack([-outwards, -np.ones(len(about))])

    # Late: the service knows the values of this module, and loads no solver.
    from scipy.optimize import least_squares

    found = least_squares(distances, start, jac=slopes, method="lm", xtol=1e-12, ftol=1e-12).x
    return middle + found[:3], float(found[3])


def _plane(points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    centre = points_mm.mean(axis=0)
    about = points_mm - centre
    # The eigenvector of the least eigenvalue of the scatter: the direction in which the points spread least.
    return centre, np.linalg.eigh(about.T @ about)[1][:, 0]


def _kept(distances_mm: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: all but the points that may be left out."""
    count = int(REJECTED_SHARE * len(distances_mm))
    kept = np.ones(len(distances_mm), dtype=bool)
    if count:
        kept[np.argpartition(np.abs(distances_mm), -count)[-count:]] = False
    return kept


def _require_enough(points_mm: FloatArray, what: str) -> None:
    if len(points_mm) < FEWEST_POINTS:
        message = (
            f"{what} is fitted to {FEWEST_POINTS} points or more, found {len(points_mm)}; bring the artefact into view "
            "of camera and projector, and matt"
        )
        raise NothingToReconstructError(message)


def ball_points(points_mm: FloatArray, normals: FloatArray, diameter_mm: float, count: int) -> list[OnArtefact]:
    """The points on each of `count` balls of one diameter, the ball with most points first.

    points_mm, normals : (n, 3) float64, the normals outwards. Each normal points back to its ball's centre, one radius
    below the surface: where most of them meet is a centre. What then lies within a twentieth of the radius of the
    sphere is on it, however far off its noise put it.

    Raises
    ------
    NothingToReconstructError
        There are fewer balls of that size.
    """
    radius_mm = diameter_mm / 2
    left = np.ones(len(points_mm), dtype=bool)
    found: list[OnArtefact] = []
    for number in range(count):
        inside = _ball(points_mm, normals, radius_mm, left)
        if inside is None:
            message = (
                f"expected {count} ball{'s' if count > 1 else ''} of {diameter_mm:g} mm, found {number}; bring the "
                "artefact wholly into view, matt, and name its certified diameter"
            )
            raise NothingToReconstructError(message)
        found.append(inside)
        left[inside.points] = False
    return sorted(found, key=lambda ball: len(ball.points), reverse=True)


def plane_points(points_mm: FloatArray, normals: FloatArray, length_mm: float) -> OnArtefact:
    """The points on the plane that most points lie on; points_mm, normals : (n, 3) float64.

    What lies within a hundredth of the plane's length of it is on it.

    Raises
    ------
    NothingToReconstructError
        No plane holds enough of them.
    """
    rng = np.random.default_rng(0)
    step = max(len(points_mm) // _MOST_VOTES, 1)
    sparse, facing = points_mm[::step], normals[::step]
    extent_mm = float(np.linalg.norm(np.ptp(points_mm, axis=0))) if len(points_mm) else 0.0
    most, best = 0, (np.zeros(3), np.zeros(3))
    for seed in rng.integers(0, max(len(sparse), 1), _TRIALS if len(sparse) else 0):
        off = np.abs((sparse - sparse[seed]) @ facing[seed])
        votes = int(((off < 0.004 * extent_mm) & (facing @ facing[seed] > _TILT_COSINE)).sum())
        if votes > most:
            most, best = votes, (sparse[seed], facing[seed])
    near = np.abs((points_mm - best[0]) @ best[1]) < _SLAB * length_mm
    chosen = np.flatnonzero(near)
    for _ in range(_ROUNDS):
        if len(chosen) < FEWEST_POINTS:
            message = (
                f"expected a plane, found {len(chosen)} points on one; bring it into view, matt, and fill the view"
            )
            raise NothingToReconstructError(message)
        plane = fitted_plane(points_mm[chosen])
        near = np.abs((points_mm - plane.centre_mm) @ plane.normal) < _SLAB * length_mm
        chosen = np.flatnonzero(near & (np.abs(normals @ plane.normal) > _TURNED_COSINE))
    return OnArtefact(chosen, int(near.sum()) - len(chosen))


def _ball(points_mm: FloatArray, normals: FloatArray, radius_mm: float, left: NDArray[np.bool_]) -> OnArtefact | None:
    candidates = np.flatnonzero(left)
    voters = candidates[:: max(len(candidates) // _MOST_VOTES, 1)]
    if len(voters) == 0:
        return None
    votes = points_mm[voters] - radius_mm * normals[voters]
    # Late: as in `_sphere`.
    from scipy.spatial import cKDTree

    tree = cKDTree(votes)
    reach_mm = _VOTE_REACH * radius_mm
    counts = tree.query_ball_point(votes[::10], reach_mm, return_length=True)
    centre = votes[::10][int(np.argmax(counts))]
    for _ in range(_ROUNDS):
        near = tree.query_ball_point(centre, reach_mm)
        if not near:
            return None
        centre = votes[near].mean(axis=0)
    nominal_mm, shell_mm = radius_mm, _SHELL * radius_mm
    near, inside = candidates, candidates
    for turn in range(_ROUNDS):
        outwards = points_mm[candidates] - centre
        distance = np.linalg.norm(outwards, axis=1)
        along = (outwards * normals[candidates]).sum(axis=1) / np.maximum(distance, 1e-12)
        close = np.abs(distance - radius_mm) < shell_mm
        # The centre that votes found is a rough one: at first, only what faces as the ball does tells a better one.
        facing = along > (_TURNED_COSINE if turn else _TILT_COSINE)
        near, inside = candidates[close], candidates[close & facing]
        if len(inside) < FEWEST_POINTS:
            return None
        fit = fitted_sphere(points_mm[inside])
        centre, radius_mm = fit.centre_mm, fit.radius_mm
        if abs(radius_mm - nominal_mm) > _SHELL * nominal_mm:
            return None
    return OnArtefact(inside, len(near) - len(inside))
