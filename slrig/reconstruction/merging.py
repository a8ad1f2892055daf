"""Merging of curves from several cameras.

A projector ray meets one surface point, so on a light sheet depth is a function of the projector row. Curves of one
position from two cameras sample the same function, and are merged by row. Where both have it, the point is the mean
weighted by inverse variance. Where only one has it, it fills the gap. The result is never two sheets. Further cameras
are merged one after another. Fused points are at the rows of the earlier camera, so the camera that samples the sheets
most finely comes first: one of low resolution must not thin out the points of the others. Cameras that contradict each
other must not be merged: `redundancy` detects them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, Source
from slrig.reconstruction.triangulation import SheetCurves

_ALL = int(Source.ALL)
_SAME_POINT_SIGMA = 12.0  # beyond this the cameras saw different surfaces, which must not be averaged


@dataclass(frozen=True, slots=True)
class MergedCurves:
    """Curves of all cameras, and the distances between them.

    camera : (n,) int32, index of the camera whose pixel the point has. seen_by : (n,) int64, one bit for each camera
    whose measurement is in the point. residual_sigma : (m,) float64, distance between the points of two cameras on one
    ray over its standard deviation. residual_mm : (m,) float64, the same distance, signed towards the camera that was
    merged first.
    """

    curves: SheetCurves
    camera: NDArray[np.int32]
    seen_by: NDArray[np.int64]
    residual_sigma: FloatArray
    residual_mm: FloatArray


def merge_curves(parts: list[SheetCurves], centre_mm: FloatArray, /, *, widest_gap_px: float) -> MergedCurves:
    """Merge the curves of several cameras along each light sheet.

    centre_mm : (3,) float64, the projector's centre; widest_gap_px : rows between two consecutive points of one camera
    up to which the curve between them counts as measured.
    """
    first, *others = sorted(range(len(parts)), key=lambda index: _spacing_px(parts[index]))
    result, camera = parts[first], np.full(len(parts[first].points_mm), first, dtype=np.int32)
    seen_by = np.int64(1) << camera.astype(np.int64)
    sigmas, distances = [], []
    for index in others:
        result, camera, seen_by, sigma, distance = _merge_pair(
            result, camera, seen_by, parts[index], index, centre_mm, widest_gap_px
        )
        sigmas.append(sigma)
        distances.append(distance)
    return MergedCurves(
        result, camera, seen_by, np.concatenate([np.zeros(0), *sigmas]), np.concatenate([np.zeros(0), *distances])
    )


def _spacing_px(curves: SheetCurves) -> float:
    """Usual distance of two points along a light sheet; infinite for a camera that measured none."""
    return float(np.median(np.abs(np.diff(curves.along_px)))) if len(curves.along_px) > 1 else np.inf


def _merge_pair(
    first: SheetCurves,
    camera: NDArray[np.int32],
    seen_by: NDArray[np.int64],
    second: SheetCurves,
    index: int,
    centre_mm: FloatArray,
    widest_gap_px: float,
) -> tuple[SheetCurves, NDArray[np.int32], NDArray[np.int64], FloatArray, FloatArray]:
    first, order_first = sort_by_row(first)
    second, _ = sort_by_row(second)
    camera, own = camera[order_first], np.int64(1) << np.int64(index)
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
    is_fused = has_partner & (np.abs(sigma) <= _SAME_POINT_SIGMA)
    seen_by = np.concatenate([seen_by[order_first] | np.where(is_fused, own, 0), np.full(int(unmatched.sum()), own)])
    return result, cameras.astype(np.int32), seen_by[order], sigma[has_partner], distance[has_partner]


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
