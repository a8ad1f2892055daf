"""Extents, and the devices of a rig: lens, pose, and how well they are known."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slrig.errors import CalibrationError
from slrig.model.arrays import FloatArray, require

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
