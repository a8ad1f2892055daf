"""Fit of spheres and planes to the points of an artefact in a scan, and the decision about its errors.

After VDI/VDE 2634 part 2 and ISO 10360-13; no conformity is claimed. Least squares of the distances; at most three
points in a thousand, those with the largest distances, are rejected and counted. All other measured points of the
artefact count, also at its rim and at grazing views.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import NothingToReconstructError
from slrig.model import FloatArray

MAX_REJECTED_FRACTION = 0.003
"""Largest fraction of points that is rejected (VDI/VDE 2634-2)."""

MIN_POINTS = 100
_DISPERSION_FRACTION = 0.95
_MAX_VOTERS = 20_000
_VOTE_RADIUS = 0.08  # of the ball's radius: spread of the centres that single normals point at
_SHELL_DEPTH = 0.05  # of the ball's radius: points that are nearer to the sphere belong to it
_SLAB_DEPTH = 0.01  # of the plane's length: points that are nearer to the plane belong to it
_ITERATIONS = 4
_TRIALS = 200
_MIN_FACING_COSINE = np.cos(np.deg2rad(15.0))
_MIN_SURFACE_COSINE = np.cos(np.deg2rad(45.0))
"""Points that face farther away belong to another object that touches the artefact: a rod or foot of up to half a
ball's radius leaves the ball at 60 degrees or more. Noise turns few normals so far."""


@dataclass(frozen=True, slots=True)
class FittedSphere:
    """A sphere fitted to points. centre_mm : (3,); distances_mm : (n,) of the inliers, positive outwards."""

    centre_mm: FloatArray
    radius_mm: float
    distances_mm: FloatArray
    rejected: int


@dataclass(frozen=True, slots=True)
class FittedPlane:
    """A plane fitted to points. normal : (3,), unit; distances_mm : (n,) of the inliers, along the normal."""

    centre_mm: FloatArray
    normal: FloatArray
    distances_mm: FloatArray
    rejected: int


class ArtefactPoints(NamedTuple):
    """Indices of the points on an artefact, (n,), and the number of points that are as near but face another way."""

    points: NDArray[np.intp]
    misoriented: int


class Decision(StrEnum):
    """Decision about an error and its limit, given the measurement uncertainty (ISO 14253-1)."""

    PASSES = "passes"
    FAILS = "fails"
    UNDECIDED = "undecided"


def decide(error_mm: float, limit_mm: float, uncertainty_mm: float) -> Decision:
    """Pass if |error| is below the limit by the expanded uncertainty (k = 2), fail if it is above by as much.

    >>> decide(-0.012, 0.02, 0.003).value, decide(0.019, 0.02, 0.003).value, decide(0.03, 0.02, 0.003).value
    ('passes', 'undecided', 'fails')
    """
    if abs(error_mm) <= limit_mm - uncertainty_mm:
        return Decision.PASSES
    return Decision.FAILS if abs(error_mm) > limit_mm + uncertainty_mm else Decision.UNDECIDED


def fit_sphere(points_mm: FloatArray) -> FittedSphere:
    """Fit a sphere of free radius to points (n, 3) mm. Raises NothingToReconstructError where there are too few."""
    _require_enough(points_mm, "a sphere")
    centre, radius = _sphere(points_mm)
    inliers = _inliers(np.linalg.norm(points_mm - centre, axis=1) - radius)
    centre, radius = _sphere(points_mm[inliers])
    distances = np.linalg.norm(points_mm[inliers] - centre, axis=1) - radius
    return FittedSphere(centre, radius, distances, int((~inliers).sum()))


def fit_plane(points_mm: FloatArray) -> FittedPlane:
    """Fit a plane to points (n, 3) mm. Raises NothingToReconstructError where there are too few."""
    _require_enough(points_mm, "a plane")
    centre, normal = _plane(points_mm)
    inliers = _inliers((points_mm - centre) @ normal)
    centre, normal = _plane(points_mm[inliers])
    return FittedPlane(centre, normal, (points_mm[inliers] - centre) @ normal, int((~inliers).sum()))


def dispersion_mm(distances_mm: FloatArray) -> float:
    """Width of the narrowest shell that holds 95 % of the distances (D95 %, ISO 10360-13)."""
    ordered = np.sort(distances_mm)
    inside = int(np.ceil(_DISPERSION_FRACTION * len(ordered)))
    return float((ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]).min())


def _sphere(points_mm: FloatArray) -> tuple[FloatArray, float]:
    # Start from the algebraic sphere about the centroid, |p|² = 2 c·p + (r² - |c|²).
    centroid = points_mm.mean(axis=0)
    relative = points_mm - centroid
    system = np.column_stack([2 * relative, np.ones(len(relative))])
    algebraic = np.linalg.lstsq(system, (relative**2).sum(axis=1), rcond=None)[0]
    start = np.append(algebraic[:3], np.sqrt(max(algebraic[3] + algebraic[:3] @ algebraic[:3], 1e-12)))

    def distances(parameters: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(relative - parameters[:3], axis=1) - parameters[3])

    def jacobian(parameters: FloatArray) -> FloatArray:
        outwards = relative - parameters[:3]
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        return np.column_stack([-outwards, -np.ones(len(relative))])

    # Imported here: the service imports this module and needs no solver.
    from scipy.optimize import least_squares

    found = least_squares(distances, start, jac=jacobian, method="lm", xtol=1e-12, ftol=1e-12).x
    return centroid + found[:3], float(found[3])


