"""One set of curves from several cameras, their redundancy, and their disagreement.

A projector ray meets one surface point, so on a light sheet the depth is a function of the projector row. Curves of one
code from two cameras sample the same function: they are merged by row. Where both have it, the point is the mean
weighted by inverse variance, and their distance, in standard deviations and in pixels, is a live check of the
calibration; where one has it alone, it fills the gap. Never two sheets.
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
_SAME_POINT_SIGMA = 12.0  # beyond this the two saw different things; the mean would be neither


@dataclass(frozen=True, slots=True)
class MergedCurves:
    """Curves of all cameras, and what the redundancy says.

    camera : (n,) int32, index of the camera whose pixel the point has.
    residual_sigma : (m,) float64, distance between two cameras' points of one ray over its standard deviation.
    residual_mm : (m,) float64, the same distance, signed towards the first camera.
    """

    curves: SheetCurves
    camera: NDArray[np.int32]
    residual_sigma: FloatArray
    residual_mm: FloatArray


def merged(parts: list[SheetCurves], centre_mm: FloatArray, /, *, widest_gap_px: float) -> MergedCurves:
    """Merge the curves of several cameras along each light sheet.

    centre_mm : (3,) float64, the projector's centre; widest_gap_px : rows between two consecutive points of one camera
    up to which the curve between them counts as seen.
    """
    result, camera = parts[0], np.zeros(len(parts[0].points_mm), dtype=np.int32)
    sigmas, distances = [], []
    for index, part in enumerate(parts[1:], start=1):
        result, camera, sigma, distance = _merged_pair(result, camera, part, index, centre_mm, widest_gap_px)
        sigmas.append(sigma)
        distances.append(distance)
    return MergedCurves(
        result,
        camera,
        np.concatenate([np.zeros(0), *sigmas]),
        np.concatenate([np.zeros(0), *distances]),
    )


def _merged_pair(
    first: SheetCurves,
    camera: NDArray[np.int32],
    second: SheetCurves,
    index: int,
    centre_mm: FloatArray,
    widest_gap_px: float,
) -> tuple[SheetCurves, NDArray[np.int32], FloatArray, FloatArray]:
    first, order_first = by_row(first)
    second, _ = by_row(second)
    camera = camera[order_first]
    offset = int(first.stripe.max(initial=-1)) + 1
    positions = np.union1d(first.position_px, second.position_px)
    a, b = _spread(first, positions), _spread(second, positions)
    fused, spread, source, sigma, distance = _fuse_kernel(
        a, first.points_mm, first.deviation_mm, first.along_px, first.source,
        b, second.points_mm, second.deviation_mm, second.along_px, second.bridge_after, centre_mm, widest_gap_px,
    )  # fmt: skip
    alone = _alone_kernel(a, first.along_px, first.bridge_after, b, second.along_px, widest_gap_px)
    # Concatenate, then sort each sheet by row; the sort is stable, so equal rows keep the first camera first.
    curve = np.concatenate([np.repeat(np.arange(len(positions)), np.diff(a)),
                            np.repeat(np.arange(len(positions)), np.diff(b))[alone]])  # fmt: skip
    along = np.concatenate([first.along_px, second.along_px[alone]])
    order = np.lexsort((along, curve))
    bridge = np.concatenate([first.bridge_after, second.bridge_after[alone]])[order]
    along = along[order]
    stripe = np.concatenate([first.stripe, second.stripe[alone] + offset])[order]
    # A step joins two stripes when they differ; a hole that the other camera filled is no bridge any more.
    joins = bridge | np.append(stripe[1:] != stripe[:-1], False)
    within = np.append(np.diff(curve[order]) == 0, False)
    wide = np.append(np.diff(along), 0.0) > widest_gap_px
    result = SheetCurves(
        offsets=np.searchsorted(curve[order], np.arange(len(positions) + 1)).astype(np.int32),
        position_px=positions,
        points_mm=np.concatenate([fused, second.points_mm[alone]])[order],
        deviation_mm=np.concatenate([spread, second.deviation_mm[alone]])[order],
        along_px=along,
        pixels_px=np.concatenate([first.pixels_px, second.pixels_px[alone]])[order],
        stripe=stripe,
        bridge_after=joins & within & wide,
        source=np.concatenate([source, second.source[alone]])[order],
    )
    cameras = np.concatenate([camera, np.full(int(alone.sum()), index, dtype=np.int32)])[order]
    seen = np.isfinite(sigma)
    return result, cameras.astype(np.int32), sigma[seen], distance[seen]


def by_row(curves: SheetCurves, /) -> tuple[SheetCurves, NDArray[np.intp]]:
    """The same curves, the points of each by rising `along_px`, and the order that makes them so."""
    order = np.lexsort((curves.along_px, curves.curve_of_point()))
    return curves.taken(order, offsets=curves.offsets, bridge_after=curves.bridge_after[order]), order


def _spread(curves: SheetCurves, positions: FloatArray) -> NDArray[np.int32]:
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
            # Errors at a given row act along the projector ray: a point displaced in the sheet slides along its
            # curve until the row is right again, so each deviation counts with its part along the ray, corrected
            # by the slope of the curve in that ray's direction.
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
    """Standard deviation of the depth at a fixed row: the deviation less its slide along the curve, on the ray."""
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
def _alone_kernel(a: Any, along: Any, bridge: Any, b: Any, along2: Any, widest: float) -> Any:
    """Points of the second camera that lie in no stretch which the first camera has."""
    alone = np.ones(len(along2), dtype=np.bool_)
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
                alone[i] = False
    return alone


CELLS = 6  # along each side of the map, as in those of a calibration's residuals
FEWEST_PAIRS = 20  # the mean of a cell is then known to a quarter of their scatter
_STEPS = 32  # segments that the foot of a perpendicular is looked for on
_TANGENT_REACH = 2  # points either way, for the direction of a stripe
_OUTLYING = 12.0  # robust standard deviations, as for points to be merged: two different things, not one
DEVIATIONS_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@dataclass(frozen=True, slots=True)
class SpareEquation:
    """The spare equation of each point of one camera that another camera's stripe of the same column passes.

    residual_px : (m,) float64, in pixels of the other camera: from where this camera's point projects to the other's
    stripe, across that stripe, positive towards higher projector positions.
    sigma_px : (m,) float64, what the stated deviations of both stripes make of it.
    pixels_px : (m, 2) float64, (x, y) of the point in this camera.
    """

    residual_px: FloatArray
    sigma_px: FloatArray
    pixels_px: FloatArray


@dataclass(frozen=True, slots=True)
class PairRedundancy:
    """The spare equation of two cameras in figures, px of `camera`'s image; the map is over `reference`'s image.

    Points further than 12 robust standard deviations from the median are two different things, not one: they are
    counted in `outlying` and in nothing else.
    stated_rms_px : rms that the stated deviations predict for a perfect calibration.
    map_mean_px, map_rms_px : (6, 6) float64, NaN where fewer than 20 pairs are; map_pairs : (6, 6) int32.
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
    """The spare equation of every pair of cameras, and, when there is none at all, the reason."""

    pairs: tuple[PairRedundancy, ...]
    reason: str | None


