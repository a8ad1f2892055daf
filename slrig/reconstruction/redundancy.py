"""Redundant equations of cameras that see the same light sheets, as a test of the calibration.

A point that one camera and the projector measure has a projection in every other camera, which sees the same stripe:
the distance across that stripe is a redundant equation, px. Its standard deviation is stated by the noise of both
stripes and by the covariance of the calibration. Cameras contradict each other where the distances, as medians of
small areas, exceed the stated deviations: noise has no median, whether its size is stated correctly or not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import DEVICE_PARAMETERS, Axis, Calibration, FloatArray, IntArray, Pinhole, Refusal, Size, Source
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.merging import sort_by_row
from slrig.reconstruction.triangulation import SheetCurves, intersect_light_sheets, project

MAP_CELLS = 6  # along each side of the map, as for residuals of a calibration
MIN_PAIRS = 20  # the mean of a cell is then known to a quarter of the scatter
_CELL_PX, _WIDEST_CELL_PX = 16.0, 256.0  # projector pixels, along each side of a cell with one median
_STEPS = 256  # segments to search for the foot of a perpendicular: as many as a turn by 3° displaces a stripe
_TANGENT_REACH = 2  # points either way, for the direction of a stripe
OUTLIER_SIGMA = 12.0  # robust standard deviations, as for merging: further points are of different surfaces
DEVIATIONS_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MOST_NOISE_PX = 0.5  # no stripe is located worse; distances that scatter more are not noise
_SAMPLE = 500  # equations for the part of the calibration, which varies slowly over the image
_STEP_SIGMAS = 0.1  # of each parameter, for derivatives

MIN_POINTS = 100
"""Common points of two cameras; fewer hardly show the same surface."""

MAX_OVER_SIGMA = 3.0
"""Cameras contradict each other beyond this: the stated deviations do not explain the distances."""


@dataclass(frozen=True, slots=True)
class StripeResiduals:
    """Redundant equation of each point of one camera whose column another camera sees, too.

    residual_px : (m,) float64, distance across the stripe in the other camera, px, from the projection of the point to
    that stripe, positive towards higher projector positions. sigma_px : (m,) float64, its standard deviation by the
    stated deviations of both stripes. pixels_px : (m, 2) float64, (x, y) of the point in this camera. sheet_px : (m, 2)
    float64, position of its light sheet and coordinate along it, in the projector. index : (m,) int, the point in its
    `SheetCurves`. normals : (m, 2) float64, unit, direction of the residual in the other image.
    """

    residual_px: FloatArray
    sigma_px: FloatArray
    pixels_px: FloatArray
    sheet_px: FloatArray
    index: NDArray[np.intp]
    normals: FloatArray


@dataclass(frozen=True, slots=True)
class PairRedundancy:
    """Statistics of the redundant equations of two cameras, px of the image of `camera`; the map covers that of
    `reference`.

    Points further than 12 robust standard deviations from the median are of different surfaces: they count in
    `outlying` only. stated_rms_px : rms to expect from the stated deviations with a perfect calibration. map_mean_px,
    map_rms_px : (6, 6) float64, NaN where fewer than 20 pairs are; map_pairs : (6, 6) int32. residuals : the equations
    of all points. calibration_px : median standard deviation of an equation by the stated covariance of the
    calibration, 0 without one. over_stated : robust standard deviation of all equations, as a multiple of the deviation
    that noise and calibration state. contradiction : the same of the medians of small cells of the projector's image,
    as a multiple of the larger of the stated deviation and the scatter about the medians, at most 0.5 px; 0 for fewer
    than 100 points.
    """

    reference: str
    camera: str
    pairs: int
    outlying: int
    mean_px: float
    rms_px: float
    median_absolute_px: float
    stated_rms_px: float
    map_mean_px: FloatArray
    map_rms_px: FloatArray
    map_pairs: IntArray
    residuals: StripeResiduals
    calibration_px: float
    over_stated: float
    contradiction: float

    @property
    def is_contradicted(self) -> bool:
        """True if the calibration does not explain the measurements of the two cameras."""
        return self.contradiction > MAX_OVER_SIGMA


@dataclass(frozen=True, slots=True)
class Redundancy:
    """Redundancy of every pair of cameras, or the reason why there is none."""

    pairs: tuple[PairRedundancy, ...]
    reason: str | None


def evaluate_redundancy(
    parts: list[SheetCurves],
    devices: Mapping[str, Pinhole],
    axis: Axis,
    /,
    *,
    widest_gap_px: float,
    calibration: Calibration | None = None,
) -> Redundancy:
    """Evaluate the redundant equations of every pair of cameras.

    parts : curves of each camera with the projector's light sheets, before merging, in the order of `devices`; axis :
    axis that numbers the sheets; widest_gap_px : as for `merge_curves`. calibration : states the error of the devices.
    """
    if len(devices) < 2:
        return Redundancy((), "one camera and one axis of patterns give three equations for three unknowns")
    if any((part.source == Source.CAMERA_CAMERA).any() for part in parts):
        reason = (
            "the projector is not calibrated: the stripe and the epipolar plane of the second camera are both needed "
            "for the depth"
        )
        return Redundancy((), reason)
    found = []
    names = list(devices)
    for first, second in combinations(range(len(parts)), 2):
        a, b = names[first], names[second]
        residuals = stripe_residuals(parts[first], parts[second], devices[b], axis, widest_gap_px=widest_gap_px)
        if len(residuals.residual_px):
            error_px = 0.0 if calibration is None else _calibration_px(parts[first], residuals, calibration, a, b, axis)
            found.append(summarise_pair(residuals, a, b, devices[a].size, calibration_px=error_px))
    return Redundancy(tuple(found), None if found else "the cameras share no point of any light sheet")


def stripe_residuals(
    first: SheetCurves, second: SheetCurves, other: Pinhole, axis: Axis, /, *, widest_gap_px: float
) -> StripeResiduals:
    """Project the points of `first` into the camera `other`, and measure the distance to its own stripes `second`.

    A point belongs to the stretch of the same column with its projector row, since a row meets one surface point. From
    there the foot of the perpendicular is searched along the stripe, so a wrong pose of `other` displaces no
    measurement. Points at a gap or bridge of the other curve have no partner.
    """
    first, order = sort_by_row(first)
    second, _ = sort_by_row(second)
    _, own_index, other_index = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    expected = project(other, first.points_mm)
    # Displacements by one standard deviation in the image of the other camera.
    own_shift = project(other, first.points_mm + first.deviation_mm) - expected
    other_shift = project(other, second.points_mm + second.deviation_mm) - project(other, second.points_mm)
    residual, sigma = (np.full(len(expected), np.nan) for _ in range(2))
    normals = np.zeros((len(expected), 2))
    in_bands(
        _residual_kernel, len(own_index), own_index, first.offsets, first.along_px, expected, own_shift,
        other_index, second.offsets, second.along_px, second.pixels_px, other_shift, second.bridge_after, widest_gap_px,
        residual, sigma, normals,
    )  # fmt: skip
    has_partner = np.flatnonzero(np.isfinite(residual))
    # Along rising rows, higher columns are on one side; along rising columns, higher rows on the other.
    side = 1.0 if axis is Axis.COLUMN else -1.0
    return StripeResiduals(
        residual_px=side * residual[has_partner],
        sigma_px=sigma[has_partner],
        pixels_px=first.pixels_px[has_partner],
        sheet_px=np.stack(
            [first.position_px[first.curve_of_point()[has_partner]], first.along_px[has_partner]], axis=1
        ),
        index=order[has_partner],
        normals=side * normals[has_partner],
    )


def sheet_coordinates(curves: SheetCurves) -> FloatArray:
    """(n, 2) float64: position of the light sheet of each point and its coordinate along the sheet, projector px."""
    return np.stack([np.repeat(curves.position_px, np.diff(curves.offsets)), curves.along_px], axis=1)


def summarise_pair(
    residuals: StripeResiduals, reference: str, camera: str, size: Size, /, *, calibration_px: float = 0.0
) -> PairRedundancy:
    """Statistics of one pair; `size` is that of the reference camera's image. At least one point is needed."""
    residual = residuals.residual_px
    centre = np.median(residual)
    spread = DEVIATIONS_PER_MEDIAN * max(np.median(np.abs(residual - centre)), np.median(residuals.sigma_px))
    is_inlier = np.abs(residual - centre) <= OUTLIER_SIGMA * spread
    inliers, pixels = residual[is_inlier], residuals.pixels_px[is_inlier]
    cell = _map_index(pixels[:, 1], size.height_px) * MAP_CELLS + _map_index(pixels[:, 0], size.width_px)
    count = np.bincount(cell, minlength=MAP_CELLS * MAP_CELLS)
    enough = count >= MIN_PAIRS
    sums = [np.bincount(cell, weights=values, minlength=MAP_CELLS * MAP_CELLS) for values in (inliers, inliers**2)]
    mean, square = (
        np.where(enough, total / np.maximum(count, 1), np.nan).reshape(MAP_CELLS, MAP_CELLS) for total in sums
    )
    stated_px = np.hypot(residuals.sigma_px, calibration_px)
    return PairRedundancy(
        reference=reference,
        camera=camera,
        pairs=len(inliers),
        outlying=len(residual) - len(inliers),
        mean_px=float(inliers.mean()),
        rms_px=float(np.sqrt((inliers**2).mean())),
        median_absolute_px=float(np.median(np.abs(inliers))),
        stated_rms_px=float(np.sqrt((residuals.sigma_px[is_inlier] ** 2).mean())),
        map_mean_px=mean,
        map_rms_px=np.sqrt(square),
        map_pairs=count.reshape(MAP_CELLS, MAP_CELLS).astype(np.int32),
        residuals=residuals,
        calibration_px=calibration_px,
        over_stated=_robust_ratio(residual, stated_px),
        contradiction=_contradiction(residuals, stated_px),
    )


