"""Devices that are a little wrong, and points found with them: an oracle that shares nothing with what it tests.

Projection is OpenCV's, undistortion OpenCV's, and the depth of a point is found by the secant method.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray, Pinhole, Size

CAMERA = Size(1280, 1024)
LIGHT = Size(1024, 768)
RIGHT = Size(1200, 1000)


def looking(
    size: Size, focal_px: float, distortion: tuple[float, ...], position_mm: FloatArray, target_mm: FloatArray
) -> Pinhole:
    """A device at a place in the world that looks at another one."""
    axis = (target_mm - position_mm) / np.linalg.norm(target_mm - position_mm)
    across = np.cross([0.0, 1.0, 0.0], axis)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(axis, across), axis])
    middle = (size.width_px / 2 + 3.0, size.height_px / 2 - 5.0)
    matrix = np.array([[focal_px, 0, middle[0]], [0, 1.002 * focal_px, middle[1]], [0, 0, 1]])
    return Pinhole(size, matrix, np.array(distortion), rotation, -rotation @ position_mm)


def left_camera() -> Pinhole:
    """The world's own camera."""
    matrix = np.array([[2300.0, 0, 635.0], [0, 2304.0, 520.0], [0, 0, 1]])
    distortion = np.array([-0.12, 0.16, 0.0004, -0.0003, 0.0])
    return Pinhole(CAMERA, matrix, distortion, np.eye(3), np.zeros(3))


def right_camera() -> Pinhole:
    """A second camera."""
    return looking(RIGHT, 2200.0, (-0.1, 0.1, 0.0, 0.0003, 0.0), np.array([210.0, 8.0, 5.0]), np.array([30.0, 0, 580]))


def light_source() -> Pinhole:
    """A projector."""
    return looking(LIGHT, 2100.0, (0.03, -0.02, 0.0003, 0.0, 0.0), np.array([180.0, 5.0, -20.0]), np.array([0, 0, 600]))


def changed(device: Pinhole, change: FloatArray) -> Pinhole:
    """The device with its 15 parameters changed."""
    matrix = device.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    turn = cv2.Rodrigues(change[9:12].astype(np.float64))[0]
    return replace(
        device,
        matrix=matrix,
        distortion=device.distortion + change[4:9],
        rotation=turn @ device.rotation,
        translation_mm=device.translation_mm + change[12:],
    )


def pixels(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2): where points fall."""
    # OpenCV's own way from a matrix to a turn takes a small one for none.
    turn = Rotation.from_matrix(device.rotation).as_rotvec()
    found = cv2.projectPoints(points_mm[:, None], turn, device.translation_mm, device.matrix, device.distortion)[0]
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def ray_directions(device: Pinhole, pixels_px: FloatArray) -> FloatArray:
    """(n, 3): world directions of pixels, of depth 1 in the device."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    flat = cv2.undistortPoints(pixels_px[:, None], device.matrix, device.distortion, criteria=criteria)
    rays = np.column_stack([np.asarray(flat, dtype=np.float64).reshape(-1, 2), np.ones(len(pixels_px))])
    return np.asarray(rays @ device.rotation)


def met_with_projector(
    camera: Pinhole, projector: Pinhole, pixels_px: FloatArray, position_px: FloatArray, start_mm: FloatArray, axis: int
) -> FloatArray:
    """(n, 3): the points on the pixels' rays that the projector lights with these columns (axis 0) or rows (1)."""
    directions = ray_directions(camera, pixels_px)
    origin = camera.centre_mm

    def off(depth: FloatArray) -> FloatArray:
        return np.asarray(pixels(projector, origin + depth[:, None] * directions)[:, axis] - position_px)

    before = (start_mm - origin) @ camera.rotation[2]
    now = before + 0.05
    gap_before, gap = off(before), off(now)
    for _ in range(12):
        moves = np.abs(gap - gap_before) > 1e-13
        step = np.where(moves, gap * (now - before) / np.where(moves, gap - gap_before, 1.0), 0.0)
        before, gap_before = now, gap
        now = now - step
        gap = off(now)
    return np.asarray(origin + now[:, None] * directions)


def covariance_by_known_points(devices: list[Pinhole], fixed: int, sigma_px: float, seed: int) -> FloatArray:
    """(15 d, 15 d): of devices that were each calibrated on 150 known points in space, one by one.

    Focal lengths, principal points, lenses and poses are tied to one another as they are in a real solve. The first
    `fixed` devices keep their pose, and none has a third radial term.
    """
    random = np.random.default_rng(seed)
    result = np.zeros((15 * len(devices), 15 * len(devices)))
    steps = np.array([1e-2] * 4 + [1e-5] * 5 + [1e-7] * 3 + [1e-4] * 3)
    for index, device in enumerate(devices):
        points = random.uniform([-70, -60, 540], [70, 60, 680], (150, 3))
        free = np.array([k for k in range(15) if k != 8 and not (index < fixed and k >= 9)])
        columns = []
        for k in free:
            change = np.zeros(15)
            change[k] = steps[k]
            columns.append((pixels(changed(device, change), points) - pixels(changed(device, -change), points)).ravel())
            columns[-1] /= 2 * steps[k]
        jacobian = np.stack(columns, axis=1)
        norms = np.linalg.norm(jacobian, axis=0)
        inverse = np.linalg.inv((jacobian / norms).T @ (jacobian / norms)) / np.outer(norms, norms)
        result[np.ix_(15 * index + free, 15 * index + free)] = sigma_px**2 * inverse
    return result


def draws(covariance: FloatArray, count: int, seed: int) -> FloatArray:
    """(count, p): changes of the parameters with this covariance."""
    known = np.diagonal(covariance) > 0
    scale = np.sqrt(np.diagonal(covariance)[known])
    factor = np.linalg.cholesky(covariance[np.ix_(known, known)] / np.outer(scale, scale))
    result = np.zeros((count, len(covariance)))
    result[:, known] = np.random.default_rng(seed).normal(size=(count, len(scale))) @ factor.T * scale
    return result


def aligned(found_mm: FloatArray, true_mm: FloatArray) -> FloatArray:
    """(n, 3): the points found, moved rigidly as near as possible to the true ones (Kabsch 1976)."""
    middle, true_middle = found_mm.mean(axis=0), true_mm.mean(axis=0)
    u, _, vt = np.linalg.svd((found_mm - middle).T @ (true_mm - true_middle))
    sign: NDArray[np.float64] = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((found_mm - middle) @ (u @ sign @ vt) + true_middle)
