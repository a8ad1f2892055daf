"""Does the calibration still hold? The spare equation of every pair of devices, and the size of the board as measured.

Both need no knowledge of where the board is. The spare equation needs none of the board at all; the size tells what no
epipolar line can: how far apart the devices are, and how strongly they magnify.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from slrig.calibration.board import Board
from slrig.calibration.health.devices import block
from slrig.calibration.health.rays import Spare, rays, spare_equation, stepped
from slrig.calibration.observations import COLUMN, ROW, Correspondences, PoseObservation
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose
from slrig.model import Calibration, FloatArray, IntArray, Pinhole, Size

_OUTLYING = 6.0
_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_FOR_SHARE = 160  # points that the calibration's share is evaluated at
_FEWEST = 12


@dataclass(frozen=True, slots=True)
class PairResidual:
    """The spare equation of two devices: px of `second`'s image, positive to one side of the epipolar lines throughout.

    outlying : points further than 6 robust standard deviations from the median; in no other figure. noise_px : rms that
    the stated noise predicts. calibration_px : rms that the calibration's covariance predicts; mean_sigma_px : standard
    deviation of the mean from both. Maps are over the image of `first`, (6, 6), NaN where nothing was seen.
    """

    first: str
    second: str
    count: int
    outlying: int
    mean_px: float
    rms_px: float
    noise_px: float
    calibration_px: float
    mean_sigma_px: float
    map_mean_px: FloatArray
    map_rms_px: FloatArray
    map_count: IntArray


@dataclass(frozen=True, slots=True)
class BoardScale:
    """How much larger the board measures than it is.

    share : the measured board over the true one, less 1; error_mm : over its diagonal; sigma_share : standard deviation
    of share from noise and the calibration's covariance.
    """

    first: str
    second: str
    corners: int
    share: float
    sigma_share: float
    error_mm: float


@dataclass(frozen=True, slots=True)
class Matches:
    """Points that two devices both measured: (n, 2) pixels each, and (n, 2) standard deviations in the second.

    first_sigma_px : (n,) of the pixel in the first device. start_mm : (n, 3), about where they are.
    """

    first_px: FloatArray
    second_px: FloatArray
    second_sigma_px: FloatArray
    first_sigma_px: FloatArray
    start_mm: FloatArray


def pair_residuals(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[PairResidual, ...]:
    """The spare equation of each camera with the projector, and of each two cameras, over all poses.

    standing : where the board stands in each pose, as `slrig.calibration.health.equations` finds it.
    """
    found = []
    for first, second in _pairs(calibration):
        parts = [_matches(pose, board, calibration, standing[pose.name], first, second) for pose in poses]
        kept = [part for part in parts if part is not None]
        if kept:
            found.append(_in_figures(_joined(kept), calibration, first, second))
    return tuple(found)


def board_scales(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[BoardScale, ...]:
    """The size of the board as each pair of devices measures it, the surest first; too few corners, no size."""
    found = []
    for first, second in _pairs(calibration):
        parts = []
        for pose in poses:
            corners = _corner_matches(pose, board, standing[pose.name], first, second)
            if corners is not None:
                parts.append(corners)
        if parts:
            found.append(_scale(parts, board, calibration, first, second))
    return tuple(sorted(found, key=lambda each: each.sigma_share))


def _pairs(calibration: Calibration) -> list[tuple[str, str]]:
    cameras = list(calibration.cameras)
    lit = [(name, PROJECTOR) for name in cameras] if calibration.projector is not None else []
    return [*lit, *combinations(cameras, 2)]


def _device(calibration: Calibration, name: str) -> Pinhole:
    device = calibration.projector if name == PROJECTOR else calibration.cameras[name]
    if device is None:
        raise ValueError(name)
    return device


def _placed(board: Board, pose: BoardPose) -> FloatArray:
    return np.asarray(board.points_mm @ pose.rotation.T + pose.translation_mm)


def _on_board(device: Pinhole, pixels_px: FloatArray, pose: BoardPose) -> FloatArray:
    """(n, 3): where the pixels' rays meet the board's plane."""
    ahead, normal = rays(device, pixels_px), pose.rotation[:, 2]
    depth = ((pose.translation_mm - device.centre_mm) @ normal) / (ahead @ normal)
    return np.asarray(device.centre_mm + depth[:, None] * ahead)


def _matches(
    pose: PoseObservation, board: Board, calibration: Calibration, stands: BoardPose, first: str, second: str
) -> Matches | None:
    if second != PROJECTOR:
        corners = _corner_matches(pose, board, stands, first, second)
        return None if corners is None else corners[1]
    light = pose.correspondences.get(first)
    if light is None:
        return None
    pixels, position, sigma = both_axes(light)
    if len(pixels) < _FEWEST:
        return None
    start = _on_board(_device(calibration, first), pixels, stands)
    return Matches(pixels, position, sigma, np.zeros(len(pixels)), start)


def both_axes(light: Correspondences, /) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2) of which both projector coordinates are known, those (n, 2), and their deviations (n, 2)."""
    column, row = np.flatnonzero(light.axis == COLUMN), np.flatnonzero(light.axis == ROW)
    keys = [np.round(light.pixels_px[rows] * 8).astype(np.int64) @ (1 << 24, 1) for rows in (column, row)]
    _, mine, theirs = np.intersect1d(keys[0], keys[1], return_indices=True)
    column, row = column[mine], row[theirs]
    return (
        light.pixels_px[column],
        np.column_stack([light.position_px[column], light.position_px[row]]),
        np.column_stack([light.sigma_px[column], light.sigma_px[row]]),
    )


