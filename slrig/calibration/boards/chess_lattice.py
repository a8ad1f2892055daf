"""The largest chessboard in view, whatever its size: grown corner by corner as far as squares alternate."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.blobs import neighbours_in_steps
from slrig.calibration.boards.board_map import BoardMap
from slrig.calibration.boards.corner_fit import PlacedCorners, placed_corners
from slrig.calibration.boards.grey import Grey
from slrig.calibration.boards.lattice import Lattice, beside, levels_at
from slrig.model import FloatArray, IntArray

_SEARCHES_PX = (640, 1280)
_SMOOTH_PX, _FAINTEST, _MOST_SADDLES = 1.5, 0.1, 1500
_SIDE = 60
_FEWEST = 9
_TURNS = 2 * _SIDE
_TRUE = 0.4
"""Least share of the seed's corners that must be crossings."""
_PLANE = Board(BoardKind.CHESSBOARD, _SIDE, _SIDE, 1.0)
"""A board larger than any seed: corners of what is in view get numbers of it, the first ones in its middle."""
_ALTERNATES = 0.5
"""Least strength of a crossing over the usual one. Where three squares of four are light it is half or less."""
_MIDDLES = np.array([(-0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (0.5, -0.5)])
_WITHIN = np.array([(x, y) for x in (-0.22, 0.0, 0.22) for y in (-0.22, 0.0, 0.22)])
_TIPS = np.array([(-0.4, -0.4), (0.4, -0.4), (-0.4, 0.4), (0.4, 0.4)])


def chessboard_lattice(grey: Grey) -> Lattice | None:
    """The largest chessboard in view. None where there is none.

    What is taken for corners must be crossings of four squares that alternate and are flat: the gaps between circles,
    markers and noise are not.
    """
    for longest_px in _SEARCHES_PX:
        image, factor = grey.reduced(longest_px)
        saddles = _saddles(image)
        index, steps = neighbours_in_steps(saddles)
        if len(index) >= _FEWEST and (np.ptp(steps, axis=0) < _SIDE - 4).all():
            lattice = grown_lattice(grey.level, (saddles[index] + 0.5) / factor - 0.5, steps)
            if lattice is not None:
                return lattice
        if factor == 1.0:
            break
    return None


def _saddles(image: NDArray[np.uint8]) -> FloatArray:
    """(n, 2) float64: where grey levels rise one way and fall across it, the strongest places of an image.

    There the determinant of the second derivatives is most negative.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SMOOTH_PX)
    by_xx, by_yy = cv2.Sobel(smooth, cv2.CV_32F, 2, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    strength = cv2.Sobel(smooth, cv2.CV_32F, 1, 1) ** 2 - by_xx * by_yy
    highest = strength == cv2.dilate(strength, np.ones((7, 7), dtype=np.uint8))
    row, column = np.nonzero(highest & (strength > _FAINTEST * strength.max()))
    strongest = np.argsort(-strength[row, column])[:_MOST_SADDLES]
    return np.column_stack([column, row])[strongest].astype(np.float64)


def grown_lattice(level: FloatArray, points_px: FloatArray, steps: IntArray) -> Lattice | None:
    """The chessboard about a seed of corners, (n, 2) px, each with its column and row, (n, 2) int, without those of the
    seed that are none. None where too few remain, or the squares are not squares.
    """
    column, row = (steps - steps.min(axis=0) + (_SIDE - 1 - np.ptp(steps, axis=0)) // 2).T
    order = np.argsort(row * _SIDE + column)
    placed = placed_corners(
        level, _PLANE, (row * _SIDE + column)[order].astype(np.int32), points_px[order], crossed=True
    )
    for turn in range(_TURNS):
        if placed is None:
            return None
        corner, points = placed.view.corner, placed.view.points_px
        crossing = _crossing(level, placed.board_map, corner)
        if not np.isfinite(crossing).all(axis=1).any():
            return None
        polarity = 1.0 if np.nanmedian(crossing.sum(axis=1)) > 0 else -1.0
        strength = (polarity * crossing).min(axis=1)
        usual = float(np.nanmedian(strength))
        kept = strength > _ALTERNATES * usual
        if not usual > 0 or kept.sum() < max(_FEWEST, 0 if turn else _TRUE * len(points_px)):
            return None
        near = beside(corner[kept], _SIDE, _SIDE)
        guessed = placed.board_map(_places(near))
        more = (polarity * _crossing(level, placed.board_map, near)).min(axis=1) > _ALTERNATES * usual
        everything = np.concatenate([corner[kept], near[more]])
        rough = np.concatenate([points[kept], guessed[more]])
        order = np.argsort(everything)
        grown = placed_corners(level, _PLANE, everything[order], rough[order], crossed=True)
        if grown is None or set(grown.view.corner.tolist()) <= set(corner.tolist()):
            return _lattice(level, grown)
        placed = grown
    return _lattice(level, placed)


def _lattice(level: FloatArray, placed: PlacedCorners | None) -> Lattice | None:
    if placed is None or _round(level, placed.board_map, placed.view.corner):
        return None
    row, column = np.divmod(placed.view.corner, _SIDE)
    places = np.column_stack([column, row]).astype(np.int32)
    whole = _in_whole_lines(places)
    if whole.sum() < _FEWEST:
        return None
    places = places[whole] - places[whole].min(axis=0)
    columns, rows = (int(extent) + 1 for extent in places.max(axis=0))
    if min(columns, rows) < 3:
        return None
    return Lattice(columns, rows, placed.view.points_px[whole], places)


def _in_whole_lines(places: IntArray) -> NDArray[np.bool_]:
    """(n,) bool: which of the places (n, 2) remain when outermost lines of which not half is there are taken off.

    Where the light ends on the paper beside the print, the outermost squares, lit paper and paper in the dark may
    alternate about one place of the print's outer edge, or two: so a grid gets a line too many. Counted as one of the
    board's it would number all corners a square off.
    """
    kept = np.ones(len(places), dtype=np.bool_)
    while kept.any():
        least, most = places[kept].min(axis=0), places[kept].max(axis=0)
        lines = [kept & (places[:, axis] == end[axis]) for axis in (0, 1) for end in (least, most)]
        across = np.repeat((most - least + 1)[::-1], 2)
        few = [line for line, length in zip(lines, across, strict=True) if 2 * line.sum() < length]
        if not few:
            break
        kept &= ~few[0]
    return kept


def _places(corner: IntArray) -> FloatArray:
    row, column = np.divmod(corner, _SIDE)
    return np.column_stack([column, row]).astype(np.float64)


def _crossing(level: FloatArray, board_map: BoardMap, corner: IntArray) -> FloatArray:
    """(n, 4) float64: the steps between the four squares about each corner, as the corners' numbers ask, each less what
    varies within the squares. All have one sign at a crossing. NaN where a square lies out of view.
    """
    centres = _places(corner)[:, None] + _MIDDLES
    squares = levels_at(level, board_map(centres[:, :, None] + _WITHIN))
    middle, spread = squares.mean(axis=-1), squares.std(axis=-1).mean(axis=-1)
    row, column = np.divmod(corner, _SIDE)
    sign = np.where((row + column) % 2 == 0, 1.0, -1.0)[:, None]
    steps = sign * np.stack([middle[:, i] - middle[:, j] for i in (0, 1) for j in (2, 3)], axis=1)
    return np.asarray(np.sign(steps) * np.maximum(np.abs(steps) - spread[:, None], 0))


def _round(level: FloatArray, board_map: BoardMap, corner: IntArray) -> bool:
    """Whether the dark squares are light at their tips: then they are circles."""
    centres = _places(corner) + 0.5
    middles = levels_at(level, board_map(centres))
    tips = levels_at(level, board_map(centres[:, None] + _TIPS)).mean(axis=1)
    good = np.isfinite(middles) & np.isfinite(tips)
    if good.sum() < 4:
        return False
    threshold = (np.percentile(middles[good], 90) + np.percentile(middles[good], 10)) / 2
    dark = good & (middles < threshold)
    return bool(dark.any() and np.median(tips[dark]) > threshold)


def holds_markers(level: FloatArray, lattice: Lattice) -> bool:
    """Whether grey levels vary within the light squares far more than within the dark ones, as where markers lie."""
    board_map = lattice.board_map()
    if board_map is None:
        return False
    x, y = np.meshgrid(np.arange(lattice.columns - 1) + 0.5, np.arange(lattice.rows - 1) + 0.5)
    centres = np.stack([x.ravel(), y.ravel()], axis=-1)
    squares = levels_at(level, board_map(centres[:, None] + _WITHIN))
    odd = (np.floor(x) + np.floor(y)).ravel() % 2 == 1
    spread, high = squares.std(axis=1), squares.max(axis=1)
    light, dark = (odd, ~odd) if np.nanmedian(high[odd]) > np.nanmedian(high[~odd]) else (~odd, odd)
    step = np.nanmedian(high[light]) - np.nanmedian(high[dark])
    return bool(np.nanmedian(spread[light]) > max(0.2 * step, 3 * np.nanmedian(spread[dark])))
