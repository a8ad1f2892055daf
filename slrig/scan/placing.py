"""Where the vertices of a mesh fall in the picture of a camera, or of one with finer or coarser pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import Pinhole, Size
from slrig.reconstruction import optical_depths_mm, project

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
