"""Spheres and planes fitted to scans of artefacts, and the decision, after VDI/VDE 2634 part 2 and ISO 10360-13.

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
