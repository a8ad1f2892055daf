"""How far the camera's blur reaches, told by the lines of the scan itself.

The first harmonic of the lines' light, over white minus black, is what is left of it behind both lenses: the
projector's part is the same everywhere in its own columns, and a Gaussian blur of the camera of variance σ² leaves
exp(-½ ω²σ²|g|²) where the position rises by g per pixel, ω the phase per position. A surface has slopes that differ, so
that the logarithm falls by ½ ω²σ² along |g|²: of the albedo, the projector's focus and the noise nothing enters. On
rendered scenes the variance is told to 3 %, from 0.08 px², that of the pixel's square alone, to 1.1; a relief of few
slopes is told 1.45 for 1.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import PositionMap

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
