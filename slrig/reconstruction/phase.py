"""Projector position at every pixel from all line frames, its centroid correction, and depth and shadow edges.

A stripe's own frame tells its centre from a few pixels. The other shifts light the same patch of surface, so the phase
of their light tells the projector position there as well, at every pixel: x = n/2π · arg Σ I_k exp(2πi centre_k / n).
Only the first harmonic of the light is used: neither the stripe's shape nor the projector's response bends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, LineShift, has_even_shifts
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames, band_rows, rows_of
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.surface_fit import stencils


class PositionMap(NamedTuple):
    """The projector position of one axis at every pixel.

    position : (H, W) float32, px, NaN where refused; sigma : (H, W) float32, its standard deviation from noise, px,
    NaN where the position is a code cell's middle and no phase tells more.
    """

    position: NDArray[np.float32]
    sigma: NDArray[np.float32]


def line_step_px(patterns: Sequence[LineShift], /) -> int | None:
    """The step of shifts that divide their period evenly into three or more, px, so that their light tells the phase at
    each pixel; None for others. patterns : of one period and width, by shift.
    """
    return patterns[0].period_px // len(patterns) if has_even_shifts(patterns) else None


def has_phase(frames: AxisFrames, /) -> bool:
    """Whether the lines' light tells the phase at each pixel."""
    return line_step_px(frames.line_patterns) is not None


def position_map(
    frames: AxisFrames, noise: NoiseModel, code: CodeMap, cell_position: FloatArray, /, *, by_phase: bool = True
) -> PositionMap:
    """The projector position at every decoded pixel.

    cell_position : (cells,) float64, centre of each code cell. The code tells the period, the phase of the line frames
    the position within it; without line frames, or not by_phase, the middle of the code interval stands. A pixel of
    which a line frame is clipped has no position by phase: it is bent.
    """
    patterns = frames.line_patterns
    phase = by_phase and has_phase(frames)
    # An interval of more than half a period may hold the phase twice, and does not tell which.
    widest_px = 0.5 * patterns[0].period_px if phase else np.inf
    shape = code.lowest.shape
    position, sigma = (np.full(shape, np.nan, dtype=np.float32) for _ in range(2))
    if not phase:
        in_bands(_middle_kernel, shape[0], code, cell_position, widest_px, position)
        return PositionMap(position, sigma)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        middle = np.full((last - first, shape[1]), np.nan, dtype=np.float32)
        _middle_kernel(0, last - first, code.rows(rows), cell_position, widest_px, middle)
        lines = rows_of(frames.lines, rows)
        position[rows], sigma[rows] = _phases(lines, patterns, noise.rows(rows), middle, np.float32(frames.clipped_at))

    in_bands(band, shape[0], rows_at_most=band_rows(frames.lines, shape[1]))
    return PositionMap(position, sigma)


