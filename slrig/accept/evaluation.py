"""Evaluation of an acceptance test: errors of one capture, their uncertainties, and the decision by all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

from slrig.accept.plan import REFERENCE_C, AcceptancePlan, Artefact, Artefacts, Limits, Quantity, Step
from slrig.calibration import (
    ArtefactPoints,
    Decision,
    FittedPlane,
    FittedSphere,
    decide,
    dispersion_mm,
    find_balls,
    find_plane,
    fit_plane,
    fit_sphere,
)
from slrig.calibration.judgement import MIN_SCALE_ERROR, SCALE_SIGMAS
from slrig.errors import NothingToReconstructError, setting
from slrig.model import Calibration, FloatArray, Mesh

Measured = Annotated[float, BeforeValidator(lambda given: math.nan if given is None else given)]
"""A number that may be NaN, for which JSON holds null."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Errors of one capture.

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
    """The errors of a quantity by position, mm, of each capture there; positions without it are left out."""
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


FORMULA = "U = sqrt(U_certificate^2 + U_form^2 + U_temperature^2 + U_fixture^2)"
_HALF_TO_DEVIATION = 1 / math.sqrt(3)  # of a rectangular distribution
_EXPANSION_WITHIN_PER_K = 1.0e-6
"""Steels differ by so much (ISO 3650); other materials are taken to be known no better."""
_STATED_WITHIN_K = 1.0
"""Chosen: a room's thermometer, and an artefact that has not quite taken the room's temperature."""
_ROOM_WITHIN_K = 5.0
"""Chosen: a room of unknown temperature, about the reference of 20 °C."""


@dataclass(frozen=True, slots=True)
class ErrorUncertainty:
    """Expanded uncertainties (k = 2) of an error, mm, by cause; None where the certificate's is not stated."""

    certificate_mm: float | None
    form_mm: float | None
    temperature_mm: float
    fixture_mm: float

    @property
    def expanded_mm(self) -> float:
        """U by `FORMULA`, without parts that are not stated."""
        return math.hypot(self.certificate_mm or 0.0, self.form_mm or 0.0, self.temperature_mm, self.fixture_mm)


def error_uncertainty(quantity: Quantity, artefacts: Artefacts) -> ErrorUncertainty:
    """Contribution of the artefact of a quantity to its error.

    An artefact out of form by F has u = F / 2 (ISO/TS 23165), with k = 2 F itself; a sphere's diameter found from the
    visible part may differ from the certified one by as much. A length L of thermal expansion a at a temperature t
    has u^2 = (L a u(t))^2 + (L (t - 20 °C) u(a))^2.
    """
    certified = {Quantity.SIZE: artefacts.diameter, Quantity.SPACING: artefacts.distance}.get(quantity)
    form_mm: float | None = 0.0
    if quantity in {Quantity.FORM, Quantity.SIZE}:
        form_mm = artefacts.sphere_form_mm
    elif quantity is Quantity.FLATNESS:
        form_mm = artefacts.plane_form_mm
    return ErrorUncertainty(
        certificate_mm=0.0 if certified is None else certified.uncertainty_mm,
        form_mm=form_mm,
        temperature_mm=0.0 if certified is None else _temperature_mm(certified.value_mm, artefacts),
        fixture_mm=artefacts.fixture_mm,
    )


def _temperature_mm(length_mm: float, artefacts: Artefacts) -> float:
    if artefacts.expansion_per_k == 0:
        return 0.0
    stated = artefacts.temperature_c is not None
    warmer_k = 0.0 if artefacts.temperature_c is None else artefacts.temperature_c - REFERENCE_C
    by_temperature = artefacts.expansion_per_k * (_STATED_WITHIN_K if stated else _ROOM_WITHIN_K)
    by_expansion = warmer_k * _EXPANSION_WITHIN_PER_K
    return 2 * length_mm * math.hypot(by_temperature, by_expansion) * _HALF_TO_DEVIATION


_FEWEST_PLACES = 3
"""Chosen: in fewer, a bent volume cannot be distinguished from one that is too large."""


@dataclass(frozen=True, slots=True)
class Scale:
    """share : excess of a bar's measured length over its certificate's, over its length, the mean of all places.

    sigma : of that, from the differences of places and the bar's uncertainty; places : number of places where it was
    measured. words : the fault and its remedy; None without one.
    """

    share: float
    sigma: float
    places: int
    words: str | None


