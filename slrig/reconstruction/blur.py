"""How far the camera's blur reaches, told by the lines of the scan itself.

The first harmonic of the lines' light, over white minus black, is what is left of it behind both lenses: the
projector's part is the same everywhere in its own columns, and a Gaussian blur of the camera of variance σ² leaves
exp(-½ ω²σ²|g|²) where the position rises by g per pixel, ω the phase per position. A surface has slopes that differ, so
that the logarithm falls by ½ ω²σ² along |g|²: of the albedo, the projector's focus and the noise nothing enters. On
rendered scenes the variance is told to 3 %, from 0.08 px², that of the pixel's square alone, to 1.1; a relief of few
slopes is told 1.1 for 1.5, since what is expected counts there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import PositionMap

_EVERY = 4  # of rows and columns: neighbours know the same
_REACH = 2  # px either way, of the slope
_FLAT_PX = 1.0  # of second difference over that: more is two surfaces, whose light mixes
_FEWEST = 500
_TURNS = 4
_FARTHEST = 3.0  # standard deviations from the line: glints, and light of two surfaces
# Chosen, both. Of the logarithm, which a projector's focus that changes with depth may tie to the slope; and of what is
# expected, of lenses more or less in focus.
_UNEVEN = 0.02
_PRIOR_SHARE = 0.5
_LEAST = 1 / 12  # px², of the pixel's own square


def told_blur_px(frames: AxisFrames, seen: PositionMap, clear: NDArray[np.bool_], expected_px: float, /) -> float:
    """Standard deviation of the camera's own blur, its pixel's area included, px.

    seen : by the phase of all line frames; clear : (H, W) bool, pixels away from the borders of shadows; expected_px :
    what stands where slopes are too even, or pixels too few, to tell; it is one more observation elsewhere.
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
    squared, bend = np.zeros(left.shape), np.zeros(left.shape)
    for rows, columns in ((0, _REACH), (_REACH, 0)):
        before, after = seen.position[beside(-rows, -columns)], seen.position[beside(rows, columns)]
        squared += ((after - before) / (2 * _REACH)) ** 2
        bend = np.maximum(bend, np.abs(before - 2 * seen.position[inner] + after))
    contrast = frames.white[inner] - frames.black[inner]
    known = clear[inner] & (bend < _FLAT_PX) & (contrast > 0) & (left > 0)
    if np.count_nonzero(known) < _FEWEST:
        return expected_px
    across, fallen = -0.5 * turn**2 * squared[known], np.log(left[known] / contrast[known])
    kept = np.ones(len(across), dtype=np.bool_)
    told = expected_px**2
    for _ in range(_TURNS):
        middle, mean = across[kept].mean(), fallen[kept].mean()
        away = across - middle
        told = float(away[kept] @ (fallen[kept] - mean)) / max(float(away[kept] @ away[kept]), 1e-12)
        residual = np.abs(fallen - mean - told * away)
        kept = residual <= _FARTHEST * 1.4826 * np.median(residual[kept])
    # Two observations: that of the lines by the share of its weight in what is expected.
    expected = expected_px**2
    share = (float(across[kept].std()) / _UNEVEN * _PRIOR_SHARE * expected) ** 2
    return float(np.sqrt(max((share * told + expected) / (share + 1), min(_LEAST, expected))))
