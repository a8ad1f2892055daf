"""Movements of the simulated rig: object poses, turntable, bumped and drifting devices.

A generated series of poses follows good practice with a calibration board: tilted about all axes, near and far, rotated
in its plane, and in the centre, the corners and at the sides of the images.
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
from slrig.bundle import Strict
from slrig.devices import TurntableBase
from slrig.errors import ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray, Pinhole, RotationAxis

PROJECTOR = "projector"

Index = Annotated[int, Field(ge=0)]


_SEED = 0x7475726E
_GOLDEN_TURN = np.pi * (3 - np.sqrt(5))
_TRIES = 200
_HALVINGS = 20
_FARTHEST_MM = 1000.0
_NEAR_MIDDLE = 0.15
_SIDES = (1, 5, 3, 7, 0, 4, 2, 6)
"""Directions in eighths of a turn; corners are odd."""


class PoseOffset(Strict, use_attribute_docstrings=True):
    """Change of a device's pose in its own frame: X' = turn (X + shift). The calibration does not follow it."""

    device: Annotated[str, Field(min_length=1)]
    """Name of a camera, or "projector"."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """Rotation about the x, y and z axis."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """Shift along the x, y and z axis."""


class BumpFault(PoseOffset):
    """Device that is bumped when a pose is taken: `[[head.faults.bump]]`.

    The bump stays for all later poses; earlier poses are without it.
    """

    pose: Index
    """Number of the pose, from 0."""


class PoseDrift(PoseOffset):
    """Device that drifts towards a change of pose as 1 - exp(-t / settling): `[[head.drift]]`.

    t counts from the opening of the rig, in seconds for settle_s or in captures for settle_captures. The device does
    not move during a capture.
    """

    settle_s: Positive | None = None
    """Settling time of a drift over time."""

    settle_captures: Positive | None = None
    """Number of captures in which a drift over captures settles."""

    @model_validator(mode="after")
    def _check_settling(self) -> PoseDrift:
        if (self.settle_s is None) == (self.settle_captures is None):
            message = "a drift needs either settle_s or settle_captures"
            raise ValueError(message)
        return self

    def progress(self, time_s: float, captures: int) -> float:
        """Return the fraction of the drift, 0 to 1, after a time and a number of captures."""
        if self.settle_s is not None:
            return 1 - math.exp(-time_s / self.settle_s)
        return 1 - math.exp(-captures / (self.settle_captures or 1.0))


class ObjectMotion(Strict, use_attribute_docstrings=True):
    """Motion of the object while a pose is captured: `[[head.faults.moving]]`."""

    pose: Index | None = None
    """Number of the pose, from 0; default: every pose."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """Shift from the first to the last pattern of the capture."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """Rotation over the capture, about the world's axes at the object's own origin."""

    steps: Annotated[int, Field(ge=2, le=200)] = 6
    """Number of equal steps."""


def apply_pose_offset(device: Pinhole, push: PoseOffset, *, share: float = 1.0) -> Pinhole:
    """Return a device after a fraction of a pose offset."""
    turn = Rotation.from_rotvec(share * np.deg2rad(push.turn_deg)).as_matrix()
    translation = turn @ (device.translation_mm + share * np.array(push.shift_mm))
    return replace(device, rotation=turn @ device.rotation, translation_mm=translation)


class TurntableOptions(Strict, use_attribute_docstrings=True):
    """Options of the turntable: `[head.turntable]`. At 0° the objects are as in the scene file."""

    point_mm: Triple
    """A point on the axis."""

    direction: Triple = (0.0, -1.0, 0.0)
    """Direction of the axis; angles count right-handed about it. Default: upwards, since y points down."""

    objects: Names | None = None
    """Names of the objects on it; default: all except those called "backdrop"."""

    poses: Annotated[int, Field(ge=1, le=360)] = 8
    """Number of equally spaced poses."""

    knows_axis: bool = False
    """Report the axis; otherwise it must be determined, as with a real turntable."""

    scale_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """Relative error of each angle."""

    angle_sigma_deg: NotNegative = 0.0
    """Standard deviation of the angle, drawn again for each turn."""

    wobble_deg: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Tilt of the axis twice per turn, as from an uneven bearing: this times sin(2 · angle), about a direction
    perpendicular to the axis."""

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, direction: Triple) -> Triple:
        if not np.linalg.norm(direction) > 0:
            message = "expected a direction, found [0, 0, 0]; upwards is [0, -1, 0]"
            raise ValueError(message)
        return direction

    @property
    def axis(self) -> RotationAxis:
        """The axis in the world."""
        return RotationAxis(np.array(self.point_mm), np.array(self.direction) / np.linalg.norm(self.direction))

    def motion(self, angle_deg: float) -> FloatArray:
        """(4, 4): motion of the objects from 0° to the exact angle."""
        axis = self.axis
        # Perpendicular to the axis: the world axis farthest from it, orthogonalised.
        farthest = np.eye(3)[np.argmin(np.abs(axis.direction))]
        across = np.cross(axis.direction, farthest)
        across /= np.linalg.norm(across)
        angle = np.deg2rad(angle_deg)
        lean = Rotation.from_rotvec(np.deg2rad(self.wobble_deg) * np.sin(2 * angle) * across)
        motion = np.eye(4)
        motion[:3, :3] = (lean * Rotation.from_rotvec(angle * axis.direction)).as_matrix()
        motion[:3, 3] = axis.point_mm - motion[:3, :3] @ axis.point_mm
        return motion


