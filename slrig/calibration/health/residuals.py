"""Does the calibration still hold? The spare equation of every pair of devices, and the size of the board as measured.

A pixel of one device fixes a ray. Where the other device measures both coordinates of the same point, one of them gives
the depth on that ray and one is left over: the distance from what was measured to the image of the ray, the epipolar
line (a curve, for a lens that bends it). That distance is zero but for noise as long as the calibration holds, whatever
the point's depth is, and it needs no knowledge of the board. The size tells what no epipolar line can: how far apart
the devices are, and how strongly they magnify. Projection is OpenCV's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slrig.calibration.board import Board
from slrig.calibration.health.verification import PairFigures
from slrig.calibration.observations import COLUMN, ROW, Correspondences, PoseObservation
from slrig.calibration.solution import CELLS, PARAMETERS, PROJECTOR, BoardPose, covariance_of, devices_of
from slrig.model import Calibration, FloatArray, IntArray, Pinhole, Size

_OUTLYING = 6.0
_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_FOR_SHARE = 160  # points that the calibration's share is evaluated at
_FEWEST = 12
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-13)
_STEP_MM = 0.05
_TURNS = 4
_STEPS = np.array([1e-2] * 4 + [1e-4] * 5 + [1e-6] * 3 + [1e-3] * 3)
"""Steps of a device's parameters for derivatives: px, lens terms, rad, mm."""


class _Matches(NamedTuple):
    """Points that two devices both measured: (n, 2) pixels each, and (n, 2) standard deviations in the second.

    first_sigma_px : (n,) of the pixel in the first device. start_mm : (n, 3), about where they are.
    """

    first_px: FloatArray
    second_px: FloatArray
    second_sigma_px: FloatArray
    first_sigma_px: FloatArray
    start_mm: FloatArray


class _Spare(NamedTuple):
    """residual_px : (n,) float64, measured minus the epipolar line, across it, px of the second device.

    across : (n, 2) float64, the unit vector across the line. points_mm : (n, 3) float64, on the first device's ray.
    """

    residual_px: FloatArray
    across: FloatArray
    points_mm: FloatArray


