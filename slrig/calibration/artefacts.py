"""Errors of measured artefacts in the manner of VDI/VDE 2634 part 2 and ISO 10360-13: spheres, ball bars, planes.

No conformity is claimed. A sphere or plane is fitted by least squares of the distances to it; at most three points in a
thousand, those that lie furthest off, are left out, and how many is said.
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

FEWEST_POINTS = 100
_DISPERSED = 0.95


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


@dataclass(frozen=True, slots=True)
class Probing:
    """Probing errors of one sphere, mm.

    form_mm : PF, the range of the radial distances; size_mm : PS, measured less calibrated diameter; dispersion_mm :
    the width of the shell that holds 95 % of the points (D95 %, ISO 10360-13); sigma_mm : standard deviation of the
    radial distances. rejected_share : of all points.
    """

    form_mm: float
    size_mm: float
    dispersion_mm: float
    sigma_mm: float
    points: int
    rejected_share: float


@dataclass(frozen=True, slots=True)
class Spacing:
    """Error of one distance of two sphere centres, mm: SD, measured less calibrated."""

    error_mm: float
    measured_mm: float
    rejected_share: float


@dataclass(frozen=True, slots=True)
class Flatness:
    """Flatness error of one plane, mm: F, the range of the distances; the shell that holds 95 %; their deviation."""

    form_mm: float
    dispersion_mm: float
    sigma_mm: float
    points: int
    rejected_share: float


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


def probing(points_mm: FloatArray, diameter_mm: float) -> Probing:
    """Probing errors of a sphere of known diameter; its points, (n, 3) mm, in the world.

    Raises
    ------
    NothingToReconstructError
        There are too few points.
    """
    found = fitted_sphere(points_mm)
    distances = found.distances_mm
    return Probing(
        form_mm=float(np.ptp(distances)),
        size_mm=2 * found.radius_mm - diameter_mm,
        dispersion_mm=_dispersion(distances),
        sigma_mm=float(np.std(distances)),
        points=len(points_mm),
        rejected_share=found.rejected / len(points_mm),
    )


def spacing(first_mm: FloatArray, second_mm: FloatArray, distance_mm: float) -> Spacing:
    """Error of the distance of two balls' centres; their points, (n, 3) and (m, 3) mm. Radii are free.

    Raises
    ------
    NothingToReconstructError
        There are too few points.
    """
    first, second = fitted_sphere(first_mm), fitted_sphere(second_mm)
    measured = float(np.linalg.norm(first.centre_mm - second.centre_mm))
    rejected = (first.rejected + second.rejected) / (len(first_mm) + len(second_mm))
    return Spacing(measured - distance_mm, measured, rejected)


def flatness(points_mm: FloatArray) -> Flatness:
    """Flatness error of a plane; its points, (n, 3) mm. Raises NothingToReconstructError."""
    found = fitted_plane(points_mm)
    distances = found.distances_mm
    return Flatness(
        form_mm=float(np.ptp(distances)),
        dispersion_mm=_dispersion(distances),
        sigma_mm=float(np.std(distances)),
        points=len(points_mm),
        rejected_share=found.rejected / len(points_mm),
    )


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


def _dispersion(distances_mm: FloatArray) -> float:
    """The narrowest interval that holds 95 % of the distances."""
    rising = np.sort(distances_mm)
    inside = int(np.ceil(_DISPERSED * len(rising)))
    return float((rising[inside - 1 :] - rising[: len(rising) - inside + 1]).min())


def _require_enough(points_mm: FloatArray, what: str) -> None:
    if len(points_mm) < FEWEST_POINTS:
        message = (
            f"{what} is fitted to {FEWEST_POINTS} points or more, found {len(points_mm)}; bring the artefact into view "
            "of camera and projector, and matt"
        )
        raise NothingToReconstructError(message)
