"""Devices that changed since the calibration: equations, estimates, and which changes the geometry cannot separate.

A hypothesis is a change δ of one device: it turned about its own centre (3), moved (3), did both (6), or its focal
length changed (1). Each is fitted to the equations of one verification by the board
(`slrig.calibration.health.drift`) by generalised least squares, everything else held by the calibration's
covariance. With the columns J of the change and what is left r, both made orthogonal to all that is not a change, and S
the size that such a change may have,

    2 ln(evidence / evidence of no change) = rᵀ J' (J'ᵀJ' + 1)⁻¹ J'ᵀ r - ln det(J'ᵀJ' + 1),    J' = J S

(the marginal likelihood of a linear model with normal prior, whose large-sample form is Schwarz's BIC of 1978).

What can be told apart: a turn of a camera moves the projector's epipole in its image, a turn of the projector does not.
A camera that moved and a projector that moved the other way are one and the same to a rig of these two.
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

_MAX_MATCHES = 12_000  # correspondences taken of each camera, pose and axis
_CELLS = 14
_MIN_IN_CELL = 3
_OUTLIER_SIGMAS = 6.0
_SIGMA_PER_MEDIAN = 1.4826
_MAX_ITERATIONS = 4
_STEP_TOLERANCE = 1e-5  # rad, mm

_EquationGroup = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
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


def linearise(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Equations:
    """Set up the equations of one or more poses.

    Raises CalibrationError where no camera of the calibration sees enough of the board.
    """
    names = list(calibration.cameras)
    sizes = {name: camera.size for name, camera in calibration.cameras.items()}
    projector_size = None if calibration.projector is None else calibration.projector.size
    everything = collect_measurements(
        Observations(board, sizes, projector_size, tuple(poses)), {}, matches_per_view=_MAX_MATCHES
    )
    if not len(everything.corner_px):
        seen = sorted({name for pose in poses for name in pose.views})
        message = (
            f"the calibration is of camera {', '.join(names)}, the board was seen by {', '.join(seen) or 'none'}: "
            "check the calibration against the rig that shot the board"
        )
        raise CalibrationError(message)
    devices = np.stack([
        device_row(each.matrix, each.distortion, each.rotation, each.translation_mm)
        for each in devices_by_name(calibration).values()
    ])  # fmt: skip
    geometry = flat_geometry(
        board, devices, np.stack([_initial_board_pose(pose, board, calibration) for pose in poses])
    )
    # The board is taken for the one that the calibration was made with: its size has not changed since then.
    modes = covariance_modes(device_covariance(calibration, board=False))
    found = _build_equations(everything, geometry, modes)
    for _ in range(_MAX_ITERATIONS):
        # The most likely board poses, modes and shared errors, with no change of the devices.
        solved = np.linalg.lstsq(design_matrix(found), pad(found, found.left), rcond=None)[0][: POSE * len(poses)]
        step = np.zeros(geometry.layout.count)
        step[geometry.layout.first_pose : geometry.layout.first_offset] = solved
        geometry = geometry.apply_step(step)
        found = _build_equations(everything, geometry, modes)
        if np.abs(solved).max() < _STEP_TOLERANCE:
            break
    standing = {pose.name: to_board_pose(row) for pose, row in zip(poses, geometry.poses, strict=True)}
    return replace(found, standing=standing)


def design_matrix(found: Equations, /) -> FloatArray:
    """(n + k + s, 6 m + k + s): all that is not a change, and below it that the modes and shared errors are about 0."""
    own = np.hstack([found.by_device @ found.modes, found.shared])
    below = np.hstack([np.zeros((own.shape[1], found.by_pose.shape[1])), np.eye(own.shape[1])])
    return np.vstack([np.hstack([found.by_pose, own]), below])


def pad(found: Equations, values: FloatArray, /) -> FloatArray:
    """Values (n, …) with zeros for the equations that `design_matrix` adds."""
    below = found.modes.shape[1] + found.shared.shape[1]
    return np.concatenate([values, np.zeros((below, *values.shape[1:]))])


def _build_equations(m: Measurements, geometry: Geometry, modes: FloatArray) -> Equations:
    """The equations about the poses of a geometry."""
    parts = _corner_equations(m, geometry) + _light_equations(m, geometry)
    shared = np.zeros((sum(len(part[0]) for part in parts), 6 * len(parts)))
    start = 0
    for number, (left, _, _, surface, sigma) in enumerate(parts):
        shared[start : start + len(left), 6 * number : 6 * number + 6] = SHARED_PX * surface / sigma[:, None]
        start += len(left)
    left, by_device, by_pose, _, scale = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Equations(left / scale, by_device / scale[:, None], by_pose / scale[:, None], shared, modes, {})


def _corner_equations(m: Measurements, geometry: Geometry) -> list[_EquationGroup]:
    residual, rows = corner_residuals(geometry, m, jacobian=True)
    parts: list[_EquationGroup] = []
    for run in find_groups(m.corner_where, columns=2):
        camera, pose = m.corner_where[run][0, :2]
        surface = _quadratic_terms(geometry, geometry.points[m.corner_where[run][:, 2]])
        for axis in (0, 1):
            left = -residual[run, axis]
            sigma, kept = _estimate_sigma(left, m.corner_sigma[run], surface)
            by_device = _place_block(rows[run, axis, :DEVICE], camera, len(geometry.devices))
            by_pose = _place_block(rows[run, axis, DEVICE : DEVICE + POSE], pose, len(geometry.poses))
            parts.append((left[kept], by_device[kept], by_pose[kept], surface[kept], sigma[kept]))
    return parts


def _light_equations(m: Measurements, geometry: Geometry) -> list[_EquationGroup]:
    left = -match_residuals(geometry, m, jacobian=False)[0]
    devices = len(geometry.devices)
    parts: list[_EquationGroup] = []
    for run in find_groups(m.match_where):
        good = np.flatnonzero(np.isfinite(left[run])) + run.start
        if len(good) < _CELLS:
            continue
        pixels, value, sigma = _average_cells(m.match_pixel[good], left[good], m.match_sigma[good])
        where = np.repeat(m.match_where[good[:1]], len(value), axis=0)
        camera, pose = where[0, :2]
        cells = replace(m, match_where=where, match_pixel=pixels, match_px=np.zeros(len(value)))
        _, rows = match_residuals(geometry, cells, jacobian=True)
        on_board = (pixels - pixels.mean(axis=0)) / np.ptp(pixels) * 2 * geometry.frame[2] + geometry.frame[:2]
        surface = _quadratic_terms(geometry, on_board)
        sigma, kept = _estimate_sigma(value, sigma, surface)
        kept = kept & np.isfinite(rows).all(axis=1)
        by_device = _place_block(rows[:, :DEVICE], camera, devices)
        by_device += _place_block(rows[:, DEVICE : 2 * DEVICE], devices - 1, devices)
        by_pose = _place_block(rows[:, 2 * DEVICE : 2 * DEVICE + POSE], pose, len(geometry.poses))
        parts.append((value[kept], by_device[kept], by_pose[kept], surface[kept], sigma[kept]))
    return parts


def _place_block(rows: FloatArray, index: int, count: int) -> FloatArray:
    """(n, k count): rows (n, k) in their place among `count` such blocks, zeros elsewhere."""
    width = rows.shape[1]
    columns = np.zeros((len(rows), width * count))
    columns[:, width * index : width * (index + 1)] = rows
    return columns


def _quadratic_terms(geometry: Geometry, points_mm: FloatArray) -> FloatArray:
    """(n, 6): the terms of a quadratic surface over the board."""
    x, y = ((points_mm - geometry.frame[:2]) / geometry.frame[2]).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _estimate_sigma(left: FloatArray, stated: FloatArray, surface: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Deviations (n,), the stated ones made larger where the scatter about a smooth surface says so; which to keep."""
    cubic = np.column_stack([surface, surface[:, 1:3] * surface[:, 3:4], surface[:, 1:3] * surface[:, 5:6]])
    kept = np.isfinite(left)
    factor = 1.0
    for _ in range(3):
        weight = np.where(kept, 1 / stated, 0.0)
        solved = np.linalg.lstsq(cubic * weight[:, None], np.nan_to_num(left) * weight, rcond=None)[0]
        rest = np.abs(left - cubic @ solved) / stated
        spare = max(kept.sum() - cubic.shape[1], 1) / max(kept.sum(), 1)
        factor = max(_SIGMA_PER_MEDIAN * float(np.nanmedian(rest[kept])) / np.sqrt(spare), 1.0)
        kept = np.isfinite(left) & (rest <= _OUTLIER_SIGMAS * factor)
    return stated * factor, kept


