"""The plan of an acceptance test in the manner of VDI/VDE 2634 part 2: artefacts, limits, positions; and its request.

No conformity is claimed. The working volume is a box along the world's axes; L0 is its space diagonal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field, PlainValidator

from slrig.bundle import SafeText, Strict
from slrig.errors import (
    InvalidInputError,
)
from slrig.model import Calibration, FloatArray, Pinhole

Numbers = Annotated[FloatArray, PlainValidator(lambda given: np.array(given, np.float64))]
"""An array, float64, that pydantic reads from lists."""

WANTED_SHARE = 1 / 5000
"""Tolerance of a point as a share of L0, where none is given."""

USUAL_REPEATS = 3
STEEL_PER_K = 11.5e-6
"""Thermal expansion of an artefact where it is not given: steel's (gauge blocks, ISO 3650: 11.5e-6 +- 1.0e-6)."""
REFERENCE_C = 20.0
"""Reference temperature of certified lengths (ISO 1)."""
_MOST_EXPANSION_PER_K = 1e-3  # ten times a plastic's: more is a slip of units
_SPHERE_SHARES = (0.02, 0.2)
_BAR_SHARE, _PLANE_SHARE, _PLANE_WIDTH_MM = 0.3, 0.5, 50.0
_MADE_SPHERE_SHARE, _MADE_BAR_SHARE, _MADE_PLANE_SHARES = 0.11, 0.4, (0.6, 0.42)


class Artefact(StrEnum):
    """The measured artefacts."""

    SPHERE = "sphere"
    BAR = "bar"
    PLANE = "plane"


class Quantity(StrEnum):
    """The errors of a rig: probing error form and size, sphere spacing error, flatness error."""

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
    """A certified value and its expanded uncertainty (k = 2), mm. None: the certificate's is not stated."""

    value_mm: float
    uncertainty_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Artefacts:
    """The artefacts as certified, matt.

    diameter : of the sphere. distance : of the bar's ball centres; its balls have bar_diameter_mm, or the sphere's.
    plane_mm : length and width. sphere_form_mm, plane_form_mm : by how much the artefact itself is out of form, the
    certificate's uncertainty of that included. certificate : as a person notes it. temperature_c : the artefacts', None
    where not known; expansion_per_k : of their material, 0 if they have none. fixture_mm : by how much one may move or
    bend in its place while it is captured, an expanded uncertainty (k = 2).
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
        """A certified length at the artefacts' temperature."""
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
    normal towards the devices. words : instruction for a person.
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
    """Uncertainties of a certificate; None where they are not stated."""
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
            f"the certificate's expanded uncertainty of {', '.join(unknown)} is not stated; without it nothing can "
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


_SIDES = (1.0, 0.75, 0.42)
"""Width, height and depth of a volume that is made up, as shares of its width."""
_MARGIN_SHARE = 0.03  # of an image's extent: the volume's corners stay so far inside
_HALVINGS = 40
_STEEPEST_BAR = 0.8  # of a bar's length that lies along the depth: steeper, one ball would hide the other
_TILT_DEG = 25.0
_NEAR = 0.15  # of the half volume: what lies nearer to the middle than this has no side

_NAMES = (("left", "right"), ("upper", "lower"), ("front", "back"))

_Lie = tuple[FloatArray, FloatArray, str]
"""Position of an artefact: a step's centre_mm, axis and words."""

_DIAGONALS = ((-1, -1, -1), (1, -1, -1), (-1, 1, -1), (1, 1, -1))
_CORNERS = tuple((x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1))


def acceptance_plan(
    calibration: Calibration,
    volume_mm: FloatArray,
    artefacts: Artefacts,
    *,
    rendered: bool,
    limits: Limits | None = None,
    repeats: int = USUAL_REPEATS,
    exposure_s: float | None = None,
    notes: str = "",
) -> AcceptancePlan:
    """The test of a rig over a volume, (2, 3) float64, opposite corners in the world, mm.

    Raises InvalidInputError if the artefacts do not suit the volume, with all faults, or repeats is below 1.
    """
    require_fitting(artefacts, volume_mm, rendered=rendered)
    if repeats < 1:
        message = f"repeats: expected 1 or more, found {repeats}; 3 show the scatter"
        raise InvalidInputError(message)
    camera = next(iter(calibration.cameras.values()))
    lies = {
        Artefact.SPHERE: _spheres(volume_mm, artefacts, camera),
        Artefact.BAR: _bars(volume_mm, artefacts, camera),
        Artefact.PLANE: _planes(volume_mm, artefacts),
    }
    steps = tuple(
        Step(f"{artefact}-{number}", artefact, *each)
        for artefact, found in lies.items()
        for number, each in enumerate(found, 1)
    )
    chosen = usual_limits(volume_mm) if limits is None else limits
    return AcceptancePlan(volume_mm, artefacts, chosen, steps, rendered, repeats, exposure_s, notes)


