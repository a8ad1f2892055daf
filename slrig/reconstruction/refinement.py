"""Stripe points refined by the light of all line frames, and points that the filter misses.

A local surface fitted to the position map, solved for the line's own column, uses the light of all shifts. It holds
where stripes are squeezed together at a grazing view, and beside a shadow, where a filter reaches over the border
and a fit merely has fewer pixels. What it asks for is the same light in every frame, and that is checked: each frame's
own stripes must lie where all frames together put them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.phase import FittedPoints, PositionMap, no_points, windows
from slrig.reconstruction.stripes import LinePoints
from slrig.reconstruction.surface_fit import LEAST_GRADIENT, POINTS, fit_kernel

_SURE_PX = 0.15  # a chain may begin at a point that the filter missed, if it is known as well as this
_FAINT = 1e-6  # far below a filter's response: what it found comes first
_POINTS_TIED = 5  # by a filter along the stripe: 2√π of its scale, 4.3 points at 1.2 px
_CLEAR_PX = 0.12  # so near to the border of a pixel, a fit of its own might end beyond it
_LINES_KEPT = 2  # of the lines that begin at one pixel, which are neighbours, these many are remembered
_MOST_FOR_MEDIAN = 20_000  # tied, their median is known to a fiftieth of their scatter
_ENDS = 0.5  # cosine between a line and the way to pixels that are not usable, where it ends there
_BEYOND_PX = 0.25  # half way to the border of the last usable pixel, which is lit to its border
_WITHIN_PX = 0.49  # of a pixel's centre
_CROSSING_PX = 0.62  # more than half a pixel: two neighbours' noisy slopes must not both miss a line between them


def _crossings(
    seen: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_of: FloatArray,
    step_px: int,
    started: IntArray,
    landed: NDArray[np.uint8],
    fitted: FittedPoints,
    targets: FloatArray,
    beyond_px: float = 0.0,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Where lines cross pixels, less those crossings from which a fit would surely land at a pixel that has its point.

    position_of : (frames, cells) float64, as for `identify`; step_px : from one frame's lines to the next one's. A line
    crosses a pixel when it passes within 0.62 px of its centre, along either axis. beyond_px : by how much a line goes
    on beyond the centre of the last usable pixel.
    Returns frame (n,) int32, starts_px (n, 2) and targets_px (n,), frame by frame, row by row.
    """
    by_cell = np.ascontiguousarray(position_of.T)
    frames, rows = len(position_of), len(usable)
    shown = position_of[np.isfinite(position_of)]
    if not len(shown):
        return np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0)
    # Line n of them all, counted across the projector, is at first + n steps and in frame n mod frames.
    frame = int(np.flatnonzero(np.isfinite(position_of).any(axis=1))[0])
    first = float(shown[0]) - frame * step_px
    given = seen.position, usable, code, by_cell, first, float(step_px), beyond_px, started, landed, fitted, targets
    counts = np.zeros((rows, frames), dtype=np.int64)
    crossed = np.zeros(usable.shape, dtype=np.bool_)
    nowhere = np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0)
    in_bands(_crossing_kernel, rows, *given, crossed, counts, False, *nowhere)
    ends = np.cumsum(counts.T.ravel()).reshape(frames, rows)
    total = int(ends[-1, -1]) if ends.size else 0
    found = np.zeros(total, dtype=np.int32), np.zeros((total, 2)), np.zeros(total)
    in_bands(_crossing_kernel, rows, *given, crossed, np.ascontiguousarray(ends.T) - counts, True, *found)
    return found


