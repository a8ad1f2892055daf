"""Rasterisation of a mesh by a z-buffer: the nearest triangle at every pixel, and its normal."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray, IntArray, Size

_MAX_BANDS = 4  # each has its own buffers, 8 bytes per pixel
_MIN_FACES = 50_000  # of a band: a millisecond of work, as much as merging two buffers


Nearness = TypeVar("Nearness", NDArray[np.float32], NDArray[np.float64])


class RasterView(NamedTuple):
    """The nearest triangle at every pixel centre.

    depth_mm : (H, W) float32, along the optical axis; NaN without a triangle.
    face : (H, W) int32, index of the triangle, -1 without one; the first of equally near ones.
    """

    depth_mm: NDArray[np.float32]
    face: IntArray


def rasterise(points: NDArray[np.float32], faces: IntArray, size: Size) -> RasterView:
    """Rasterise a mesh. points : (V, 3) float32, column and row, pixels, and depth, mm, of its vertices.

    Interpolates inverse depth, which is linear in the image. Skips triangles with a vertex behind the camera.
    """
    at_least = max(_MIN_FACES, -(-len(faces) // _MAX_BANDS))
    given = np.ascontiguousarray(points), np.ascontiguousarray(faces), size.height_px, size.width_px
    inverse, face = merge_depth_buffers(in_bands(_z_buffer, len(faces), *given, rows_at_least=at_least))
    empty = inverse == 0
    inverse[empty] = np.nan
    face[empty] = -1
    return RasterView(np.reciprocal(inverse, out=inverse), face)


def depth_ranges(points: NDArray[np.floating[Any]], faces: IntArray, size: Size) -> tuple[FloatArray, FloatArray]:
    """(H, W) float64 each: nearest and furthest depth of the triangles at each pixel centre, mm; inf and -inf without
    a triangle. points : (V, 3), column and row, pixels, and depth, mm, which counts as linear in the image.
    """
    at_least = max(_MIN_FACES, -(-len(faces) // _MAX_BANDS))
    given = np.ascontiguousarray(points), np.ascontiguousarray(faces), size.height_px, size.width_px
    bands = in_bands(_depth_ranges, len(faces), *given, rows_at_least=at_least)
    nearest, furthest = np.full(size.shape, np.inf), np.full(size.shape, -np.inf)
    for near, far in bands:
        np.minimum(nearest, near, out=nearest)
        np.maximum(furthest, far, out=furthest)
    return nearest, furthest


def covered_pixels(points: NDArray[np.float32], faces: IntArray, size: Size) -> NDArray[np.bool_]:
    """(H, W) bool: pixel centres that a triangle covers. Arguments as for `rasterise`."""
    covered = np.zeros(size.shape, dtype=np.bool_)
    given = np.ascontiguousarray(points), np.ascontiguousarray(faces), covered
    in_bands(_cover, len(faces), *given, rows_at_least=_MIN_FACES)
    return covered


def merge_depth_buffers(buffers: list[tuple[Nearness, IntArray]]) -> tuple[Nearness, IntArray]:
    """Merge pairs of inverse depth and triangle index, (H, W) each; empties the list to save memory."""
    inverse, face = buffers.pop(0)
    while buffers:
        next_inverse, next_face = buffers.pop(0)
        # Of equally near triangles the first stays, as inside a band.
        nearer = next_inverse > inverse
        np.copyto(inverse, next_inverse, where=nearer)
        np.copyto(face, next_face, where=nearer)
    return inverse, face


def rasterise_normals(
    view: RasterView, points: NDArray[np.float32], normals: NDArray[np.float32], faces: IntArray
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Normal of the visible side at every pixel, and a mask of pixels that show a front.

    points, faces : the arguments of `rasterise`. normals : (V, 3) float32 of the vertices, in any frame; NaN counts as
    0. Returns (H, W, 3) float32 normals in that frame, unit, reversed for backs, 0 without a triangle; and (H, W) bool,
    True if the triangle is counter-clockwise in the image.
    """
    out, front = np.zeros((*view.face.shape, 3), dtype=np.float32), np.zeros(view.face.shape, dtype=np.bool_)
    given = np.ascontiguousarray(points), np.ascontiguousarray(normals), np.ascontiguousarray(faces)
    in_bands(_normals, len(out), view.face, *given, out, front, rows_at_least=16)
    return out, front


