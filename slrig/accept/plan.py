"""What an acceptance test is to do, in the manner of VDI/VDE 2634 part 2: artefacts, limits, and the prescribed steps.

No conformity is claimed. The working volume is a box along the world's axes; L0 is its space diagonal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import PlainValidator

from slrig.errors import InvalidInputError
from slrig.model import FloatArray

Numbers = Annotated[FloatArray, PlainValidator(lambda given: np.array(given, np.float64))]
"""An array, float64, that pydantic reads from lists."""

WANTED_SHARE = 1 / 5000
"""Of L0: how far off a point may be where nobody says what the rig is for."""

USUAL_REPEATS = 3
STEEL_PER_K = 11.5e-6
"""Thermal expansion of an artefact where it is not told: steel's (gauge blocks, ISO 3650: 11.5e-6 +- 1.0e-6)."""
REFERENCE_C = 20.0
"""What certified lengths hold at (ISO 1)."""
_MOST_EXPANSION_PER_K = 1e-3  # ten times a plastic's: more is a slip of units
_SPHERE_SHARES = (0.02, 0.2)
_BAR_SHARE, _PLANE_SHARE, _PLANE_WIDTH_MM = 0.3, 0.5, 50.0
_MADE_SPHERE_SHARE, _MADE_BAR_SHARE, _MADE_PLANE_SHARES = 0.11, 0.4, (0.6, 0.42)


class Artefact(StrEnum):
    """What is measured."""

    SPHERE = "sphere"
    BAR = "bar"
    PLANE = "plane"


class Quantity(StrEnum):
    """What is told of a rig: probing error form and size, sphere spacing error, flatness error."""

    FORM = "PF"
    SIZE = "PS"
    SPACING = "SD"
    FLATNESS = "F"

    @property
    def words(self) -> str:
        """Its name for a person."""
        return {
            "PF": "probing error, form",
            "PS": "probing error, size",
            "SD": "sphere spacing error",
            "F": "flatness error",
        }[self]


@dataclass(frozen=True, slots=True)
class Certified:
    """A certified value and its expanded uncertainty (k = 2), mm. None: the certificate's was not told."""

    value_mm: float
    uncertainty_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Artefacts:
    """The artefacts as certified, matt.

    diameter : of the sphere. distance : of the bar's ball centres; its balls have bar_diameter_mm, or the sphere's.
    plane_mm : length and width. sphere_form_mm, plane_form_mm : by how much the artefact itself is out of form, the
    certificate's uncertainty of that included. certificate : as a person notes it. temperature_c : the artefacts', None
    where not told; expansion_per_k : of their material, 0 if they have none. fixture_mm : by how much one may move or
    bend where it stands while it is captured, an expanded uncertainty (k = 2).
    """

    diameter: Certified
    distance: Certified
    plane_mm: tuple[float, float]
    bar_diameter_mm: float | None = None
    sphere_form_mm: float | None = None
    plane_form_mm: float | None = None
    certificate: str = ""
    temperature_c: float | None = None
    expansion_per_k: float = STEEL_PER_K
    fixture_mm: float = 0.0

    @property
    def ball_mm(self) -> float:
        """Diameter of the bar's balls."""
        return self.diameter.value_mm if self.bar_diameter_mm is None else self.bar_diameter_mm

    def expanded_mm(self, certified: Certified) -> float:
        """A certified length as it is at the temperature told."""
        warmer_k = 0.0 if self.temperature_c is None else self.temperature_c - REFERENCE_C
        return certified.value_mm * (1 + self.expansion_per_k * warmer_k)


@dataclass(frozen=True, slots=True)
class Limits:
    """The greatest permissible errors (MPE), mm. They are agreed before the test, and nothing that is measured in it
    moves them.
    """

    form_mm: float
    size_mm: float
    spacing_mm: float
    flatness_mm: float

    def limit_mm(self, quantity: Quantity) -> float:
        """The limit of an error."""
        return {
            Quantity.FORM: self.form_mm,
            Quantity.SIZE: self.size_mm,
            Quantity.SPACING: self.spacing_mm,
            Quantity.FLATNESS: self.flatness_mm,
        }[quantity]


