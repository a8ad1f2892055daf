"""Verification of a calibration by views of a board: epipolar residuals, board size, and changed devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slrig.calibration.board import COLUMN, ROW, Board, Correspondences, PoseObservation
from slrig.calibration.health.drift import (
    MIN_EVIDENCE_GAP,
    Change,
    Hypothesis,
    describe_alternatives,
    describe_change,
    describe_remedy,
    equally_likely,
    estimate_board_growth,
    linearise,
    rank_hypotheses,
)
from slrig.calibration.health.state import DriftEstimate, PairFigures, Verification
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    cell_centres,
    covariance_modes,
    device_covariance,
    devices_by_name,
    point_sensitivity,
    project_out_rigid_motion,
)
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, IntArray, Pinhole, Size

_MAX_LISTED = 5
_STEPS = 7  # of the grid in the volume, along each axis
_MIN_POINTS = 30
_MIN_WEIGHT = 1e-4
_OUTLIER_SIGMAS = 6.0
_SIGMA_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MAX_COVARIANCE_POINTS = 160  # for the contribution of the calibration's covariance
_MIN_RESIDUALS = 12
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-13)
_STEP_MM = 0.05
_INTERSECTION_STEPS = 4
_DERIVATIVE_STEPS = np.array([1e-2] * 4 + [1e-4] * 5 + [1e-6] * 3 + [1e-3] * 3)
"""Steps of a device's parameters for derivatives: px, lens terms, rad, mm."""