def _phases(
    lines: NDArray[np.float32], patterns: tuple[LineShift, ...], noise: NoiseModel, middle: NDArray[np.float32],
    clipped_at: np.float32,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Position and its deviation, (rows, W) float32 each, NaN where unknown.

    lines : (n, rows, W) float32; middle : (rows, W) float32, of the code's intervals, px.
    """
    period = patterns[0].period_px
    angle = 2 * np.pi / period * np.array([p.centre_px for p in patterns])
    given = lines, np.cos(angle), np.sin(angle), float(period), middle

    def phases(read: float, slope: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        position, sigma = (np.full_like(middle, np.nan) for _ in range(2))
        _phase_kernel(0, len(middle), *given, read, slope, clipped_at, position, sigma)
        return position, sigma

    if noise.read_share is None or noise.shot_share is None:
        return phases(noise.read_variance, noise.slope)
    # The variance is a sum of one part by read noise and one by shot noise, each with its own share at each pixel.
    position, by_read = phases(noise.read_variance, 0.0)
    _, by_shot = phases(0.0, noise.slope)
    return position, np.sqrt(noise.read_share * by_read**2 + noise.shot_share * by_shot**2)


@kernel
def _middle_kernel(first: int, last: int, code: Any, cell_position: Any, widest: float, out: Any) -> None:
    """Fill in the middle of each pixel's code interval, px, where it is neither refused nor too wide."""
    for y in range(first, last):
        for x in range(out.shape[1]):
            if code.refusal[y, x] == 0:
                low, high = cell_position[code.lowest[y, x]], cell_position[code.highest[y, x]]
                if high - low <= widest:
                    out[y, x] = 0.5 * (low + high)


@kernel
def _phase_kernel(
    first: int, last: int, lines: Any, cosine: Any, sine: Any, period: float, middle: Any, read: float, slope: float,
    clipped_at: float, out: Any, sigma: Any,
) -> None:  # fmt: skip
    count, _, columns = lines.shape
    scale = period / (2 * np.pi)
    sums = np.zeros((5, columns))
    brightest = np.zeros(columns, dtype=np.float32)
    for y in range(first, last):
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
            variance = sums[2, x] * real * real - 2 * sums[3, x] * real * imaginary + sums[4, x] * imaginary * imaginary
            within = np.arctan2(imaginary, real) * scale
            out[y, x] = within + period * np.rint((middle[y, x] - within) / period)
            sigma[y, x] = scale * np.sqrt(max(variance, 0.0)) / squared


# Loops of few arrays each: with more, the compiler gives up proving that they do not overlap, and uses no vectors.
@kernel_part
def _add_line(line: Any, cosine: float, sine: float, real: Any, imaginary: Any) -> None:
    for x in range(len(line)):
        real[x] += line[x] * cosine
    for x in range(len(line)):
        imaginary[x] += line[x] * sine


@kernel_part
def _add_variance(line: Any, cosine: float, sine: float, read: float, slope: float, ss: Any, sc: Any, cc: Any) -> None:
    """Add the variance of a frame times sine², sine · cosine and cosine²."""
    for x in range(len(line)):
        ss[x] += (read + slope * max(line[x], 0.0)) * (sine * sine)
    for x in range(len(line)):
        sc[x] += (read + slope * max(line[x], 0.0)) * (sine * cosine)
    for x in range(len(line)):
        cc[x] += (read + slope * max(line[x], 0.0)) * (cosine * cosine)


class FittedPoints(NamedTuple):
    """What `fit_kernel` fills in: points (n, 2), normals (n, 2) along the gradient, sigma_px (n,), found (n,) bool.

    noise_px : (n,) float64, what noise alone makes of sigma_px, which is larger where pixels scatter more than that.
    """

    points: FloatArray
    normals: FloatArray
    sigma_px: FloatArray
    found: NDArray[np.bool_]
    noise_px: FloatArray


def windows(seen: PositionMap, usable: NDArray[np.bool_]) -> tuple[Any, ...]:
    """What `fit_kernel` knows of the map: the first of its arguments."""
    # A 5 x 5 neighbourhood is whole where the mask's erosion by it stands.
    whole = cv2.erode(usable.view(np.uint8), np.ones((5, 5), dtype=np.uint8), borderValue=0)
    return seen.position, seen.sigma, usable, whole, *stencils()


def no_points(count: int) -> FittedPoints:
    """Room for what `fit_kernel` fills in."""
    found = np.zeros(count, dtype=np.bool_)
    return FittedPoints(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count), found, np.zeros(count))


_FITTED_PX = 5  # by as many pixels a point is fitted
_FLAT_PX = 1.0  # projector px of second difference over six pixels: more is two surfaces with a step between
_APART_PX = 4.0  # projector px of second difference over two pixels: more than an edge of a print displaces them
_SIXTH_GAIN = 2 * (45**2 + 9**2 + 1) / 60**2  # variance of the sixth-order difference of unit noise
_DOUBT = 4.0  # squared: fine structure of two standard deviations counts by half
_TURNS = 2  # the second takes the surface's slope from positions that are no longer displaced
_REACH = 5  # px either way that tell the blur: an edge and the surface round it
_SMOOTHED_PX = 1.0  # about as the fit to the positions smooths them, so that the blur is the one that is best for it
_SURROUND_PX = 2.5
_EVERY = 4  # of rows and columns: edges are many, and each costs 121 neighbours
_GRADIENT_GAIN = (8 * np.pi * _SMOOTHED_PX**4) ** -0.5  # deviation of a smoothed derivative of unit noise
_LEAST_SIGMA = 2.0  # noise alone tells no blur: an edge must stand out of it, by its smoothed shift
_FARTHEST = 1.5  # px² from what is expected: more would be a blur of 1.4 px, or of none, and is told by shading
_LEAST_SHARE = 0.5  # of all edges: fewer than 0.12 are as near as that for shading, more than 0.8 for prints
_LEAST_EDGES = 30  # fewer may agree by chance
_PRIOR_SHARE = 0.5  # standard deviation of σ² over what is expected: of lenses more or less in focus


