"""Refinement of stripe points by the phase of all line frames, and points that the filter misses.

A local surface is fitted to the position map and solved for the column of the line, so a point uses the light of all
shifts. This works where stripes are squeezed together at a grazing view, and next to a shadow, where a filter reaches
over the border and a fit merely has fewer pixels. It requires the same light in every frame, which is checked: the
stripes of each frame must be where all frames together put them.
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
from slrig.reconstruction.phase import FittedPoints, PositionMap, allocate_points, fit_arguments
from slrig.reconstruction.stripes import LinePoints
from slrig.reconstruction.surface_fit import MIN_GRADIENT, MIN_POINTS, fit_kernel

_MAX_START_SIGMA_PX = 0.15  # of points that the filter missed: others are there to begin at
_MISSED_STRENGTH = 1e-6  # of points that the filter missed: far below its response, so that its points come first
_CORRELATED_POINTS = 5  # whose errors a filter correlates along the stripe: 2√π of its scale, 4.3 points at 1.2 px
_BORDER_PX = 0.12  # closer to the border of a pixel, another fit might end beyond it
_LINES_PER_PIXEL = 2  # number of neighbouring lines that one pixel remembers
_MAX_FOR_MEDIAN = 20_000  # correlated, their median is known to a fiftieth of their scatter
_MIN_END_COSINE = 0.5  # cosine between a line and the direction of unusable pixels, where it ends
_EXTENSION_PX = 0.25  # half way to the border of the last usable pixel, which is lit to its border
_WITHIN_PX = 0.49  # from the centre of a pixel
# More than half a pixel, so that noisy slopes of two neighbours do not both miss a line between them
_CROSSING_PX = 0.62


def _find_crossings(
    measured: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_table: FloatArray,
    step_px: int,
    started: IntArray,
    landed: NDArray[np.uint8],
    fitted: FittedPoints,
    targets: FloatArray,
    extension_px: float = 0.0,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Crossings of lines and pixels, without those from which a fit would end at a pixel that has its point already.

    position_table : (frames, cells) float64, as for `identify_stripes`; step_px : from the lines of one frame to those
    of the next. A line crosses a pixel if it passes within 0.62 px of its centre, along either axis. extension_px :
    length of a line beyond the centre of the last usable pixel. Returns frame (n,) int32, starts_px (n, 2) and
    targets_px (n,), frame by frame, row by row.
    """
    by_cell = np.ascontiguousarray(position_table.T)
    frames, rows = len(position_table), len(usable)
    known = position_table[np.isfinite(position_table)]
    if not len(known):
        return np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0)
    # Line n, counted across the projector, is at first + n steps and in frame n mod frames.
    frame = int(np.flatnonzero(np.isfinite(position_table).any(axis=1))[0])
    first = float(known[0]) - frame * step_px
    arguments = (
        measured.position,
        usable,
        code,
        by_cell,
        first,
        float(step_px),
        extension_px,
        started,
        landed,
        fitted,
        targets,
    )
    counts = np.zeros((rows, frames), dtype=np.int64)
    crossed = np.zeros(usable.shape, dtype=np.bool_)
    nowhere = np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0)
    in_bands(_crossing_kernel, rows, *arguments, crossed, counts, False, *nowhere)
    borders = np.cumsum(counts.T.ravel()).reshape(frames, rows)
    total = int(borders[-1, -1]) if borders.size else 0
    crossings = np.zeros(total, dtype=np.int32), np.zeros((total, 2)), np.zeros(total)
    in_bands(_crossing_kernel, rows, *arguments, crossed, np.ascontiguousarray(borders.T) - counts, True, *crossings)
    return crossings


