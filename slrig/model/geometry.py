"""Geometry of a rig: extents, devices with lens and pose, calibration, baselines, turntable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import hypot, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy import linalg
from numpy.typing import NDArray

from slrig.errors import CalibrationError

Pixels = NDArray[np.unsignedinteger[Any]]
"""A raw image: (H, W) uint8 or uint16."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

DEVICE_PARAMETERS = 15
"""Rows for each device in a calibration's covariance."""

MIN_BASELINE_FRACTION = 0.2
"""Smallest useful `baseline_fraction`. A baseline at less than 12° to the stripes makes errors five times as large as
one at right angles, and the depth that it measures is mostly errors."""


def require_array(array: NDArray[Any], name: str, shape: tuple[int | None, ...], kind: str) -> None:
    """Raise ValueError unless an array has this shape (None: any length) and one of these dtype kinds."""
    fits = array.ndim == len(shape) and all(
        expected is None or found == expected for found, expected in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: expected an array ({wanted}) of kind '{kind}', found {array.shape} {array.dtype}")


@dataclass(frozen=True, slots=True)
class Size:
    """Width and height in pixels. Arrays have the opposite order, see `shape`.

    >>> Size(1280, 800).shape
    (800, 1280)
    """

    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise ValueError(f"a size must be at least 1 x 1 pixels, found {self.width_px} x {self.height_px}")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), the shape of an array of this extent."""
        return (self.height_px, self.width_px)

    def along(self, axis: Axis) -> int:
        """Number of columns for the column axis, of rows for the row axis."""
        return self.width_px if axis is Axis.COLUMN else self.height_px

    def __str__(self) -> str:
        return f"{self.width_px} x {self.height_px}"


class Axis(StrEnum):
    """Projector coordinate that a pattern encodes. `COLUMN` patterns vary along a row."""

    COLUMN = "column"
    ROW = "row"

    @property
    def other(self) -> Axis:
        """The other coordinate."""
        return Axis.ROW if self is Axis.COLUMN else Axis.COLUMN


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A camera or projector: pinhole with Brown distortion (k1, k2, p1, p2, k3) and pose in the world.

    matrix : (3, 3) float64, pixels; distortion : (5,) float64; rotation : (3, 3) float64, world to device;
    translation_mm : (3,) float64.

    Raises CalibrationError: a value is not finite, a focal length is not positive, or `rotation` is not orthonormal and
    right-handed.
    """

    size: Size
    matrix: FloatArray
    distortion: FloatArray
    rotation: FloatArray
    translation_mm: FloatArray

    def __post_init__(self) -> None:
        for name, shape in (("matrix", (3, 3)), ("distortion", (5,)), ("rotation", (3, 3)), ("translation_mm", (3,))):
            array: FloatArray = getattr(self, name)
            if array.shape != shape:
                message = f"{name}: expected shape {shape}, found {array.shape}; see slrig.model.Pinhole for a device"
                raise CalibrationError(message)
            if not np.isfinite(array).all():
                raise CalibrationError(f"{name}: every number must be finite, found {array.tolist()}; calibrate again")
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0 or not np.allclose(self.matrix[2], (0, 0, 1)):
            raise CalibrationError(
                "matrix: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, "
                f"found {self.matrix.tolist()}"
            )
        handed = float(np.linalg.det(self.rotation))
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-4) or handed < 0:
            raise CalibrationError(
                f"rotation: expected an orthonormal right-handed 3 x 3 matrix, found determinant {handed:.4f}; "
                "check the order of rows and columns"
            )

    @property
    def centre_mm(self) -> FloatArray:
        """(3,) float64: centre of projection in the world, mm: -Rᵀ t."""
        return np.asarray(-self.rotation.T @ self.translation_mm, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class SolveRecord:
    """Identity, date and uncertainty of a solved calibration, from which a scan states its own error.

    solved_at : ISO 8601 with the offset from UTC.
    covariance : (15 d, 15 d) float64, of fx, fy, cx, cy, k1, k2, p1, p2, k3, a small rotation (three angles, rad:
    R' = exp([a]x) R) and the translation, mm, of each of the d devices: cameras in order, then the projector.
    volume_mm : (2, 3) float64, opposite corners of the box in the world that contained the board.
    expected_error_mm : rms over that volume of the standard deviation of a measured point along the first camera's line
    of sight, from the calibration alone; for a single camera, across that line for a point of known distance.
    scale_sigma : relative standard deviation of the scale from the size of the board; the covariance includes it.
    """

    id: str
    solved_at: str
    covariance: FloatArray
    volume_mm: FloatArray
    expected_error_mm: float
    scale_sigma: float = 0.0

    def __post_init__(self) -> None:
        require_array(self.covariance, "SolveRecord.covariance", (None, len(self.covariance)), "f")
        require_array(self.volume_mm, "SolveRecord.volume_mm", (2, 3), "f")
        if not np.isfinite(self.covariance).all() or not np.allclose(self.covariance, self.covariance.T):
            message = "covariance: expected finite numbers, the same on both sides of the diagonal; solve again"
            raise CalibrationError(message)


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """Relative brightness of the projector over its image, at constant distance on one white surface:
    exp(Σ c_ij x^i y^j), with x and y from -1 to 1 over the image's columns and rows.

    coefficients : (C, n, n) float64, c_ij of white, or of red, green and blue in the cameras' colours.
    covered_px : (2, 2) float64, minimum and maximum (column, row) of the measured area; its border values hold outside.
    """

    coefficients: FloatArray
    covered_px: FloatArray

    def __post_init__(self) -> None:
        require_array(self.coefficients, "light.coefficients", (None, None, None), "f")
        require_array(self.covered_px, "light.covered_px", (2, 2), "f")

    def light(self, points_px: FloatArray, size: Size, channels: int) -> FloatArray:
        """(n, C) float64: brightness at (n, 2) points, (column, row); (n, 1), the mean, if C is not `channels`."""
        x, y = light_map_coordinates(np.clip(points_px, *self.covered_px), size)
        values = np.exp([np.polynomial.polynomial.polyval2d(x, y, each) for each in self.coefficients]).T
        return np.asarray(values if channels == values.shape[1] else values.mean(axis=1, keepdims=True))


def light_map_coordinates(points_px: FloatArray, size: Size) -> FloatArray:
    """(2, n) float64: x and y of `LightMap` at (n, 2) points, (column, row)."""
    return np.asarray((2 * points_px / (np.array([size.width_px, size.height_px]) - 1) - 1).T)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The devices of a rig in one world frame. `projector` is None if only the cameras were calibrated.

    `solved` is None if the uncertainty is unknown: the calibration was written manually, imported, or is exact. `light`
    is None if the projector's light was not measured.

    Raises CalibrationError: the covariance is for another number of devices.
    """

    cameras: Mapping[str, Pinhole]
    projector: Pinhole | None
    solved: SolveRecord | None = None
    light: LightMap | None = None

    def __post_init__(self) -> None:
        devices = len(self.cameras) + (self.projector is not None)
        if self.solved is not None and len(self.solved.covariance) != DEVICE_PARAMETERS * devices:
            raise CalibrationError(
                f"covariance: expected {DEVICE_PARAMETERS} rows for each of {devices} devices, found "
                f"{len(self.solved.covariance)} rows; export the calibration again"
            )

    @property
    def can_triangulate(self) -> bool:
        """True with two devices or more; a single camera measures directions only."""
        return self.projector is not None or len(self.cameras) > 1

    @property
    def solve_id(self) -> str:
        """Identifier of this calibration in records: the id of its solve, or else its digest."""
        return self.digest if self.solved is None else self.solved.id

    @property
    def digest(self) -> str:
        """Twelve hexadecimal digits of a hash of all device parameters, without their uncertainty."""
        devices: dict[str, Pinhole | None] = {**self.cameras, "projector": self.projector}
        text = json.dumps(
            {
                name: None
                if device is None
                else [
                    device.size.shape,
                    *(a.tolist() for a in (device.matrix, device.distortion, device.rotation, device.translation_mm)),
                ]
                for name, device in devices.items()
            },
            sort_keys=True,
        )
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def triangulated_axis(cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> Axis:
    """Return the axis of the patterns to triangulate with. cameras : in the order of the rig.

    Stripes along the baseline give no depth: an epipolar line meets such a stripe nowhere or everywhere. Columns are
    for devices side by side, rows for devices above one another.

    With a projector, the axis is the one with the smaller depth error from all cameras together: disparity in a camera
    is proportional to its focal length times its baseline in the projector's frame, and inverse variances add up.
    Without a projector, the baseline is that from the first camera to another in the first camera's frame, the longest
    across the view of several. The projector is then assumed to be upright to the first camera within 45°, so that its
    columns run down the image; `slrig.reconstruction.triangulation` checks this by the direction of the stripes.
    """
    across = baseline_fraction(Axis.COLUMN, cameras, projector)
    return Axis.COLUMN if across >= baseline_fraction(Axis.ROW, cameras, projector) else Axis.ROW


def baseline_fraction(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> float:
    """Return the sine of the angle between the baseline of `triangulated_axis` and the stripes of an axis, 0 to 1.

    A point's error is proportional to its inverse. Several baselines count by their weighted root mean square. Without
    a baseline across the view, the result is 1 for columns and 0 for rows.
    """
    x, y = _baselines_px_mm(cameras, projector)
    length = hypot(x, y)
    if length == 0:
        return 1.0 if axis is Axis.COLUMN else 0.0
    return (x if axis is Axis.COLUMN else y) / length


def depth_sensitive_cameras(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole, /) -> list[bool]:
    """Return which cameras measure depth with patterns of an axis; all of them if none does."""
    sensitive = [baseline_fraction(axis, [camera], projector) >= MIN_BASELINE_FRACTION for camera in cameras]
    return sensitive if any(sensitive) else [True] * len(sensitive)


def _baselines_px_mm(cameras: Sequence[Pinhole], projector: Pinhole | None) -> tuple[float, float]:
    """Focal length times baseline, px mm, along x and y of the projector's or the first camera's frame.

    The component along the view gives no disparity and is left out.
    """
    first, *others = cameras
    base, devices = (first, others) if projector is None else (projector, cameras)
    baselines = [
        sqrt(abs(linalg.det(device.matrix[:2, :2]))) * abs(base.rotation @ device.centre_mm + base.translation_mm)
        for device in devices
    ]
    if projector is None:
        return max(((float(x), float(y)) for x, y, _ in baselines), key=lambda each: hypot(*each), default=(0.0, 0.0))
    return hypot(*(float(x) for x, _, _ in baselines)), hypot(*(float(y) for _, y, _ in baselines))


@dataclass(frozen=True, slots=True)
class RotationAxis:
    """Rotation axis of a turntable in the calibration's world frame.

    point_mm : (3,), any point on the axis. direction : (3,), unit; angles are right-handed about it.
    """

    point_mm: FloatArray
    direction: FloatArray


@dataclass(frozen=True, slots=True)
class MeasuredAxis(RotationAxis):
    """A rotation axis with its uncertainty.

    covariance : (6, 6) float64, of the point (mm) and the direction (rad), both across the axis; zero along it.
    """

    covariance: FloatArray

    @property
    def point_sigma_mm(self) -> float:
        """Standard deviation of the point across the axis, rms of the two directions."""
        return float(np.sqrt(max(np.trace(self.covariance[:3, :3]), 0.0) / 2))

    @property
    def direction_sigma_rad(self) -> float:
        """Standard deviation of the direction, rms of the two angles."""
        return float(np.sqrt(max(np.trace(self.covariance[3:, 3:]), 0.0) / 2))


class PlaneKind(StrEnum):
    """Kind of plane: the plate under the object, perpendicular to the axis, or a backdrop behind it."""

    PLATE = "plate"
    BACKDROP = "backdrop"


@dataclass(frozen=True, slots=True)
class TurntablePlane:
    """A plane of the empty turntable in the calibration's world frame. The object is entirely in front of it.

    point_mm : (3,), centre of the measured area. normal : (3,), unit, towards the cameras. sigma_mm : standard
    deviation of the surface from the plane. radius_mm : radius of the measured area. margin_mm : thickness of the layer
    in front of the plane that is also removed from scans.
    """

    kind: PlaneKind
    point_mm: FloatArray
    normal: FloatArray
    sigma_mm: float
    radius_mm: float
    margin_mm: float


AXIS_SPAN_MM = 50.0  # distance along the axis, both ways from the object's middle, within which two axes are compared
MAX_AXIS_SIGMAS = 5.0  # limit of the distance of two axes in their four parameters: as rare (5e-5) as 4 σ in one
_DRIFT_MM, _DRIFT_RAD = 0.005, 5e-5
"""Drift of a rig against its turntable between models: 1 K over 0.2 m of aluminium, and that over 0.1 m."""


class AxisUpdate(NamedTuple):
    """A recorded axis after another measurement of it.

    axis : both combined by their covariances; the recorded one if they disagree. moved_mm : largest distance of the two
    within `AXIS_SPAN_MM` along the new one; moved_deg : their angle; sigmas : their Mahalanobis distance in the four
    parameters of an axis.
    """

    axis: MeasuredAxis
    moved_mm: float
    moved_deg: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        """True if they are one axis."""
        return self.sigmas <= MAX_AXIS_SIGMAS


def update_axis(record: MeasuredAxis, found: MeasuredAxis) -> AxisUpdate:
    """Update a recorded axis by another measurement: a Kalman filter with a small drift in between."""
    along = record.direction
    sense = 1.0 if found.direction @ along > 0 else -1.0
    base = record.point_mm + along * (along @ (found.point_mm - record.point_mm))
    across = np.linalg.svd(along[None])[2][1:]
    drift = np.diag([_DRIFT_MM**2] * 2 + [_DRIFT_RAD**2] * 2)
    _, before = _axis_parameters(RotationAxis(base, along), across, record)
    difference, of_found = _axis_parameters(RotationAxis(base, along), across, found)
    before = before + drift
    gain = before @ np.linalg.inv(before + of_found)
    offset, tilt = difference[:2], difference[2:]
    distances = [float(np.linalg.norm(offset + s * tilt)) for s in (-AXIS_SPAN_MM, AXIS_SPAN_MM)]
    sigmas = float(np.sqrt(difference @ np.linalg.solve(before + of_found, difference)))
    axis = record
    if sigmas <= MAX_AXIS_SIGMAS:
        change = gain @ difference
        direction = along + change[2:] @ across
        known = (np.eye(4) - gain) @ before
        spread = np.kron(np.eye(2), across.T)
        axis = MeasuredAxis(
            base + change[:2] @ across, direction / np.linalg.norm(direction), spread @ known @ spread.T
        )
    angle = np.arccos(np.clip(sense * (found.direction @ along), -1.0, 1.0))
    return AxisUpdate(axis, max(distances), float(np.rad2deg(angle)), sigmas)


def _axis_parameters(base: RotationAxis, across: FloatArray, axis: MeasuredAxis) -> tuple[FloatArray, FloatArray]:
    """(4,), (4, 4): point (mm) and slopes of an axis where it crosses the plane through `base` square to it, in the
    coordinates `across` (2, 3); and their covariance.
    """
    slope = axis.direction / (axis.direction @ base.direction)
    along = (base.point_mm - axis.point_mm) @ base.direction
    transport = np.kron([[1.0, along], [0.0, 1.0]], across)
    parameters = np.concatenate([across @ (axis.point_mm + along * slope - base.point_mm), across @ slope])
    return parameters, transport @ axis.covariance @ transport.T