@dataclass(frozen=True, slots=True)
class Step:
    """One prescribed position. name : "sphere-1" and so on, as a positioner's pose may be called.

    centre_mm : (3,) float64, of the artefact in the world; axis : (3,) float64, unit: along the bar, or the plane's
    normal towards the devices. words : what a person is to do.
    """

    name: str
    artefact: Artefact
    centre_mm: Numbers
    axis: Numbers
    words: str


@dataclass(frozen=True, slots=True)
class AcceptancePlan:
    """A test as it will be done. volume_mm : (2, 3) float64, opposite corners of the working volume.

    repeats : so often is the first position of each artefact measured, for the scatter of repeated captures.
    """

    volume_mm: Numbers
    artefacts: Artefacts
    limits: Limits
    steps: tuple[Step, ...]
    rendered: bool
    repeats: int = USUAL_REPEATS
    exposure_s: float | None = None
    notes: str = ""

    @property
    def diagonal_mm(self) -> float:
        """L0: the space diagonal of the working volume."""
        return diagonal_mm(self.volume_mm)

    @property
    def takes(self) -> tuple[tuple[Step, int], ...]:
        """Every capture in order: a step and how many times it was measured before."""
        firsts = {step.artefact: step.name for step in reversed(self.steps)}
        return tuple(
            (step, take)
            for step in self.steps
            for take in range(self.repeats if firsts[step.artefact] == step.name else 1)
        )


def takes_of(plan: AcceptancePlan, step: str) -> list[tuple[Step, int]]:
    """The captures of one position, in order."""
    return [take for take in plan.takes if take[0].name == step]


def diagonal_mm(volume_mm: FloatArray) -> float:
    """The space diagonal of a box of two opposite corners, (2, 3) float64, mm."""
    return float(np.linalg.norm(volume_mm[1] - volume_mm[0]))


def usual_limits(volume_mm: FloatArray, tolerance_mm: float | None = None) -> Limits:
    """The limits where none are given, from what a point may be wrong by in what the rig is for: tolerance_mm, or
    L0 / 5000.

    A size or a spacing may be wrong by tolerance_mm. A form is a range, from the point furthest out to that furthest
    in, each of which may be wrong by tolerance_mm: 2 tolerance_mm.

    >>> usual_limits(np.array([[0.0, 0.0, 0.0], [200.0, 100.0, 200.0]]), 0.05)
    Limits(form_mm=0.1, size_mm=0.05, spacing_mm=0.05, flatness_mm=0.1)
    """
    length_mm = WANTED_SHARE * diagonal_mm(volume_mm) if tolerance_mm is None else tolerance_mm
    return Limits(form_mm=2 * length_mm, size_mm=length_mm, spacing_mm=length_mm, flatness_mm=2 * length_mm)


def exact_artefacts(volume_mm: FloatArray) -> Artefacts:
    """Artefacts of a size that suits a volume, and without any error of their own: those of a rendered rig."""
    reach_mm = diagonal_mm(volume_mm)
    length, width = (float(round(share * reach_mm)) for share in _MADE_PLANE_SHARES)
    return Artefacts(
        diameter=Certified(round(_MADE_SPHERE_SHARE * reach_mm, 1), 0.0),
        distance=Certified(float(round(_MADE_BAR_SHARE * reach_mm)), 0.0),
        plane_mm=(length, max(width, _PLANE_WIDTH_MM)),
        sphere_form_mm=0.0,
        plane_form_mm=0.0,
        certificate="exact by construction",
        expansion_per_k=0.0,
    )


def _certified(artefacts: Artefacts) -> dict[str, float | None]:
    """What a certificate tells the uncertainty of; None where it was not told."""
    return {
        "the sphere's diameter": artefacts.diameter.uncertainty_mm,
        "the bar's distance": artefacts.distance.uncertainty_mm,
        "the sphere's form": artefacts.sphere_form_mm,
        "the plane's form": artefacts.plane_form_mm,
    }


