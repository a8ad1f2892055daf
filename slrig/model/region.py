"""Scan region: the part of the scene to measure, and limits for its points."""

from __future__ import annotations

import base64
import binascii
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from slrig.errors import ConfigError
from slrig.model.geometry import Size

Corner = tuple[float, float, float]
Polygon = tuple[tuple[float, float], ...]

MAX_MASK_CHARACTERS = 2**18
"""Length of a mask in base64: ten times that of a two-valued picture of 12 megapixels."""
_MAX_COORDINATE = 1e6  # mm and px: a larger number has the wrong unit
_PNG = struct.Struct(">8s4x4sII")
_PNG_BEGINS = b"\x89PNG\r\n\x1a\n", b"IHDR"


@dataclass(frozen=True, slots=True)
class Region:
    """The part of the scene to measure, and limits for its points. A field that is None or empty sets no limit.

    box_mm : minimum and maximum corner of a box in the world. depth_mm : minimum and maximum depth along each camera's
    optical axis. polygons_px : by camera, corners (x, y) of the measured part of its image. masks : by camera, a PNG of
    the image's size in base64; pixels that are not black are measured. min_contrast : minimum of white − black, as a
    fraction of full scale. max_sigma_mm : maximum standard deviation of a point.

    Raises ConfigError: a limit excludes everything, or is not a valid number, polygon or PNG.
    """

    box_mm: tuple[Corner, Corner] | None = None
    depth_mm: tuple[float, float] | None = None
    polygons_px: Mapping[str, Polygon] = field(default_factory=dict)
    masks: Mapping[str, str] = field(default_factory=dict)
    min_contrast: float | None = None
    max_sigma_mm: float | None = None

    def __post_init__(self) -> None:
        if self.box_mm is not None:
            for axis, least, most in zip("xyz", *self.box_mm, strict=True):
                _require_rising(f"region.box_mm: {axis}", least, most, "mm; write the minimum corner first")
        if self.depth_mm is not None:
            _require_rising("region.depth_mm", *self.depth_mm, "mm from the camera; write the nearest first")
            if self.depth_mm[1] <= 0:
                message = f"region.depth_mm: expected depths in front of the camera, found {self.depth_mm[1]:g} mm"
                raise ConfigError(message)
        for camera, corners in self.polygons_px.items():
            numbers = [number for corner in corners for number in corner]
            if len(corners) < 3 or not all(-_MAX_COORDINATE < number < _MAX_COORDINATE for number in numbers):
                message = (
                    f"region.polygons_px.{camera}: expected three corners or more, [x, y] in pixels, found "
                    f"{len(corners)}; list them in order along the border"
                )
                raise ConfigError(message)
        for camera in self.masks:
            self.mask_size(camera)
        for name, value, most in (
            ("min_contrast", self.min_contrast, 1.0),
            ("max_sigma_mm", self.max_sigma_mm, math.inf),
        ):
            if value is not None and not 0 < value < most:
                below = " and below 1" if most == 1 else ""
                message = f"region.{name}: expected a number above 0{below}, found {value:g}; 0.05 is usual"
                raise ConfigError(message)

    @property
    def cameras(self) -> frozenset[str]:
        """Cameras with a polygon or mask."""
        return frozenset((*self.polygons_px, *self.masks))

    def mask_png(self, camera: str) -> bytes:
        """Return the PNG of a camera's mask. Raises ConfigError: it is not a PNG in base64, or too long."""
        text = self.masks[camera]
        try:
            data = base64.b64decode(text[: MAX_MASK_CHARACTERS + 1], validate=True)
            start, kind, _, _ = _PNG.unpack_from(data)
        except (binascii.Error, ValueError, struct.error):
            start, kind, data = b"", b"", b""
        if (start, kind) != _PNG_BEGINS or len(text) > MAX_MASK_CHARACTERS:
            message = (
                f"region.masks.{camera}: expected a PNG in base64 of at most {MAX_MASK_CHARACTERS} characters, found "
                f"{len(text)} of something else; save the mask as PNG, white where to measure"
            )
            raise ConfigError(message)
        return data

    def mask_size(self, camera: str) -> Size:
        """Return the extent in the header of a camera's mask. Raises ConfigError: it is not a PNG."""
        _, _, width, height = _PNG.unpack_from(self.mask_png(camera))
        try:
            return Size(width, height)
        except ValueError as cause:
            raise ConfigError(f"region.masks.{camera}: {cause}") from cause

    def require_fits(self, cameras: Mapping[str, Size]) -> None:
        """Raise ConfigError if the region names an unknown camera, or a mask has another size than its camera."""
        for name in sorted(self.cameras - set(cameras)):
            message = f"region: expected one of the cameras {sorted(cameras)}, found '{name}'; correct the name"
            raise ConfigError(message)
        for name in self.masks:
            found, size = self.mask_size(name), cameras[name]
            if found != size:
                message = (
                    f"region.masks.{name}: expected {size} pixels as the camera has, found {found}; draw the mask on a "
                    "frame of that camera"
                )
                raise ConfigError(message)


def _require_rising(name: str, low: float, high: float, advice: str) -> None:
    if not -_MAX_COORDINATE < low < high < _MAX_COORDINATE:
        message = f"{name}: expected two rising numbers, found {low:g} and {high:g} {advice}"
        raise ConfigError(message)