def _average_cells(
    pixels_px: FloatArray, left: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means over cells of the light's extent: pixels (c, 2), what is left (c,), and deviations (c,); outliers out."""
    least = pixels_px.min(axis=0)
    cell = np.minimum(((pixels_px - least) / (np.ptp(pixels_px, axis=0) + 1e-9) * _CELLS).astype(int), _CELLS - 1)
    key: IntArray = cell[:, 0] * _CELLS + cell[:, 1]
    order = np.argsort(key, kind="stable")
    found = []
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        middle = np.median(left[rows])
        spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(left[rows] - middle))) + 1e-9
        good = rows[np.abs(left[rows] - middle) <= _OUTLIER_SIGMAS * spread]
        if len(good) < _MIN_IN_CELL:
            continue
        weight = 1 / sigma[good] ** 2
        weight /= weight.sum()
        mean = float(weight @ left[good])
        variance = max(float((weight**2) @ sigma[good] ** 2), float((weight**2) @ (left[good] - mean) ** 2))
        found.append((*(weight @ pixels_px[good]), mean, np.sqrt(variance)))
    table = np.array(found).reshape(-1, 4)
    return np.ascontiguousarray(table[:, :2]), table[:, 2], table[:, 3]


def _initial_board_pose(pose: PoseObservation, board: Board, calibration: Calibration) -> FloatArray:
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


