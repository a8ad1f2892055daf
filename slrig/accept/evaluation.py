"""One capture of an artefact as figures: its points picked out of the scan, and the errors that they show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

from slrig.accept.plan import AcceptancePlan, Artefact, Quantity, Step
from slrig.calibration.artefacts import (
    FittedPlane,
    FittedSphere,
    ball_points,
    dispersion_mm,
    fitted_plane,
    fitted_sphere,
    plane_points,
    seen_well,
)
from slrig.errors import NothingToReconstructError
from slrig.model import Calibration, FloatArray, IntArray, Mesh

BORDER_RINGS = 2
"""Points so few steps from a border of the mesh do not count: there a stripe is cut, and its middle is not where it
seems. A step is about one pixel along a stripe, and one column across."""

Measured = Annotated[float, BeforeValidator(lambda given: math.nan if given is None else given)]
"""A number that may be NaN, for which JSON holds null."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What one capture showed.

    step : name of the position; take : how many times it was measured before. errors_mm : by quantity; limits_mm : the
    limit of each, here. noise_mm : root mean square of the standard deviations that the scan states for the points
    used; sigma_mm, dispersion_mm : standard deviation of their distances from the fit, and the shell that holds 95 % of
    them. on_artefact : points found on it; steep, at_border : of them left out as seen too obliquely, or too near a
    border; used : the others. rejected_share : of those, left out of the fit as furthest off.
    """

    step: str
    take: int
    errors_mm: Mapping[Quantity, Measured]
    limits_mm: Mapping[Quantity, Measured]
    noise_mm: Measured
    sigma_mm: Measured
    dispersion_mm: Measured
    on_artefact: int
    steep: int
    at_border: int
    used: int
    rejected_share: Measured

    @property
    def beyond(self) -> bool:
        """Whether an error is beyond its limit."""
        return any(abs(error) > self.limits_mm[quantity] for quantity, error in self.errors_mm.items())


@dataclass(frozen=True, slots=True)
class Evidence:
    """The points behind a reading.

    points_mm : (n, 3) float64, all of the scan; artefact : (n,) uint8, 0 elsewhere, 1 on the plane, the sphere or the
    first ball, 2 on the second; used : (n,) bool; distances_mm : (n,) float64, from the fit, along the normal, NaN off
    the artefact; sigma_mm : (n,) float64, as the scan states it.
    """

    points_mm: FloatArray
    artefact: NDArray[np.uint8]
    used: NDArray[np.bool_]
    distances_mm: FloatArray
    sigma_mm: FloatArray


def reading(mesh: Mesh, step: Step, take: int, plan: AcceptancePlan, rig: Calibration) -> tuple[Reading, Evidence]:
    """The errors that a scan of one position shows, and its points.

    Raises NothingToReconstructError if the artefact is not in the scan, or too little of it counts.
    """
    points, normals = mesh.vertices_mm.astype(np.float64), mesh.normals.astype(np.float64)
    sigma = mesh.sigma_mm.astype(np.float64)
    try:
        parts = _parts(points, normals, step, plan)
        devices = [*rig.cameras.values(), *([] if rig.projector is None else [rig.projector])]
        facing = seen_well(points, normals, [device.centre_mm for device in devices])
        inner = ~near_border(mesh.faces, len(points), rings=BORDER_RINGS)
        kept = [part[facing[part] & inner[part]] for part in parts]
        fit = fitted_plane if step.artefact is Artefact.PLANE else fitted_sphere
        fits: list[FittedSphere | FittedPlane] = [fit(points[each]) for each in kept]
    except NothingToReconstructError as cause:
        message = f"{step.name}: {cause}"
        raise NothingToReconstructError(message) from cause
    whole, counted = np.concatenate(parts), np.concatenate(kept)
    noise_mm = float(np.sqrt(np.mean(sigma[counted] ** 2)))
    distances = np.full(len(points), np.nan)
    artefact = np.zeros(len(points), np.uint8)
    for number, (part, fitted) in enumerate(zip(parts, fits, strict=True), 1):
        artefact[part] = number
        distances[part] = _off(points[part], fitted)
    used = np.zeros(len(points), dtype=bool)
    used[counted] = True
    off = np.concatenate([each.distances_mm for each in fits])
    errors = _errors_mm(fits, plan)
    found = Reading(
        step=step.name,
        take=take,
        errors_mm=errors,
        limits_mm={quantity: plan.limits.limit_mm(quantity, noise_mm) for quantity in errors},
        noise_mm=noise_mm,
        sigma_mm=float(np.std(off)),
        dispersion_mm=dispersion_mm(off),
        on_artefact=len(whole),
        steep=int((~facing[whole]).sum()),
        at_border=int((facing[whole] & ~inner[whole]).sum()),
        used=len(counted),
        rejected_share=sum(each.rejected for each in fits) / len(counted),
    )
    return found, Evidence(points, artefact, used, distances, sigma)


def near_border(faces: IntArray, count: int, *, rings: int) -> NDArray[np.bool_]:
    """(count,) bool: vertices on a border of a mesh, (F, 3), or at most `rings` edges from one; and those of no face.

    A border is an edge of one face only.

    >>> near_border(np.array([[0, 1, 2]]), 4, rings=0).tolist()
    [True, True, True, True]
    """
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    keys, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    lone = keys[uses == 1]
    near = np.ones(count, dtype=bool)
    near[faces.ravel()] = False
    near[lone // count] = near[lone % count] = True
    for _ in range(rings):
        near[faces[near[faces].any(axis=1)].ravel()] = True
    return near


def _parts(points: FloatArray, normals: FloatArray, step: Step, plan: AcceptancePlan) -> list[NDArray[np.intp]]:
    if step.artefact is Artefact.PLANE:
        return [plane_points(points, normals)]
    if step.artefact is Artefact.SPHERE:
        return ball_points(points, normals, plan.artefacts.diameter.value_mm, 1)
    return ball_points(points, normals, plan.artefacts.ball_mm, 2)


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
                Quantity.SIZE: 2 * sphere.radius_mm - plan.artefacts.diameter.value_mm,
            }
    apart_mm = float(np.linalg.norm(fits[0].centre_mm - fits[1].centre_mm))
    return {Quantity.SPACING: apart_mm - plan.artefacts.distance.value_mm}
