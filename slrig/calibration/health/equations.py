"""What one verification by the board says of the devices, as linear equations about a calibration.

Observed are the corners in each camera and the projector's light, averaged over cells of the image. With the board's
pose p, the calibration's own error e with covariance C = M Mᵀ, and a change δ of the devices since then,

    predicted - measured = -(J_p p + J_θ (e + δ)) + noise,    e = M z, z ~ N(0, 1).

p is free. Errors that neighbouring observations share (ink, stray light, what a lens model leaves over) would be taken
for a change of the devices if they counted as independent: every camera and axis has a quadratic surface over the board
with coefficients of `SHARED_PX` as further unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.displacement import modes_of
from slrig.calibration.observations import Observations, PoseObservation
from slrig.calibration.solution import BoardPose, covariance_of, devices_of
from slrig.calibration.solving.adjustment import corner_terms, match_terms
from slrig.calibration.solving.measurements import Measurements, groups, measured
from slrig.calibration.solving.parameters import Geometry, device_row, pose_row, to_board_pose
from slrig.calibration.solving.problem import flat_geometry
from slrig.calibration.solving.projection import DEVICE, POSE
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, IntArray

SHARED_PX = 0.01
"""Standard deviation of each coefficient of an error that all observations of one camera and axis share, px."""

_LIGHT = 12_000  # correspondences taken of each camera, pose and axis
_CELLS = 14
_FEWEST_IN_CELL = 3
_OUTLYING = 6.0
_PER_MEDIAN = 1.4826
_TURNS = 4
_SETTLED = 1e-5  # rad, mm

_Part = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""n equations of one camera, pose and axis: what is left (n,), by_device, by_pose, the surface (n, 6), deviations."""


@dataclass(frozen=True, slots=True)
class Equations:
    """n equations, each divided by its standard deviation, about the calibration as it is.

    left : (n,) float64, measured minus predicted. by_device : (n, 15 d); by_pose : (n, 6 m). shared : (n, s), by the
    coefficients of shared errors, each in units of its deviation. modes : (15 d, k), M. standing : by pose, where the
    board is with the calibration as it is.
    """

    left: FloatArray
    by_device: FloatArray
    by_pose: FloatArray
    shared: FloatArray
    modes: FloatArray
    standing: Mapping[str, BoardPose]