def redundancy(
    parts: list[SheetCurves], devices: Mapping[str, Pinhole], axis: Axis, /, *, widest_gap_px: float
) -> Redundancy:
    """Evaluate the spare equation of every pair of cameras.

    parts : the curves of each camera with the projector's light sheets, before they are merged, in the order of
    `devices`; axis : the axis the sheets are numbered along; widest_gap_px : rows between two consecutive points of one
    camera up to which the curve between them counts as seen.
    """
    if len(devices) < 2:
        return Redundancy((), "one camera and one axis of patterns: three equations for three unknowns, none to spare")
    if any((part.source == Source.CAMERA_CAMERA).any() for part in parts):
        reason = (
            "the projector is not calibrated: the stripe of the second camera is spent on the depth, and the epipolar "
            "plane chooses the point on it, so no equation is to spare"
        )
        return Redundancy((), reason)
    found = []
    names = list(devices)
    for first, second in combinations(range(len(parts)), 2):
        spare = spare_equation(parts[first], parts[second], devices[names[second]], axis, widest_gap_px=widest_gap_px)
        if len(spare.residual_px):
            found.append(in_figures(spare, names[first], names[second], devices[names[first]].size))
    return Redundancy(tuple(found), None if found else "the cameras share no point of any light sheet")


def spare_equation(
    first: SheetCurves, second: SheetCurves, other: Pinhole, axis: Axis, /, *, widest_gap_px: float
) -> SpareEquation:
    """Project the points of `first` into the camera `other`, and measure how far off its own stripes `second` are.

    A point belongs to the stretch of the same column that has its projector row: a row meets one surface point. From
    there the foot of the perpendicular is looked for along the stripe, so a wrong pose of `other` moves no measurement.
    Points on a gap or a bridge of the other camera's curve have no partner.
    """
    first, _ = by_row(first)
    second, _ = by_row(second)
    _, mine, theirs = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    expected = project(other, first.points_mm)
    # Displacements by one standard deviation, as the other camera sees them.
    moved = project(other, first.points_mm + first.deviation_mm) - expected
    own = project(other, second.points_mm + second.deviation_mm) - project(other, second.points_mm)
    residual, sigma = (np.full(len(expected), np.nan) for _ in range(2))
    in_bands(
        _across_kernel, len(mine), mine, first.offsets, first.along_px, expected, moved,
        theirs, second.offsets, second.along_px, second.pixels_px, own, second.bridge_after, widest_gap_px,
        residual, sigma,
    )  # fmt: skip
    met = np.isfinite(residual)
    # Walking along rising rows, higher columns are on one side, and along rising columns, higher rows on the other.
    side = 1.0 if axis is Axis.COLUMN else -1.0
    return SpareEquation(side * residual[met], sigma[met], first.pixels_px[met])


