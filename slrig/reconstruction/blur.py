"""Blur of the camera, estimated from the lines of a scan, and the correction of curved surfaces for it.

The first harmonic of the lines' light, over white minus black, is what is left of it behind both lenses: the
projector's part is the same everywhere in its own columns, and a Gaussian blur of the camera of variance σ² leaves
exp(-½ ω²σ²|g|²) where the position rises by g per pixel, ω the phase per position. A surface has slopes that differ, so
that the logarithm falls by ½ ω²σ² along |g|²: of the albedo, the projector's focus and the noise nothing enters. On
rendered scenes the variance is told to 3 %, from 0.08 px², that of the pixel's square alone, to 1.1; a relief of few
slopes is told 1.45 for 1.5.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import PositionMap

# Chosen. 9 x 9 pixels add 1 % to the noise of a point, 7 x 7 add 3 % and 5 x 5 10 %. On a relief with tight bends the
# error over σ is 1.28 as it is, 1.17 by the 9 x 9 alone, and 1.05 by both.
_WIDE, _NARROW = 4, 2  # px either way
# Of what is not usable round a window: at the projector's own border the last usable pixels still miss some of their
# light, and that looks like a bend (points 3 columns from it erred by 12 % more).
_CLEAR_PX = 1
# Up to which a pixel without a whole window has that of a neighbour. Beside a straight border 3 are needed. Where the
# neighbour's surface does not go on to the pixel, its bends say nothing there.
_BESIDE_PX = 4
_APART = 3.0  # standard deviations: the two windows see two surfaces, or one that bends within the wide one
_DOUBT = 4.0  # squared: a shift of two standard deviations counts by half


def freed_of_curvature(
    seen: PositionMap, usable: NDArray[np.bool_], blur_variance: float, period_px: float, /
) -> PositionMap:
    """The position map without what the blur adds on a curved surface.

    usable : (H, W) bool, pixels whose light is of one surface; blur_variance : of the camera's own blur, its pixel's
    area included, px²; period_px : of the lines whose phase tells the positions.

    Derivatives are those of a quadratic surface fitted to 9 x 9 pixels; where it does not explain the 5 x 5 in the
    middle, or where a window is not wholly usable, to those. A shift d counts d⁴/(d⁴ + 16 σ⁴), σ its standard
    deviation by noise, so that an even surface keeps its noise. A pixel beside a border has the shift at the nearest
    5 x 5 window that is whole, if that one's surface goes on to it.
    """
    mask = (usable & np.isfinite(seen.position)).view(np.uint8)
    wide, narrow = (
        cv2.erode(mask, np.ones((2 * (r + _CLEAR_PX) + 1,) * 2, np.uint8), borderValue=0) for r in (_WIDE, _NARROW)
    )
    turn = (2 * np.pi / period_px) ** 2 * blur_variance
    freed = seen.position.copy()
    in_bands(_curvature_kernel, len(freed), *seen, wide, narrow, float(blur_variance), turn, freed)
    in_bands(_border_kernel, len(freed), *seen, mask, narrow, float(blur_variance), turn, freed)
    return PositionMap(freed, seen.sigma)


@kernel
def _curvature_kernel(
    first: int, last: int, position: Any, sigma: Any, wide: Any, narrow: Any, variance: float, turn: float, out: Any
) -> None:
    """Take the shift from each position; turn : ω²σ²."""
    columns = position.shape[1]
    down, broad, fine = np.zeros((3, columns)), np.zeros((5, columns)), np.zeros((5, columns))
    broad_gain, fine_gain = variance * _gain(_WIDE), variance * _gain(_NARROW)
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
            shift = _shift(fine, x, variance, turn)
            if wide[y, x]:
                smooth = _shift(broad, x, variance, turn)
                if abs(smooth - shift) <= _APART * noise:
                    shift, noise = smooth, broad_gain * sigma[y, x]
            out[y, x] -= _counted(shift, noise)


@kernel
def _border_kernel(
    first: int, last: int, position: Any, sigma: Any, known: Any, narrow: Any, variance: float, turn: float, out: Any
) -> None:
    """Take from each position beside a border the shift at the nearest whole window."""
    rows, columns = position.shape
    derivatives = np.zeros((5, 1))
    gain = variance * _gain(_NARROW)
    for y in range(first, last):
        for x in range(columns):
            if narrow[y, x] or not known[y, x]:
                continue
            nearest, down, across = _BESIDE_PX**2 + 1, 0, 0
            for dy in range(max(-_BESIDE_PX, -y), min(_BESIDE_PX, rows - 1 - y) + 1):
                for dx in range(max(-_BESIDE_PX, -x), min(_BESIDE_PX, columns - 1 - x) + 1):
                    if narrow[y + dy, x + dx] and dx * dx + dy * dy < nearest:
                        nearest, down, across = dx * dx + dy * dy, dy, dx
            if nearest > _BESIDE_PX**2:
                continue
            level = _derivatives_at(position, y + down, x + across, derivatives)
            there, spread = _continued(level, derivatives, -across, -down)
            if abs(position[y, x] - there) > _APART * spread * sigma[y, x]:
                continue
            out[y, x] -= _counted(_shift(derivatives, 0, variance, turn), gain * sigma[y, x])


@kernel_part
def _derivatives_at(position: Any, y: int, x: int, out: Any) -> float:
    """Fill out, (5, 1), with the derivatives of one narrow window, as `_derivatives` has them. Returns the mean."""
    count = 2 * _NARROW + 1
    mean, second, bend = _squares(_NARROW)
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
def _continued(level: float, derivatives: Any, dx: int, dy: int) -> tuple[float, float]:
    """Where the fitted surface is this far from its window's middle, and how far off a pixel there is by unit noise."""
    count = 2 * _NARROW + 1
    mean, second, bend = _squares(_NARROW)
    gx, gy, xx, xy, yy = derivatives[:, 0]
    across, down = dx * dx - mean, dy * dy - mean
    there = level + gx * dx + gy * dy + xx * across / 2 + xy * dx * dy + yy * down / 2
    variance = 1 + 1 / count**2 + (dx * dx + dy * dy) / (count * second)
    variance += (across * across + down * down) / (count * bend) + (dx * dy / second) ** 2
    return there, float(np.sqrt(variance))


