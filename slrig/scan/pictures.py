"""Pictures of a scan for people: the shaded mesh beside what the camera saw, and why pixels were refused.

Pictures are (H, W, 3) uint8, blue, green, red, as OpenCV has them.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import StorageError
from slrig.meshing.rasteriser import rasterised
from slrig.model import FloatArray, Mesh, Pinhole, Pixels, Refusal, Size

Picture = NDArray[np.uint8]

_PANEL_PX = 520
_PANEL_HEIGHT_PX = 640
_GAP_PX = 10
_CAPTION_PX = 34
_TURN_DEG = 35.0
_SUPERSAMPLING = 2
_FILL = 0.86

_PAGE = (43, 38, 36)
_BACKDROP = (74, 67, 63)
_INK = (235, 233, 230)
_CLAY = np.array((196, 209, 219), dtype=np.float64)
_BACK_OF_CLAY = np.array((92, 92, 176), dtype=np.float64)
_SIDE_LIGHT = np.array((0.55, -0.65, -0.52), dtype=np.float64)  # from above and one side, camera frame
_TO_VIEWER = np.array((0.0, 0.0, -1.0), dtype=np.float64)

_LEGEND_PX = 330
_REJECTION_WIDTH_PX = 1600 - _LEGEND_PX
_LEGEND_ROW_PX = 30

# After Okabe and Ito, "Color universal design": told apart by colour-blind readers too. Blue, green, red.
_COLOURS: dict[Refusal, tuple[int, int, int]] = {
    Refusal.NONE: (200, 200, 200),
    Refusal.NOT_LIT: (30, 26, 24),
    Refusal.SATURATED: (66, 228, 240),
    Refusal.AMBIGUOUS_BIT: (0, 159, 230),
    Refusal.BEYOND_PROJECTOR: (178, 114, 0),
    Refusal.AMBIGUOUS_LINE: (233, 180, 86),
    Refusal.STRAY_CODE: (0, 94, 213),
    Refusal.SHORT_STRIPE: (167, 121, 204),
    Refusal.SHADOW_EDGE: (115, 158, 0),
    Refusal.DEPTH_EDGE: (255, 0, 170),
    Refusal.OFF_PROJECTOR: (60, 90, 140),
    Refusal.BEHIND_DEVICE: (150, 150, 0),
    Refusal.NO_INTERSECTION: (120, 40, 120),
    Refusal.SHEET_SEEN_ALONG: (90, 90, 200),
}


def preview(mesh: Mesh, camera: Pinhole, white: Pixels, full_scale: int) -> Picture:
    """Three panels: the white image, the mesh as the same camera sees it, and the mesh turned by 35°.

    From where the camera stands errors along its rays do not show; from the side they do, the more so the more
    slanting the view is, so of the two sides that one is shown.
    Backs of triangles are red. A bar gives the scale at the middle of the object. At most 1600 pixels wide.

    Parameters
    ----------
    white : (H, W) of `camera`, the white frame; `full_scale` is the value of a saturated sample.
    """
    scale = min(_PANEL_PX / camera.size.width_px, _PANEL_HEIGHT_PX / camera.size.height_px)
    size = Size(max(1, round(camera.size.width_px * scale)), max(1, round(camera.size.height_px * scale)))
    seen, gain = _displayed(white, full_scale, size)
    points = _turned(camera.rotation, mesh.vertices_mm) + camera.translation_mm
    normals = _turned(camera.rotation, mesh.normals)
    triangles = f"{len(mesh.faces):,} triangles"
    as_seen = _shaded(_projected(mesh, camera, scale), points, normals, mesh, size)
    panels = [
        _captioned(seen, "white image" + (f", brightened {gain:.1f} x" if gain > 1 else ""), str(camera.size) + " px"),
        _captioned(as_seen, "mesh from the camera", triangles),
    ]
    if len(mesh.faces):
        area_mm2 = _vertex_areas_mm2(points, mesh)
        middle = _weighted_percentiles(points, area_mm2, (0.5,))[0]
        _draw_scale(panels[1], size, scale * camera.matrix[0, 0] / middle[2])
        leaning = float(np.nan_to_num(normals[:, 0]) @ area_mm2)
        turn = cv2.Rodrigues(np.array((0.0, math.copysign(math.radians(_TURN_DEG), -leaning), 0.0)))[0]
        turned = _turned(turn, points - middle) + middle
        pixels, px_per_mm = _fitted(turned, area_mm2, size)
        panels.append(
            _captioned(
                _shaded(pixels, turned, _turned(turn, normals), mesh, size),
                f"turned by {_TURN_DEG:.0f} degrees",
                "backs are red",
            )
        )
        _draw_scale(panels[2], size, px_per_mm)
    return _side_by_side(panels)


def rejection_picture(refusals: NDArray[np.uint8], white: Pixels | None = None, full_scale: int = 255) -> Picture:
    """Every camera pixel coloured by why it gave no point, with a legend of causes, counts and shares.

    Parameters
    ----------
    refusals : (H, W) uint8, `Refusal`.
    white : (H, W) the white frame, shown where a pixel was not refused; `full_scale` its saturated value.
    """
    palette = np.array([_COLOURS[cause] for cause in Refusal], dtype=np.uint8)
    picture = palette[refusals]
    if white is not None:
        bright, _ = _displayed(white, full_scale, Size(white.shape[1], white.shape[0]))
        picture = np.where((refusals == Refusal.NONE)[..., None], bright, picture)
    rows, columns = refusals.shape
    least_rows = (len(Refusal) + 2) * _LEGEND_ROW_PX
    enlarged = max(1, min(math.ceil(least_rows / rows), _REJECTION_WIDTH_PX // columns))
    factor = min(float(enlarged), _REJECTION_WIDTH_PX / columns)
    size = Size(max(1, round(columns * factor)), max(1, round(rows * factor)))
    picture = _resized(picture, size)
    height = max(size.height_px, least_rows)
    page = np.full((height, size.width_px + _LEGEND_PX, 3), _PAGE, dtype=np.uint8)
    page[: size.height_px, : size.width_px] = picture
    _draw_legend(page, size.width_px + 16, np.bincount(refusals.ravel(), minlength=len(Refusal)))
    return page


def encode_png(image: Picture) -> bytes:
    """A picture, (H, W, 3) or (H, W) uint8, as PNG. Raises StorageError: it has no such form."""
    done, data = cv2.imencode(".png", image)
    if not done:
        message = f"could not encode a picture of shape {image.shape} {image.dtype}: it has no PNG form"
        raise StorageError(message)
    return data.tobytes()


def _displayed(white: Pixels, full_scale: int, size: Size) -> tuple[Picture, float]:
    """The white image as a picture of `size`, and how much it was brightened to be legible (1 if not at all)."""
    bright = float(np.percentile(white, 99.5)) / full_scale
    gain = min(max(1.0, 0.9 / max(bright, 1e-6)), 8.0) if bright < 0.6 else 1.0
    grey = np.clip(white * (gain * 255.0 / full_scale), 0, 255).astype(np.uint8)
    return _resized(np.repeat(grey[..., None], 3, axis=2), size), gain


def _resized(picture: Picture, size: Size) -> Picture:
    larger = size.width_px > picture.shape[1]
    how = cv2.INTER_NEAREST if larger else cv2.INTER_AREA
    return np.asarray(cv2.resize(picture, (size.width_px, size.height_px), interpolation=how), dtype=np.uint8)


def _projected(mesh: Mesh, camera: Pinhole, scale: float) -> FloatArray:
    """(V, 2) float64: where the vertices fall in the camera's image shrunk by `scale`, with lens distortion."""
    if not len(mesh.vertices_mm):
        return np.zeros((0, 2))
    rotation = cv2.Rodrigues(camera.rotation)[0]
    points = mesh.vertices_mm.astype(np.float64)
    pixels, _ = cv2.projectPoints(points, rotation, camera.translation_mm, camera.matrix, camera.distortion)
    return np.asarray((pixels.reshape(-1, 2) + 0.5) * scale - 0.5)  # pixel centres are at integers in both


