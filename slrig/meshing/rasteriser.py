"""What a camera sees of a mesh: depth and normal at every pixel, by a z-buffer."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel
from slrig.model import FloatArray, IntArray, Size


class View(NamedTuple):
    """The nearest surface at every pixel centre.

    depth_mm : (H, W) float64, along the optical axis, NaN where nothing is seen.
    normals : (H, W, 3) float64, in the frame of the normals that were given, unit, 0 where nothing is seen.
    front : (H, W) bool, the triangle is counter-clockwise in the picture.
    """

    depth_mm: FloatArray
    normals: FloatArray
    front: NDArray[np.bool_]


def rasterised(
    pixels_px: FloatArray,
    depth_mm: FloatArray,
    normals: NDArray[np.floating[Any]],
    faces: IntArray,
    size: Size,
) -> View:
    """The view of a mesh whose vertices fall on `pixels_px`, (V, 2) (column, row), at `depth_mm`, (V,).

    Inverse depth is linear in the picture, so depth and normals (V, 3) are interpolated over it.
    Triangles with a vertex that is not in front of the camera are left out, whole.
    """
    z, n, front = _z_buffer(
        np.ascontiguousarray(pixels_px, dtype=np.float64),
        np.ascontiguousarray(depth_mm, dtype=np.float64),
        np.ascontiguousarray(np.nan_to_num(normals), dtype=np.float64),
        np.ascontiguousarray(faces),
        size.height_px,
        size.width_px,
    )
    return View(z, n, front)


@kernel
def _z_buffer(
    pixels: FloatArray, depth: FloatArray, normals: FloatArray, faces: IntArray, height: int, width: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    nearest = np.full((height, width), np.nan)
    normal = np.zeros((height, width, 3))
    front = np.zeros((height, width), dtype=np.bool_)
    for face in range(len(faces)):
        a, b, c = faces[face]
        if not (depth[a] > 0.0 and depth[b] > 0.0 and depth[c] > 0.0):
            continue
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 0.0:
            continue
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        top, bottom = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
        if not (left <= right and top <= bottom):
            continue
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                wa = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / area
                wb = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / area
                wc = 1.0 - wa - wb
                # Closed on all sides: a pixel on a shared edge is drawn twice, never left open.
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                wa, wb, wc = wa / depth[a], wb / depth[b], wc / depth[c]
                z = 1.0 / (wa + wb + wc)
                if nearest[row, column] <= z:
                    continue
                nearest[row, column] = z
                front[row, column] = area < 0.0
                for axis in range(3):
                    normal[row, column, axis] = wa * normals[a, axis] + wb * normals[b, axis] + wc * normals[c, axis]
    for row in range(height):
        for column in range(width):
            x, y, z = normal[row, column]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                for axis in range(3):
                    normal[row, column, axis] /= length
    return nearest, normal, front
