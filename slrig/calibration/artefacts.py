"""Which points of a scan lie on an artefact, the sphere or plane fitted to them, and the decision.

After VDI/VDE 2634 part 2 and ISO 10360-13; no conformity is claimed. A sphere or plane is fitted by least squares of
the distances to it; at most three points in a thousand, those that lie furthest off, are left out, and how many is
said.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slrig.errors import NothingToReconstructError
from slrig.model import FloatArray

REJECTED_SHARE = 0.003
"""At most this share of the points is left out (VDI/VDE 2634-2)."""

STEEPEST_DEG = 60.0
"""Points that a device sees more obliquely than this do not count."""

FEWEST_POINTS = 100
_DISPERSED = 0.95
_MOST_VOTES = 20_000
_VOTE_REACH = 0.08  # of the radius: how far the centres that single normals point at may lie from one another
_SHELL = 0.05  # of the radius, at first
_DEVIATIONS = 8.0
_ROUNDS = 4
_TRIALS = 200
_TILT_COSINE = np.cos(np.deg2rad(15.0))


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


def ball_points(points_mm: FloatArray, normals: FloatArray, diameter_mm: float, count: int) -> list[NDArray[np.intp]]:
    """Indices of the points on each of `count` balls of one diameter, the ball with most points first.

    points_mm, normals : (n, 3) float64, the normals outwards. Each normal points back to its ball's centre, one radius
    below the surface: where most of them meet is a centre.

    Raises
    ------
    NothingToReconstructError
        There are fewer balls of that size.
    """
    radius_mm = diameter_mm / 2
    left = np.ones(len(points_mm), dtype=bool)
    found: list[NDArray[np.intp]] = []
    for number in range(count):
        inside = _ball(points_mm, normals, radius_mm, left)
        if inside is None:
            message = (
                f"expected {count} ball{'s' if count > 1 else ''} of {diameter_mm:g} mm, found {number}; bring the "
                "artefact wholly into view, matt, and name its certified diameter"
            )
            raise NothingToReconstructError(message)
        found.append(inside)
        left[inside] = False
    return sorted(found, key=len, reverse=True)


def plane_points(points_mm: FloatArray, normals: FloatArray) -> NDArray[np.intp]:
    """Indices of the points on the plane that most points lie on; points_mm, normals : (n, 3) float64.

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
    reach_mm = 0.01 * extent_mm
    chosen = np.flatnonzero(np.abs((points_mm - best[0]) @ best[1]) < reach_mm)
    for _ in range(_ROUNDS):
        if len(chosen) < FEWEST_POINTS:
            message = (
                f"expected a plane, found {len(chosen)} points on one; bring it into view, matt, and fill the view"
            )
            raise NothingToReconstructError(message)
        plane = fitted_plane(points_mm[chosen])
        off = np.abs((points_mm - plane.centre_mm) @ plane.normal)
        # What stands on the plane is far off; its own noise and form are not.
        reach_mm = min(reach_mm, _DEVIATIONS * _deviation(off[chosen]))
        chosen = np.flatnonzero((off < reach_mm) & (np.abs(normals @ plane.normal) > _TILT_COSINE))
    return chosen


def seen_well(points_mm: FloatArray, normals: FloatArray, centres_mm: list[FloatArray]) -> NDArray[np.bool_]:
    """(n,) bool: points whose normal is less than 60 degrees from the direction to every device.

    centres_mm : the devices' centres of projection in the world, (3,) each.
    """
    good = np.ones(len(points_mm), dtype=bool)
    for centre in centres_mm:
        towards = centre - points_mm
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        good &= (normals * towards).sum(axis=1) > np.cos(np.deg2rad(STEEPEST_DEG))
    return good


def _ball(
    points_mm: FloatArray, normals: FloatArray, radius_mm: float, left: NDArray[np.bool_]
) -> NDArray[np.intp] | None:
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
    inside = candidates
    for _ in range(_ROUNDS):
        outwards = points_mm[candidates] - centre
        distance = np.linalg.norm(outwards, axis=1)
        along = (outwards * normals[candidates]).sum(axis=1) / np.maximum(distance, 1e-12)
        inside = candidates[(np.abs(distance - radius_mm) < shell_mm) & (along > _TILT_COSINE)]
        if len(inside) < FEWEST_POINTS:
            return None
        fit = fitted_sphere(points_mm[inside])
        centre, radius_mm = fit.centre_mm, fit.radius_mm
        if abs(radius_mm - nominal_mm) > _SHELL * nominal_mm:
            return None
        shell_mm = min(shell_mm, max(_DEVIATIONS * _deviation(fit.distances_mm), 1e-6))
    return np.asarray(inside)


def _deviation(distances_mm: FloatArray) -> float:
    """Standard deviation by the median: what does not belong does not widen it."""
    return 1.4826 * float(np.median(np.abs(distances_mm - np.median(distances_mm))))
