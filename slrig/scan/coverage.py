"""How much of what a camera decoded the mesh covers."""

from __future__ import annotations

from slrig.meshing import rasterise
from slrig.model import Mesh, Refusal, Size
from slrig.scan.placing import placed_vertices, resampled
from slrig.scan.stream import CameraResult

_PICTURE_PX = 480
"""Wide enough for a share, and a tenth of the work at full size."""


def covered_share(mesh: Mesh, seen: CameraResult) -> float | None:
    """The share of the pixels that the camera decoded whose ray meets the mesh; None where it decoded none.

    Counted on a picture of at most 480 pixels' width. A pixel of it is decoded where half of its camera pixels are.
    """
    shape = seen.curves.refusal.shape
    step = max(1, -(-shape[1] // _PICTURE_PX))
    rows, columns = (extent // step for extent in shape)
    decoded = seen.curves.refusal[: rows * step, : columns * step] == Refusal.NONE
    decoded = decoded.reshape(rows, step, columns, step).mean(axis=(1, 3)) >= 0.5
    if not decoded.any():
        return None
    coarse = resampled(seen.device, 1 / step, Size(columns, rows))
    view = rasterise(placed_vertices(mesh.vertices_mm, coarse), mesh.faces, coarse.size)
    return float(((view.face >= 0) & decoded).sum() / decoded.sum())
