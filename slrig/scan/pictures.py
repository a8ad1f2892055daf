"""Pictures of a scan for people: the shaded mesh beside what the camera saw, and why pixels were refused.

Pictures are (H, W, 3) uint8, blue, green, red, as OpenCV has them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import StorageError
from slrig.kernels import in_bands, kernel
from slrig.meshing import rasterise, rasterise_normals, weighted_percentiles
from slrig.model import (
    AlbedoMark,
    Axis,
    FloatArray,
    LightMap,
    Mesh,
    Pinhole,
    Pixels,
    Refusal,
    Size,
    linear_to_srgb,
)
from slrig.reconstruction import (
    BRIGHT_ALBEDO,
    BRIGHT_PERCENT,
    Albedo,
    AlbedoSamples,
    Illumination,
    MergedCurves,
    SheetCurves,
    estimate_albedo,
    optical_depths_mm,
    project,
)
from slrig.scan.stream import CameraResult
from slrig.scan.thumbnail import BACKDROP, CAPTION_PX, GAP_PX

_AT_ONCE = 65_536  # vertices: what is float64 in between stays below 4 MB


def resampled(device: Pinhole, per_px: float, size: Size) -> Pinhole:
    """The device with `per_px` pixels in the place of one along each side, `size` in all; place and lens stay."""
    # Pixel centres are at integers in both, so that it is the corner of the picture, at -0.5, that stays.
    offset = (per_px - 1) / 2
    finer = np.array(((per_px, 0.0, offset), (0.0, per_px, offset), (0.0, 0.0, 1.0)))
    return replace(device, size=size, matrix=finer @ device.matrix)


def placed_vertices(vertices_mm: NDArray[np.floating[Any]], device: Pinhole) -> NDArray[np.float32]:
    """(V, 3) float32: column and row, pixels, and depth along the optical axis, mm, of world points, (V, 3).

    Points behind the device have NaN pixels and a depth that is not positive.
    """
    placed = np.zeros((len(vertices_mm), 3), dtype=np.float32)
    for start in range(0, len(vertices_mm), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        points = vertices_mm[part].astype(np.float64)
        placed[part, :2] = project(device, points)
        placed[part, 2] = optical_depths_mm(device, points)
    return placed


Picture = NDArray[np.uint8]

_SUPERSAMPLING = 2
_ROWS_AT_LEAST = 64  # in a band, a fifth of a millisecond
_COLOURS = np.array(((196, 209, 219), (92, 92, 176)), dtype=np.float64)  # of the front and of the back
_DARK, _HEADLIGHT, _SIDE_LIGHT = 0.12, 0.46, 0.44  # of the colour: everywhere, and from each light at most
_TO_VIEWER = np.array((0.0, 0.0, -1.0), dtype=np.float64)
_TO_SIDE_LIGHT = np.array((0.55, -0.65, -0.52), dtype=np.float64)  # above and on one side, in the camera's frame


def shaded(mesh: Mesh, camera: Pinhole) -> Picture:
    """The picture of `camera`, the second light on the side to which the surface leans."""
    wide, high = (extent * _SUPERSAMPLING for extent in (camera.size.width_px, camera.size.height_px))
    finer = resampled(camera, _SUPERSAMPLING, Size(wide, high))
    placed = placed_vertices(mesh.vertices_mm, finer)
    view = rasterise(placed, mesh.faces, finer.size)
    normals, front = rasterise_normals(view, placed, mesh.normals, mesh.faces)
    leaning = float(normals.sum(axis=0).sum(axis=0, dtype=np.float64) @ camera.rotation[0])
    to_side = _TO_SIDE_LIGHT * (math.copysign(1.0, leaning), 1.0, 1.0) / np.linalg.norm(_TO_SIDE_LIGHT)
    # Normals are in the world: rather than each of them, the lights are turned.
    lights = np.stack((_HEADLIGHT * _TO_VIEWER, _SIDE_LIGHT * to_side)) @ camera.rotation
    picture = np.full((*view.face.shape, 3), BACKDROP, dtype=np.uint8)
    in_bands(_lit, len(picture), view.face, normals, front, lights, _COLOURS, picture, rows_at_least=_ROWS_AT_LEAST)
    return np.asarray(resized(picture, camera.size), dtype=np.uint8)


def resized(picture: Pixels, size: Size) -> Pixels:
    """The picture, (H, W) or (H, W, 3), at another size; itself if it has that size."""
    if picture.shape[:2] == size.shape:
        return picture
    larger = size.width_px > picture.shape[1]
    how = cv2.INTER_NEAREST if larger else cv2.INTER_AREA
    return np.asarray(cv2.resize(picture, (size.width_px, size.height_px), interpolation=how))


@kernel
def _lit(first: int, last: int, face: Any, normals: Any, front: Any, lights: Any, colours: Any, picture: Any) -> None:
    """Fill the rows from first to last where a triangle is seen: of each light, (2, 3), what falls on the normal."""
    for row in range(first, last):
        for column in range(face.shape[1]):
            if face[row, column] < 0:
                continue
            light = _DARK
            for number in range(2):
                falling = 0.0
                for axis in range(3):
                    falling += lights[number, axis] * normals[row, column, axis]
                light += max(falling, 0.0)
            side = 0 if front[row, column] else 1
            for channel in range(3):
                picture[row, column, channel] = min(light * colours[side, channel], 255.0)


_PANEL_PX = 520
_PANEL_HEIGHT_PX = 640
_TURN_DEG = 35.0
_FILL = 0.86
_SHOWN_PERCENTS = (0.2, 99.8)
# Triangles that say where the object is: the share of its area beyond a border of the view is then known to 0.03 %,
# and the view stays within a quarter of a pixel of that of all triangles.
_SAMPLED = 20_000
_GOLDEN_RATIO = (math.sqrt(5) - 1) / 2

# A fifth smaller than OpenCV's own choice, in the same time.
_PNG = (cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_COMPRESSION, 1,
        cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT)  # fmt: skip

_PAGE = (43, 38, 36)
_INK = (235, 233, 230)

_LEGEND_PX = 330
_REJECTION_WIDTH_PX = 1600 - _LEGEND_PX
_LEGEND_ROW_PX = 30
_MEAN_PX = (15, 15)
_LEAST_LIMIT_PX = 0.05  # of the scale of differences: smaller ones are noise
_LEAST_ROWS = (len(Refusal) + 2) * _LEGEND_ROW_PX

# Colours, blue, green, red, after Okabe and Ito, "Color universal design": told apart by colour-blind readers too.
_CAUSES: Mapping[Refusal, tuple[tuple[int, int, int], str]] = {
    Refusal.NONE: ((200, 200, 200), "measured"),
    Refusal.NOT_LIT: ((30, 26, 24), "no light, or too little: in shadow, or too dark"),
    Refusal.SATURATED: ((66, 228, 240), "too bright: the camera is at its limit"),
    Refusal.AMBIGUOUS_BIT: ((0, 159, 230), "the code cannot be read: its light and dark frames differ too little"),
    Refusal.BEYOND_PROJECTOR: (
        (178, 114, 0),
        "the code names a place that the projector has not, or a line that its border cuts",
    ),
    Refusal.AMBIGUOUS_LINE: ((233, 180, 86), "on the boundary of two codes that mean different lines"),
    Refusal.STRAY_CODE: ((0, 94, 213), "the code differs from that of the rest of its stripe"),
    Refusal.SHORT_STRIPE: ((167, 121, 204), "the stripe is too short to be trusted"),
    Refusal.SHADOW_EDGE: ((115, 158, 0), "at the edge of a shadow, which displaces the stripe"),
    Refusal.DEPTH_EDGE: ((255, 0, 170), "depth edge: two surfaces in one pixel"),
    Refusal.OFF_PROJECTOR: ((60, 90, 140), "its ray meets the light where the projector has no pixel"),
    Refusal.BEHIND_DEVICE: ((150, 150, 0), "its ray meets the light behind the camera or the projector"),
    Refusal.NO_INTERSECTION: ((120, 40, 120), "its ray does not meet the light"),
    Refusal.SHEET_SEEN_ALONG: ((90, 90, 200), "its ray runs along the light, so there is no depth"),
    Refusal.OUTSIDE_REGION: ((86, 80, 77), "outside the region that the scan was asked for, or beyond its limits"),
    Refusal.MIRROR_IMAGE: ((80, 230, 150), "a mirror image: it faces only one of the devices that measured it"),
    Refusal.CONTRADICTED: (
        (60, 20, 220),
        "columns and rows contradict each other: a mirror image, or the object moved between them",
    ),
    Refusal.ONE_CAMERA_ONLY: (
        (220, 180, 200),
        "no partner in the other camera, or left out because the cameras contradict each other",
    ),
    Refusal.NO_SURFACE: ((60, 200, 150), "decoded, but outside the mesh: a hole, or a border that was cut"),
}


def preview(mesh: Mesh, camera: Pinhole, white: Pixels, full_scale: int, *, unit: str = "mm") -> Picture:
    """Three panels: the white image, the mesh as the same camera sees it, and the mesh turned by 35°.

    From where the camera stands errors along its rays do not show; from the side they do, the more so the more
    slanting the view is, so of the two sides that one is shown.
    Backs of triangles are red. A bar gives the scale at the middle of the object. At most 1600 pixels wide.

    Parameters
    ----------
    white : (H, W) of `camera`, the white frame; `full_scale` is the value of a saturated sample; unit : of lengths.
    """
    scale = min(_PANEL_PX / camera.size.width_px, _PANEL_HEIGHT_PX / camera.size.height_px)
    size = Size(max(1, round(camera.size.width_px * scale)), max(1, round(camera.size.height_px * scale)))
    seen, gain = _displayed(white, full_scale, size)
    at_panel = resampled(camera, scale, size)
    triangles = f"{len(mesh.faces):,} triangles"
    panels = [
        captioned(seen, "white image" + (f", brightened {gain:.1f} x" if gain > 1 else ""), str(camera.size) + " px"),
        captioned(shaded(mesh, at_panel), "mesh from the camera", triangles),
    ]
    if len(mesh.faces):
        sample = _sampled(mesh, camera)
        middle = np.array([sample.percentiles(ordinates, (50.0,)) for ordinates in sample.points_mm]).ravel()
        draw_scale(panels[1], size, at_panel.matrix[0, 0] / middle[2], unit=unit)
        aside = _turned_to_show(sample, middle, camera, size)
        panels.append(captioned(shaded(mesh, aside), f"turned by {_TURN_DEG:.0f} degrees", "backs are red"))
        draw_scale(panels[2], size, aside.matrix[0, 0] / middle[2], unit=unit)
    return side_by_side(panels)


def rejection_picture(refusals: NDArray[np.uint8], white: Pixels | None = None, full_scale: int = 255) -> Picture:
    """Every camera pixel coloured by why it gave no point, with a legend of causes, counts and shares.

    Parameters
    ----------
    refusals : (H, W) uint8, `Refusal`.
    white : (H, W) the white frame, shown where a pixel was not refused; `full_scale` its saturated value.
    """
    palette = np.zeros((max(Refusal) + 1, 3), dtype=np.uint8)
    for cause in Refusal:
        palette[cause] = _CAUSES[cause][0]
    picture = np.take(palette, refusals, axis=0)
    if white is not None:
        grey, _ = _displayed(white, full_scale, Size(white.shape[1], white.shape[0]))
        picture = np.asarray(cv2.copyTo(grey, (refusals == Refusal.NONE).view(np.uint8), picture), dtype=np.uint8)
    size = rejection_size(Size(refusals.shape[1], refusals.shape[0]))
    picture = resized(picture, size)
    height = max(size.height_px, _LEAST_ROWS)
    page = np.full((height, size.width_px + _LEGEND_PX, 3), _PAGE, dtype=np.uint8)
    page[: size.height_px, : size.width_px] = picture
    _draw_legend(page, size.width_px + 16, np.bincount(refusals.ravel(), minlength=max(Refusal) + 1))
    return page


def agreement_picture(
    residual_px: NDArray[np.float32], unit: str, white: Pixels | None = None, full_scale: int = 255
) -> Picture:
    """A spare measurement minus its prediction at each camera pixel, with a scale of colours.

    Each pixel shows the mean of 15 x 15, since code cells alone displace single pixels.

    residual_px : (H, W) float32, NaN where there is none; there the white frame is shown. unit : of the scale.
    """
    known = np.isfinite(residual_px)
    total, count = (cv2.boxFilter(each, -1, _MEAN_PX, normalize=False) for each in (
        np.nan_to_num(residual_px), known.astype(np.float32)
    ))  # fmt: skip
    mean = np.asarray(total / np.maximum(count, 1), dtype=np.float64)
    limit = max(float(np.percentile(np.abs(mean[known]), 98)), _LEAST_LIMIT_PX) if known.any() else 1.0
    share = np.clip(mean / limit, -1, 1)
    picture = _diverging(share)
    if white is not None:
        grey, _ = _displayed(white, full_scale, Size(white.shape[1], white.shape[0]))
        picture = np.where(known[..., None], picture, grey)
    size = rejection_size(Size(residual_px.shape[1], residual_px.shape[0]))
    height = max(size.height_px, _LEAST_ROWS)
    page = np.full((height, size.width_px + _LEGEND_PX, 3), _PAGE, dtype=np.uint8)
    page[: size.height_px, : size.width_px] = resized(np.asarray(picture, dtype=np.uint8), size)
    left, steps = size.width_px + 16, 9
    _text(page, f"measured - predicted, {unit}", (left, 24))
    for step in range(steps):
        value, row = 1 - 2 * step / (steps - 1), 24 + (step + 1) * _LEGEND_ROW_PX
        colour = _diverging(np.array([[value]]))[0, 0].tolist()
        cv2.rectangle(page, (left, row - 13), (left + 16, row + 3), colour, cv2.FILLED)
        _text(page, f"{value * limit:+.2f}", (left + 26, row))
    median = float(np.median(np.abs(mean[known]))) if known.any() else float("nan")
    _text(page, f"median {median:.3f} at {known.sum():,} pixels", (left, 24 + (steps + 2) * _LEGEND_ROW_PX))
    return page


def _diverging(share: FloatArray) -> Picture:
    """Colours of -1 (blue) over 0 (light grey) to 1 (red), (H, W, 3)."""
    middle, low, high = (np.array(each, dtype=np.float64) for each in ((225, 225, 225), (170, 80, 30), (30, 30, 190)))
    weight = np.abs(share)[..., None]
    end = np.where(share[..., None] < 0, low, high)
    return np.asarray(np.rint(middle + weight * (end - middle)), dtype=np.uint8)


def rejection_size(camera: Size) -> Size:
    """The part of `rejection_picture`, from the upper left corner, that holds the camera's pixels."""
    enlarged = max(1, min(math.ceil(_LEAST_ROWS / camera.height_px), _REJECTION_WIDTH_PX // camera.width_px))
    factor = min(float(enlarged), _REJECTION_WIDTH_PX / camera.width_px)
    return Size(max(1, round(camera.width_px * factor)), max(1, round(camera.height_px * factor)))


def described_causes() -> list[dict[str, str]]:
    """Each cause by name, in words, and in the colour it has in a picture, at the place that is its value in the maps.

    >>> described_causes()[Refusal.SATURATED]["colour"]
    '#f0e442'
    """
    described = [{"name": "", "words": "not in use", "colour": "#000000"} for _ in range(max(Refusal) + 1)]
    for cause, ((blue, green, red), words) in _CAUSES.items():
        described[cause] = {"name": cause.name.lower(), "words": words, "colour": f"#{red:02x}{green:02x}{blue:02x}"}
    return described


def encode_png(image: Picture) -> bytes:
    """A picture, (H, W, 3) or (H, W) uint8, as PNG. Raises StorageError: it has no such form."""
    done, data = cv2.imencode(".png", image, _PNG)
    if not done:
        message = f"could not encode a picture of shape {image.shape} {image.dtype}: it has no PNG form"
        raise StorageError(message)
    return data.tobytes()


def _displayed(white: Pixels, full_scale: int, size: Size) -> tuple[Picture, float]:
    """The white image as a picture of `size`, and how much it was brightened to be legible (1 if not at all)."""
    bright = float(np.percentile(white, 99.5)) / full_scale
    gain = min(max(1.0, 0.9 / max(bright, 1e-6)), 8.0) if bright < 0.6 else 1.0
    grey = resized(white, size) * np.float32(gain * 255.0 / full_scale)
    grey = np.clip(grey, 0, 255, out=grey).astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8), gain


class _Sample(NamedTuple):
    """Corners of triangles in a camera's frame, (3, n), and of each its share of the area and its normal's x, (n,)."""

    points_mm: FloatArray
    area_mm2: FloatArray
    leaning: FloatArray

    def percentiles(self, values: FloatArray, percents: tuple[float, ...]) -> list[float]:
        """The values, (n,), one for each corner, below which these percents of the area lie."""
        return weighted_percentiles(values, self.area_mm2, percents)


def _sampled(mesh: Mesh, camera: Pinhole) -> _Sample:
    """The corners of at most _SAMPLED triangles, one from each of as many runs of equal length.

    Where in its run, the golden ratio says: at a fixed stride, strips of triangles that are a multiple of it long would
    be sampled at the same few rows.
    """
    number = np.arange(min(len(mesh.faces), _SAMPLED))
    picked = (number + number * _GOLDEN_RATIO % 1.0) * (len(mesh.faces) / len(number))
    corners = mesh.faces[np.minimum(picked.astype(np.int64), len(mesh.faces) - 1)].T.ravel()
    points = camera.rotation @ mesh.vertices_mm[corners].T + camera.translation_mm[:, None]
    a, b, c = np.split(points, 3, axis=1)
    across = np.cross(b - a, c - a, axis=0)
    area_mm2 = np.sqrt((across**2).sum(axis=0)) / 6
    if not area_mm2.any():
        area_mm2[:] = 1.0  # triangles without an area have a place all the same
    leaning = camera.rotation[0] @ np.nan_to_num(mesh.normals[corners]).T
    return _Sample(points, np.tile(area_mm2, 3), leaning)


def _turned_to_show(sample: _Sample, middle_mm: FloatArray, camera: Pinhole, size: Size) -> Pinhole:
    """An ideal camera for a panel of `size`, turned about the middle of the object, which fills the panel.

    The object is where the area is: neither dense nor stray vertices move the view.
    """
    angle = math.copysign(math.radians(_TURN_DEG), -float(sample.leaning @ sample.area_mm2))
    turn = np.asarray(cv2.Rodrigues(np.array((0.0, angle, 0.0)))[0], dtype=np.float64)
    x, y, z = turn @ (sample.points_mm - middle_mm[:, None]) + middle_mm[:, None]
    z = np.maximum(z, 1e-9)
    ranges = np.array([sample.percentiles(rays, _SHOWN_PERCENTS) for rays in (x / z, y / z)])
    extent = np.maximum(ranges[:, 1] - ranges[:, 0], 1e-9)
    focal_px = _FILL * min(size.width_px / extent[0], size.height_px / extent[1])
    centre = (np.array(size.shape[::-1]) - 1) / 2 - ranges.mean(axis=1) * focal_px
    return Pinhole(
        size=size,
        matrix=np.array(((focal_px, 0.0, centre[0]), (0.0, focal_px, centre[1]), (0.0, 0.0, 1.0))),
        distortion=np.zeros(5),
        rotation=turn @ camera.rotation,
        translation_mm=turn @ (camera.translation_mm - middle_mm) + middle_mm,
    )


def captioned(panel: Picture, title: str, detail: str) -> Picture:
    """The panel with a line of text under it: what it shows on the left, a figure on the right."""
    rows, columns = panel.shape[:2]
    page = np.full((rows + CAPTION_PX, columns, 3), _PAGE, dtype=np.uint8)
    page[:rows] = panel
    _text(page, title, (4, rows + 23))
    _text(page, detail, (columns - _text_width(detail) - 4, rows + 23))
    return page


def draw_scale(panel: Picture, size: Size, px_per_mm: float, *, unit: str = "mm") -> None:
    """A bar of 1, 2 or 5 times a power of ten mm, about a fifth of the panel wide, in the lower left corner."""
    if not 0 < px_per_mm < math.inf:
        return  # the middle of the object lies behind the camera: no length is right
    aim_mm = size.width_px / 5 / px_per_mm
    power = 10.0 ** math.floor(math.log10(aim_mm))
    length_mm = max(step * power for step in (1, 2, 5) if step * power <= aim_mm * (1 + 1e-9))
    right, row = 16 + round(length_mm * px_per_mm), size.height_px - 16
    cv2.line(panel, (16, row), (right, row), _INK, 2)
    for end in (16, right):
        cv2.line(panel, (end, row - 5), (end, row + 5), _INK, 2)
    _text(panel, f"{length_mm:g} {unit}", (18, row - 10))


def _draw_legend(page: Picture, left: int, counts: NDArray[np.int64]) -> None:
    _text(page, "camera pixels", (left, 24))
    total = max(int(counts.sum()), 1)
    for line, cause in enumerate(Refusal, start=1):
        row = 24 + line * _LEGEND_ROW_PX
        name = "measured" if cause is Refusal.NONE else cause.name.lower().replace("_", " ")
        cv2.rectangle(page, (left, row - 13), (left + 16, row + 3), _CAUSES[cause][0], cv2.FILLED)
        cv2.rectangle(page, (left, row - 13), (left + 16, row + 3), _INK, 1)
        _text(page, name, (left + 26, row))
        for figure, right in ((f"{counts[cause]:,}", 248), (f"{counts[cause] / total:.1%}", 306)):
            _text(page, figure, (left + right - _text_width(figure), row))


def side_by_side(panels: list[Picture]) -> Picture:
    """One row of panels, with gaps beside and above them."""
    rows = max(panel.shape[0] for panel in panels)
    columns = sum(panel.shape[1] for panel in panels) + GAP_PX * (len(panels) + 1)
    page = np.full((rows + GAP_PX, columns, 3), _PAGE, dtype=np.uint8)
    left = GAP_PX
    for panel in panels:
        page[GAP_PX : GAP_PX + panel.shape[0], left : left + panel.shape[1]] = panel
        left += panel.shape[1] + GAP_PX
    return page


def _text(picture: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0])


