"""Detection of devices that changed since the calibration.

A hypothesis is a change δ of one device: it turned about its own centre (3), moved (3), did both (6), or its focal
length changed (1). Each is fitted to the linearised equations of one verification by generalised least squares, with
the calibration's covariance as prior of everything else. With the Jacobian J of the change and the residuals r, both
made orthogonal to all other unknowns, and the prior standard deviation S of the change,

    2 ln(evidence / evidence of no change) = rᵀ J' (J'ᵀJ' + 1)⁻¹ J'ᵀ r - ln det(J'ᵀJ' + 1),    J' = J S

(the marginal likelihood of a linear model with normal prior, whose large-sample form is Schwarz's BIC of 1978).

A turn of a camera moves the projector's epipole in its image, a turn of the projector does not. In a rig of one camera
and one projector, a move of the camera and the opposite move of the projector cannot be distinguished.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.calibration.board import Board, Observations, PoseObservation
from slrig.calibration.solution import (
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    covariance_modes,
    device_covariance,
    device_title,
    devices_by_name,
)
from slrig.calibration.solving.adjustment import flat_geometry
from slrig.calibration.solving.projection import (
    DEVICE,
    POSE,
    Geometry,
    Measurements,
    collect_measurements,
    corner_residuals,
    device_row,
    find_groups,
    match_residuals,
    pose_row,
    to_board_pose,
)
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, IntArray, Pinhole

SHARED_PX = 0.01
"""Standard deviation of each coefficient of an error that all observations of one camera and axis share, px."""
MIN_EVIDENCE_GAP = 9.0
"""Hypotheses whose evidence differs by less (2 ln) cannot be distinguished: 3 σ."""

_MAX_MATCHES = 12_000  # of each camera, pose and axis
_CELLS = 14
_MIN_IN_CELL = 3
_OUTLIER_SIGMAS = 6.0
_SIGMA_PER_MEDIAN = 1.4826
_MAX_ITERATIONS = 4
_STEP_TOLERANCE = 1e-5  # rad, mm

_TURN = slice(PARAMETERS.index("turn_x"), PARAMETERS.index("turn_z") + 1)
_SHIFT = slice(PARAMETERS.index("x_mm"), PARAMETERS.index("z_mm") + 1)
# Prior standard deviations of changes.
_TURN_SIGMA_RAD = float(np.radians(0.1))
_SHIFT_SIGMA_MM = 0.5
_FOCAL_SIGMA = 0.001
_GROWTH_SIGMA = 0.001
_AXES = ("about its horizontal axis", "about its vertical axis", "about its viewing axis")
_DIRECTIONS = ("to its side", "up or down", "along its viewing axis")
_MAIN_AXIS_FRACTION = 0.9

_EquationGroup = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""n equations of one camera, pose and axis: residuals (n,), by_device, by_pose, terms of a surface (n, 6), sigmas."""


@dataclass(frozen=True, slots=True)
class Equations:
    """n equations, linearised at the calibration, each divided by its standard deviation.

    residual : (n,) float64, measured minus predicted. by_device : (n, 15 d), by_pose : (n, 6 m), derivatives. shared :
    (n, s), derivatives by the coefficients of shared errors, in units of their deviation. modes : (15 d, k), of the
    calibration's covariance. board_poses : by pose, estimated with the calibration as it is.
    """

    residual: FloatArray
    by_device: FloatArray
    by_pose: FloatArray
    shared: FloatArray
    modes: FloatArray
    board_poses: Mapping[str, BoardPose]


