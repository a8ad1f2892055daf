"""Projector column of each stripe, refusal of ambiguous points, and links between stripes of one column.

Every point looks up the interval of code cells at its pixel. Both ends of the interval must mean the same column of
light in the frame of the point. A chain is cut where the column changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray, Refusal
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.stripes import Stripes, gather_points

_AMBIGUOUS_LINE = int(Refusal.AMBIGUOUS_LINE)
_BEYOND_PROJECTOR = int(Refusal.BEYOND_PROJECTOR)
_STRAY_CODE = int(Refusal.STRAY_CODE)
_SHADOW_EDGE = int(Refusal.SHADOW_EDGE)
_DEPTH_EDGE = int(Refusal.DEPTH_EDGE)
_SHORT_STRIPE = int(Refusal.SHORT_STRIPE)
_SATURATED = int(Refusal.SATURATED)
_MAX_GAP_POINTS = 3  # of another position, or none, that do not end a stripe

_END_POINTS = 10  # r in the paper, which gives no value


@dataclass(frozen=True, slots=True)
class NumberedStripes:
    """Stripes with their projector position: position_px (s,) float64, in any order."""

    stripes: Stripes
    position_px: FloatArray


def identify_stripes(
    stripes: Stripes,
    code: CodeMap,
    position_table: FloatArray,
    near_shadow: NDArray[np.bool_],
    near_step: NDArray[np.bool_],
    /,
    *,
    shortest_points: int,
) -> tuple[NumberedStripes, NDArray[np.uint8]]:
    """Number the stripes of one camera and axis.

    position_table : (frames, cells) float64, px, light position of a stripe of this frame at a pixel of this cell; NaN
    where the projector's border cuts the line. near_shadow, near_step : (H, W) bool, pixels where light of two surfaces
    mixes. Returns the numbered stripes, and the (H, W) uint8 map of refusals with those of stripe points added.
    """
    refusal = code.refusal.copy()
    count = len(stripes.points_px)
    point_position, cause = np.full(count, np.nan), np.zeros(count, dtype=np.uint8)
    in_bands(
        _position_kernel, len(stripes), stripes.offsets, stripes.frame, stripes.points_px, code, position_table,
        near_shadow, near_step, point_position, cause,
    )  # fmt: skip
    order, offsets, chains, position = _identify_kernel(
        stripes.offsets, stripes.points_px, point_position, cause, shortest_points, refusal
    )
    points = gather_points(order, stripes.points_px, stripes.normals, stripes.sigma_px)
    return NumberedStripes(Stripes(offsets, stripes.frame[chains], *points), position), refusal


def mark_refused_pixels(
    code: CodeMap,
    frames: AxisFrames,
    position: NDArray[np.float32],
    position_table: FloatArray,
    near_shadow: NDArray[np.bool_],
    near_step: NDArray[np.bool_],
    /,
) -> CodeMap:
    """Add the causes of pixels in which refinement makes no point to the code map.

    Arguments as for `identify_stripes`; position : (H, W) float32, that of `phase.position_map`, NaN where a line frame
    is clipped.
    """
    refusal = code.refusal.copy()
    clipped = np.zeros(refusal.shape, dtype=np.bool_)

    def find_clipped(first: int, last: int) -> None:
        for image in frames.lines:
            clipped[first:last] |= image[first:last] >= frames.clipped_at

    in_bands(find_clipped, len(clipped))
    by_cell = np.ascontiguousarray(position_table.T)
    in_bands(_cause_kernel, len(refusal), by_cell, code, clipped, position, near_shadow, near_step, refusal)
    return code._replace(refusal=refusal)


@kernel
def _cause_kernel(
    first: int, last: int, by_cell: Any, code: Any, clipped: Any, position: Any, near_shadow: Any, near_step: Any,
    refusal: Any,
) -> None:  # fmt: skip
    """Fill in why a pixel has no point, by the line closest to it."""
    frames = by_cell.shape[1]
    for y in range(first, last):
        for x in range(position.shape[1]):
            lowest, highest = code.lowest[y, x], code.highest[y, x]
            if lowest < 0:
                continue
            here, frame, nearest = position[y, x], 0, np.inf
            for k in range(frames):
                distance = abs(by_cell[lowest, k] - here)
                if distance < nearest:
                    frame, nearest = k, distance
            cause = _cause(by_cell[lowest, frame], by_cell[highest, frame], near_shadow[y, x], near_step[y, x])
            if not cause and np.isnan(here) and clipped[y, x]:
                cause = _SATURATED
            if cause:
                refusal[y, x] = cause


@kernel_part(inline="always")
def _cause(low: float, high: float, near_shadow: bool, near_step: bool) -> int:
    """Cause of refusal of a point whose pixel may mean these two lines; 0 for none."""
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
    first: int, last: int, offsets: Any, frame: Any, points: Any, code: Any, position_table: Any,
    near_shadow: Any, near_step: Any, position: Any, cause: Any,
) -> None:  # fmt: skip
    """Fill in the position of each point, NaN if it is refused, and the cause of refusal."""
    for s in range(first, last):
        for i in range(offsets[s], offsets[s + 1]):
            x, y = int(np.rint(points[i, 0])), int(np.rint(points[i, 1]))
            if code.lowest[y, x] < 0:
                continue
            low, high = position_table[frame[s], code.lowest[y, x]], position_table[frame[s], code.highest[y, x]]
            cause[i] = _cause(low, high, near_shadow[y, x], near_step[y, x])
            if not cause[i]:
                position[i] = low


@kernel
def _identify_kernel(offsets: Any, points: Any, position: Any, cause: Any, shortest: int, refusal: Any) -> Any:
    count = len(points)
    # In order: points of two frames may share a pixel, and the last cause counts.
    for i in range(count):
        if cause[i]:
            _mark(refusal, points, i, cause[i])
    order = np.zeros(count, dtype=np.int32)
    out_offsets = np.zeros(count + 1, dtype=np.int32)
    chains = np.zeros(count, dtype=np.int32)
    out_position = np.zeros(count)
    filled = 0
    count_out = 0
    for s in range(len(offsets) - 1):
        first = offsets[s]
        last = offsets[s + 1]
        i = first
        while i < last:
            if np.isnan(position[i]):
                i += 1
                continue
            # A run of one position. Other points are skipped if the run continues soon.
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
                for m in range(k + 1, min(last, k + 1 + _MAX_GAP_POINTS)):
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
                is_whole_chain = first == i and k == last
                for m in range(begin, filled):
                    _mark(refusal, points, order[m], _SHORT_STRIPE if is_whole_chain else _STRAY_CODE)
                filled = begin
            else:
                chains[count_out] = s
                out_position[count_out] = here
                count_out += 1
                out_offsets[count_out] = filled
            i = k
    return (
        order[:filled].copy(),
        out_offsets[: count_out + 1].copy(),
        chains[:count_out].copy(),
        out_position[:count_out].copy(),
    )


@kernel_part
def _mark(refusal: Any, points: Any, i: int, cause: int) -> None:
    refusal[int(np.rint(points[i, 1])), int(np.rint(points[i, 0]))] = cause


class StripeEnsemble(NamedTuple):
    """One ordered curve per projector position, sorted by it. Curve i holds the points offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; position_px : (c,) float64; points_px, normals : (n, 2) float64; sigma_px : (n,) float64;
    stripe : (n,) int32, stripe of each point; bridge_after : (n,) bool, True where the step to the next point joins two
    stripes.
    """

    offsets: IntArray
    position_px: FloatArray
    points_px: FloatArray
    normals: FloatArray
    sigma_px: FloatArray
    stripe: IntArray
    bridge_after: NDArray[np.bool_]

    @property
    def ends(self) -> NDArray[np.bool_]:
        """(n,) bool: points whose next point is of another stripe or curve."""
        ends = self.bridge_after.copy()
        ends[self.offsets[1:] - 1] = True
        return ends

    def without_points(self) -> StripeEnsemble:
        """Curves and joins without the points, for use after triangulation."""
        empty = np.zeros((0, 2))
        return self._replace(points_px=empty, normals=empty, sigma_px=np.zeros(0), stripe=np.zeros(0, dtype=np.int32))


def link_stripes(coded: NumberedStripes, /) -> StripeEnsemble:
    """Link the stripes of each position into one curve, top end first."""
    stripes = coded.stripes
    by_position = np.argsort(coded.position_px, kind="stable").astype(np.int32)
    sorted_positions = coded.position_px[by_position]
    starts = np.flatnonzero(np.diff(sorted_positions, prepend=-np.inf) > 0)
    groups = np.append(starts, len(sorted_positions)).astype(np.int32)
    order, bridge, offsets = _link_kernel(stripes.points_px, stripes.offsets, by_position, groups)
    points, normals, sigma_px = gather_points(order, stripes.points_px, stripes.normals, stripes.sigma_px)
    return StripeEnsemble(
        offsets=offsets,
        position_px=sorted_positions[starts],
        points_px=points,
        normals=normals,
        sigma_px=sigma_px,
        stripe=np.repeat(np.arange(len(stripes), dtype=np.int32), np.diff(stripes.offsets))[order],
        bridge_after=bridge,
    )


@kernel
def _link_kernel(points: Any, offsets: Any, by_position: Any, groups: Any) -> Any:
    total = len(points)
    order = np.zeros(total, dtype=np.int32)
    bridge = np.zeros(total, dtype=np.bool_)
    curve_offsets = np.zeros(len(groups), dtype=np.int32)
    filled = 0
    for g in range(len(groups) - 1):
        members = by_position[groups[g] : groups[g + 1]]
        sequence, reversed_ = _order_stripes(points, offsets, members)
        # The curve starts at its upper end.
        head, tail = sequence[0], sequence[-1]
        first = points[offsets[head + 1] - 1 if reversed_[0] else offsets[head], 1]
        last = points[offsets[tail] if reversed_[-1] else offsets[tail + 1] - 1, 1]
        backwards = last < first
        count = len(sequence)
        for k in range(count):
            at = count - 1 - k if backwards else k
            stripe = sequence[at]
            length = offsets[stripe + 1] - offsets[stripe]
            is_reversed = reversed_[at] != backwards
            for i in range(length):
                order[filled] = offsets[stripe + 1] - 1 - i if is_reversed else offsets[stripe] + i
                filled += 1
            if k < count - 1:
                bridge[filled - 1] = True
        curve_offsets[g + 1] = filled
    return order, bridge, curve_offsets


@kernel_part
def _order_stripes(points: Any, offsets: Any, members: Any) -> Any:
    """Stripes of one position in the order of the curve, and True for each that runs backwards in it."""
    count = len(members)
    ends = np.zeros((count, 2, 2))
    directions = np.zeros((count, 2, 2))
    centroids = np.zeros((count, 2))
    lengths = np.zeros(count)
    first = 0
    for m in range(count):
        a, b = np.int64(offsets[members[m]]), np.int64(offsets[members[m] + 1])
        lengths[m] = b - a
        for axis in range(2):
            for i in range(a, b):
                centroids[m, axis] += points[i, axis]
            centroids[m, axis] /= b - a
            ends[m, 0, axis] = points[a, axis]
            ends[m, 1, axis] = points[b - 1, axis]
        for side in range(2):
            _end_direction(points, b - 1 if side else a, 1 - 2 * side, b - a, directions[m, side])
        longer = lengths[m] > lengths[first]
        higher = lengths[m] == lengths[first] and centroids[m, 1] < centroids[first, 1]
        if longer or higher:
            first = m
    sequence = np.zeros(2 * count, dtype=np.int32)
    reversed_ = np.zeros(2 * count, dtype=np.bool_)
    head = tail = count
    sequence[count] = members[first]
    is_linked = np.zeros(count, dtype=np.bool_)
    is_linked[first] = True
    # The curve so far, in the row of its first stripe.
    centroid, end, direction = centroids[first], ends[first], directions[first]
    weight = lengths[first]
    for _ in range(count - 1):
        near = -1
        least = np.inf
        for m in range(count):
            if not is_linked[m]:
                distance = (centroids[m, 0] - centroid[0]) ** 2 + (centroids[m, 1] - centroid[1]) ** 2
                if distance < least:
                    least = distance
                    near = m
        best = np.inf
        own_end = other_end = 0
        for i in range(2):
            for k in range(2):
                bend = _turn_angle(end[i], direction[i], ends[near, k], directions[near, k])
                if bend < best:
                    best = bend
                    own_end, other_end = i, k
        if own_end == 1:
            tail += 1
            sequence[tail] = members[near]
            reversed_[tail] = other_end == 1
        else:
            head -= 1
            sequence[head] = members[near]
            reversed_[head] = other_end == 0
        total = weight + lengths[near]
        for axis in range(2):
            end[own_end, axis] = ends[near, 1 - other_end, axis]
            direction[own_end, axis] = directions[near, 1 - other_end, axis]
            centroid[axis] = (weight * centroid[axis] + lengths[near] * centroids[near, axis]) / total
        weight = total
        is_linked[near] = True
    return sequence[head : tail + 1], reversed_[head : tail + 1]


@kernel_part
def _end_direction(points: Any, end: int, inwards: int, length: int, out: Any) -> None:
    """Eq. 1: weighted mean of the unit steps towards the end, outward; weights fall with the distance from the end."""
    reach = min(_END_POINTS, length)
    x = y = 0.0
    for t in range(reach - 1):
        a, b = end + t * inwards, end + (t + 1) * inwards
        dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
        norm = np.sqrt(dx * dx + dy * dy)
        if norm > 0:
            x += (reach - 1 - t) * dx / norm
            y += (reach - 1 - t) * dy / norm
    norm = np.sqrt(x * x + y * y)
    if norm > 0:
        out[0], out[1] = x / norm, y / norm


@kernel_part
def _turn_angle(a: Any, direction_a: Any, b: Any, direction_b: Any) -> float:
    """ω1 + ω2: angle between the connection of two ends and their directions.

    Ends that touch have no connection: the result is the turn from one direction into the other, a lower limit for any
    connection.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    norm = np.hypot(dx, dy)
    if norm == 0:
        turn = -direction_a[0] * direction_b[0] - direction_a[1] * direction_b[1]
        return float(np.arccos(min(1.0, max(-1.0, turn))))
    dx, dy = dx / norm, dy / norm
    first = min(1.0, max(-1.0, direction_a[0] * dx + direction_a[1] * dy))
    second = min(1.0, max(-1.0, -direction_b[0] * dx - direction_b[1] * dy))
    return float(np.arccos(first) + np.arccos(second))
