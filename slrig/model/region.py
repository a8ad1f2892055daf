"""Scan region: the part of a scene to measure, and the tolerance for its points."""

from __future__ import annotations

import base64
import binascii
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from slrig.errors import ConfigError
from slrig.model.rig import Size

Corner = tuple[float, float, float]
Polygon = tuple[tuple[float, float], ...]

MOST_MASK_CHARACTERS = 2**18
"""Of a mask as text: a picture of two values and 12 megapixels has a tenth of that."""
_FURTHEST = 1e6  # mm and px: beyond it is a slip of units
_PNG = struct.Struct(">8s4x4sII")
_PNG_BEGINS = b"\x89PNG\r\n\x1a\n", b"IHDR"


@dataclass(frozen=True, slots=True)
class Region:
    """A part of the scene, and limits of what counts as measured. What is None or empty limits nothing.

    box_mm : the least and the greatest corner of a box in the world. depth_mm : the nearest and the furthest depth
    along each camera's optical axis. polygons_px : by camera, the corners (x, y) of the part of its image that counts.
    masks : by camera, the same as a PNG of the image's extent, in base64: what is not black counts. least_contrast :
    of white less black, as a share of full scale. most_sigma_mm : of a point's stated standard deviation.

    Raises
    ------
    ConfigError
        Something of it limits to nothing, or is no number, polygon or PNG.
    """

    box_mm: tuple[Corner, Corner] | None = None
    depth_mm: tuple[float, float] | None = None
    polygons_px: Mapping[str, Polygon] = field(default_factory=dict)
    masks: Mapping[str, str] = field(default_factory=dict)
    least_contrast: float | None = None
    most_sigma_mm: float | None = None

    def __post_init__(self) -> None:
        if self.box_mm is not None:
            for axis, least, most in zip("xyz", *self.box_mm, strict=True):
                _require_rising(f"region.box_mm: {axis}", least, most, "mm; the first corner is the least one")
        if self.depth_mm is not None:
            _require_rising("region.depth_mm", *self.depth_mm, "mm from the camera; the nearest comes first")
            if self.depth_mm[1] <= 0:
                message = f"region.depth_mm: expected depths before the camera, found {self.depth_mm[1]:g} mm"
                raise ConfigError(message)
        for camera, corners in self.polygons_px.items():
            numbers = [number for corner in corners for number in corner]
            if len(corners) < 3 or not all(-_FURTHEST < number < _FURTHEST for number in numbers):
                message = (
                    f"region.polygons_px.{camera}: expected three corners or more, [x, y] in pixels, found "
                    f"{len(corners)}; list them in order along the border"
                )
                raise ConfigError(message)
        for camera in self.masks:
            self.mask_size(camera)
        for name, value, most in (
            ("least_contrast", self.least_contrast, 1.0),
            ("most_sigma_mm", self.most_sigma_mm, math.inf),
        ):
            if value is not None and not 0 < value < most:
                below = " and below 1" if most == 1 else ""
                message = f"region.{name}: expected a number above 0{below}, found {value:g}; 0.05 is usual"
                raise ConfigError(message)

    @property
    def cameras(self) -> frozenset[str]:
        """The cameras that it names."""
        return frozenset((*self.polygons_px, *self.masks))

    def mask_png(self, camera: str) -> bytes:
        """The PNG of a camera's mask. Raises ConfigError: it is none."""
        text = self.masks[camera]
        try:
            data = base64.b64decode(text[: MOST_MASK_CHARACTERS + 1], validate=True)
            start, kind, _, _ = _PNG.unpack_from(data)
        except (binascii.Error, ValueError, struct.error):
            start, kind, data = b"", b"", b""
        if (start, kind) != _PNG_BEGINS or len(text) > MOST_MASK_CHARACTERS:
            message = (
                f"region.masks.{camera}: expected a PNG in base64 of at most {MOST_MASK_CHARACTERS} characters, found "
                f"{len(text)} of something else; save the mask as PNG, white where it counts"
            )
            raise ConfigError(message)
        return data

    def mask_size(self, camera: str) -> Size:
        """The extent that the PNG of a camera's mask states. Raises ConfigError: it is no PNG."""
        _, _, width, height = _PNG.unpack_from(self.mask_png(camera))
        try:
            return Size(width, height)
        except ValueError as cause:
            raise ConfigError(f"region.masks.{camera}: {cause}") from cause

    def require_fits(self, cameras: Mapping[str, Size]) -> None:
        """Raise ConfigError unless these are cameras with images as it says."""
        for name in sorted(self.cameras - set(cameras)):
            message = f"region: names camera '{name}'; there are {sorted(cameras)}. Write one of these."
            raise ConfigError(message)
        for name in self.masks:
            found, size = self.mask_size(name), cameras[name]
            if found != size:
                message = (
                    f"region.masks.{name}: expected {size} pixels as the camera has, found {found}; draw it on a frame "
                    "of that camera"
                )
                raise ConfigError(message)


def _require_rising(what: str, least: float, most: float, words: str) -> None:
    if not -_FURTHEST < least < most < _FURTHEST:
        message = f"{what}: expected two rising numbers, found {least:g} and {most:g} {words}"
        raise ConfigError(message)
