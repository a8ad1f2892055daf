"""The part of a camera's image in which a scan region can be seen, and how far away it is there."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import ConfigError
from slrig.model import FloatArray, Pinhole, Pixels, Region, Size
from slrig.reconstruction.triangulation import pixel_rays, project

_MARGIN_PX = 16
"""Around the region: points at its border depend on it."""
_LEAST_PX = 320
"""Of the sides of a part, if the camera has as many: its pixels show the noise of the camera."""
_STEPS = 17
"""Points on each edge of a box by which its outline is known: through a lens its edges bend by less between two."""
_CORNER_BITS = 4
"""Of a pixel, of a polygon's corners when it is drawn: sixteenths."""


class ImagePart(NamedTuple):
    """A rectangle of a camera's image. mask : (h, w) bool, its pixels whose rays meet the region. depths_mm : (h, w)
    float64 each, the nearest and the furthest depth of the region on each ray; None where it limits none.
    """

    rows: slice
    columns: slice
    mask: NDArray[np.bool_]
    depths_mm: tuple[FloatArray, FloatArray] | None

    def rays(self, device: Pinhole) -> FloatArray:
        """The rays of its pixels, row by row, as `pixel_rays` gives them."""
        return _rays(self.rows, self.columns, device)


def part_of_region(region: Region, name: str, size: Size, device: Pinhole) -> ImagePart:
    """Find where a camera sees a region.

    Raises
    ------
    ConfigError
        The region names another extent than the camera's, or nothing of it is in the camera's image.
    """
    drawn = _drawn(region, name, size)
    outline = _outline(region, device, size)
    pixels = outline if drawn is None else outline & drawn
    if not pixels.any():
        message = (
            f"region: nothing of it is in the image of camera '{name}'. Coordinates of a box are those of the mesh, in "
            "mm: look at the mesh of a scan without a region."
        )
        raise ConfigError(message)
    rows, columns = (
        _about(np.asarray(pixels.any(axis=across)), extent) for across, extent in zip((1, 0), size.shape, strict=True)
    )
    exact = pixels[rows, columns]
    if region.box_mm is None and region.depth_mm is None:
        return ImagePart(rows, columns, exact, None)
    near, far = (each.reshape(exact.shape) for each in _stretch(region, device, _rays(rows, columns, device)))
    return ImagePart(rows, columns, exact & (near < far), (near, far))


def _rays(rows: slice, columns: slice, device: Pinhole) -> FloatArray:
    y, x = np.mgrid[rows, columns].astype(np.float64)
    return pixel_rays(device, np.stack([x.ravel(), y.ravel()], axis=1))


def _drawn(region: Region, name: str, size: Size) -> NDArray[np.bool_] | None:
    """(H, W) bool: where polygon and mask let a camera look; None where there are none."""
    drawn = np.full(size.shape, 255, dtype=np.uint8)
    if name in region.masks:
        mask = cv2.imdecode(np.frombuffer(region.mask_png(name), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
        if mask is None or mask.shape != size.shape:
            message = f"region.masks.{name}: the PNG cannot be read; save it again"
            raise ConfigError(message)
        drawn = np.asarray(mask, dtype=np.uint8)
    if name in region.polygons_px:
        corners = np.rint(np.array(region.polygons_px[name]) * 2**_CORNER_BITS).astype(np.int32)
        inside: Pixels = np.zeros(size.shape, dtype=np.uint8)
        cv2.fillPoly(inside, [corners], 255, shift=_CORNER_BITS)
        drawn = np.minimum(drawn, inside)
    return None if name not in region.cameras else drawn > 0


def _outline(region: Region, device: Pinhole, size: Size) -> NDArray[np.bool_]:
    """(H, W) bool: a rectangle that holds the image of the region's box; all of the image where no box says less."""
    seen = np.zeros(size.shape, dtype=np.bool_)
    first, last = np.zeros(2), np.array([size.width_px, size.height_px], dtype=np.float64)
    if region.box_mm is not None:
        pixels = project(device, _edges(region.box_mm))
        if np.isfinite(pixels).all():  # a box that reaches behind the camera has no outline
            first = np.clip(np.floor(pixels.min(axis=0)) - _MARGIN_PX, 0, last)
            last = np.clip(np.ceil(pixels.max(axis=0)) + 1 + _MARGIN_PX, 0, last)
    (left, top), (right, bottom) = first.astype(int), last.astype(int)
    seen[top:bottom, left:right] = True
    return seen


def _edges(box_mm: tuple[tuple[float, float, float], tuple[float, float, float]]) -> FloatArray:
    """(n, 3) float64: points on the edges of a box, mm."""
    along = np.linspace(0, 1, _STEPS)
    least, most = np.array(box_mm)
    shares = [
        np.insert(np.array(corner, dtype=np.float64), axis, share)
        for axis in range(3)
        for corner in product((0, 1), repeat=2)
        for share in along
    ]
    return np.asarray(least + np.array(shares) * (most - least))


def _about(seen: NDArray[np.bool_], extent: int) -> slice:
    """From the first that is seen to the last, with room beside them, and not fewer than the noise needs."""
    inside = np.flatnonzero(seen)
    first, last = int(inside[0]) - _MARGIN_PX, int(inside[-1]) + 1 + _MARGIN_PX
    more = max(_LEAST_PX - (last - first), 0)
    first = max(min(first - more // 2, extent - _LEAST_PX), 0)
    return slice(first, min(max(last + more - more // 2, first + _LEAST_PX), extent))


def _stretch(region: Region, device: Pinhole, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) float64 each: the nearest and the furthest depth of each ray in the region, mm; the nearest is not the
    smaller one where the ray does not meet it. directions : (n, 3) float64, as `rays` gives them.
    """
    near, far = region.depth_mm or (0.0, np.inf)
    nearest, furthest = np.full(len(directions), max(near, 0.0)), np.full(len(directions), far)
    if region.box_mm is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = (np.array(region.box_mm)[:, np.newaxis] - device.centre_mm) / directions
        # Where a ray runs along a side and lies on it, 0/0 says nothing of it.
        nearest = np.fmax(nearest, np.fmin(*ends).max(axis=1))
        furthest = np.fmin(furthest, np.fmax(*ends).min(axis=1))
    return nearest, furthest