def at_pixel_centres(
    seen: PositionMap,
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    blur_px: float,
    /,
    *,
    clear: NDArray[np.bool_] | None = None,
) -> PositionMap:
    """The position map moved from the centroids of the pixels' light to their centres, to first order.

    contrast, deviation : (H, W) float32, white minus black and the standard deviation of its noise; blur_px : standard
    deviation of the camera's own blur, its pixel's area included, px. clear : (H, W) bool, pixels away from the borders
    of shadows: edges of a print there tell the blur, and blur_px is what is expected without any; None where it is
    known.

    The gradient of ln L is a difference of sixth order, that of the position one over six pixels; beside a border or a
    step both are plain central differences. What the sixth order tells beyond a difference over six pixels, and all of
    a plain difference, may be noise: such a d counts d⁴/(d⁴ + 16 σ⁴), σ its standard deviation by noise. A pixel that
    lacks a neighbour along an axis, or lies at a step, stays as it is along that axis.
    """
    brightness = np.full_like(contrast, np.nan)
    in_bands(_log_kernel, len(contrast), contrast, brightness)
    moved, shift = seen.position, np.zeros_like(seen.position)
    variance = blur_px**2
    for _ in range(_TURNS):
        in_bands(_shift_kernel, len(moved), moved, brightness, contrast, deviation, shift)
        if clear is not None:
            variance = _told_variance(seen, shift, contrast, deviation, clear, blur_px**2)
        moved = seen.position - np.float32(variance) * shift
    return PositionMap(moved, seen.sigma)


def third_order_px(
    measured: PositionMap, centred: PositionMap, usable: NDArray[np.bool_], blur_px: float, period_px: float, /
) -> NDArray[np.float32]:
    """(H, W): standard deviation, camera px, of what the first order leaves in points that are fitted to 5 x 5 pixels.

    It is the third order where brightness changes as sharply as the blur lets it, ∂³ ln L = ∂ ln L / σ²: the share
    σ²ω²s²/6 of what the first order displaced them by. It has either sign.
    """
    down, across = np.gradient(measured.position)
    share = (blur_px * 2 * np.pi / period_px) ** 2 / 6  # over s², and in projector px over s
    squared = share**2 * (down * down + across * across) * (centred.position - measured.position) ** 2
    squared[~(usable & np.isfinite(squared))] = 0
    mean = cv2.blur(squared, (_FITTED_PX, _FITTED_PX))
    return np.asarray(np.sqrt(np.maximum(mean, 0)), dtype=np.float32)  # running sums go a rounding below 0


def _told_variance(
    seen: PositionMap,
    shift: NDArray[np.float32],
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    clear: NDArray[np.bool_],
    expected: float,
    /,
) -> float:
    """Variance of the blur, px², by which the shifts make the positions smoothest.

    shift : (H, W) float32, of a unit variance; the rest as for `at_pixel_centres`. Shifts r and positions p, both
    smoothed and freed of a quadratic surface, give the least Σ w (p - σ² r)² over strong edges, with the expected value
    as one more observation. Where edges are few, or most are of shading, it stands alone.
    """
    inner = (clear & np.isfinite(seen.position)).view(np.uint8)
    whole = cv2.erode(inner, np.ones((2 * _REACH + 1,) * 2, dtype=np.uint8), borderValue=0)
    # Sums by row: those of all rows are then the same to the bit, however many cores share them.
    sums = np.zeros((len(shift), 5))
    in_bands(
        _edges_kernel, len(shift), *seen, shift, contrast, deviation, whole, _beyond_quadratic(), expected, sums
    )  # fmt: skip
    both, squared, misfit, count, edges = sums.sum(axis=0)
    if count < max(_LEAST_EDGES, _LEAST_SHARE * edges):
        return expected
    # Residuals larger than their weights say are so for all.
    told = max(1.0, (misfit - both * both / squared) / count)
    prior = 1 / (_PRIOR_SHARE * expected) ** 2
    return max(0.0, float((both / told + expected * prior) / (squared / told + prior)))


def _beyond_quadratic() -> FloatArray:
    """(11, 11) float64: weights of a Gaussian of 1 px, less what it sees of a quadratic surface about it."""
    at = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    near, about = (np.exp(-(x * x + y * y) / (2 * scale**2)) for scale in (_SMOOTHED_PX, _SURROUND_PX))
    near /= near.sum()
    seen = np.linalg.solve((basis * about) @ basis.T, basis @ near)
    return np.asarray((near - about * (seen @ basis)).reshape(len(at), len(at)))