def _robust_ratio(values: FloatArray, sigma: FloatArray) -> float:
    """Robust standard deviation of values about 0, as a multiple of their stated ones; 0 for fewer than 100 of them."""
    stated = sigma > 0
    if np.count_nonzero(stated) < MIN_POINTS:
        return 0.0
    return DEVIATIONS_PER_MEDIAN * float(np.median(np.abs(values[stated]) / sigma[stated]))


def _contradiction(residuals: StripeResiduals, stated_px: FloatArray) -> float:
    median, _ = cell_medians(residuals)
    known = np.isfinite(median)
    if not known.any():
        return 0.0
    return _robust_ratio(median[known], noise_px(residuals, median, stated_px)[known])


def noise_px(residuals: StripeResiduals, median: FloatArray, stated_px: FloatArray) -> FloatArray:
    """(m,) float64: the larger of each equation's stated deviation and their scatter about the medians of cells."""
    scatter = np.abs(residuals.residual_px - median)
    scatter = scatter[np.isfinite(scatter)]
    if len(scatter) == 0:
        return stated_px
    return np.maximum(stated_px, min(DEVIATIONS_PER_MEDIAN * float(np.median(scatter)), _MOST_NOISE_PX))


def cell_numbers(sheet_px: FloatArray, size_px: float) -> NDArray[np.int64]:
    """(m, 2) int64: square cell of the projector's image that each point lies in."""
    return np.asarray(np.floor(sheet_px / size_px), dtype=np.int64)