def _corner_matches(
    pose: PoseObservation, board: Board, stands: BoardPose, first: str, second: str
) -> tuple[IntArray, Matches] | None:
    """The corners that both measure: in the projector's picture by the light around them."""
    view = pose.views.get(first)
    if view is None:
        return None
    if second == PROJECTOR:
        light = pose.correspondences.get(first)
        if light is None:
            return None
        at, sigma = _light_at(view.points_px, light, _reach_px(view.points_px, view.corner, board))
        good = np.isfinite(at).all(axis=1)
        number, place, own = view.corner[good], view.points_px[good], view.sigma_px[good]
        at, sigma = at[good], sigma[good]
    else:
        other = pose.views.get(second)
        if other is None:
            return None
        number, mine, theirs = np.intersect1d(view.corner, other.corner, return_indices=True)
        place, at, own = view.points_px[mine], other.points_px[theirs], view.sigma_px[mine]
        sigma = np.repeat(other.sigma_px[theirs][:, None], 2, axis=1)
    if len(number) < _FEWEST:
        return None
    return number, Matches(place, at, sigma, own, _placed(board, stands)[number])


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


def _joined(parts: Sequence[Matches]) -> Matches:
    return Matches(
        np.concatenate([part.first_px for part in parts]),
        np.concatenate([part.second_px for part in parts]),
        np.concatenate([part.second_sigma_px for part in parts]),
        np.concatenate([part.first_sigma_px for part in parts]),
        np.concatenate([part.start_mm for part in parts]),
    )


def _spare(first: Pinhole, second: Pinhole, found: Matches) -> Spare:
    return spare_equation(first, second, found.first_px, found.second_px, found.start_mm)


def _in_figures(found: Matches, calibration: Calibration, first: str, second: str) -> PairResidual:
    one, other = _device(calibration, first), _device(calibration, second)
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
    slopes = _slopes(one, other, _part(found, chosen))
    spread_of = block(calibration, (first, second))
    shares = np.einsum("ni,ij,nj->n", slopes, spread_of, slopes)
    mean = slopes.mean(axis=0)
    mean_variance = float(mean @ spread_of @ mean) + float((sigma[good] ** 2).mean()) / len(kept)
    mean_map, rms_map, count_map = _maps(found.first_px[good], kept, one.size)
    return PairResidual(
        first, second, len(kept), int(len(residual) - len(kept)), float(kept.mean()), float(np.sqrt((kept**2).mean())),
        float(np.sqrt((sigma[good] ** 2).mean())), float(np.sqrt(shares.mean())),
        float(np.sqrt(max(mean_variance, 0.0))),
        mean_map, rms_map, count_map,
    )  # fmt: skip


