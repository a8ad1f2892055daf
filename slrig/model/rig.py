"""Devices of a rig: extents, lens, pose, uncertainty; light axis; pose of a turntable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import hypot, sqrt
from typing import Any

import numpy as np
from numpy import linalg
from numpy.typing import NDArray

from slrig.errors import CalibrationError

Pixels = NDArray[np.unsignedinteger[Any]]
"""A raw image: (H, W) uint8 or uint16."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]


def require(array: NDArray[Any], name: str, shape: tuple[int | None, ...], kind: str) -> None:
    """Raise ValueError unless an array has this shape (None: any length) and one of these dtype kinds."""
    fits = array.ndim == len(shape) and all(
        want is None or got == want for got, want in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        wanted = ", ".join("n" if want is None else str(want) for want in shape)
        raise ValueError(f"{name}: expected an array ({wanted}) of kind '{kind}', found {array.shape} {array.dtype}")


DEVICE_PARAMETERS = 15
"""Numbers that describe one device in a covariance."""


@dataclass(frozen=True, slots=True)
class Size:
    """An extent in pixels. The only place where width comes before height.

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
    """Which projector coordinate a pattern encodes: `COLUMN` patterns vary along a row."""

    COLUMN = "column"
    ROW = "row"


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A camera or projector: pinhole with Brown distortion (k1, k2, p1, p2, k3), posed in the world.

    matrix : (3, 3) float64, pixels; distortion : (5,) float64; rotation : (3, 3) float64, world to device;
    translation_mm : (3,) float64.

    Raises CalibrationError: a value is not finite, the rotation is no rotation, or a focal length is not positive.
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
        """(3,) float64: the centre of projection in the world, mm: -Rᵀ t."""
        return np.asarray(-self.rotation.T @ self.translation_mm, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """How a calibration was found, and how well: what a scan takes along to say its own error.

    id : names this solve; solved_at : when, ISO 8601 with the offset from UTC.
    covariance : (15 d, 15 d) float64, of fx, fy, cx, cy, k1, k2, p1, p2, k3, a small turn (three angles, rad:
    R' = exp([turn]x) R) and the translation, mm, of each of the d devices: cameras in order, then the projector.
    volume_mm : (2, 3) float64, opposite corners of the box in the world in which the board was held.
    expected_error_mm : standard deviation of a measured point along the first camera's line of sight in that volume,
    from the calibration alone, root mean square; of one camera alone, of a point of known distance across that line.
    scale_sigma : standard deviation of the scale, a share, by the size of the board alone; it is in the covariance.
    """

    id: str
    solved_at: str
    covariance: FloatArray
    volume_mm: FloatArray
    expected_error_mm: float
    scale_sigma: float = 0.0

    def __post_init__(self) -> None:
        require(self.covariance, "Solved.covariance", (None, len(self.covariance)), "f")
        require(self.volume_mm, "Solved.volume_mm", (2, 3), "f")
        if not np.isfinite(self.covariance).all() or not np.allclose(self.covariance, self.covariance.T):
            message = "covariance: expected finite numbers, the same on both sides of the diagonal; solve again"
            raise CalibrationError(message)


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """How bright the projector's light is over its image, at one distance and on one white, as shares of any one light:
    exp(Σ c_ij x^i y^j), with x and y from -1 to 1 over the image's columns and rows.

    coefficients : (C, n, n) float64, c_ij of white alone, or of red, green and blue as the cameras see them.
    covered_px : (2, 2) float64, the least and the greatest (column, row) at which it was measured; beyond, light counts
    as there.
    """

    coefficients: FloatArray
    covered_px: FloatArray

    def __post_init__(self) -> None:
        require(self.coefficients, "light.coefficients", (None, None, None), "f")
        require(self.covered_px, "light.covered_px", (2, 2), "f")

    def light(self, places_px: FloatArray, size: Size, channels: int) -> FloatArray:
        """(n, C) float64 at (n, 2) places, (column, row); (n, 1) for channels that it was not measured in."""
        x, y = light_axes(np.clip(places_px, *self.covered_px), size)
        shares = np.exp([np.polynomial.polynomial.polyval2d(x, y, each) for each in self.coefficients]).T
        return np.asarray(shares if channels == shares.shape[1] else shares.mean(axis=1, keepdims=True))


def light_axes(places_px: FloatArray, size: Size) -> FloatArray:
    """(2, n) float64: x and y of `LightMap` at (n, 2) places, (column, row)."""
    return np.asarray((2 * places_px / (np.array([size.width_px, size.height_px]) - 1) - 1).T)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The devices of a rig in one world frame. `projector` is None when only the cameras were calibrated.

    `solved` is None for a calibration that says nothing of its own error: written by hand, imported, or exact. `light`
    is None where the projector's light was not measured.
    Raises CalibrationError: the covariance is for another number of devices.
    """

    cameras: Mapping[str, Pinhole]
    projector: Pinhole | None
    solved: Solved | None = None
    light: LightMap | None = None

    def __post_init__(self) -> None:
        devices = len(self.cameras) + (self.projector is not None)
        if self.solved is not None and len(self.solved.covariance) != DEVICE_PARAMETERS * devices:
            raise CalibrationError(
                f"covariance: expected {DEVICE_PARAMETERS} rows for each of {devices} devices, found "
                f"{len(self.solved.covariance)} rows; export the calibration again"
            )

    @property
    def triangulates(self) -> bool:
        """Whether it has two rays that meet in a point; one camera alone has a direction, and no depth."""
        return self.projector is not None or len(self.cameras) > 1

    @property
    def solve_id(self) -> str:
        """What is on record about this calibration goes by: the id of its solve, else a digest of its numbers."""
        return self.digest if self.solved is None else self.solved.id

    @property
    def digest(self) -> str:
        """Twelve hexadecimal digits that change with any number of its devices, and not with what is known of them."""
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


LEAST_SHARE = 0.2
"""A baseline that lies across the stripes by less than this share of it (12°) makes errors five times as large as they
need be, and what is seen of depth is mostly errors."""


def triangulated_axis(cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> Axis:
    """The axis of patterns to triangulate by, of cameras in their order.

    Light that runs along the baseline is seen edge on, and an epipolar line meets such a stripe nowhere or everywhere:
    it tells no depth. Columns are for devices side by side, rows for devices above one another.

    With a projector that is the axis by which all cameras together know depth best: a point moves in a camera by as
    many pixels as its focal length times its baseline, seen in the projector's frame; inverse variances add up.
    Without a projector the baseline is that from the first camera to another, seen in the first camera's frame; of
    several the one that is longest across the view. The projector is then assumed to stand upright to the first camera,
    within 45°: its columns run down the image. The direction of the stripes shows whether that holds
    (`slrig.reconstruction.triangulation`).
    """
    across = share_across(Axis.COLUMN, cameras, projector)
    return Axis.COLUMN if across >= share_across(Axis.ROW, cameras, projector) else Axis.ROW


def share_across(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> float:
    """0 to 1: the sine of the angle between the baseline of `triangulated_axis` and the stripes of an axis.

    A point's error grows with its inverse. Of several baselines their root mean square by the same weights. Where there
    is no baseline to be seen, 1 for columns and 0 for rows.
    """
    beside, above = _moved_px(cameras, projector)
    length = hypot(beside, above)
    if length == 0:
        return 1.0 if axis is Axis.COLUMN else 0.0
    return (beside if axis is Axis.COLUMN else above) / length


def told_depth(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole, /) -> list[bool]:
    """Which cameras an axis of light tells depth; all of them where it tells it to none."""
    told = [share_across(axis, [camera], projector) >= LEAST_SHARE for camera in cameras]
    return told if any(told) else [True] * len(told)


def _moved_px(cameras: Sequence[Pinhole], projector: Pinhole | None) -> tuple[float, float]:
    """By how much points move in images, px mm, along x and y of the frame that the baselines are seen in.

    What of a baseline runs along the view is of no use.
    """
    first, *others = cameras
    seen_by, ends = (first, others) if projector is None else (projector, cameras)
    found = [
        sqrt(abs(linalg.det(end.matrix[:2, :2]))) * abs(seen_by.rotation @ end.centre_mm + seen_by.translation_mm)
        for end in ends
    ]
    if projector is None:
        return max(((float(x), float(y)) for x, y, _ in found), key=lambda each: hypot(*each), default=(0.0, 0.0))
    return hypot(*(float(x) for x, _, _ in found)), hypot(*(float(y) for _, y, _ in found))


@dataclass(frozen=True, slots=True)
class StageAxis:
    """The axis that a stage turns about, in the calibration's world frame.

    point_mm : (3,), any point of it. direction : (3,), unit; angles count right-handed about it.
    """

    point_mm: FloatArray
    direction: FloatArray


@dataclass(frozen=True, slots=True)
class MeasuredAxis(StageAxis):
    """An axis, and how well it is known.

    covariance : (6, 6) float64, of the point (mm) and of the direction (rad), both across the axis: along it there is
    none.
    """

    covariance: FloatArray

    @property
    def point_sigma_mm(self) -> float:
        """Standard deviation of the point across the axis, rms of both directions."""
        return float(np.sqrt(max(np.trace(self.covariance[:3, :3]), 0.0) / 2))

    @property
    def direction_sigma_rad(self) -> float:
        """The same of the direction."""
        return float(np.sqrt(max(np.trace(self.covariance[3:, 3:]), 0.0) / 2))


class PlaneKind(StrEnum):
    """What a plane is: of the plate that the object stands on, square to the axis, or of anything else behind it."""

    PLATE = "plate"
    BACKDROP = "backdrop"


@dataclass(frozen=True, slots=True)
class StagePlane:
    """A plane of the empty stage, in the calibration's world frame; nothing of the object lies behind it.

    point_mm : (3,), the middle of what was seen of it. normal : (3,), unit, to the side it was seen from. sigma_mm :
    deviation of its surface from it; radius_mm : how far from the middle it was seen. margin_mm : what lies so near
    before it is cut away, too.
    """

    kind: PlaneKind
    point_mm: FloatArray
    normal: FloatArray
    sigma_mm: float
    radius_mm: float
    margin_mm: float
