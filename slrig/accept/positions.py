"""The prescribed positions of an acceptance test: ten of a sphere, seven of a ball bar, six of a plane.

They fill the working volume, and are told as the first camera sees them: its left and right, up and down, near and far.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from slrig.accept.plan import (
    USUAL_REPEATS,
    AcceptancePlan,
    Artefact,
    Artefacts,
    Limits,
    Step,
    require_fitting,
    usual_limits,
)
from slrig.errors import InvalidInputError
from slrig.model import Calibration, FloatArray, Pinhole

_SIDES = (1.0, 0.75, 0.42)
"""Width, height and depth of a volume that is made up, as shares of its width."""
_SEEN_SHARE = 0.03  # of an image's extent: the volume's corners stay so far inside
_HALVINGS = 40
_STEEPEST_BAR = 0.8  # of a bar's length that lies along the depth: steeper, one ball would hide the other
_TILT_DEG = 25.0
_NEAR = 0.15  # of the half volume: what lies nearer to the middle than this has no side

_NAMES = (("left", "right"), ("upper", "lower"), ("front", "back"))

_Lie = tuple[FloatArray, FloatArray, str]
"""Where an artefact lies: a step's centre_mm, axis and words."""

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
        message = f"repeats: expected 1 or more, found {repeats}; 3 tell the scatter"
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
    proportions, about where the devices look, that all of them see. Raises InvalidInputError if there is none.
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
            "volume: the devices of this rig have no common view about the point that they look at; give the working "
            "volume yourself, and check the calibration"
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
    return bool(((pixels > _SEEN_SHARE * extent) & (pixels < (1 - _SEEN_SHARE) * extent)).all())


def _spheres(volume_mm: FloatArray, artefacts: Artefacts, camera: Pinhole) -> Iterator[_Lie]:
    middle, room = _inside(volume_mm, artefacts.diameter.value_mm / 2)
    for place in ((0.0, 0.0, 0.0), *_CORNERS, (0.0, 0.0, -1.0)):
        centre = middle + np.array(place) * room
        told = _where(camera, centre, volume_mm)
        at = "in the middle" if told == "the middle" else f"at {told}"
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
    for depth, normal, words in lies:
        yield middle + np.array([0.0, 0.0, depth * half[2]]), np.array(normal), f"Put the plane {words}."


def _inside(volume_mm: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """The volume's middle, and how far from it, along each axis, a ball's centre may lie; (3,) each."""
    return volume_mm.mean(axis=0), (volume_mm[1] - volume_mm[0]) / 2 - radius_mm


def _where(camera: Pinhole, point_mm: FloatArray, volume_mm: FloatArray) -> str:
    """Where in the volume a point lies, as the camera sees it.

    Each side of the volume is named by the camera's direction that it lies nearest to, so that a world that stands
    otherwise is told rightly too.
    """
    share = (point_mm - volume_mm.mean(axis=0)) / ((volume_mm[1] - volume_mm[0]) / 2)
    sides: dict[int, str] = {}
    for axis in range(3):
        along = int(np.abs(camera.rotation[:, axis]).argmax())
        if abs(share[axis]) > _NEAR:
            sides[along] = _NAMES[along][int(share[axis] * camera.rotation[along, axis] > 0)]
    told = " ".join(sides[along] for along in (1, 0, 2) if along in sides)
    return f"the {told}" if told else "the middle"