@kernel
def _crossing_kernel(
    begin: int, end: int, position: Any, usable: Any, code: Any, by_cell: Any, first: float,
    step: float, extension: float, started: Any, landed: Any, fitted: Any, fitted_targets: Any,
    crossed: Any, place: Any, fill: bool, frame: Any, starts: Any, targets: Any,
) -> None:  # fmt: skip
    """Count the crossings of each row and frame in `place` and set their pixels in `crossed`; or, if `fill`, store them
    at the indices in `place`.
    """
    rows, columns = position.shape
    points, normals = fitted.points, fitted.normals
    frames = by_cell.shape[1]
    for y in range(max(begin, 1), min(end, rows - 1)):
        for x in range(1, columns - 1):
            if not usable[y, x] or (fill and not crossed[y, x]):
                continue
            here = position[y, x]
            gx, gy = _gradient(position, usable, y, x)
            squared = gx * gx + gy * gy
            if not squared > MIN_GRADIENT * MIN_GRADIENT:
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
                if extension > 0 and (abs(dx) > 0.5 or abs(dy) > 0.5):
                    # Of two pixels that a line passes between, the one with the closer centre has the point.
                    nx, ny = int(np.rint(x + dx)), int(np.rint(y + dy))
                    if 1 <= nx < columns - 1 and 1 <= ny < rows - 1 and usable[ny, nx]:
                        neighbour = position[ny, nx]
                        hx, hy = _gradient(position, usable, ny, nx)
                        steep = hx * hx + hy * hy
                        if steep > MIN_GRADIENT * MIN_GRADIENT and by_cell[code.lowest[ny, nx], k] == low:
                            off_x, off_y = abs((low - neighbour) * hx / steep), abs((low - neighbour) * hy / steep)
                            is_first = ny * columns + nx < y * columns + x
                            if max(off_x, off_y) <= (_CROSSING_PX if is_first else 0.5):
                                continue
                if extension > 0:
                    # Component of the unit vector along the line towards unusable pixels, where it ends.
                    ahead_x = int(usable[y, x - 1]) - int(usable[y, x + 1])
                    ahead_y = int(usable[y - 1, x]) - int(usable[y + 1, x])
                    length = np.sqrt(squared)
                    along = (ahead_y * gx - ahead_x * gy) / length
                    if abs(along) > _MIN_END_COSINE:
                        further = np.copysign(extension, along) / length
                        dx = min(max(dx - further * gy, -_WITHIN_PX), _WITHIN_PX)
                        dy = min(max(dy + further * gx, -_WITHIN_PX), _WITHIN_PX)
                i = started[int(np.rint(y + dy)), int(np.rint(x + dx)), k % _LINES_PER_PIXEL] - 1
                if i >= 0 and fitted_targets[i] == low:
                    # The same surface was fitted for a point that started here: this one would end next to it, straight
                    # across the line from its start.
                    distance = (points[i, 0] - x - dx) * normals[i, 0] + (points[i, 1] - y - dy) * normals[i, 1]
                    end_x, end_y = x + dx + distance * normals[i, 0], y + dy + distance * normals[i, 1]
                    at_x, at_y = int(np.rint(end_x)), int(np.rint(end_y))
                    inside = max(abs(end_x - at_x), abs(end_y - at_y)) < 0.5 - _BORDER_PX
                    if inside and _is_occupied(landed, k, at_y, at_x):
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
    """Change of position per pixel along x and y, from usable neighbours; NaN along an axis without any."""
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
    """Points of each line frame at the positions measured by all frames, and points that a filter misses.

    disagreement_px : (frames,) float64, median distance from the stripes of each frame to the refined ones, along the
    normals, less three standard deviations of that median; NaN for a frame without any. It is close to 0 if the light
    was the same in all frames. accepted : False if it was not, and the points are those of the filter.
    frame_sigma_px : (frames,) float64, standard deviation of the error that all points of a frame share, because its
    lines are displaced from those of the others; `sigma_px` of the points does not contain it.
    """

    points: list[LinePoints]
    disagreement_px: FloatArray
    accepted: bool
    frame_sigma_px: FloatArray