class BoardPoses(NamedTuple):
    """Poses of a board. names : of the m poses. poses : (m, 4, 4) float64, board to world. covariance : (6 m, 6 m)
    float64, of a small turn (rad, R' = exp([turn]x) R) and the translation (mm), pose by pose.
    """

    names: tuple[str, ...]
    poses: FloatArray
    covariance: FloatArray


def estimate_board_poses(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> BoardPoses:
    """The board's poses by least squares, with the calibration's own error, which all of them share.

    A pose's own unknowns (errors its observations share) are solved for beside it and eliminated (Schur), so that the
    equations of all poses together stay small.

    Raises CalibrationError where no camera of the calibration sees enough of the board.
    """
    each = [linearise([pose], board, calibration) for pose in poses]
    modes, size = each[0].modes.shape[1], 6 * len(each)
    information, pull = np.zeros((size + modes,) * 2), np.zeros(size + modes)
    information[size:, size:] = np.eye(modes)
    for number, found in enumerate(each):
        rows = np.hstack([found.by_pose, found.by_device @ found.modes])
        own = found.shared.T @ found.shared + np.eye(found.shared.shape[1])
        # What the shared errors explain of each column, and of what is left.
        taken = np.linalg.solve(own, found.shared.T @ np.column_stack([rows, found.left]))
        reduced = rows.T @ (np.column_stack([rows, found.left]) - found.shared @ taken)
        where = np.r_[6 * number : 6 * number + 6, size : size + modes]
        information[np.ix_(where, where)] += reduced[:, :-1]
        pull[where] += reduced[:, -1]
    # Turns are of 1e-5 rad and modes of 1: scaled, the inverse keeps its digits.
    scale = 1 / np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    moves = (covariance @ pull)[:size].reshape(-1, 6)
    placed = np.tile(np.eye(4), (len(each), 1, 1))
    for pose, found, move in zip(placed, each, moves, strict=True):
        (standing,) = found.standing.values()
        pose[:3, :3] = Rotation.from_rotvec(move[:3]).as_matrix() @ standing.rotation
        pose[:3, 3] = standing.translation_mm + move[3:]
    return BoardPoses(tuple(pose.name for pose in poses), placed, covariance[:size, :size])


MIN_EVIDENCE_GAP = 9.0
"""Hypotheses whose evidence differs by less (2 ln) cannot be told apart: 3 σ."""

_TURN = slice(PARAMETERS.index("turn_x"), PARAMETERS.index("turn_z") + 1)
_SHIFT = slice(PARAMETERS.index("x_mm"), PARAMETERS.index("z_mm") + 1)
_TURN_SIGMA_RAD = float(np.radians(0.1))
_SHIFT_SIGMA_MM = 0.5
_FOCAL_SIGMA = 0.001
_GROWTH_SIGMA = 0.001
_AXES = ("about its horizontal axis", "about its vertical axis", "about its viewing axis")
_DIRECTIONS = ("to its side", "up or down", "along its viewing axis")
_MAIN_AXIS_FRACTION = 0.9


class Change(StrEnum):
    """What may have happened to a device."""

    NONE = "none"
    TURNED = "turned"
    MOVED = "moved"
    FOCAL = "focal"
    BUMPED = "turned and moved"


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One explanation of what is seen.

    evidence : 2 ln of its evidence over that of no change. weight : its probability among all, which were equally
    likely before. significance : √(drop of χ²) of its best fit, in σ of one parameter.
    turn_deg, shift_mm, focal_share : the change, (3,) about and along the device's own x, y and z axis, and of the
    focal length; each with its standard deviation; NaN where the hypothesis has none.
    mean : (15 d,) float64, the most likely deviation of all parameters from the calibration, its own error included;
    modes : (15 d, k), how sure that is; change : (15 d,) that of the change alone.
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
    def turned(self) -> bool:
        """Whether the device has another orientation."""
        return self.kind in (Change.TURNED, Change.BUMPED)

    @property
    def moved(self) -> bool:
        """Whether the device stands elsewhere."""
        return self.kind in (Change.MOVED, Change.BUMPED)


def rank_hypotheses(found: Equations, calibration: Calibration, /) -> tuple[Hypothesis, ...]:
    """Every explanation, the most likely first; that nothing changed is among them."""
    devices = devices_by_name(calibration)
    tried = [_fit_hypothesis(found, "", Change.NONE, np.zeros((DEVICE * len(devices), 0)))]
    for index, (name, device) in enumerate(devices.items()):
        for kind in (Change.TURNED, Change.MOVED, Change.FOCAL, Change.BUMPED):
            own = _change_columns(kind, device)
            columns = np.zeros((len(devices), *own.shape))
            columns[index] = own
            tried.append(_fit_hypothesis(found, name, kind, columns.reshape(-1, own.shape[1])))
    tried.sort(key=lambda each: -each.evidence)
    odds = np.exp((np.array([each.evidence for each in tried]) - tried[0].evidence) / 2)
    return tuple(replace(each, weight=float(weight)) for each, weight in zip(tried, odds / odds.sum(), strict=True))


def equally_likely(ranked: Sequence[Hypothesis], /) -> tuple[Hypothesis, ...]:
    """The other hypotheses that explain what is seen about as well as the first, with as few numbers or fewer."""
    best = ranked[0]
    if best.kind is Change.NONE:
        return ()
    close = [
        each for each in ranked[1:] if best.evidence - each.evidence < MIN_EVIDENCE_GAP and each.kind is not Change.NONE
    ]
    # A device that turned is also one that turned and moved a little: that adds nothing.
    return tuple(each for each in close if each.kind is not Change.BUMPED or best.kind is Change.BUMPED)


def estimate_board_growth(found: Equations, calibration: Calibration, /) -> tuple[float, float]:
    """The share by which a larger board alone would explain what is seen, and its evidence.

    A board that grew looks like a rig that shrank: all devices drew nearer to one another.
    """
    devices = list(devices_by_name(calibration).values())
    columns = np.zeros((len(devices), DEVICE))
    for index, device in enumerate(devices):
        columns[index, _SHIFT] = device.rotation @ (device.centre_mm - devices[0].centre_mm)
    columns = columns.reshape(-1, 1) * _GROWTH_SIGMA
    fitted = _fit_hypothesis(found, "", Change.NONE, columns)
    first = int(np.argmax(np.abs(columns)))
    return float(fitted.change[first] / columns[first, 0] * _GROWTH_SIGMA), fitted.evidence


def _change_columns(kind: Change, device: Pinhole) -> FloatArray:
    """(15, k): the change of one device per unit of its prior size."""
    turn, moved, focal = np.zeros((DEVICE, 3)), np.zeros((DEVICE, 3)), np.zeros((DEVICE, 1))
    turn[_TURN] = np.eye(3)
    # A turn about the device's own centre turns its translation along.
    turn[_SHIFT] = np.cross(np.eye(3), device.translation_mm).T
    turn *= _TURN_SIGMA_RAD
    moved[_SHIFT] = np.eye(3) * _SHIFT_SIGMA_MM
    focal[:2, 0] = np.diagonal(device.matrix)[:2] * _FOCAL_SIGMA
    both = np.hstack([turn, moved])
    return {Change.TURNED: turn, Change.MOVED: moved, Change.FOCAL: focal, Change.BUMPED: both}[kind]


def _fit_hypothesis(found: Equations, device: str, kind: Change, columns: FloatArray) -> Hypothesis:
    count = columns.shape[1]
    base, left = design_matrix(found), pad(found, found.left)
    basis, _ = np.linalg.qr(base)
    by_change = pad(found, found.by_device @ columns)
    free = by_change - basis @ (basis.T @ by_change)
    normal = free.T @ free
    against = free.T @ (left - basis @ (basis.T @ left))
    regular = normal + np.eye(count)
    size: FloatArray = np.asarray(np.linalg.solve(regular, against), dtype=np.float64)
    drop = float(against @ np.linalg.pinv(normal) @ against) if count else 0.0
    deviation: FloatArray = np.sqrt(np.diagonal(np.linalg.inv(regular))).astype(np.float64)
    mean, modes = _posterior(found, base, left, columns, by_change)
    nothing: FloatArray = np.full(3, np.nan)
    degrees = np.degrees(_TURN_SIGMA_RAD)
    made = Hypothesis(
        device=device, kind=kind, weight=0.0, significance=float(np.sqrt(max(drop, 0.0))),
        evidence=float(against @ size) - float(np.linalg.slogdet(regular)[1]) if count else 0.0,
        turn_deg=nothing, turn_sigma_deg=nothing, shift_mm=nothing, shift_sigma_mm=nothing,
        focal_share=np.nan, focal_sigma=np.nan, mean=mean, modes=modes, change=columns @ size,
    )  # fmt: skip
    if made.turned:
        made = replace(made, turn_deg=degrees * size[:3], turn_sigma_deg=degrees * deviation[:3])
    if made.moved:
        made = replace(made, shift_mm=_SHIFT_SIGMA_MM * size[-3:], shift_sigma_mm=_SHIFT_SIGMA_MM * deviation[-3:])
    if kind is Change.FOCAL:
        share, sigma = _FOCAL_SIGMA * float(size[0]), _FOCAL_SIGMA * float(deviation[0])
        made = replace(made, focal_share=share, focal_sigma=sigma)
    return made


def _posterior(
    found: Equations, base: FloatArray, left: FloatArray, columns: FloatArray, by_change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (15 d,) and modes (15 d, k) of the parameters' deviation, after the verification."""
    count, poses = columns.shape[1], found.by_pose.shape[1]
    prior = np.hstack([np.zeros((count, base.shape[1])), np.eye(count)])
    orthogonal, upper = np.linalg.qr(np.vstack([np.hstack([base, by_change]), prior]))
    solved = np.linalg.solve(upper, orthogonal.T @ np.concatenate([left, np.zeros(count)]))
    chosen = np.r_[poses : poses + found.modes.shape[1], base.shape[1] : base.shape[1] + count]
    carry = np.hstack([found.modes, columns])
    return carry @ solved[chosen], carry @ np.linalg.inv(upper)[chosen]


def describe_change(each: Hypothesis, /) -> str:
    """One sentence without an end: which device changed, and by how much, with its standard deviation."""
    if each.kind is Change.NONE:
        return "no device changed"
    name = device_title(each.device)
    if each.kind is Change.FOCAL:
        return (
            f"{name}: its focal length changed by {100 * each.focal_share:+.3f} ± {100 * each.focal_sigma:.3f} % "
            "(its lens was turned, or it warmed up)"
        )
    told = [f"turned by {_format_change(each.turn_deg, each.turn_sigma_deg, '°', _AXES)}"] if each.turned else []
    told += [f"moved by {_format_change(each.shift_mm, each.shift_sigma_mm, ' mm', _DIRECTIONS)}"] if each.moved else []
    return f"{name} {' and '.join(told)}"


def describe_alternatives(
    best: Hypothesis, others: Sequence[Hypothesis], calibration: Calibration, growth: float, /
) -> str | None:
    """What else it may be, and why the geometry cannot tell; None where nothing is left open.

    growth : the share by which the board would have grown for it to look so, 0 where that explains it less well.
    """
    parts = []
    verbs = {Change.FOCAL: "zoomed"}
    if others:
        names = sorted({f"{device_title(each.device)} {verbs.get(each.kind, each.kind)}" for each in others})
        parts.append(f"as well explained by: {', '.join(names)}")
    if others and len(devices_by_name(calibration)) == 2:
        if best.moved:
            pair = "one camera and one projector" if calibration.projector is not None else "two cameras"
            parts.append(f"{pair} cannot tell a device that moved from the other one that moved the opposite way")
        elif best.turned and {best.device} != {each.device for each in others}:
            parts.append("a turn about the line between both devices looks the same from either, and others nearly so")
    if growth:
        parts.append(
            f"or the board is {abs(growth):.2%} {'larger' if growth > 0 else 'smaller'} than was said: its size alone "
            "tells the distance of the devices; measure its ruler"
        )
    return "; ".join(parts) or None


def describe_remedy(best: Hypothesis, /) -> str:
    """What to do about it."""
    if best.kind is Change.FOCAL:
        return "lock its lens, let the rig warm up, and calibrate again"
    mount = "the projector's mount" if best.device == PROJECTOR else f"the mount of {device_title(best.device)}"
    return f"check {mount}, and calibrate again"


def _format_change(value: FloatArray, sigma: FloatArray, unit: str, ways: Sequence[str]) -> str:
    size = float(np.linalg.norm(value))
    along = value / max(size, 1e-300)
    spread = float(np.sqrt(((along * sigma) ** 2).sum()))
    main = int(np.argmax(np.abs(along)))
    return f"{size:.3f} ± {spread:.3f}{unit} {'' if abs(along[main]) > _MAIN_AXIS_FRACTION else 'mostly '}{ways[main]}"