def verify_by_board(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Verification:
    """Verify a calibration by one or more poses of a board, shot after it.

    Raises
    ------
    CalibrationError
        None of the calibration's cameras sees the board, or the calibration is of a single camera.
    """
    if not calibration.can_triangulate:
        message = (
            "expected a calibration of at least two devices, which a verification compares, found one of camera "
            f"'{next(iter(calibration.cameras))}' alone: calibrate it again, and see what changed with slrig calibrate "
            "compare"
        )
        raise CalibrationError(message)
    equations = linearise(poses, board, calibration)
    ranked = rank_hypotheses(equations, calibration)
    best = ranked[0]
    growth = 0.0
    if best.has_shift:
        share, evidence = estimate_board_growth(equations, calibration)
        growth = share if evidence > best.evidence - MIN_EVIDENCE_GAP else 0.0
    scale = estimate_board_scale(poses, board, calibration, equations.board_poses)
    now_mm, stated_mm, drift_mm = _expected_errors_mm(
        ranked, calibration, _working_volume(calibration, board, equations.board_poses)
    )
    verification = Verification(
        kind="board",
        pairs=pair_residuals(poses, board, calibration, equations.board_poses),
        scale_percent=None if scale is None else 100 * scale[0],
        scale_sigma_percent=None if scale is None else 100 * scale[1],
        scale_mm=None if scale is None else scale[0] * float(np.linalg.norm(np.ptp(board.points_mm, axis=0))),
        expected_mm=now_mm,
        stated_mm=None if calibration.solved is None else stated_mm,
        drift_mm=drift_mm,
        significance=best.significance,
        evidence=best.evidence,
        unseen=_unseen_devices(poses, calibration),
    )
    if best.kind is Change.NONE:
        return verification
    listed = [each for each in ranked if each.kind is not Change.NONE and each.evidence > 0][:_MAX_LISTED]
    drifts = tuple(
        DriftEstimate(each.device, str(each.kind), each.evidence, each.significance, each.weight, describe_change(each))
        for each in listed
    )
    alternatives = describe_alternatives(best, equally_likely(ranked), calibration, growth)
    return replace(verification, drifts=drifts, open=alternatives, remedy=describe_remedy(best))


def _unseen_devices(poses: Sequence[PoseObservation], calibration: Calibration) -> tuple[str, ...]:
    """Devices without observations in any pose."""
    observed = {name for pose in poses for name in pose.views}
    if any(len(light.axis) for pose in poses for light in pose.correspondences.values()):
        observed.add(PROJECTOR)
    return tuple(name for name in devices_by_name(calibration) if name not in observed)


def _working_volume(calibration: Calibration, board: Board, board_poses: Mapping[str, BoardPose]) -> FloatArray:
    """The calibration's volume; if it states none, a cube about the board."""
    if calibration.solved is not None:
        return calibration.solved.volume_mm
    corners = np.concatenate([pose.to_world(board.points_mm) for pose in board_poses.values()])
    centre, half = corners.mean(axis=0), float(np.ptp(corners, axis=0).max()) / 2
    return np.stack([centre - half, centre + half])


def _expected_errors_mm(
    ranked: Sequence[Hypothesis], calibration: Calibration, volume_mm: FloatArray
) -> tuple[float | None, float | None, float | None]:
    """Expected errors of a point along the first camera's ray, rms over a box (2, 3), mm, without noise: with changes
    since the calibration; from the calibration alone; and from the likeliest change alone, 0 if none is likely.

    The uncertainty of the board's size is left out: it is constant, and would hide a change. None if the devices share
    too little of the box.
    """
    nodes = cell_centres(np.sort(volume_mm, axis=0), [_STEPS] * 3)
    cameras = list(calibration.cameras.values())
    sensitivity = point_sensitivity(cameras, calibration.projector, nodes)
    visible = sensitivity.visible & np.isfinite(sensitivity.by_parameter).all(axis=(1, 2))
    if calibration.projector is not None and len(cameras) > 1:
        visible &= point_sensitivity(cameras[:1], calibration.projector, nodes).visible
    if visible.sum() < _MIN_POINTS:
        return None, None, None
    points, by_parameter = nodes[visible], sensitivity.by_parameter[visible]
    ray = points - cameras[0].centre_mm
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def rms(changes: FloatArray) -> float:
        fields = project_out_rigid_motion(points, by_parameter @ changes.reshape(len(changes), -1))
        return float(np.sqrt((np.einsum("ni,nik->nk", ray, fields) ** 2).sum(axis=1).mean()))

    likely = [each for each in ranked if each.weight > _MIN_WEIGHT and (each.evidence > 0 or each.kind is Change.NONE)]
    square = sum(each.weight * (rms(each.mean) ** 2 + rms(each.modes) ** 2) for each in likely)
    square /= sum(each.weight for each in likely)
    drift_mm = 0.0 if ranked[0].kind is Change.NONE else rms(ranked[0].change)
    return float(np.sqrt(square)), rms(covariance_modes(device_covariance(calibration, board=False))), drift_mm


class _MatchedPoints(NamedTuple):
    """Points measured by two devices: (n, 2) pixels each, and (n, 2) standard deviations in the second.

    first_sigma_px : (n,), of the pixel in the first device. start_mm : (n, 3), approximate positions.
    """

    first_px: FloatArray
    second_px: FloatArray
    second_sigma_px: FloatArray
    first_sigma_px: FloatArray
    start_mm: FloatArray


class _EpipolarResiduals(NamedTuple):
    """residual_px : (n,) float64, measured minus the epipolar line, across it, px of the second device.

    across : (n, 2) float64, the unit vector across the line. points_mm : (n, 3) float64, on the first device's ray.
    """

    residual_px: FloatArray
    across: FloatArray
    points_mm: FloatArray


def pair_residuals(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, board_poses: Mapping[str, BoardPose], /
) -> tuple[PairFigures, ...]:
    """Epipolar residuals of each camera with the projector, and of each two cameras, over all poses.

    board_poses : by pose (`slrig.calibration.health.drift.Equations.board_poses`).
    """
    figures = []
    for first, second in _device_pairs(calibration):
        parts = [_match_points(pose, board, calibration, board_poses[pose.name], first, second) for pose in poses]
        matched = [part for part in parts if part is not None]
        if matched:
            points = _MatchedPoints(*(np.concatenate(column) for column in zip(*matched, strict=True)))
            figures.append(_pair_figures(points, calibration, first, second))
    return tuple(figures)


def estimate_board_scale(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, board_poses: Mapping[str, BoardPose], /
) -> tuple[float, float] | None:
    """Relative excess of the board's measured size over its true one, and its deviation from noise and covariance.

    Measured by the pair of devices with the smallest deviation; None if no pair sees enough corners.
    """
    estimates = []
    for first, second in _device_pairs(calibration):
        parts = [_match_corners(pose, board, board_poses[pose.name], first, second) for pose in poses]
        matched = [part for part in parts if part is not None]
        if matched:
            estimates.append(_measure_scale(matched, board, calibration, first, second))
    return min(estimates, key=lambda each: each[1], default=None)


def _device_pairs(calibration: Calibration) -> list[tuple[str, str]]:
    cameras = list(calibration.cameras)
    with_projector = [(name, PROJECTOR) for name in cameras] if calibration.projector is not None else []
    return [*with_projector, *combinations(cameras, 2)]


def _match_points(
    pose: PoseObservation, board: Board, calibration: Calibration, board_pose: BoardPose, first: str, second: str
) -> _MatchedPoints | None:
    if second != PROJECTOR:
        corners = _match_corners(pose, board, board_pose, first, second)
        return None if corners is None else corners[1]
    light = pose.correspondences.get(first)
    if light is None:
        return None
    pixels, position, sigma = _join_axes(light)
    if len(pixels) < _MIN_RESIDUALS:
        return None
    # Intersect the pixels' rays with the board's plane.
    device = calibration.cameras[first]
    rays, normal = _rays(device, pixels), board_pose.rotation[:, 2]
    depth = ((board_pose.translation_mm - device.centre_mm) @ normal) / (rays @ normal)
    return _MatchedPoints(pixels, position, sigma, np.zeros(len(pixels)), device.centre_mm + depth[:, None] * rays)


def _join_axes(light: Correspondences) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2) with both projector coordinates, these coordinates (n, 2), and their deviations (n, 2)."""
    column, row = np.flatnonzero(light.axis == COLUMN), np.flatnonzero(light.axis == ROW)
    keys = [np.round(light.pixels_px[rows] * 8).astype(np.int64) @ (1 << 24, 1) for rows in (column, row)]
    _, column_rows, row_rows = np.intersect1d(keys[0], keys[1], return_indices=True)
    both = np.column_stack([column[column_rows], row[row_rows]])
    return light.pixels_px[both[:, 0]], light.position_px[both], light.sigma_px[both]


def _match_corners(
    pose: PoseObservation, board: Board, board_pose: BoardPose, first: str, second: str
) -> tuple[IntArray, _MatchedPoints] | None:
    """Corners measured by both devices; the projector's coordinates are interpolated from the light around them."""
    view = pose.views.get(first)
    if view is None:
        return None
    if second == PROJECTOR:
        light = pose.correspondences.get(first)
        if light is None:
            return None
        spacing_px = _corner_spacing_px(view.points_px, view.corner, board)
        coordinates, sigma = _interpolate_light(view.points_px, light, spacing_px)
        own = np.flatnonzero(np.isfinite(coordinates).all(axis=1))
        number, coordinates, sigma = view.corner[own], coordinates[own], sigma[own]
    else:
        other = pose.views.get(second)
        if other is None:
            return None
        number, own, other_rows = np.intersect1d(view.corner, other.corner, return_indices=True)
        coordinates, sigma = other.points_px[other_rows], np.repeat(other.sigma_px[other_rows][:, None], 2, axis=1)
    if len(number) < _MIN_RESIDUALS:
        return None
    return number, _MatchedPoints(
        view.points_px[own], coordinates, sigma, view.sigma_px[own], board_pose.to_world(board.points_mm)[number]
    )


