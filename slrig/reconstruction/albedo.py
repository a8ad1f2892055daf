"""Albedo of each point, from the frames of full light and of no light.

A dull surface of albedo ρ at distance d from the projector, lit at the angle i, gives

    white - black = g · L · ρ · cos(i) / d²

with the camera's gain g and the projector's light L in that direction (Lambert's law). Light of the room is in both
frames and cancels. Not modelled: gloss, light between parts of the object, and vignetting, of the camera always, of the
projector unless it is stated.

Albedo is relative, since g and L are not known. Cameras are brought to one gain by points that two of them see, and all
of them to a usual albedo of bright surfaces. The ratios of L and g between red, green and blue are unknown, too: white
surfaces have their tint, unless a white board was measured (`slrig.model.LightMap`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import AlbedoMark, FloatArray, Pinhole
from slrig.reconstruction.triangulation import project

MIN_COSINE = 0.2
"""Of the angle of incidence, for a reliable albedo: at 78° an error of one degree of the normal changes albedo by 9 %,
and more at larger angles.
"""

BRIGHT_PERCENT, BRIGHT_ALBEDO = 98.0, 0.8
"""Percentage of points without a mark below that albedo, which is that of white paint or paper. The few above may be
glossy.
"""

_MIN_SHARED = 100  # points for a ratio of gains: each has an error of a few per cent, their median of half a per cent
_MAX_SHARED = 20_000
_MAX_RANKED = 200_000  # values: their percentile is known to a thousandth of the points

_GRAZING = int(AlbedoMark.GRAZING)

Light = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Illumination:
    """Full light of the projector in the image of one camera, in C channels.

    contrast : (H, W, C) float32, white minus black, proportional to light; clipped : (H, W) bool, where white is
    saturated; decoded : (H, W) bool, where a surface was decoded.
    """

    device: Pinhole
    contrast: Light
    clipped: NDArray[np.bool_]
    decoded: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class AlbedoSamples:
    """Points and where their light was measured.

    points_mm : (n, 3) float64; normals : (n, 3), unit, NaN if unknown; camera : (n,) int32, camera of the point;
    pixels_px : (n, 2) float64, (column, row) in it; seen_by : (n,) int64, one bit for each camera that measured it;
    border : (n,) bool, True at the border of the projector's image.
    """

    points_mm: FloatArray
    normals: NDArray[np.floating[Any]]
    pixels_px: FloatArray
    camera: NDArray[np.int32]
    seen_by: NDArray[np.int64]
    border: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Albedo:
    """Relative albedo of points.

    value : (n, C) float32, NaN if unknown; mark : (n,) uint8, `AlbedoMark`. gains : (cameras, C) float64, contrast of
    the first camera over that of each; shared : number of common points for each gain, 0 if the cameras were brought to
    the same median instead.
    """

    value: Light
    mark: NDArray[np.uint8]
    gains: FloatArray
    shared: tuple[int, ...]


def estimate_albedo(
    points: AlbedoSamples,
    views: Sequence[Illumination],
    centre_mm: FloatArray | None,
    /,
    *,
    light: FloatArray | None = None,
) -> Albedo:
    """Relative albedo of points, with marks where it is not reliable.

    centre_mm : (3,) float64, centre of the projector. None if unknown: the value is then white minus black, and every
    point is marked. light : (n, C) or (n, 1) float64, relative light of the projector in the direction of each point;
    None if it is the same for all.
    """
    count = len(points.camera)
    channels = max(view.contrast.shape[2] for view in views)
    contrast, clipped = np.zeros((count, channels), dtype=np.float32), np.zeros(count, dtype=np.bool_)
    for index, view in enumerate(views):
        own = slice(None) if len(views) == 1 else points.camera == index
        contrast[own], clipped[own] = sample_contrast(view, points.pixels_px[own])
    irradiance = np.ones(count, dtype=np.float32)
    if centre_mm is None:
        mark = np.full(count, AlbedoMark.SHADED, dtype=np.uint8)
    else:
        mark = np.where(points.border, AlbedoMark.BORDER, AlbedoMark.NONE).astype(np.uint8)
        in_bands(_incidence_kernel, count, points.points_mm, points.normals, centre_mm, mark, irradiance)
    incident = (
        irradiance[:, None] if light is None or centre_mm is None else irradiance[:, None] * light.astype(np.float32)
    )
    mark[clipped] = AlbedoMark.SATURATED
    mark[np.isnan(irradiance)] = AlbedoMark.UNKNOWN
    reliable = (mark == AlbedoMark.NONE) | (mark == AlbedoMark.SHADED)
    value: Light = np.divide(contrast, incident, dtype=np.float32)
    gains, shared = _camera_gains(points, views, value, incident, reliable)
    if len(views) > 1:
        value *= gains.astype(np.float32)[points.camera]
    value *= _brightness_scale(value[reliable if reliable.any() else mark != AlbedoMark.UNKNOWN])
    return Albedo(value, mark, gains, shared)


def sample_contrast(view: Illumination, pixels_px: FloatArray) -> tuple[Light, NDArray[np.bool_]]:
    """(n, C) float32: contrast at positions (n, 2), (column, row), interpolated linearly, and beyond the border as on
    it; (n,) bool: True if a pixel in use is clipped.
    """
    contrast = np.zeros((len(pixels_px), view.contrast.shape[2]), dtype=np.float32)
    clipped = np.zeros(len(contrast), dtype=np.bool_)
    in_bands(_sample_kernel, len(contrast), view.contrast, view.clipped, pixels_px, contrast, clipped)
    return contrast, clipped


@kernel
def _sample_kernel(first: int, last: int, contrast: Any, clipped: Any, pixels: Any, out: Any, hit: Any) -> None:
    rows, columns, channels = contrast.shape
    for i in range(first, last):
        x, y = min(max(pixels[i, 0], 0.0), columns - 1.0), min(max(pixels[i, 1], 0.0), rows - 1.0)
        left, above = int(x), int(y)
        right, below = x - left, y - above
        for corner in range(4):
            to_right, to_below = corner & 1, corner >> 1
            share = (right if to_right else 1 - right) * (below if to_below else 1 - below)
            if share > 0:
                hit[i] |= clipped[above + to_below, left + to_right]
                for c in range(channels):
                    out[i, c] += np.float32(share) * contrast[above + to_below, left + to_right, c]


@kernel
def _incidence_kernel(
    first: int, last: int, points: Any, normals: Any, centre: Any, mark: Any, irradiance: Any
) -> None:
    for i in range(first, last):
        square = along = 0.0
        for k in range(3):
            towards = centre[k] - points[i, k]
            square += towards * towards
            along += towards * normals[i, k]
        cosine = along / np.sqrt(square)
        if cosine < MIN_COSINE:
            mark[i] = _GRAZING
            cosine = MIN_COSINE
        irradiance[i] = cosine / square


def _camera_gains(
    points: AlbedoSamples, views: Sequence[Illumination], value: Light, incident: Light, reliable: NDArray[np.bool_]
) -> tuple[FloatArray, tuple[int, ...]]:
    """`Albedo.gains` and `Albedo.shared`, each camera by those before it, from the one that most points are of.

    value : (n, C), before any gain; incident : (n, C) or (n, 1), light on each point; reliable : (n,).
    """
    gains = np.ones((len(views), value.shape[1]))
    shared = [0] * len(views)
    order = np.argsort(-np.bincount(points.camera, minlength=len(views)), kind="stable").tolist()
    for place, index in enumerate(order[1:], start=1):
        view = views[index]
        before, own = reliable & np.isin(points.camera, order[:place]), reliable & (points.camera == index)
        both = np.flatnonzero(before & ((points.seen_by >> index & 1) == 1))
        both = both[:: len(both) // _MAX_SHARED + 1]
        pixels = project(view.device, points.points_mm[both])
        visible = _is_visible(view, pixels)
        both, (other, _) = both[visible], sample_contrast(view, pixels[visible])
        if len(both) >= _MIN_SHARED:
            shared[index] = len(both)
            scaled_light = gains[points.camera[both]] * incident[both]
            gains[index] = np.median(value[both] * scaled_light / other, axis=0)
        elif before.any() and own.any():
            known = value[before] * gains[points.camera[before]]
            gains[index] = np.median(known, axis=0) / np.median(value[own], axis=0)
    # The first camera's is 1, and its points are those of the camera that the search began with.
    shared[order[0]] = shared[0]
    shared[0] = 0
    return gains / gains[0], tuple(shared)


def _is_visible(view: Illumination, pixels_px: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: True if the camera decoded a surface at its pixels (n, 2), and is not clipped there."""
    height, width = view.decoded.shape
    columns, rows = np.rint(np.nan_to_num(pixels_px, nan=-1.0)).astype(np.intp).T
    visible = np.asarray((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height))
    inside = rows[visible], columns[visible]
    visible[visible] = view.decoded[inside] & ~view.clipped[inside]
    return visible


def _brightness_scale(reliable: Light) -> np.float32:
    """Factor by which `BRIGHT_PERCENT` of reliable values, (m, C), are below `BRIGHT_ALBEDO` in their brightest
    channel.
    """
    sample = reliable[:: len(reliable) // _MAX_RANKED + 1]
    bright = float(np.percentile(sample.max(axis=1), BRIGHT_PERCENT)) if len(sample) else 0.0
    return np.float32(BRIGHT_ALBEDO / bright if bright > 0 else 1.0)
