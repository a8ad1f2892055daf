"""What is asked of an acceptance test, over HTTP or by a schedule, and the plan that it comes to."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from slrig.accept.plan import (
    STEEL_PER_K,
    USUAL_REPEATS,
    AcceptancePlan,
    Artefacts,
    Certified,
    exact_artefacts,
    usual_limits,
)
from slrig.accept.positions import acceptance_plan, rig_volume_mm
from slrig.bundle import SafeText, Strict
from slrig.errors import InvalidInputError
from slrig.model import Calibration

Length = Annotated[float, Field(gt=0, le=100_000)]
Uncertainty = Annotated[float, Field(ge=0, le=1000)]
Coordinate = Annotated[float, Field(ge=-100_000, le=100_000)]
Corner = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
"""x, y, z in the world, mm."""


class CertifiedRequest(Strict):
    """A certified value and its expanded uncertainty (k = 2), mm."""

    value_mm: Length
    uncertainty_mm: Uncertainty


class ArtefactsRequest(Strict):
    """The artefacts, as their certificates have them."""

    sphere: CertifiedRequest = Field(description="diameter")
    bar: CertifiedRequest = Field(description="distance of the balls' centres")
    plane_mm: tuple[Length, Length] = Field(strict=False, description="length and width")
    sphere_form_mm: Uncertainty = Field(description="by how much the sphere itself is out of round")
    plane_form_mm: Uncertainty = Field(description="by how much the plane itself is out of flat")
    ball_mm: Length | None = Field(default=None, description="diameter of the bar's balls; absent, the sphere's")
    certificate: Annotated[SafeText, Field(max_length=200)] = ""
    temperature_c: Annotated[float, Field(ge=-50, le=100)] | None = Field(
        default=None, description="of the artefacts; absent, about 20 °C is taken, and not known well"
    )
    expansion_per_k: Annotated[float, Field(ge=0, lt=1e-3)] = Field(
        default=STEEL_PER_K, description="thermal expansion of the artefacts; absent, that of steel"
    )
    fixture_mm: Uncertainty = Field(
        default=0.0, description="by how much an artefact may move or bend where it stands while it is captured (k = 2)"
    )

    def artefacts(self) -> Artefacts:
        """The artefacts that are meant."""
        sphere, bar = (Certified(**dict(each)) for each in (self.sphere, self.bar))
        return Artefacts(
            sphere, bar, self.plane_mm, self.ball_mm, self.sphere_form_mm, self.plane_form_mm, self.certificate,
            self.temperature_c, self.expansion_per_k, self.fixture_mm,
        )  # fmt: skip


class LimitsRequest(Strict):
    """Limits in mm; absent ones follow tolerance_mm: as much for spacing and size, twice as much for form and
    flatness.
    """

    spacing_mm: Length | None = None
    form_mm: Length | None = None
    size_mm: Length | None = None
    flatness_mm: Length | None = None


class AcceptanceRequest(Strict):
    """What to test with. Without artefacts: the exact ones of a rendered rig."""

    artefacts: ArtefactsRequest | None = None
    volume_mm: tuple[Corner, Corner] | None = Field(
        default=None, strict=False, description="least and greatest corner in the world; absent, the calibration's"
    )
    tolerance_mm: Length | None = Field(
        default=None,
        description="what a point may be wrong by in what the rig is for; absent, the rig file's, or 1/5000 of the "
        "volume's diagonal",
    )
    limits: LimitsRequest = LimitsRequest()
    repeats: Annotated[int, Field(ge=1, le=50)] = USUAL_REPEATS
    exposure_s: Annotated[float, Field(gt=0, le=60)] | None = None
    notes: Annotated[str, Field(max_length=1000)] = ""

    def plan(self, calibration: Calibration, tolerance_mm: float | None = None, /) -> AcceptancePlan:
        """The plan for a rig so calibrated; tolerance_mm is its rig file's. Raises InvalidInputError."""
        rendered = self.artefacts is None
        volume = rig_volume_mm(calibration) if self.volume_mm is None else np.array(self.volume_mm, np.float64)
        if not (volume[0] < volume[1]).all():
            message = f"volume_mm: expected the least corner and then the greatest, found {volume.tolist()}"
            raise InvalidInputError(message)
        told = self.limits.model_dump(exclude_none=True)
        return acceptance_plan(
            calibration,
            volume,
            exact_artefacts(volume) if self.artefacts is None else self.artefacts.artefacts(),
            rendered=rendered,
            limits=replace(
                usual_limits(volume, tolerance_mm if self.tolerance_mm is None else self.tolerance_mm), **told
            ),
            repeats=self.repeats,
            exposure_s=self.exposure_s,
            notes=self.notes,
        )
