"""The initial mesh: a strip of triangles between each two neighbouring curves (Yang & Chen 2010, section 3.2).

`strips` makes exactly I + J - 2 triangles for curves of I and J points. A second, recorded step drops triangles that
do not belong to the surface: those across a depth edge, mirror images and, on request, those that use a bridge.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.facing import Viewpoints, front_sides
from slrig.meshing.flips import prefers_flip
from slrig.meshing.topology import component_sizes, select_faces
from slrig.model import FloatArray, IntArray


def strips(points_mm: FloatArray, runs: IntArray, /) -> IntArray:
    """Triangulate between the parts of two curves each.

    points_mm : (n, 3) float64, in curve order; runs : (s, 4) int32, the first and last point of both parts, those of
    the second behind those of the first; see `slrig.meshing.strips`. A step of a curve is in one strip on either side.
    Returns (Σ(I + J - 2), 3) int32. Seen with curves running down and following one another to the right, triangles
    run counter-clockwise.
    """
    firsts = _strip_offsets(runs)
    faces = np.zeros((int(firsts[-1]), 3), dtype=np.int32)
    in_bands(_strips_kernel, len(runs), np.ascontiguousarray(points_mm), runs, firsts, faces)
    return faces


def strip_neighbours(faces: IntArray, runs: IntArray, point_count: int, /) -> IntArray:
    """Adjacency of the faces that `strips` makes of these runs: equal to `neighbours`, and faster.

    Triangles of a strip follow one another; two strips meet in the steps of the curve that they share.
    Returns (F, 3) int32: entry k is the face across the edge opposite corner k, -1 at a boundary.
    """
    after_first, after_second = np.full((2, point_count), -1, dtype=np.int32)
    across = np.zeros(faces.shape, dtype=np.int32)
    given = faces, runs, _strip_offsets(runs), after_first, after_second
    in_bands(_index_strip_steps, len(runs), *given)
    in_bands(_strip_neighbours, len(runs), *given, across)
    return across


def faces_to_drop(
    points_mm: FloatArray,
    faces: IntArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    /,
    *,
    depth_edge_ratio: float,
    keep_holes: bool,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The triangles that cross a depth edge, and those that use a bridge: (F,) bool each. A triangle may do both.

    sampling_mm : (n,) float64, the distance at which the rig samples a surface that faces it, at each point.
    A triangle with an edge longer than depth_edge_ratio times that crosses a depth edge. Bridges count with keep_holes.
    """
    depth_edge = np.zeros(len(faces), dtype=np.bool_)
    bridge = np.zeros(len(faces), dtype=np.bool_)
    in_bands(
        _faces_to_drop, len(faces), np.ascontiguousarray(points_mm), np.ascontiguousarray(faces), bridge_after,
        sampling_mm, depth_edge_ratio, keep_holes, depth_edge, bridge,
    )  # fmt: skip
    return depth_edge, bridge


def _strip_offsets(runs: IntArray) -> NDArray[np.int64]:
    """(s + 1,) int64: index of each strip's first triangle."""
    counts = runs[:, 1] - runs[:, 0] + runs[:, 3] - runs[:, 2]
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@kernel
def _strips_kernel(begin: int, end: int, points: Any, runs: Any, firsts: Any, faces: Any) -> None:
    for s in range(begin, end):
        # Of one type, so that the rule is compiled once.
        i, last_i = np.int64(runs[s, 0]), runs[s, 1]
        j, last_j = np.int64(runs[s, 2]), runs[s, 3]
        at = firsts[s]
        while i < last_i or j < last_j:
            if i == last_i:
                first_moves = False
            elif j == last_j:
                first_moves = True
            else:
                first_moves = prefers_flip(points, i, j + 1, j, i + 1)
            faces[at, 0] = i
            if first_moves:
                faces[at, 1] = i + 1
                faces[at, 2] = j
                i += 1
            else:
                faces[at, 1] = j + 1
                faces[at, 2] = j
                j += 1
            at += 1


@kernel
def _index_strip_steps(
    begin: int, end: int, faces: Any, runs: Any, firsts: Any, after_first: Any, after_second: Any
) -> None:
    """Write the triangle on each step of a curve, as a strip's first curve and as its second: at most one each."""
    for s in range(begin, end):
        last_of_first = runs[s, 1]
        for face in range(firsts[s], firsts[s + 1]):
            if faces[face, 1] <= last_of_first:
                after_first[faces[face, 0]] = face
            else:
                after_second[faces[face, 2]] = face