def scale_by_bar(readings: Sequence[Reading], artefacts: Artefacts) -> Scale | None:
    """The scale that the bar's readings show; None where the bar was measured in fewer than three places.

    It is reported from 0.1 % and from five of its standard deviations on, as the scale of a calibration is.
    """
    by_place = errors_by_step(readings, Quantity.SPACING)
    if len(by_place) < _FEWEST_PLACES:
        return None
    length_mm = artefacts.expanded_mm(artefacts.distance)
    shares = np.array([np.mean(errors) for errors in by_place.values()]) / length_mm
    share = float(shares.mean())
    known = error_uncertainty(Quantity.SPACING, artefacts).expanded_mm / 2 / length_mm
    sigma = float(np.hypot(shares.std(ddof=1) / np.sqrt(len(shares)), known))
    if abs(share) <= max(MIN_SCALE_ERROR, SCALE_SIGMAS * sigma):
        return Scale(share, sigma, len(shares), None)
    longer, smaller = ("longer", "smaller") if share > 0 else ("shorter", "larger")
    message = (
        f"the bar measures {abs(share):.2%} ± {100 * sigma:.1g}% {longer} than its certificate says, in all of "
        f"{len(shares)} places: everything does. The squares of the board that the rig was calibrated with are so much "
        f"{smaller} than they were said to be, or a device was moved since; measure both rulers of the board, give "
        f"{setting('measured_mm')}, and calibrate again"
    )
    return Scale(share, sigma, len(shares), message)


@dataclass(frozen=True, slots=True)
class QuantityVerdict:
    """One quantity over all positions. error_mm : of the reading with the largest, which is that of `step`, `take`.
    scatter_mm : the standard deviation of repeated captures, NaN where none were made; repeats : number of those.
    It is shown and decides nothing: the rig's own scatter is in its errors.
    """

    quantity: Quantity
    error_mm: float
    limit_mm: float
    step: str
    take: int
    uncertainty: ErrorUncertainty
    scatter_mm: float
    repeats: int
    decision: Decision


@dataclass(frozen=True, slots=True)
class AcceptanceResult:
    """A test that was done. readings : every capture in order. verdicts : by quantity."""

    rig: str
    begun: datetime
    ended: datetime
    plan: AcceptancePlan
    calibration: Calibration
    readings: tuple[Reading, ...]
    verdicts: tuple[QuantityVerdict, ...]

    @property
    def decision(self) -> Decision:
        """Fails if any quantity fails, passes if all pass."""
        found = {verdict.decision for verdict in self.verdicts}
        for worst in (Decision.FAILS, Decision.UNDECIDED):
            if worst in found:
                return worst
        return Decision.PASSES

    @property
    def scale(self) -> Scale | None:
        """Whether everything measures too long or too short; None where the bar was not measured, or in few places."""
        return scale_by_bar(self.readings, self.plan.artefacts)

    @property
    def complete(self) -> bool:
        """Whether every position was measured as often as planned."""
        return len(self.readings) == len(self.plan.takes)


def verdicts(readings: Sequence[Reading], plan: AcceptancePlan) -> tuple[QuantityVerdict, ...]:
    """Verdict on each measured quantity."""
    measured = {quantity for each in readings for quantity in each.errors_mm}
    return tuple(_verdict(quantity, readings, plan) for quantity in Quantity if quantity in measured)


def _verdict(quantity: Quantity, readings: Sequence[Reading], plan: AcceptancePlan) -> QuantityVerdict:
    having = [each for each in readings if quantity in each.errors_mm]
    worst = max(having, key=lambda each: abs(each.errors_mm[quantity]))
    error, limit = worst.errors_mm[quantity], plan.limits.limit_mm(quantity)
    uncertainty = error_uncertainty(quantity, plan.artefacts)
    return QuantityVerdict(
        quantity, error, limit, worst.step, worst.take, uncertainty, *_scatter(quantity, having),
        decide(error, limit, uncertainty.expanded_mm),
    )  # fmt: skip


def _scatter(quantity: Quantity, readings: Sequence[Reading]) -> tuple[float, int]:
    """Standard deviation of repeated captures of one position, mm, and how many they were; NaN and 0 without any."""
    repeated = [np.array(errors) for errors in errors_by_step(readings, quantity).values() if len(errors) > 1]
    if not repeated:
        return float("nan"), 0
    count = sum(len(errors) for errors in repeated)
    squares = sum(float(((errors - errors.mean()) ** 2).sum()) for errors in repeated)
    return float(np.sqrt(squares / (count - len(repeated)))), count
