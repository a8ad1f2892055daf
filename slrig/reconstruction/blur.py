"""Blur of the camera, estimated from the lines of a scan, and the correction of curved surfaces for it.

The amplitude of the first harmonic of the lines' light, over white minus black, shows the blur of both lenses. The
projector's part is the same everywhere in its own columns. A Gaussian blur of the camera of variance σ² leaves the
factor exp(-½ω²σ²|g|²) where the position rises by g per pixel, ω the phase per position. On surfaces with different
slopes the logarithm falls by ½ω²σ² along |g|², independent of albedo, focus of the projector and noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import PositionMap

# Chosen: 9 x 9 pixels add 1 % to the noise of a point, 5 x 5 add 10 %, and both together follow tight bends.
_WIDE, _NARROW = 4, 2  # px either way
# Clearance of a window from unusable pixels. At the projector's border the last usable pixels lack some light, which
# resembles a bend.
_MARGIN_PX = 1
# Largest distance at which a pixel without a whole window uses that of a neighbour; a straight border needs 3.
_NEIGHBOUR_PX = 4
# Standard deviations: further apart, the windows cover two surfaces, or one that bends within the wide one.
_MAX_DIFFERENCE_SIGMA = 3.0
_DOUBT = 4.0  # squared: a shift of two standard deviations counts by half

_SAMPLE_STEP = 4  # of rows and columns: neighbours are alike
_REACH = 2  # px either way, for the slope
_MAX_BEND_PX = 1.0  # second difference over that distance: more is two surfaces, whose light mixes
_MAX_CONTRAST_STEP = 0.2  # change over that distance, of the brightness: edges of a print reduce the estimate
_MIN_SAMPLES = 500
_ITERATIONS = 4
_MAX_RESIDUAL_SIGMA = 3.0  # standard deviations from the line: glints, and light of two surfaces
# Chosen: standard deviation of the logarithm of the contrast, as the focus of the projector may vary with depth and
# slope; and of that of the expected variance, for lenses more or less in focus.
_LOG_CONTRAST_SIGMA = 0.02
_LOG_VARIANCE_SIGMA = np.log(2)
_MIN_VARIANCE, _MAX_VARIANCE = 1 / 12, 16.0
"""px²: of the area of a pixel, and of a blur in which lines of 8 px vanish."""
_STEPS = 2000  # of 0.3 % of the variance


def correct_curvature(
    measured: PositionMap, usable: NDArray[np.bool_], blur_variance: float, period_px: float, /
) -> PositionMap:
    """Correct the position map for the shift by blur on a curved surface.

    usable : (H, W) bool, pixels whose light is of one surface; blur_variance : of the camera's own blur, its pixel's
    area included, px²; period_px : of the lines that give the phase.

    Derivatives are those of a quadratic surface fitted to 9 x 9 pixels; where it does not fit the inner 5 x 5, or a
    window has unusable pixels, to those. A shift d counts d⁴/(d⁴ + 16 σ⁴), σ its standard deviation by noise, so that
    an even surface keeps its noise. A pixel next to a border uses the shift at the closest whole 5 x 5 window, if the
    surface there extends to it.
    """
    mask = (usable & np.isfinite(measured.position)).view(np.uint8)
    wide, narrow = (
        cv2.erode(mask, np.ones((2 * (r + _MARGIN_PX) + 1,) * 2, np.uint8), borderValue=0) for r in (_WIDE, _NARROW)
    )
    phase_variance = (2 * np.pi / period_px) ** 2 * blur_variance
    corrected = measured.position.copy()
    in_bands(
        _curvature_kernel, len(corrected), *measured, wide, narrow, float(blur_variance), phase_variance, corrected
    )
    in_bands(_border_kernel, len(corrected), *measured, mask, narrow, float(blur_variance), phase_variance, corrected)
    return PositionMap(corrected, measured.sigma)


@kernel
def _curvature_kernel(
    first: int, last: int, position: Any, sigma: Any, wide: Any, narrow: Any, variance: float, phase_variance: float,
    out: Any,
) -> None:  # fmt: skip
    """Subtract the shift from each position; phase_variance : ω²σ²."""
    columns = position.shape[1]
    down, broad, fine = np.zeros((3, columns)), np.zeros((5, columns)), np.zeros((5, columns))
    broad_gain, fine_gain = variance * _noise_gain(_WIDE), variance * _noise_gain(_NARROW)
    for y in range(first, last):
        if not narrow[y].any():
            continue
        _derivatives(position, y, _NARROW, down, fine)
        if wide[y].any():
            _derivatives(position, y, _WIDE, down, broad)
        for x in range(columns):
            if not narrow[y, x]:
                continue
            noise = fine_gain * sigma[y, x]
            shift = _curvature_shift(fine, x, variance, phase_variance)
            if wide[y, x]:
                smooth = _curvature_shift(broad, x, variance, phase_variance)
                if abs(smooth - shift) <= _MAX_DIFFERENCE_SIGMA * noise:
                    shift, noise = smooth, broad_gain * sigma[y, x]
            out[y, x] -= _shrink_shift(shift, noise)


@kernel
def _border_kernel(
    first: int, last: int, position: Any, sigma: Any, known: Any, narrow: Any, variance: float, phase_variance: float,
    out: Any,
) -> None:  # fmt: skip
    """Subtract the shift at the closest whole window from each position next to a border."""
    rows, columns = position.shape
    derivatives = np.zeros((5, 1))
    gain = variance * _noise_gain(_NARROW)
    for y in range(first, last):
        for x in range(columns):
            if narrow[y, x] or not known[y, x]:
                continue
            nearest, down, across = _NEIGHBOUR_PX**2 + 1, 0, 0
            for dy in range(max(-_NEIGHBOUR_PX, -y), min(_NEIGHBOUR_PX, rows - 1 - y) + 1):
                for dx in range(max(-_NEIGHBOUR_PX, -x), min(_NEIGHBOUR_PX, columns - 1 - x) + 1):
                    if narrow[y + dy, x + dx] and dx * dx + dy * dy < nearest:
                        nearest, down, across = dx * dx + dy * dy, dy, dx
            if nearest > _NEIGHBOUR_PX**2:
                continue
            level = _derivatives_at(position, y + down, x + across, derivatives)
            expected, spread = _extrapolate(level, derivatives, -across, -down)
            if abs(position[y, x] - expected) > _MAX_DIFFERENCE_SIGMA * spread * sigma[y, x]:
                continue
            out[y, x] -= _shrink_shift(_curvature_shift(derivatives, 0, variance, phase_variance), gain * sigma[y, x])


@kernel_part
def _derivatives_at(position: Any, y: int, x: int, out: Any) -> float:
    """Fill out, (5, 1), with the derivatives of one narrow window as `_derivatives` does, and return the mean."""
    count = 2 * _NARROW + 1
    mean, second, bend = _offset_moments(_NARROW)
    out[:] = 0
    level = 0.0
    for dy in range(-_NARROW, _NARROW + 1):
        for dx in range(-_NARROW, _NARROW + 1):
            p = position[y + dy, x + dx]
            level += p / count**2
            out[0, 0] += p * dx / (count * second)
            out[1, 0] += p * dy / (count * second)
            out[2, 0] += p * 2 * (dx * dx - mean) / (count * bend)
            out[3, 0] += p * dx * dy / (second * second)
            out[4, 0] += p * 2 * (dy * dy - mean) / (count * bend)
    return level


@kernel_part
def _extrapolate(level: float, derivatives: Any, dx: int, dy: int) -> tuple[float, float]:
    """Fitted surface at this offset from the middle of its window, and its distance to a pixel there for unit noise."""
    count = 2 * _NARROW + 1
    mean, second, bend = _offset_moments(_NARROW)
    gx, gy, xx, xy, yy = derivatives[:, 0]
    across, down = dx * dx - mean, dy * dy - mean
    value = level + gx * dx + gy * dy + xx * across / 2 + xy * dx * dy + yy * down / 2
    variance = 1 + 1 / count**2 + (dx * dx + dy * dy) / (count * second)
    variance += (across * across + down * down) / (count * bend) + (dx * dy / second) ** 2
    return value, float(np.sqrt(variance))


@kernel_part(inline="always")
def _shrink_shift(shift: float, noise: float) -> float:
    """Part of a shift that counts, given its standard deviation by noise."""
    fourth, doubt = shift**4, (_DOUBT * noise * noise) ** 2
    return shift * (fourth / (fourth + doubt)) if fourth > 0 else 0.0


@kernel_part(inline="always")
def _curvature_shift(derivatives: Any, x: int, variance: float, phase_variance: float) -> Any:
    gx, gy, xx, xy, yy = (
        derivatives[0, x], derivatives[1, x], derivatives[2, x], derivatives[3, x], derivatives[4, x]
    )  # fmt: skip
    return 0.5 * variance * (xx + yy - phase_variance * (gx * gx * xx + 2 * gx * gy * xy + gy * gy * yy))


@kernel_part
def _offset_moments(reach: int) -> tuple[float, float, float]:
    """Of the offsets d of a window: their mean square, the sum of d², and that of (d² - mean)²."""
    second = fourth = 0.0
    for d in range(-reach, reach + 1):
        second += d * d
        fourth += d**4
    count = 2 * reach + 1
    return second / count, second, fourth - second * second / count


@kernel_part
def _noise_gain(reach: int) -> float:
    """Standard deviation of ½ tr H for unit noise of the pixels."""
    return float(np.sqrt(2 / ((2 * reach + 1) * _offset_moments(reach)[2])))


# Loops over few arrays are vectorised. Sums start again in each window, so that all rows round alike.
@kernel_part
def _derivatives(position: Any, y: int, reach: int, down: Any, out: Any) -> None:
    """Fill out, (5, W), with ∂x, ∂y, ∂xx, ∂xy, ∂yy of the quadratic surface about each pixel of row y.

    Its terms d² - mean, d and 1 are orthogonal over a whole window along each axis. down : (3, W) working memory.
    """
    count = 2 * reach + 1
    mean, second, bend = _offset_moments(reach)
    columns = position.shape[1]
    down[:] = 0
    for d in range(-reach, reach + 1):
        row = position[y + d]
        even, slope, curve = down[0], down[1], down[2]
        for x in range(columns):
            even[x] += row[x]
        for x in range(columns):
            slope[x] += d * row[x]
        for x in range(columns):
            curve[x] += (d * d - mean) * row[x]
    out[:] = 0
    for d in range(-reach, reach + 1):
        _add_column(out[0], down[0], d, reach, d / (count * second))
        _add_column(out[1], down[1], d, reach, 1 / (count * second))
        _add_column(out[2], down[0], d, reach, 2 * (d * d - mean) / (count * bend))
        _add_column(out[3], down[1], d, reach, d / (second * second))
        _add_column(out[4], down[2], d, reach, 2 / (count * bend))


@kernel_part
def _add_column(out: Any, column: Any, d: int, reach: int, weight: float) -> None:
    """Add the part of a column to the windows at distance d from it."""
    for x in range(reach, len(out) - reach):
        out[x] += weight * column[x + d]


class BlurEstimate(NamedTuple):
    """Estimated blur of the camera.

    sigma_px : standard deviation of the camera's own blur, the pixel's area included. from_lines : True if lines
    determine it, False if it is the expected one.
    """

    sigma_px: float
    from_lines: bool


def estimate_blur(
    frames: AxisFrames, measured: PositionMap, clear: NDArray[np.bool_], expected_px: float, /
) -> BlurEstimate:
    """Estimate the blur of the camera from lines, with the expected blur as prior.

    measured : positions by the phase of all line frames, or by sinusoids; clear : (H, W) bool, pixels away from the
    borders of shadows; expected_px : blur to expect, and the result if slopes are too even or pixels too few; 0 to
    accept it as known.
    """
    images, angle, period_px = frames.phase_frames
    # White and black by the modulation of a coarser period lose some of it, too.
    reference_px = np.inf if frames.has_reference else max(each.period_px for each in frames.sine_patterns)
    radians_per_px = 2 * np.pi * float(np.sqrt(max(period_px**-2 - reference_px**-2, 0.0)))
    height, width = measured.position.shape

    def shifted(rows: int, columns: int) -> tuple[slice, slice]:
        step = _SAMPLE_STEP
        return slice(step + rows, height - step + rows, step), slice(step + columns, width - step + columns, step)

    inner = shifted(0, 0)
    values = np.array([image[inner] for image in images], dtype=np.float64)
    amplitude = np.hypot(np.tensordot(np.cos(angle), values, 1), np.tensordot(np.sin(angle), values, 1))
    light = frames.contrast
    contrast = light[inner]
    squared, bend, edge = np.zeros((3, *amplitude.shape))
    for rows, columns in ((0, _REACH), (_REACH, 0)):
        before, after = measured.position[shifted(-rows, -columns)], measured.position[shifted(rows, columns)]
        squared += ((after - before) / (2 * _REACH)) ** 2
        bend = np.maximum(bend, np.abs(before - 2 * measured.position[inner] + after))
        edge = np.maximum(edge, np.abs(light[shifted(rows, columns)] - light[shifted(-rows, -columns)]))
    known = clear[inner] & (bend < _MAX_BEND_PX) & (contrast > 0) & (amplitude > 0)
    even = known & (edge < _MAX_CONTRAST_STEP * contrast)
    if np.count_nonzero(even) >= _MIN_SAMPLES:
        known = even
    if radians_per_px == 0 or expected_px <= 0 or np.count_nonzero(known) < _MIN_SAMPLES:
        return BlurEstimate(expected_px, from_lines=False)
    expected_fall, log_amplitude = -0.5 * radians_per_px**2 * squared[known], np.log(amplitude[known] / contrast[known])
    inliers = np.ones(len(expected_fall), dtype=np.bool_)
    fitted = expected_px**2
    for _ in range(_ITERATIONS):
        middle, mean = expected_fall[inliers].mean(), log_amplitude[inliers].mean()
        centred = expected_fall - middle
        square = float(centred[inliers] @ centred[inliers])
        fitted = float(centred[inliers] @ (log_amplitude[inliers] - mean)) / max(square, 1e-12)
        residual = np.abs(log_amplitude - mean - fitted * centred)
        inliers = residual <= _MAX_RESIDUAL_SIGMA * 1.4826 * np.median(residual[inliers])
    expected, deviation = expected_px**2, _LOG_CONTRAST_SIGMA / max(float(expected_fall[inliers].std()), 1e-12)
    candidates = np.geomspace(min(_MIN_VARIANCE, expected), max(_MAX_VARIANCE, expected), _STEPS)
    unlikely = ((candidates - fitted) / deviation) ** 2 + (np.log(candidates / expected) / _LOG_VARIANCE_SIGMA) ** 2
    likely = float(candidates[np.argmin(unlikely)])
    # An estimate that is less certain than the prior is likely to be wrong, by the focus of the projector for example.
    from_lines = deviation < _LOG_VARIANCE_SIGMA * likely
    return BlurEstimate(likely**0.5 if from_lines else expected_px, from_lines=bool(from_lines))
