"""One capture of an artefact as figures: its points picked out of the scan, and the errors that they show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

from slrig.accept.plan import AcceptancePlan, Artefact, Limits, Quantity, Step
from slrig.calibration import (
    ArtefactPoints,
    FittedPlane,
    FittedSphere,
    dispersion_mm,
    find_balls,
    find_plane,
    fit_plane,
    fit_sphere,
)
from slrig.errors import NothingToReconstructError
from slrig.model import FloatArray, Mesh

Measured = Annotated[float, BeforeValidator(lambda given: math.nan if given is None else given)]
"""A number that may be NaN, for which JSON holds null."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What one capture showed.

    step : name of the position; take : how many times it was measured before. errors_mm : by quantity. noise_mm : root
    mean square of the standard deviations that the scan states for the points used; sigma_mm, dispersion_mm : standard
    deviation of their distances from the fit, and the shell that holds 95 % of them. used : points on the artefact, all
    of which count, rim and oblique ones among them; turned : as `ArtefactPoints.misoriented`; rejected_share : of those
    used, left out of the fit as furthest off.
    """

    step: str
    take: int
    errors_mm: Mapping[Quantity, Measured]
    noise_mm: Measured
    sigma_mm: Measured
    dispersion_mm: Measured
    used: int
    turned: int
    rejected_share: Measured

    def beyond(self, limits: Limits) -> bool:
        """Whether an error is beyond its limit."""
        return any(abs(error) > limits.limit_mm(quantity) for quantity, error in self.errors_mm.items())


def errors_by_step(readings: Sequence[Reading], quantity: Quantity) -> dict[str, list[float]]:
    """The errors of a quantity by position, mm, of each capture there; positions that do not tell it are left out."""
    found: dict[str, list[float]] = {}
    for each in readings:
        if quantity in each.errors_mm:
            found.setdefault(each.step, []).append(each.errors_mm[quantity])
    return found


@dataclass(frozen=True, slots=True)
class ReadingPoints:
    """The points behind a reading.

    points_mm : (n, 3) float64, all of the scan; artefact : (n,) uint8, 0 elsewhere, 1 on the plane, the sphere or the
    first ball, 2 on the second; distances_mm : (n,) float64, from the fit, along the normal, NaN off the artefact;
    sigma_mm : (n,) float64, as the scan states it.
    """

    points_mm: FloatArray
    artefact: NDArray[np.uint8]
    distances_mm: FloatArray
    sigma_mm: FloatArray


def reading(mesh: Mesh, step: Step, take: int, plan: AcceptancePlan) -> tuple[Reading, ReadingPoints]:
    """The errors that a scan of one position shows, and its points.

    Raises NothingToReconstructError if the artefact is not in the scan, or too little of it.
    """
    points, normals = mesh.vertices_mm.astype(np.float64), mesh.normals.astype(np.float64)
    sigma = mesh.sigma_mm.astype(np.float64)
    try:
        parts = _parts(points, normals, step, plan)
        fit = fit_plane if step.artefact is Artefact.PLANE else fit_sphere
        fits: list[FittedSphere | FittedPlane] = [fit(points[each.points]) for each in parts]
    except NothingToReconstructError as cause:
        message = f"{step.name}: {cause}"
        raise NothingToReconstructError(message) from cause
    used = np.concatenate([each.points for each in parts])
    distances = np.full(len(points), np.nan)
    artefact = np.zeros(len(points), np.uint8)
    for number, (part, fitted) in enumerate(zip(parts, fits, strict=True), 1):
        artefact[part.points] = number
        distances[part.points] = _off(points[part.points], fitted)
    off = np.concatenate([each.distances_mm for each in fits])
    found = Reading(
        step=step.name,
        take=take,
        errors_mm=_errors_mm(fits, plan),
        noise_mm=float(np.sqrt(np.mean(sigma[used] ** 2))),
        sigma_mm=float(np.std(off)),
        dispersion_mm=dispersion_mm(off),
        used=len(used),
        turned=sum(each.misoriented for each in parts),
        rejected_share=sum(each.rejected for each in fits) / len(used),
    )
    return found, ReadingPoints(points, artefact, distances, sigma)


def _parts(points: FloatArray, normals: FloatArray, step: Step, plan: AcceptancePlan) -> list[ArtefactPoints]:
    if step.artefact is Artefact.PLANE:
        return [find_plane(points, normals, max(plan.artefacts.plane_mm))]
    if step.artefact is Artefact.SPHERE:
        return find_balls(points, normals, plan.artefacts.diameter.value_mm, 1)
    return find_balls(points, normals, plan.artefacts.ball_mm, 2)


def _off(points: FloatArray, fit: FittedSphere | FittedPlane) -> FloatArray:
    """(n,) how far the points lie from the fit; of a plane, towards its normal."""
    if isinstance(fit, FittedPlane):
        return np.asarray((points - fit.centre_mm) @ fit.normal)
    return np.asarray(np.linalg.norm(points - fit.centre_mm, axis=1) - fit.radius_mm)


def _errors_mm(fits: Sequence[FittedSphere | FittedPlane], plan: AcceptancePlan) -> dict[Quantity, float]:
    """The errors of a position, in the manner of VDI/VDE 2634-2: of a fitted plane, of a sphere, or of two balls."""
    match fits:
        case [FittedPlane() as plane]:
            return {Quantity.FLATNESS: float(np.ptp(plane.distances_mm))}
        case [FittedSphere() as sphere]:
            return {
                Quantity.FORM: float(np.ptp(sphere.distances_mm)),
                Quantity.SIZE: 2 * sphere.radius_mm - plan.artefacts.expanded_mm(plan.artefacts.diameter),
            }
    apart_mm = float(np.linalg.norm(fits[0].centre_mm - fits[1].centre_mm))
    return {Quantity.SPACING: apart_mm - plan.artefacts.expanded_mm(plan.artefacts.distance)}
