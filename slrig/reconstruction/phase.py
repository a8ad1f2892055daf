"""Projector position at every pixel from all line frames, its centroid correction, and depth and shadow edges.

In its own frame the centre of a stripe is measured by a few pixels. The other shifts light the same patch of surface,
so the phase of their light gives the projector position at every pixel: x = n/2π · arg Σ I_k exp(2πi centre_k / n).
Only the first harmonic of the light is used, which neither the shape of a stripe nor the response of the projector
changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, LineShift, NoiseModel, has_even_shifts
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames, rows_per_band, stack_rows
from slrig.reconstruction.surface_fit import MIN_GRADIENT, stencils

_FITTED_PX = 5  # pixels along each side of the window of a fit
_MAX_BEND_PX = 1.0  # projector px of second difference over six pixels: more is a step between two surfaces
_MAX_STEP_PX = 4.0  # projector px of second difference over two pixels: more than edges of a print displace positions
_SIXTH_GAIN = 2 * (45**2 + 9**2 + 1) / 60**2  # variance of the sixth-order difference for unit noise
_DOUBT = 4.0  # squared: fine structure of two standard deviations counts by half
_ITERATIONS = 2  # the second uses the slope of corrected positions
_REACH = 5  # px either way: an edge and the surface round it
_SMOOTHED_PX = 1.0  # about the smoothing by the fit to positions, so that the blur suits that fit
_SURROUND_PX = 2.5
_SAMPLE_STEP = 4  # of rows and columns: there are many edges, and each uses 121 pixels
_GRADIENT_GAIN = (8 * np.pi * _SMOOTHED_PX**4) ** -0.5  # deviation of a smoothed derivative for unit noise
_MIN_EDGE_SIGMA = 2.0  # least shift of an edge over its noise
_MAX_DEVIATION = 1.5  # px² from the expected variance: further edges are of shading
_MIN_AGREEING = 0.5  # of all edges: for shading the share is below 0.12, for prints above 0.8
_MIN_EDGES = 30  # fewer may agree by chance
_PRIOR_SIGMA = 0.5  # standard deviation of σ² over its expected value, for lenses more or less in focus

_STEP_SIGMA_PX = (0.04, 0.015)
"""Standard deviation by light of the other surface in the first and second pixel next to a depth step; chosen for edges
of terraces and boxes.
"""

_SHADOW_SHARE = 0.5  # of the displacement by fading light, chosen for shadows of posts on plates 8 and 40 mm behind

_MEAN_PX = 17  # window over which the squared displacements by asymmetric light are averaged
_MIN_EXCESS = 2.5  # standard deviations of that average beyond its noise
_USUAL_SHARE = 0.25  # of the lit pixels have no light from other surfaces, as far as one scan can show
_MIN_HARMONIC = 0.2  # of the amplitude of narrow lines: below, the harmonic is not that of the line

_QUANTILE_STEP = 7  # of the pixels
_MAX_MOVED_PX = 0.02  # projector px, by changes of brightness; a harmonic of threefold frequency moves as much again
_MIN_KNOWN = 0.1  # share of the pixels of a window that are measured
_TINY = np.float32(1e-6)

_SHADOW_SIGMA = 3.0
"""Standard deviations of the camera's blur within which light fades out at a border."""


class PositionMap(NamedTuple):
    """Projector position of one axis at every pixel.

    position : (H, W) float32, px, NaN where refused; sigma : (H, W) float32, its standard deviation from noise, px, NaN
    where the position is the middle of a code cell.
    """

    position: NDArray[np.float32]
    sigma: NDArray[np.float32]


def line_step_px(patterns: Sequence[LineShift], /) -> int | None:
    """Step of shifts that divide their period evenly into three or more, px; None for others, which have no phase.

    patterns : of one period and width, by shift.
    """
    return patterns[0].period_px // len(patterns) if has_even_shifts(patterns) else None


def has_phase(frames: AxisFrames, /) -> bool:
    """True if the lines give the phase at each pixel."""
    return line_step_px(frames.line_patterns) is not None


def position_map(
    frames: AxisFrames, noise: NoiseModel, code: CodeMap, cell_position: FloatArray, /, *, by_phase: bool = True
) -> PositionMap:
    """Projector position at every decoded pixel.

    cell_position : (cells,) float64, centre of each code cell. The code gives the period and the phase of the line
    frames the position within it; without line frames, or not by_phase, it is the middle of the code interval. A pixel
    with a clipped line frame has no position by phase.
    """
    patterns = frames.line_patterns
    phase = by_phase and has_phase(frames)
    # An interval of more than half a period may contain the phase twice.
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
        lines = stack_rows(frames.lines, rows)
        position[rows], sigma[rows] = _measure_phase(
            lines, patterns, noise.rows(rows), middle, np.float32(frames.clipped_at)
        )

    in_bands(band, shape[0], rows_at_most=rows_per_band(frames.lines, shape[1]))
    return PositionMap(position, sigma)


