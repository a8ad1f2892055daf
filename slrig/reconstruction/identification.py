"""Giving each stripe its projector column, and refusing ambiguous points.

Every point looks up the interval of code cells at its pixel; both ends of the interval must mean the same light
column in the frame that the point was found in. A chain is cut where the column changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, Refusal
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.stripes import Stripes, gathered

_AMBIGUOUS_LINE = int(Refusal.AMBIGUOUS_LINE)
_BEYOND_PROJECTOR = int(Refusal.BEYOND_PROJECTOR)
_STRAY_CODE = int(Refusal.STRAY_CODE)
_SHADOW_EDGE = int(Refusal.SHADOW_EDGE)
_DEPTH_EDGE = int(Refusal.DEPTH_EDGE)
_SHORT_STRIPE = int(Refusal.SHORT_STRIPE)
_SATURATED = int(Refusal.SATURATED)
_LONGEST_GAP_POINTS = 3  # that show another position, or none, on a stripe that goes on behind them


@dataclass(frozen=True, slots=True)
class CodedStripes:
    """Stripes with the projector position each shows: position_px (s,) float64, rising or not."""

    stripes: Stripes
    position_px: FloatArray


def identify(
    stripes: Stripes,
    code: CodeMap,
    position_of: FloatArray,
    near_shadow: NDArray[np.bool_],
    near_step: NDArray[np.bool_],
    /,
    *,
    shortest_points: int,
) -> tuple[CodedStripes, NDArray[np.uint8]]:
    """Number the stripes of one camera and axis.

    position_of : (frames, cells) float64, the light position, px, that a stripe of this frame has when its pixel shows
    this cell; NaN where the projector's border cuts the line.
    near_shadow, near_step : (H, W) bool, pixels where light of two surfaces mixes.
    Returns the coded stripes, and the (H, W) uint8 map of refusals with those of the stripe points added.
    """
    refusal = code.refusal.copy()
    count = len(stripes.points_px)
    shown, cause = np.full(count, np.nan), np.zeros(count, dtype=np.uint8)
    in_bands(
        _position_kernel, len(stripes), stripes.offsets, stripes.frame, stripes.points_px, code, position_of,
        near_shadow, near_step, shown, cause,
    )  # fmt: skip
    order, offsets, chains, position = _identify_kernel(
        stripes.offsets, stripes.points_px, shown, cause, shortest_points, refusal
    )
    cut = gathered(order, stripes.points_px, stripes.normals, stripes.sigma_px)
    return CodedStripes(Stripes(offsets, stripes.frame[chains], *cut), position), refusal


def with_refused_pixels(
    code: CodeMap,
    frames: AxisFrames,
    position: NDArray[np.float32],
    position_of: FloatArray,
    near_shadow: NDArray[np.bool_],
    near_step: NDArray[np.bool_],
    /,
) -> CodeMap:
    """The code map with the causes of those pixels marked in which the refinement makes no point.

    Arguments as for `identify`; position : (H, W) float32, that of `phase.position_map`, NaN where a line frame is
    clipped.
    """
    refusal = code.refusal.copy()
    clipped = np.zeros(refusal.shape, dtype=np.bool_)

    def clip(first: int, last: int) -> None:
        for image in frames.lines:
            clipped[first:last] |= image[first:last] >= frames.clipped_at

    in_bands(clip, len(clipped))
    by_cell = np.ascontiguousarray(position_of.T)
    in_bands(_cause_kernel, len(refusal), by_cell, code, clipped, position, near_shadow, near_step, refusal)
    return code._replace(refusal=refusal)


@kernel
def _cause_kernel(
    first: int, last: int, by_cell: Any, code: Any, clipped: Any, position: Any, near_shadow: Any, near_step: Any,
    refusal: Any,
) -> None:  # fmt: skip
    """Fill in why a pixel has no point, by the line that is nearest to it."""
    frames = by_cell.shape[1]
    for y in range(first, last):
        for x in range(position.shape[1]):
            lowest, highest = code.lowest[y, x], code.highest[y, x]
            if lowest < 0:
                continue
            here, frame, nearest = position[y, x], 0, np.inf
            for k in range(frames):
                away = abs(by_cell[lowest, k] - here)
                if away < nearest:
                    frame, nearest = k, away
            cause = _cause(by_cell[lowest, frame], by_cell[highest, frame], near_shadow[y, x], near_step[y, x])
            if not cause and np.isnan(here) and clipped[y, x]:
                cause = _SATURATED
            if cause:
                refusal[y, x] = cause


@kernel_part(inline="always")
def _cause(low: float, high: float, near_shadow: bool, near_step: bool) -> int:
    """Why a point is refused whose pixel may mean these two lines; 0 if it is not."""
    if np.isnan(low) or np.isnan(high):
        return _BEYOND_PROJECTOR
    if low != high:
        return _AMBIGUOUS_LINE
    if near_shadow:
        return _SHADOW_EDGE
    if near_step:
        return _DEPTH_EDGE
    return 0


@kernel
def _position_kernel(
    first: int, last: int, offsets: Any, frame: Any, points: Any, code: Any, position_of: Any,
    near_shadow: Any, near_step: Any, position: Any, cause: Any,
) -> None:  # fmt: skip
    """Fill in the position that each point shows, NaN where it is refused, and the cause of that."""
    for s in range(first, last):
        for i in range(offsets[s], offsets[s + 1]):
            x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
            if code.lowest[y, x] < 0:
                continue
            low, high = position_of[frame[s], code.lowest[y, x]], position_of[frame[s], code.highest[y, x]]
            cause[i] = _cause(low, high, near_shadow[y, x], near_step[y, x])
            if not cause[i]:
                position[i] = low


@kernel
def _identify_kernel(offsets: Any, points: Any, position: Any, cause: Any, shortest: int, refusal: Any) -> Any:
    count = len(points)
    # One after another: points of two frames may share a pixel, and the last one's cause stands.
    for i in range(count):
        if cause[i]:
            _mark(refusal, points, i, cause[i])
    order = np.zeros(count, dtype=np.int32)
    out_offsets = np.zeros(count + 1, dtype=np.int32)
    chains = np.zeros(count, dtype=np.int32)
    out_position = np.zeros(count)
    filled = 0
    made = 0
    for s in range(len(offsets) - 1):
        first = offsets[s]
        last = offsets[s + 1]
        i = first
        while i < last:
            if np.isnan(position[i]):
                i += 1
                continue
            # A run of one position; other points in it are passed over when the run goes on soon after.
            here = position[i]
            begin = filled
            order[filled] = i
            filled += 1
            k = i + 1
            while k < last:
                if position[k] == here:
                    order[filled] = k
                    filled += 1
                    k += 1
                    continue
                ahead = -1
                for m in range(k + 1, min(last, k + 1 + _LONGEST_GAP_POINTS)):
                    if position[m] == here:
                        ahead = m
                        break
                if ahead < 0:
                    break
                for m in range(k, ahead):
                    if not np.isnan(position[m]):
                        _mark(refusal, points, m, _STRAY_CODE)
                k = ahead
            if filled - begin < shortest:
                alone = first == i and k == last
                for m in range(begin, filled):
                    _mark(refusal, points, order[m], _SHORT_STRIPE if alone else _STRAY_CODE)
                filled = begin
            else:
                chains[made] = s
                out_position[made] = here
                made += 1
                out_offsets[made] = filled
            i = k
    return order[:filled].copy(), out_offsets[: made + 1].copy(), chains[:made].copy(), out_position[:made].copy()


@kernel_part
def _mark(refusal: Any, points: Any, i: int, cause: int) -> None:
    refusal[int(np.rint(points[i, 1])), int(np.rint(points[i, 0]))] = cause