def in_figures(spare: SpareEquation, reference: str, camera: str, size: Size, /) -> PairRedundancy:
    """The figures of one pair; `size` is that of the reference camera's image. At least one point is needed."""
    residual = spare.residual_px
    centre = np.median(residual)
    spread = DEVIATIONS_PER_MEDIAN * max(np.median(np.abs(residual - centre)), np.median(spare.sigma_px))
    same = np.abs(residual - centre) <= _OUTLYING * spread
    kept, pixels = residual[same], spare.pixels_px[same]
    cell = _cells(pixels[:, 1], size.height_px) * CELLS + _cells(pixels[:, 0], size.width_px)
    count = np.bincount(cell, minlength=CELLS * CELLS)
    enough = count >= FEWEST_PAIRS
    sums = [np.bincount(cell, weights=values, minlength=CELLS * CELLS) for values in (kept, kept**2)]
    mean, square = (np.where(enough, total / np.maximum(count, 1), np.nan).reshape(CELLS, CELLS) for total in sums)
    return PairRedundancy(
        reference=reference,
        camera=camera,
        pairs=len(kept),
        outlying=len(residual) - len(kept),
        mean_px=float(kept.mean()),
        rms_px=float(np.sqrt((kept**2).mean())),
        median_absolute_px=float(np.median(np.abs(kept))),
        stated_rms_px=float(np.sqrt((spare.sigma_px[same] ** 2).mean())),
        map_mean_px=mean,
        map_rms_px=np.sqrt(square),
        map_pairs=count.reshape(CELLS, CELLS).astype(np.int32),
    )


