"""What a finished mesh says of each vertex, gathered from the points that its faces use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.meshing.topology import used_vertices
from slrig.model import FloatArray, IntArray, Mesh


def compact_mesh(
    faces: IntArray,
    points_mm: FloatArray,
    normals: NDArray[np.float32],
    colour: NDArray[np.uint8],
    mark: NDArray[np.uint8],
    sigma_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    /,
) -> Mesh:
    """The mesh of the points that a face uses, in their order.

    faces : (F, 3) int32 into points_mm (n, 3) float64; normals (n, 3), colour (n, 3), mark (n,), sigma_mm (n,) of
    the points.
    offsets : (c + 1,) int32, curve i holds points offsets[i]:offsets[i + 1], all points belong to one;
    position_px : (c,) float64, projector column of each curve.
    """
    used = used_vertices(faces, len(points_mm))
    numbers, where = np.cumsum(used, dtype=np.int32) - np.int32(1), np.flatnonzero(used)
    return Mesh(
        vertices_mm=np.take(points_mm, where, axis=0).astype(np.float32),
        faces=numbers[faces],
        normals=np.take(normals, where, axis=0),
        colour=np.take(colour, where, axis=0),
        mark=np.take(mark, where),
        sigma_mm=np.take(sigma_mm, where).astype(np.float32),
        stripe=np.take(np.repeat(np.floor(position_px).astype(np.int32), np.diff(offsets)), where),
    )
