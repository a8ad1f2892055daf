"""Did the board hold still while its pose was shot?

Two ways tell. The optical flow about each corner follows it through frames of all ages, and tells a jolt, and how far a
board went; it is good to a twentieth of a pixel or so. Between the first lit frame, one in the middle and the last one
corners are placed anew by their own fits. A board that moves as a whole moves them all by an affine map of their place,
six numbers, which n corners known to σ px each tell to about σ √(12/n): of 88 corners of 0.02 px, to 0.007 px. What is
told is what exceeds chance, so that the least movement that is noticed follows the light: twice that noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slrig.calibrate.pose_frames import Image, Mask, window_about
from slrig.calibration import Board, BoardView
from slrig.calibration.detection import find_board, refine_view
from slrig.errors import PoseRefusedError
from slrig.model import FloatArray

_LEAST_WINDOW, _MOST_WINDOW = 7, 31
"""Sides of the surroundings of a corner that are followed, px: 0.8 of the way to its neighbour, within these."""
_LEVELS = 2
_CLEAR_PX = 1.0
_ALIKE = 0.9
_LOST_PX = 1e3
_FLOW_TELLS_PX = 0.12
"""The flow of boards that stand still comes to half of this."""
_CHANCE = 27.9
"""What the χ² of six numbers exceeds by chance in one of ten thousand cases."""
_LEAST_COMMON = 6
_CHANGED, _CHANGED_SHARE = 0.1, 0.002
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-3)


def moved_px(views: Sequence[Image], view: BoardView, board: Board, region: Mask, full_scale: float, /) -> float:
    """The rms distance, px, of the corners from where the first frame shows them, less what noise makes of those that
    stand still; NaN with one frame only.

    The greatest over the frames, if all are below a pixel; otherwise that of the last frame that is not.

    views : (H, W) float32 each, frames of one pose in which the whole board is lit, in the order of time; region :
    (H, W) bool, the board. Corners are followed by the optical flow of their surroundings (Lucas and Kanade 1981),
    which tells small movements. A larger one may carry a corner to the place of its neighbour, which looks alike; so
    where the flow is large, or the frames are not much the same, the board is looked for anew, and `inf` stands for one
    that is not found any more.
    """
    if len(views) < 2:
        return float("nan")
    window = window_about(region, _MOST_WINDOW)
    start = view.points_px - np.array([window[1].start, window[0].start])
    board_there = region[window]
    first = _grey(views[0][window], full_scale)
    worst = 0.0
    for each in reversed(views[1:]):
        image = _grey(each[window], full_scale)
        moved = _rms(_flow(first, image, start))
        if not (moved < _CLEAR_PX and _correlation(first, image, board_there) > _ALIKE):
            # Looking for the board takes long; how far it went further on the way matters no more.
            return _apart(views[0], each, board, full_scale)
        worst = max(worst, moved)
    placed = _as_a_whole(views, view, board, full_scale)
    return max([worst, *placed]) if worst > _FLOW_TELLS_PX or not placed else max(placed)


def _as_a_whole(views: Sequence[Image], view: BoardView, board: Board, full_scale: float) -> list[float]:
    """By how much all corners together moved from the first frame to one in the middle, and to the last, px; those of
    which too few corners can be placed are left out.
    """
    chosen = sorted({0, len(views) // 2, len(views) - 1})
    before, *after = (refine_view(views[at], view, board, full_scale=full_scale) for at in chosen)
    return [moved for each in after if (moved := _moved_together(before, each)) is not None]


def _moved_together(before: BoardView, after: BoardView) -> float | None:
    """The rms of the affine displacement between two views, px, by as much as it exceeds chance, else 0; None if
    they have too few corners in common.
    """
    _, mine, its = np.intersect1d(before.corner, after.corner, return_indices=True)
    if len(mine) < _LEAST_COMMON:
        return None
    variance = before.sigma_px[mine] ** 2 + after.sigma_px[its] ** 2
    off, place = after.points_px[its] - before.points_px[mine], before.points_px[mine]
    terms = np.column_stack([np.ones(len(place)), place - place.mean(axis=0)])
    weight = 1 / np.sqrt(variance)[:, None]
    moved = terms @ np.linalg.lstsq(terms * weight, off * weight, rcond=None)[0]
    square = np.sum(moved**2, axis=1)
    exceeds = float(np.sum(square / variance)) / _CHANCE
    return float(np.sqrt(np.mean(square) * (1 - 1 / exceeds))) if exceeds > 1 else 0.0


def differ(first: Image, last: Image, full_scale: float, /) -> bool:
    """Whether two frames in which all is lit show something else, somewhere."""
    changed = np.abs(last - first) > _CHANGED * full_scale
    return float(np.mean(changed)) > _CHANGED_SHARE


def _apart(first: Image, image: Image, board: Board, full_scale: float) -> float:
    """By how much the board moved from one frame to another, looked for in both: `view` may be of a mean of the two."""
    try:
        before, after = (find_board(each, board, full_scale=full_scale) for each in (first, image))
    except PoseRefusedError:
        return float("inf")
    _, mine, its = np.intersect1d(before.corner, after.corner, return_indices=True)
    return _rms(after.points_px[its] - before.points_px[mine]) if len(mine) else float("inf")


def _flow(first: NDArray[np.uint8], image: NDArray[np.uint8], start: FloatArray) -> FloatArray:
    """(n, 2) float64: by how much the surroundings of each corner moved; far off where they were lost."""
    to_neighbour_px = float(np.median(cKDTree(start).query(start, k=[2])[0]))
    side = int(np.clip(0.8 * to_neighbour_px, _LEAST_WINDOW, _MOST_WINDOW)) | 1
    given = start.astype(np.float32).reshape(-1, 1, 2)
    followed, status, _ = cv2.calcOpticalFlowPyrLK(
        first, image, given, given.copy(), winSize=(side, side), maxLevel=_LEVELS, criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    moved = (followed - given).reshape(-1, 2).astype(np.float64)
    moved[status.ravel() == 0] = _LOST_PX
    return np.asarray(moved)


def _correlation(first: NDArray[np.uint8], image: NDArray[np.uint8], where: Mask) -> float:
    """How alike two pictures of the board are, 1 for the same but for brightness and contrast."""
    a, b = first[where].astype(np.float64), image[where].astype(np.float64)
    spread = float(a.std() * b.std())
    return float(np.mean((a - a.mean()) * (b - b.mean())) / spread) if spread > 0 else 0.0


def _grey(image: Image, full_scale: float) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image * (255.0 / full_scale), 0, 255), dtype=np.uint8)


def _rms(moved: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
