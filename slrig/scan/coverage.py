"""How much of what a camera decoded the mesh covers. A scan that lost most of it says so; one that lost all fails."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.errors import NothingToReconstructError, setting
from slrig.meshing import depth_ranges, rasterise
from slrig.model import IntArray, Mesh, Refusal, Size
from slrig.reconstruction import SheetCurves, optical_depths_mm
from slrig.scan.placing import placed_vertices, resampled
from slrig.scan.report import lit_pixels
from slrig.scan.stream import CameraResult

FAIR_SHARE = 0.6
"""Sound scans of real rigs have 0.8 and more, borders of two pixels that are refused included."""
_PICTURE_PX = 480
"""Wide enough for a share, and a tenth of the work at full size."""


def covered_share(mesh: Mesh, seen: CameraResult) -> float | None:
    """The share of the pixels that the camera decoded whose ray meets the mesh; None where it decoded none.

    Counted on a picture of at most 480 pixels' width. A pixel of it is decoded where half of its camera pixels are.
    """
    shape = seen.curves.refusal.shape
    step = _sampled_every(shape[1])
    rows, columns = (extent // step for extent in shape)
    decoded = seen.curves.refusal[: rows * step, : columns * step] == Refusal.NONE
    decoded = decoded.reshape(rows, step, columns, step).mean(axis=(1, 3)) >= 0.5
    if not decoded.any():
        return None
    coarse = resampled(seen.device, 1 / step, Size(columns, rows))
    view = rasterise(placed_vertices(mesh.vertices_mm, coarse), mesh.faces, coarse.size)
    return float(((view.face >= 0) & decoded).sum() / decoded.sum())


def _sampled_every(width_px: int) -> int:
    return max(1, -(-width_px // _PICTURE_PX))


def layered_share(
    seen: CameraResult, curves: SheetCurves, mine: NDArray[np.bool_], faces: IntArray, least_mm: float
) -> float:
    """The share of a mesh's image in a camera where two of its triangles lie one behind the other.

    Counted on a picture of at most 480 pixels' width. mine : (n,) bool, the points that this camera alone measured
    (others are moved in its image): triangles with others do not count. faces : (F, 3) int32 into the points.
    least_mm : smaller distances are folds of noise.
    """
    size = seen.device.size
    step = _sampled_every(size.width_px)
    faces = faces if mine.all() else faces[mine[faces].all(axis=1)]
    placed = np.column_stack((curves.pixels_px / step, optical_depths_mm(seen.device, curves.points_mm)))
    nearest, furthest = depth_ranges(placed, faces, Size(size.width_px // step, size.height_px // step))
    covered = int(np.count_nonzero(nearest <= furthest))
    return int(np.count_nonzero(furthest - nearest > least_mm)) / max(covered, 1)


def coverage_notes(name: str, share: float | None) -> list[str]:
    """One sentence if the mesh covers much less than was decoded."""
    if share is None or share >= FAIR_SHARE:
        return []
    return [
        f"the mesh covers {share:.0%} of what camera '{name}' decoded. Look at the picture of causes: the finest "
        f"patterns may not resolve (wider cells: {setting('gray_cell_px')}; wider lines: {setting('line_width_px')}), "
        f"or the limit at depth edges be too low: {setting('depth_edge_ratio')}"
    ]


def require_surface(holds: bool, folder: Path, what: str, cameras: Sequence[CameraResult]) -> None:
    """Refuse a scan that holds no surface (NothingToReconstructError), with the figures that tell why."""
    if holds:
        return
    figures = "; ".join(
        f"camera '{seen.name}': white {seen.white.mean():.0f} of {seen.full_scale:.0f} on average, at most "
        f"{seen.contrast.max():.0f} above black, {lit_pixels(seen.curves).mean():.1%} of the image lit, "
        f"{seen.curves.decoded_pixels} pixels decoded{_outside(seen)}"
        for seen in cameras
    )
    message = (
        f"{folder}: {what}. {figures}. Look whether the projector lit the object, the lens cap is off, and the "
        "exposure leaves white below full scale and well above black"
    )
    raise NothingToReconstructError(message)


def _outside(seen: CameraResult) -> str:
    share = float((seen.curves.refusal == Refusal.OUTSIDE_REGION).mean())
    return f", {share:.1%} of the image outside the region that was asked for" if share else ""
