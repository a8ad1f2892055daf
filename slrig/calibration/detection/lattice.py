"""Grid of corners in view: its extent, where the image cuts it, and which corner is number 0.

- A ChArUco board has one numbering: its markers say which.
- A chessboard whose columns and rows of corners add up to an odd number (11 x 8) has one: the square up and left of
  corner 0 is dark. If they add up to an even number (7 x 9), it looks the same after half a turn; with as many columns
  as rows, and an even number of both, after every quarter turn.
- Asymmetric circles have one numbering with an odd number of rows (4 x 11); with an even number they look the same
  after half a turn.

A mirrored chessboard is a chessboard, and mirrored circles with an odd number of rows are such circles: every corner
has its place by the same numbers, and nothing goes wrong. Mirrored circles with an even number of rows, and a mirrored
ChArUco board, are other boards and are refused.

Where a print looks the same from two sides, an image alone cannot tell them apart. Poses of one camera do no harm by
that: the board's own place is solved anew in each. Two cameras and a projector that see one pose must agree, though:
the solve tries both ends of a view of every camera but the first and keeps what fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.corners import BoardMap, Grey, PlacedCorners, fitted_map, placed_corners
from slrig.model import FloatArray, IntArray

_MARGIN = 1.3
"""Where to look for the paper about a chessboard, in squares from its outermost corners."""
_LIGHT, _DARK = 0.7, 0.2
"""Grey levels of lit paper, at least, and of what no light falls on, at most, between dark and light squares."""
_BEYOND = 1.8
"""A grid is cut off where the squares about its next corner would not all lie in the image."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """A grid in view. columns, rows : its extent, of circles in steps of half their distance within a row;
    points_px : (n, 2) float64; places : (n, 2) int, the column and row of each.
    """

    columns: int
    rows: int
    points_px: FloatArray
    places: IntArray

    def fits_in(self, board: Board) -> bool:
        """Whether it may be a part of the board, in either direction."""
        wanted = (2 * board.columns if board.kind is BoardKind.CIRCLES else board.columns, board.rows)
        seen = (self.columns, self.rows)
        return any(a <= wanted[0] and b <= wanted[1] for a, b in (seen, seen[::-1]))

    def board_map(self) -> BoardMap | None:
        """The map of places into the image; None where the points determine none."""
        return fitted_map(self.places.astype(np.float64), self.points_px)

    def complete(self, level: FloatArray) -> bool:
        """Whether a chessboard ends on all four sides: beyond its outermost squares lies paper as light as its light
        squares. False where it cannot be told.
        """
        return all(float((side > _LIGHT).mean()) > 0.85 for side in self._beyond(level))

    def dark_beyond(self, level: FloatArray) -> bool:
        """Whether next to no light falls beyond one of a chessboard's sides. Of more squares half would be dark."""
        return any(float((side < _DARK).mean()) > 0.6 for side in self._beyond(level))

    def _beyond(self, level: FloatArray) -> list[FloatArray]:
        """(n,) float64 for each of the four sides: grey levels beyond the outermost squares of a chessboard, 0 as its
        dark squares and 1 as its light ones; NaN outside the image, and for all where it cannot be told.
        """
        board_map = self.board_map()
        if board_map is None:
            return [np.full(1, np.nan)]
        inside = _line(np.arange(self.columns - 1) + 0.5, np.arange(self.rows - 1) + 0.5)
        low, high = np.nanpercentile(levels_at(level, board_map(inside)), [10, 90])
        x, y = np.arange(self.columns + 1) - 0.5, np.arange(self.rows + 1) - 0.5
        last = np.array([self.columns - 1, self.rows - 1])
        lines = _around(np.zeros(2) - _MARGIN, last + _MARGIN, x, y)
        return [(levels_at(level, board_map(line)) - low) / max(high - low, 1e-9) for line in lines]

    def cut_sides(self, shape: tuple[int, ...]) -> list[str]:
        """The sides of the image of this shape (H, W) beyond which the grid would go on: left, right, upper, lower."""
        board_map = self.board_map()
        if board_map is None:
            return []
        least, most = self.places.min(axis=0), self.places.max(axis=0)
        x, y = np.arange(least[0], most[0] + 1.0), np.arange(least[1], most[1] + 1.0)
        height, width = shape[:2]
        sides = []
        for line in _around(least - _BEYOND, most + _BEYOND, x, y):
            beyond_x, beyond_y = board_map(line).T
            outside = {
                "left": beyond_x < 0, "right": beyond_x > width - 1,
                "upper": beyond_y < 0, "lower": beyond_y > height - 1,
            }  # fmt: skip
            side = max(outside, key=lambda name: float(outside[name].mean()))
            if outside[side].mean() > 0.5 and side not in sides:
                sides.append(side)
        return sides


def _around(least: FloatArray, most: FloatArray, x: NDArray[Any], y: NDArray[Any]) -> list[FloatArray]:
    """Four lines of places (n, 2): at the least and the greatest x, then at the least and the greatest y."""
    ends = np.stack([least, most])
    return [_line(at, y) for at in ends[:, :1]] + [_line(x, at) for at in ends[:, 1:]]