_NEUTRAL = 128
_BORDER_PX = 2.0  # from the middle of the outermost: light falls there by a third, and beyond by less than a hundredth


@dataclass(frozen=True, slots=True)
class Coloured:
    """colour : (n, 3) uint8, sRGB; mark : (n,) uint8, `AlbedoMark`; found : what the colours come from."""

    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    found: Albedo


def coloured(
    cameras: Sequence[CameraResult],
    joined: MergedCurves,
    normals: NDArray[np.float32],
    projector: Pinhole | None,
    axis: Axis,
    /,
    light: LightMap | None = None,
) -> Coloured:
    """Colour each point by the camera that it counts as seen by. normals : (n, 3), unit, NaN where not known."""
    curves, nowhere = joined.curves, np.zeros(len(joined.camera), dtype=np.bool_)
    border = nowhere if projector is None else _at_border(curves, projector, axis)
    points = AlbedoSamples(curves.points_mm, normals, curves.pixels_px, joined.camera, joined.seen_by, border)
    views = [
        Illumination(seen.device, seen.contrast, seen.clipped, seen.curves.refusal == Refusal.NONE) for seen in cameras
    ]
    if projector is None:
        found = estimate_albedo(points, views, None)
    else:
        channels = max(view.contrast.shape[2] for view in views)
        shares = None if light is None else light.light(places_px(curves, axis), projector.size, channels)
        found = estimate_albedo(points, views, projector.centre_mm, light=shares)
    colour = linear_to_srgb(found.value)
    colour[found.mark == AlbedoMark.UNKNOWN] = _NEUTRAL
    return Coloured(np.repeat(colour, 3, axis=1) if colour.shape[1] == 1 else colour, found.mark, found)