def pair_residuals(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[PairFigures, ...]:
    """The spare equation of each camera with the projector, and of each two cameras, over all poses.

    standing : where the board stands in each pose, as `slrig.calibration.health.equations` finds it.
    """
    found = []
    for first, second in _pairs(calibration):
        parts = [_matches(pose, board, calibration, standing[pose.name], first, second) for pose in poses]
        kept = [part for part in parts if part is not None]
        if kept:
            joined = _Matches(*(np.concatenate(column) for column in zip(*kept, strict=True)))
            found.append(_in_figures(joined, calibration, first, second))
    return tuple(found)


def board_scale(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[float, float] | None:
    """By which share of it the board measures larger than it is, and the deviation of that from noise and covariance.

    As the pair of devices measures it that is surest; None where none sees enough corners.
    """
    found = []
    for first, second in _pairs(calibration):
        parts = [_corner_matches(pose, board, standing[pose.name], first, second) for pose in poses]
        kept = [part for part in parts if part is not None]
        if kept:
            found.append(_scale(kept, board, calibration, first, second))
    return min(found, key=lambda each: each[1], default=None)


def _pairs(calibration: Calibration) -> list[tuple[str, str]]:
    cameras = list(calibration.cameras)
    lit = [(name, PROJECTOR) for name in cameras] if calibration.projector is not None else []
    return [*lit, *combinations(cameras, 2)]


def _matches(
    pose: PoseObservation, board: Board, calibration: Calibration, stands: BoardPose, first: str, second: str
) -> _Matches | None:
    if second != PROJECTOR:
        corners = _corner_matches(pose, board, stands, first, second)
        return None if corners is None else corners[1]
    light = pose.correspondences.get(first)
    if light is None:
        return None
    pixels, position, sigma = _both_axes(light)
    if len(pixels) < _FEWEST:
        return None
    # Where the pixels' rays meet the board's plane.
    device = calibration.cameras[first]
    ahead, normal = _rays(device, pixels), stands.rotation[:, 2]
    depth = ((stands.translation_mm - device.centre_mm) @ normal) / (ahead @ normal)
    return _Matches(pixels, position, sigma, np.zeros(len(pixels)), device.centre_mm + depth[:, None] * ahead)


def _both_axes(light: Correspondences) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2) of which both projector coordinates are known, those (n, 2), and their deviations (n, 2)."""
    column, row = np.flatnonzero(light.axis == COLUMN), np.flatnonzero(light.axis == ROW)
    keys = [np.round(light.pixels_px[rows] * 8).astype(np.int64) @ (1 << 24, 1) for rows in (column, row)]
    _, mine, theirs = np.intersect1d(keys[0], keys[1], return_indices=True)
    both = np.column_stack([column[mine], row[theirs]])
    return light.pixels_px[both[:, 0]], light.position_px[both], light.sigma_px[both]


def _corner_matches(
    pose: PoseObservation, board: Board, stands: BoardPose, first: str, second: str
) -> tuple[IntArray, _Matches] | None:
    """The corners that both measure: in the projector's picture by the light around them."""
    view = pose.views.get(first)
    if view is None:
        return None
    if second == PROJECTOR:
        light = pose.correspondences.get(first)
        if light is None:
            return None
        at, sigma = _light_at(view.points_px, light, _reach_px(view.points_px, view.corner, board))
        mine = np.flatnonzero(np.isfinite(at).all(axis=1))
        number, at, sigma = view.corner[mine], at[mine], sigma[mine]
    else:
        other = pose.views.get(second)
        if other is None:
            return None
        number, mine, theirs = np.intersect1d(view.corner, other.corner, return_indices=True)
        at, sigma = other.points_px[theirs], np.repeat(other.sigma_px[theirs][:, None], 2, axis=1)
    if len(number) < _FEWEST:
        return None
    return number, _Matches(
        view.points_px[mine], at, sigma, view.sigma_px[mine], stands.placed(board.points_mm)[number]
    )


def _reach_px(points_px: FloatArray, corner: IntArray, board: Board) -> float:
    """How far around a corner its light is taken: the mean distance of neighbours along a row."""
    row, column = np.divmod(corner, board.columns)
    next_to = (np.diff(row) == 0) & (np.diff(column) == 1)
    lengths = np.linalg.norm(np.diff(points_px, axis=0), axis=1)[next_to]
    return float(np.median(lengths)) if len(lengths) else 20.0


def _light_at(points_px: FloatArray, light: Correspondences, reach_px: float) -> tuple[FloatArray, FloatArray]:
    """The projector coordinates at points (n, 2) by a weighted quadratic surface, and deviations (n, 2)."""
    at, sigma = np.full((len(points_px), 2), np.nan), np.full((len(points_px), 2), np.nan)
    for axis in (COLUMN, ROW):
        rows = np.flatnonzero(light.axis == axis)
        if not len(rows):
            continue
        tree = cKDTree(light.pixels_px[rows])
        for number, place in enumerate(points_px):
            chosen = tree.query_ball_point(place, reach_px)
            if len(chosen) < _FEWEST:
                continue
            mine = rows[chosen]
            x, y = (light.pixels_px[mine] - points_px[number]).T / reach_px
            terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
            weight = 1 / light.sigma_px[mine]
            position = light.position_px[mine]
            for _ in range(2):
                solved = np.linalg.lstsq(terms * weight[:, None], position * weight, rcond=None)[0]
                left = (position - terms @ solved) * weight
                spread = _PER_MEDIAN * float(np.median(np.abs(left))) + 1e-9
                weight = np.where(np.abs(left) > 4 * spread, 0.0, weight)
            normal = np.linalg.pinv((terms * weight[:, None]).T @ (terms * weight[:, None]))
            at[number, axis] = solved[0]
            sigma[number, axis] = max(spread, 1.0) * np.sqrt(max(normal[0, 0], 0.0))
    return at, sigma


def _projected(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: pixels of points (n, 3) in the world; NaN behind the device."""
    turned = points_mm @ device.rotation.T + device.translation_mm
    before = np.isfinite(turned).all(axis=1) & (turned[:, 2] > 0)
    safe = np.where(before[:, None], turned, (0.0, 0.0, 1.0))
    pixels, _ = cv2.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), device.matrix, device.distortion)
    return np.where(before[:, None], np.asarray(pixels, dtype=np.float64).reshape(-1, 2), np.nan)


def _rays(device: Pinhole, pixels_px: FloatArray) -> FloatArray:
    """(n, 3) float64: directions in the world of pixels (n, 2), of depth 1 in the device."""
    flat = cv2.undistortPoints(pixels_px[:, None], device.matrix, device.distortion, criteria=_CRITERIA)
    ahead = np.column_stack([np.asarray(flat, dtype=np.float64).reshape(-1, 2), np.ones(len(pixels_px))])
    return np.asarray(ahead @ device.rotation)


def _spare(first: Pinhole, second: Pinhole, found: _Matches) -> _Spare:
    """Meet the rays of the first device's pixels with what the second one measured.

    The point on the ray is that whose image is nearest.
    """
    origin, ahead = first.centre_mm, _rays(first, found.first_px)
    depth = (found.start_mm - origin) @ first.rotation[2]
    for _ in range(_TURNS):
        at = _projected(second, origin + depth[:, None] * ahead)
        along = (_projected(second, origin + (depth + _STEP_MM)[:, None] * ahead) - at) / _STEP_MM
        depth = depth + ((found.second_px - at) * along).sum(axis=1) / (along**2).sum(axis=1)
    points = origin + depth[:, None] * ahead
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    return _Spare(((found.second_px - _projected(second, points)) * across).sum(axis=1), across, points)


def _in_figures(found: _Matches, calibration: Calibration, first: str, second: str) -> PairFigures:
    devices = devices_of(calibration)
    one, other = devices[first], devices[second]
    spare = _spare(one, other, found)
    residual = spare.residual_px
    finite = np.isfinite(residual)
    middle = float(np.median(residual[finite]))
    spread = _PER_MEDIAN * float(np.median(np.abs(residual[finite] - middle))) + 1e-9
    good = finite & (np.abs(residual - middle) <= _OUTLYING * spread)
    sigma = np.hypot(
        np.sqrt(((found.second_sigma_px * spare.across) ** 2).sum(axis=1)), _as_seen(one, other, found, spare)
    )
    kept = residual[good]
    chosen = np.flatnonzero(good)[np.unique(np.linspace(0, good.sum() - 1, min(_FOR_SHARE, good.sum())).astype(int))]
    some = _Matches(*(column[chosen] for column in found))
    slopes = _slopes(lambda a, b: _spare(a, b, some).residual_px, one, other)
    covariance = covariance_of(calibration, first, second)
    shares = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    noise_variance, mean = float((sigma[good] ** 2).mean()), slopes.mean(axis=0)
    mean_variance = float(mean @ covariance @ mean) + noise_variance / len(kept)
    mean_map, rms_map, count_map = _maps(found.first_px[good], kept, one.size)
    return PairFigures(
        first, second, len(kept), float(kept.mean()), float(np.sqrt((kept**2).mean())),
        float(np.hypot(np.sqrt(noise_variance), np.sqrt(shares.mean()))), float(np.sqrt(max(mean_variance, 0.0))),
        mean_map, rms_map, count_map,
    )  # fmt: skip


def _as_seen(one: Pinhole, other: Pinhole, found: _Matches, spare: _Spare) -> FloatArray:
    """(n,): the deviation of the first device's pixel, px across the line in the second."""
    if not found.first_sigma_px.any():
        return np.zeros(len(found.first_px))
    moves = []
    for axis in np.eye(2):
        moved = found._replace(first_px=found.first_px + 0.1 * axis)
        moves.append((_spare(one, other, moved).residual_px - spare.residual_px) / 0.1)
    return np.asarray(found.first_sigma_px * np.hypot(moves[0], moves[1]))


def _slopes(value: Callable[[Pinhole, Pinhole], FloatArray | float], one: Pinhole, other: Pinhole) -> FloatArray:
    """(..., 30): derivatives of what a function gives by the parameters of both devices, in the order of PARAMETERS."""
    columns = []
    for which in (0, 1):
        for number, step in enumerate(_STEPS):
            change = np.zeros((2, len(PARAMETERS)))
            change[which, number] = step
            high, low = (value(_changed(one, by[0]), _changed(other, by[1])) for by in (change, -change))
            columns.append((high - low) / (2 * step))
    return np.stack(columns, axis=-1)


def _changed(device: Pinhole, change: FloatArray) -> Pinhole:
    """The device with its 15 parameters changed, in the order of PARAMETERS."""
    matrix = device.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    turn = np.asarray(cv2.Rodrigues(np.asarray(change[9:12], dtype=np.float64))[0], dtype=np.float64)
    return replace(
        device, matrix=matrix, distortion=device.distortion + change[4:9], rotation=turn @ device.rotation,
        translation_mm=device.translation_mm + change[12:],
    )  # fmt: skip


def _maps(
    pixels_px: FloatArray, residual: FloatArray, size: Size
) -> tuple[list[list[float | None]], list[list[float | None]], list[list[int]]]:
    """Mean, rms and count by cell, (6, 6) over the image; None where nothing was seen."""
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip(((pixels_px + 0.5) / extent * CELLS).astype(int), 0, CELLS - 1)
    key = cell[:, 1] * CELLS + cell[:, 0]
    count = np.bincount(key, minlength=CELLS**2).reshape(CELLS, CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(key, residual, CELLS**2).reshape(CELLS, CELLS) / count
        rms = np.sqrt(np.bincount(key, residual**2, CELLS**2).reshape(CELLS, CELLS) / count)
    rows = [[[None if np.isnan(v) else round(float(v), 4) for v in row] for row in values] for values in (mean, rms)]
    return rows[0], rows[1], count.tolist()


def _scale(
    parts: Sequence[tuple[IntArray, _Matches]], board: Board, calibration: Calibration, first: str, second: str
) -> tuple[float, float]:
    """The board's size as two devices measure it, as a share of it less 1, and the deviation of that."""
    devices = devices_of(calibration)
    one, other = devices[first], devices[second]

    def share(one: Pinhole, other: Pinhole) -> tuple[float, float]:
        """The scale less 1, and its variance from what is left over."""
        total, weight, left = 0.0, 0.0, 0.0
        for number, found in parts:
            scale, extent, rest = _similarity(_spare(one, other, found).points_mm, board.points_mm[number])
            total, weight, left = total + extent * (scale - 1), weight + extent, left + rest
        count = sum(len(number) for number, _ in parts)
        return total / weight, left / (3 * count - 7 * len(parts)) / weight

    value, noise = share(one, other)
    slopes = _slopes(lambda a, b: share(a, b)[0], one, other)
    variance = noise + float(slopes @ covariance_of(calibration, first, second) @ slopes)
    return value, float(np.sqrt(variance))


def _similarity(found_mm: FloatArray, true_mm: FloatArray) -> tuple[float, float, float]:
    """Scale from true to found points (Umeyama 1991), the true ones' sum of squares, and that of what is left."""
    found, true = found_mm - found_mm.mean(axis=0), true_mm - true_mm.mean(axis=0)
    u, values, vt = np.linalg.svd(found.T @ true)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    extent = float((true**2).sum())
    scale = float((values * sign).sum()) / extent
    left = found - scale * true @ ((u * sign) @ vt).T
    return scale, extent, float((left**2).sum())