@kernel_part(inline="always")
def _counted(shift: float, noise: float) -> float:
    """How much of a shift counts whose standard deviation by noise is this."""
    fourth, doubt = shift**4, (_DOUBT * noise * noise) ** 2
    return shift * (fourth / (fourth + doubt)) if fourth > 0 else 0.0


@kernel_part(inline="always")
def _shift(derivatives: Any, x: int, variance: float, turn: float) -> Any:
    gx, gy, xx, xy, yy = (
        derivatives[0, x], derivatives[1, x], derivatives[2, x], derivatives[3, x], derivatives[4, x]
    )  # fmt: skip
    return 0.5 * variance * (xx + yy - turn * (gx * gx * xx + 2 * gx * gy * xy + gy * gy * yy))


@kernel_part
def _squares(reach: int) -> tuple[float, float, float]:
    """Over the offsets d of a window: their mean square, the sum of d², and that of (d² - mean)²."""
    second = fourth = 0.0
    for d in range(-reach, reach + 1):
        second += d * d
        fourth += d**4
    count = 2 * reach + 1
    return second / count, second, fourth - second * second / count


@kernel_part
def _gain(reach: int) -> float:
    """Standard deviation of ½ tr H by unit noise of the pixels."""
    return float(np.sqrt(2 / ((2 * reach + 1) * _squares(reach)[2])))


# Loops of few arrays each, for vectors; window by window, so that the sums differ from row to row by nothing but rows.
@kernel_part
def _derivatives(position: Any, y: int, reach: int, down: Any, out: Any) -> None:
    """Fill out, (5, W), with ∂x, ∂y, ∂xx, ∂xy, ∂yy of the quadratic surface about each pixel of row y.

    Its terms d² - mean, d and 1 are orthogonal over a whole window along each axis. down : (3, W), to work in.
    """
    count = 2 * reach + 1
    mean, second, bend = _squares(reach)
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
        _add(out[0], down[0], d, reach, d / (count * second))
        _add(out[1], down[1], d, reach, 1 / (count * second))
        _add(out[2], down[0], d, reach, 2 * (d * d - mean) / (count * bend))
        _add(out[3], down[1], d, reach, d / (second * second))
        _add(out[4], down[2], d, reach, 2 / (count * bend))


@kernel_part
def _add(out: Any, of: Any, d: int, reach: int, weight: float) -> None:
    """Add a column's part to the windows that it lies d beside."""
    for x in range(reach, len(out) - reach):
        out[x] += weight * of[x + d]