@kernel
def _crossing_kernel(
    begin: int, end: int, position: Any, usable: Any, code: Any, by_cell: Any, first: float,
    step: float, beyond: float, started: Any, landed: Any, fitted: Any, begun_targets: Any,
    crossed: Any, place: Any, fill: bool, frame: Any, starts: Any, targets: Any,
) -> None:  # fmt: skip
    """Count the crossings of each row and frame in `place`, and note the pixels in `crossed`; or put them where `place`
    says that they begin.
    """
    rows, columns = position.shape
    moved, normals = fitted.points, fitted.normals
    frames = by_cell.shape[1]
    for y in range(max(begin, 1), min(end, rows - 1)):
        for x in range(1, columns - 1):
            if not usable[y, x] or (fill and not crossed[y, x]):
                continue
            here = position[y, x]
            gx, gy = _gradient(position, usable, y, x)
            squared = gx * gx + gy * gy
            if not squared > LEAST_GRADIENT * LEAST_GRADIENT:
                continue
            reach = _CROSSING_PX * (abs(gx) + abs(gy)) + 1e-6
            low_cell, high_cell = code.lowest[y, x], code.highest[y, x]
            nearest = int(np.ceil((here - reach - first) / step))
            for line in range(nearest, int(np.floor((here + reach - first) / step)) + 1):
                k = line % frames
                low = by_cell[low_cell, k]
                miss = low - here
                if not abs(miss) <= reach or low != by_cell[high_cell, k]:
                    continue
                dx, dy = miss * gx / squared, miss * gy / squared
                if abs(dx) > _CROSSING_PX or abs(dy) > _CROSSING_PX:
                    continue
                if beyond > 0 and (abs(dx) > 0.5 or abs(dy) > 0.5):
                    # Of two pixels that a line passes between, the one to whose centre it is nearer has the point.
                    nx, ny = int(np.rint(x + dx)), int(np.rint(y + dy))
                    if 1 <= nx < columns - 1 and 1 <= ny < rows - 1 and usable[ny, nx]:
                        there = position[ny, nx]
                        hx, hy = _gradient(position, usable, ny, nx)
                        steep = hx * hx + hy * hy
                        if steep > LEAST_GRADIENT * LEAST_GRADIENT and by_cell[code.lowest[ny, nx], k] == low:
                            off_x, off_y = abs((low - there) * hx / steep), abs((low - there) * hy / steep)
                            first_of_both = ny * columns + nx < y * columns + x
                            if max(off_x, off_y) <= (_CROSSING_PX if first_of_both else 0.5):
                                continue
                if beyond > 0:
                    # The unit vector along the line, towards pixels that are not usable where it ends here.
                    ahead_x = int(usable[y, x - 1]) - int(usable[y, x + 1])
                    ahead_y = int(usable[y - 1, x]) - int(usable[y + 1, x])
                    length = np.sqrt(squared)
                    along = (ahead_y * gx - ahead_x * gy) / length
                    if abs(along) > _ENDS:
                        further = np.copysign(beyond, along) / length
                        dx = min(max(dx - further * gy, -_WITHIN_PX), _WITHIN_PX)
                        dy = min(max(dy + further * gx, -_WITHIN_PX), _WITHIN_PX)
                i = started[int(np.rint(y + dy)), int(np.rint(x + dx)), k % _LINES_KEPT] - 1
                if i >= 0 and begun_targets[i] == low:
                    # The same surface was fitted for a point that began here: this one would end beside it, straight
                    # across the line from where it began.
                    away = (moved[i, 0] - x - dx) * normals[i, 0] + (moved[i, 1] - y - dy) * normals[i, 1]
                    end_x, end_y = x + dx + away * normals[i, 0], y + dy + away * normals[i, 1]
                    at_x, at_y = int(np.rint(end_x)), int(np.rint(end_y))
                    clear = max(abs(end_x - at_x), abs(end_y - at_y)) < 0.5 - _CLEAR_PX
                    if clear and _has_landed(landed, k, at_y, at_x):
                        continue
                if fill:
                    at = place[y, k]
                    frame[at] = k
                    starts[at, 0], starts[at, 1] = x + dx, y + dy
                    targets[at] = low
                crossed[y, x] = True
                place[y, k] += 1


@kernel_part(inline="always")
def _gradient(position: Any, usable: Any, y: int, x: int) -> Any:
    """Change of position per pixel along x and y, from usable neighbours of pixel (x, y); NaN along an axis without."""
    here = position[y, x]
    gx = _slope(position[y, x - 1], here, position[y, x + 1], usable[y, x - 1], usable[y, x + 1])
    return gx, _slope(position[y - 1, x], here, position[y + 1, x], usable[y - 1, x], usable[y + 1, x])


@kernel_part(inline="always")
def _slope(before: float, here: float, after: float, before_usable: bool, after_usable: bool) -> float:
    if before_usable and after_usable:
        return 0.5 * (after - before)
    if after_usable:
        return after - here
    if before_usable:
        return here - before
    return np.nan


@dataclass(frozen=True, slots=True)
class Refinement:
    """Points of each line frame moved to where the light of all frames puts them, and those that a filter misses.

    disagreement_px : (frames,) float64, median distance from each frame's own stripes to the refined ones, along the
    normals, less three standard deviations of that median; NaN for a frame without any. Where the light was the same
    in all frames it is next to nothing. moved : False where it is not, and the filter's points stand as they were.
    """

    points: list[LinePoints]
    disagreement_px: FloatArray
    moved: bool


