"""How a projector's picture lies in a camera's image: mirrored, turned, and how large.

Projector position (column, row) over camera pixel (x, y) is close to an affine map. A camera and a projector that look
at the same side of a surface both have x to the right and y down, so the map's determinant is positive, however either
of them is turned; it is negative where one of the two pictures is mirrored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Pinhole

FEWEST_PIXELS = 50

_TRIMMED = 0.8
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Orientation:
    """The affine map from camera to projector. jacobian : (2, 2) float64, d(column, row)/d(x, y)."""

    jacobian: FloatArray

    @property
    def mirrored(self) -> bool:
        """Whether one of the two pictures is a mirror image."""
        return bool(np.linalg.det(self.jacobian) < 0)

    @property
    def camera_px(self) -> float:
        """How many camera pixels one projector pixel is long, on average over directions."""
        return float(abs(np.linalg.det(self.jacobian)) ** -0.5)

    @property
    def turn_deg(self) -> float:
        """By how much the picture is turned in the image, −180 to 180, clockwise; that of its rows if mirrored.

        The direction in the image in which projector columns grow.
        """
        across = np.linalg.inv(self.jacobian)[:, 0]
        return math.degrees(math.atan2(across[1], across[0]))


def orientation(column_px: FloatArray, row_px: FloatArray, known: NDArray[np.bool_]) -> Orientation | None:
    """Fit the map by least squares, leaving out the fifth of the pixels that it fits worst; None where it is not told.

    column_px, row_px : (H, W) float64, the projector position that each camera pixel shows, where it is `known`.
    """
    y, x = np.nonzero(known)
    if len(x) < FEWEST_PIXELS:
        return None
    seen = np.column_stack([column_px[y, x], row_px[y, x]])
    base = np.column_stack([np.ones(len(x)), x, y])
    kept = np.ones(len(x), np.bool_)
    weights = np.zeros((3, 2))
    for _ in range(_ROUNDS):
        weights = np.asarray(np.linalg.lstsq(base[kept], seen[kept], rcond=None)[0], np.float64)
        off = np.linalg.norm(base @ weights - seen, axis=1)
        kept = off <= np.quantile(off, _TRIMMED)
    jacobian = np.asarray(weights[1:].T, np.float64)
    if np.linalg.matrix_rank(jacobian, tol=1e-3) != 2:
        return None
    return Orientation(jacobian)


def expected_orientation(camera: Pinhole, projector: Pinhole) -> Orientation | None:
    """Return the map that a calibration foresees for a surface that faces both devices; None if they never meet.

    The surface stands where the optical axes come nearest to each other, across the direction between them. Lens
    distortion is left out: it turns nothing.
    """
    view, beam = camera.rotation[2], projector.rotation[2]
    between = view + beam
    if np.linalg.norm(between) < 1e-6:
        return None
    normal = np.asarray(between / np.linalg.norm(between), np.float64)
    # The point with the least sum of squared distances from both axes; parallel axes meet at a usual distance.
    projections = [np.eye(3) - np.outer(axis, axis) for axis in (view, beam)]
    matrix = projections[0] + projections[1]
    target = projections[0] @ camera.centre_mm + projections[1] @ projector.centre_mm
    if np.linalg.cond(matrix) < 1e6:
        meeting = np.asarray(np.linalg.solve(matrix, target), np.float64)
    else:
        meeting = np.asarray(camera.centre_mm + 1000.0 * view, np.float64)
    pixel = _image_of(camera, meeting)
    if pixel is None:
        return None
    hits = [
        _image_of(projector, _met(camera, pixel + step, meeting, normal)) for step in np.array([[0, 0], [1, 0], [0, 1]])
    ]
    if any(hit is None for hit in hits):
        return None
    origin, right, down = (np.asarray(hit, np.float64) for hit in hits)
    return Orientation(np.column_stack([right - origin, down - origin]))


def apart_deg(one: Orientation, other: Orientation) -> float:
    """The angle between two turns, 0 to 180."""
    return abs((one.turn_deg - other.turn_deg + 180) % 360 - 180)


def _image_of(device: Pinhole, point_mm: FloatArray) -> FloatArray | None:
    seen = device.matrix @ (device.rotation @ point_mm + device.translation_mm)
    return None if seen[2] <= 0 else np.asarray(seen[:2] / seen[2], np.float64)


def _met(camera: Pinhole, pixel: FloatArray, point_mm: FloatArray, normal: FloatArray) -> FloatArray:
    ray = camera.rotation.T @ np.linalg.solve(camera.matrix, np.array([*pixel, 1.0]))
    distance = normal @ (point_mm - camera.centre_mm) / (normal @ ray)
    return np.asarray(camera.centre_mm + distance * ray, np.float64)