_EVERY = 4  # of rows and columns: neighbours know the same
_REACH = 2  # px either way, of the slope
_FLAT_PX = 1.0  # of second difference over that: more is two surfaces, whose light mixes
_EVEN = 0.2  # of the brightness, over that: at an edge of a print of 7:1, lines tell a sixth of the variance too little
_FEWEST = 500
_TURNS = 4
_FARTHEST = 3.0  # standard deviations from the line: glints, and light of two surfaces
# Chosen, both. Of the logarithm, which a projector's focus that changes with depth may tie to the slope; and of that of
# the variance over what is expected: lenses more or less in focus, twice and half of it.
_UNEVEN = 0.02
_PRIOR = np.log(2)
_LEAST, _MOST = 1 / 12, 16.0
"""px²: of the pixel's own square, and of a blur in which lines of 8 px are lost."""
_STEPS = 2000  # of 0.3 % of the variance


class ToldBlur(NamedTuple):
    """The camera's own blur. sigma_px : its standard deviation, the pixel's area included. by_lines : whether lines
    tell it, and not what is expected.
    """

    sigma_px: float
    by_lines: bool


def told_blur(frames: AxisFrames, seen: PositionMap, clear: NDArray[np.bool_], expected_px: float, /) -> ToldBlur:
    """The most likely blur, by the lines and by what is expected.

    seen : by the phase of all line frames; clear : (H, W) bool, pixels away from the borders of shadows; expected_px :
    what stands where slopes are too even, or pixels too few, to tell more; 0 is taken as known.
    """
    patterns = frames.line_patterns
    turn = 2 * np.pi / patterns[0].period_px
    angle = turn * np.array([pattern.centre_px for pattern in patterns])
    height, width = seen.position.shape

    def beside(rows: int, columns: int) -> tuple[slice, slice]:
        first, second = _EVERY + rows, _EVERY + columns
        return slice(first, height - _EVERY + rows, _EVERY), slice(second, width - _EVERY + columns, _EVERY)

    inner = beside(0, 0)
    lines = np.array([image[inner] for image in frames.lines], dtype=np.float64)
    left = np.hypot(np.tensordot(np.cos(angle), lines, 1), np.tensordot(np.sin(angle), lines, 1))
    light = frames.contrast
    contrast = light[inner]
    squared, bend, edge = np.zeros((3, *left.shape))
    for rows, columns in ((0, _REACH), (_REACH, 0)):
        before, after = seen.position[beside(-rows, -columns)], seen.position[beside(rows, columns)]
        squared += ((after - before) / (2 * _REACH)) ** 2
        bend = np.maximum(bend, np.abs(before - 2 * seen.position[inner] + after))
        edge = np.maximum(edge, np.abs(light[beside(rows, columns)] - light[beside(-rows, -columns)]))
    known = clear[inner] & (bend < _FLAT_PX) & (contrast > 0) & (left > 0)
    even = known & (edge < _EVEN * contrast)
    if np.count_nonzero(even) >= _FEWEST:
        known = even
    if expected_px <= 0 or np.count_nonzero(known) < _FEWEST:
        return ToldBlur(expected_px, by_lines=False)
    across, fallen = -0.5 * turn**2 * squared[known], np.log(left[known] / contrast[known])
    kept = np.ones(len(across), dtype=np.bool_)
    told = expected_px**2
    for _ in range(_TURNS):
        middle, mean = across[kept].mean(), fallen[kept].mean()
        away = across - middle
        told = float(away[kept] @ (fallen[kept] - mean)) / max(float(away[kept] @ away[kept]), 1e-12)
        residual = np.abs(fallen - mean - told * away)
        kept = residual <= _FARTHEST * 1.4826 * np.median(residual[kept])
    expected, deviation = expected_px**2, _UNEVEN / max(float(across[kept].std()), 1e-12)
    tried = np.geomspace(min(_LEAST, expected), max(_MOST, expected), _STEPS)
    unlikely = ((tried - told) / deviation) ** 2 + (np.log(tried / expected) / _PRIOR) ** 2
    likely = float(tried[np.argmin(unlikely)])
    # Lines that tell less than is known beforehand are as likely to be misled, by a projector's focus for example.
    by_lines = deviation < _PRIOR * likely
    return ToldBlur(likely**0.5 if by_lines else expected_px, by_lines=bool(by_lines))