def refine_points(
    found: list[LinePoints],
    measured: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_table: FloatArray,
    step_px: int,
    /,
    *,
    extra_sigma_px: NDArray[np.float32] | None = None,
    coarsest_px: float = 0.5,
    max_disagreement_px: float = np.inf,
    sampled: bool = False,
    start_sigma_px: float = _MAX_START_SIGMA_PX,
    release_lines: Callable[[], None] = lambda: None,
) -> Refinement:
    """Refine the points of all line frames of one axis. Empties `found`.

    Points of mixed light (not `usable`) or of no single line are left out, and those with a standard deviation above
    coarsest_px pixels. position_table : (frames, cells) float64, as for `identify_stripes`; step_px : from the lines of
    one frame to those of the next. extra_sigma_px : (H, W), standard deviation of errors that the scatter of pixels
    does not show; added in squares. sampled : `found` are some of the points, to check that the light was the same in
    all frames, and all points come from the position map. start_sigma_px : a chain may begin at a point that the filter
    missed if its standard deviation is smaller. release_lines : called if it was, before the largest
    allocation.
    """
    borders = np.concatenate([[0], np.cumsum([len(each.points_px) for each in found], dtype=np.int64)])
    parts = [slice(a, b) for a, b in pairwise(borders)]
    count = int(borders[-1])
    arguments = fit_arguments(measured, usable)
    clear = cv2.erode(usable.view(np.uint8), np.ones((7, 7), dtype=np.uint8), borderValue=0)
    refined, targets, disagreement = allocate_points(count), np.zeros(count), np.zeros(len(found))
    scatter_px = np.zeros(len(found))
    started, landed = _allocate_marks(len(found), usable.shape)
    for index, (points, part) in enumerate(zip(found, parts, strict=True)):
        starts = np.ascontiguousarray(points.points_px)
        in_bands(_target_kernel, len(starts), starts, code, position_table[index], targets[part])
        # Only for the points of this frame.
        noise_px, distance = np.zeros(len(starts)), np.zeros(len(starts))
        frame_points = FittedPoints(
            refined.points[part], refined.normals[part], refined.sigma_px[part], refined.found[part], noise_px
        )
        in_bands(fit_kernel, len(starts), *arguments, starts, targets[part], frame_points, rows_at_least=MIN_POINTS)
        own_sigma = np.ascontiguousarray(points.sigma_px)
        in_bands(_combine_kernel, len(starts), starts, own_sigma, clear, coarsest_px, frame_points, distance)
        distances = _subsample(distance, frame_points.found)
        disagreement[index] = _significant_median(distances)
        scatter_px[index] = _excess_scatter(distances, _subsample(own_sigma, frame_points.found))
        if not sampled:
            _mark_points(starts, frame_points, part.start, index, started, landed)
    excess = _excess_disagreement(disagreement)
    if np.isfinite(excess).any() and np.nanmax(np.abs(excess)) > max_disagreement_px:
        originals = found.copy()
        found.clear()
        moved_px, shared_px = _frame_displacements(disagreement)
        frame_sigma_px = np.sqrt(moved_px**2 + shared_px**2 + scatter_px**2)
        return Refinement(originals, disagreement, False, frame_sigma_px)
    release_lines()
    if sampled:
        found[:] = [points.head(0) for points in found]
        refined, targets, parts = allocate_points(0), np.zeros(0), [slice(0, 0)] * len(found)
    frame, *crossings = _find_crossings(
        measured, usable, code, position_table, step_px, started, landed, refined, targets,
        _EXTENSION_PX if sampled else 0.0,
    )  # fmt: skip
    # Released, because each of the next steps takes as much memory.
    del started, targets
    added = allocate_points(len(frame))
    in_bands(fit_kernel, len(frame), *arguments, *crossings, added, rows_at_least=MIN_POINTS)
    in_bands(_accept_kernel, len(frame), frame, coarsest_px, landed, added)
    del landed, crossings
    new_borders = np.searchsorted(frame, np.arange(len(found) + 1))
    new_parts = [slice(a, b) for a, b in pairwise(new_borders)]

    def merge(first: int, last: int) -> None:
        # In place, to release the memory of its parts.
        for index in range(first, last):
            found[index] = _merge_points(
                found[index], refined, parts[index], added, new_parts[index], extra_sigma_px, start_sigma_px
            )  # fmt: skip

    in_bands(merge, len(found))
    merged = found.copy()
    found.clear()
    moved_px, shared_px = _frame_displacements(excess)
    return Refinement(merged, disagreement, True, np.hypot(_phase_gains(len(merged)) @ moved_px, shared_px))


