"""The script of a rendered rig: the poses that an object takes one after the other, listed or made up.

A made-up series is what a careful person does with a calibration board: tilted every way, near and far, turned in its
plane, and brought to the middle, the corners and the sides of the images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

from simulated_rig.optics import field_radius, image_positions
from simulated_rig.scene import Names, NotNegative, Pair, Positive, PrintedBoard, Triple
from slrig.bundle.validation import Strict
from slrig.devices import AnyAngle
from slrig.errors import ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray, Pinhole, StageAxis

PROJECTOR = "projector"

Index = Annotated[int, Field(ge=0)]


_SEED = 0x7475726E
_GOLDEN_TURN = np.pi * (3 - np.sqrt(5))
_TRIES = 200
_HALVINGS = 20
_FARTHEST_MM = 1000.0
_NEAR_MIDDLE = 0.15
_SIDES = (1, 5, 3, 7, 0, 4, 2, 6)
"""Eighths of a turn: corners are odd."""


class PoseOffset(Strict, use_attribute_docstrings=True):
    """A device's change of pose, in its own frame: X' = turn (X + shift). The stated calibration does not follow."""

    device: Annotated[str, Field(min_length=1)]
    """A camera's name, or "projector"."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """About its x, y and z axis."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """Along its x, y and z axis."""


class BumpFault(PoseOffset):
    """A device is bumped when a pose is taken, and stays so: `[[head.faults.bump]]`.

    Whoever goes back to an earlier pose finds it as it was before the bump.
    """

    pose: Index
    """Number of the pose, from 0."""


class PoseDrift(PoseOffset):
    """A device drifts towards a change of pose as 1 - exp(-t / settling): `[[head.drift]]`.

    t counts from the opening of the rig in the world's time for settle_s, or in captures for settle_captures. During
    one capture the device stands still.
    """

    settle_s: Positive | None = None
    """Settling time of a drift by time."""

    settle_captures: Positive | None = None
    """How many captures settling takes, of a drift by captures."""

    @model_validator(mode="after")
    def _check_settling(self) -> PoseDrift:
        if (self.settle_s is None) == (self.settle_captures is None):
            message = "a drift needs settle_s or settle_captures, and not both"
            raise ValueError(message)
        return self

    def progress(self, time_s: float, captures: int) -> float:
        """How much of the drift is there, 0 to 1, after a time and so many captures."""
        if self.settle_s is not None:
            return 1 - math.exp(-time_s / self.settle_s)
        return 1 - math.exp(-captures / (self.settle_captures or 1.0))


class ObjectMotion(Strict, use_attribute_docstrings=True):
    """What is moved does not stand still while a pose is captured: `[[head.faults.moving]]`."""

    pose: Index | None = None
    """Number of the pose, from 0; else every one."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """From the capture's first pattern to its last one."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """The same, about the world's axes at the object's own origin."""

    steps: Annotated[int, Field(ge=2, le=200)] = 6
    """In how many equal steps."""


def apply_pose_offset(device: Pinhole, push: PoseOffset, *, share: float = 1.0) -> Pinhole:
    """Return a device after a share of a push."""
    turn = Rotation.from_rotvec(share * np.deg2rad(push.turn_deg)).as_matrix()
    translation = turn @ (device.translation_mm + share * np.array(push.shift_mm))
    return replace(device, rotation=turn @ device.rotation, translation_mm=translation)


class TurntableOptions(Strict, use_attribute_docstrings=True):
    """What turns objects: `[head.turntable]`. At 0° they stand as the scene file has them."""

    point_mm: Triple
    """A point of the axis."""

    direction: Triple = (0.0, -1.0, 0.0)
    """Of the axis; angles count right-handed about it. Upwards by default, since y points down."""

    objects: Names | None = None
    """Names of what stands on it; else all objects but those called "backdrop"."""

    poses: Annotated[int, Field(ge=1, le=360)] = 8
    """How many even poses it offers."""

    knows_axis: bool = False
    """Whether it tells its axis; else that has to be found, as on metal."""

    scale_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """By what share of the angle that was asked for it goes too far."""

    angle_sigma_deg: NotNegative = 0.0
    """Standard deviation of the angle that it stops at, drawn anew by the seed for each turn."""

    wobble_deg: Annotated[float, Field(ge=0, le=10)] = 0.0
    """How far its axis leans, twice to either side in a turn, as on a bearing that is not flat: this times
    sin(2 · angle), about a direction across it."""

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, direction: Triple) -> Triple:
        if not np.linalg.norm(direction) > 0:
            message = "expected a direction, found [0, 0, 0]; upwards is [0, -1, 0]"
            raise ValueError(message)
        return direction

    @property
    def axis(self) -> StageAxis:
        """The axis, in the world."""
        return StageAxis(np.array(self.point_mm), np.array(self.direction) / np.linalg.norm(self.direction))

    def motion(self, angle_deg: float) -> FloatArray:
        """(4, 4): how what stands on it has moved, from 0° to an angle at which it stands exactly."""
        axis = self.axis
        # Across the axis: the world's direction that lies farthest from it, made orthogonal to it.
        farthest = np.eye(3)[np.argmin(np.abs(axis.direction))]
        across = np.cross(axis.direction, farthest)
        across /= np.linalg.norm(across)
        angle = np.deg2rad(angle_deg)
        lean = Rotation.from_rotvec(np.deg2rad(self.wobble_deg) * np.sin(2 * angle) * across)
        motion = np.eye(4)
        motion[:3, :3] = (lean * Rotation.from_rotvec(angle * axis.direction)).as_matrix()
        motion[:3, 3] = axis.point_mm - motion[:3, :3] @ axis.point_mm
        return motion


