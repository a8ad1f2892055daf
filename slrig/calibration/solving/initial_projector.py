"""A start for the projector, as an inverse camera: points of the board that it lights, and the coordinates shown.

Each lit pixel's ray is met with the board: a point in space X with one projector coordinate. For a 3 x 4 matrix P with
rows p1, p2, p3 a column u says u p3·X - p1·X = 0 and a row v says v p3·X - p2·X = 0 (the direct linear transform,
Hartley and Zisserman, Multiple View Geometry, §7.1). Nothing is assumed of where its principal point lies.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from slrig.calibration.observations import COLUMN, ROW
from slrig.calibration.solving.measurements import Measurements
from slrig.calibration.solving.parameters import device_row
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, Size

_ROUNDS = 12
_LEAST_EACH = 50


def projector_start(devices: FloatArray, poses: FloatArray, matches: Measurements, size: Size, /) -> FloatArray:
    """(21,) float64: the projector as a row, without distortion.

    devices : (c, 21), cameras; poses : (m, 12).

    Raises SolveRefusedError where there is too little light along one axis, or what it shows is a mirror image.
    """
    axis = matches.match_where[:, 2]
    counts = [int((axis == one).sum()) for one in (COLUMN, ROW)]
    if min(counts) < _LEAST_EACH:
        message = (
            f"the projector's light was decoded at {counts[COLUMN]} places along columns and {counts[ROW]} along rows, "
            "and both are needed: shoot the poses with patterns along both axes, so that the light reaches the board"
        )
        raise SolveRefusedError(message)
    points = met_points(devices, poses, matches)
    good = np.isfinite(points).all(axis=1)
    points, axis, position = points[good], axis[good], matches.match_px[good]
    matrix = _robust(points, axis, position)
    return _decomposed(matrix, points, size)


def met_points(devices: FloatArray, poses: FloatArray, matches: Measurements) -> FloatArray:
    """(k, 3) float64: where each lit pixel's ray meets the flat board, in the world, mm; NaN behind the camera."""
    points = np.full((len(matches.match_px), 3), np.nan)
    for camera, device in enumerate(devices):
        mine = matches.match_where[:, 0] == camera
        if not mine.any():
            continue
        matrix = np.array([[device[0], 0, device[2]], [0, device[1], device[3]], [0, 0, 1.0]])
        flat = cv2.undistortPoints(matches.match_pixel[mine].reshape(-1, 1, 2), matrix, device[4:9]).reshape(-1, 2)
        turn, shift = device[9:18].reshape(3, 3), device[18:]
        rays = np.column_stack([flat, np.ones(len(flat))]) @ turn
        origin = -turn.T @ shift
        board = poses[matches.match_where[mine, 1]]
        normal = board[:, [2, 5, 8]]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.einsum("ni,ni->n", normal, board[:, 9:] - origin) / np.einsum("ni,ni->n", normal, rays)
        points[mine] = np.where(depth[:, None] > 0, origin + depth[:, None] * rays, np.nan)
    return points


def _robust(points: FloatArray, axis: NDArray[np.int32], position: FloatArray) -> FloatArray:
    """(3, 4) float64: the matrix by least squares of pixels, what lies far off weighing less and less (Cauchy)."""
    middle, extent = points.mean(axis=0), float(points.std())
    centre, half = float(position.mean()), float(position.std())
    scaled = np.column_stack([(points - middle) / extent, np.ones(len(points))])
    coordinate = (position - centre) / half
    rows = np.zeros((len(points), 12))
    rows[:, 8:] = coordinate[:, None] * scaled
    for one in (COLUMN, ROW):
        mine = np.flatnonzero(axis == one)
        rows[mine, 4 * one : 4 * one + 4] = -scaled[mine]
    weight = np.ones(len(points))
    solved = np.zeros((3, 4))
    for _ in range(_ROUNDS):
        weighed = rows * weight[:, None]
        solved = np.linalg.eigh(weighed.T @ weighed)[1][:, 0].reshape(3, 4)
        depth = scaled @ solved[2]
        depth = np.where(np.abs(depth) > 1e-6 * np.abs(depth).max(), depth, np.nan)
        residual = np.einsum("ni,ni->n", scaled, solved[axis]) / depth - coordinate
        scale = float(np.nanmedian(np.abs(residual))) / 0.6745 + 1e-12
        weight = np.nan_to_num(1 / np.abs(depth) / np.sqrt(1 + (residual / (2 * scale)) ** 2))
    to_pixels = np.array([[half, 0, centre], [0, half, centre], [0, 0, 1.0]])
    to_scaled = np.eye(4) / extent
    to_scaled[:3, 3] = -middle / extent
    to_scaled[3, 3] = 1.0
    return np.asarray(to_pixels @ solved @ to_scaled)


def _decomposed(matrix: FloatArray, points: FloatArray, size: Size) -> FloatArray:
    """The device of a 3 x 4 matrix; see Hartley and Zisserman §6.2.4."""
    depth = np.column_stack([points, np.ones(len(points))]) @ matrix[2]
    matrix = matrix * (1 if np.median(depth) > 0 else -1)
    if np.linalg.det(matrix[:, :3]) < 0:
        message = (
            "the projector's light lies on the board as in a mirror: its columns or rows run the other way round than "
            "the cameras see them; switch off mirroring (rear or ceiling mode) in the projector and in the cameras"
        )
        raise SolveRefusedError(message)
    upper, rotation = rq(matrix[:, :3])
    signs = np.diag(np.sign(np.diagonal(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    lens = upper / upper[2, 2]
    if not np.isfinite(lens).all() or not 0.1 < lens[0, 0] / lens[1, 1] < 10 or lens[0, 0] > 1e3 * size.width_px:
        message = (
            f"the projector's light and the board's poses do not fit one another (focal lengths {lens[0, 0]:.0f} and "
            f"{lens[1, 1]:.0f} px): shoot the board at several distances and tilts, and make sure that it stands still"
        )
        raise SolveRefusedError(message)
    return device_row(
        np.asarray(lens, dtype=np.float64),
        np.zeros(5),
        np.asarray(rotation, dtype=np.float64),
        np.linalg.solve(upper, matrix[:, 3]),
    )
