"""Merging of curves from several cameras, their redundancy, and their disagreement.

A projector ray meets one surface point, so on a light sheet depth is a function of the projector row. Curves of one
position from two cameras sample the same function, and are merged by row. Where both have it, the point is the mean
weighted by inverse variance, and their distance, in standard deviations and in pixels, checks the calibration. Where
only one has it, it fills the gap. The result is never two sheets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, FloatArray, IntArray, Pinhole, Size, Source
from slrig.reconstruction.triangulation import SheetCurves, project

_ALL = int(Source.ALL)
_SAME_POINT_SIGMA = 12.0  # beyond this the cameras saw different surfaces, which must not be averaged

MAP_CELLS = 6  # along each side of the map, as for residuals of a calibration
MIN_PAIRS = 20  # the mean of a cell is then known to a quarter of the scatter
_STEPS = 32  # segments to search for the foot of a perpendicular
_TANGENT_REACH = 2  # points either way, for the direction of a stripe
_OUTLIER_SIGMA = 12.0  # robust standard deviations, as for merging: further points are of different surfaces
DEVIATIONS_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation

MIN_POINTS = 100
"""Common points of two cameras; fewer hardly show the same surface."""

MAX_OVER_SIGMA = 3.0
"""Beyond this the stated deviations do not explain the distances."""


@dataclass(frozen=True, slots=True)
class MergedCurves:
    """Curves of all cameras, and the distances between them.

    camera : (n,) int32, index of the camera whose pixel the point has. residual_sigma : (m,) float64, distance between
    the points of two cameras on one ray over its standard deviation. residual_mm : (m,) float64, the same distance,
    signed towards the first camera.
    """

    curves: SheetCurves
    camera: NDArray[np.int32]
    residual_sigma: FloatArray
    residual_mm: FloatArray


def merge_curves(parts: list[SheetCurves], centre_mm: FloatArray, /, *, widest_gap_px: float) -> MergedCurves:
    """Merge the curves of several cameras along each light sheet.

    centre_mm : (3,) float64, the projector's centre; widest_gap_px : rows between two consecutive points of one camera
    up to which the curve between them counts as measured.
    """
    result, camera = parts[0], np.zeros(len(parts[0].points_mm), dtype=np.int32)
    sigmas, distances = [], []
    for index, part in enumerate(parts[1:], start=1):
        result, camera, sigma, distance = _merge_pair(result, camera, part, index, centre_mm, widest_gap_px)
        sigmas.append(sigma)
        distances.append(distance)
    return MergedCurves(
        result, camera, np.concatenate([np.zeros(0), *sigmas]), np.concatenate([np.zeros(0), *distances])
    )


def _merge_pair(
    first: SheetCurves,
    camera: NDArray[np.int32],
    second: SheetCurves,
    index: int,
    centre_mm: FloatArray,
    widest_gap_px: float,
) -> tuple[SheetCurves, NDArray[np.int32], FloatArray, FloatArray]:
    first, order_first = sort_by_row(first)
    second, _ = sort_by_row(second)
    camera = camera[order_first]
    offset = int(first.stripe.max(initial=-1)) + 1
    positions = np.union1d(first.position_px, second.position_px)
    a, b = _common_offsets(first, positions), _common_offsets(second, positions)
    fused, deviation, source, sigma, distance = _fuse_kernel(
        a, first.points_mm, first.deviation_mm, first.along_px, first.source,
        b, second.points_mm, second.deviation_mm, second.along_px, second.bridge_after, centre_mm, widest_gap_px,
    )  # fmt: skip
    unmatched = _unmatched_kernel(a, first.along_px, first.bridge_after, b, second.along_px, widest_gap_px)
    # Concatenate, then sort each sheet by row. The sort is stable, so for equal rows the first camera comes first.
    curve = np.concatenate([np.repeat(np.arange(len(positions)), np.diff(a)),
                            np.repeat(np.arange(len(positions)), np.diff(b))[unmatched]])  # fmt: skip
    along = np.concatenate([first.along_px, second.along_px[unmatched]])
    order = np.lexsort((along, curve))
    bridge = np.concatenate([first.bridge_after, second.bridge_after[unmatched]])[order]
    along = along[order]
    stripe = np.concatenate([first.stripe, second.stripe[unmatched] + offset])[order]
    # A step joins two stripes when they differ. A hole that the other camera filled is not a bridge.
    joins = bridge | np.append(stripe[1:] != stripe[:-1], False)
    within = np.append(np.diff(curve[order]) == 0, False)
    is_gap = np.append(np.diff(along), 0.0) > widest_gap_px
    result = SheetCurves(
        offsets=np.searchsorted(curve[order], np.arange(len(positions) + 1)).astype(np.int32),
        position_px=positions,
        points_mm=np.concatenate([fused, second.points_mm[unmatched]])[order],
        deviation_mm=np.concatenate([deviation, second.deviation_mm[unmatched]])[order],
        along_px=along,
        pixels_px=np.concatenate([first.pixels_px, second.pixels_px[unmatched]])[order],
        stripe=stripe,
        bridge_after=joins & within & is_gap,
        source=np.concatenate([source, second.source[unmatched]])[order],
    )
    cameras = np.concatenate([camera, np.full(int(unmatched.sum()), index, dtype=np.int32)])[order]
    has_partner = np.isfinite(sigma)
    return result, cameras.astype(np.int32), sigma[has_partner], distance[has_partner]


def sort_by_row(curves: SheetCurves, /) -> tuple[SheetCurves, NDArray[np.intp]]:
    """Return the curves with the points of each by rising `along_px`, and the order of the points."""
    order = np.lexsort((curves.along_px, curves.curve_of_point()))
    return curves.take(order, offsets=curves.offsets, bridge_after=curves.bridge_after[order]), order


def _common_offsets(curves: SheetCurves, positions: FloatArray) -> NDArray[np.int32]:
    counts = np.zeros(len(positions), dtype=np.int64)
    counts[np.searchsorted(positions, curves.position_px)] = np.diff(curves.offsets)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


@kernel(in_every_scan=False)
def _fuse_kernel(
    a: Any, points: Any, deviation: Any, along: Any, source: Any,
    b: Any, points2: Any, deviation2: Any, along2: Any, bridge2: Any, centre: Any, widest: float,
) -> Any:  # fmt: skip
    count = len(points)
    fused = points.copy()
    spread = deviation.copy()
    kind = source.copy()
    sigma = np.full(count, np.nan)
    distance = np.full(count, np.nan)
    ray = np.zeros(3)
    for curve in range(len(a) - 1):
        k = b[curve]
        last = b[curve + 1] - 1
        for i in range(a[curve], a[curve + 1]):
            while k < last and along2[k + 1] < along[i]:
                k += 1
            if k >= last or along2[k] > along[i] or along2[k + 1] - along2[k] > widest or bridge2[k]:
                continue
            share = (along[i] - along2[k]) / (along2[k + 1] - along2[k])
            norm = 0.0
            for c in range(3):
                ray[c] = points[i, c] - centre[c]
                norm += ray[c] * ray[c]
            norm = np.sqrt(norm)
            # At a given row errors act along the projector ray: a point displaced in the sheet slides along its curve
            # until the row is right again. So each deviation counts with its part along the ray, corrected by the slope
            # of the curve in that direction.
            e1 = _along_ray(points, deviation, i, a[curve], a[curve + 1], ray, norm)
            e2 = _along_ray(points2, deviation2, k, b[curve], b[curve + 1], ray, norm)
            gap = 0.0
            for c in range(3):
                other = points2[k, c] + share * (points2[k + 1, c] - points2[k, c])
                gap += (other - points[i, c]) * ray[c] / norm
            if e1 <= 0 or e2 <= 0:
                continue
            sigma[i] = gap / np.sqrt(e1 * e1 + e2 * e2)
            distance[i] = gap
            if abs(sigma[i]) > _SAME_POINT_SIGMA:
                continue
            weight = e1 * e1 / (e1 * e1 + e2 * e2)
            for c in range(3):
                fused[i, c] = points[i, c] + weight * gap * ray[c] / norm
                spread[i, c] = ray[c] / norm * e1 * e2 / np.sqrt(e1 * e1 + e2 * e2)
            kind[i] = _ALL
    return fused, spread, kind, sigma, distance


@kernel_part
def _along_ray(points: Any, deviation: Any, i: int, first: int, end: int, ray: Any, norm: float) -> float:
    """Standard deviation of the depth at a fixed row: the deviation along the ray, less its slide along the curve."""
    before, after = max(first, i - 2), min(end - 1, i + 2)
    tangent = np.zeros(3)
    length = 0.0
    for c in range(3):
        tangent[c] = points[after, c] - points[before, c]
        length += tangent[c] * tangent[c]
    if length <= 0:
        return 0.0
    # Solve deviation = depth · r̂ + slide · tangent in the sheet (two unknowns, three equations).
    rr = tt = rt = rd = td = 0.0
    for c in range(3):
        r = ray[c] / norm
        rr += r * r
        tt += tangent[c] * tangent[c]
        rt += r * tangent[c]
        rd += r * deviation[i, c]
        td += tangent[c] * deviation[i, c]
    det = rr * tt - rt * rt
    if det <= 1e-12 * rr * tt:
        return 0.0
    return float(abs((tt * rd - rt * td) / det))


@kernel(in_every_scan=False)
def _unmatched_kernel(a: Any, along: Any, bridge: Any, b: Any, along2: Any, widest: float) -> Any:
    """Points of the second camera outside the stretches of the first."""
    unmatched = np.ones(len(along2), dtype=np.bool_)
    for curve in range(len(a) - 1):
        k = a[curve]
        last = a[curve + 1] - 1
        for i in range(b[curve], b[curve + 1]):
            while k < last and along[k + 1] < along2[i]:
                k += 1
            if k > last:
                continue
            inside = along[k] <= along2[i] and k < last and along[k + 1] - along[k] <= widest and not bridge[k]
            touching = abs(along[k] - along2[i]) < 0.5 or (k < last and abs(along[k + 1] - along2[i]) < 0.5)
            if inside or touching:
                unmatched[i] = False
    return unmatched


@dataclass(frozen=True, slots=True)
class StripeResiduals:
    """Redundant equation of each point of one camera whose column another camera sees, too.

    residual_px : (m,) float64, distance across the stripe in the other camera, px, from the projection of the point to
    that stripe, positive towards higher projector positions. sigma_px : (m,) float64, its standard deviation by the
    stated deviations of both stripes. pixels_px : (m, 2) float64, (x, y) of the point in this camera.
    """

    residual_px: FloatArray
    sigma_px: FloatArray
    pixels_px: FloatArray


@dataclass(frozen=True, slots=True)
class PairRedundancy:
    """Statistics of the redundant equations of two cameras, px of the image of `camera`; the map covers that of
    `reference`.

    Points further than 12 robust standard deviations from the median are of different surfaces: they count in
    `outlying` only. stated_rms_px : rms to expect from the stated deviations with a perfect calibration. map_mean_px,
    map_rms_px : (6, 6) float64, NaN where fewer than 20 pairs are; map_pairs : (6, 6) int32.
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