def _as_seen(one: Pinhole, other: Pinhole, found: Matches, spare: Spare) -> FloatArray:
    """(n,): the deviation of the first device's pixel, px across the line in the second."""
    if not found.first_sigma_px.any():
        return np.zeros(len(found.first_px))
    moves = []
    for axis in np.eye(2):
        moved = Matches(
            found.first_px + 0.1 * axis, found.second_px, found.second_sigma_px, found.first_sigma_px, found.start_mm
        )
        moves.append((_spare(one, other, moved).residual_px - spare.residual_px) / 0.1)
    return np.asarray(found.first_sigma_px * np.hypot(moves[0], moves[1]))


def _part(found: Matches, chosen: IntArray) -> Matches:
    return Matches(
        found.first_px[chosen], found.second_px[chosen], found.second_sigma_px[chosen], found.first_sigma_px[chosen],
        found.start_mm[chosen],
    )  # fmt: skip


def _slopes(one: Pinhole, other: Pinhole, found: Matches) -> FloatArray:
    """(n, 30): derivatives of the spare equation by the parameters of both devices."""
    columns = [
        (_spare(high, other, found).residual_px - _spare(low, other, found).residual_px) / width
        for width, low, high in stepped(one)
    ]
    columns += [
        (_spare(one, high, found).residual_px - _spare(one, low, found).residual_px) / width
        for width, low, high in stepped(other)
    ]
    return np.stack(columns, axis=1)


def _maps(pixels_px: FloatArray, residual: FloatArray, size: Size) -> tuple[FloatArray, FloatArray, IntArray]:
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip(((pixels_px + 0.5) / extent * CELLS).astype(int), 0, CELLS - 1)
    key = cell[:, 1] * CELLS + cell[:, 0]
    count = np.bincount(key, minlength=CELLS**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(key, residual, CELLS**2) / count
        rms = np.sqrt(np.bincount(key, residual**2, CELLS**2) / count)
    shape = (CELLS, CELLS)
    return mean.reshape(shape), rms.reshape(shape), count.reshape(shape).astype(np.int32)


def _scale(
    parts: Sequence[tuple[IntArray, Matches]], board: Board, calibration: Calibration, first: str, second: str
) -> BoardScale:
    one, other = _device(calibration, first), _device(calibration, second)

    def share(one: Pinhole, other: Pinhole) -> tuple[float, float]:
        """The scale less 1, and its variance from what is left over."""
        total, weight, left = 0.0, 0.0, 0.0
        for number, found in parts:
            scale, extent, rest = _similarity(_spare(one, other, found).points_mm, board.points_mm[number])
            total, weight, left = total + extent * (scale - 1), weight + extent, left + rest
        count = sum(len(number) for number, _ in parts)
        return total / weight, left / (3 * count - 7 * len(parts)) / weight

    value, noise = share(one, other)
    slopes = [(share(high, other)[0] - share(low, other)[0]) / width for width, low, high in stepped(one)]
    slopes += [(share(one, high)[0] - share(one, low)[0]) / width for width, low, high in stepped(other)]
    by = np.array(slopes)
    variance = noise + float(by @ block(calibration, (first, second)) @ by)
    diagonal = float(np.linalg.norm(np.ptp(board.points_mm, axis=0)))
    corners = sum(len(number) for number, _ in parts)
    return BoardScale(first, second, corners, value, float(np.sqrt(variance)), value * diagonal)


def _similarity(found_mm: FloatArray, true_mm: FloatArray) -> tuple[float, float, float]:
    """Scale from true to found points (Umeyama 1991), the true ones' sum of squares, and that of what is left."""
    found, true = found_mm - found_mm.mean(axis=0), true_mm - true_mm.mean(axis=0)
    u, values, vt = np.linalg.svd(found.T @ true)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    extent = float((true**2).sum())
    scale = float((values * sign).sum()) / extent
    left = found - scale * true @ ((u * sign) @ vt).T
    return scale, extent, float((left**2).sum())