@kernel
def _strip_neighbours(
    begin: int, end: int, faces: Any, runs: Any, firsts: Any, after_first: Any, after_second: Any, across: Any
) -> None:
    for s in range(begin, end):
        last_of_first = runs[s, 1]
        for face in range(firsts[s], firsts[s + 1]):
            before = face - 1 if face > firsts[s] else -1
            after = face + 1 if face + 1 < firsts[s + 1] else -1
            if faces[face, 1] <= last_of_first:
                # (i, i + 1, j): the step is opposite j, the next triangle opposite i, the one before opposite i + 1.
                across[face, 0], across[face, 1], across[face, 2] = after, before, after_second[faces[face, 0]]
            else:
                # (i, j + 1, j): the step is opposite i.
                across[face, 0], across[face, 1], across[face, 2] = after_first[faces[face, 2]], before, after


@kernel
def _faces_to_drop(
    first: int, last: int, points: Any, faces: Any, bridge_after: Any, sampling: Any, ratio: float,
    keep_holes: bool, depth_edge: Any, bridge: Any,
) -> None:  # fmt: skip
    for face in range(first, last):
        longest, allowed, over = 0.0, 0.0, False
        for corner in range(3):
            a, b = faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]
            x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
            square = x * x + y * y + z * z
            # Not "square > longest": an unmeasured corner is longer than anything.
            if not square <= longest:
                longest = square if square > longest else np.inf
            allowed += sampling[a]
            over |= abs(a - b) == 1 and bridge_after[min(a, b)]
        depth_edge[face] = not math.sqrt(longest) <= ratio * (allowed / 3.0)
        bridge[face] = keep_holes and over


def neighbouring_curves(position_px: FloatArray, offsets: IntArray, /, *, widest_step_px: float) -> IntArray:
    """(s, 2) int32: pairs of consecutive curves, neither empty, at most `widest_step_px` columns apart."""
    filled = np.flatnonzero(np.diff(offsets) > 0)
    near = np.diff(position_px[filled]) <= widest_step_px + 1e-9
    return np.stack([filled[:-1][near], filled[1:][near]], axis=1).astype(np.int32)


def runs_of_whole_curves(pairs: IntArray, offsets: IntArray, /) -> IntArray:
    """(s, 4) int32: first and last point of both curves of each pair."""
    ends = np.stack([offsets[:-1], offsets[1:] - 1], axis=1)
    return np.ascontiguousarray(ends[pairs].reshape(-1, 4), dtype=np.int32)


def runs_of_curve_parts(
    position_px: FloatArray, offsets: IntArray, along_px: FloatArray, /, *, widest_step_px: float, widest_gap_px: float
) -> IntArray:
    """(s, 4) int32: first and last point of both parts, for curves with gaps.

    Each step of a curve is paired with the nearest curve that exists at that place, at most `widest_step_px` away. So
    where a curve ends because the camera no longer resolves its bit, its two neighbours are paired, and strips meet in
    shared points. Steps without a neighbour join the next strip, as with whole curves: a fan around the last point of
    the curve that ends.

    along_px : (n,) float64, ascending along each curve; widest_gap_px : a longer step is a gap in the curve.
    """
    pieces = [_pieces(along_px, begin, end, widest_gap_px) for begin, end in pairwise(offsets.tolist())]
    found = _Runs(along_px, pieces)
    for curve, own in enumerate(pieces):
        last = int(np.searchsorted(position_px, position_px[curve] + widest_step_px + 1e-9))
        for piece in own:
            # Parts of the piece without a neighbour yet.
            open_px = [(-np.inf, np.inf)]
            for other in (each for there in pieces[curve + 1 : last] for each in _overlapping_pieces(there, piece)):
                left: list[tuple[float, float]] = []
                for bounds in open_px:
                    taken = piece.overlap(other, *bounds)
                    if taken is None:
                        left.append(bounds)
                        continue
                    begin, end, run = taken
                    found.add(*run)
                    left += [each for each in ((bounds[0], begin), (end, bounds[1])) if each[0] < each[1]]
                open_px = left
    return found.merge()


