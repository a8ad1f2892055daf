"""The colours of a scan's points: their albedo as sRGB, marks where it is in doubt, and what the report says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import AlbedoMark, Axis, Mesh, Pinhole, Refusal, Source
from slrig.model.srgb import srgb_of
from slrig.reconstruction.albedo import BRIGHT_ALBEDO, BRIGHT_PERCENT, Albedo, LitPoints, LitView, albedo
from slrig.reconstruction.frames import NEARLY_FULL
from slrig.reconstruction.merging import MergedCurves
from slrig.reconstruction.sheet_curves import SheetCurves
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
) -> Coloured:
    """Colour each point by the camera that it counts as seen by. normals : (n, 3), unit, NaN where not known."""
    curves, nowhere = joined.curves, np.zeros(len(joined.camera), dtype=np.bool_)
    border = nowhere if projector is None else _at_border(curves, projector, axis)
    points = LitPoints(
        curves.points_mm, normals, curves.pixels_px, joined.camera, curves.source == Source.ALL, border
    )  # fmt: skip
    found = albedo(points, [_lit(seen) for seen in cameras], None if projector is None else projector.centre_mm)
    colour = srgb_of(found.value)
    colour[found.mark == AlbedoMark.UNKNOWN] = _NEUTRAL
    return Coloured(np.repeat(colour, 3, axis=1) if colour.shape[1] == 1 else colour, found.mark, found)


def _lit(seen: CameraResult) -> LitView:
    """What a camera saw of the light: in red, green and blue where it has them, in one channel else."""
    contrast, clipped = seen.contrast[..., None], seen.clipped
    if seen.white_colour is not None and seen.black_colour is not None:
        full = np.float32(seen.full_scale)
        # A bracket's values are light already, and go beyond full scale.
        if not seen.exposures:
            clipped = clipped | (seen.white_colour.max(axis=2) >= NEARLY_FULL * full)
        white, black = (image[..., ::-1].astype(np.float32) for image in (seen.white_colour, seen.black_colour))
        if seen.curves.gamma != 1:
            white, black = (full * (image / full) ** np.float32(seen.curves.gamma) for image in (white, black))
        contrast = white - black
    return LitView(seen.device, contrast, clipped, seen.curves.refusal == Refusal.NONE)


def _at_border(curves: SheetCurves, projector: Pinhole, axis: Axis) -> NDArray[np.bool_]:
    """(n,) bool: points in the projector's outermost pixels."""
    across, along = projector.size.along(axis), projector.size.along(Axis.ROW if axis is Axis.COLUMN else Axis.COLUMN)
    outermost = _within(curves.position_px, across)
    return np.asarray(np.repeat(outermost, np.diff(curves.offsets)) | _within(curves.along_px, along))


def _within(place_px: NDArray[np.float64], length_px: int) -> NDArray[np.bool_]:
    return np.asarray((place_px < _BORDER_PX) | (place_px > length_px - 1 - _BORDER_PX))


def albedo_report(coloured: Coloured, mesh: Mesh, cameras: Sequence[CameraResult], *, lit: bool) -> dict[str, object]:
    """The report's section on colours: what they are, their scale, and the vertices whose colour is in doubt, by cause.

    `camera_gains` are by which the first camera sees light larger, and how many points told so; 0: none did, and the
    cameras were brought to the same median. lit : whether the projector's place is known.
    """
    counts = np.bincount(mesh.mark, minlength=len(AlbedoMark))
    known = coloured.mark != AlbedoMark.UNKNOWN
    return {
        "channels": coloured.found.value.shape[1],
        "is": "albedo: (white - black) * distance^2 / cosine of incidence at the projector"
        if lit
        else "brightness: white - black, because the projector is not calibrated",
        "scale": {"percentile": BRIGHT_PERCENT, "albedo": BRIGHT_ALBEDO},
        "brighter_than_white": round(float((coloured.found.value[known] > 1).any(axis=1).mean()), 4),
        "marked_vertices": {mark.name.lower(): int(counts[mark]) for mark in AlbedoMark if mark is not AlbedoMark.NONE},
        "camera_gains": {
            seen.name: {"gain": gain.round(4).tolist(), "points": shared}
            for seen, gain, shared in zip(cameras, coloured.found.gains, coloured.found.shared, strict=True)
        },
    }
