"""How well the errors found in an acceptance test are known: the test value's uncertainty, for the decision.

Of the artefacts and of how they stand alone. What the rig itself adds, its noise and the scatter of repeated captures
among it, is what the test is to show, and is in the errors already: counted here once more, it would let a worse rig
have a wider band of doubt (ISO 14253-5: test value uncertainty; ISO/TS 23165: its contributions for coordinate
measuring machines).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slrig.accept.plan import REFERENCE_C, Artefacts, Quantity

FORMULA = "U = sqrt(U_certificate^2 + U_form^2 + U_temperature^2 + U_fixture^2)"
_HALF_TO_DEVIATION = 1 / math.sqrt(3)  # of a rectangular distribution
_EXPANSION_WITHIN_PER_K = 1.0e-6
"""Steels differ by so much (ISO 3650); other materials are taken to be known no better."""
_TOLD_WITHIN_K = 1.0
"""Chosen: a room's thermometer, and an artefact that has not quite taken the room's temperature."""
_ROOM_WITHIN_K = 5.0
"""Chosen: a room whose temperature nobody read, about the reference of 20 °C."""


@dataclass(frozen=True, slots=True)
class ErrorUncertainty:
    """Expanded uncertainties (k = 2) of an error, mm, by cause; None where the certificate's was not told."""

    certificate_mm: float | None
    form_mm: float | None
    temperature_mm: float
    fixture_mm: float

    @property
    def expanded_mm(self) -> float:
        """U by `FORMULA`; what was not told is left out."""
        return math.hypot(self.certificate_mm or 0.0, self.form_mm or 0.0, self.temperature_mm, self.fixture_mm)


def error_uncertainty(quantity: Quantity, artefacts: Artefacts) -> ErrorUncertainty:
    """What the artefact of a quantity brings into its error.

    An artefact out of form by F has u = F / 2 (ISO/TS 23165), with k = 2 F itself; a sphere's diameter found from the
    part that is seen may differ from the certified one by as much. A length L of thermal expansion a at a temperature t
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
    told = artefacts.temperature_c is not None
    warmer_k = 0.0 if artefacts.temperature_c is None else artefacts.temperature_c - REFERENCE_C
    by_temperature = artefacts.expansion_per_k * (_TOLD_WITHIN_K if told else _ROOM_WITHIN_K)
    by_expansion = warmer_k * _EXPANSION_WITHIN_PER_K
    return 2 * length_mm * math.hypot(by_temperature, by_expansion) * _HALF_TO_DEVIATION
