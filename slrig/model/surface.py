"""Surfaces: curves of points, meshes, ground truth, causes of rejected pixels, sRGB."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model.geometry import Calibration, FloatArray, IntArray, require_array

_FULL_SCALE_16 = 65_535
# The sRGB transfer function of IEC 61966-2-1: linear up to the first number, then a power law.
_LINEAR_UP_TO, _LINEAR_SLOPE = 0.0031308, 12.92
_POWER, _OFFSET = 2.4, 0.055


class MeshAxes(StrEnum):
    """Axes of the files that hold a mesh or its points, mm.

    UPRIGHT : x right, y up, z towards the rig, as viewers and CAD programs have them: (x, -y, -z) of the calibration.
    RIG : those of the calibration, x right, y down, z away from the rig, to compare with other data.
    ROBOT : those of the base of a robot, in which hand-eye calibration locates the rig.
    """

    UPRIGHT = "upright"
    RIG = "rig"
    ROBOT = "robot"


def linear_to_srgb(light: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return the sRGB value, (...) uint8, of light relative to white, clipped to 0 to 1; NaN gives 0."""
    clipped = np.clip(np.nan_to_num(light, nan=0.0, posinf=1.0), 0, 1)
    return np.asarray(_srgb_table()[np.rint(clipped * _FULL_SCALE_16).astype(np.uint16)])