def _measure_phase(
    lines: NDArray[np.float32], patterns: tuple[LineShift, ...], noise: NoiseModel, middle: NDArray[np.float32],
    clipped_at: np.float32,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Position and its standard deviation, (rows, W) float32 each, NaN where unknown.

    lines : (n, rows, W) float32; middle : (rows, W) float32, of the code's intervals, px.
    """
    period = patterns[0].period_px
    angle = 2 * np.pi / period * np.array([p.centre_px for p in patterns])
    arguments = lines, np.cos(angle), np.sin(angle), float(period), middle

    def run(read: float, slope: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        position, sigma = (np.full_like(middle, np.nan) for _ in range(2))
        _phase_kernel(0, len(middle), *arguments, read, slope, clipped_at, position, sigma)
        return position, sigma

    if noise.read_share is None or noise.shot_share is None:
        return run(noise.read_variance, noise.slope)
    # The variance has a part by read noise and one by shot noise, each with its own share at each pixel.
    position, by_read = run(noise.read_variance, 0.0)
    _, by_shot = run(0.0, noise.slope)
    return position, np.sqrt(noise.read_share * by_read**2 + noise.shot_share * by_shot**2)


@kernel
def _middle_kernel(first: int, last: int, code: Any, cell_position: Any, widest: float, out: Any) -> None:
    """Fill in the middle of each pixel's code interval, px, unless it is refused or too wide."""
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


# Loops over few arrays each: with more, the compiler cannot prove that they do not overlap, and does not vectorise.
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
    """Output of `fit_kernel`: points (n, 2), normals (n, 2) along the gradient, sigma_px (n,), found (n,) bool.

    noise_px : (n,) float64, sigma_px by noise alone; sigma_px is larger where pixels scatter more than that.
    """

    points: FloatArray
    normals: FloatArray
    sigma_px: FloatArray
    found: NDArray[np.bool_]
    noise_px: FloatArray


def fit_arguments(measured: PositionMap, usable: NDArray[np.bool_]) -> tuple[Any, ...]:
    """First arguments of `fit_kernel`, which describe the map."""
    # A 5 x 5 neighbourhood is whole where the mask eroded by it is set.
    whole = cv2.erode(usable.view(np.uint8), np.ones((5, 5), dtype=np.uint8), borderValue=0)
    return measured.position, measured.sigma, usable, whole, *stencils()


def allocate_points(count: int) -> FittedPoints:
    """Empty output of `fit_kernel`."""
    found = np.zeros(count, dtype=np.bool_)
    return FittedPoints(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count), found, np.zeros(count))


def resample_to_pixel_centres(
    measured: PositionMap,
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    blur_px: float,
    /,
    *,
    clear: NDArray[np.bool_] | None = None,
) -> PositionMap:
    """Move the positions from the centroids of the pixels' light to the pixel centres, to first order.

    contrast, deviation : (H, W) float32, white minus black and the standard deviation of its noise; blur_px : standard
    deviation of the camera's own blur, its pixel's area included, px. clear : (H, W) bool, pixels away from the borders
    of shadows, at which edges of a print are used to estimate the blur, with blur_px as prior; None if it is known.

    The gradient of ln L is a difference of sixth order, that of the position one over six pixels; next to a border or
    step both are central differences. The part of the sixth order beyond a difference over six pixels, and all of a
    central difference, may be noise: such a d counts d⁴/(d⁴ + 16 σ⁴), σ its standard deviation by noise. A pixel
    without a neighbour along an axis, or at a step, is not corrected along it.
    """
    brightness = np.full_like(contrast, np.nan)
    in_bands(_log_kernel, len(contrast), contrast, brightness)
    corrected, shift = measured.position, np.zeros_like(measured.position)
    variance = blur_px**2
    for _ in range(_ITERATIONS):
        in_bands(_shift_kernel, len(corrected), corrected, brightness, contrast, deviation, shift)
        if clear is not None:
            variance = _estimate_variance(measured, shift, contrast, deviation, clear, blur_px**2)
        corrected = measured.position - np.float32(variance) * shift
    return PositionMap(corrected, measured.sigma)