def rig_volume_mm(calibration: Calibration) -> FloatArray:
    """(2, 3) float64: the working volume: the one in which the board was held, else the largest box of usual
    proportions about the point nearest to their axes that all devices see. Raises InvalidInputError if there is none.
    """
    if calibration.solved is not None:
        return calibration.solved.volume_mm
    devices = [*calibration.cameras.values()]
    if calibration.projector is not None:
        devices.append(calibration.projector)
    middle = _watched_mm(devices)
    distance_mm = float(np.linalg.norm(middle - devices[0].centre_mm))
    half = np.array(_SIDES) / 2
    low, high = 0.0, distance_mm
    for _ in range(_HALVINGS):
        width = (low + high) / 2
        corners = middle + np.array(_CORNERS) * half * width
        low, high = (width, high) if all(_sees(device, corners) for device in devices) else (low, width)
    if low < 0.01 * distance_mm:
        message = (
            "volume: the devices of this rig have no common view about the point nearest to their axes; give the "
            "working volume yourself, and check the calibration"
        )
        raise InvalidInputError(message)
    return np.stack([middle - half * low, middle + half * low])


def _watched_mm(devices: list[Pinhole]) -> FloatArray:
    """(3,) the point nearest to all devices' middle rays, by least squares."""
    system, target = np.zeros((3, 3)), np.zeros(3)
    for device in devices:
        middle = np.array([device.size.width_px / 2, device.size.height_px / 2, 1.0])
        ray = device.rotation.T @ np.linalg.solve(device.matrix, middle)
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        system += across
        target += across @ device.centre_mm
    return np.asarray(np.linalg.lstsq(system, target, rcond=None)[0])


def _sees(device: Pinhole, points_mm: FloatArray) -> bool:
    turned = cv2.Rodrigues(device.rotation)[0]
    if ((points_mm @ device.rotation.T + device.translation_mm)[:, 2] <= 0).any():
        return False
    pixels = cv2.projectPoints(points_mm, turned, device.translation_mm, device.matrix, device.distortion)[0][:, 0]
    extent = np.array([device.size.width_px, device.size.height_px])
    return bool(((pixels > _MARGIN_SHARE * extent) & (pixels < (1 - _MARGIN_SHARE) * extent)).all())


def _spheres(volume_mm: FloatArray, artefacts: Artefacts, camera: Pinhole) -> Iterator[_Lie]:
    middle, room = _inside(volume_mm, artefacts.diameter.value_mm / 2)
    for place in ((0.0, 0.0, 0.0), *_CORNERS, (0.0, 0.0, -1.0)):
        centre = middle + np.array(place) * room
        name = _where(camera, centre, volume_mm)
        at = "in the middle" if name == "the middle" else f"at {name}"
        yield centre, np.zeros(3), f"Put the sphere {at} of the volume."


def _bars(volume_mm: FloatArray, artefacts: Artefacts, camera: Pinhole) -> Iterator[_Lie]:
    length_mm = artefacts.distance.value_mm
    middle, room = _inside(volume_mm, artefacts.ball_mm / 2)
    edge = np.eye(3)[int(room[1] > room[0])]
    face = np.array([room[0], room[1], 0.0])
    # As deep as the volume allows, and aslant across the line of the devices, where neither ball shades the other.
    deep = min(_STEEPEST_BAR, 2 * float(room[2]) / length_mm)
    lies = [
        *((middle, -np.array(signs) * room / np.linalg.norm(room), "along the diagonal") for signs in _DIAGONALS),
        (middle - room * (1 - edge), edge, "along the edge of the front"),
        (middle + np.array([0, 0, room[2]]), face / np.linalg.norm(face), "across the back face"),
        (middle, np.array([0.0, np.sqrt(1 - deep**2), deep]), "into the depth, aslant"),
    ]
    for centre, axis, how in lies:
        ends = (centre - axis * length_mm / 2, centre + axis * length_mm / 2)
        first, second = (_where(camera, end, volume_mm) for end in ends)
        yield centre, axis, f"Put the ball bar {how}, from {first} to {second}."