def _merge_points(
    points: LinePoints, refined: FittedPoints, part: slice, added: FittedPoints, new_part: slice,
    extra_sigma_px: NDArray[np.float32] | None, start_sigma_px: float,
) -> LinePoints:  # fmt: skip
    """Valid points of one frame: those of the filter, and those that it missed."""
    valid, new_valid = refined.found[part], added.found[new_part]
    first, count = int(np.count_nonzero(valid)), int(np.count_nonzero(new_valid))
    out = np.zeros((first + count, 2)), np.zeros((first + count, 2)), np.zeros(first + count)
    strength, strong = np.zeros(first + count), np.zeros(first + count, dtype=np.bool_)
    for filled, fitted, extra in zip(out, refined[:3], added[:3], strict=True):
        np.compress(valid, fitted[part], axis=0, out=filled[:first])
        np.compress(new_valid, extra[new_part], axis=0, out=filled[first:])
    np.compress(valid, points.strength, out=strength[:first])
    np.compress(valid, points.strong, out=strong[:first])
    # Chains begin at points of the filter; points that it missed come after, the most accurate first.
    strength[first:] = _MISSED_STRENGTH / out[2][first:]
    strong[first:] = out[2][first:] < start_sigma_px
    sigma_px = out[2]
    if extra_sigma_px is not None:
        columns, rows = np.rint(out[0]).astype(np.intp).T
        sigma_px = np.hypot(sigma_px, extra_sigma_px[rows, columns])
    return LinePoints(points_px=out[0], normals=out[1], strength=strength, strong=strong, sigma_px=sigma_px)