@kernel
def _log_kernel(first: int, last: int, contrast: Any, out: Any) -> None:
    """Fill in the logarithm where there is light."""
    for y in range(first, last):
        for x in range(contrast.shape[1]):
            if contrast[y, x] > 0:
                out[y, x] = np.log(contrast[y, x])


@kernel
def _shift_kernel(
    first: int, last: int, position: Any, brightness: Any, contrast: Any, deviation: Any, out: Any
) -> None:
    """Fill in by how much a blur of unit variance displaces each position, 0 where nothing tells."""
    rows, columns = position.shape
    for y in range(max(first, 1), min(last, rows - 1)):
        for x in range(1, columns - 1):
            here = position[y, x]
            if np.isnan(here):
                continue
            shift = 0.0
            noise = deviation[y, x] / max(contrast[y, x], np.float32(1e-6))
            for dy, dx in ((0, 1), (1, 0)):
                before, after = position[y - dy, x - dx], position[y + dy, x + dx]
                if not abs(before - 2 * here + after) < _APART_PX:
                    continue
                slope = 0.5 * (after - before)
                # What may be noise: all of the plain difference, of the sixth order what the wide one does not tell.
                rise, gain = np.float32(0.0), 0.5
                fine = 0.5 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                if 3 * dy <= y < rows - 3 * dy and 3 * dx <= x < columns - 3 * dx:
                    before, after = position[y - 3 * dy, x - 3 * dx], position[y + 3 * dy, x + 3 * dx]
                    # Of one surface, and not of two with a step between them.
                    if abs(before - 2 * here + after) < _FLAT_PX:
                        slope = (after - before) / 6
                        far = brightness[y + 3 * dy, x + 3 * dx] - brightness[y - 3 * dy, x - 3 * dx]
                        sixth = (
                            45 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                            - 9 * (brightness[y + 2 * dy, x + 2 * dx] - brightness[y - 2 * dy, x - 2 * dx])
                            + far
                        ) / 60  # fmt: skip
                        if np.isfinite(sixth):
                            rise, gain = far / 6, _SIXTH_GAIN
                            fine = sixth - rise
                fourth, doubt = fine**4, (_DOUBT * gain * noise * noise) ** 2
                if fourth > 0:
                    rise += fine * (fourth / (fourth + doubt))
                shift += slope * rise
            out[y, x] = shift


@kernel(in_every_scan=False)
def _edges_kernel(
    first: int, last: int, position: Any, sigma: Any, shift: Any, contrast: Any, deviation: Any, whole: Any,
    stencil: Any, expected: float, sums: Any,
) -> None:  # fmt: skip
    """Fill in by row Σ w r p, Σ w r², Σ w p² and the count of edges that a lens can make, and the count of all."""
    reach = len(stencil) // 2
    gain = 1 / (2 * np.sqrt(np.pi) * _SMOOTHED_PX)
    for y in range(first + -first % _EVERY, last, _EVERY):
        for x in range(0, shift.shape[1], _EVERY):
            if not whole[y, x]:
                continue
            # The shift's noise is that of ln L times the slope of the position.
            gx = 0.5 * (position[y, x + 1] - position[y, x - 1])
            gy = 0.5 * (position[y + 1, x] - position[y - 1, x])
            least = _LEAST_SIGMA * _GRADIENT_GAIN * np.sqrt(gx * gx + gy * gy) * deviation[y, x] / contrast[y, x]
            if not abs(shift[y, x]) > 0:
                continue
            r = p = 0.0
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    weight = stencil[dy + reach, dx + reach]
                    r += weight * shift[y + dy, x + dx]
                    p += weight * (position[y + dy, x + dx] - position[y, x])
            if not abs(r) > least:
                continue
            sums[y, 4] += 1
            if not abs(p - expected * r) < _FARTHEST * abs(r):
                continue
            weight = 1 / (gain * sigma[y, x]) ** 2
            sums[y, 0] += weight * r * p
            sums[y, 1] += weight * r * r
            sums[y, 2] += weight * p * p
            sums[y, 3] += 1


_BESIDE_STEPS_PX = (0.04, 0.015)
"""What the light of the other surface displaces a point by in the first and the second pixel beside a step of depth.
Beside edges of terraces and boxes, rendered by others and by us, errors were 1.7 to 2.3 and 1.3 to 1.9 times what noise
alone states, 95 % of them below 4.8 and 3.7."""


