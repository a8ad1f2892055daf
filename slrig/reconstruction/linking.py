"""Linking all stripes of one code into one curve (Yang & Chen 2010, section 2).

The longest stripe begins (ties: the top-most). The stripe whose centroid is nearest joins it at that pair of ends at
which the sum of the two angles between the joining line and the end directions is least; the centroid is updated, and
so on until one curve is left. Joins are remembered as bridges.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.identification import CodedStripes
from slrig.reconstruction.stripes import gathered

_END_POINTS = 10  # the paper's r, for which it gives no number


class StripeEnsemble(NamedTuple):
    """One ordered curve per code, by rising position. Curve i holds the points offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; position_px : (c,) float64; points_px, normals : (n, 2) float64; sigma_px : (n,) float64;
    stripe : (n,) int32, the stripe each point came from.
    bridge_after : (n,) bool, True where the step to the next point joins two stripes.
    """

    offsets: IntArray
    position_px: FloatArray
    points_px: FloatArray
    normals: FloatArray
    sigma_px: FloatArray
    stripe: IntArray
    bridge_after: NDArray[np.bool_]

    def without_points(self) -> StripeEnsemble:
        """Which curves there are and where they are joined, for when their points are triangulated."""
        none = np.zeros((0, 2))
        return self._replace(points_px=none, normals=none, sigma_px=np.zeros(0), stripe=np.zeros(0, dtype=np.int32))


def link(coded: CodedStripes, /) -> StripeEnsemble:
    """Link the stripes of each code into one curve, top end first."""
    stripes = coded.stripes
    by_position = np.argsort(coded.position_px, kind="stable").astype(np.int32)
    sorted_positions = coded.position_px[by_position]
    starts = np.flatnonzero(np.diff(sorted_positions, prepend=-np.inf) > 0)
    groups = np.append(starts, len(sorted_positions)).astype(np.int32)
    order, bridge, offsets = _link_kernel(stripes.points_px, stripes.offsets, by_position, groups)
    points, normals, sigma_px = gathered(order, stripes.points_px, stripes.normals, stripes.sigma_px)
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
        sequence, reversed_ = _linked_sequence(points, offsets, members)
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
            turned = reversed_[at] != backwards
            for i in range(length):
                order[filled] = offsets[stripe + 1] - 1 - i if turned else offsets[stripe] + i
                filled += 1
            if k < count - 1:
                bridge[filled - 1] = True
        curve_offsets[g + 1] = filled
    return order, bridge, curve_offsets


@kernel_part
def _linked_sequence(points: Any, offsets: Any, members: Any) -> Any:
    """The members of one code in the order of the curve, and whether each runs backwards in it."""
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
    joined = np.zeros(count, dtype=np.bool_)
    joined[first] = True
    # The curve so far, in the row of the stripe that it began with.
    centroid, end, direction = centroids[first], ends[first], directions[first]
    weight = lengths[first]
    for _ in range(count - 1):
        near = -1
        least = np.inf
        for m in range(count):
            if not joined[m]:
                distance = (centroids[m, 0] - centroid[0]) ** 2 + (centroids[m, 1] - centroid[1]) ** 2
                if distance < least:
                    least = distance
                    near = m
        best = np.inf
        mine = theirs = 0
        for i in range(2):
            for k in range(2):
                bend = _bend(end[i], direction[i], ends[near, k], directions[near, k])
                if bend < best:
                    best = bend
                    mine, theirs = i, k
        if mine == 1:
            tail += 1
            sequence[tail] = members[near]
            reversed_[tail] = theirs == 1
        else:
            head -= 1
            sequence[head] = members[near]
            reversed_[head] = theirs == 0
        total = weight + lengths[near]
        for axis in range(2):
            end[mine, axis] = ends[near, 1 - theirs, axis]
            direction[mine, axis] = directions[near, 1 - theirs, axis]
            centroid[axis] = (weight * centroid[axis] + lengths[near] * centroids[near, axis]) / total
        weight = total
        joined[near] = True
    return sequence[head : tail + 1], reversed_[head : tail + 1]


@kernel_part
def _end_direction(points: Any, end: int, inwards: int, length: int, out: Any) -> None:
    """Eq. 1: weighted mean of the unit steps towards the end, outward; the weight falls with the distance from it."""
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
def _bend(a: Any, direction_a: Any, b: Any, direction_b: Any) -> float:
    """ω1 + ω2: how far the join of two ends turns from the directions in which they point.

    Ends that touch have no line between them: what is left is the turn from one direction into the other, the least
    that any line could have.
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
