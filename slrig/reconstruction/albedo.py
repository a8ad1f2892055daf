"""Albedo of each point, from the frames of full light and of no light.

A dull surface of albedo ρ at distance d from the projector, on which the light falls at the angle i, shows

    white - black = g · L · ρ · cos(i) / d²

with the camera's gain g and the projector's light L in that direction (Lambert's law). Light of the room is in both
frames and cancels. What this leaves out: gloss, light from one part of the object to another, and what lenses take
from the corners: the camera's always, the projector's where nobody states it.

Albedo has no scale of its own here: g and L are not known. Cameras are brought to one gain by the points that two of
them saw, and the whole to a usual albedo of bright surfaces. Nor is it known how L and g differ between red, green and
blue: what is white has their tint, unless a white board has told (`slrig.model.LightMap`).
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

LEAST_COSINE = 0.2
"""Of the angle at which light falls, up to which albedo is relied on: at 78° one degree that a normal is off makes 9 %
of albedo, and the share grows as the tangent."""

BRIGHT_PERCENT, BRIGHT_ALBEDO = 98.0, 0.8
"""Of the points without a mark so many per cent lie below that albedo, which is that of white paint or paper. The few
above it may shine."""

_LEAST_SHARED = 100  # points, for a ratio of gains: each knows it to a few per cent, the median of so many to a half
_MOST_SHARED = 20_000
_MOST_RANKED = 200_000  # values: their percentile is known to a thousandth of the points

_GRAZING = int(AlbedoMark.GRAZING)

Light = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LitView:
    """What one camera saw of the projector's full light, in C channels.

    contrast : (H, W, C) float32, white minus black, proportional to light; clipped : (H, W) bool, where white is no
    measure of light; decoded : (H, W) bool, where it saw a surface in that light.
    """

    device: Pinhole
    contrast: Light
    clipped: NDArray[np.bool_]
    decoded: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LitPoints:
    """Points, and how they were seen.

    points_mm : (n, 3) float64; normals : (n, 3), unit, NaN where not known; camera : (n,) int32, that the point counts
    as seen by; pixels_px : (n, 2) float64, (column, row) in it; shared : (n,) bool, another camera saw it as well;
    border : (n,) bool, at the border of the projector's image.
    """

    points_mm: FloatArray
    normals: NDArray[np.floating[Any]]
    pixels_px: FloatArray
    camera: NDArray[np.int32]
    shared: NDArray[np.bool_]
    border: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Albedo:
    """value : (n, C) float32, relative albedo, NaN where it is not known; mark : (n,) uint8, `AlbedoMark`.

    gains : (cameras, C) float64, by which the first camera's contrast is larger; shared : how many points told each, 0
    where none did and the cameras were brought to the same median.
    """

    value: Light
    mark: NDArray[np.uint8]
    gains: FloatArray
    shared: tuple[int, ...]


def albedo(
    points: LitPoints, views: Sequence[LitView], centre_mm: FloatArray | None, /, *, light: FloatArray | None = None
) -> Albedo:
    """The relative albedo of points, and marks where it is not to be relied on.

    centre_mm : (3,) float64, the projector's centre. None where it is not known: then the value is white minus black
    alone, and every point is marked. light : (n, C) or (n, 1) float64, the projector's in the direction of each
    point, as a share of any one; None where it is the same in all.
    """
    count = len(points.camera)
    channels = max(view.contrast.shape[2] for view in views)
    seen, clipped = np.zeros((count, channels), dtype=np.float32), np.zeros(count, dtype=np.bool_)
    for index, view in enumerate(views):
        mine = slice(None) if len(views) == 1 else points.camera == index
        seen[mine], clipped[mine] = sampled(view, points.pixels_px[mine])
    fallen = np.ones(count, dtype=np.float32)
    if centre_mm is None:
        mark = np.full(count, AlbedoMark.SHADED, dtype=np.uint8)
    else:
        mark = np.where(points.border, AlbedoMark.BORDER, AlbedoMark.NONE).astype(np.uint8)
        in_bands(_incidence_kernel, count, points.points_mm, points.normals, centre_mm, mark, fallen)
    fell = fallen[:, None] if light is None or centre_mm is None else fallen[:, None] * light.astype(np.float32)
    mark[clipped] = AlbedoMark.SATURATED
    mark[np.isnan(fallen)] = AlbedoMark.UNKNOWN
    sound = (mark == AlbedoMark.NONE) | (mark == AlbedoMark.SHADED)
    value: Light = np.divide(seen, fell, dtype=np.float32)
    gains, shared = _gains(points, views, value, fell, sound)
    if len(views) > 1:
        value *= gains.astype(np.float32)[points.camera]
    value *= _scale(value[sound if sound.any() else mark != AlbedoMark.UNKNOWN])
    return Albedo(value, mark, gains, shared)


def sampled(view: LitView, pixels_px: FloatArray) -> tuple[Light, NDArray[np.bool_]]:
    """(n, C) float32: the contrast at places (n, 2), (column, row), between pixels in proportion, and beyond the border
    as on it; (n,) bool: whether a pixel that takes part is clipped.
    """
    seen = np.zeros((len(pixels_px), view.contrast.shape[2]), dtype=np.float32)
    clipped = np.zeros(len(seen), dtype=np.bool_)
    in_bands(_sample_kernel, len(seen), view.contrast, view.clipped, pixels_px, seen, clipped)
    return seen, clipped


@kernel
def _sample_kernel(first: int, last: int, contrast: Any, clipped: Any, pixels: Any, seen: Any, hit: Any) -> None:
    rows, columns, channels = contrast.shape
    for i in range(first, last):
        x, y = min(max(pixels[i, 0], 0.0), columns - 1.0), min(max(pixels[i, 1], 0.0), rows - 1.0)
        left, above = int(x), int(y)
        right, below = x - left, y - above
        for corner in range(4):
            aside, under = corner & 1, corner >> 1
            share = (right if aside else 1 - right) * (below if under else 1 - below)
            if share > 0:
                hit[i] |= clipped[above + under, left + aside]
                for c in range(channels):
                    seen[i, c] += np.float32(share) * contrast[above + under, left + aside, c]


@kernel
def _incidence_kernel(first: int, last: int, points: Any, normals: Any, centre: Any, mark: Any, fallen: Any) -> None:
    for i in range(first, last):
        square = along = 0.0
        for k in range(3):
            towards = centre[k] - points[i, k]
            square += towards * towards
            along += towards * normals[i, k]
        cosine = along / np.sqrt(square)
        if cosine < LEAST_COSINE:
            mark[i] = _GRAZING
            cosine = LEAST_COSINE
        fallen[i] = cosine / square


def _gains(
    points: LitPoints, views: Sequence[LitView], value: Light, fell: Light, sound: NDArray[np.bool_]
) -> tuple[FloatArray, tuple[int, ...]]:
    """`Albedo.gains` and `Albedo.shared`: of each camera by those before it.

    value : (n, C), before any gain; fell : (n, C) or (n, 1), the light that fell on each point; sound : (n,), to
    be relied on.
    """
    gains = np.ones((len(views), value.shape[1]))
    shared = [0] * len(views)
    for index, view in enumerate(views[1:], start=1):
        before, mine = sound & (points.camera < index), sound & (points.camera == index)
        both = np.flatnonzero(before & points.shared)
        both = both[:: len(both) // _MOST_SHARED + 1]
        pixels = project(view.device, points.points_mm[both])
        there = _sees(view, pixels)
        both, (other, _) = both[there], sampled(view, pixels[there])
        if len(both) >= _LEAST_SHARED:
            shared[index] = len(both)
            there_gains = gains[points.camera[both]] * fell[both]
            gains[index] = np.median(value[both] * there_gains / other, axis=0)
        elif before.any() and mine.any():
            known = value[before] * gains[points.camera[before]]
            gains[index] = np.median(known, axis=0) / np.median(value[mine], axis=0)
    return gains, tuple(shared)


def _sees(view: LitView, pixels_px: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: whether the camera saw a surface at its pixels (n, 2), and is not clipped there."""
    height, width = view.decoded.shape
    columns, rows = np.rint(np.nan_to_num(pixels_px, nan=-1.0)).astype(np.intp).T
    sees = np.asarray((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height))
    inside = rows[sees], columns[sees]
    sees[sees] = view.decoded[inside] & ~view.clipped[inside]
    return sees


def _scale(sound: Light) -> np.float32:
    """By which `BRIGHT_PERCENT` of sound values, (m, C), lie below `BRIGHT_ALBEDO` in their brightest channel."""
    some = sound[:: len(sound) // _MOST_RANKED + 1]
    bright = float(np.percentile(some.max(axis=1), BRIGHT_PERCENT)) if len(some) else 0.0
    return np.float32(BRIGHT_ALBEDO / bright if bright > 0 else 1.0)