def srgb_to_linear(srgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the light, (...) uint16, of an sRGB value; white is 65535. 8 bits would merge dark colours."""
    return np.asarray(_linear_table()[srgb])


@cache
def _srgb_table() -> NDArray[np.uint8]:
    """(65536,) uint8, by light; the largest rounding error is a fortieth of an sRGB step."""
    light: FloatArray = np.arange(_FULL_SCALE_16 + 1) / _FULL_SCALE_16
    curved = (1 + _OFFSET) * light ** (1 / _POWER) - _OFFSET
    value: FloatArray = np.where(light <= _LINEAR_UP_TO, _LINEAR_SLOPE * light, curved)
    return np.rint(255 * value).astype(np.uint8)


@cache
def _linear_table() -> NDArray[np.uint16]:
    """(256,) uint16, by sRGB value."""
    value: FloatArray = np.arange(256) / 255
    linear = value <= _LINEAR_SLOPE * _LINEAR_UP_TO
    light: FloatArray = np.where(linear, value / _LINEAR_SLOPE, ((value + _OFFSET) / (1 + _OFFSET)) ** _POWER)
    return np.rint(_FULL_SCALE_16 * light).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class Surface:
    """A triangle mesh without attributes: vertices_mm (V, 3) float64, faces (F, 3) int32."""

    vertices_mm: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        require_array(self.vertices_mm, "Surface.vertices_mm", (None, 3), "f")
        require_array(self.faces, "Surface.faces", (None, 3), "i")


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """Ground truth of one camera's view in a rendered rig.

    depth_mm : (H, W) float64, depth along the optical axis at the pixel centre, NaN without a surface.
    projector_px : (H, W, 2) float64, (column, row) of the projector pixel that lights that point, NaN in shadow.
    visible_points_mm : (n, 3) float64, world: surface points that this camera sees and the projector lights.
    """

    depth_mm: FloatArray
    projector_px: FloatArray
    visible_points_mm: FloatArray

    def __post_init__(self) -> None:
        require_array(self.depth_mm, "CameraTruth.depth_mm", (None, None), "f")
        require_array(self.projector_px, "CameraTruth.projector_px", (*self.depth_mm.shape, 2), "f")
        require_array(self.visible_points_mm, "CameraTruth.visible_points_mm", (None, 3), "f")


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a rendered scene, in the renderer's world frame. calibration : the true one, in the same frame;
    None if the truth is in the frame of every calibration of the rig.
    """

    surface: Surface
    cameras: Mapping[str, CameraTruth]
    calibration: Calibration | None = None


class Refusal(IntEnum):
    """Why a camera pixel gave no surface point: the first step of the reconstruction that rejected it.

    10 to 13 concern the intersection of the viewing ray with the light sheet: outside the projector's image, behind the
    camera or the projector, not found by Newton's method, or undefined because the sheet contains the camera.
    NO_SURFACE is the cause of decoded pixels without another one that no triangle of the mesh covers.
    """

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
    BEHIND_DEVICE = 11
    NO_INTERSECTION = 12
    SHEET_SEEN_ALONG = 13
    OUTSIDE_REGION = 14
    MIRROR_IMAGE = 15
    CONTRADICTED = 16
    ONE_CAMERA_ONLY = 17
    NO_SURFACE = 18


class FlipRule(StrEnum):
    """Criterion for flipping an edge to the other diagonal of its two triangles (paper, section 3.1)."""

    CONSTRAINED = "constrained"
    DELAUNAY = "delaunay"


class Source(IntEnum):
    """Devices that a point was triangulated from."""

    CAMERA_PROJECTOR = 0
    CAMERA_CAMERA = 1
    ALL = 2


class AlbedoMark(IntEnum):
    """Why the albedo of a point is unreliable, the first cause that applies; NONE if it is reliable.

    SATURATED : one of its pixels is clipped, so the albedo is too small. GRAZING : the angle of incidence is so large
    that a small error of the normal is a large error of the albedo. BORDER : near the border of the projector's image,
    where its light fades. UNKNOWN : the surface has no normal, and the point a neutral colour. SHADED : the
    projector is not calibrated, so the incident light is unknown and the colour is brightness.
    """

    NONE = 0
    SATURATED = 1
    GRAZING = 2
    BORDER = 3
    UNKNOWN = 4
    SHADED = 5


@dataclass(frozen=True, slots=True)
class PointCurves:
    """Curves of surface points in the world, one for each light sheet, sorted by column.

    Curve i is points[offsets[i]:offsets[i + 1]].

    offsets : (c + 1,) int32; column_px : (c,) float64, projector column of each curve.
    points_mm : (n, 3) float64; sigma_mm : (n,) float64, standard deviation along the surface normal.
    bridge_after : (n,) bool, True if the step to the next point joins two stripes (paper, section 2).
    source : (n,) uint8, `Source`; colour : (n, 3) uint8, albedo as sRGB; mark : (n,) uint8, `AlbedoMark`.
    """

    offsets: IntArray
    column_px: FloatArray
    points_mm: FloatArray
    sigma_mm: FloatArray
    bridge_after: NDArray[np.bool_]
    source: NDArray[np.uint8]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.points_mm)
        require_array(self.points_mm, "PointCurves.points_mm", (None, 3), "f")
        require_array(self.column_px, "PointCurves.column_px", (len(self.offsets) - 1,), "f")
        require_array(self.sigma_mm, "PointCurves.sigma_mm", (count,), "f")
        require_array(self.bridge_after, "PointCurves.bridge_after", (count,), "b")
        require_array(self.source, "PointCurves.source", (count,), "u")
        require_array(self.colour, "PointCurves.colour", (count, 3), "u")
        require_array(self.mark, "PointCurves.mark", (count,), "u")
        if self.offsets[0] != 0 or self.offsets[-1] != count or (np.diff(self.offsets) < 0).any():
            raise ValueError("PointCurves.offsets must rise from 0 to the number of points")


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in the calibration's world frame; triangles are counter-clockwise as seen from the camera.

    vertices_mm : (V, 3) float32; faces : (F, 3) int32; normals : (V, 3) float32, unit;
    colour : (V, 3) uint8, relative albedo as sRGB; mark : (V,) uint8, `AlbedoMark`;
    sigma_mm : (V,) float32, standard deviation along the normal;
    stripe : (V,) int32, projector column of the vertex, rounded down.
    """

    vertices_mm: NDArray[np.float32]
    faces: IntArray
    normals: NDArray[np.float32]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    sigma_mm: NDArray[np.float32]
    stripe: IntArray

    def __post_init__(self) -> None:
        count = len(self.vertices_mm)
        require_array(self.vertices_mm, "Mesh.vertices_mm", (None, 3), "f")
        require_array(self.faces, "Mesh.faces", (None, 3), "i")
        require_array(self.normals, "Mesh.normals", (count, 3), "f")
        require_array(self.colour, "Mesh.colour", (count, 3), "u")
        require_array(self.mark, "Mesh.mark", (count,), "u")
        require_array(self.sigma_mm, "Mesh.sigma_mm", (count,), "f")
        require_array(self.stripe, "Mesh.stripe", (count,), "i")