@kernel
def _z_buffer(
    first: int, last: int, points: Any, faces: Any, height: int, width: int
) -> tuple[NDArray[np.float32], IntArray]:
    """Inverse depth, 0 without a triangle, and index of the nearest triangle from first to last."""
    inverse = np.zeros((height, width), dtype=np.float32)
    nearest = np.zeros((height, width), dtype=np.int32)
    for face in range(first, last):
        a, b, c = points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]]
        if not (a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0):
            continue
        ax, bx, cx = float(a[0]), float(b[0]), float(c[0])
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        ay, by, cy = float(a[1]), float(b[1]), float(c[1])
        top, bottom = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
        # Most triangles of a dense scan are between pixel centres.
        if not (left <= right and top <= bottom):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 0.0:
            continue
        share, da, db, dc = 1.0 / area, 1.0 / a[2], 1.0 / b[2], 1.0 / c[2]
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                wa = ((bx - column) * (cy - row) - (by - row) * (cx - column)) * share
                wb = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) * share
                wc = 1.0 - wa - wb
                # Closed on all sides: a pixel on a shared edge is drawn twice, never left open.
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                near = np.float32(wa * da + wb * db + wc * dc)
                if near > inverse[row, column]:
                    inverse[row, column] = near
                    nearest[row, column] = face
    return inverse, nearest


@kernel
def _depth_ranges(
    first: int, last: int, points: Any, faces: Any, height: int, width: int
) -> tuple[FloatArray, FloatArray]:
    nearest, furthest = np.full((height, width), np.inf), np.full((height, width), -np.inf)
    for face in range(first, last):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, bx, cx = points[a, 0], points[b, 0], points[c, 0]
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        if not left <= right:
            continue
        ay, by, cy = points[a, 1], points[b, 1], points[c, 1]
        top, bottom = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not top <= bottom or not abs(area) > 0.0:
            continue
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                wa = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / area
                wb = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / area
                wc = 1.0 - wa - wb
                if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                    depth = wa * points[a, 2] + wb * points[b, 2] + wc * points[c, 2]
                    nearest[row, column] = min(nearest[row, column], depth)
                    furthest[row, column] = max(furthest[row, column], depth)
    return nearest, furthest


@kernel
def _cover(first: int, last: int, points: Any, faces: Any, covered: Any) -> None:
    """Mark the pixels of the triangles from first to last, as `_z_buffer` draws them."""
    height, width = covered.shape
    for face in range(first, last):
        a, b, c = points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]]
        if not (a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0):
            continue
        ax, bx, cx = float(a[0]), float(b[0]), float(c[0])
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        ay, by, cy = float(a[1]), float(b[1]), float(c[1])
        top, bottom = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (left <= right and top <= bottom and abs(area) > 0.0):
            continue
        share = 1.0 / area
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                wa = ((bx - column) * (cy - row) - (by - row) * (cx - column)) * share
                wb = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) * share
                if wa >= -1e-9 and wb >= -1e-9 and 1.0 - wa - wb >= -1e-9:
                    covered[row, column] = True


@kernel
def _normals(first: int, last: int, nearest: Any, points: Any, normals: Any, faces: Any, out: Any, front: Any) -> None:
    """Normals of the rows from first to last, weighted as inverse depth is."""
    for row in range(first, last):
        for column in range(nearest.shape[1]):
            face = nearest[row, column]
            if face < 0:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ax, ay, bx, by = points[a, 0] - column, points[a, 1] - row, points[b, 0] - column, points[b, 1] - row
            cx, cy = points[c, 0] - column, points[c, 1] - row
            # Twice the areas of the parts opposite the corners, positive if clockwise in the image: a back. Divided
            # by depth they have the ratios of the parts of the triangle itself; their sum cancels in a unit vector.
            wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
            front[row, column] = wa + wb + wc < 0.0
            wa, wb, wc = -wa / points[a, 2], -wb / points[b, 2], -wc / points[c, 2]
            x, y, z = 0.0, 0.0, 0.0
            for weight, corner in ((wa, a), (wb, b), (wc, c)):
                nx, ny, nz = normals[corner, 0], normals[corner, 1], normals[corner, 2]
                if not np.isnan(nx + ny + nz):
                    x, y, z = x + weight * nx, y + weight * ny, z + weight * nz
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                out[row, column, 0], out[row, column, 1], out[row, column, 2] = (
                    x / length,
                    y / length,
                    z / length,
                )