def _line(x: NDArray[Any], y: NDArray[Any]) -> FloatArray:
    """(n, 2) float64: every x with every y."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)


def right_handed(grid: FloatArray) -> FloatArray:
    """A grid of points (rows, columns, 2) with x turning to y clockwise, as on a print that is looked at: its rows in
    the other order if they did not.
    """
    across, down = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    return grid[::-1] if across[0] * down[1] - across[1] * down[0] < 0 else grid


def levels_at(level: FloatArray, places_px: FloatArray) -> FloatArray:
    """(...) float64: grey levels at places (..., 2) by the nearest pixel, NaN outside the image."""
    x, y = np.round(places_px[..., 0]), np.round(places_px[..., 1])
    height, width = level.shape
    inside: NDArray[np.bool_] = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    found = level[np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)]
    return np.asarray(np.where(inside, found, np.nan))


def beside(corner: IntArray, columns: int, rows: int) -> IntArray:
    """Numbers of the corners that are the neighbours of these on a board, diagonal ones too, and not among them."""
    known = np.zeros((rows, columns), dtype=np.uint8)
    known.ravel()[corner] = 1
    near = np.asarray(cv2.dilate(known, np.ones((3, 3), dtype=np.uint8)))
    return np.flatnonzero((near > known).ravel()).astype(np.int32)


def half_turn_looks_same(board: Board) -> bool:
    """Whether half a turn of the print changes nothing that can be seen."""
    if board.kind is BoardKind.CHESSBOARD:
        return (board.columns + board.rows) % 2 == 0
    return board.kind is BoardKind.CIRCLES and board.rows % 2 == 0


def turned_half(view: BoardView, board: Board) -> BoardView:
    """The same corners numbered from the other end of the print: number k becomes n - 1 - k.

    This turns the board's frame by half about the middle of its corners: what was at (x, y) in it is then at
    (X - x, Y - y), X and Y the greatest coordinates of any corner. Light on the board has no numbers.

    Raises ValueError where half a turn of this board can be seen.
    """
    if not half_turn_looks_same(board):
        message = f"{board.title} looks different after half a turn: it has one numbering"
        raise ValueError(message)
    return _renumbered(view, board.corner_count - 1 - view.corner)


def equivalent_views(view: BoardView, board: Board) -> tuple[BoardView, ...]:
    """Every numbering that the image allows, the given one first: 1, 2 or 4."""
    views = [view]
    if half_turn_looks_same(board):
        views.append(turned_half(view, board))
    if board.kind is BoardKind.CHESSBOARD and board.columns == board.rows and board.columns % 2 == 0:
        row, column = np.divmod(view.corner, board.columns)
        quarter = _renumbered(view, column * board.columns + (board.rows - 1 - row))
        views += [quarter, turned_half(quarter, board)]
    return tuple(views)


def pointing_right(points_px: FloatArray, board: Board) -> FloatArray:
    """All corners of a print that looks the same from several sides, (n, 2), in the order in which x points most to the
    right in the image.
    """
    everything = np.arange(board.corner_count, dtype=np.int32)
    whole = BoardView(everything, points_px, np.zeros(len(points_px)))
    views = equivalent_views(whole, board)
    across = [_towards(view.points_px, board) for view in views]
    best = max(range(len(views)), key=lambda index: (round(float(across[index][0]), 9), float(across[index][1])))
    return views[best].points_px


def _towards(points_px: FloatArray, board: Board) -> FloatArray:
    """(2,) float64: direction of the board's x axis in the image, of length 1."""
    grid = points_px.reshape(board.rows, board.columns, 2)
    towards = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    return np.asarray(towards / max(float(np.hypot(*towards)), 1e-12))


def _renumbered(view: BoardView, corner: IntArray) -> BoardView:
    order = np.argsort(corner)
    return BoardView(corner[order].astype(np.int32), view.points_px[order], view.sigma_px[order], view.light_first)


_LEAST_AREA_PX = 25.0
_FEWEST_IN_LATTICE = 9
_MOST = 5000
_SEEDS = 12
_CLEAR, _HALF = 0.85, 0.6
"""Least share of the places that must be as they are between circles; a corner of a square may be light by its blur."""
_STRAY = 0.3
"""How far a spot may lie from where its neighbours say, in steps of the lattice."""


@dataclass(frozen=True, slots=True)
class Blobs:
    """Spots: points_px (n, 2) float64, radius_px (n,) float64."""

    points_px: FloatArray
    radius_px: FloatArray


