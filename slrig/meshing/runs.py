"""Which parts of which curves lie beside one another, to be joined by a strip of triangles."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray


def neighbouring_curves(position_px: FloatArray, offsets: IntArray, /, *, widest_step_px: float) -> IntArray:
    """(s, 2) int32: pairs of consecutive curves, neither empty, at most `widest_step_px` columns apart."""
    filled = np.flatnonzero(np.diff(offsets) > 0)
    near = np.diff(position_px[filled]) <= widest_step_px + 1e-9
    return np.stack([filled[:-1][near], filled[1:][near]], axis=1).astype(np.int32)


def whole_curves(pairs: IntArray, offsets: IntArray, /) -> IntArray:
    """(s, 4) int32: first and last point of both curves of each pair."""
    ends = np.stack([offsets[:-1], offsets[1:] - 1], axis=1)
    return np.ascontiguousarray(ends[pairs].reshape(-1, 4), dtype=np.int32)


def parts_of_curves(
    position_px: FloatArray, offsets: IntArray, along_px: FloatArray, /, *, widest_step_px: float, widest_gap_px: float
) -> IntArray:
    """(s, 4) int32: first and last point of both parts, for curves of which some are there only in parts.

    Each step of a curve has the nearest curve beside it that is there at that place, at most `widest_step_px` away. So
    a curve that ends, where the camera does not resolve its bit any more, leaves its neighbours to one another, and
    strips meet in the points that they share. Steps with nobody beside them go on in the strip next to them, as those
    of whole curves do: a fan about the last point of the curve that ends.

    along_px : (n,) float64, rising along each curve; widest_gap_px : where its next point is further, a curve is not
    there in between.
    """
    pieces = [_pieces(along_px, begin, end, widest_gap_px) for begin, end in pairwise(offsets.tolist())]
    found = _Runs(along_px, pieces)
    for curve, mine in enumerate(pieces):
        last = int(np.searchsorted(position_px, position_px[curve] + widest_step_px + 1e-9))
        for piece in mine:
            # Where along the piece there is nobody beside it yet.
            open_px = [(-np.inf, np.inf)]
            for other in (each for there in pieces[curve + 1 : last] for each in _overlapping(there, piece)):
                left: list[tuple[float, float]] = []
                for bounds in open_px:
                    taken = piece.beside(other, *bounds)
                    if taken is None:
                        left.append(bounds)
                        continue
                    begin, end, run = taken
                    found.add(*run)
                    left += [each for each in ((bounds[0], begin), (end, bounds[1])) if each[0] < each[1]]
                open_px = left
    return found.joined()


class _Runs:
    """The runs so far. Of each step the first strip on either side stands: sparse curves leave it to several."""

    def __init__(self, along_px: FloatArray, pieces: list[list[_Piece]]) -> None:
        self._along_px = along_px
        self._right, self._left = np.zeros((2, len(along_px)), dtype=np.bool_)
        self._firsts, self._lasts = np.zeros((2, len(along_px)), dtype=np.bool_)
        for piece in (piece for curve in pieces for piece in curve):
            self._firsts[piece.first] = self._lasts[piece.last] = True
        self._runs: list[list[int]] = []

    def add(self, i: int, last_i: int, j: int, last_j: int) -> None:
        """Add a run, but for the steps that have a strip already."""
        i, last_i = _free(self._right, i, last_i)
        j, last_j = _free(self._left, j, last_j)
        if i == last_i and j == last_j:
            return
        self._right[i:last_i] = True
        self._left[j:last_j] = True
        self._runs.append([i, last_i, j, last_j])

    def joined(self) -> IntArray:
        """(s, 4) int32: with the free steps before and behind each; two that share both ends are one strip."""
        runs = np.array(self._runs, dtype=np.int32).reshape(-1, 4)
        first, second = runs[:, :2], runs[:, 2:]
        runs = np.hstack([self._extended(first, second, self._right), self._extended(second, first, self._left)])
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

    def _extended(self, part: IntArray, other: IntArray, taken: NDArray[np.bool_]) -> IntArray:
        """(s, 2) int32: parts with the free steps on to the end of the curve's piece, or half way to the next strip.

        part, other : (s, 2), first and last points, and those on the curve beside; taken : (n,) bool, each step.
        """
        held = np.zeros(len(taken), dtype=np.bool_)
        held[part] = True
        points = np.arange(len(taken), dtype=np.int32)
        stops = held | self._firsts | self._lasts
        before = np.maximum.accumulate(np.where(stops, points, 0))
        behind = np.minimum.accumulate(np.where(stops, points, len(taken))[::-1])[::-1]
        longer = part.copy()
        for side, sign, ends in ((0, -1, self._firsts), (1, 1, self._lasts)):
            # Of several strips that end in one point, that which is furthest.
            order = np.lexsort((sign * self._along_px[other[:, side]], part[:, side]))
            at = part[order, side]
            furthest = np.append(at[1:] != at[:-1], True)
            mine, at = order[furthest], at[furthest]
            free = ~taken[at - (sign < 0)] & ~ends[at]
            mine, at = mine[free], at[free]
            to = before[at - 1] if sign < 0 else behind[at + 1]
            longer[mine, side] = np.where(held[to], (at + to) // 2, to)
        return longer


def _free(taken: NDArray[np.bool_], first: int, last: int) -> tuple[int, int]:
    """The first part of first … last whose steps are not taken."""
    free = np.flatnonzero(~taken[first:last])
    if len(free) == 0:
        return last, last
    first += int(free[0])
    after = np.flatnonzero(taken[first:last])
    return first, last if len(after) == 0 else first + int(after[0])


@dataclass(frozen=True, slots=True)
class _Piece:
    """A part of a curve without gaps. first : the number of its first point; along_px : (k,) float64, of its points."""

    first: int
    along_px: FloatArray

    @property
    def last(self) -> int:
        """The number of its last point."""
        return self.first + len(self.along_px) - 1

    def beside(
        self, other: _Piece, after: float, before: float
    ) -> tuple[float, float, tuple[int, int, int, int]] | None:
        """Where both are there between two places, and the points there; None where not both are.

        A place that is given is the end of a strip: this one begins in the points that the other one ends in.
        """
        low = max(self.along_px[0], other.along_px[0])
        high = min(self.along_px[-1], other.along_px[-1])
        run = []
        for piece in (self, other):
            begin = piece.last_to(after) if after > low else piece.first_from(low)
            end = piece.first_from(before) if before < high else piece.last_to(high)
            # Both at one place between two points, where the other one lies within a step.
            run += [piece.first + min(begin, end), piece.first + max(begin, end)]
        if max(low, after) >= min(high, before):
            return None
        return max(low, after), min(high, before), (run[0], run[1], run[2], run[3])

    def first_from(self, place: float) -> int:
        """The first point not before a place, or the last of all."""
        return min(int(np.searchsorted(self.along_px, place)), len(self.along_px) - 1)

    def last_to(self, place: float) -> int:
        """The last point not beyond a place, or the first of all."""
        return max(int(np.searchsorted(self.along_px, place, side="right")) - 1, 0)


def _overlapping(pieces: list[_Piece], piece: _Piece) -> list[_Piece]:
    """Those of a curve's pieces, which follow one another, that are there where another piece is."""
    first = bisect_left(pieces, piece.along_px[0], key=lambda each: each.along_px[-1])
    last = bisect_right(pieces, piece.along_px[-1], key=lambda each: each.along_px[0])
    return pieces[first:last]


def _pieces(along_px: FloatArray, begin: int, end: int, widest_gap_px: float) -> list[_Piece]:
    # Points of a stripe keep their order, and may lie a little before the one before them.
    along = np.maximum.accumulate(along_px[begin:end])
    cuts = [0, *(np.flatnonzero(np.diff(along) > widest_gap_px) + 1).tolist(), end - begin]
    return [_Piece(begin + a, along[a:b]) for a, b in pairwise(cuts) if b > a]