def centroid_residual_px(
    measured: PositionMap, centred: PositionMap, usable: NDArray[np.bool_], blur_px: float, period_px: float,
    near_shadow: NDArray[np.bool_], /,
) -> NDArray[np.float32]:  # fmt: skip
    """(H, W): standard deviation, camera px, of the error after first-order correction of points fitted to 5 x 5
    pixels.

    It is the third order where brightness changes as sharply as the blur allows, ∂³ ln L = ∂ ln L / σ²: the share
    σ²ω²s²/6 of the first-order displacement, with either sign. Next to shadows it is at least `_SHADOW_SHARE` of it,
    since the light of the projector itself fades there.
    """
    down, across = np.gradient(measured.position)
    share = (blur_px * 2 * np.pi / period_px) ** 2 / 6  # over s², and in projector px over s
    slope_squared = down * down + across * across
    displaced_squared = (centred.position - measured.position) ** 2
    squared = share**2 * slope_squared * displaced_squared
    squared[~(usable & np.isfinite(squared))] = 0
    window = (_FITTED_PX, _FITTED_PX)
    mean = cv2.blur(squared, window)
    if near_shadow.any():
        # A fit next to a border has pixels on one side only.
        near_border = cv2.dilate(near_shadow.view(np.uint8), np.ones((2 * _FITTED_PX - 1,) * 2, np.uint8)) > 0
        near_border &= usable & np.isfinite(displaced_squared) & (slope_squared > MIN_GRADIENT**2)
        of_shadow = np.divide(displaced_squared, slope_squared, out=np.zeros_like(squared), where=near_border)
        pixels = cv2.blur(near_border.astype(np.float32), window)
        mean += _SHADOW_SHARE**2 * cv2.blur(of_shadow, window) / np.maximum(pixels, np.float32(1 / _FITTED_PX**2))
    return np.asarray(np.sqrt(np.maximum(mean, 0)), dtype=np.float32)  # running sums may round to below 0


def asymmetry_sigma_px(
    frames: AxisFrames, measured: PositionMap, centred: PositionMap, usable: NDArray[np.bool_], noise: NoiseModel, /
) -> NDArray[np.float32]:
    """(H, W): standard deviation, camera px, by which light from other surfaces displaces points fitted to 5 x 5
    pixels.

    A line that lights a pixel straight from the projector is symmetric about its centre with any blur and response:
    the phases of its harmonics agree. Light that comes by way of another surface displaces each harmonic in its own
    way; the difference between the positions by a higher and by the first one is about as large as the displacement
    by the first. Counted where noise does not explain it, beyond the usual value of the image. Pixels whose brightness
    changes sharply (by `centred`, from `resample_to_pixel_centres`) are left out: it makes lines asymmetric, too.
    """
    patterns = frames.line_patterns
    if not patterns:  # sinusoids have no harmonics
        return np.zeros(usable.shape, dtype=np.float32)
    period_px, width_px, count = patterns[0].period_px, patterns[0].line_width_px, len(patterns)
    amplitudes = {order: np.sin(np.pi * order * width_px / period_px) for order in (2, 3) if 2 * order < count}
    order = next((each for each, amplitude in amplitudes.items() if abs(amplitude) > _MIN_HARMONIC), None)
    difference, variance = (np.zeros(usable.shape, dtype=np.float32) for _ in range(2))
    if order is None or not usable.any():
        return difference
    turn = 2 * np.pi * order / period_px
    angle = turn * np.array([each.centre_px for each in patterns])
    # A line wider than half a wave of the harmonic inverts it.
    offset = 0.0 if amplitudes[order] > 0 else np.pi

    sums = np.array([np.cos(angle), np.sin(angle), np.full(count, 1 / count)], dtype=np.float32)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        lines = stack_rows(frames.lines, rows)
        real, imaginary, level = (sums @ lines.reshape(count, -1)).reshape(3, *lines.shape[1:])
        apart = np.arctan2(imaginary, real) - np.float32(offset) - np.float32(turn) * measured.position[rows]
        apart -= np.float32(2 * np.pi) * np.rint(apart / np.float32(2 * np.pi))
        by_harmonic = noise.rows(rows).variance(level)
        by_harmonic *= np.float32(count / (2 * turn * turn)) / np.maximum(real * real + imaginary * imaginary, _TINY)
        by_harmonic += measured.sigma[rows] ** 2
        np.copyto(difference[rows], apart / np.float32(turn), where=usable[rows])
        np.copyto(variance[rows], by_harmonic, where=usable[rows])

    in_bands(band, len(usable), rows_at_most=rows_per_band(frames.lines, usable.shape[1]))
    # The points follow the positions as the fit weighs its pixels.
    weights = stencils()[0][0, : _FITTED_PX**2].reshape(_FITTED_PX, _FITTED_PX)
    even = usable & (np.abs(centred.position - measured.position) < _MAX_MOVED_PX)
    whole = cv2.erode(even.view(np.uint8), np.ones_like(weights, dtype=np.uint8), borderValue=0)
    squared = cv2.filter2D(difference, -1, weights) ** 2
    noise_squared = cv2.filter2D(variance, -1, weights**2)
    squared -= noise_squared
    pixels = cv2.blur(whole.astype(np.float32), (_MEAN_PX, _MEAN_PX))
    known = usable & (pixels > _MIN_KNOWN)
    if not known.any():
        return np.zeros_like(difference)
    squared, noise_squared = (
        cv2.blur(each * whole, (_MEAN_PX, _MEAN_PX)) / np.maximum(pixels, _TINY) for each in (squared, noise_squared)
    )
    squared -= max(float(np.quantile(squared[known][::_QUANTILE_STEP], _USUAL_SHARE)), 0.0)
    independent = np.maximum(pixels * (_MEAN_PX / _FITTED_PX) ** 2, 1)
    squared[~(known & (squared > _MIN_EXCESS * np.maximum(noise_squared, _TINY) * np.sqrt(2 / independent)))] = 0
    down, across = np.gradient(measured.position)
    slope = np.hypot(down, across)
    is_steep = (squared > 0) & (slope > MIN_GRADIENT)
    return np.asarray(np.divide(np.sqrt(squared), slope, out=np.zeros_like(squared), where=is_steep))