def cell_medians(residuals: StripeResiduals) -> tuple[FloatArray, float]:
    """Median of the residuals in the cell of each point, (m,) float64, px, NaN for fewer than 20 points; and the size
    of the cells, px: 16, or so much more that most points have a median.
    """
    size_px = _CELL_PX
    medians = _medians(residuals, size_px)
    while size_px < _WIDEST_CELL_PX and np.count_nonzero(np.isfinite(medians)) < len(medians) / 2:
        size_px *= 2
        medians = _medians(residuals, size_px)
    return medians, size_px


def _medians(residuals: StripeResiduals, size_px: float) -> FloatArray:
    medians = np.full(len(residuals.residual_px), np.nan)
    if len(medians) == 0:
        return medians
    cells = cell_numbers(residuals.sheet_px, size_px)
    cells -= cells.min(axis=0)
    number = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    order = np.lexsort((residuals.residual_px, number))
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    middle = np.where(counts >= MIN_PAIRS, residuals.residual_px[order[starts + counts // 2]], np.nan)
    medians[order] = np.repeat(middle, counts)
    return medians


class PairEquations(NamedTuple):
    """Redundant equations of points of one camera in another one, as functions of the devices.

    offsets, position_px, pixels_px : curves of the points, as in `StripeEnsemble`. normals : (m, 2), as in
    `StripeResiduals`. feet_px : (m,), coordinate of the other camera's stripe along its normal. sigma_px : (m,).
    """

    offsets: IntArray
    position_px: FloatArray
    pixels_px: FloatArray
    normals: FloatArray
    feet_px: FloatArray
    sigma_px: FloatArray

    def residual_px(self, axis: Axis, first: Pinhole, second: Pinhole, projector: Pinhole) -> FloatArray:
        """(m,) float64: distances across the stripes in `second` of points that `first` and the projector measure; NaN
        for points that the devices do not see.
        """
        count = len(self.feet_px)
        points, _, _, cause = intersect_light_sheets(
            StripeEnsemble(
                self.offsets, self.position_px, self.pixels_px, np.zeros((count, 2)), np.zeros(count),
                np.zeros(count, dtype=np.int32), np.zeros(count, dtype=np.bool_),
            ),
            first, projector, axis,
        )  # fmt: skip
        distance = self.feet_px - np.einsum("ij,ij->i", self.normals, project(second, points))
        return np.where(cause == Refusal.NONE, distance, np.nan)


def pair_equations(
    first: SheetCurves, residuals: StripeResiduals, second: Pinhole, /, *, at_most: int
) -> PairEquations:
    """The equations of evenly chosen points of `first`, whose residuals in the camera `second` were measured."""
    count = len(residuals.residual_px)
    chosen = np.arange(0, count, max(1, -(-count // at_most)))
    chosen = chosen[np.argsort(residuals.index[chosen])]
    index = residuals.index[chosen]
    curves, starts = np.unique(first.curve_of_point()[index], return_index=True)
    normals = residuals.normals[chosen]
    projected = np.einsum("ij,ij->i", normals, project(second, first.points_mm[index]))
    return PairEquations(
        offsets=np.append(starts, len(index)).astype(np.int32),
        position_px=first.position_px[curves],
        pixels_px=np.ascontiguousarray(first.pixels_px[index]),
        normals=normals,
        feet_px=residuals.residual_px[chosen] + projected,
        sigma_px=residuals.sigma_px[chosen],
    )


def _calibration_px(
    first: SheetCurves, residuals: StripeResiduals, calibration: Calibration, a: str, b: str, axis: Axis
) -> float:
    """Median standard deviation of an equation by the stated covariance C of the calibration: √(J C Jᵀ)."""
    solved, projector = calibration.solved, calibration.projector
    if solved is None or projector is None:
        return 0.0
    names = list(calibration.cameras)
    devices = [calibration.cameras[a], calibration.cameras[b], projector]
    equations = pair_equations(first, residuals, devices[1], at_most=_SAMPLE)
    start = equations.residual_px(axis, *devices)
    places = np.concatenate([np.arange(DEVICE_PARAMETERS) + DEVICE_PARAMETERS * k
                             for k in (names.index(a), names.index(b), len(names))])  # fmt: skip
    covariance = solved.covariance[np.ix_(places, places)]
    steps = _STEP_SIGMAS * np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    slopes = np.zeros((len(start), len(steps)))
    for number in np.flatnonzero(steps):
        which, parameter = divmod(int(number), DEVICE_PARAMETERS)
        changed = [*devices]
        changed[which] = _with_parameter(devices[which], parameter, float(steps[number]))
        slopes[:, number] = (equations.residual_px(axis, *changed) - start) / steps[number]
    variance = np.einsum("ij,jk,ik->i", slopes, covariance, slopes)
    variance = variance[np.isfinite(variance)]
    return float(np.sqrt(max(np.median(variance), 0.0))) if len(variance) else 0.0


def _with_parameter(device: Pinhole, parameter: int, step: float) -> Pinhole:
    """The device with one of the parameters of `SolveRecord.covariance` increased."""
    matrix, distortion = device.matrix.copy(), device.distortion.copy()
    turn, shift = np.zeros(3), np.zeros(3)
    if parameter < 4:
        matrix[((0, 0), (1, 1), (0, 2), (1, 2))[parameter]] += step
    elif parameter < 9:
        distortion[parameter - 4] += step
    elif parameter < 12:
        turn[parameter - 9] = step
    else:
        shift[parameter - 12] = step
    rotation = np.asarray(cv2.Rodrigues(turn)[0]) @ device.rotation
    return Pinhole(device.size, matrix, distortion, rotation, device.translation_mm + shift)


def _map_index(coordinate_px: FloatArray, extent_px: int) -> NDArray[np.int64]:
    """(n,) int64: index of the map cell of each coordinate."""
    return np.clip((coordinate_px + 0.5) * MAP_CELLS // extent_px, 0, MAP_CELLS - 1).astype(np.int64)


@kernel(in_every_scan=False)
def _residual_kernel(
    first: int, last: int, own_index: Any, a: Any, along: Any, expected: Any, own_shift: Any,
    other_index: Any, b: Any, along2: Any, pixels2: Any, other_shift: Any, bridge2: Any, widest: float,
    residual: Any, sigma: Any, normals: Any,
) -> None:  # fmt: skip
    for pair in range(first, last):
        low, high = b[other_index[pair]], b[other_index[pair] + 1]
        row = low
        for i in range(a[own_index[pair]], a[own_index[pair] + 1]):
            while row < high - 1 and along2[row + 1] < along[i]:
                row += 1
            if row >= high - 1 or along2[row] > along[i] or not _is_joined(row, along2, bridge2, widest):
                continue
            k, share = _foot(expected[i], row, low, high, along2, pixels2, bridge2, widest)
            if k < 0:
                continue
            before = after = k
            for _ in range(_TANGENT_REACH):
                if before > low and _is_joined(before - 1, along2, bridge2, widest):
                    before -= 1
                if after + 2 < high and _is_joined(after + 1, along2, bridge2, widest):
                    after += 1
            tx, ty = pixels2[after + 1, 0] - pixels2[before, 0], pixels2[after + 1, 1] - pixels2[before, 1]
            length = np.sqrt(tx * tx + ty * ty)
            if length == 0:
                continue
            nx, ny = ty / length, -tx / length
            x = pixels2[k, 0] + share * (pixels2[k + 1, 0] - pixels2[k, 0])
            y = pixels2[k, 1] + share * (pixels2[k + 1, 1] - pixels2[k, 1])
            normals[i, 0], normals[i, 1] = nx, ny
            residual[i] = nx * (x - expected[i, 0]) + ny * (y - expected[i, 1])
            # Neighbours along a stripe share most of their light, so their errors are taken as one.
            other_sigma = (1 - share) * abs(nx * other_shift[k, 0] + ny * other_shift[k, 1])
            other_sigma += share * abs(nx * other_shift[k + 1, 0] + ny * other_shift[k + 1, 1])
            sigma[i] = np.hypot(nx * own_shift[i, 0] + ny * own_shift[i, 1], other_sigma)


@kernel_part(inline="always")
def _is_joined(k: int, along: Any, bridge: Any, widest: float) -> bool:
    """True if the step from point k to the next one is measured curve."""
    return not bridge[k] and along[k + 1] - along[k] <= widest


@kernel_part
def _foot(point: Any, start: int, low: int, high: int, along: Any, pixels: Any, bridge: Any, widest: float) -> Any:
    """Segment of a curve with the foot of the perpendicular from a point, and the fraction of the segment before it.

    The search goes one way from segment `start`; the segment is -1 if the curve ends before the foot.
    """
    k = start
    way = 0
    for _ in range(_STEPS):
        dx, dy = pixels[k + 1, 0] - pixels[k, 0], pixels[k + 1, 1] - pixels[k, 1]
        square = dx * dx + dy * dy
        share = 0.5
        if square > 0:
            share = ((point[0] - pixels[k, 0]) * dx + (point[1] - pixels[k, 1]) * dy) / square
        turn = -1 if share < 0 else 1 if share > 1 else 0
        if turn == 0 or turn == -way:
            # At a corner the foot is the point between the two segments.
            return k, min(max(share, 0.0), 1.0)
        way = turn
        k += turn
        if k < low or k + 1 >= high or not _is_joined(k, along, bridge, widest):
            return -1, 0.0
    return -1, 0.0
