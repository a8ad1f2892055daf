"""What a finished mesh says of each vertex, gathered from the points that its faces use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.topology import compact
from slrig.model import FloatArray, IntArray, Mesh, Pixels


def brightness(
    pixels_px: FloatArray, camera: NDArray[np.int32], whites: list[Pixels], full_scales: list[float], /
) -> NDArray[np.uint8]:
    """(n,) uint8: each point's pixel in the white frame of its camera, of 255 at full scale.

    pixels_px : (n, 2) float64, (column, row), inside the frame; camera : (n,) int32, which of the frames.
    """
    grey = np.zeros(len(pixels_px), dtype=np.uint8)
    for index, (white, full_scale) in enumerate(zip(whites, full_scales, strict=True)):
        in_bands(_brightness, len(grey), pixels_px, camera, index, white, 255 / full_scale, grey)
    return grey


def compact_mesh(
    faces: IntArray,
    points_mm: FloatArray,
    normals: NDArray[np.float32],
    grey: NDArray[np.uint8],
    sigma_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    /,
) -> Mesh:
    """The mesh of the points that a face uses.

    faces : (F, 3) int32 into points_mm (n, 3) float64; normals (n, 3), grey (n,), sigma_mm (n,) of the points.
    offsets : (c + 1,) int32, curve i holds points offsets[i]:offsets[i + 1], all points belong to one;
    position_px : (c,) float64, projector column of each curve.
    """
    index = compact(faces, vertex_count=len(points_mm))
    count = len(index.kept)
    vertices, turned = np.zeros((count, 3), dtype=np.float32), np.zeros((count, 3), dtype=np.float32)
    shade, sigma = np.zeros(count, dtype=np.uint8), np.zeros(count, dtype=np.float32)
    stripe = np.zeros(count, dtype=np.int32)
    in_bands(
        _gather, len(position_px), index.kept, np.searchsorted(index.kept, offsets),
        np.floor(position_px).astype(np.int32),
        points_mm, normals, grey, sigma_mm, vertices, turned, shade, sigma, stripe,
    )  # fmt: skip
    return Mesh(
        vertices_mm=vertices, faces=index.faces, normals=turned, grey=shade, sigma_mm=sigma, stripe=stripe
    )  # fmt: skip


@kernel
def _brightness(
    first: int, last: int, pixels: Any, camera: Any, index: int, white: Any, factor: float, grey: Any
) -> None:
    for point in range(first, last):
        if camera[point] == index:
            column, row = int(np.rint(pixels[point, 0])), int(np.rint(pixels[point, 1]))
            grey[point] = int(min(max(np.rint(white[row, column] * factor), 0.0), 255.0))


@kernel
def _gather(
    first: int, last: int, kept: Any, firsts: Any, columns: Any, points: Any, normals: Any, grey: Any, sigma: Any,
    to_points: Any, to_normals: Any, to_grey: Any, to_sigma: Any, to_stripe: Any,
) -> None:  # fmt: skip
    for curve in range(first, last):
        for to in range(firsts[curve], firsts[curve + 1]):
            point = kept[to]
            for axis in range(3):
                to_points[to, axis] = points[point, axis]
                to_normals[to, axis] = normals[point, axis]
            to_grey[to], to_sigma[to], to_stripe[to] = grey[point], sigma[point], columns[curve]
