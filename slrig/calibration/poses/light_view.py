"""Where the board's corners, and the lit pixels of the board, lie in the projector: good to a few pixels, for judging.

A solve takes each correspondence as it is. Here one plane-to-plane map per pose is enough, without lens distortion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.observations import COLUMN, BoardView, Correspondences, PoseObservation
from slrig.model import FloatArray, Size

_MOST_SAMPLES = 2500
_FEWEST_SAMPLES = 40
_TURNS = 3
_WIDE = 3.0
"""Correspondences farther off than this many robust deviations are left out of the map."""

_LEAST_SPREAD_PX = 0.5
LEAST_SIGMA_PX = 0.03
"""No corner is trusted to be better known than this, whatever its detector states."""


@dataclass(frozen=True, slots=True)
class LitBoard:
    """One pose as the projector would see it.

    view : the board's corners in its image; of several cameras, the one with the most counts; None where no camera has
    enough light on them. positions_px : (n, 2) float64, (column, row) of a sample of the pixels lit on the board.
    """

    view: BoardView | None
    positions_px: FloatArray


def lit_board(pose: PoseObservation, size: Size) -> LitBoard:
    """Return one pose as a projector of this size would see it. Corners that lie outside its image are left out."""
    best: BoardView | None = None
    positions = [np.zeros((0, 2))]
    for camera, light in pose.correspondences.items():
        to_projector = plane_map(light)
        if to_projector is None:
            continue
        positions_px = mapped(to_projector, _sample(light).pixels_px)
        positions.append(positions_px[within(positions_px, size)])
        view = pose.views.get(camera)
        if view is None:
            continue
        points_px = mapped(to_projector, view.points_px)
        inside = within(points_px, size)
        sigma_px = np.full(int(inside.sum()), _corner_sigma(light, len(view.corner)))
        found = BoardView(view.corner[inside], points_px[inside], sigma_px)
        if best is None or len(found.corner) > len(best.corner):
            best = found
    return LitBoard(best, np.concatenate(positions))


def plane_map(light: Correspondences) -> FloatArray | None:
    """Return the (3, 3) float64 homography from camera pixels to projector (column, row), or None without one.

    Each correspondence gives one linear equation, u (h3·p) = h_axis·p (Hartley and Zisserman, chapter 4), so that
    columns and rows need not come from the same pixels. Fitted again without what lies far off.
    """
    few = _sample(light)
    along_column = few.axis == COLUMN
    if min(int(along_column.sum()), int((~along_column).sum())) < _FEWEST_SAMPLES:
        return None
    columns, rows = few.position_px[along_column], few.position_px[~along_column]
    in_camera = _scaling(few.pixels_px.mean(axis=0), float(few.pixels_px.std()))
    middle = np.array([np.median(columns), np.median(rows)])
    in_projector = _scaling(middle, max(float(columns.std()), float(rows.std())))
    points = np.column_stack([few.pixels_px, np.ones(len(few.axis))]) @ in_camera.T
    position = few.position_px * np.where(along_column, in_projector[0, 0], in_projector[1, 1])
    position = position + np.where(along_column, in_projector[0, 2], in_projector[1, 2])
    rows = np.zeros((len(points), 9))
    rows[along_column, 0:3] = points[along_column]
    rows[~along_column, 3:6] = points[~along_column]
    rows[:, 6:9] = -position[:, None] * points
    keep = np.ones(len(points), dtype=bool)
    solved = np.eye(3)
    for _ in range(_TURNS):
        _, vectors = np.linalg.eigh(rows[keep].T @ rows[keep])
        solved = vectors[:, 0].reshape(3, 3)
        depth = points @ solved[2]
        if not (np.abs(depth) > 1e-9).all():
            return None
        off = np.abs(np.where(along_column, points @ solved[0], points @ solved[1]) / depth - position)
        spread = 1.4826 * float(np.median(off[keep]))
        fresh = off <= max(_WIDE * spread, _LEAST_SPREAD_PX * float(in_projector[0, 0]))
        if fresh.sum() < 2 * _FEWEST_SAMPLES or (fresh == keep).all():
            break
        keep = fresh
    return np.asarray(np.linalg.inv(in_projector) @ solved @ in_camera, dtype=np.float64)


def mapped(homography: FloatArray, points_px: FloatArray) -> FloatArray:
    """(n, 2) float64: points taken through a (3, 3) homography."""
    ends = np.column_stack([points_px, np.ones(len(points_px))]) @ homography.T
    return np.asarray(ends[:, :2] / ends[:, 2:], dtype=np.float64)


def within(points_px: FloatArray, size: Size) -> NDArray[np.bool_]:
    """(n,) bool: whether each point lies in an image of this size, whose pixel centres are at whole numbers."""
    inside = (points_px > -0.5) & (points_px < np.array([size.width_px, size.height_px]) - 0.5)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def _sample(light: Correspondences) -> Correspondences:
    step = max(1, len(light.axis) // _MOST_SAMPLES)
    # An odd step: with an even one, columns and rows that come by turns would leave one axis out.
    every = slice(None, None, step + (1 - step % 2))
    return Correspondences(light.pixels_px[every], light.axis[every], light.position_px[every], light.sigma_px[every])


def _corner_sigma(light: Correspondences, corners: int) -> float:
    """Deviation of a corner in the projector: that of its light, averaged over the pixels that belong to it."""
    per_corner = max(1.0, len(light.axis) / (2 * max(corners, 1)))
    return max(LEAST_SIGMA_PX, float(np.median(light.sigma_px)) / float(np.sqrt(per_corner)))


def _scaling(middle: FloatArray, spread: float) -> FloatArray:
    """A similarity that brings points about a middle to the origin at unit spread, which the linear solve needs."""
    spread = max(spread, 1e-6)
    return np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])