def linearise(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Equations:
    """Linearise the equations of one or more poses at the calibration and the most likely board poses.

    Raises CalibrationError if no camera of the calibration sees enough of the board.
    """
    names = list(calibration.cameras)
    sizes = {name: camera.size for name, camera in calibration.cameras.items()}
    projector_size = None if calibration.projector is None else calibration.projector.size
    measurements = collect_measurements(
        Observations(board, sizes, projector_size, tuple(poses)), {}, matches_per_view=_MAX_MATCHES
    )
    if not len(measurements.corner_px):
        views = sorted({name for pose in poses for name in pose.views})
        message = (
            f"the calibration is of camera {', '.join(names)}, the board is visible in {', '.join(views) or 'none'}: "
            "check that the calibration is of the rig that shot the board"
        )
        raise CalibrationError(message)
    devices = np.stack([
        device_row(each.matrix, each.distortion, each.rotation, each.translation_mm)
        for each in devices_by_name(calibration).values()
    ])  # fmt: skip
    geometry = flat_geometry(
        board, devices, np.stack([_initial_board_pose(pose, board, calibration) for pose in poses])
    )
    # Assume the board of the calibration: its size has not changed since then.
    modes = covariance_modes(device_covariance(calibration, board=False))
    equations = _build_equations(measurements, geometry, modes)
    for _ in range(_MAX_ITERATIONS):
        # The most likely board poses, modes and shared errors without a change of the devices.
        solution = np.linalg.lstsq(design_matrix(equations), pad(equations, equations.residual), rcond=None)[0]
        pose_steps = solution[: POSE * len(poses)]
        step = np.zeros(geometry.layout.count)
        step[geometry.layout.first_pose : geometry.layout.first_offset] = pose_steps
        geometry = geometry.apply_step(step)
        equations = _build_equations(measurements, geometry, modes)
        if np.abs(pose_steps).max() < _STEP_TOLERANCE:
            break
    board_poses = {pose.name: to_board_pose(row) for pose, row in zip(poses, geometry.poses, strict=True)}
    return replace(equations, board_poses=board_poses)


def design_matrix(equations: Equations, /) -> FloatArray:
    """(n + k + s, 6 m + k + s): derivatives by board poses, modes and shared errors, and below the priors of the last
    two.
    """
    parameters = np.hstack([equations.by_device @ equations.modes, equations.shared])
    prior = np.hstack([np.zeros((parameters.shape[1], equations.by_pose.shape[1])), np.eye(parameters.shape[1])])
    return np.vstack([np.hstack([equations.by_pose, parameters]), prior])


def pad(equations: Equations, values: FloatArray, /) -> FloatArray:
    """Append zeros to values (n, …) for the equations that `design_matrix` adds."""
    zeros = equations.modes.shape[1] + equations.shared.shape[1]
    return np.concatenate([values, np.zeros((zeros, *values.shape[1:]))])


def _build_equations(m: Measurements, geometry: Geometry, modes: FloatArray) -> Equations:
    """Equations at the poses of a geometry."""
    parts = _corner_equations(m, geometry) + _light_equations(m, geometry)
    shared = np.zeros((sum(len(part[0]) for part in parts), 6 * len(parts)))
    start = 0
    for number, (residual, _, _, surface, sigma) in enumerate(parts):
        shared[start : start + len(residual), 6 * number : 6 * number + 6] = SHARED_PX * surface / sigma[:, None]
        start += len(residual)
    residual, by_device, by_pose, _, sigmas = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Equations(residual / sigmas, by_device / sigmas[:, None], by_pose / sigmas[:, None], shared, modes, {})


def _corner_equations(m: Measurements, geometry: Geometry) -> list[_EquationGroup]:
    residual, rows = corner_residuals(geometry, m, jacobian=True)
    parts: list[_EquationGroup] = []
    for group in find_groups(m.corner_where, columns=2):
        camera, pose = m.corner_where[group][0, :2]
        terms = _quadratic_terms(geometry, geometry.points[m.corner_where[group][:, 2]])
        for axis in (0, 1):
            value = -residual[group, axis]
            sigma, inliers = _estimate_sigma(value, m.corner_sigma[group], terms)
            by_device = _place_block(rows[group, axis, :DEVICE], camera, len(geometry.devices))
            by_pose = _place_block(rows[group, axis, DEVICE : DEVICE + POSE], pose, len(geometry.poses))
            parts.append((value[inliers], by_device[inliers], by_pose[inliers], terms[inliers], sigma[inliers]))
    return parts


def _light_equations(m: Measurements, geometry: Geometry) -> list[_EquationGroup]:
    residual = -match_residuals(geometry, m, jacobian=False)[0]
    devices = len(geometry.devices)
    parts: list[_EquationGroup] = []
    for group in find_groups(m.match_where):
        good = np.flatnonzero(np.isfinite(residual[group])) + group.start
        if len(good) < _CELLS:
            continue
        pixels, value, sigma = _average_cells(m.match_pixel[good], residual[good], m.match_sigma[good])
        where = np.repeat(m.match_where[good[:1]], len(value), axis=0)
        camera, pose = where[0, :2]
        cells = replace(m, match_where=where, match_pixel=pixels, match_px=np.zeros(len(value)))
        _, rows = match_residuals(geometry, cells, jacobian=True)
        on_board = (pixels - pixels.mean(axis=0)) / np.ptp(pixels) * 2 * geometry.frame[2] + geometry.frame[:2]
        terms = _quadratic_terms(geometry, on_board)
        sigma, inliers = _estimate_sigma(value, sigma, terms)
        inliers = inliers & np.isfinite(rows).all(axis=1)
        by_device = _place_block(rows[:, :DEVICE], camera, devices)
        by_device += _place_block(rows[:, DEVICE : 2 * DEVICE], devices - 1, devices)
        by_pose = _place_block(rows[:, 2 * DEVICE : 2 * DEVICE + POSE], pose, len(geometry.poses))
        parts.append((value[inliers], by_device[inliers], by_pose[inliers], terms[inliers], sigma[inliers]))
    return parts


def _place_block(rows: FloatArray, index: int, count: int) -> FloatArray:
    """(n, k count): rows (n, k) as one of `count` blocks, zeros elsewhere."""
    width = rows.shape[1]
    columns = np.zeros((len(rows), width * count))
    columns[:, width * index : width * (index + 1)] = rows
    return columns


def _quadratic_terms(geometry: Geometry, points_mm: FloatArray) -> FloatArray:
    """(n, 6): terms of a quadratic surface over the board."""
    x, y = ((points_mm - geometry.frame[:2]) / geometry.frame[2]).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _estimate_sigma(
    residual: FloatArray, stated: FloatArray, surface: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Deviations (n,), enlarged if the scatter about a smooth surface is larger than stated; and inliers, (n,)."""
    cubic = np.column_stack([surface, surface[:, 1:3] * surface[:, 3:4], surface[:, 1:3] * surface[:, 5:6]])
    inliers = np.isfinite(residual)
    factor = 1.0
    for _ in range(3):
        weight = np.where(inliers, 1 / stated, 0.0)
        coefficients = np.linalg.lstsq(cubic * weight[:, None], np.nan_to_num(residual) * weight, rcond=None)[0]
        remaining = np.abs(residual - cubic @ coefficients) / stated
        freedom = max(inliers.sum() - cubic.shape[1], 1) / max(inliers.sum(), 1)
        factor = max(_SIGMA_PER_MEDIAN * float(np.nanmedian(remaining[inliers])) / np.sqrt(freedom), 1.0)
        inliers = np.isfinite(residual) & (remaining <= _OUTLIER_SIGMAS * factor)
    return stated * factor, inliers


def _average_cells(
    pixels_px: FloatArray, residual: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Average residuals over cells of the light's extent, without outliers: pixels (c, 2), means (c,), sigmas (c,)."""
    least = pixels_px.min(axis=0)
    cell = np.minimum(((pixels_px - least) / (np.ptp(pixels_px, axis=0) + 1e-9) * _CELLS).astype(int), _CELLS - 1)
    key: IntArray = cell[:, 0] * _CELLS + cell[:, 1]
    order = np.argsort(key, kind="stable")
    averages = []
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        median = np.median(residual[rows])
        spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(residual[rows] - median))) + 1e-9
        inliers = rows[np.abs(residual[rows] - median) <= _OUTLIER_SIGMAS * spread]
        if len(inliers) < _MIN_IN_CELL:
            continue
        weight = 1 / sigma[inliers] ** 2
        weight /= weight.sum()
        mean = float(weight @ residual[inliers])
        variance = max(float((weight**2) @ sigma[inliers] ** 2), float((weight**2) @ (residual[inliers] - mean) ** 2))
        averages.append((*(weight @ pixels_px[inliers]), mean, np.sqrt(variance)))
    table = np.array(averages).reshape(-1, 4)
    return np.ascontiguousarray(table[:, :2]), table[:, 2], table[:, 3]


