"""One capture of an artefact as figures: its points picked out of the scan, and the errors that they show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.accept.plan import AcceptancePlan, Artefact, Quantity, Step
from slrig.calibration.artefacts import FittedPlane, FittedSphere, fitted_plane, fitted_sphere
from slrig.calibration.artefacts import flatness as flatness_of
from slrig.calibration.artefacts import probing as probing_of
from slrig.calibration.artefacts import spacing as spacing_of
from slrig.calibration.segmentation import ball_points, plane_points, seen_well
from slrig.errors import NothingToReconstructError
from slrig.model import Calibration, FloatArray, IntArray, Mesh

BORDER_RINGS = 2
"""Points so few steps from a border of the mesh do not count: there a stripe is cut, and its middle is not where it
seems. A step is about one pixel along a stripe, and one column across."""


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
    errors_mm: Mapping[Quantity, float]
    limits_mm: Mapping[Quantity, float]
    noise_mm: float
    sigma_mm: float
    dispersion_mm: float
    on_artefact: int
    steep: int
    at_border: int
    used: int
    rejected_share: float

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
    """The errors that a scan of one position shows.

    Raises
    ------
    NothingToReconstructError
        The artefact is not in the scan, or too little of it counts.
    """
    points, normals = mesh.vertices_mm.astype(np.float64), mesh.normals.astype(np.float64)
    sigma = mesh.sigma_mm.astype(np.float64)
    try:
        parts = _parts(points, normals, step, plan)
        devices = [*rig.cameras.values(), *([] if rig.projector is None else [rig.projector])]
        facing = seen_well(points, normals, [device.centre_mm for device in devices])
        inner = ~near_border(mesh.faces, len(points), rings=BORDER_RINGS)
        kept = [part[facing[part] & inner[part]] for part in parts]
        fits = [_fit(points[each], step) for each in kept]
        errors, rejected = _errors(step, [points[each] for each in kept], plan)
    except NothingToReconstructError as cause:
        message = f"{step.name}: {cause}"
        raise NothingToReconstructError(message) from cause
    whole, counted = np.concatenate(parts), np.concatenate(kept)
    noise_mm = float(np.sqrt(np.mean(sigma[counted] ** 2)))
    distances = np.full(len(points), np.nan)
    artefact = np.zeros(len(points), np.uint8)
    for number, (part, fit) in enumerate(zip(parts, fits, strict=True), 1):
        artefact[part] = number
        distances[part] = _off(points[part], fit)
    used = np.zeros(len(points), dtype=bool)
    used[counted] = True
    off = np.concatenate([fit.distances_mm for fit in fits])
    found = Reading(
        step=step.name,
        take=take,
        errors_mm=errors,
        limits_mm={quantity: plan.limits.limit_mm(quantity, noise_mm) for quantity in errors},
        noise_mm=noise_mm,
        sigma_mm=float(np.std(off)),
        dispersion_mm=_shell_mm(off),
        on_artefact=len(whole),
        steep=int((~facing[whole]).sum()),
        at_border=int((facing[whole] & ~inner[whole]).sum()),
        used=len(counted),
        rejected_share=rejected,
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


def _fit(points: FloatArray, step: Step) -> FittedSphere | FittedPlane:
    return fitted_plane(points) if step.artefact is Artefact.PLANE else fitted_sphere(points)


def _off(points: FloatArray, fit: FittedSphere | FittedPlane) -> FloatArray:
    """(n,) how far the points lie from the fit; of a plane, towards its normal."""
    if isinstance(fit, FittedPlane):
        return np.asarray((points - fit.centre_mm) @ fit.normal)
    return np.asarray(np.linalg.norm(points - fit.centre_mm, axis=1) - fit.radius_mm)


def _errors(step: Step, parts: list[FloatArray], plan: AcceptancePlan) -> tuple[dict[Quantity, float], float]:
    """The errors of a position by quantity, mm, and the share of points left out of the fits."""
    if step.artefact is Artefact.SPHERE:
        probed = probing_of(parts[0], plan.artefacts.diameter.value_mm)
        return {Quantity.FORM: probed.form_mm, Quantity.SIZE: probed.size_mm}, probed.rejected_share
    if step.artefact is Artefact.BAR:
        spaced = spacing_of(parts[0], parts[1], plan.artefacts.distance.value_mm)
        return {Quantity.SPACING: spaced.error_mm}, spaced.rejected_share
    flat = flatness_of(parts[0])
    return {Quantity.FLATNESS: flat.form_mm}, flat.rejected_share


def _shell_mm(distances_mm: FloatArray) -> float:
    """The narrowest shell that holds 95 % of the distances (D95 %)."""
    rising = np.sort(distances_mm)
    inside = int(np.ceil(0.95 * len(rising)))
    return float((rising[inside - 1 :] - rising[: len(rising) - inside + 1]).min())