def _plane(points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    centre = points_mm.mean(axis=0)
    relative = points_mm - centre
    # Eigenvector of the least eigenvalue of the scatter matrix: the direction of least spread.
    return centre, np.linalg.eigh(relative.T @ relative)[1][:, 0]


def _inliers(distances_mm: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: False for the points with the largest distances, up to MAX_REJECTED_FRACTION."""
    count = int(MAX_REJECTED_FRACTION * len(distances_mm))
    inliers = np.ones(len(distances_mm), dtype=bool)
    if count:
        inliers[np.argpartition(np.abs(distances_mm), -count)[-count:]] = False
    return inliers


def _require_enough(points_mm: FloatArray, what: str) -> None:
    if len(points_mm) < MIN_POINTS:
        message = (
            f"{what} is fitted to {MIN_POINTS} points or more, found {len(points_mm)}; bring the artefact into view "
            "of camera and projector, and make it matt"
        )
        raise NothingToReconstructError(message)


def find_balls(points_mm: FloatArray, normals: FloatArray, diameter_mm: float, count: int) -> list[ArtefactPoints]:
    """Find the points on each of `count` balls of one diameter, the ball with most points first.

    points_mm, normals : (n, 3) float64, outward normals. Each normal votes for the centre one radius below its point.

    Raises NothingToReconstructError where there are fewer balls of that size.
    """
    radius_mm = diameter_mm / 2
    unused = np.ones(len(points_mm), dtype=bool)
    found: list[ArtefactPoints] = []
    for number in range(count):
        inside = _find_ball(points_mm, normals, radius_mm, unused)
        if inside is None:
            message = (
                f"expected {count} ball{'s' if count > 1 else ''} of {diameter_mm:g} mm, found {number}; bring the "
                "whole artefact into view, make it matt, and give its certified diameter"
            )
            raise NothingToReconstructError(message)
        found.append(inside)
        unused[inside.points] = False
    return sorted(found, key=lambda ball: len(ball.points), reverse=True)


def find_plane(points_mm: FloatArray, normals: FloatArray, length_mm: float) -> ArtefactPoints:
    """Find the points on the plane that holds most points; points_mm, normals : (n, 3) float64.

    Raises NothingToReconstructError where no plane holds enough points.
    """
    rng = np.random.default_rng(0)
    step = max(len(points_mm) // _MAX_VOTERS, 1)
    sparse, facing = points_mm[::step], normals[::step]
    extent_mm = float(np.linalg.norm(np.ptp(points_mm, axis=0))) if len(points_mm) else 0.0
    max_votes, best = 0, (np.zeros(3), np.zeros(3))
    for seed in rng.integers(0, max(len(sparse), 1), _TRIALS if len(sparse) else 0):
        off = np.abs((sparse - sparse[seed]) @ facing[seed])
        votes = int(((off < 0.004 * extent_mm) & (facing @ facing[seed] > _MIN_FACING_COSINE)).sum())
        if votes > max_votes:
            max_votes, best = votes, (sparse[seed], facing[seed])
    near = np.abs((points_mm - best[0]) @ best[1]) < _SLAB_DEPTH * length_mm
    chosen = np.flatnonzero(near)
    for _ in range(_ITERATIONS):
        if len(chosen) < MIN_POINTS:
            message = (
                f"expected a plane, found {len(chosen)} points on one; bring it into view, make it matt, and fill the "
                "view with it"
            )
            raise NothingToReconstructError(message)
        plane = fit_plane(points_mm[chosen])
        near = np.abs((points_mm - plane.centre_mm) @ plane.normal) < _SLAB_DEPTH * length_mm
        chosen = np.flatnonzero(near & (np.abs(normals @ plane.normal) > _MIN_SURFACE_COSINE))
    return ArtefactPoints(chosen, int(near.sum()) - len(chosen))


def _find_ball(
    points_mm: FloatArray, normals: FloatArray, radius_mm: float, unused: NDArray[np.bool_]
) -> ArtefactPoints | None:
    candidates = np.flatnonzero(unused)
    voters = candidates[:: max(len(candidates) // _MAX_VOTERS, 1)]
    if len(voters) == 0:
        return None
    votes = points_mm[voters] - radius_mm * normals[voters]
    # Imported here as in `_sphere`.
    from scipy.spatial import cKDTree

    tree = cKDTree(votes)
    reach_mm = _VOTE_RADIUS * radius_mm
    counts = tree.query_ball_point(votes[::10], reach_mm, return_length=True)
    centre = votes[::10][int(np.argmax(counts))]
    for _ in range(_ITERATIONS):
        near = tree.query_ball_point(centre, reach_mm)
        if not near:
            return None
        centre = votes[near].mean(axis=0)
    nominal_mm, shell_mm = radius_mm, _SHELL_DEPTH * radius_mm
    near, inside = candidates, candidates
    for iteration in range(_ITERATIONS):
        outwards = points_mm[candidates] - centre
        distance = np.linalg.norm(outwards, axis=1)
        facing_cosine = (outwards * normals[candidates]).sum(axis=1) / np.maximum(distance, 1e-12)
        close = np.abs(distance - radius_mm) < shell_mm
        # The centre from the votes is rough: the first fit uses only points that face as the ball does.
        facing = facing_cosine > (_MIN_SURFACE_COSINE if iteration else _MIN_FACING_COSINE)
        near, inside = candidates[close], candidates[close & facing]
        if len(inside) < MIN_POINTS:
            return None
        fit = fit_sphere(points_mm[inside])
        centre, radius_mm = fit.centre_mm, fit.radius_mm
        if abs(radius_mm - nominal_mm) > _SHELL_DEPTH * nominal_mm:
            return None
    return ArtefactPoints(inside, len(near) - len(inside))