def _initial_board_pose(pose: PoseObservation, board: Board, calibration: Calibration) -> FloatArray:
    """(12,): approximate pose of the board, from the camera that sees most of it."""
    visible = [name for name in calibration.cameras if name in pose.views]
    if not visible:
        message = (
            f"pose '{pose.name}': none of the calibration's cameras ({', '.join(calibration.cameras)}) sees the board; "
            "put it where all cameras see it"
        )
        raise CalibrationError(message)
    name = max(visible, key=lambda each: len(pose.views[each].corner))
    view, camera = pose.views[name], calibration.cameras[name]
    corners = board.points_mm[view.corner]
    found, turn, shift = cv2.solvePnP(corners, view.points_px, camera.matrix, camera.distortion)
    if not found:
        message = f"pose '{pose.name}': the corners in camera '{name}' do not fit a flat board; shoot it again"
        raise CalibrationError(message)
    rotation = camera.rotation.T @ np.asarray(cv2.Rodrigues(turn)[0])
    return pose_row(rotation, camera.rotation.T @ (np.ravel(shift) - camera.translation_mm))


class BoardPoses(NamedTuple):
    """Poses of a board. names : of the m poses. poses : (m, 4, 4) float64, board to world. covariance : (6 m, 6 m)
    float64, for each pose of a small turn (rad, R' = exp([turn]x) R) and the translation (mm).
    """

    names: tuple[str, ...]
    poses: FloatArray
    covariance: FloatArray


