"""What all line frames say together: the projector position at every pixel.

A stripe's own frame tells its centre from a few pixels. The other shifts light the same patch of surface, so the phase
of their light tells the projector position there as well, at every pixel: x = n/2π · arg Σ I_k exp(2πi centre_k / n).
Only the first harmonic of the light is used: neither the stripe's shape nor the projector's response bends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, LineShift, divides_period
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
    return patterns[0].period_px // len(patterns) if divides_period(patterns) else None


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
