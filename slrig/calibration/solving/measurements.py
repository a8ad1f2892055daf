"""What was observed, as flat arrays that kernels walk over, in groups of one camera and one pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.observations import Correspondences, Observations
from slrig.model import FloatArray, IntArray

LEAST_CORNERS = 6
"""A view with fewer corners than this tells too little of a pose."""


@dataclass(frozen=True, slots=True)
class Measurements:
    """All observations of some poses by some cameras.

    corner_where : (n, 3) int32, camera, pose and corner; corner_px : (n, 2); corner_sigma : (n,), px, as stated.
    match_where : of the correspondences with the projector, (k, 3) int32, camera, pose and axis; match_pixel : (k, 2),
    in the camera; match_px : (k,), projector coordinates; match_sigma : (k,), as stated.
    """

    corner_where: IntArray
    corner_px: FloatArray
    corner_sigma: FloatArray
    match_where: IntArray
    match_pixel: FloatArray
    match_px: FloatArray
    match_sigma: FloatArray

    def of(self, corners: NDArray[np.bool_], matches: NDArray[np.bool_]) -> Measurements:
        """Those that are chosen: (n,) and (k,) bool."""
        return Measurements(
            self.corner_where[corners], self.corner_px[corners], self.corner_sigma[corners], self.match_where[matches],
            self.match_pixel[matches], self.match_px[matches], self.match_sigma[matches],
        )  # fmt: skip

    def of_poses(self, poses: NDArray[np.bool_], /, *, matches: bool = True) -> Measurements:
        """Those of the chosen poses, (m,) bool; without their matches if those are not wanted."""
        return self.of(poses[self.corner_where[:, 1]], poses[self.match_where[:, 1]] & matches)

    def thinned(self, limit: int) -> Measurements:
        """The same with at most `limit` correspondences of each camera, pose and axis, spread over its image."""
        keep = np.zeros(len(self.match_px), dtype=np.bool_)
        for rows in groups(self.match_where):
            keep[rows.start + spread(self.match_pixel[rows], limit)] = True
        return self.of(np.ones(len(self.corner_px), dtype=np.bool_), keep)


def measured(
    observations: Observations, flipped: Mapping[tuple[int, int], bool], /, *, matches_per_view: int
) -> Measurements:
    """Flat arrays of all poses; what is not finite, or has no positive deviation, is left out.

    flipped : by (camera, pose), whether that view's corners are counted from the board's other end.
    matches_per_view : at most as many correspondences of each camera, pose and axis are used, spread over its image.
    """
    last = observations.board.corner_count - 1
    nothing = np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros(0)
    corners, matches = [nothing], [(*nothing, np.zeros(0))]
    for number, pose in enumerate(observations.poses):
        for camera, name in enumerate(observations.cameras):
            view = pose.views.get(name)
            if view is not None and len(view.corner) >= LEAST_CORNERS:
                corner = last - view.corner if flipped.get((camera, number), False) else view.corner
                where = np.column_stack([np.full((len(corner), 2), (camera, number)), corner]).astype(np.int32)
                good = np.isfinite(view.points_px).all(axis=1) & (view.sigma_px > 0) & np.isfinite(view.sigma_px)
                corners.append((where[good], view.points_px[good], view.sigma_px[good]))
            seen = pose.correspondences.get(name)
            if seen is not None and len(seen.axis) and observations.projector is not None:
                matches.append(_match_rows(camera, number, seen, matches_per_view))
    columns = [*zip(*corners, strict=True), *zip(*matches, strict=True)]
    return Measurements(*(np.concatenate(column) for column in columns))


def _match_rows(
    camera: int, pose: int, seen: Correspondences, limit: int
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    finite = np.isfinite(seen.pixels_px).all(axis=1) & np.isfinite(seen.position_px)
    good = finite & np.isfinite(seen.sigma_px) & (seen.sigma_px > 0)
    chosen: list[IntArray] = []
    for axis in (0, 1):
        rows = np.flatnonzero(good & (seen.axis == axis))
        chosen.append(rows[spread(seen.pixels_px[rows], limit)].astype(np.int32))
    kept = np.concatenate(chosen)
    where = np.column_stack([np.full((len(kept), 2), (camera, pose)), seen.axis[kept]]).astype(np.int32)
    return where, seen.pixels_px[kept], seen.position_px[kept], seen.sigma_px[kept]


def groups(where: IntArray, /, *, columns: int = 3) -> list[slice]:
    """The runs of rows whose first `columns` numbers are the same. Measurements lie in such runs, pose by pose."""
    if not len(where):
        return []
    changes = np.flatnonzero(np.any(np.diff(where[:, :columns], axis=0) != 0, axis=1)) + 1
    ends = [0, *changes.tolist(), len(where)]
    return [slice(first, last) for first, last in pairwise(ends)]


def spread(points_px: FloatArray, limit: int) -> IntArray:
    """(at most limit,) int: row numbers of points (n, 2) that lie evenly over their extent, one per cell first.

    Cells have about the size at which the points would fill `limit` of them; which point of a cell is taken is random,
    and the same every time.
    """
    count = len(points_px)
    if count <= limit:
        return np.arange(count, dtype=np.int32)
    order = np.random.default_rng(count).permutation(count)
    least = points_px.min(axis=0)
    extent = np.maximum(points_px.max(axis=0) - least, 1.0)
    side = np.sqrt(extent[0] * extent[1] / limit)
    cell = ((points_px[order] - least) / side).astype(np.int64)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    by_key = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(key[by_key]) != 0]))
    rank = np.arange(count) - np.repeat(starts, np.diff(np.append(starts, count)))
    first = by_key[np.argsort(rank, kind="stable")[:limit]]
    return np.sort(order[first])