def equations(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Equations:
    """Set up the equations of one or more poses.

    Raises CalibrationError where no camera of the calibration sees enough of the board.
    """
    names = list(calibration.cameras)
    sizes = {name: camera.size for name, camera in calibration.cameras.items()}
    projector_size = None if calibration.projector is None else calibration.projector.size
    everything = measured(Observations(board, sizes, projector_size, tuple(poses)), {}, matches_per_view=_LIGHT)
    if not len(everything.corner_px):
        seen = sorted({name for pose in poses for name in pose.views})
        message = (
            f"the calibration is of camera {', '.join(names)}, the board was seen by {', '.join(seen) or 'none'}: "
            "check the calibration against the rig that shot the board"
        )
        raise CalibrationError(message)
    devices = np.stack([
        device_row(each.matrix, each.distortion, each.rotation, each.translation_mm)
        for each in devices_of(calibration).values()
    ])  # fmt: skip
    geometry = flat_geometry(board, devices, np.stack([_standing(pose, board, calibration) for pose in poses]))
    # The board is taken for the one that the calibration was made with: its size has not changed since then.
    modes = modes_of(covariance_of(calibration, board=False))
    found = _linear(everything, geometry, modes)
    for _ in range(_TURNS):
        # The most likely board poses, modes and shared errors, with no change of the devices.
        solved = np.linalg.lstsq(design(found), padded(found, found.left), rcond=None)[0][: POSE * len(poses)]
        step = np.zeros(geometry.layout.count)
        step[geometry.layout.first_pose : geometry.layout.first_offset] = solved
        geometry = geometry.moved(step)
        found = _linear(everything, geometry, modes)
        if np.abs(solved).max() < _SETTLED:
            break
    standing = {pose.name: to_board_pose(row) for pose, row in zip(poses, geometry.poses, strict=True)}
    return replace(found, standing=standing)


def design(found: Equations, /) -> FloatArray:
    """(n + k + s, 6 m + k + s): all that is not a change, and below it that the modes and shared errors are about 0."""
    own = np.hstack([found.by_device @ found.modes, found.shared])
    below = np.hstack([np.zeros((own.shape[1], found.by_pose.shape[1])), np.eye(own.shape[1])])
    return np.vstack([np.hstack([found.by_pose, own]), below])


def padded(found: Equations, values: FloatArray, /) -> FloatArray:
    """Values (n, …) with zeros for the equations that `design` adds."""
    below = found.modes.shape[1] + found.shared.shape[1]
    return np.concatenate([values, np.zeros((below, *values.shape[1:]))])


def _linear(m: Measurements, geometry: Geometry, modes: FloatArray) -> Equations:
    """The equations about the poses of a geometry."""
    parts = _corners(m, geometry) + _light(m, geometry)
    shared = np.zeros((sum(len(part[0]) for part in parts), 6 * len(parts)))
    start = 0
    for number, (left, _, _, surface, sigma) in enumerate(parts):
        shared[start : start + len(left), 6 * number : 6 * number + 6] = SHARED_PX * surface / sigma[:, None]
        start += len(left)
    left, by_device, by_pose, _, scale = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Equations(left / scale, by_device / scale[:, None], by_pose / scale[:, None], shared, modes, {})


def _corners(m: Measurements, geometry: Geometry) -> list[_Part]:
    residual, rows = corner_terms(geometry, m, jacobian=True)
    parts: list[_Part] = []
    for run in groups(m.corner_where, columns=2):
        camera, pose = m.corner_where[run][0, :2]
        surface = _surface(geometry, geometry.points[m.corner_where[run][:, 2]])
        for axis in (0, 1):
            left = -residual[run, axis]
            sigma, kept = _sigma(left, m.corner_sigma[run], surface)
            by_device = _spread(rows[run, axis, :DEVICE], camera, len(geometry.devices))
            by_pose = _spread(rows[run, axis, DEVICE : DEVICE + POSE], pose, len(geometry.poses))
            parts.append((left[kept], by_device[kept], by_pose[kept], surface[kept], sigma[kept]))
    return parts


def _light(m: Measurements, geometry: Geometry) -> list[_Part]:
    left = -match_terms(geometry, m, jacobian=False)[0]
    devices = len(geometry.devices)
    parts: list[_Part] = []
    for run in groups(m.match_where):
        good = np.flatnonzero(np.isfinite(left[run])) + run.start
        if len(good) < _CELLS:
            continue
        pixels, value, sigma = _cells(m.match_pixel[good], left[good], m.match_sigma[good])
        where = np.repeat(m.match_where[good[:1]], len(value), axis=0)
        camera, pose = where[0, :2]
        cells = replace(m, match_where=where, match_pixel=pixels, match_px=np.zeros(len(value)))
        _, rows = match_terms(geometry, cells, jacobian=True)
        on_board = (pixels - pixels.mean(axis=0)) / np.ptp(pixels) * 2 * geometry.frame[2] + geometry.frame[:2]
        surface = _surface(geometry, on_board)
        sigma, kept = _sigma(value, sigma, surface)
        kept = kept & np.isfinite(rows).all(axis=1)
        by_device = _spread(rows[:, :DEVICE], camera, devices)
        by_device += _spread(rows[:, DEVICE : 2 * DEVICE], devices - 1, devices)
        by_pose = _spread(rows[:, 2 * DEVICE : 2 * DEVICE + POSE], pose, len(geometry.poses))
        parts.append((value[kept], by_device[kept], by_pose[kept], surface[kept], sigma[kept]))
    return parts


def _spread(rows: FloatArray, index: int, count: int) -> FloatArray:
    """(n, k count): rows (n, k) in their place among `count` such blocks, zeros elsewhere."""
    width = rows.shape[1]
    columns = np.zeros((len(rows), width * count))
    columns[:, width * index : width * (index + 1)] = rows
    return columns


def _surface(geometry: Geometry, points_mm: FloatArray) -> FloatArray:
    """(n, 6): the terms of a quadratic surface over the board."""
    x, y = ((points_mm - geometry.frame[:2]) / geometry.frame[2]).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _sigma(left: FloatArray, stated: FloatArray, surface: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Deviations (n,), the stated ones made larger where the scatter about a smooth surface says so; which to keep."""
    cubic = np.column_stack([surface, surface[:, 1:3] * surface[:, 3:4], surface[:, 1:3] * surface[:, 5:6]])
    kept = np.isfinite(left)
    factor = 1.0
    for _ in range(3):
        weight = np.where(kept, 1 / stated, 0.0)
        solved = np.linalg.lstsq(cubic * weight[:, None], np.nan_to_num(left) * weight, rcond=None)[0]
        rest = np.abs(left - cubic @ solved) / stated
        spare = max(kept.sum() - cubic.shape[1], 1) / max(kept.sum(), 1)
        factor = max(_PER_MEDIAN * float(np.nanmedian(rest[kept])) / np.sqrt(spare), 1.0)
        kept = np.isfinite(left) & (rest <= _OUTLYING * factor)
    return stated * factor, kept


def _cells(pixels_px: FloatArray, left: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means over cells of the light's extent: pixels (c, 2), what is left (c,), and deviations (c,); outliers out."""
    least = pixels_px.min(axis=0)
    cell = np.minimum(((pixels_px - least) / (np.ptp(pixels_px, axis=0) + 1e-9) * _CELLS).astype(int), _CELLS - 1)
    key: IntArray = cell[:, 0] * _CELLS + cell[:, 1]
    order = np.argsort(key, kind="stable")
    found = []
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        middle = np.median(left[rows])
        spread = _PER_MEDIAN * float(np.median(np.abs(left[rows] - middle))) + 1e-9
        good = rows[np.abs(left[rows] - middle) <= _OUTLYING * spread]
        if len(good) < _FEWEST_IN_CELL:
            continue
        weight = 1 / sigma[good] ** 2
        weight /= weight.sum()
        mean = float(weight @ left[good])
        variance = max(float((weight**2) @ sigma[good] ** 2), float((weight**2) @ (left[good] - mean) ** 2))
        found.append((*(weight @ pixels_px[good]), mean, np.sqrt(variance)))
    table = np.array(found).reshape(-1, 4)
    return np.ascontiguousarray(table[:, :2]), table[:, 2], table[:, 3]


def _standing(pose: PoseObservation, board: Board, calibration: Calibration) -> FloatArray:
    """(12,): about where the board is, by the camera that sees most of it."""
    seen = [name for name in calibration.cameras if name in pose.views]
    if not seen:
        message = (
            f"pose '{pose.name}': none of the calibration's cameras ({', '.join(calibration.cameras)}) sees the board; "
            "put it where they all see it"
        )
        raise CalibrationError(message)
    name = max(seen, key=lambda each: len(pose.views[each].corner))
    view, camera = pose.views[name], calibration.cameras[name]
    corners = board.points_mm[view.corner]
    found, turn, shift = cv2.solvePnP(corners, view.points_px, camera.matrix, camera.distortion)
    if not found:
        message = f"pose '{pose.name}': the corners in camera '{name}' are of no board in one plane; shoot it again"
        raise CalibrationError(message)
    rotation = camera.rotation.T @ np.asarray(cv2.Rodrigues(turn)[0])
    return pose_row(rotation, camera.rotation.T @ (np.ravel(shift) - camera.translation_mm))