def _subsample(values: FloatArray, valid: NDArray[np.bool_]) -> FloatArray:
    """Valid values of an even sample."""
    step = max(1, -(-len(values) // _MAX_FOR_MEDIAN))
    return values[::step][valid[::step]]


def _significant_median(distance: FloatArray) -> float:
    """Median, less three of its own standard deviations, as few or noisy points prove little. NaN without values."""
    if not len(distance):
        return np.nan
    median = float(np.median(distance))
    scatter = 1.4826 * float(np.median(np.abs(distance - median)))
    # The standard deviation of a median is 1.2533/√n of that of its values; a filter correlates some five points.
    error = 1.2533 * scatter * np.sqrt(_CORRELATED_POINTS / len(distance))
    return float(np.copysign(max(abs(median) - 3 * error, 0.0), median))


def _excess_scatter(distance: FloatArray, sigma_px: FloatArray) -> float:
    """Standard deviation of the distances about their median beyond their noise, px; 0 without values."""
    if not len(distance):
        return 0.0
    scatter = 1.4826 * float(np.median(np.abs(distance - np.median(distance))))
    return float(np.sqrt(max(scatter**2 - float(np.median(sigma_px)) ** 2, 0.0)))


def _phase_gains(frames: int) -> FloatArray:
    """(frames, frames) float64: motion of the phase at the lines of each frame for a displacement of those of another.

    With I_k = cos(φ - 2πk/N), the phase of Σ I_k exp(2πik/N) moves by 2/N Σ sin²(φ - 2πk/N) d_k.
    """
    angle = np.pi * np.subtract.outer(np.arange(frames), np.arange(frames)) * 2 / frames
    return np.asarray(2 / frames * np.sin(angle) ** 2)


def _frame_displacements(distance_px: FloatArray) -> tuple[FloatArray, float]:
    """Displacement of the lines of each frame, (frames,) px, and the standard deviation of their common part, px.

    Lines displaced by d move the phase by G d (`_phase_gains`): their distance from it is (1 - G) d, NaN without any.
    A displacement of all frames alike is not visible; if they are independent, its variance is that of one over their
    number.
    """
    frames = len(distance_px)
    moved = np.linalg.pinv(np.eye(frames) - _phase_gains(frames)) @ np.nan_to_num(distance_px)
    return np.asarray(moved), float(np.sqrt(np.sum(moved**2) / ((frames - 1) * frames)))


def _excess_disagreement(disagreement: FloatArray) -> FloatArray:
    """Disagreement of each frame beyond that of all frames, (frames,) px.

    On a surface that is curved across a line, the middle of the line is displaced from the projector's by width²/8
    times the second derivative of its position, in all frames alike.
    """
    shared = np.nanmedian(disagreement) if np.isfinite(disagreement).any() else 0.0
    beyond = disagreement - shared
    return np.where(np.abs(disagreement) < np.abs(beyond), disagreement, beyond)


@kernel
def _combine_kernel(
    first: int, last: int, starts: Any, filter_sigma: Any, clear: Any, coarsest: float, fitted: Any, distance: Any
) -> None:
    """Combine each point with the position in its own frame, and store in `distance` how far the fit moved it.

    If the camera's pixels are finer than the projector's, 5 x 5 of them contain only a part of a stripe, and its own
    frame may be more accurate: the weight of each is its share of the inverse variance. The filter counts only clear of
    borders, where both agree, and where it is more accurate than the fit by noise alone: edges of a print, which make
    pixels scatter more, displace a filter without increasing its stated error.
    """
    points, normals, sigma, valid, noise = fitted
    for i in range(first, last):
        valid[i] = valid[i] and sigma[i] < coarsest
        x, y = starts[i, 0], starts[i, 1]
        distance[i] = (points[i, 0] - x) * normals[i, 0] + (points[i, 1] - y) * normals[i, 1]
        if not valid[i] or not filter_sigma[i] < noise[i] or not clear[int(np.rint(y)), int(np.rint(x))]:
            continue
        variance = sigma[i] * sigma[i]
        summed_variance = variance + filter_sigma[i] * filter_sigma[i]
        if distance[i] * distance[i] < 9 * summed_variance:
            weight = variance / max(summed_variance, 1e-30)
            points[i, 0] -= weight * distance[i] * normals[i, 0]
            points[i, 1] -= weight * distance[i] * normals[i, 1]
            sigma[i] *= np.sqrt(1 - weight)


@kernel
def _target_kernel(first: int, last: int, points: Any, code: Any, position_table: Any, targets: Any) -> None:
    """Fill in the position of the line of each point, NaN where its pixel may mean two. position_table : (cells,)."""
    for i in range(first, last):
        x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
        targets[i] = np.nan
        if code.lowest[y, x] >= 0:
            low = position_table[code.lowest[y, x]]
            if low == position_table[code.highest[y, x]]:
                targets[i] = low


def _allocate_marks(frames: int, shape: tuple[int, int]) -> tuple[IntArray, NDArray[np.uint8]]:
    """Empty arrays for `_mark_points`: (H, W, 2) int32, and (frames / 8, H, W) uint8, a bit for each frame."""
    return np.zeros((*shape, _LINES_PER_PIXEL), dtype=np.int32), np.zeros((-(-frames // 8), *shape), dtype=np.uint8)


def _mark_points(
    starts: FloatArray, fitted: FittedPoints, first: int, frame: int, started: IntArray, landed: NDArray[np.uint8]
) -> None:
    """Mark the pixel at which each valid point of a frame started (with its index + 1), and the pixel at which it
    ended.
    """
    valid = np.flatnonzero(fitted.found)
    columns, rows = np.rint(starts[valid]).astype(np.intp).T
    # Of several that start at a pixel the last one counts.
    started[rows, columns, frame % _LINES_PER_PIXEL] = first + valid + 1
    columns, rows = np.rint(fitted.points[valid]).astype(np.intp).T
    landed[frame >> 3, rows, columns] |= np.uint8(1 << (frame & 7))


@kernel_part(inline="always")
def _is_occupied(landed: Any, frame: int, y: int, x: int) -> bool:
    return bool(landed[frame >> 3, y, x] >> (frame & 7) & 1)


@kernel
def _accept_kernel(first: int, last: int, frame: Any, coarsest: float, landed: Any, fitted: Any) -> None:
    """Keep only points that are accurate enough and end where their line has none."""
    points, _, sigma, valid, _ = fitted
    for i in range(first, last):
        x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
        valid[i] = valid[i] and sigma[i] < coarsest and not _is_occupied(landed, frame[i], y, x)
