"""Pixels near the border of a shadow or of a depth step, where light of two surfaces mixes and stripes are displaced.

A dense map of projector positions tells: between the border of the lit area and the nearest bend of that map sharper
than a surface makes, a stripe's own neighbourhood is one surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.model import FloatArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames


@dataclass(frozen=True, slots=True)
class EdgeLimits:
    """How far from a border a stripe point must be, and what a border is.

    shadow_px, depth_px : radius of refusal round the lit area's border, and round a depth step.
    bend_px : a second difference of the projector position, over two camera pixels, that no surface makes,
    bend_share : unless it is below this share of the first difference, as on a surface seen at a grazing angle.
    smallest_shadow_px : unlit specks of fewer pixels than this are noise or dust, not shadow.
    """

    shadow_px: float = 2.0
    depth_px: float = 2.0
    bend_px: float = 0.9
    bend_share: float = 0.5
    smallest_shadow_px: int = 4


def has_phase(frames: AxisFrames, /) -> bool:
    """Whether every shift of the line pattern was shown, so that its light tells the phase at each pixel."""
    patterns = frames.line_patterns
    return len(patterns) > 0 and len(patterns) == patterns[0].period_px


def dense_position(frames: AxisFrames, code: CodeMap, cell_position: FloatArray, /) -> NDArray[np.float32]:
    """(H, W) float32: the projector position at every decoded pixel, px; NaN where refused.

    cell_position : (cells,) float64, centre of each code cell. With line frames the phase of their light gives the
    position within a period, x = n/2π · arg Σ I_k exp(2πi centre_k / n), and the code the period; without them the
    middle of the code interval stands.
    """
    middle = 0.5 * (cell_position[code.lowest] + cell_position[code.highest])
    middle = np.where(code.refusal == 0, middle, np.nan)
    if not has_phase(frames):
        return np.asarray(middle, dtype=np.float32)
    patterns = frames.line_patterns
    period = patterns[0].period_px
    angle = 2 * np.pi / period * np.array([p.centre_px for p in patterns])
    return np.asarray(_phase_kernel(frames.lines, np.cos(angle), np.sin(angle), float(period), middle))


def near_edges(
    position: NDArray[np.float32],
    unlit: NDArray[np.bool_],
    resolution_px: float,
    limits: EdgeLimits,
    /,
    *,
    blur_px: float = 1.0,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels near the lit area's border, and pixels near a depth step: two (H, W) bool maps.

    unlit : (H, W) bool; resolution_px : step of the position map (0 where phase makes it continuous).
    blur_px : standard deviation of a stripe; light mixes the further, the more than 1 px it is.
    """
    reach = max(1.0, blur_px)
    dark = _without_specks(unlit, limits.smallest_shadow_px)
    bends = _bend_kernel(position, limits.bend_px + 2 * resolution_px, limits.bend_share)
    return _within(dark, limits.shadow_px * reach), _within(bends, limits.depth_px * reach)


def _without_specks(unlit: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    _, labels, figures, _ = cv2.connectedComponentsWithStats(unlit.astype(np.uint8), connectivity=8)
    large = figures[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False
    return np.asarray(large[labels])


def _within(mask: NDArray[np.bool_], radius_px: float) -> NDArray[np.bool_]:
    if not mask.any():
        return mask
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= radius_px)


@njit(cache=True, nogil=True, parallel=True)
def _phase_kernel(lines: Any, cosine: Any, sine: Any, period: float, middle: Any) -> Any:
    count, rows, columns = lines.shape
    out = np.full((rows, columns), np.nan, dtype=np.float32)
    for y in prange(rows):
        for x in range(columns):
            if np.isnan(middle[y, x]):
                continue
            real = imaginary = 0.0
            for k in range(count):
                real += lines[k, y, x] * cosine[k]
                imaginary += lines[k, y, x] * sine[k]
            within = np.arctan2(imaginary, real) * period / (2 * np.pi)
            out[y, x] = within + period * np.rint((middle[y, x] - within) / period)
    return out


@njit(cache=True, nogil=True, parallel=True)
def _bend_kernel(position: Any, limit: float, share: float) -> Any:
    rows, columns = position.shape
    out = np.zeros((rows, columns), dtype=np.bool_)
    for y in prange(1, rows - 1):
        for x in range(1, columns - 1):
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                before, after = position[y - dy, x - dx], position[y + dy, x + dx]
                bend = abs(before - 2 * position[y, x] + after)
                if bend > limit and bend > share * abs(after - before):
                    out[y, x] = True
    return out