def _cells(coordinate_px: FloatArray, extent_px: int) -> NDArray[np.int64]:
    """(n,) int64: which of the equal parts of an image's extent each coordinate is in."""
    return np.clip((coordinate_px + 0.5) * CELLS // extent_px, 0, CELLS - 1).astype(np.int64)


@kernel(in_every_scan=False)
def _across_kernel(
    first: int, last: int, mine: Any, a: Any, along: Any, expected: Any, moved: Any,
    theirs: Any, b: Any, along2: Any, pixels2: Any, own: Any, bridge2: Any, widest: float,
    residual: Any, sigma: Any,
) -> None:  # fmt: skip
    for pair in range(first, last):
        low, high = b[theirs[pair]], b[theirs[pair] + 1]
        row = low
        for i in range(a[mine[pair]], a[mine[pair] + 1]):
            while row < high - 1 and along2[row + 1] < along[i]:
                row += 1
            if row >= high - 1 or along2[row] > along[i] or not _joined(row, along2, bridge2, widest):
                continue
            k, share = _foot(expected[i], row, low, high, along2, pixels2, bridge2, widest)
            if k < 0:
                continue
            before = after = k
            for _ in range(_TANGENT_REACH):
                if before > low and _joined(before - 1, along2, bridge2, widest):
                    before -= 1
                if after + 2 < high and _joined(after + 1, along2, bridge2, widest):
                    after += 1
            tx, ty = pixels2[after + 1, 0] - pixels2[before, 0], pixels2[after + 1, 1] - pixels2[before, 1]
            length = np.sqrt(tx * tx + ty * ty)
            if length == 0:
                continue
            nx, ny = ty / length, -tx / length
            x = pixels2[k, 0] + share * (pixels2[k + 1, 0] - pixels2[k, 0])
            y = pixels2[k, 1] + share * (pixels2[k + 1, 1] - pixels2[k, 1])
            residual[i] = nx * (x - expected[i, 0]) + ny * (y - expected[i, 1])
            # Neighbours along a stripe share most of the light they were found in, so their errors are taken as one.
            theirs_px = (1 - share) * abs(nx * own[k, 0] + ny * own[k, 1])
            theirs_px += share * abs(nx * own[k + 1, 0] + ny * own[k + 1, 1])
            sigma[i] = np.hypot(nx * moved[i, 0] + ny * moved[i, 1], theirs_px)


@kernel_part(inline="always")
def _joined(k: int, along: Any, bridge: Any, widest: float) -> bool:
    """Whether the step from point k to the next one is a piece of seen curve."""
    return not bridge[k] and along[k + 1] - along[k] <= widest


@kernel_part
def _foot(point: Any, start: int, low: int, high: int, along: Any, pixels: Any, bridge: Any, widest: float) -> Any:
    """The segment of a curve that holds the foot of the perpendicular from a point, and the foot's share of it.

    The search walks one way from segment `start`; the segment is -1 where the curve ends before the foot.
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
        if k < low or k + 1 >= high or not _joined(k, along, bridge, widest):
            return -1, 0.0
    return -1, 0.0


FEWEST_POINTS = 100
"""That both have: with fewer they hardly see the same surface."""

MOST_OVER_SIGMA = 3.0
"""Beyond this the deviations that were stated do not explain what was found."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two cameras that contradict each other.

    apart_mm : median distance of their points of one projector ray, along it. over_sigma : their distances over what is
    stated for them, as a standard deviation: 1 for cameras that agree.
    """

    apart_mm: float
    over_sigma: float

    @property
    def sigma_mm(self) -> float:
        """What is to be added to a point's standard deviation, in squares.

        One of the two may be right, and the other off by all of the distance; nothing here tells which.
        """
        return self.apart_mm

    def __str__(self) -> str:
        return (
            f"the cameras contradict each other: they place the surface {self.apart_mm:.3f} mm apart (median), "
            f"{self.over_sigma:.1f} times what is stated for them. The standard deviations were widened by as much; "
            "a camera has moved or the calibration is wrong: verify it (slrig verify), and calibrate again"
        )


def disagreement(merged: MergedCurves, share_mm: FloatArray | None, /) -> Disagreement | None:
    """How far the cameras contradict each other; None where they agree, or hardly see the same.

    share_mm : (n,) float64, the calibration's part of each point's standard deviation, None where it states none.
    """
    apart = np.abs(merged.residual_mm)
    told = (merged.residual_sigma != 0) & np.isfinite(merged.residual_sigma)
    if np.count_nonzero(told) < FEWEST_POINTS:
        return None
    noise = apart[told] / np.abs(merged.residual_sigma[told])
    # Each of the two has the calibration's error.
    share = 0.0 if share_mm is None else 2**0.5 * float(np.median(share_mm))
    over = DEVIATIONS_PER_MEDIAN * float(np.median(apart[told] / np.hypot(noise, share)))
    return Disagreement(float(np.median(apart[told])), over) if over > MOST_OVER_SIGMA else None
