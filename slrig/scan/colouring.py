"""The colours of a scan's points: their albedo as sRGB, marks where it is in doubt, and what the report says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import AlbedoMark, Axis, LightMap, Mesh, Pinhole, Refusal, Source, linear_to_srgb
from slrig.reconstruction import (
    BRIGHT_ALBEDO,
    BRIGHT_PERCENT,
    Albedo,
    AlbedoSamples,
    Illumination,
    MergedCurves,
    SheetCurves,
    estimate_albedo,
)
from slrig.scan.stream import CameraResult

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
    points = AlbedoSamples(
        curves.points_mm, normals, curves.pixels_px, joined.camera, curves.source == Source.ALL, border
    )  # fmt: skip
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