def refined(
    found: list[LinePoints],
    seen: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_of: FloatArray,
    step_px: int,
    /,
    *,
    displaced_px: NDArray[np.float32] | None = None,
    coarsest_px: float = 0.5,
    largest_disagreement_px: float = np.inf,
    sampled: bool = False,
    steady: Callable[[], None] = lambda: None,
) -> Refinement:
    """Refine the points of all line frames of one axis, which `found` gives away.

    Points of mixed light (not `usable`) or of no single line are left out, as are those whose standard deviation
    exceeds coarsest_px pixels. position_of : (frames, cells) float64, as for `identify`; step_px : from one frame's
    lines to the next one's. displaced_px : (H, W), what points err by and no pixels' scatter shows, standard deviation;
    they state it. sampled : `found` are a few of the points, which show whether the light was the same in all frames,
    and all points come from the position map. steady : is called when it was, before what takes most memory begins.
    """
    borders = np.concatenate([[0], np.cumsum([len(each.points_px) for each in found], dtype=np.int64)])
    parts = [slice(a, b) for a, b in pairwise(borders)]
    count = int(borders[-1])
    given = windows(seen, usable)
    clear = cv2.erode(usable.view(np.uint8), np.ones((7, 7), dtype=np.uint8), borderValue=0)
    old, targets, disagreement = no_points(count), np.zeros(count), np.zeros(len(found))
    started, landed = _nothing_taken(len(found), usable.shape)
    for index, (points, part) in enumerate(zip(found, parts, strict=True)):
        starts = np.ascontiguousarray(points.points_px)
        in_bands(_target_kernel, len(starts), starts, code, position_of[index], targets[part])
        # Of one frame at a time: what only its own points need.
        noise_px, away = np.zeros(len(starts)), np.zeros(len(starts))
        fitted = FittedPoints(old.points[part], old.normals[part], old.sigma_px[part], old.found[part], noise_px)
        in_bands(fit_kernel, len(starts), *given, starts, targets[part], fitted, rows_at_least=POINTS)
        own = np.ascontiguousarray(points.sigma_px)
        in_bands(_settle_kernel, len(starts), starts, own, clear, coarsest_px, fitted, away)
        disagreement[index] = _sure_median(_drawn(away, fitted.found))
        if not sampled:
            _note_points(starts, fitted, part.start, index, started, landed)
    if _differs(disagreement) > largest_disagreement_px:
        unmoved = found.copy()
        found.clear()
        return Refinement(unmoved, disagreement, moved=False)
    steady()
    if sampled:
        found[:] = [points.first(0) for points in found]
        old, targets, parts = no_points(0), np.zeros(0), [slice(0, 0)] * len(found)
    frame, *crossings = _crossings(
        seen, usable, code, position_of, step_px, started, landed, old, targets, _BEYOND_PX if sampled else 0.0
    )
    # Each step from here on takes as much again.
    del started, targets
    missed = no_points(len(frame))
    in_bands(fit_kernel, len(frame), *given, *crossings, missed, rows_at_least=POINTS)
    in_bands(_new_kernel, len(frame), frame, coarsest_px, landed, missed)
    del landed, crossings
    new_borders = np.searchsorted(frame, np.arange(len(found) + 1))
    new_parts = [slice(a, b) for a, b in pairwise(new_borders)]

    def join(first: int, last: int) -> None:
        # Each in place of what it is made of, whose memory is needed.
        for at in range(first, last):
            found[at] = _joined(found[at], old, parts[at], missed, new_parts[at], displaced_px)

    in_bands(join, len(found))
    joined = found.copy()
    found.clear()
    return Refinement(joined, disagreement, moved=True)


def _joined(
    points: LinePoints, old: FittedPoints, part: slice, missed: FittedPoints, more: slice,
    displaced_px: NDArray[np.float32] | None,
) -> LinePoints:  # fmt: skip
    """The good points of one frame: those that the filter found, and those that it missed."""
    kept, added = old.found[part], missed.found[more]
    first, count = int(np.count_nonzero(kept)), int(np.count_nonzero(added))
    out = np.zeros((first + count, 2)), np.zeros((first + count, 2)), np.zeros(first + count)
    strength, strong = np.zeros(first + count), np.zeros(first + count, dtype=np.bool_)
    for filled, fitted, new in zip(out, old[:3], missed[:3], strict=True):
        np.compress(kept, fitted[part], axis=0, out=filled[:first])
        np.compress(added, new[more], axis=0, out=filled[first:])
    np.compress(kept, points.strength, out=strength[:first])
    np.compress(kept, points.strong, out=strong[:first])
    # Chains begin at what the filter found; what it missed comes after, the surest first.
    strength[first:] = _FAINT / out[2][first:]
    strong[first:] = out[2][first:] < _SURE_PX
    sigma_px = out[2]
    if displaced_px is not None:
        columns, rows = np.rint(out[0]).astype(np.intp).T
        sigma_px = np.hypot(sigma_px, displaced_px[rows, columns])
    return LinePoints(points_px=out[0], normals=out[1], strength=strength, strong=strong, sigma_px=sigma_px)