def _corner_spacing_px(points_px: FloatArray, corner: IntArray, board: Board) -> float:
    """Median distance of neighbouring corners along a row, the radius for interpolating light."""
    row, column = np.divmod(corner, board.columns)
    next_to = (np.diff(row) == 0) & (np.diff(column) == 1)
    lengths = np.linalg.norm(np.diff(points_px, axis=0), axis=1)[next_to]
    return float(np.median(lengths)) if len(lengths) else 20.0


def _interpolate_light(points_px: FloatArray, light: Correspondences, reach_px: float) -> tuple[FloatArray, FloatArray]:
    """Projector coordinates at points (n, 2) from a weighted quadratic surface, and deviations (n, 2)."""
    coordinates, sigma = np.full((len(points_px), 2), np.nan), np.full((len(points_px), 2), np.nan)
    for axis in (COLUMN, ROW):
        rows = np.flatnonzero(light.axis == axis)
        if not len(rows):
            continue
        tree = cKDTree(light.pixels_px[rows])
        for number, place in enumerate(points_px):
            chosen = tree.query_ball_point(place, reach_px)
            if len(chosen) < _MIN_RESIDUALS:
                continue
            near = rows[chosen]
            x, y = (light.pixels_px[near] - points_px[number]).T / reach_px
            terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
            weight = 1 / light.sigma_px[near]
            position = light.position_px[near]
            for _ in range(2):
                coefficients = np.linalg.lstsq(terms * weight[:, None], position * weight, rcond=None)[0]
                residual = (position - terms @ coefficients) * weight
                spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(residual))) + 1e-9
                weight = np.where(np.abs(residual) > 4 * spread, 0.0, weight)
            normal = np.linalg.pinv((terms * weight[:, None]).T @ (terms * weight[:, None]))
            coordinates[number, axis] = coefficients[0]
            sigma[number, axis] = max(spread, 1.0) * np.sqrt(max(normal[0, 0], 0.0))
    return coordinates, sigma