def _estimate_variance(
    measured: PositionMap,
    shift: NDArray[np.float32],
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    clear: NDArray[np.bool_],
    expected: float,
    /,
) -> float:
    """Variance of the blur, px², for which the shifts make the positions smoothest.

    shift : (H, W) float32, for unit variance; other arguments as for `resample_to_pixel_centres`. Shifts r and
    positions p, both smoothed and without a local quadratic surface, minimise Σ w (p - σ² r)² over strong edges, with
    the expected value as one more observation. If edges are few, or most are of shading, the expected value is
    returned.
    """
    inner = (clear & np.isfinite(measured.position)).view(np.uint8)
    whole = cv2.erode(inner, np.ones((2 * _REACH + 1,) * 2, dtype=np.uint8), borderValue=0)
    # Sums by row are the same to the bit for any number of cores.
    sums = np.zeros((len(shift), 5))
    in_bands(
        _edges_kernel, len(shift), *measured, shift, contrast, deviation, whole, _edge_stencil(), expected, sums
    )  # fmt: skip
    both, squared, misfit, count, edges = sums.sum(axis=0)
    if count < max(_MIN_EDGES, _MIN_AGREEING * edges):
        return expected
    # If residuals are larger than their weights predict, all are scaled.
    scale = max(1.0, (misfit - both * both / squared) / count)
    prior = 1 / (_PRIOR_SIGMA * expected) ** 2
    return max(0.0, float((both / scale + expected * prior) / (squared / scale + prior)))