def _drawn(away: FloatArray, good: NDArray[np.bool_]) -> FloatArray:
    """The good ones of an even sample."""
    step = max(1, -(-len(away) // _MOST_FOR_MEDIAN))
    return away[::step][good[::step]]


def _sure_median(away: FloatArray) -> float:
    """The median, less three of its own standard deviations: of few or noisy points it tells little. NaN of none."""
    if not len(away):
        return np.nan
    median = float(np.median(away))
    scatter = 1.4826 * float(np.median(np.abs(away - median)))
    # A median's standard deviation is 1.2533/√n of its values', and a filter ties some five points together.
    error = 1.2533 * scatter * np.sqrt(_POINTS_TIED / len(away))
    return float(np.copysign(max(abs(median) - 3 * error, 0.0), median))


def _differs(disagreement: FloatArray) -> float:
    """By how much any frame disagrees, px, beyond what all of them do.

    A surface that is bent under a line displaces the line's middle from the projector's by width²/8 times the second
    derivative of its place, in all frames alike: on a ball of 30 pixels' radius 0.02 px for lines of 4 px.
    """
    if not np.isfinite(disagreement).any():
        return 0.0
    beyond = np.minimum(np.abs(disagreement), np.abs(disagreement - np.nanmedian(disagreement)))
    return float(np.nanmax(beyond))


@kernel
def _settle_kernel(
    first: int, last: int, starts: Any, own_sigma: Any, clear: Any, coarsest: float, fitted: Any, away: Any
) -> None:
    """Give each point what its own frame knows of it, and put how far the other frames moved it into `away`.

    Where the camera's pixels are finer than the projector's, five of them hold but a part of a stripe, and the stripe's
    own frame may know better: its part in the mean is its share of the inverse variance. A filter is trusted clear of
    borders only, where both agree, and where it is better than the fit by noise alone: what makes pixels scatter more
    than that, an edge of a print for example, displaces a filter, too, which does not know of it.
    """
    moved, normals, sigma, good, noise = fitted
    for i in range(first, last):
        good[i] = good[i] and sigma[i] < coarsest
        x, y = starts[i, 0], starts[i, 1]
        away[i] = (moved[i, 0] - x) * normals[i, 0] + (moved[i, 1] - y) * normals[i, 1]
        if not good[i] or not own_sigma[i] < noise[i] or not clear[int(np.rint(y)), int(np.rint(x))]:
            continue
        variance = sigma[i] * sigma[i]
        both = variance + own_sigma[i] * own_sigma[i]
        if away[i] * away[i] < 9 * both:
            weight = variance / max(both, 1e-30)
            moved[i, 0] -= weight * away[i] * normals[i, 0]
            moved[i, 1] -= weight * away[i] * normals[i, 1]
            sigma[i] *= np.sqrt(1 - weight)


@kernel
def _target_kernel(first: int, last: int, points: Any, code: Any, position_of: Any, targets: Any) -> None:
    """The position of the line that each point lies on, NaN where its pixel may mean two. position_of : (cells,)."""
    for i in range(first, last):
        x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
        targets[i] = np.nan
        if code.lowest[y, x] >= 0:
            low = position_of[code.lowest[y, x]]
            if low == position_of[code.highest[y, x]]:
                targets[i] = low


def _nothing_taken(frames: int, shape: tuple[int, int]) -> tuple[IntArray, NDArray[np.uint8]]:
    """What `_note_points` fills in: (H, W, 2) int32, and (frames / 8, H, W) uint8, a bit for each frame."""
    return np.zeros((*shape, _LINES_KEPT), dtype=np.int32), np.zeros((-(-frames // 8), *shape), dtype=np.uint8)


def _note_points(
    starts: FloatArray, fitted: FittedPoints, first: int, frame: int, started: IntArray, landed: NDArray[np.uint8]
) -> None:
    """Note which good point of a frame began at each pixel (one more than its index), and whether one landed there."""
    good = np.flatnonzero(fitted.found)
    columns, rows = np.rint(starts[good]).astype(np.intp).T
    # Of several that begin at a pixel the last one stands.
    started[rows, columns, frame % _LINES_KEPT] = first + good + 1
    columns, rows = np.rint(fitted.points[good]).astype(np.intp).T
    landed[frame >> 3, rows, columns] |= np.uint8(1 << (frame & 7))


@kernel_part(inline="always")
def _has_landed(landed: Any, frame: int, y: int, x: int) -> bool:
    return bool(landed[frame >> 3, y, x] >> (frame & 7) & 1)


@kernel
def _new_kernel(first: int, last: int, frame: Any, coarsest: float, landed: Any, fitted: Any) -> None:
    """Leave good only points that are fine enough and land where their line has none."""
    points, _, sigma, good, _ = fitted
    for i in range(first, last):
        x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
        good[i] = good[i] and sigma[i] < coarsest and not _has_landed(landed, frame[i], y, x)