def require_fitting(artefacts: Artefacts, volume_mm: FloatArray, *, rendered: bool) -> None:
    """Refuse artefacts that a test of this volume cannot be done with. Raises InvalidInputError with all faults."""
    faults = _unusable(artefacts, volume_mm) or _unfit(artefacts, volume_mm)
    unknown = [name for name, uncertainty in _certified(artefacts).items() if uncertainty is None]
    if unknown and not rendered:
        faults.append(
            f"the certificate's expanded uncertainty of {', '.join(unknown)} is not told; without it nothing can "
            "be decided on metal: copy it from the certificate"
        )
    if faults:
        message = "\n".join(["the acceptance test cannot be done so; correct each and try again:", *faults])
        raise InvalidInputError(message)


def _unusable(artefacts: Artefacts, volume_mm: FloatArray) -> list[str]:
    faults = []
    if volume_mm.shape != (2, 3) or not (np.isfinite(volume_mm).all() and (volume_mm[0] < volume_mm[1]).all()):
        faults.append(
            f"volume: expected x, y, z of the least corner and then of the greatest, found {volume_mm.tolist()}"
        )
    lengths = {
        "the sphere's diameter": artefacts.diameter.value_mm,
        "the bar's distance": artefacts.distance.value_mm,
        "the diameter of the bar's balls": artefacts.ball_mm,
        "the plane's length": artefacts.plane_mm[0],
        "the plane's width": artefacts.plane_mm[1],
    }
    for name, value in lengths.items():
        if not 0 < value < math.inf:
            faults.append(f"{name}: expected a length above 0 mm, found {value:g} mm")
    for name, uncertainty in {**_certified(artefacts), "the fixture": artefacts.fixture_mm}.items():
        if uncertainty is not None and not 0 <= uncertainty < math.inf:
            faults.append(f"the uncertainty of {name}: expected 0 mm or more, found {uncertainty:g} mm")
    if not 0 <= artefacts.expansion_per_k < _MOST_EXPANSION_PER_K:
        faults.append(
            f"the artefacts' expansion: expected 0 to {_MOST_EXPANSION_PER_K:g} per kelvin, as steel has "
            f"{STEEL_PER_K:g}, found {artefacts.expansion_per_k:g}"
        )
    return faults


def _unfit(artefacts: Artefacts, volume_mm: FloatArray) -> list[str]:
    """Faults of size: the shares of L0 of VDI/VDE 2634-2, and whether every position lies inside the volume."""
    reach_mm = diagonal_mm(volume_mm)
    faults = []
    least, most = (share * reach_mm for share in _SPHERE_SHARES)
    for name, value in (("the sphere", artefacts.diameter.value_mm), ("a ball of the bar", artefacts.ball_mm)):
        if not least <= value <= most:
            faults.append(
                f"{name}: expected a diameter of {least:.1f} to {most:.1f} mm (0.02 to 0.2 of the volume's diagonal, "
                f"{reach_mm:.0f} mm), found {value:g} mm"
            )
    distance = artefacts.distance.value_mm
    if distance < _BAR_SHARE * reach_mm:
        faults.append(
            f"the bar: expected {_BAR_SHARE * reach_mm:.1f} mm or more between the balls (0.3 of the volume's "
            f"diagonal), found {distance:g} mm"
        )
    room = (volume_mm[1] - volume_mm[0] - artefacts.ball_mm).clip(min=0)
    fits_mm = float(max(room[0], room[1]))
    if distance > fits_mm:
        faults.append(
            f"the bar: expected {fits_mm:.1f} mm or less between the balls, so that it fits along an edge of the "
            f"volume, found {distance:g} mm"
        )
    length, width = max(artefacts.plane_mm), min(artefacts.plane_mm)
    if length < _PLANE_SHARE * reach_mm or width < _PLANE_WIDTH_MM:
        faults.append(
            f"the plane: expected {_PLANE_SHARE * reach_mm:.1f} mm or more in length (half the volume's diagonal) and "
            f"{_PLANE_WIDTH_MM:.0f} mm in width, found {length:g} x {width:g} mm"
        )
    return faults
