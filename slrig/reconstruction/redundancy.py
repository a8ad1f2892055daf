"""What two cameras say of one another: the spare equation of every light-sheet point that both have, in pixels.

A camera pixel gives two equations and the projector column a third: a point in space, with nothing left to check it by.
A second camera that sees the same column of light adds one equation: the point, projected into that camera, must lie on
the stripe of that column. Along the stripe nothing is measured, so the spare equation is the distance across it. Its
mean and its map over the image tell whether the calibration still holds.
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
from slrig.reconstruction.merging import by_row
from slrig.reconstruction.optics import project
from slrig.reconstruction.triangulation import SheetCurves

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
