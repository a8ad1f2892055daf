"""Peer: one projector column per camera pixel from a Gray code, and a mesh of the pixel grid.

This is what an application built on OpenCV's `structured_light` module does. The code is read with the module's own
`getProjPixel`, which answers for one pixel per call; the same rule on whole arrays is measured beside it, so that the
peer's time is not that of the calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from slrig.model import FloatArray, IntArray, Pinhole, Surface
from tests.bench.peers.measuring import Meter, Phase
from tests.bench.peers.scene import GrayFrames, projected_px, towards_camera, without_long_edges

# What serves the peer best on these frames. The module's own 40 and 5 leave out up to a quarter of the surface,
# pixels beside a code edge most of all, and make the rest better by less than a tenth.
_BLACK_THRESHOLD = 10
_WHITE_THRESHOLD = 0

_ROW_ROUNDS = 3

Decoder = Callable[[GrayFrames], IntArray]


def gray_mesh(frames: GrayFrames, meter: Meter, *, decoder: Decoder) -> Surface:
    """Decode, triangulate, and mesh the pixel grid."""
    meter.enter(Phase.POINTS)
    points_mm = triangulated_mm(decoder(frames), frames.camera, frames.projector)
    meter.enter(Phase.MESH)
    return grid_mesh(points_mm, frames.camera.centre_mm)


def columns_by_opencv(frames: GrayFrames) -> IntArray:
    """(H, W) int32: the projector column of each camera pixel by OpenCV, -1 where it refuses the pixel."""
    # With a height of one row the module reads beyond its list of row bits, so it is given one bit of rows: always 0.
    # Only the contrib wheel has the module, so the stubs of the other do not know it.
    with_contrib: Any = cv2
    pattern = with_contrib.structured_light.GrayCodePattern.create(frames.projector.size.width_px, 2)
    pattern.setWhiteThreshold(_WHITE_THRESHOLD)
    pattern.setBlackThreshold(_BLACK_THRESHOLD)
    images = [image for pair in zip(frames.direct, frames.inverse, strict=True) for image in pair]
    dark, bright = np.zeros_like(frames.white), np.full_like(frames.white, 255)
    images += [dark, bright]
    found = np.full(frames.white.shape, -1, dtype=np.int32)
    for row, column in np.argwhere(_lit(frames)).tolist():
        refused, projector_px = pattern.getProjPixel(images, column, row)
        if not refused:
            found[row, column] = projector_px[0]
    return found


def columns_by_arrays(frames: GrayFrames) -> IntArray:
    """(H, W) int32: the same columns by the same rule, on whole arrays."""
    sure = _lit(frames)
    bit = np.zeros(sure.shape, dtype=bool)
    column = np.zeros(sure.shape, dtype=np.int32)
    for direct, inverse in zip(frames.direct, frames.inverse, strict=True):
        sure &= cv2.absdiff(direct, inverse) >= _WHITE_THRESHOLD
        bit ^= direct > inverse
        column = 2 * column + bit
    sure &= column < frames.projector.size.width_px
    return np.where(sure, column, -1).astype(np.int32)


def triangulated_mm(columns: IntArray, camera: Pinhole, projector: Pinhole) -> FloatArray:
    """(H, W, 3) float64, world, NaN where the column is -1: each pixel's ray meets its column's plane of light.

    The projector's lens bends the plane, so it is taken at the projector row that the point falls on, which three
    rounds find.
    """
    found = np.full((*columns.shape, 3), np.nan)
    rows_px, columns_px = np.nonzero(columns >= 0)
    if not len(rows_px):
        return found
    pixels = np.stack((columns_px, rows_px), axis=1).astype(np.float64)
    rays = np.concatenate((_undistorted(pixels, camera), np.ones((len(pixels), 1))), axis=1) @ camera.rotation
    eye = projector.rotation @ camera.centre_mm + projector.translation_mm
    rays_seen = rays @ projector.rotation.T
    light_px = np.stack((columns[rows_px, columns_px], np.full(len(pixels), projector.matrix[1, 2])), axis=1)
    points_mm = np.zeros((len(pixels), 3))
    for _ in range(_ROW_ROUNDS):
        across = _undistorted(light_px, projector)[:, 0]
        reach = (across * eye[2] - eye[0]) / (rays_seen[:, 0] - across * rays_seen[:, 2])
        points_mm = camera.centre_mm + rays * reach[:, None]
        light_px[:, 1] = projected_px(points_mm, projector)[:, 1]
    found[rows_px, columns_px] = points_mm
    return found


def grid_mesh(points_mm: FloatArray, eye_mm: FloatArray) -> Surface:
    """Four neighbouring pixels make two triangles along the shorter diagonal, three make one; long edges dropped."""
    known = np.isfinite(points_mm[..., 0])
    number = np.where(known, np.cumsum(known).reshape(known.shape) - 1, -1)
    flat = points_mm[known]
    quads = np.stack((number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]), axis=-1).reshape(-1, 4)
    count = (quads >= 0).sum(axis=1)
    threes = quads[count == 3]
    a, b, c, d = quads[count == 4].T
    shorter = np.linalg.norm(flat[a] - flat[c], axis=1) <= np.linalg.norm(flat[b] - flat[d], axis=1)
    halves = (
        np.where(shorter[:, None], np.stack((a, b, c), axis=1), np.stack((a, b, d), axis=1)),
        np.where(shorter[:, None], np.stack((a, c, d), axis=1), np.stack((b, c, d), axis=1)),
        threes[threes >= 0].reshape(-1, 3),
    )
    faces = np.concatenate(halves)
    spacing_mm = float(np.median(np.linalg.norm(flat[a] - flat[b], axis=1))) if len(a) else np.inf
    return towards_camera(flat, without_long_edges(flat, faces, spacing_mm=spacing_mm), eye_mm)


def _lit(frames: GrayFrames) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.asarray(cv2.subtract(frames.white, frames.black) > _BLACK_THRESHOLD)


def _undistorted(pixels_px: FloatArray, device: Pinhole) -> FloatArray:
    """(n, 2) float64: pixels on the plane at distance 1 before the device, its lens undone."""
    steps = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 1e-9)
    flat = cv2.undistortPoints(pixels_px[:, None].astype(np.float64), device.matrix, device.distortion, criteria=steps)
    return np.asarray(flat[:, 0], dtype=np.float64)
