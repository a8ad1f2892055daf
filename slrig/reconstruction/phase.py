"""What all line frames say together: the projector position at every pixel, and stripe points refined by it.

A stripe's own frame tells its centre from a few pixels. The other shifts light the same patch of surface, so the phase
of their light tells the projector position there as well, at every pixel: x = n/2π · arg Σ I_k exp(2πi centre_k / n).
A local surface fitted to those positions, solved for the line's own column, uses the light of all shifts. It holds
where stripes are squeezed together at a grazing view, and beside a shadow, where a filter reaches over the border
and a fit merely has fewer pixels. Only the first harmonic of the light is used: neither the stripe's shape nor the
projector's response bends it. What it does ask for is the same light in every frame, and that is checked: each frame's
own stripes must lie where all frames together put them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.stripes import LinePoints
from slrig.reconstruction.surface_fit import fit_kernel, stencils

_LEAST_GRADIENT = 0.05
_SURE_PX = 0.15
_FAINT = 1e-6
_POINTS_TIED = 5
_ROWS = 16  # rows, and points, that one thread takes at a time
_CLEAR_PX = 0.12
_CROSSING_PX = 0.62  # more than half a pixel: two neighbours' noisy slopes must not both miss a line between them


@dataclass(frozen=True, slots=True)
class PositionMap:
    """The projector position of one axis at every pixel.

    position : (H, W) float32, px, NaN where refused; sigma : (H, W) float32, its standard deviation from noise, px,
    NaN where the position is a code cell's middle and no phase tells more.
    """

    position: NDArray[np.float32]
    sigma: NDArray[np.float32]


def has_phase(frames: AxisFrames, /) -> bool:
    """Whether every shift of the line pattern was shown, so that its light tells the phase at each pixel."""
    patterns = frames.line_patterns
    return len(patterns) > 0 and len(patterns) == patterns[0].period_px


def position_map(frames: AxisFrames, noise: NoiseModel, code: CodeMap, cell_position: FloatArray, /) -> PositionMap:
    """The projector position at every decoded pixel.

    cell_position : (cells,) float64, centre of each code cell. The code tells the period, the phase of the line frames
    the position within it; without line frames the middle of the code interval stands. A pixel of which a line frame
    is clipped has no position: its phase is bent.
    """
    patterns = frames.line_patterns
    phase = has_phase(frames)
    # An interval of more than half a period may hold the phase twice, and does not tell which.
    widest_px = 0.5 * patterns[0].period_px if phase else np.inf
    middle = _middle_kernel(code.lowest, code.highest, code.refusal, cell_position, widest_px)
    if not phase:
        return PositionMap(middle, np.full_like(middle, np.nan))
    period = patterns[0].period_px
    angle = 2 * np.pi / period * np.array([p.centre_px for p in patterns])
    position, sigma = _phase_kernel(
        frames.lines, np.cos(angle), np.sin(angle), float(period), middle, noise.read_variance, noise.slope,
        np.float32(frames.clipped_at),
    )  # fmt: skip
    return PositionMap(position, sigma)


@njit(cache=True, nogil=True, parallel=True)
def _middle_kernel(lowest: Any, highest: Any, refusal: Any, cell_position: Any, widest: float) -> Any:
    """(H, W) float32: the middle of each pixel's code interval, px, NaN where it is refused or too wide."""
    out = np.full(lowest.shape, np.nan, dtype=np.float32)
    for y in prange(lowest.shape[0]):
        for x in range(lowest.shape[1]):
            if refusal[y, x] == 0:
                low, high = cell_position[lowest[y, x]], cell_position[highest[y, x]]
                if high - low <= widest:
                    out[y, x] = 0.5 * (low + high)
    return out