class _Runs:
    """Collects runs. Each side of a step keeps its first strip only: sparse curves would give it several."""

    def __init__(self, along_px: FloatArray, pieces: list[list[_Piece]]) -> None:
        self._along_px = along_px
        self._right, self._left = np.zeros((2, len(along_px)), dtype=np.bool_)
        self._firsts, self._lasts = np.zeros((2, len(along_px)), dtype=np.bool_)
        for piece in (piece for curve in pieces for piece in curve):
            self._firsts[piece.first] = self._lasts[piece.last] = True
        self._runs: list[list[int]] = []

    def add(self, i: int, last_i: int, j: int, last_j: int) -> None:
        """Add a run without the steps that already have a strip."""
        i, last_i = _first_free_part(self._right, i, last_i)
        j, last_j = _first_free_part(self._left, j, last_j)
        if i == last_i and j == last_j:
            return
        self._right[i:last_i] = True
        self._left[j:last_j] = True
        self._runs.append([i, last_i, j, last_j])

    def merge(self) -> IntArray:
        """(s, 4) int32: runs extended by the free steps before and after; two that share both ends become one."""
        runs = np.array(self._runs, dtype=np.int32).reshape(-1, 4)
        first, second = runs[:, :2], runs[:, 2:]
        runs = np.hstack([self._extend(first, second, self._right), self._extend(second, first, self._left)])
        strips: list[list[int]] = []
        by_end: dict[tuple[int, int], list[int]] = {}
        for i, last_i, j, last_j in sorted(runs.tolist()):
            strip = by_end.pop((i, j), None)
            if strip is None:
                strips.append(strip := [i, last_i, j, last_j])
            else:
                strip[1], strip[3] = last_i, last_j
            by_end[last_i, last_j] = strip
        return np.array(strips, dtype=np.int32).reshape(-1, 4)

    def _extend(self, part: IntArray, other: IntArray, taken: NDArray[np.bool_]) -> IntArray:
        """(s, 2) int32: parts extended by free steps to the end of the curve's piece, or half way to the next strip.

        part, other : (s, 2), first and last points, and those on the neighbouring curve; taken : (n,) bool, each step.
        """
        held = np.zeros(len(taken), dtype=np.bool_)
        held[part] = True
        points = np.arange(len(taken), dtype=np.int32)
        stops = held | self._firsts | self._lasts
        before = np.maximum.accumulate(np.where(stops, points, 0))
        behind = np.minimum.accumulate(np.where(stops, points, len(taken))[::-1])[::-1]
        longer = part.copy()
        for side, sign, ends in ((0, -1, self._firsts), (1, 1, self._lasts)):
            # Of several strips that end in one point, the furthest.
            order = np.lexsort((sign * self._along_px[other[:, side]], part[:, side]))
            at = part[order, side]
            furthest = np.append(at[1:] != at[:-1], True)[: len(at)]
            strip, at = order[furthest], at[furthest]
            free = ~taken[at - (sign < 0)] & ~ends[at]
            strip, at = strip[free], at[free]
            to = before[at - 1] if sign < 0 else behind[at + 1]
            longer[strip, side] = np.where(held[to], (at + to) // 2, to)
        return longer


def _first_free_part(taken: NDArray[np.bool_], first: int, last: int) -> tuple[int, int]:
    """The first range within first … last whose steps are not taken."""
    free = np.flatnonzero(~taken[first:last])
    if len(free) == 0:
        return last, last
    first += int(free[0])
    after = np.flatnonzero(taken[first:last])
    return first, last if len(after) == 0 else first + int(after[0])


@dataclass(frozen=True, slots=True)
class _Piece:
    """A part of a curve without gaps. first : index of its first point; along_px : (k,) float64, of its points."""

    first: int
    along_px: FloatArray

    @property
    def last(self) -> int:
        """Index of its last point."""
        return self.first + len(self.along_px) - 1

    def overlap(
        self, other: _Piece, after: float, before: float
    ) -> tuple[float, float, tuple[int, int, int, int]] | None:
        """Interval between two places in which both pieces exist, and their points there; None without one.

        A given place is the end of another strip: this one begins at the points where that one ends.
        """
        low = max(self.along_px[0], other.along_px[0])
        high = min(self.along_px[-1], other.along_px[-1])
        run = []
        for piece in (self, other):
            begin = piece.last_at_or_before(after) if after > low else piece.first_at_or_after(low)
            end = piece.first_at_or_after(before) if before < high else piece.last_at_or_before(high)
            # Both bounds between the same two points, if the other piece is within one step.
            run += [piece.first + min(begin, end), piece.first + max(begin, end)]
        if max(low, after) >= min(high, before):
            return None
        return max(low, after), min(high, before), (run[0], run[1], run[2], run[3])

    def first_at_or_after(self, place: float) -> int:
        """The first point at or after a place, or else the last point."""
        return min(int(np.searchsorted(self.along_px, place)), len(self.along_px) - 1)

    def last_at_or_before(self, place: float) -> int:
        """The last point at or before a place, or else the first point."""
        return max(int(np.searchsorted(self.along_px, place, side="right")) - 1, 0)


def _overlapping_pieces(pieces: list[_Piece], piece: _Piece) -> list[_Piece]:
    """The pieces of a curve, in order, that overlap another piece."""
    first = bisect_left(pieces, piece.along_px[0], key=lambda each: each.along_px[-1])
    last = bisect_right(pieces, piece.along_px[-1], key=lambda each: each.along_px[0])
    return pieces[first:last]


def _pieces(along_px: FloatArray, begin: int, end: int, widest_gap_px: float) -> list[_Piece]:
    # Points of a stripe keep their order, even if their places decrease a little.
    along = np.maximum.accumulate(along_px[begin:end])
    cuts = [0, *(np.flatnonzero(np.diff(along) > widest_gap_px) + 1).tolist(), end - begin]
    return [_Piece(begin + a, along[a:b]) for a, b in pairwise(cuts) if b > a]


MIN_COMPONENT = 100
"""Triangles of a component; fewer are dust of stripe points that agreed by chance."""


@dataclass(frozen=True, slots=True)
class InitialMesh:
    """faces : (F, 3) int32 into the curves' points, counter-clockwise seen from the camera that measured them.
    adjacency : (F, 3) int32, entry k is the face across the edge opposite corner k, -1 at a boundary. mirror_faces :
    (M, 3) int32, the mirror images among the dropped triangles; few of them, such as folds next to a depth edge, count
    as dust. strip_triangles : Σ(I + J - 2), before dropping; the drops at edges and bridges overlap, mirror images are
    counted among the rest, and dust among what remains then: small components.
    """

    faces: IntArray
    adjacency: IntArray
    mirror_faces: IntArray
    strip_pairs: int
    strip_triangles: int
    dropped_at_depth_edges: int
    dropped_at_bridges: int
    dropped_as_dust: int
    dropped_triangles: int


def initial_mesh(
    points_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    views: Viewpoints,
    /,
    *,
    widest_step_px: float,
    depth_edge_ratio: float,
    keep_holes: bool,
    runs: IntArray | None = None,
) -> InitialMesh:
    """Mesh between neighbouring curves and drop triangles that are not surface.

    points_mm : (n, 3) float64; offsets : (c + 1,) int32; position_px : (c,) float64; bridge_after : (n,) bool;
    sampling_mm : (n,) float64; views : the devices that decide which side is the front.
    runs : (s, 4) int32, the parts to join, from `runs_of_curve_parts`; by default whole neighbouring curves.
    """
    if runs is None:
        runs = runs_of_whole_curves(neighbouring_curves(position_px, offsets, widest_step_px=widest_step_px), offsets)
    strip_faces = strips(points_mm, runs)
    adjacency = strip_neighbours(strip_faces, runs, len(points_mm))
    at_depth_edge, at_bridge = faces_to_drop(
        points_mm, strip_faces, bridge_after, sampling_mm, depth_edge_ratio=depth_edge_ratio, keep_holes=keep_holes
    )
    connected = ~(at_depth_edge | at_bridge)
    front = front_sides(points_mm, strip_faces, views, connected)
    images = strip_faces[front.mirrored]
    mirror_faces = images[component_sizes(images, np.ones(len(images), dtype=np.bool_)) >= MIN_COMPONENT]
    linked = int(np.count_nonzero(connected)) - len(mirror_faces)
    connected &= ~front.mirrored
    apart = _between_windings(adjacency, front.turned, connected)
    remaining = component_sizes(strip_faces, connected & ~apart) >= MIN_COMPONENT
    faces, across = select_faces(strip_faces, adjacency, remaining)
    turned = front.turned[remaining]
    if turned.all():
        faces, across = np.ascontiguousarray(faces[:, ::-1]), np.ascontiguousarray(across[:, ::-1])
    elif turned.any():
        faces[turned], across[turned] = faces[turned, ::-1], across[turned, ::-1]
    return InitialMesh(
        faces=faces,
        adjacency=across,
        mirror_faces=mirror_faces,
        strip_pairs=len(runs),
        strip_triangles=len(strip_faces),
        dropped_at_depth_edges=int(np.count_nonzero(at_depth_edge)),
        dropped_at_bridges=int(np.count_nonzero(at_bridge)),
        dropped_as_dust=linked - len(faces),
        dropped_triangles=len(strip_faces) - len(faces),
    )


def _between_windings(
    adjacency: IntArray, turned: NDArray[np.bool_], connected: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(F,) bool: turned triangles next to one that is not: with both, a mesh has no front."""
    apart = np.zeros(len(turned), dtype=np.bool_)
    suspects = np.flatnonzero(turned & connected)
    if len(suspects) < np.count_nonzero(connected):
        beyond = adjacency[suspects]
        apart[suspects] = ((beyond >= 0) & connected[beyond] & ~turned[beyond]).any(axis=1)
    return apart