@dataclass(frozen=True, slots=True)
class Redundancy:
    """Redundancy of every pair of cameras, or the reason why there is none."""

    pairs: tuple[PairRedundancy, ...]
    reason: str | None


def evaluate_redundancy(
    parts: list[SheetCurves], devices: Mapping[str, Pinhole], axis: Axis, /, *, widest_gap_px: float
) -> Redundancy:
    """Evaluate the redundant equations of every pair of cameras.

    parts : curves of each camera with the projector's light sheets, before merging, in the order of `devices`; axis :
    axis that numbers the sheets; widest_gap_px : as for `merge_curves`.
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
        residuals = stripe_residuals(
            parts[first], parts[second], devices[names[second]], axis, widest_gap_px=widest_gap_px
        )
        if len(residuals.residual_px):
            found.append(summarise_pair(residuals, names[first], names[second], devices[names[first]].size))
    return Redundancy(tuple(found), None if found else "the cameras share no point of any light sheet")


def stripe_residuals(
    first: SheetCurves, second: SheetCurves, other: Pinhole, axis: Axis, /, *, widest_gap_px: float
) -> StripeResiduals:
    """Project the points of `first` into the camera `other`, and measure the distance to its own stripes `second`.

    A point belongs to the stretch of the same column with its projector row, since a row meets one surface point. From
    there the foot of the perpendicular is searched along the stripe, so a wrong pose of `other` displaces no
    measurement. Points at a gap or bridge of the other curve have no partner.
    """
    first, _ = sort_by_row(first)
    second, _ = sort_by_row(second)
    _, own_index, other_index = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    expected = project(other, first.points_mm)
    # Displacements by one standard deviation in the image of the other camera.
    own_shift = project(other, first.points_mm + first.deviation_mm) - expected
    other_shift = project(other, second.points_mm + second.deviation_mm) - project(other, second.points_mm)
    residual, sigma = (np.full(len(expected), np.nan) for _ in range(2))
    in_bands(
        _residual_kernel, len(own_index), own_index, first.offsets, first.along_px, expected, own_shift,
        other_index, second.offsets, second.along_px, second.pixels_px, other_shift, second.bridge_after, widest_gap_px,
        residual, sigma,
    )  # fmt: skip
    has_partner = np.isfinite(residual)
    # Along rising rows, higher columns are on one side; along rising columns, higher rows on the other.
    side = 1.0 if axis is Axis.COLUMN else -1.0
    return StripeResiduals(side * residual[has_partner], sigma[has_partner], first.pixels_px[has_partner])


def summarise_pair(residuals: StripeResiduals, reference: str, camera: str, size: Size, /) -> PairRedundancy:
    """Statistics of one pair; `size` is that of the reference camera's image. At least one point is needed."""
    residual = residuals.residual_px
    centre = np.median(residual)
    spread = DEVIATIONS_PER_MEDIAN * max(np.median(np.abs(residual - centre)), np.median(residuals.sigma_px))
    is_inlier = np.abs(residual - centre) <= _OUTLIER_SIGMA * spread
    inliers, pixels = residual[is_inlier], residuals.pixels_px[is_inlier]
    cell = _map_index(pixels[:, 1], size.height_px) * MAP_CELLS + _map_index(pixels[:, 0], size.width_px)
    count = np.bincount(cell, minlength=MAP_CELLS * MAP_CELLS)
    enough = count >= MIN_PAIRS
    sums = [np.bincount(cell, weights=values, minlength=MAP_CELLS * MAP_CELLS) for values in (inliers, inliers**2)]
    mean, square = (
        np.where(enough, total / np.maximum(count, 1), np.nan).reshape(MAP_CELLS, MAP_CELLS) for total in sums
    )
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
    )