def _project(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: pixels of points (n, 3) in the world; NaN behind the device."""
    in_device = points_mm @ device.rotation.T + device.translation_mm
    in_front = np.isfinite(in_device).all(axis=1) & (in_device[:, 2] > 0)
    safe = np.where(in_front[:, None], in_device, (0.0, 0.0, 1.0))
    pixels, _ = cv2.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), device.matrix, device.distortion)
    return np.where(in_front[:, None], np.asarray(pixels, dtype=np.float64).reshape(-1, 2), np.nan)


def _rays(device: Pinhole, pixels_px: FloatArray) -> FloatArray:
    """(n, 3) float64: directions in the world of pixels (n, 2), with depth 1 in the device."""
    normalised = cv2.undistortPoints(pixels_px[:, None], device.matrix, device.distortion, criteria=_CRITERIA)
    rays = np.column_stack([np.asarray(normalised, dtype=np.float64).reshape(-1, 2), np.ones(len(pixels_px))])
    return np.asarray(rays @ device.rotation)


def _epipolar_residuals(first: Pinhole, second: Pinhole, points: _MatchedPoints) -> _EpipolarResiduals:
    """Find the point on each ray of the first device whose image is nearest to the second device's pixel."""
    origin, rays = first.centre_mm, _rays(first, points.first_px)
    depth = (points.start_mm - origin) @ first.rotation[2]
    for _ in range(_INTERSECTION_STEPS):
        image = _project(second, origin + depth[:, None] * rays)
        along = (_project(second, origin + (depth + _STEP_MM)[:, None] * rays) - image) / _STEP_MM
        depth = depth + ((points.second_px - image) * along).sum(axis=1) / (along**2).sum(axis=1)
    points_mm = origin + depth[:, None] * rays
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    residual_px = ((points.second_px - _project(second, points_mm)) * across).sum(axis=1)
    return _EpipolarResiduals(residual_px, across, points_mm)


def _pair_figures(points: _MatchedPoints, calibration: Calibration, first: str, second: str) -> PairFigures:
    devices = devices_by_name(calibration)
    first_device, second_device = devices[first], devices[second]
    result = _epipolar_residuals(first_device, second_device, points)
    residual = result.residual_px
    finite = np.isfinite(residual)
    median = float(np.median(residual[finite]))
    spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(residual[finite] - median))) + 1e-9
    good = finite & (np.abs(residual - median) <= _OUTLIER_SIGMAS * spread)
    sigma = np.hypot(
        np.sqrt(((points.second_sigma_px * result.across) ** 2).sum(axis=1)),
        _first_pixel_sigma_px(first_device, second_device, points, result),
    )
    inlying = residual[good]
    spaced = np.linspace(0, good.sum() - 1, min(_MAX_COVARIANCE_POINTS, good.sum()))
    chosen = np.flatnonzero(good)[np.unique(spaced.astype(int))]
    subset = _MatchedPoints(*(column[chosen] for column in points))
    slopes = _derivatives(lambda a, b: _epipolar_residuals(a, b, subset).residual_px, first_device, second_device)
    covariance = device_covariance(calibration, first, second)
    variances = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    noise_variance, mean = float((sigma[good] ** 2).mean()), slopes.mean(axis=0)
    mean_variance = float(mean @ covariance @ mean) + noise_variance / len(inlying)
    mean_map, rms_map, count_map = _residual_maps(points.first_px[good], inlying, first_device.size)
    return PairFigures(
        first, second, len(inlying), float(inlying.mean()), float(np.sqrt((inlying**2).mean())),
        float(np.hypot(np.sqrt(noise_variance), np.sqrt(variances.mean()))), float(np.sqrt(max(mean_variance, 0.0))),
        mean_map, rms_map, count_map,
    )  # fmt: skip


