"""Frozen values that travel between the rooms of slrig, shape-checked once, on construction.

Conventions: arrays are (row, column); extents only as `Size`; pixel centres at integer coordinates (OpenCV);
world to device `X_dev = R @ X_world + t_mm`; millimetres; unmeasured is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slrig.errors import BundleError, CalibrationError, PatternError

Pixels = NDArray[np.unsignedinteger[Any]]
"""A raw image: (H, W) uint8 or uint16."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]


def _require(array: NDArray[Any], name: str, shape: tuple[int | None, ...], kind: str) -> None:
    fits = array.ndim == len(shape) and all(
        want is None or got == want for got, want in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        wanted = ", ".join("n" if want is None else str(want) for want in shape)
        message = f"{name}: expected an array ({wanted}) of kind '{kind}', found {array.shape} {array.dtype}"
        raise ValueError(message)


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
            message = f"a size must be at least 1 x 1 pixels, found {self.width_px} x {self.height_px}"
            raise ValueError(message)

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

    Raises
    ------
    CalibrationError
        A value is not finite, the rotation is no rotation, or a focal length is not positive.
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
                message = f"{name}: expected shape {shape}, found {array.shape}; write it as DEVICE in the design"
                raise CalibrationError(message)
            if not np.isfinite(array).all():
                message = f"{name}: every number must be finite, found {array.tolist()}; calibrate again"
                raise CalibrationError(message)
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0 or not np.allclose(self.matrix[2], (0, 0, 1)):
            message = (
                "matrix: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, "
                f"found {self.matrix.tolist()}"
            )
            raise CalibrationError(message)
        handed = float(np.linalg.det(self.rotation))
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-4) or handed < 0:
            message = (
                f"rotation: expected an orthonormal right-handed 3 x 3 matrix, found determinant {handed:.4f}; "
                "check the order of rows and columns"
            )
            raise CalibrationError(message)

    @property
    def centre_mm(self) -> FloatArray:
        """(3,) float64: the centre of projection in the world, mm: -Rᵀ t."""
        return np.asarray(-self.rotation.T @ self.translation_mm, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The devices of a rig in one world frame. `projector` is None when only the cameras were calibrated."""

    cameras: Mapping[str, Pinhole]
    projector: Pinhole | None


@dataclass(frozen=True, slots=True)
class White:
    """Every projector pixel lit."""

    kind: Literal["white"] = "white"


@dataclass(frozen=True, slots=True)
class Black:
    """No projector pixel lit."""

    kind: Literal["black"] = "black"


@dataclass(frozen=True, slots=True)
class Gray:
    """One bit of a Gray code: lights position c when bit `bits - 1 - bit` of gray(⌊(c + offset_px)/cell_px⌋) is 1."""

    axis: Axis
    bit: int
    bits: int
    cell_px: int = 1
    offset_px: int = 0
    inverted: bool = False
    kind: Literal["gray"] = "gray"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 24 or not 0 <= self.bit < self.bits or self.cell_px < 1 or self.offset_px < 0:
            message = (
                f"gray pattern: need 1 ≤ bits ≤ 24, 0 ≤ bit < bits, cell_px ≥ 1, offset_px ≥ 0; found bit {self.bit} "
                f"of {self.bits}, cell {self.cell_px} px, offset {self.offset_px} px"
            )
            raise PatternError(message)


@dataclass(frozen=True, slots=True)
class LineShift:
    """One frame of shifted lines: lights position c when (c - shift) mod period < line width."""

    axis: Axis
    shift: int
    period_px: int
    line_width_px: int = 1
    kind: Literal["line_shift"] = "line_shift"

    def __post_init__(self) -> None:
        if self.period_px < 4 or not 0 <= self.shift < self.period_px or not 1 <= self.line_width_px < self.period_px:
            message = (
                "line shift pattern: need period ≥ 4, 0 ≤ shift < period, 1 ≤ line width < period; found shift "
                f"{self.shift}, period {self.period_px}, width {self.line_width_px}"
            )
            raise PatternError(message)

    @property
    def centre_px(self) -> float:
        """Position of the first line's centre: shift + (width - 1)/2."""
        return self.shift + (self.line_width_px - 1) / 2


Pattern = White | Black | Gray | LineShift


@dataclass(frozen=True, slots=True)
class PatternSequence:
    """What a projector shows: specifications, and the light each one asks for.

    Patterns vary along one axis only, so each image is kept as one row or one column and spread when looked at.

    profiles : one (1, Wp), (Hp, 1) or (1, 1) uint8 array per pattern.
    """

    projector: Size
    patterns: tuple[Pattern, ...]
    profiles: tuple[Pixels, ...]

    def __post_init__(self) -> None:
        if len(self.patterns) != len(self.profiles):
            message = f"a sequence needs one profile per pattern, found {len(self.patterns)} and {len(self.profiles)}"
            raise ValueError(message)
        for profile in self.profiles:
            np.broadcast_shapes(profile.shape, self.projector.shape)

    def __len__(self) -> int:
        return len(self.patterns)

    def image(self, index: int) -> Pixels:
        """(Hp, Wp) uint8, a read-only view: the full image of pattern `index`."""
        return np.broadcast_to(self.profiles[index], self.projector.shape)


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure as a camera delivered it. Times are CLOCK_MONOTONIC (or the rig's own clock), ns.

    image : (H, W) uint8 or uint16. `t_start_ns`..`t_end_ns` is the exposure, each known to ± `t_err_ns`: from the first
    row's start to the last row's end. `sequence_number` counts every frame the sensor made; `dropped_count` those lost
    since the camera was armed. `shutter_skew_s` : a rolling shutter's last row is exposed this much later than its
    first; 0 for a global shutter, and where the driver does not know. The times span exposure_s + shutter_skew_s.
    """

    camera: str
    image: Pixels
    t_start_ns: int
    t_end_ns: int
    t_err_ns: int
    sequence_number: int
    dropped_count: int
    exposure_s: float
    gain: float
    shutter_skew_s: float = 0.0

    def __post_init__(self) -> None:
        _require(self.image, "Frame.image", (None, None), "u")


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """Extent and bit depth of a camera's frames; full scale is 2^bit_depth - 1."""

    size: Size
    bit_depth: int

    def __post_init__(self) -> None:
        if not 1 <= self.bit_depth <= 16:
            message = f"bit_depth: expected 1 to 16, found {self.bit_depth}"
            raise BundleError(message)

    @property
    def full_scale(self) -> int:
        """The value of a saturated sample."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame that shows one pattern, seen by one camera. `time_s` counts from the first frame."""

    pattern: int
    camera: str
    image: Pixels
    exposure_s: float | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        _require(self.image, "Shot.image", (None, None), "u")


@dataclass(frozen=True, slots=True)
class Capture:
    """Everything one sequence gave: the patterns as described data, and the frames that show them."""

    projector: Size
    patterns: tuple[Pattern, ...]
    cameras: Mapping[str, CameraFormat]
    shots: tuple[Shot, ...]

    def __post_init__(self) -> None:
        for shot in self.shots:
            if not 0 <= shot.pattern < len(self.patterns) or shot.camera not in self.cameras:
                message = f"a frame names pattern {shot.pattern} of camera '{shot.camera}', which is not in the list"
                raise BundleError(message)
            size = self.cameras[shot.camera].size
            if shot.image.shape != size.shape:
                rows, columns = shot.image.shape
                message = f"a frame of camera '{shot.camera}' is {columns} x {rows}, the camera is {size}"
                raise BundleError(message)


FEWEST_EXPOSURES, MOST_EXPOSURES = 2, 6
"""How many exposures a bracket has."""

_LEAST_STEP = 1.1
_SAME_EXPOSURE = 1.05


def bracket_fault(exposures_s: Sequence[float]) -> str | None:
    """Say why these exposure times are no bracket, and what to ask for; None if they are one.

    >>> bracket_fault([0.005, 0.02, 0.08]) is None
    True
    """
    found = ", ".join(f"{each:g}" for each in exposures_s)
    if not FEWEST_EXPOSURES <= len(exposures_s) <= MOST_EXPOSURES:
        return (
            f"expected {FEWEST_EXPOSURES} to {MOST_EXPOSURES} exposure times, found {len(exposures_s)} ({found}); "
            "three, each four times as long as the one before, are usual, and one alone is exposure_s"
        )
    if not all(0 < each < float("inf") for each in exposures_s):
        return f"expected finite times above 0 s, found {found}; 0.005, 0.02, 0.08 are usual"
    rising = sorted(exposures_s)
    # A tenth as people write it: 0.011 is not quite 1.1 times 0.01 in binary.
    if any(after < (_LEAST_STEP - 1e-9) * before for before, after in pairwise(rising)):
        return (
            f"expected times that differ by {_LEAST_STEP - 1:.0%} at least, found {found}; four times as long as the "
            "one before is usual"
        )
    return None


def exposure_groups(exposures_s: Iterable[float | None]) -> dict[float | None, float | None]:
    """Each exposure time, and the one that stands for all that are alike, the shortest of them.

    A camera that reads each frame's exposure from its hardware names the same one a little differently every time.
    Unknown ones are alike.

    >>> exposure_groups([0.02, 0.005, 0.0201, None])
    {None: None, 0.005: 0.005, 0.02: 0.02, 0.0201: 0.02}
    """
    given = set(exposures_s)
    groups: dict[float | None, float | None] = {None: None} if None in given else {}
    shortest = 0.0
    for each in sorted(e for e in given if e is not None):
        if each > _SAME_EXPOSURE * shortest:
            shortest = each
        groups[each] = shortest
    return groups


@dataclass(frozen=True, slots=True)
class Surface:
    """A bare triangle surface: vertices_mm (V, 3) float64, faces (F, 3) int32."""

    vertices_mm: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        _require(self.vertices_mm, "Surface.vertices_mm", (None, 3), "f")
        _require(self.faces, "Surface.faces", (None, 3), "i")


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """What a rendered rig knows of one camera's view.

    depth_mm : (H, W) float64, distance along the optical axis at the pixel centre, NaN where nothing is seen.
    projector_px : (H, W, 2) float64, (column, row) of the projector pixel lighting that point, NaN in shadow.
    visible_points_mm : (n, 3) float64, world: surface points seen by this camera and lit by the projector.
    """

    depth_mm: FloatArray
    projector_px: FloatArray
    visible_points_mm: FloatArray

    def __post_init__(self) -> None:
        _require(self.depth_mm, "CameraTruth.depth_mm", (None, None), "f")
        _require(self.projector_px, "CameraTruth.projector_px", (*self.depth_mm.shape, 2), "f")
        _require(self.visible_points_mm, "CameraTruth.visible_points_mm", (None, 3), "f")


@dataclass(frozen=True, slots=True)
class Truth:
    """What a rendered rig knows of its scene, in the calibration's world frame."""

    surface: Surface
    cameras: Mapping[str, CameraTruth]


class Refusal(IntEnum):
    """Why a camera pixel gave no surface point, one cause each: the first in the walk that refused it."""

    NONE = 0
    NOT_LIT = 1
    SATURATED = 2
    AMBIGUOUS_BIT = 3
    BEYOND_PROJECTOR = 4
    AMBIGUOUS_LINE = 5
    STRAY_CODE = 6
    SHORT_STRIPE = 7
    SHADOW_EDGE = 8
    DEPTH_EDGE = 9
    OFF_PROJECTOR = 10


class FlipRule(StrEnum):
    """When an edge of the mesh is exchanged for the other diagonal of its two triangles (paper, section 3.1)."""

    CONSTRAINED = "constrained"
    DELAUNAY = "delaunay"


class Source(IntEnum):
    """Which devices a point was triangulated from."""

    CAMERA_PROJECTOR = 0
    CAMERA_CAMERA = 1
    ALL = 2


@dataclass(frozen=True, slots=True)
class PointCurves:
    """Curves of surface points in the world, one per light sheet, ordered along it and by column.

    Curve i holds the points offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; column_px : (c,) float64, the projector column of each curve.
    points_mm : (n, 3) float64; sigma_mm : (n,) float64, standard deviation along the viewing ray's surface normal.
    bridge_after : (n,) bool, True where the step to the next point joins two stripes (paper, section 2).
    source : (n,) uint8, `Source`; grey : (n,) uint8, brightness in the white frame.
    """

    offsets: IntArray
    column_px: FloatArray
    points_mm: FloatArray
    sigma_mm: FloatArray
    bridge_after: NDArray[np.bool_]
    source: NDArray[np.uint8]
    grey: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.points_mm)
        _require(self.points_mm, "PointCurves.points_mm", (None, 3), "f")
        _require(self.column_px, "PointCurves.column_px", (len(self.offsets) - 1,), "f")
        _require(self.sigma_mm, "PointCurves.sigma_mm", (count,), "f")
        _require(self.bridge_after, "PointCurves.bridge_after", (count,), "b")
        _require(self.source, "PointCurves.source", (count,), "u")
        _require(self.grey, "PointCurves.grey", (count,), "u")
        if self.offsets[0] != 0 or self.offsets[-1] != count or (np.diff(self.offsets) < 0).any():
            message = "PointCurves.offsets must rise from 0 to the number of points"
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in the calibration's world frame; triangles counter-clockwise seen from the camera.

    vertices_mm : (V, 3) float32; faces : (F, 3) int32; normals : (V, 3) float32, unit;
    grey : (V,) uint8, brightness in the white frame; sigma_mm : (V,) float32, standard deviation along the normal;
    stripe : (V,) int32, the projector column (rounded down) that the vertex was found on.
    """

    vertices_mm: NDArray[np.float32]
    faces: IntArray
    normals: NDArray[np.float32]
    grey: NDArray[np.uint8]
    sigma_mm: NDArray[np.float32]
    stripe: IntArray

    def __post_init__(self) -> None:
        count = len(self.vertices_mm)
        _require(self.vertices_mm, "Mesh.vertices_mm", (None, 3), "f")
        _require(self.faces, "Mesh.faces", (None, 3), "i")
        _require(self.normals, "Mesh.normals", (count, 3), "f")
        _require(self.grey, "Mesh.grey", (count,), "u")
        _require(self.sigma_mm, "Mesh.sigma_mm", (count,), "f")
        _require(self.stripe, "Mesh.stripe", (count,), "i")
