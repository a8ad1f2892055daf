"""A scan that is limited to a region: the part of each camera's frames that is looked at, and the points that count.

The frames are cut to the rectangle in which anything that is asked for can be seen, before anything is computed of
them. In it the code says of each pixel whether its surface lies in the region, as near as a cell; points tell it to the
end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import ConfigError
from slrig.model import Axis, CameraFormat, FloatArray, Pinhole, Pixels, Refusal, Region, Shot, Size
from slrig.reconstruction import (
    CameraCurves,
    RegionMask,
    SheetCurves,
    optical_depths_mm,
    pixel_rays,
    project,
    select_points,
)

Sample = TypeVar("Sample", bound=np.generic)

_BESIDE_PX = 16
"""About what is asked for: on it the points at its border depend."""
_LEAST_PX = 320
"""Of a part's sides, if the camera has as many: the noise of the camera is told by its pixels."""
_STEPS = 17
"""Points on each edge of a box by which its outline is known: through a lens its edges bend by less between two."""
_CORNER_BITS = 4
"""Of a pixel, of a polygon's corners when it is drawn: sixteenths."""


@dataclass(frozen=True, slots=True)
class FramePart:
    """The rectangle of a camera's frames that is looked at, and what of it is asked for. whole : of the camera."""

    rows: slice
    columns: slice
    asked: RegionMask
    whole: CameraFormat

    @property
    def form(self) -> CameraFormat:
        """Extent and depth of the part."""
        size = Size(self.columns.stop - self.columns.start, self.rows.stop - self.rows.start)
        return CameraFormat(size, self.whole.bit_depth)

    def of(self, shot: Shot) -> Shot:
        """The part of a frame."""
        colour = None if shot.colour is None else shot.colour[self.rows, self.columns]
        return replace(shot, image=shot.image[self.rows, self.columns], colour=colour)

    def placed(self, part: NDArray[Sample], beyond: object = 0) -> NDArray[Sample]:
        """An array of the part, (h, w, …), in one of the whole frame; elsewhere it is `beyond`."""
        whole = np.full((*self.whole.size.shape, *part.shape[2:]), beyond, dtype=part.dtype)
        whole[self.rows, self.columns] = part
        return whole

    def curves(self, found: CameraCurves) -> CameraCurves:
        """The same curves in the pixels of the whole frame."""
        origin = np.array([self.columns.start, self.rows.start], dtype=np.float64)
        unresolved, lost = found.unresolved, found.unresolved_lines
        return replace(
            found,
            ensemble=found.ensemble._replace(points_px=found.ensemble.points_px + origin),
            refusal=self.placed(found.refusal, Refusal.OUTSIDE_REGION),
            unresolved=None if unresolved is None else self.placed(unresolved),
            unresolved_lines=None if lost is None else self.placed(lost, beyond=False),
        )


def frame_part(
    region: Region, name: str, form: CameraFormat, device: Pinhole, projector: Pinhole | None, axis: Axis
) -> FramePart:
    """What of a camera's frames is looked at for a region.

    Raises
    ------
    ConfigError
        The region names another extent than the camera's, or nothing of it is in the camera's image.
    """
    drawn = _drawn(region, name, form.size)
    outline = _outline(region, device, form.size)
    pixels = outline if drawn is None else outline & drawn
    if not pixels.any():
        message = (
            f"region: nothing of it is in the image of camera '{name}'. Coordinates of a box are those of the mesh, in "
            "mm: look at the mesh of a scan without a region."
        )
        raise ConfigError(message)
    rows, columns = (
        _about(np.asarray(pixels.any(axis=across)), extent)
        for across, extent in zip((1, 0), form.size.shape, strict=True)
    )
    exact = pixels[rows, columns]
    lowest = highest = None
    if region.box_mm is not None or region.depth_mm is not None:
        y, x = np.mgrid[rows, columns].astype(np.float64)
        directions = pixel_rays(device, np.stack([x.ravel(), y.ravel()], axis=1))
        near, far = _stretch(region, device, directions)
        exact &= (near < far).reshape(exact.shape)
        if projector is not None:
            ends = _light(near, far, directions, device, projector, axis)
            lowest, highest = (each.reshape(exact.shape) for each in ends)
    asked = RegionMask(exact, lowest, highest, region.min_contrast or 0.0)
    return FramePart(rows, columns, asked, form)


def limited(
    region: Region, curves: SheetCurves, refusal: NDArray[np.uint8], device: Pinhole
) -> tuple[SheetCurves, NDArray[np.uint8]]:
    """The points of a camera that the region holds, and its refusals, (H, W), with the others among them."""
    kept = within(region, curves.points_mm, curves.pixels_px, refusal, device)
    return select_points(curves, kept), marked(refusal, curves.pixels_px, kept)


def within(
    region: Region, points_mm: FloatArray, pixels_px: FloatArray, refusal: NDArray[np.uint8], device: Pinhole
) -> NDArray[np.bool_]:
    """(n,) bool: the points, (n, 3), that the region holds, seen by a camera at these pixels, (n, 2) of its image.

    refusal : (H, W) of that camera, with the pixels outside of the region.
    """
    columns, rows = np.rint(pixels_px).astype(np.intp).T
    kept = refusal[rows, columns] != Refusal.OUTSIDE_REGION
    if region.box_mm is not None:
        least, most = np.array(region.box_mm)
        kept &= ((points_mm >= least) & (points_mm <= most)).all(axis=1)
    if region.depth_mm is not None:
        depth = optical_depths_mm(device, points_mm)
        kept &= (depth >= region.depth_mm[0]) & (depth <= region.depth_mm[1])
    return np.asarray(kept)


def marked(refusal: NDArray[np.uint8], pixels_px: FloatArray, kept: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The refusals, with the pixels outside the region of which no point is kept."""
    if kept.all():
        return refusal
    columns, rows = np.rint(pixels_px).astype(np.intp).T
    out = refusal.copy()
    out[rows[~kept], columns[~kept]] = Refusal.OUTSIDE_REGION
    out[rows[kept], columns[kept]] = refusal[rows[kept], columns[kept]]
    return out


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
            first = np.clip(np.floor(pixels.min(axis=0)) - _BESIDE_PX, 0, last)
            last = np.clip(np.ceil(pixels.max(axis=0)) + 1 + _BESIDE_PX, 0, last)
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
    first, last = int(inside[0]) - _BESIDE_PX, int(inside[-1]) + 1 + _BESIDE_PX
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


def _light(
    near: FloatArray, far: FloatArray, directions: FloatArray, device: Pinhole, projector: Pinhole, axis: Axis
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n,) float32 each: between which the light's position is on each ray from `near` to `far`."""
    ends = []
    for depth in (near, far):
        # Behind the projector, or without an end, the ray goes anywhere.
        known = np.where(np.isfinite(depth), depth, np.nan)[:, np.newaxis]
        ends.append(project(projector, device.centre_mm + known * directions)[:, 0 if axis is Axis.COLUMN else 1])
    unknown = ~np.isfinite(ends[0] + ends[1])
    lowest = np.where(unknown, -np.inf, np.minimum(*ends)).astype(np.float32)
    return lowest, np.where(unknown, np.inf, np.maximum(*ends)).astype(np.float32)