def places_px(curves: SheetCurves, axis: Axis) -> NDArray[np.float64]:
    """(n, 2) float64: (column, row) of the projector's image that lights each point."""
    pair = np.repeat(curves.position_px, np.diff(curves.offsets)), curves.along_px
    return np.stack(pair if axis is Axis.COLUMN else pair[::-1], axis=1)


def _at_border(curves: SheetCurves, projector: Pinhole, axis: Axis) -> NDArray[np.bool_]:
    """(n,) bool: points in the projector's outermost pixels."""
    across, along = projector.size.along(axis), projector.size.along(axis.other)
    outermost = _within(curves.position_px, across)
    return np.asarray(np.repeat(outermost, np.diff(curves.offsets)) | _within(curves.along_px, along))


def _within(place_px: NDArray[np.float64], length_px: int) -> NDArray[np.bool_]:
    return np.asarray((place_px < _BORDER_PX) | (place_px > length_px - 1 - _BORDER_PX))


def albedo_report(
    coloured: Coloured, mesh: Mesh, cameras: Sequence[CameraResult], *, lit: bool, mapped: bool
) -> dict[str, object]:
    """The report's section on colours: what they are, their scale, and the vertices whose colour is in doubt, by cause.

    `camera_gains` are by which the first camera sees light larger, and how many points told so; 0: none did, and the
    cameras were brought to the same median. lit : whether the projector's place is known; mapped : its light over its
    image, too.
    """
    counts = np.bincount(mesh.mark, minlength=len(AlbedoMark))
    known = coloured.mark != AlbedoMark.UNKNOWN
    return {
        "channels": coloured.found.value.shape[1],
        "is": "albedo: (white - black) * distance^2 / cosine of incidence at the projector"
        if lit
        else "brightness: white - black, because the projector is not calibrated",
        "projector_light": "as measured on a white board"
        if mapped
        else "taken as even over its image; what is white in colour is not known",
        "scale": {"percentile": BRIGHT_PERCENT, "albedo": BRIGHT_ALBEDO},
        "brighter_than_white": round(float((coloured.found.value[known] > 1).any(axis=1).mean()), 4),
        "marked_vertices": {mark.name.lower(): int(counts[mark]) for mark in AlbedoMark if mark is not AlbedoMark.NONE},
        "camera_gains": {
            seen.name: {"gain": gain.round(4).tolist(), "points": shared}
            for seen, gain, shared in zip(cameras, coloured.found.gains, coloured.found.shared, strict=True)
        },
    }