def dark_blobs(image: NDArray[np.uint8], *, most: int) -> Blobs:
    """Dark spots that a circle may look like, tilted up to some 70 degrees, each at most 1 / `most` of the image."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 30, 230, 20
    settings.minRepeatability = 2
    settings.minDistBetweenBlobs = 4
    settings.filterByColor, settings.blobColor = True, 0
    settings.filterByArea, settings.minArea = True, _LEAST_AREA_PX
    settings.maxArea = image.size / max(most, 1)
    settings.filterByCircularity, settings.minCircularity = True, 0.4
    settings.filterByConvexity, settings.minConvexity = True, 0.85
    settings.filterByInertia, settings.minInertiaRatio = True, 0.08
    spots = cv2.SimpleBlobDetector.create(settings).detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    spots = sorted(spots, key=lambda spot: -spot.size)[:_MOST]
    points = np.array([spot.pt for spot in spots], dtype=np.float64).reshape(-1, 2)
    return Blobs(points, np.array([spot.size / 2 for spot in spots], dtype=np.float64))


def circle_lattice(grey: Grey) -> Lattice | None:
    """The largest lattice of asymmetric circles in view, whatever its size. None where there is none."""
    lattice = lattice_of(dark_blobs(grey.eight, most=_FEWEST_IN_LATTICE).points_px)
    return lattice if lattice is not None and of_circles(grey.level, lattice) else None


def of_circles(level: FloatArray, lattice: Lattice) -> bool:
    """Whether the spots of a lattice are circles between which it is light. Dark squares of a chessboard stand in the
    same lattice and are dark in their corners, too; spots of noise are not light between.
    """
    board_map = lattice.board_map()
    if board_map is None:
        return False
    centres = _about(level, board_map, lattice, np.zeros((1, 2)))
    gaps = _about(level, board_map, lattice, np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]))
    tips = _about(level, board_map, lattice, np.array([(0.45, 0.45), (0.45, -0.45), (-0.45, 0.45), (-0.45, -0.45)]))
    halfway = (np.median(centres) + np.median(gaps)) / 2
    return bool(
        np.mean(centres < halfway) > _CLEAR and np.mean(gaps > halfway) > _CLEAR and np.mean(tips > halfway) > _HALF
    )


def _about(level: FloatArray, board_map: BoardMap, lattice: Lattice, offsets: FloatArray) -> FloatArray:
    """(n,) float64: grey levels at these offsets from every spot, those outside the image left out."""
    found = levels_at(level, board_map(lattice.places[:, None] + offsets).reshape(-1, 2))
    return found[np.isfinite(found)]


def lattice_of(points_px: FloatArray) -> Lattice | None:
    """The largest lattice of asymmetric circles that points form. None where there is none.

    The steps between neighbours are taken as (1, -1) and (1, 1), right-handed, as circles in rows that are shifted by
    half a distance stand; which of the two directions are rows is not known.
    """
    index, steps = neighbours_in_steps(points_px)
    if len(index) < _FEWEST_IN_LATTICE:
        return None
    places = np.column_stack([steps.sum(axis=1), steps[:, 1] - steps[:, 0]])
    places -= places.min(axis=0)
    columns, rows = (int(extent) + 1 for extent in places.max(axis=0))
    if min(columns, rows) < 3:
        return None
    return Lattice(columns, rows, points_px[index], places.astype(np.int32))


def neighbours_in_steps(points_px: FloatArray) -> tuple[NDArray[np.int64], IntArray]:
    """The largest set of points of which each is a neighbour of another in one of two directions.

    Returns their indices, (m,) int64, and how many steps along the two directions, right-handed, each lies from the
    first, (m, 2) int32. Both are empty where there is none.
    """
    best: dict[int, tuple[int, int]] = {}
    if len(points_px) >= _FEWEST_IN_LATTICE:
        tree = KDTree(points_px)
        near = np.asarray(tree.query(points_px, k=5)[1], dtype=np.int64)
        middle = np.median(points_px, axis=0)
        for seed in np.argsort(np.linalg.norm(points_px - middle, axis=1))[:_SEEDS]:
            if int(seed) in best:
                continue
            places = _grown(points_px, tree, int(seed), near[seed, 1:])
            if len(places) > len(best):
                best = places
    steps = np.array(list(best.values()), dtype=np.int32).reshape(-1, 2)
    return np.array(list(best), dtype=np.int64), steps


def _grown(points: FloatArray, tree: KDTree, seed: int, near: NDArray[np.int64]) -> dict[int, tuple[int, int]]:
    """From a seed outwards: each point's steps along the two directions. Steps follow those of the point come from."""
    first = points[near[0]] - points[seed]
    length = float(np.hypot(*first))
    second = None
    for other in near[1:]:
        step = points[other] - points[seed]
        sine = (first[0] * step[1] - first[1] * step[0]) / max(length * float(np.hypot(*step)), 1e-9)
        if abs(sine) > 0.5:
            first, second = (first, step) if sine > 0 else (step, first)
            break
    if second is None:
        return {}
    places = {seed: (0, 0)}
    queue = [(seed, first, second)]
    taken = {(0, 0)}
    while queue:
        index, one, two = queue.pop(0)
        a, b = places[index]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = sign * (one, two)[axis]
            where = (a + sign, b) if axis == 0 else (a, b + sign)
            distance, found = tree.query(points[index] + step)
            if where in taken or int(found) in places or distance > _STRAY * float(np.hypot(*step)):
                continue
            places[int(found)] = where
            taken.add(where)
            now = sign * (points[found] - points[index])
            queue.append((int(found), now, two) if axis == 0 else (int(found), one, now))
    return places


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