def _edge_stencil() -> FloatArray:
    """(11, 11) float64: weights of a Gaussian of 1 px, minus its response to a quadratic surface."""
    offset = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(offset, offset, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    near, surround = (np.exp(-(x * x + y * y) / (2 * scale**2)) for scale in (_SMOOTHED_PX, _SURROUND_PX))
    near /= near.sum()
    response = np.linalg.solve((basis * surround) @ basis.T, basis @ near)
    return np.asarray((near - surround * (response @ basis)).reshape(len(offset), len(offset)))


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
    """Fill in the shift of each position by a blur of unit variance, 0 where it is unknown."""
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
                if not abs(before - 2 * here + after) < _MAX_STEP_PX:
                    continue
                slope = 0.5 * (after - before)
                # Part that may be noise: all of a central difference, or the sixth order beyond the wide difference.
                rise, gain = np.float32(0.0), 0.5
                fine = 0.5 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                if 3 * dy <= y < rows - 3 * dy and 3 * dx <= x < columns - 3 * dx:
                    before, after = position[y - 3 * dy, x - 3 * dx], position[y + 3 * dy, x + 3 * dx]
                    # One surface, and not two with a step between them.
                    if abs(before - 2 * here + after) < _MAX_BEND_PX:
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
    """Fill in by row Σ w r p, Σ w r², Σ w p² and the number of edges that a lens can make, and of all edges."""
    reach = len(stencil) // 2
    gain = 1 / (2 * np.sqrt(np.pi) * _SMOOTHED_PX)
    for y in range(first + -first % _SAMPLE_STEP, last, _SAMPLE_STEP):
        for x in range(0, shift.shape[1], _SAMPLE_STEP):
            if not whole[y, x]:
                continue
            # The noise of the shift is that of ln L times the slope of the position.
            gx = 0.5 * (position[y, x + 1] - position[y, x - 1])
            gy = 0.5 * (position[y + 1, x] - position[y - 1, x])
            least = _MIN_EDGE_SIGMA * _GRADIENT_GAIN * np.sqrt(gx * gx + gy * gy) * deviation[y, x] / contrast[y, x]
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
            if not abs(p - expected * r) < _MAX_DEVIATION * abs(r):
                continue
            weight = 1 / (gain * sigma[y, x]) ** 2
            sums[y, 0] += weight * r * p
            sums[y, 1] += weight * r * r
            sums[y, 2] += weight * p * p
            sums[y, 3] += 1


@dataclass(frozen=True, slots=True)
class EdgeLimits:
    """Definition of a border, and distances of stripe points from it.

    shadow_px, depth_px : radius of refusal round the border of the lit area, and round a depth step, for a fit to
    pixels; filter_px : for a filter, whose window must be clear of the border. bend_px : a second difference of the
    projector position, over two camera pixels, that no surface has, bend_share : unless it is below this share of the
    first difference, as on a surface at a grazing angle, bend_sigma : and exceeds that limit by this many standard
    deviations, to allow for noise. smallest_shadow_px : unlit specks of fewer pixels are noise or dust.
    """

    shadow_px: float = 2.0
    depth_px: float = 0.7
    filter_px: float = 2.0
    bend_px: float = 0.9
    bend_share: float = 0.5
    bend_sigma: float = 4.0
    smallest_shadow_px: int = 4

    def for_filters(self, blur_px: float) -> EdgeLimits:
        """Limits for a filter; light mixes further for stripes wider than 1 px."""
        reach_px = self.filter_px * max(1.0, blur_px)
        return replace(self, shadow_px=reach_px, depth_px=reach_px)


def near_edges(
    measured: PositionMap, unlit: NDArray[np.bool_], resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels near the border of the lit area, and pixels near a depth step: two (H, W) bool maps.

    unlit : (H, W) bool; resolution_px : step of the position map (0 if phase makes it continuous), (H, W) if it varies.
    """
    return near_shadows(unlit, limits), near_steps(measured, resolution_px, limits)


def near_shadows(unlit: NDArray[np.bool_], limits: EdgeLimits, /) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the border of the lit area; see `near_edges`."""
    return _dilate(_remove_specks(unlit, limits.smallest_shadow_px), limits.shadow_px)


def near_shadows_by_blur(
    blur_px: float, near_shadow: NDArray[np.bool_], unlit: NDArray[np.bool_], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the border of the lit area for this blur; near_shadow : for the usual blur."""
    if _SHADOW_SIGMA * blur_px <= limits.shadow_px:
        return near_shadow
    return near_shadows(unlit, replace(limits, shadow_px=_SHADOW_SIGMA * blur_px))


def near_steps(
    measured: PositionMap, resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near a depth step; see `near_edges`."""
    limit_px = np.full(measured.position.shape, limits.bend_px + 2 * resolution_px, dtype=np.float32)
    bends = np.zeros(measured.position.shape, dtype=np.bool_)
    in_bands(
        _bend_kernel, len(bends), measured.position, np.nan_to_num(measured.sigma), limit_px, limits.bend_share,
        limits.bend_sigma, bends,
    )  # fmt: skip
    return _dilate(bends, limits.depth_px)


def _remove_specks(unlit: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(unlit.astype(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False
    return np.asarray(large[labels])


def step_sigma_px(near_step: NDArray[np.bool_], /) -> NDArray[np.float32]:
    """(H, W): standard deviation of points next to depth steps; see `_STEP_SIGMA_PX`."""
    sigma_px, inside = np.zeros(near_step.shape, dtype=np.float32), near_step.view(np.uint8)
    for displaced_px in _STEP_SIGMA_PX:
        wider = cv2.dilate(inside, np.ones((3, 3), np.uint8))
        sigma_px[wider > inside] = displaced_px
        inside = wider
    return sigma_px


def _dilate(mask: NDArray[np.bool_], radius_px: float) -> NDArray[np.bool_]:
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