def _turned(rotation: FloatArray, vectors: NDArray[np.floating[Any]]) -> FloatArray:
    """(n, 3) float64: the rotation applied to each row."""
    return np.ascontiguousarray((rotation @ vectors.T.astype(np.float64)).T)


def _vertex_areas_mm2(points_mm: FloatArray, mesh: Mesh) -> FloatArray:
    """(V,) float64: a third of the area of the triangles at each vertex."""
    a, b, c = (points_mm[mesh.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    thirds = np.sqrt(np.einsum("ij,ij->i", normals, normals)) / 6
    return np.bincount(mesh.faces.ravel(), np.repeat(thirds, 3), minlength=len(points_mm)).astype(np.float64)


def _weighted_percentiles(values: FloatArray, weights: FloatArray, shares: tuple[float, ...]) -> FloatArray:
    """(len(shares), k): the values, (n, k), below which these shares of the weight lie, column by column."""
    found = np.zeros((len(shares), values.shape[1]))
    for column, ordinates in enumerate(values.T):
        order = np.argsort(ordinates)
        cumulated = np.cumsum(weights[order])
        at = np.searchsorted(cumulated, np.asarray(shares) * cumulated[-1])
        found[:, column] = ordinates[order][np.minimum(at, len(order) - 1)]
    return found


def _fitted(points_mm: FloatArray, area_mm2: FloatArray, size: Size) -> tuple[FloatArray, float]:
    """Pixels of an ideal camera that has the object fill the panel, (V, 2), and pixels per mm at its middle.

    The object is where the area is: neither dense nor stray vertices move the view.
    """
    rays = points_mm[:, :2] / np.maximum(points_mm[:, 2:], 1e-9)
    low, high = _weighted_percentiles(rays, area_mm2, (0.002, 0.998))
    extent = np.maximum(high - low, 1e-9)
    focal_px = _FILL * min(size.width_px / extent[0], size.height_px / extent[1])
    centre = (np.array((size.width_px, size.height_px)) - 1) / 2
    depth_mm = _weighted_percentiles(points_mm[:, 2:], area_mm2, (0.5,)).item()
    return (rays - (low + high) / 2) * focal_px + centre, float(focal_px / depth_mm)


def _shaded(pixels: FloatArray, points_mm: FloatArray, normals: FloatArray, mesh: Mesh, size: Size) -> Picture:
    """The mesh under a headlight and a light from above, on the side to which the surface leans.

    Points and normals are in the camera's frame.
    """
    finer = Size(size.width_px * _SUPERSAMPLING, size.height_px * _SUPERSAMPLING)
    fine_pixels = (pixels + 0.5) * _SUPERSAMPLING - 0.5
    view = rasterised(fine_pixels, points_mm[:, 2], normals, mesh.faces, finer)
    seen = np.isfinite(view.depth_mm)
    front = view.front[seen][:, None]
    upright = np.where(front, view.normals[seen], -view.normals[seen])
    headlight = np.clip(upright @ _TO_VIEWER, 0, 1)
    side_light = _SIDE_LIGHT * (math.copysign(1.0, float(upright[:, 0].sum())), 1.0, 1.0)
    side = np.clip(upright @ (side_light / np.linalg.norm(side_light)), 0, 1)
    light = 0.12 + 0.46 * headlight + 0.44 * side
    picture = np.full((*finer.shape, 3), _BACKDROP, dtype=np.uint8)
    picture[seen] = np.clip(np.where(front, _CLAY, _BACK_OF_CLAY) * light[:, None], 0, 255)
    return _resized(picture, size)


def _captioned(panel: Picture, title: str, detail: str) -> Picture:
    """The panel with a line of text under it: what it shows on the left, a figure on the right."""
    rows, columns = panel.shape[:2]
    page = np.full((rows + _CAPTION_PX, columns, 3), _PAGE, dtype=np.uint8)
    page[:rows] = panel
    _text(page, title, (4, rows + 23))
    _text(page, detail, (columns - _text_width(detail) - 4, rows + 23))
    return page


def _draw_scale(panel: Picture, size: Size, px_per_mm: float) -> None:
    """A bar of 1, 2 or 5 times a power of ten mm, about a fifth of the panel wide, in the lower left corner."""
    aim_mm = size.width_px / 5 / px_per_mm
    power = 10.0 ** math.floor(math.log10(aim_mm))
    length_mm = max(step * power for step in (1, 2, 5) if step * power <= aim_mm * (1 + 1e-9))
    right, row = 16 + round(length_mm * px_per_mm), size.height_px - 16
    cv2.line(panel, (16, row), (right, row), _INK, 2)
    for end in (16, right):
        cv2.line(panel, (end, row - 5), (end, row + 5), _INK, 2)
    _text(panel, f"{length_mm:g} mm", (18, row - 10))


def _draw_legend(page: Picture, left: int, counts: NDArray[np.int64]) -> None:
    _text(page, "camera pixels", (left, 24))
    total = max(int(counts.sum()), 1)
    for line, cause in enumerate(Refusal, start=1):
        row = 24 + line * _LEGEND_ROW_PX
        name = "measured" if cause is Refusal.NONE else cause.name.lower().replace("_", " ")
        cv2.rectangle(page, (left, row - 13), (left + 16, row + 3), _COLOURS[cause], cv2.FILLED)
        cv2.rectangle(page, (left, row - 13), (left + 16, row + 3), _INK, 1)
        _text(page, name, (left + 26, row))
        for figure, right in ((f"{counts[cause]:,}", 248), (f"{counts[cause] / total:.1%}", 306)):
            _text(page, figure, (left + right - _text_width(figure), row))


def _side_by_side(panels: list[Picture]) -> Picture:
    rows = max(panel.shape[0] for panel in panels)
    columns = sum(panel.shape[1] for panel in panels) + _GAP_PX * (len(panels) + 1)
    page = np.full((rows + _GAP_PX, columns, 3), _PAGE, dtype=np.uint8)
    left = _GAP_PX
    for panel in panels:
        page[_GAP_PX : _GAP_PX + panel.shape[0], left : left + panel.shape[1]] = panel
        left += panel.shape[1] + _GAP_PX
    return page


def _text(picture: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0])
