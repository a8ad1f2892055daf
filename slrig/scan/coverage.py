"""How much of what a camera decoded the mesh covers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slrig.meshing import covered_pixels, depth_ranges
from slrig.model import IntArray, Mesh, Refusal, Size
from slrig.reconstruction import SheetCurves, optical_depths_mm
from slrig.scan.placing import placed_vertices
from slrig.scan.stream import CameraResult

_PICTURE_PX = 480
"""Wide enough for a share, and a tenth of the work at full size."""


def with_uncovered_refused(mesh: Mesh, seen: CameraResult) -> CameraResult:
    """The camera with the decoded pixels that no triangle of the mesh covers among its refusals."""
    covered = covered_pixels(placed_vertices(mesh.vertices_mm, seen.device), mesh.faces, seen.device.size)
    refusal = seen.curves.refusal
    bare = (refusal == Refusal.NONE) & ~covered
    return replace(seen, curves=replace(seen.curves, refusal=np.where(bare, np.uint8(Refusal.NO_SURFACE), refusal)))


def covered_share(seen: CameraResult) -> float | None:
    """The share of the pixels without another cause that the mesh covers; None without such pixels. seen : a result of
    `with_uncovered_refused`.
    """
    covered, bare = (np.count_nonzero(seen.curves.refusal == each) for each in (Refusal.NONE, Refusal.NO_SURFACE))
    return covered / (covered + bare) if covered + bare else None


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
