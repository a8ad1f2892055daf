"""Surfaces: curves of points, meshes, truth, causes of refused pixels, colours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model.rig import FloatArray, IntArray, require

_FULL_16 = 65_535
# Light below which the curve is straight, and what comes out there.
_STRAIGHT_BELOW, _STRAIGHT_SLOPE = 0.0031308, 12.92
_POWER, _OFFSET = 2.4, 0.055


def srgb_of(light: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """(...) uint8: the sRGB value of light, a share of white. Beyond 0 to 1 it is cut; NaN gives 0."""
    share = np.clip(np.nan_to_num(light, nan=0.0, posinf=1.0), 0, 1)
    return np.asarray(_to_srgb()[np.rint(share * _FULL_16).astype(np.uint16)])


def light_of(srgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """(...) uint16: the light of an sRGB value, of 65535 for white. 8 bits of it could not tell dark colours apart."""
    return np.asarray(_to_light()[srgb])


@cache
def _to_srgb() -> NDArray[np.uint8]:
    """(65536,) uint8, by light of 65535: the steepest place errs by a fortieth of an sRGB step."""
    light: FloatArray = np.arange(_FULL_16 + 1) / _FULL_16
    curved = (1 + _OFFSET) * light ** (1 / _POWER) - _OFFSET
    value: FloatArray = np.where(light <= _STRAIGHT_BELOW, _STRAIGHT_SLOPE * light, curved)
    return np.rint(255 * value).astype(np.uint8)


@cache
def _to_light() -> NDArray[np.uint16]:
    """(256,) uint16, by sRGB value."""
    value: FloatArray = np.arange(256) / 255
    straight = value <= _STRAIGHT_SLOPE * _STRAIGHT_BELOW
    light: FloatArray = np.where(straight, value / _STRAIGHT_SLOPE, ((value + _OFFSET) / (1 + _OFFSET)) ** _POWER)
    return np.rint(_FULL_16 * light).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class Surface:
    """A bare triangle surface: vertices_mm (V, 3) float64, faces (F, 3) int32."""

    vertices_mm: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        require(self.vertices_mm, "Surface.vertices_mm", (None, 3), "f")
        require(self.faces, "Surface.faces", (None, 3), "i")


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
        require(self.depth_mm, "CameraTruth.depth_mm", (None, None), "f")
        require(self.projector_px, "CameraTruth.projector_px", (*self.depth_mm.shape, 2), "f")
        require(self.visible_points_mm, "CameraTruth.visible_points_mm", (None, 3), "f")


@dataclass(frozen=True, slots=True)
class Truth:
    """What a rendered rig knows of its scene, in the calibration's world frame."""

    surface: Surface
    cameras: Mapping[str, CameraTruth]


class Refusal(IntEnum):
    """Why a camera pixel gave no surface point, one cause each: the first in the walk that refused it.

    10 to 13 say what became of a ray on its way to the light sheet: they meet where the projector has no pixel, behind
    the camera or the projector, or nowhere that Newton's method finds; or the sheet holds the camera, too. The last one
    is none of the world's: the scan was not asked for it.
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


class FlipRule(StrEnum):
    """When an edge of the mesh is exchanged for the other diagonal of its two triangles (paper, section 3.1)."""

    CONSTRAINED = "constrained"
    DELAUNAY = "delaunay"


class Source(IntEnum):
    """Which devices a point was triangulated from."""

    CAMERA_PROJECTOR = 0
    CAMERA_CAMERA = 1
    ALL = 2


class AlbedoMark(IntEnum):
    """Why the albedo of a point is not to be relied on, the first cause that holds; NONE where it is.

    SATURATED : a pixel that it was read from is clipped, so that it is brighter than told. GRAZING : light comes in so
    flat that a small error of the normal is a large one of albedo. BORDER : at the border of the projector's image,
    where its light fades. UNKNOWN : the surface has no normal there, and the point a neutral colour. SHADED : no
    calibrated projector, so that nothing tells how much light came in; the colour is brightness.
    """

    NONE = 0
    SATURATED = 1
    GRAZING = 2
    BORDER = 3
    UNKNOWN = 4
    SHADED = 5


@dataclass(frozen=True, slots=True)
class PointCurves:
    """Curves of surface points in the world, one per light sheet, ordered along it and by column.

    Curve i holds the points offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; column_px : (c,) float64, the projector column of each curve.
    points_mm : (n, 3) float64; sigma_mm : (n,) float64, standard deviation along the viewing ray's surface normal.
    bridge_after : (n,) bool, True where the step to the next point joins two stripes (paper, section 2).
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
        require(self.points_mm, "PointCurves.points_mm", (None, 3), "f")
        require(self.column_px, "PointCurves.column_px", (len(self.offsets) - 1,), "f")
        require(self.sigma_mm, "PointCurves.sigma_mm", (count,), "f")
        require(self.bridge_after, "PointCurves.bridge_after", (count,), "b")
        require(self.source, "PointCurves.source", (count,), "u")
        require(self.colour, "PointCurves.colour", (count, 3), "u")
        require(self.mark, "PointCurves.mark", (count,), "u")
        if self.offsets[0] != 0 or self.offsets[-1] != count or (np.diff(self.offsets) < 0).any():
            raise ValueError("PointCurves.offsets must rise from 0 to the number of points")


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in the calibration's world frame; triangles counter-clockwise seen from the camera.

    vertices_mm : (V, 3) float32; faces : (F, 3) int32; normals : (V, 3) float32, unit;
    colour : (V, 3) uint8, relative albedo as sRGB; mark : (V,) uint8, `AlbedoMark`;
    sigma_mm : (V,) float32, standard deviation along the normal;
    stripe : (V,) int32, the projector column (rounded down) that the vertex was found on.
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
        require(self.vertices_mm, "Mesh.vertices_mm", (None, 3), "f")
        require(self.faces, "Mesh.faces", (None, 3), "i")
        require(self.normals, "Mesh.normals", (count, 3), "f")
        require(self.colour, "Mesh.colour", (count, 3), "u")
        require(self.mark, "Mesh.mark", (count,), "u")
        require(self.sigma_mm, "Mesh.sigma_mm", (count,), "f")
        require(self.stripe, "Mesh.stripe", (count,), "i")
