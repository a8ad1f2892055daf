"""From what is asked of an acceptance test, over HTTP or by a schedule, to its plan."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from slrig.errors import InvalidInputError
from slrig.model import Calibration
from slrig.sessions.acceptance.plan import (
    AcceptancePlan,
    Artefacts,
    Certified,
    Limits,
    exact_artefacts,
    usual_limits,
)
from slrig.sessions.acceptance.positions import acceptance_plan, rig_volume_mm

Corner = tuple[float, float, float]


class AskedValue(Protocol):
    """A certified value and its expanded uncertainty (k = 2), mm."""

    value_mm: float
    uncertainty_mm: float


class AskedArtefacts(Protocol):
    """The artefacts, as their certificates have them, mm."""

    @property
    def sphere(self) -> AskedValue:
        """Diameter."""
        ...

    @property
    def bar(self) -> AskedValue:
        """Distance of the balls' centres."""
        ...

    plane_mm: tuple[float, float]
    ball_mm: float | None
    sphere_form_mm: float
    plane_form_mm: float
    certificate: str
    temperature_c: float | None


class AskedLimits(Protocol):
    """Limits, mm; None for the usual one."""

    spacing_mm: float | None
    form_mm: float | None
    size_mm: float | None
    flatness_mm: float | None


class AskedTest(Protocol):
    """A test. artefacts None : the exact ones of a rendered rig. volume_mm : two corners; None, the calibration's."""

    @property
    def artefacts(self) -> AskedArtefacts | None:
        """What is measured."""
        ...

    @property
    def limits(self) -> AskedLimits:
        """What is allowed."""
        ...

    volume_mm: tuple[Corner, Corner] | None
    repeats: int
    exposure_s: float | None
    notes: str


def plan_asked(asked: AskedTest, calibration: Calibration) -> AcceptancePlan:
    """The plan for a rig so calibrated. Raises InvalidInputError."""
    rendered = asked.artefacts is None
    volume = rig_volume_mm(calibration) if asked.volume_mm is None else np.array(asked.volume_mm, np.float64)
    if not (volume[0] < volume[1]).all():
        message = f"volume_mm: expected the least corner and then the greatest, found {volume.tolist()}"
        raise InvalidInputError(message)
    given = asked.limits
    usual_mm = usual_limits(volume, rendered=rendered).spacing_mm
    return acceptance_plan(
        calibration,
        volume,
        exact_artefacts(volume) if asked.artefacts is None else _artefacts(asked.artefacts),
        rendered=rendered,
        limits=Limits(given.spacing_mm or usual_mm, given.form_mm, given.size_mm, given.flatness_mm),
        repeats=asked.repeats,
        exposure_s=asked.exposure_s,
        notes=asked.notes,
    )


def _artefacts(given: AskedArtefacts) -> Artefacts:
    return Artefacts(
        Certified(given.sphere.value_mm, given.sphere.uncertainty_mm),
        Certified(given.bar.value_mm, given.bar.uncertainty_mm),
        given.plane_mm,
        given.ball_mm,
        given.sphere_form_mm,
        given.plane_form_mm,
        given.certificate,
        given.temperature_c,
    )