def _first_pixel_sigma_px(
    first_device: Pinhole, second_device: Pinhole, points: _MatchedPoints, result: _EpipolarResiduals
) -> FloatArray:
    """(n,): deviation from the first device's pixel, px across the epipolar line in the second."""
    if not points.first_sigma_px.any():
        return np.zeros(len(points.first_px))
    moves = []
    for axis in np.eye(2):
        shifted = points._replace(first_px=points.first_px + 0.1 * axis)
        moves.append((_epipolar_residuals(first_device, second_device, shifted).residual_px - result.residual_px) / 0.1)
    return np.asarray(points.first_sigma_px * np.hypot(moves[0], moves[1]))


def _derivatives(
    value: Callable[[Pinhole, Pinhole], FloatArray | float], first: Pinhole, second: Pinhole
) -> FloatArray:
    """(..., 30): derivatives of a function by the parameters of both devices, in the order of PARAMETERS."""
    columns = []
    for number in (0, 1):
        for parameter, step in enumerate(_DERIVATIVE_STEPS):
            change = np.zeros((2, len(PARAMETERS)))
            change[number, parameter] = step
            high, low = (value(_change_device(first, c[0]), _change_device(second, c[1])) for c in (change, -change))
            columns.append((high - low) / (2 * step))
    return np.stack(columns, axis=-1)


def _change_device(device: Pinhole, change: FloatArray) -> Pinhole:
    """Add a change to the device's 15 parameters, in the order of PARAMETERS."""
    matrix = device.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    turn = np.asarray(cv2.Rodrigues(np.asarray(change[9:12], dtype=np.float64))[0], dtype=np.float64)
    return replace(
        device, matrix=matrix, distortion=device.distortion + change[4:9], rotation=turn @ device.rotation,
        translation_mm=device.translation_mm + change[12:],
    )  # fmt: skip


def _residual_maps(
    pixels_px: FloatArray, residual: FloatArray, size: Size
) -> tuple[list[list[float | None]], list[list[float | None]], list[list[int]]]:
    """Mean, rms and count by cell, (6, 6) over the image; None where nothing was observed."""
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip(((pixels_px + 0.5) / extent * CELLS).astype(int), 0, CELLS - 1)
    key = cell[:, 1] * CELLS + cell[:, 0]
    count = np.bincount(key, minlength=CELLS**2).reshape(CELLS, CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(key, residual, CELLS**2).reshape(CELLS, CELLS) / count
        rms = np.sqrt(np.bincount(key, residual**2, CELLS**2).reshape(CELLS, CELLS) / count)
    rows = [[[None if np.isnan(v) else round(float(v), 4) for v in row] for row in values] for values in (mean, rms)]
    return rows[0], rows[1], count.tolist()


def _measure_scale(
    parts: Sequence[tuple[IntArray, _MatchedPoints]], board: Board, calibration: Calibration, first: str, second: str
) -> tuple[float, float]:
    """Relative excess of the board's size as measured by two devices, and its deviation."""
    devices = devices_by_name(calibration)
    first_device, second_device = devices[first], devices[second]

    def scale_excess(first_device: Pinhole, second_device: Pinhole) -> tuple[float, float]:
        """The scale minus 1, and its variance from the residuals."""
        total, weight, squares = 0.0, 0.0, 0.0
        for number, points in parts:
            measured_mm = _epipolar_residuals(first_device, second_device, points).points_mm
            scale, extent, rest = _fit_similarity(measured_mm, board.points_mm[number])
            total, weight, squares = total + extent * (scale - 1), weight + extent, squares + rest
        count = sum(len(number) for number, _ in parts)
        return total / weight, squares / (3 * count - 7 * len(parts)) / weight

    value, noise = scale_excess(first_device, second_device)
    slopes = _derivatives(lambda a, b: scale_excess(a, b)[0], first_device, second_device)
    variance = noise + float(slopes @ device_covariance(calibration, first, second) @ slopes)
    return value, float(np.sqrt(variance))


def _fit_similarity(measured_mm: FloatArray, true_mm: FloatArray) -> tuple[float, float, float]:
    """Scale from true to measured points (Umeyama 1991), sum of squares of the true ones, and of the residuals."""
    measured, true = measured_mm - measured_mm.mean(axis=0), true_mm - true_mm.mean(axis=0)
    u, values, vt = np.linalg.svd(measured.T @ true)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    extent = float((true**2).sum())
    scale = float((values * sign).sum()) / extent
    residual = measured - scale * true @ ((u * sign) @ vt).T
    return scale, extent, float((residual**2).sum())