def _map_index(coordinate_px: FloatArray, extent_px: int) -> NDArray[np.int64]:
    """(n,) int64: index of the map cell of each coordinate."""
    return np.clip((coordinate_px + 0.5) * MAP_CELLS // extent_px, 0, MAP_CELLS - 1).astype(np.int64)


@kernel(in_every_scan=False)
def _residual_kernel(
    first: int, last: int, own_index: Any, a: Any, along: Any, expected: Any, own_shift: Any,
    other_index: Any, b: Any, along2: Any, pixels2: Any, other_shift: Any, bridge2: Any, widest: float,
    residual: Any, sigma: Any,
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


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Contradiction between two cameras.

    distance_mm : median distance of their points on one projector ray. sigma_ratio : robust standard deviation of the
    distances over the stated one; 1 for cameras that agree.
    """

    distance_mm: float
    sigma_ratio: float

    @property
    def sigma_mm(self) -> float:
        """Standard deviation to add to that of each point, in squares.

        One camera may be right and the other off by the whole distance; the scan does not show which.
        """
        return self.distance_mm

    def __str__(self) -> str:
        return (
            f"the cameras contradict each other: they place the surface {self.distance_mm:.3f} mm apart (median), "
            f"{self.sigma_ratio:.1f} times what is stated for them. This distance was added to the standard "
            f"deviations, in squares; "
            "a camera has moved or the calibration is wrong: verify it (slrig verify), and calibrate again"
        )


def find_disagreement(merged: MergedCurves, calibration_sigma_mm: FloatArray | None, /) -> Disagreement | None:
    """Compare the distances between cameras with the stated deviations; None if they agree or have few points in
    common.

    calibration_sigma_mm : (n,) float64, the calibration's part of the standard deviation of each point, None if it
    states none.
    """
    distance = np.abs(merged.residual_mm)
    is_stated = (merged.residual_sigma != 0) & np.isfinite(merged.residual_sigma)
    if np.count_nonzero(is_stated) < MIN_POINTS:
        return None
    noise = distance[is_stated] / np.abs(merged.residual_sigma[is_stated])
    # Each of the two has the calibration's error.
    between_sigma_mm = 0.0 if calibration_sigma_mm is None else 2**0.5 * float(np.median(calibration_sigma_mm))
    ratio = DEVIATIONS_PER_MEDIAN * float(np.median(distance[is_stated] / np.hypot(noise, between_sigma_mm)))
    return Disagreement(float(np.median(distance[is_stated])), ratio) if ratio > MAX_OVER_SIGMA else None
