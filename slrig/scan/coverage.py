"""How much of what a camera decoded the mesh covers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.meshing import depth_ranges, rasterise
from slrig.model import IntArray, Mesh, Refusal, Size
from slrig.reconstruction import SheetCurves, optical_depths_mm
from slrig.scan.placing import placed_vertices, resampled
from slrig.scan.stream import CameraResult

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