@njit(cache=True, nogil=True, parallel=True)
def _phase_kernel(
    lines: Any, cosine: Any, sine: Any, period: float, middle: Any, read: float, slope: float, clipped_at: float
) -> Any:
    count, rows, columns = lines.shape
    out = np.full((rows, columns), np.nan, dtype=np.float32)
    sigma = np.full((rows, columns), np.nan, dtype=np.float32)
    scale = period / (2 * np.pi)
    for block in prange((rows + _ROWS - 1) // _ROWS):
        sums = np.zeros((5, columns))
        brightest = np.zeros(columns, dtype=np.float32)
        for y in range(block * _ROWS, min(rows, (block + 1) * _ROWS)):
            sums[:] = 0
            brightest[:] = 0
            for k in range(count):
                np.maximum(brightest, lines[k, y], brightest)
                _add_line(lines[k, y], cosine[k], sine[k], sums[0], sums[1])
                _add_variance(lines[k, y], cosine[k], sine[k], read, slope, sums[2], sums[3], sums[4])
            for x in range(columns):
                real, imaginary = sums[0, x], sums[1, x]
                squared = real * real + imaginary * imaginary
                if np.isnan(middle[y, x]) or squared <= 0 or brightest[x] >= clipped_at:
                    continue
                # ∂φ/∂I_k = (sin θ_k cos φ - cos θ_k sin φ) / |C|
                variance = (
                    sums[2, x] * real * real - 2 * sums[3, x] * real * imaginary + sums[4, x] * imaginary * imaginary
                )
                within = np.arctan2(imaginary, real) * scale
                out[y, x] = within + period * np.rint((middle[y, x] - within) / period)
                sigma[y, x] = scale * np.sqrt(max(variance, 0.0)) / squared
    return out, sigma


# Loops of few arrays each: with more, the compiler gives up proving that they do not overlap, and uses no vectors.
@njit(cache=True, nogil=True)
def _add_line(line: Any, cosine: float, sine: float, real: Any, imaginary: Any) -> None:
    for x in range(len(line)):
        real[x] += line[x] * cosine
    for x in range(len(line)):
        imaginary[x] += line[x] * sine


@njit(cache=True, nogil=True)
def _add_variance(line: Any, cosine: float, sine: float, read: float, slope: float, ss: Any, sc: Any, cc: Any) -> None:
    """Add the variance of a frame times sine², sine · cosine and cosine²."""
    for x in range(len(line)):
        ss[x] += (read + slope * max(line[x], 0.0)) * (sine * sine)
    for x in range(len(line)):
        sc[x] += (read + slope * max(line[x], 0.0)) * (sine * cosine)
    for x in range(len(line)):
        cc[x] += (read + slope * max(line[x], 0.0)) * (cosine * cosine)


def fitted_points(
    seen: PositionMap, usable: NDArray[np.bool_], starts_px: FloatArray, targets_px: FloatArray, /
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Points of the image at which a local surface of the position map has the wanted positions.

    usable : (H, W) bool, pixels whose light is of one surface; starts_px : (n, 2) float64 (x, y); targets_px : (n,)
    float64, the column of each point's line.
    A quadratic surface is fitted to the 5 x 5 pixels round the start with Gaussian weights, a plane where pixels are
    missing; pixels that others in between separate from the start are left out. From the start the point moves along
    the gradient by Newton's method.

    Returns points (n, 2), normals (n, 2) along the gradient, sigma_px (n,), the standard deviation along the normal
    from noise or from the scatter of the pixels about the surface, whichever is larger, and found (n,) bool.
    """
    # A 5 x 5 neighbourhood is whole where the mask's erosion by it stands.
    whole = cv2.erode(usable.view(np.uint8), np.ones((5, 5), dtype=np.uint8), borderValue=0)
    points, normals, deviation, found = fit_kernel(
        seen.position, seen.sigma, usable, whole, np.ascontiguousarray(starts_px),
        np.asarray(targets_px, dtype=np.float64), *stencils(),
    )  # fmt: skip
    return points, normals, deviation, found


def line_crossings(
    seen: PositionMap, usable: NDArray[np.bool_], code: CodeMap, position_of: FloatArray, /
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Where lines cross pixels, by the position map alone: a start for every stripe that the light can hold.

    position_of : (frames, cells) float64, as for `identify`. A line crosses a pixel when it passes within 0.62 px of
    its centre, along either axis.
    Returns frame (n,) int32, starts_px (n, 2) and targets_px (n,), frame by frame, row by row.
    """
    shape = (len(position_of), *usable.shape)
    none = np.zeros(shape, dtype=np.int32), np.zeros(shape, dtype=np.uint8), np.zeros((0, 2)), np.zeros((0, 2))
    return _crossings(seen, usable, code, position_of, *none)


def _crossings(
    seen: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_of: FloatArray,
    started: IntArray,
    landed: NDArray[np.uint8],
    moved: FloatArray,
    normals: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """The crossings, less those from which a fit would surely land at a pixel that has its point."""
    by_cell = np.ascontiguousarray(position_of.T)
    given = (seen.position, usable, code.lowest, code.highest, by_cell, started, landed, moved, normals)
    frames, rows = len(position_of), len(usable)
    counts = np.zeros((frames, rows), dtype=np.int64)
    _crossing_kernel(*given, counts, False, np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0))
    ends = np.cumsum(counts.ravel()).reshape(frames, rows)
    total = int(ends[-1, -1]) if ends.size else 0
    found = np.zeros(total, dtype=np.int32), np.zeros((total, 2)), np.zeros(total)
    _crossing_kernel(*given, ends - counts, True, *found)
    return found


@njit(cache=True, nogil=True, parallel=True)
def _crossing_kernel(
    position: Any, usable: Any, lowest: Any, highest: Any, by_cell: Any,
    started: Any, landed: Any, moved: Any, normals: Any, place: Any, fill: bool, frame: Any, starts: Any, targets: Any,
) -> None:  # fmt: skip
    """Count the crossings of each frame and row in `place`; or put them where `place` says that they begin."""
    rows, columns = position.shape
    frames = by_cell.shape[1]
    for y in prange(1, rows - 1):
        for x in range(1, columns - 1):
            if not usable[y, x]:
                continue
            gx = _slope(position[y, x - 1], position[y, x], position[y, x + 1], usable[y, x - 1], usable[y, x + 1])
            gy = _slope(position[y - 1, x], position[y, x], position[y + 1, x], usable[y - 1, x], usable[y + 1, x])
            squared = gx * gx + gy * gy
            if not squared > _LEAST_GRADIENT * _LEAST_GRADIENT:
                continue
            reach = _CROSSING_PX * (abs(gx) + abs(gy)) + 1e-6
            first, last = lowest[y, x], highest[y, x]
            for k in range(frames):
                low = by_cell[first, k]
                miss = low - position[y, x]
                if not abs(miss) <= reach or low != by_cell[last, k]:
                    continue
                dx, dy = miss * gx / squared, miss * gy / squared
                if abs(dx) > _CROSSING_PX or abs(dy) > _CROSSING_PX:
                    continue
                sy, sx = int(np.rint(y + dy)), int(np.rint(x + dx))
                i = started[k, sy, sx] - 1
                if i >= 0 and by_cell[lowest[sy, sx], k] == low:
                    # The same surface was fitted for a point that began here: this one would end beside it, straight
                    # across the line from where it began.
                    away = (moved[i, 0] - x - dx) * normals[i, 0] + (moved[i, 1] - y - dy) * normals[i, 1]
                    end_x, end_y = x + dx + away * normals[i, 0], y + dy + away * normals[i, 1]
                    at_x, at_y = int(np.rint(end_x)), int(np.rint(end_y))
                    clear = max(abs(end_x - at_x), abs(end_y - at_y)) < 0.5 - _CLEAR_PX
                    if clear and landed[k, at_y, at_x]:
                        continue
                if fill:
                    at = place[k, y]
                    frame[at] = k
                    starts[at, 0], starts[at, 1] = x + dx, y + dy
                    targets[at] = low
                place[k, y] += 1


@njit(cache=True, nogil=True, inline="always")
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
    in all frames it is next to nothing.
    """

    points: list[LinePoints]
    disagreement_px: FloatArray


def refined(
    found: Sequence[LinePoints],
    seen: PositionMap,
    usable: NDArray[np.bool_],
    code: CodeMap,
    position_of: FloatArray,
    /,
    *,
    coarsest_px: float = 0.5,
) -> Refinement:
    """Refine the points of all line frames of one axis.

    Points of mixed light (not `usable`) or of no single line are left out, as are those whose standard deviation
    exceeds coarsest_px pixels. position_of : (frames, cells) float64, as for `identify`.
    """
    counts = np.array([len(each.points_px) for each in found], dtype=np.int64)
    borders = np.concatenate([[0], np.cumsum(counts)])
    starts = np.concatenate([np.zeros((0, 2)), *(each.points_px for each in found)])
    targets = _target_kernel(starts, borders, code.lowest, code.highest, position_of)
    moved, normals, sigma_px, good = fitted_points(seen, usable, starts, targets)
    good &= sigma_px < coarsest_px
    away = np.einsum("ij,ij->i", moved - starts, normals)
    parts = [slice(a, b) for a, b in pairwise(borders)]
    disagreement = np.array([_sure_median(away[p][good[p]]) for p in parts])
    own_sigma_px = np.concatenate([np.zeros(0), *(each.sigma_px for each in found)])
    weight = _own_weight(starts, away, own_sigma_px, sigma_px, usable)
    moved = moved - (weight * away)[:, None] * normals
    sigma_px = np.where(weight > 0, np.sqrt(1 - weight) * sigma_px, sigma_px)
    started, landed = _taken_kernel(starts, moved, good, borders, seen.position.shape)
    frame, missed_starts, missed_targets = _crossings(seen, usable, code, position_of, started, landed, moved, normals)
    missed, missed_normals, missed_sigma_px, new = fitted_points(seen, usable, missed_starts, missed_targets)
    columns, rows = np.rint(missed).astype(np.int32).T
    new &= (missed_sigma_px < coarsest_px) & (landed[frame, rows, columns] == 0)
    new_borders = np.searchsorted(frame, np.arange(len(found) + 1))
    result = []
    for index, points in enumerate(found):
        old, more = parts[index], slice(new_borders[index], new_borders[index + 1])
        kept, added = good[old], new[more]
        result.append(
            LinePoints(
                points_px=np.concatenate([moved[old][kept], missed[more][added]]),
                normals=np.concatenate([normals[old][kept], missed_normals[more][added]]),
                # Chains begin at what the filter found; what it missed comes after, the surest first.
                strength=np.concatenate([points.strength[kept], _FAINT / missed_sigma_px[more][added]]),
                strong=np.concatenate([points.strong[kept], missed_sigma_px[more][added] < _SURE_PX]),
                sigma_px=np.concatenate([sigma_px[old][kept], missed_sigma_px[more][added]]),
            )
        )
    return Refinement(result, disagreement)


def _sure_median(away: FloatArray) -> float:
    """The median, less three of its own standard deviations: of few or noisy points it tells little. NaN of none."""
    if not len(away):
        return np.nan
    median = float(np.median(away))
    scatter = 1.4826 * float(np.median(np.abs(away - median)))
    # A median's standard deviation is 1.2533/√n of its values', and a filter ties some five points together.
    error = 1.2533 * scatter * np.sqrt(_POINTS_TIED / len(away))
    return float(np.copysign(max(abs(median) - 3 * error, 0.0), median))


def _own_weight(
    starts: FloatArray, away: FloatArray, own_sigma_px: FloatArray, sigma_px: FloatArray, usable: NDArray[np.bool_]
) -> FloatArray:
    """(n,) how much of each point's own frame belongs in the refined point: its share of the inverse variance.

    Where the camera's pixels are finer than the projector's, five of them hold but a part of a stripe, and the stripe's
    own frame may know better. A filter is trusted clear of borders only, and where both agree.
    """
    clear = cv2.erode(usable.view(np.uint8), np.ones((7, 7), dtype=np.uint8), borderValue=0)
    columns, rows = np.rint(starts).astype(np.int32).T
    surer = (own_sigma_px < sigma_px) & (clear[rows, columns] > 0)
    surer &= np.abs(away) < 3 * np.hypot(own_sigma_px, sigma_px)
    return np.where(surer, sigma_px**2 / np.maximum(sigma_px**2 + own_sigma_px**2, 1e-30), 0.0)


@njit(cache=True, nogil=True, parallel=True)
def _target_kernel(points: Any, borders: Any, lowest: Any, highest: Any, position_of: Any) -> Any:
    """(n,) the position of the line that each point lies on, NaN where its pixel may mean two."""
    targets = np.full(len(points), np.nan)
    for frame in prange(len(borders) - 1):
        for i in range(borders[frame], borders[frame + 1]):
            x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
            if lowest[y, x] >= 0:
                low = position_of[frame, lowest[y, x]]
                if low == position_of[frame, highest[y, x]]:
                    targets[i] = low
    return targets


@njit(cache=True, nogil=True, parallel=True)
def _taken_kernel(starts: Any, moved: Any, good: Any, borders: Any, shape: Any) -> Any:
    """Which good point started at each pixel (one more than its index), and whether one landed there; per frame."""
    started = np.zeros((len(borders) - 1, shape[0], shape[1]), dtype=np.int32)
    landed = np.zeros((len(borders) - 1, shape[0], shape[1]), dtype=np.uint8)
    for frame in prange(len(borders) - 1):
        for i in range(borders[frame], borders[frame + 1]):
            if good[i]:
                started[frame, int(np.rint(starts[i, 1])), int(np.rint(starts[i, 0]))] = i + 1
                landed[frame, int(np.rint(moved[i, 1])), int(np.rint(moved[i, 0]))] = 1
    return started, landed