class SimulatedTurntable(TurntableBase):
    """Implements `slrig.devices.Turntable` in the simulated world.

    turn_objects : moves the objects on the table by a motion (4, 4) from their places in the scene file.
    """

    def __init__(self, options: TurntableOptions, turn_objects: Callable[[FloatArray], None], *, seed: int) -> None:
        super().__init__(options.poses)
        self._options = options
        self._turn_objects = turn_objects
        self._rng = np.random.default_rng((seed, _SEED))
        self._angle_deg = 0.0
        self._closed = False

    @property
    def axis(self) -> RotationAxis | None:
        """See `Turntable`. Without the errors."""
        return self._options.axis if self._options.knows_axis else None

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`. Objects start as in the scene file."""
        return None

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. Reaches the angle at once; does nothing if the angle is unchanged."""
        if self._closed:
            message = "the simulated turntable is closed; open the rig again"
            raise DeviceStateError(message)
        if not np.isfinite(angle_deg):
            message = f"the turntable cannot turn to {angle_deg}°; request a finite angle"
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
    """Name of the pose; default: "pose N" counted from 1."""

    object: str | None = None
    """Name of the moved object; default: the scene's board."""

    position_mm: Triple
    """Position of the object's origin."""

    rotation_deg: Triple = (0.0, 0.0, 0.0)
    """Rotation of the object."""


class PoseSeries(Strict, use_attribute_docstrings=True):
    """Generated poses of the scene's board: `[head.poses]`."""

    count: Annotated[int, Field(ge=1, le=200)] = 20
    """Number of poses."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the random numbers."""

    tilt_deg: Pair = (15.0, 40.0)
    """Minimum and maximum angle between the board and the plane perpendicular to the viewing direction, about axes in
    all directions."""

    roll_deg: NotNegative = 25.0
    """Maximum rotation in its own plane to either side."""

    centre_mm: Triple = (0.0, 0.0, 0.0)
    """Point about which the board is held."""

    depth_mm: Pair = (-60.0, 60.0)
    """Minimum and maximum distance from centre_mm along the line away from the devices."""

    edge_px: NotNegative = 6.0
    """Minimum distance of the paper from the border of every image, including the projector's."""

    @model_validator(mode="after")
    def _check_bounds(self) -> PoseSeries:
        if not 0 <= self.tilt_deg[0] <= self.tilt_deg[1] <= 70 or self.depth_mm[0] > self.depth_mm[1]:
            message = "tilt_deg needs 0 <= minimum <= maximum <= 70, depth_mm minimum <= maximum"
            raise ValueError(message)
        return self


def generate_poses(series: PoseSeries, board: PrintedBoard, devices: Sequence[Pinhole]) -> tuple[ScriptedPose, ...]:
    """Return the poses of a series.

    Successive tilt axes differ by the golden angle, so that any few of them are well distributed. The board is moved
    from the centre towards a side or a corner until its paper touches the border of some device's image.

    Raises
    ------
    ConfigError
        The board does not fit into every image in any pose.
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
    moved_count = 0
    for number in range(series.count):
        # Two in nine stay near the centre; the others go to each corner, then to each side, and so on.
        share = _NEAR_MIDDLE if number % 9 in (0, 4) else 1.0
        side = _SIDES[moved_count % len(_SIDES)]
        in_corner = share == 1.0 and side % 2 == 1
        moved_count += share == 1.0
        for _try in range(_TRIES):
            # Depth and tilt are stratified, each in a different order, and jittered.
            depth = _stratified(series.depth_mm, (number * 7 + 3) % series.count, series.count, rng)
            tilt = np.deg2rad(_stratified(series.tilt_deg, (number * 3 + 1) % series.count, series.count, rng))
            about = number * _GOLDEN_TURN + rng.uniform(-0.2, 0.2)
            towards = side * np.pi / 4 + rng.uniform(-0.15, 0.15)
            # A strongly rotated board would not fill the corner.
            most_roll = series.roll_deg * (0.4 if in_corner else 1.0)
            roll = np.deg2rad(rng.uniform(-most_roll, most_roll))
            leaning = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
            rotation = facing @ (leaning * Rotation.from_rotvec([0.0, 0.0, roll])).as_matrix()
            middle = centre + depth * facing[:, 2]
            corners = paper @ rotation.T + middle
            if not _is_visible_to_all(corners, fields, series.edge_px):
                continue
            across, down = np.cos(towards) * facing[:, 0], 0.75 * np.sin(towards) * facing[:, 1]
            slide = np.zeros(3)
            # First along both axes together, then along each, so that corners are reached.
            for sideways in (across + down, across, down):
                slide += _free_distance(corners + slide, sideways, fields, series.edge_px) * sideways
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
    """(3, 3): board to world of a board perpendicular to `away`, its x as near the world's x as possible."""
    right = np.array([1.0, 0.0, 0.0]) - away[0] * away
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(away, right), away])


def _rounded_pose(number: int, middle: FloatArray, rotation: FloatArray) -> ScriptedPose:
    # Rounded, so that printed poses are exact.
    turn = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    x, y, z = (round(float(each), 4) for each in middle)
    a, b, c = (round(float(each), 4) for each in turn)
    return ScriptedPose(name=f"pose {number + 1}", position_mm=(x, y, z), rotation_deg=(a, b, c))


def _free_distance(
    corners: FloatArray, sideways: FloatArray, fields: Sequence[tuple[Pinhole, float]], edge_px: float
) -> float:
    """Number of times that a board can be moved by `sideways`, mm, until it touches a border."""
    low, high = 0.0, _FARTHEST_MM
    for _ in range(_HALVINGS):
        half = (low + high) / 2
        if _is_visible_to_all(corners + half * sideways, fields, edge_px):
            low = half
        else:
            high = half
    return low


def _is_visible_to_all(points: FloatArray, fields: Sequence[tuple[Pinhole, float]], edge_px: float) -> bool:
    """True if every device images all points; a field is a device and the radius that its lens images."""
    return all(_is_in_image(points, device, radius, edge_px) for device, radius in fields)


def _is_in_image(points: FloatArray, device: Pinhole, radius: float, edge_px: float) -> bool:
    at = points @ device.rotation.T + device.translation_mm
    if (at[:, 2] <= 0).any() or (np.hypot(at[:, 0], at[:, 1]) > radius * at[:, 2]).any():
        return False
    pixels = image_positions(points, device)
    limit = np.array([device.size.width_px, device.size.height_px]) - 1 - edge_px
    return bool(((pixels >= edge_px) & (pixels <= limit)).all())