def estimate_board_poses(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> BoardPoses:
    """Estimate the board's poses by least squares, with the calibration's error, which is common to all poses.

    The unknown shared errors of each pose are eliminated (Schur complement), so that the equations of all poses
    together stay small.

    Raises CalibrationError if no camera of the calibration sees enough of the board.
    """
    equations_by_pose = [linearise([pose], board, calibration) for pose in poses]
    modes, size = equations_by_pose[0].modes.shape[1], 6 * len(equations_by_pose)
    information, pull = np.zeros((size + modes,) * 2), np.zeros(size + modes)
    information[size:, size:] = np.eye(modes)
    for number, equations in enumerate(equations_by_pose):
        rows = np.hstack([equations.by_pose, equations.by_device @ equations.modes])
        own = equations.shared.T @ equations.shared + np.eye(equations.shared.shape[1])
        # Eliminate the shared errors.
        columns = np.column_stack([rows, equations.residual])
        explained = np.linalg.solve(own, equations.shared.T @ columns)
        reduced = rows.T @ (columns - equations.shared @ explained)
        index = np.r_[6 * number : 6 * number + 6, size : size + modes]
        information[np.ix_(index, index)] += reduced[:, :-1]
        pull[index] += reduced[:, -1]
    # Turns are about 1e-5 rad and modes about 1: scale the matrix, so that the inverse keeps its digits.
    scale = 1 / np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    moves = (covariance @ pull)[:size].reshape(-1, 6)
    transforms = np.tile(np.eye(4), (len(equations_by_pose), 1, 1))
    for pose, equations, move in zip(transforms, equations_by_pose, moves, strict=True):
        (board_pose,) = equations.board_poses.values()
        pose[:3, :3] = Rotation.from_rotvec(move[:3]).as_matrix() @ board_pose.rotation
        pose[:3, 3] = board_pose.translation_mm + move[3:]
    return BoardPoses(tuple(pose.name for pose in poses), transforms, covariance[:size, :size])


class Change(StrEnum):
    """Kind of a device's change."""

    NONE = "none"
    TURNED = "turned"
    MOVED = "moved"
    FOCAL = "focal"
    BUMPED = "turned and moved"


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One explanation of a verification's residuals.

    evidence : 2 ln of its evidence over that of no change. weight : its probability among all hypotheses, with equal
    prior probabilities. significance : √(reduction of χ²) of its best fit, in σ of one parameter.
    turn_deg, shift_mm, focal_share : the change, (3,) about and along the device's own x, y and z axis, and relative of
    the focal length, each with its standard deviation; NaN if the hypothesis has none.
    mean : (15 d,) float64, most likely deviation of all parameters from the calibration, including the error of the
    calibration itself; modes : (15 d, k), of its covariance; change : (15 d,), from the change alone.
    """

    device: str
    kind: Change
    evidence: float
    weight: float
    significance: float
    turn_deg: FloatArray
    turn_sigma_deg: FloatArray
    shift_mm: FloatArray
    shift_sigma_mm: FloatArray
    focal_share: float
    focal_sigma: float
    mean: FloatArray
    modes: FloatArray
    change: FloatArray

    @property
    def has_turn(self) -> bool:
        """True if the device's orientation changed."""
        return self.kind in (Change.TURNED, Change.BUMPED)

    @property
    def has_shift(self) -> bool:
        """True if the device's position changed."""
        return self.kind in (Change.MOVED, Change.BUMPED)


def rank_hypotheses(equations: Equations, calibration: Calibration, /) -> tuple[Hypothesis, ...]:
    """All hypotheses, the most likely first, including that nothing changed."""
    devices = devices_by_name(calibration)
    hypotheses = [_fit_hypothesis(equations, "", Change.NONE, np.zeros((DEVICE * len(devices), 0)))]
    for index, (name, device) in enumerate(devices.items()):
        for kind in (Change.TURNED, Change.MOVED, Change.FOCAL, Change.BUMPED):
            change = _change_columns(kind, device)
            columns = np.zeros((len(devices), *change.shape))
            columns[index] = change
            hypotheses.append(_fit_hypothesis(equations, name, kind, columns.reshape(-1, change.shape[1])))
    hypotheses.sort(key=lambda each: -each.evidence)
    odds = np.exp((np.array([each.evidence for each in hypotheses]) - hypotheses[0].evidence) / 2)
    return tuple(
        replace(each, weight=float(weight)) for each, weight in zip(hypotheses, odds / odds.sum(), strict=True)
    )


def equally_likely(ranked: Sequence[Hypothesis], /) -> tuple[Hypothesis, ...]:
    """Hypotheses that explain the residuals about as well as the first, with at most as many parameters."""
    best = ranked[0]
    if best.kind is Change.NONE:
        return ()
    similar = [
        each for each in ranked[1:] if best.evidence - each.evidence < MIN_EVIDENCE_GAP and each.kind is not Change.NONE
    ]
    # "Turned and moved" includes "turned" as a special case: do not list it as an alternative.
    return tuple(each for each in similar if each.kind is not Change.BUMPED or best.kind is Change.BUMPED)


def estimate_board_growth(equations: Equations, calibration: Calibration, /) -> tuple[float, float]:
    """Relative growth of the board that would explain the residuals without a change of a device, and its evidence.

    A larger board has the same effect as a smaller rig, with smaller distances between all devices.
    """
    devices = list(devices_by_name(calibration).values())
    columns = np.zeros((len(devices), DEVICE))
    for index, device in enumerate(devices):
        columns[index, _SHIFT] = device.rotation @ (device.centre_mm - devices[0].centre_mm)
    columns = columns.reshape(-1, 1) * _GROWTH_SIGMA
    hypothesis = _fit_hypothesis(equations, "", Change.NONE, columns)
    first = int(np.argmax(np.abs(columns)))
    return float(hypothesis.change[first] / columns[first, 0] * _GROWTH_SIGMA), hypothesis.evidence


def _change_columns(kind: Change, device: Pinhole) -> FloatArray:
    """(15, k): change of one device's parameters per prior standard deviation of the change."""
    turn, shift, focal = np.zeros((DEVICE, 3)), np.zeros((DEVICE, 3)), np.zeros((DEVICE, 1))
    turn[_TURN] = np.eye(3)
    # A turn about the device's own centre rotates its translation too.
    turn[_SHIFT] = np.cross(np.eye(3), device.translation_mm).T
    turn *= _TURN_SIGMA_RAD
    shift[_SHIFT] = np.eye(3) * _SHIFT_SIGMA_MM
    focal[:2, 0] = np.diagonal(device.matrix)[:2] * _FOCAL_SIGMA
    both = np.hstack([turn, shift])
    return {Change.TURNED: turn, Change.MOVED: shift, Change.FOCAL: focal, Change.BUMPED: both}[kind]


def _fit_hypothesis(equations: Equations, device: str, kind: Change, columns: FloatArray) -> Hypothesis:
    count = columns.shape[1]
    others, residual = design_matrix(equations), pad(equations, equations.residual)
    basis, _ = np.linalg.qr(others)
    by_change = pad(equations, equations.by_device @ columns)
    free = by_change - basis @ (basis.T @ by_change)
    normal = free.T @ free
    against = free.T @ (residual - basis @ (basis.T @ residual))
    regular = normal + np.eye(count)
    amplitude: FloatArray = np.asarray(np.linalg.solve(regular, against), dtype=np.float64)
    reduction = float(against @ np.linalg.pinv(normal) @ against) if count else 0.0
    sigma: FloatArray = np.sqrt(np.diagonal(np.linalg.inv(regular))).astype(np.float64)
    mean, modes = _posterior(equations, others, residual, columns, by_change)
    unknown: FloatArray = np.full(3, np.nan)
    degrees = np.degrees(_TURN_SIGMA_RAD)
    hypothesis = Hypothesis(
        device=device, kind=kind, weight=0.0, significance=float(np.sqrt(max(reduction, 0.0))),
        evidence=float(against @ amplitude) - float(np.linalg.slogdet(regular)[1]) if count else 0.0,
        turn_deg=unknown, turn_sigma_deg=unknown, shift_mm=unknown, shift_sigma_mm=unknown,
        focal_share=np.nan, focal_sigma=np.nan, mean=mean, modes=modes, change=columns @ amplitude,
    )  # fmt: skip
    if hypothesis.has_turn:
        hypothesis = replace(hypothesis, turn_deg=degrees * amplitude[:3], turn_sigma_deg=degrees * sigma[:3])
    if hypothesis.has_shift:
        hypothesis = replace(
            hypothesis, shift_mm=_SHIFT_SIGMA_MM * amplitude[-3:], shift_sigma_mm=_SHIFT_SIGMA_MM * sigma[-3:]
        )
    if kind is Change.FOCAL:
        focal_share, focal_sigma = _FOCAL_SIGMA * float(amplitude[0]), _FOCAL_SIGMA * float(sigma[0])
        hypothesis = replace(hypothesis, focal_share=focal_share, focal_sigma=focal_sigma)
    return hypothesis


def _posterior(
    equations: Equations, others: FloatArray, residual: FloatArray, columns: FloatArray, by_change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (15 d,) and modes (15 d, k) of the deviation of all parameters, given the verification."""
    count, poses = columns.shape[1], equations.by_pose.shape[1]
    prior = np.hstack([np.zeros((count, others.shape[1])), np.eye(count)])
    orthogonal, upper = np.linalg.qr(np.vstack([np.hstack([others, by_change]), prior]))
    solution = np.linalg.solve(upper, orthogonal.T @ np.concatenate([residual, np.zeros(count)]))
    chosen = np.r_[poses : poses + equations.modes.shape[1], others.shape[1] : others.shape[1] + count]
    to_parameters = np.hstack([equations.modes, columns])
    return to_parameters @ solution[chosen], to_parameters @ np.linalg.inv(upper)[chosen]


def describe_change(each: Hypothesis, /) -> str:
    """Describe which device changed and by how much, with the standard deviation, for use in a sentence."""
    if each.kind is Change.NONE:
        return "no device changed"
    name = device_title(each.device)
    if each.kind is Change.FOCAL:
        return (
            f"{name}: its focal length changed by {100 * each.focal_share:+.3f} ± {100 * each.focal_sigma:.3f} % "
            "(its lens was turned, or it warmed up)"
        )
    parts = []
    if each.has_turn:
        parts.append(f"turned by {_format_change(each.turn_deg, each.turn_sigma_deg, '°', _AXES)}")
    if each.has_shift:
        parts.append(f"moved by {_format_change(each.shift_mm, each.shift_sigma_mm, ' mm', _DIRECTIONS)}")
    return f"{name} {' and '.join(parts)}"


def describe_alternatives(
    best: Hypothesis, others: Sequence[Hypothesis], calibration: Calibration, growth: float, /
) -> str | None:
    """Describe other explanations that the geometry cannot rule out; None if there are none.

    growth : relative growth of the board that explains the residuals as well, 0 if none does.
    """
    parts = []
    verbs = {Change.FOCAL: "zoomed"}
    if others:
        names = sorted({f"{device_title(each.device)} {verbs.get(each.kind, each.kind)}" for each in others})
        parts.append(f"as well explained by: {', '.join(names)}")
    if others and len(devices_by_name(calibration)) == 2:
        if best.has_shift:
            pair = "one camera and one projector" if calibration.projector is not None else "two cameras"
            parts.append(f"{pair} cannot distinguish a device that moved from the opposite move of the other one")
        elif best.has_turn and {best.device} != {each.device for each in others}:
            parts.append("a turn about the line between both devices is the same for either, other turns nearly so")
    if growth:
        parts.append(
            f"or the board is {abs(growth):.2%} {'larger' if growth > 0 else 'smaller'} than stated: only its size "
            "determines the distance of the devices; measure its ruler"
        )
    return "; ".join(parts) or None


def describe_remedy(best: Hypothesis, /) -> str:
    """Describe what to do about a change."""
    if best.kind is Change.FOCAL:
        return "lock its lens, wait until the rig is warm, and calibrate again"
    mount = "the projector's mount" if best.device == PROJECTOR else f"the mount of {device_title(best.device)}"
    return f"check {mount}, and calibrate again"


def _format_change(value: FloatArray, sigma: FloatArray, unit: str, ways: Sequence[str]) -> str:
    size = float(np.linalg.norm(value))
    along = value / max(size, 1e-300)
    spread = float(np.sqrt(((along * sigma) ** 2).sum()))
    main = int(np.argmax(np.abs(along)))
    return f"{size:.3f} ± {spread:.3f}{unit} {'' if abs(along[main]) > _MAIN_AXIS_FRACTION else 'mostly '}{ways[main]}"