@dataclass(frozen=True, slots=True)
class EdgeLimits:
    """How far from a border a stripe point must be, and what a border is.

    shadow_px, depth_px : radius of refusal round the lit area's border, and round a depth step, for a fit to pixels;
    filter_px : for a filter, whose window must be clear of the border.
    bend_px : a second difference of the projector position, over two camera pixels, that no surface makes,
    bend_share : unless it is below this share of the first difference, as on a surface seen at a grazing angle,
    bend_sigma : and this many standard deviations above that limit, so that the noise of a dark surface is none.
    smallest_shadow_px : unlit specks of fewer pixels than this are noise or dust, not shadow.
    """

    shadow_px: float = 2.0
    depth_px: float = 0.7
    filter_px: float = 2.0
    bend_px: float = 0.9
    bend_share: float = 0.5
    bend_sigma: float = 4.0
    smallest_shadow_px: int = 4

    def for_filters(self, blur_px: float) -> EdgeLimits:
        """The same limits for a filter; light mixes the further, the more than 1 px the stripes' width is."""
        reach_px = self.filter_px * max(1.0, blur_px)
        return replace(self, shadow_px=reach_px, depth_px=reach_px)


def near_edges(
    seen: PositionMap, unlit: NDArray[np.bool_], resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels near the lit area's border, and pixels near a depth step: two (H, W) bool maps.

    unlit : (H, W) bool; resolution_px : step of the position map (0 where phase makes it continuous), (H, W) if it
    varies.
    """
    return near_shadows(unlit, limits), near_steps(seen, resolution_px, limits)


def near_shadows(unlit: NDArray[np.bool_], limits: EdgeLimits, /) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the lit area's border; see `near_edges`."""
    return _within(_without_specks(unlit, limits.smallest_shadow_px), limits.shadow_px)


_SHADOW_BLURS = 3.0
"""Standard deviations of the camera's blur within which light fades out at a border: 2 px of the usual 0.65 px."""


def near_shadows_of(
    blur_px: float, near_shadow: NDArray[np.bool_], unlit: NDArray[np.bool_], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the lit area's border by a camera of this blur; near_shadow : by a usual one."""
    if _SHADOW_BLURS * blur_px <= limits.shadow_px:
        return near_shadow
    return near_shadows(unlit, replace(limits, shadow_px=_SHADOW_BLURS * blur_px))


def near_steps(
    seen: PositionMap, resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near a depth step; see `near_edges`."""
    limit_px = np.full(seen.position.shape, limits.bend_px + 2 * resolution_px, dtype=np.float32)
    bends = np.zeros(seen.position.shape, dtype=np.bool_)
    in_bands(
        _bend_kernel, len(bends), seen.position, np.nan_to_num(seen.sigma), limit_px, limits.bend_share,
        limits.bend_sigma, bends,
    )  # fmt: skip
    return _within(bends, limits.depth_px)


def _without_specks(unlit: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    _, labels, figures, _ = cv2.connectedComponentsWithStats(unlit.astype(np.uint8), connectivity=8)
    large = figures[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False
    return np.asarray(large[labels])


def beside_steps_px(near_step: NDArray[np.bool_], /) -> NDArray[np.float32]:
    """(H, W): a standard deviation of points, beside steps; see `_BESIDE_STEPS_PX`."""
    sigma_px, inside = np.zeros(near_step.shape, dtype=np.float32), near_step.view(np.uint8)
    for displaced_px in _BESIDE_STEPS_PX:
        wider = cv2.dilate(inside, np.ones((3, 3), np.uint8))
        sigma_px[wider > inside] = displaced_px
        inside = wider
    return sigma_px


def _within(mask: NDArray[np.bool_], radius_px: float) -> NDArray[np.bool_]:
    if not mask.any():
        return mask
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= radius_px)


@kernel
def _bend_kernel(
    first: int, last: int, position: Any, sigma: Any, limits: Any, share: float, sigmas: float, out: Any
) -> None:
    rows, columns = position.shape
    for y in range(max(first, 1), min(last, rows - 1)):
        for x in range(1, columns - 1):
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                limit = limits[y, x]
                before, after = position[y - dy, x - dx], position[y + dy, x + dx]
                bend = abs(before - 2 * position[y, x] + after)
                if bend > limit and bend > share * abs(after - before):
                    s0, s1, s2 = sigma[y - dy, x - dx], sigma[y, x], sigma[y + dy, x + dx]
                    if bend > limit + sigmas * np.sqrt(s0 * s0 + 4 * s1 * s1 + s2 * s2):
                        out[y, x] = True