def _planes(volume_mm: FloatArray, artefacts: Artefacts) -> Iterator[_Lie]:
    middle = volume_mm.mean(axis=0)
    half = (volume_mm[1] - volume_mm[0]) / 2
    # A tilted plane reaches as deep as the volume, and no deeper.
    tilt = min(np.deg2rad(_TILT_DEG), float(np.arcsin(min(1.0, 2 * half[2] / max(artefacts.plane_mm)))))
    level, lean = np.cos(tilt), np.sin(tilt)
    aslant = lean / np.sqrt(2)
    degrees = np.rad2deg(tilt)
    lies = [
        (0.0, (0.0, 0.0, -1.0), "in the middle of the volume, facing the rig"),
        (-0.8, (0.0, 0.0, -1.0), "near the front of the volume, facing the rig"),
        (0.8, (0.0, 0.0, -1.0), "near the back of the volume, facing the rig"),
        (0.0, (lean, 0.0, -level), f"in the middle, turned by {degrees:.0f}° about the upright"),
        (0.0, (0.0, lean, -level), f"in the middle, tipped by {degrees:.0f}° about the level"),
        (0.0, (-aslant, aslant, -level), f"in the middle, turned and tipped by {degrees:.0f}° in all"),
    ]
    for depth, normal, text in lies:
        yield middle + np.array([0.0, 0.0, depth * half[2]]), np.array(normal), f"Put the plane {text}."


def _inside(volume_mm: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """The volume's middle, and how far from it, along each axis, a ball's centre may lie; (3,) each."""
    return volume_mm.mean(axis=0), (volume_mm[1] - volume_mm[0]) / 2 - radius_mm


def _where(camera: Pinhole, point_mm: FloatArray, volume_mm: FloatArray) -> str:
    """Name of a point's place in the volume, as the camera sees it.

    Each side of the volume is named by the nearest direction of the camera, so that the name is right in every world.
    """
    share = (point_mm - volume_mm.mean(axis=0)) / ((volume_mm[1] - volume_mm[0]) / 2)
    sides: dict[int, str] = {}
    for axis in range(3):
        along = int(np.abs(camera.rotation[:, axis]).argmax())
        if abs(share[axis]) > _NEAR:
            sides[along] = _NAMES[along][int(share[axis] * camera.rotation[along, axis] > 0)]
    names = " ".join(sides[along] for along in (1, 0, 2) if along in sides)
    return f"the {names}" if names else "the middle"


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
        default=0.0, description="by how much an artefact may move or bend in its place while it is captured (k = 2)"
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
    """Artefacts and limits of a test. Without artefacts: the exact ones of a rendered rig."""

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
        given = self.limits.model_dump(exclude_none=True)
        return acceptance_plan(
            calibration,
            volume,
            exact_artefacts(volume) if self.artefacts is None else self.artefacts.artefacts(),
            rendered=rendered,
            limits=replace(
                usual_limits(volume, tolerance_mm if self.tolerance_mm is None else self.tolerance_mm), **given
            ),
            repeats=self.repeats,
            exposure_s=self.exposure_s,
            notes=self.notes,
        )


def turn_deg(step: Step) -> tuple[float, float, float]:
    """The turn about the fixed x, then y, then z axes that brings an artefact into the position, degrees.

    A bar's own axis is x, a plane's front faces -z.

    >>> turn_deg(Step("bar-1", Artefact.BAR, np.zeros(3), np.array([0.0, 1.0, 0.0]), ""))
    (0.0, 0.0, 90.0)
    """
    if step.artefact is Artefact.SPHERE:
        return 0.0, 0.0, 0.0
    x, y, z = (float(each) for each in step.axis)
    if step.artefact is Artefact.BAR:
        # Rz(c) Ry(b) takes the x axis to (cos b cos c, cos b sin c, -sin b).
        return 0.0, math.degrees(-math.asin(max(-1.0, min(1.0, z)))) + 0.0, math.degrees(math.atan2(y, x))
    # Ry(b) Rx(a) takes -z to (-sin b cos a, sin a, -cos b cos a).
    return math.degrees(math.asin(max(-1.0, min(1.0, y)))), math.degrees(math.atan2(-x, -z)), 0.0