class RenderedTurntable(AnyAngle):
    """Implements `slrig.devices.Turntable` on the rendered world.

    turn_objects : has what stands on the table stand turned, by a motion (4, 4) from where the scene file has it.
    """

    def __init__(self, options: TurntableOptions, turn_objects: Callable[[FloatArray], None], *, seed: int) -> None:
        super().__init__(options.poses)
        self._options = options
        self._turn_objects = turn_objects
        self._rng = np.random.default_rng((seed, _SEED))
        self._angle_deg = 0.0
        self._closed = False

    @property
    def axis(self) -> StageAxis | None:
        """See `Turntable`. Without the errors."""
        return self._options.axis if self._options.knows_axis else None

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`. Its objects stand as the scene file has them, each time."""
        return None

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. It is there at once, and stays where it is when it is there already."""
        if self._closed:
            message = "the rendered rig's turntable is closed; open the rig again"
            raise DeviceStateError(message)
        if not np.isfinite(angle_deg):
            message = f"asked the turntable for {angle_deg}°; ask for a number of degrees"
            raise UnsupportedByDeviceError(message)
        if angle_deg == self._angle_deg:
            return
        error_deg = self._options.scale_error * angle_deg + self._rng.normal(0.0, self._options.angle_sigma_deg)
        self._turn_objects(self._options.motion(angle_deg + error_deg))
        self._angle_deg = angle_deg

    def close(self) -> None:
        """See `Positioner`."""
        self._closed = True


class ScriptedPose(Strict, use_attribute_docstrings=True):
    """One pose: `[[head.pose]]`. Position and rotation are as of an object of a scene."""

    name: str = ""
    """What it is called; else "pose N" counted from 1."""

    object: str | None = None
    """The name of what is moved; else the scene's board."""

    position_mm: Triple
    """Where its origin is."""

    rotation_deg: Triple = (0.0, 0.0, 0.0)
    """How it is turned."""


class PoseSeries(Strict, use_attribute_docstrings=True):
    """Poses of the scene's board, made up from a seed: `[head.poses]`."""

    count: Annotated[int, Field(ge=1, le=200)] = 20
    """How many."""

    seed: Annotated[int, Field(ge=0)] = 1
    """What they are made up from."""

    tilt_deg: Pair = (15.0, 40.0)
    """Least and most angle between the board and the plane across the line from it to the devices, about axes all
    round."""

    roll_deg: NotNegative = 25.0
    """Most turn in its own plane to either side."""

    centre_mm: Triple = (0.0, 0.0, 0.0)
    """About what point the board is held."""

    depth_mm: Pair = (-60.0, 60.0)
    """Least and most distance from there along the line away from the devices."""

    edge_px: NotNegative = 6.0
    """The paper stays so far inside every image, the projector's too."""

    @model_validator(mode="after")
    def _check_bounds(self) -> PoseSeries:
        if not 0 <= self.tilt_deg[0] <= self.tilt_deg[1] <= 70 or self.depth_mm[0] > self.depth_mm[1]:
            message = "tilt_deg needs 0 <= least <= most <= 70, depth_mm least <= most"
            raise ValueError(message)
        return self


def generate_poses(series: PoseSeries, board: PrintedBoard, devices: Sequence[Pinhole]) -> tuple[ScriptedPose, ...]:
    """Return the poses of a series.

    Tilt axes go round by the golden angle, so that any few of them lie well apart. The board is slid from the middle
    towards a side or a corner until its paper touches the borders of some device's image.

    Raises
    ------
    ConfigError
        The board does not fit into every image, however it is held.
    """
    rng = np.random.default_rng((series.seed, 0x706F7365))
    fields = [(device, field_radius(device)) for device in devices]
    centre = np.array(series.centre_mm)
    away = centre - np.mean([device.centre_mm for device in devices], axis=0)
    facing = _facing_rotation(away / np.linalg.norm(away))
    least, most = board.paper_mm
    rim = np.array([(x, y) for x in np.linspace(least[0], most[0], 5) for y in np.linspace(least[1], most[1], 5)])
    paper = board.on_sheet_mm(rim)
    poses: list[ScriptedPose] = []
    slid = 0
    for number in range(series.count):
        # Two in nine stay near the middle; the others go to each corner, then to each side, and so on.
        share = _NEAR_MIDDLE if number % 9 in (0, 4) else 1.0
        side = _SIDES[slid % len(_SIDES)]
        in_corner = share == 1.0 and side % 2 == 1
        slid += share == 1.0
        for _try in range(_TRIES):
            # Depth and tilt are spread evenly, each in an order of its own, and jittered.
            depth = _stratified(series.depth_mm, (number * 7 + 3) % series.count, series.count, rng)
            tilt = np.deg2rad(_stratified(series.tilt_deg, (number * 3 + 1) % series.count, series.count, rng))
            about = number * _GOLDEN_TURN + rng.uniform(-0.2, 0.2)
            towards = side * np.pi / 4 + rng.uniform(-0.15, 0.15)
            # A board that is turned much leaves the corner free into which it is slid.
            most_roll = series.roll_deg * (0.4 if in_corner else 1.0)
            roll = np.deg2rad(rng.uniform(-most_roll, most_roll))
            leaning = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
            rotation = facing @ (leaning * Rotation.from_rotvec([0.0, 0.0, roll])).as_matrix()
            middle = centre + depth * facing[:, 2]
            held = paper @ rotation.T + middle
            if not _is_visible_to_all(held, fields, series.edge_px):
                continue
            across, down = np.cos(towards) * facing[:, 0], 0.75 * np.sin(towards) * facing[:, 1]
            slide = np.zeros(3)
            # Together until the first border, then each alone: so corners are reached.
            for sideways in (across + down, across, down):
                slide += _free_distance(held + slide, sideways, fields, series.edge_px) * sideways
            poses.append(_rounded_pose(number, middle + share * slide, rotation))
            break
        else:
            message = (
                f"[head.poses]: pose {number + 1} of {series.count}: the board's paper ({most[0] - least[0]:.0f} x "
                f"{most[1] - least[1]:.0f} mm) does not fit into every device's image about {series.centre_mm}; make "
                "the board smaller, move centre_mm or narrow depth_mm"
            )
            raise ConfigError(message)
    return tuple(poses)


def _stratified(bounds: tuple[float, float], step: int, count: int, rng: np.random.Generator) -> float:
    return bounds[0] + (bounds[1] - bounds[0]) * (step + float(rng.random())) / count


def _facing_rotation(away: FloatArray) -> FloatArray:
    """(3, 3): board to world of a board across `away`, its x as near the world's as that allows."""
    right = np.array([1.0, 0.0, 0.0]) - away[0] * away
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(away, right), away])


def _rounded_pose(number: int, middle: FloatArray, rotation: FloatArray) -> ScriptedPose:
    # Rounded, so that what a log or a listing says of a pose is the pose.
    turn = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    x, y, z = (round(float(each), 4) for each in middle)
    a, b, c = (round(float(each), 4) for each in turn)
    return ScriptedPose(name=f"pose {number + 1}", position_mm=(x, y, z), rotation_deg=(a, b, c))


def _free_distance(
    held: FloatArray, sideways: FloatArray, fields: Sequence[tuple[Pinhole, float]], edge_px: float
) -> float:
    """How many times `sideways`, mm, a board can be slid until it touches a border."""
    low, high = 0.0, _FARTHEST_MM
    for _ in range(_HALVINGS):
        half = (low + high) / 2
        if _is_visible_to_all(held + half * sideways, fields, edge_px):
            low = half
        else:
            high = half
    return low


def _is_visible_to_all(points: FloatArray, fields: Sequence[tuple[Pinhole, float]], edge_px: float) -> bool:
    """Whether every device images all points; a field is a device and the radius that its lens images."""
    return all(_is_in_image(points, device, radius, edge_px) for device, radius in fields)


def _is_in_image(points: FloatArray, device: Pinhole, radius: float, edge_px: float) -> bool:
    at = points @ device.rotation.T + device.translation_mm
    if (at[:, 2] <= 0).any() or (np.hypot(at[:, 0], at[:, 1]) > radius * at[:, 2]).any():
        return False
    pixels = image_positions(points, device)
    limit = np.array([device.size.width_px, device.size.height_px]) - 1 - edge_px
    return bool(((pixels >= edge_px) & (pixels <= limit)).all())
