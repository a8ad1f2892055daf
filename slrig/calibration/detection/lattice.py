"""Grid of corners in view: its extent, the sides on which the image clips it, and its numbering.

- A ChArUco board has one numbering, given by its markers.
- A chessboard whose columns and rows of corners add up to an odd number (11 x 8) has one: the square up and left of
  corner 0 is dark. If the sum is even (7 x 9), it looks the same after half a turn; with equal and even columns and
  rows, after every quarter turn.
- Asymmetric circles with an odd number of rows (4 x 11) have one numbering; with an even number they look the same
  after half a turn.

A mirrored chessboard is a chessboard, and mirrored circles with an odd number of rows are such circles: their corners
keep their positions. Mirrored circles with an even number of rows and mirrored ChArUco boards are other boards and are
refused.

An image alone cannot resolve a symmetry of the print. Poses of one camera need no resolution, because each pose is
solved separately. Two cameras and a projector that observe one pose must agree: the solve tries both numberings of a
view of every camera but the first and keeps the better one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.corners import BoardMap, GreyImage, RefinedCorners, fit_board_map, refine_corners
from slrig.model import FloatArray, IntArray

_PAPER_DISTANCE = 1.3
"""Distance from the outermost corners of a chessboard at which paper is expected, in squares."""
_LIGHT_LEVEL, _DARK_LEVEL = 0.7, 0.2
"""Least level of lit paper and greatest level without light, on the scale from dark (0) to light squares (1)."""
_CLIP_DISTANCE = 1.8
"""A grid is clipped where the squares around its next corner would not all be in the image."""
_MIN_BLOB_AREA_PX = 25.0
_MIN_LATTICE_POINTS = 9
_MAX_BLOBS = 5000
_MAX_SEEDS = 12
_MIN_CLEAR_FRACTION, _MIN_LIGHT_TIP_FRACTION = 0.85, 0.6
"""Least fractions of positions with the grey level expected of circles; blur makes some tips of squares light."""
_MAX_STEP_DEVIATION = 0.3
"""Largest deviation of a spot from the position predicted by its neighbours, in steps of the lattice."""
_SEARCHES_PX = (640, 1280)
_SADDLE_BLUR_PX, _MIN_SADDLE_STRENGTH, _MAX_SADDLES = 1.5, 0.1, 1500
_SIDE = 60
_MIN_CORNERS = 9
_MAX_GROWTH_STEPS = 2 * _SIDE
_MIN_CROSSING_FRACTION = 0.4
"""Least fraction of the seed's corners that must be crossings."""
_VIRTUAL_BOARD = Board(BoardKind.CHESSBOARD, _SIDE, _SIDE, 1.0)
"""A board larger than any seed: corners in view get numbers of it, starting in its middle."""
_MIN_CROSSING_STRENGTH = 0.5
"""Least strength of a crossing over the median. Where three squares of four are light it is half or less."""
_SQUARE_CENTRES = np.array([(-0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (0.5, -0.5)])
_SQUARE_SAMPLES = np.array([(x, y) for x in (-0.22, 0.0, 0.22) for y in (-0.22, 0.0, 0.22)])
_SQUARE_TIPS = np.array([(-0.4, -0.4), (0.4, -0.4), (-0.4, 0.4), (0.4, 0.4)])


@dataclass(frozen=True, slots=True)
class Lattice:
    """A grid in view.

    columns, rows : its extent, of circles in steps of half their distance within a row; points_px : (n, 2) float64;
    positions : (n, 2) int32, column and row of each point.
    """

    columns: int
    rows: int
    points_px: FloatArray
    positions: IntArray

    @classmethod
    def from_positions(cls, points_px: FloatArray, positions: IntArray) -> Lattice | None:
        """Build from the column and row of each point, from any origin. None for fewer than three columns or rows."""
        positions = positions - positions.min(axis=0)
        columns, rows = (int(extent) + 1 for extent in positions.max(axis=0))
        return None if min(columns, rows) < 3 else cls(columns, rows, points_px, positions.astype(np.int32))

    @property
    def size_text(self) -> str:
        """Its columns and rows, the greater number first."""
        return f"{max(self.columns, self.rows)} x {min(self.columns, self.rows)}"

    def may_be_part_of(self, board: Board) -> bool:
        """True if it may be a part of the board, in either orientation."""
        board_extent = (2 * board.columns if board.kind is BoardKind.CIRCLES else board.columns, board.rows)
        extent = (self.columns, self.rows)
        return any(a <= board_extent[0] and b <= board_extent[1] for a, b in (extent, extent[::-1]))

    def board_map(self) -> BoardMap | None:
        """Map from positions to the image; None where the points do not determine one."""
        return fit_board_map(self.positions.astype(np.float64), self.points_px)

    def is_complete(self, level: FloatArray) -> bool:
        """True if a chessboard ends on all four sides: beyond it is paper as light as its light squares. False if
        unknown.
        """
        return all(float((side > _LIGHT_LEVEL).mean()) > 0.85 for side in self._levels_outside(level))

    def has_dark_side(self, level: FloatArray) -> bool:
        """True if almost no light falls beyond one side of a chessboard. If it went on, half would be light squares."""
        return any(float((side < _DARK_LEVEL).mean()) > 0.6 for side in self._levels_outside(level))

    def _levels_outside(self, level: FloatArray) -> list[FloatArray]:
        """(n,) float64 for each side: grey levels beyond the outermost squares of a chessboard, 0 as its dark squares
        and 1 as its light ones; NaN outside the image, and everywhere without a map.
        """
        board_map = self.board_map()
        if board_map is None:
            return [np.full(1, np.nan)]
        inside = _mesh_points(np.arange(self.columns - 1) + 0.5, np.arange(self.rows - 1) + 0.5)
        low, high = np.nanpercentile(sample_nearest(level, board_map(inside)), [10, 90])
        x, y = np.arange(self.columns + 1) - 0.5, np.arange(self.rows + 1) - 0.5
        last = np.array([self.columns - 1, self.rows - 1])
        lines = _border_lines(np.zeros(2) - _PAPER_DISTANCE, last + _PAPER_DISTANCE, x, y)
        return [(sample_nearest(level, board_map(line)) - low) / max(high - low, 1e-9) for line in lines]

    def clipped_sides(self, shape: tuple[int, ...]) -> list[str]:
        """Sides of an image of this shape (H, W) beyond which the grid would continue: left, right, upper, lower."""
        board_map = self.board_map()
        if board_map is None:
            return []
        first, last = self.positions.min(axis=0), self.positions.max(axis=0)
        x, y = np.arange(first[0], last[0] + 1.0), np.arange(first[1], last[1] + 1.0)
        height, width = shape[:2]
        sides = []
        for line in _border_lines(first - _CLIP_DISTANCE, last + _CLIP_DISTANCE, x, y):
            beyond_x, beyond_y = board_map(line).T
            outside = {
                "left": beyond_x < 0, "right": beyond_x > width - 1,
                "upper": beyond_y < 0, "lower": beyond_y > height - 1,
            }  # fmt: skip
            side = max(outside, key=lambda name: float(outside[name].mean()))
            if outside[side].mean() > 0.5 and side not in sides:
                sides.append(side)
        return sides


def _border_lines(first: FloatArray, last: FloatArray, x: NDArray[Any], y: NDArray[Any]) -> list[FloatArray]:
    """Four lines of positions (n, 2): at the least and the greatest x, then at the least and the greatest y."""
    ends = np.stack([first, last])
    return [_mesh_points(at, y) for at in ends[:, :1]] + [_mesh_points(x, at) for at in ends[:, 1:]]


def _mesh_points(x: NDArray[Any], y: NDArray[Any]) -> FloatArray:
    """(n, 2) float64: every x with every y."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)


def make_right_handed(grid: FloatArray) -> FloatArray:
    """Return a grid of points (rows, columns, 2) with its rows reversed unless x turns to y clockwise in the image."""
    across, down = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    return grid[::-1] if across[0] * down[1] - across[1] * down[0] < 0 else grid


def sample_nearest(level: FloatArray, positions_px: FloatArray) -> FloatArray:
    """(...) float64: grey levels at positions (..., 2) by the nearest pixel, NaN outside the image."""
    x, y = np.round(positions_px[..., 0]), np.round(positions_px[..., 1])
    height, width = level.shape
    inside: NDArray[np.bool_] = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    found = level[np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)]
    return np.asarray(np.where(inside, found, np.nan))


def neighbour_corners(corner: IntArray, columns: int, rows: int) -> IntArray:
    """Numbers of the neighbours of these corners on a board, diagonal ones included, without the corners themselves."""
    known = np.zeros((rows, columns), dtype=np.uint8)
    known.ravel()[corner] = 1
    near = np.asarray(cv2.dilate(known, np.ones((3, 3), dtype=np.uint8)))
    return np.flatnonzero((near > known).ravel()).astype(np.int32)


def has_half_turn_symmetry(board: Board) -> bool:
    """True if the print looks the same after half a turn."""
    if board.kind is BoardKind.CHESSBOARD:
        return (board.columns + board.rows) % 2 == 0
    return board.kind is BoardKind.CIRCLES and board.rows % 2 == 0


def rotate_half_turn(view: BoardView, board: Board) -> BoardView:
    """Number the corners from the other end of the print: number k becomes n - 1 - k.

    The board's frame turns about the centre of its corners: (x, y) becomes (X - x, Y - y), X and Y the greatest
    coordinates of any corner. Raises ValueError where the board has no such symmetry.
    """
    if not has_half_turn_symmetry(board):
        message = f"{board.title} looks different after half a turn: it has one numbering"
        raise ValueError(message)
    return _renumber(view, board.corner_count - 1 - view.corner)


def equivalent_numberings(view: BoardView, board: Board) -> tuple[BoardView, ...]:
    """All numberings that the image allows, the given one first: 1, 2 or 4."""
    views = [view]
    if has_half_turn_symmetry(board):
        views.append(rotate_half_turn(view, board))
    if board.kind is BoardKind.CHESSBOARD and board.columns == board.rows and board.columns % 2 == 0:
        row, column = np.divmod(view.corner, board.columns)
        quarter = _renumber(view, column * board.columns + (board.rows - 1 - row))
        views += [quarter, rotate_half_turn(quarter, board)]
    return tuple(views)


def orient_x_right(points_px: FloatArray, board: Board) -> FloatArray:
    """Order all corners of a print with symmetry, (n, 2), so that the x axis points most to the right in the image."""

    def x_direction(view: BoardView) -> tuple[float, float]:
        grid = view.points_px.reshape(board.rows, board.columns, 2)
        direction = (grid[:, -1] - grid[:, 0]).mean(axis=0)
        direction = direction / max(float(np.hypot(*direction)), 1e-12)
        return round(float(direction[0]), 9), float(direction[1])

    every_corner = np.arange(board.corner_count, dtype=np.int32)
    whole = BoardView(every_corner, points_px, np.zeros(len(points_px)))
    return max(equivalent_numberings(whole, board), key=x_direction).points_px


def _renumber(view: BoardView, corner: IntArray) -> BoardView:
    order = np.argsort(corner)
    return BoardView(corner[order].astype(np.int32), view.points_px[order], view.sigma_px[order], view.light_first)


@dataclass(frozen=True, slots=True)
class Blobs:
    """Spots: points_px (n, 2) float64, radius_px (n,) float64."""

    points_px: FloatArray
    radius_px: FloatArray


def detect_dark_blobs(image: NDArray[np.uint8], *, expected_count: int) -> Blobs:
    """Detect dark spots like circles tilted by up to 70 degrees, each at most 1 / `expected_count` of the image."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 30, 230, 20
    settings.minRepeatability = 2
    settings.minDistBetweenBlobs = 4
    settings.filterByColor, settings.blobColor = True, 0
    settings.filterByArea, settings.minArea = True, _MIN_BLOB_AREA_PX
    settings.maxArea = image.size / max(expected_count, 1)
    settings.filterByCircularity, settings.minCircularity = True, 0.4
    settings.filterByConvexity, settings.minConvexity = True, 0.85
    settings.filterByInertia, settings.minInertiaRatio = True, 0.08
    spots = cv2.SimpleBlobDetector.create(settings).detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    spots = sorted(spots, key=lambda spot: -spot.size)[:_MAX_BLOBS]
    points = np.array([spot.pt for spot in spots], dtype=np.float64).reshape(-1, 2)
    return Blobs(points, np.array([spot.size / 2 for spot in spots], dtype=np.float64))


def find_circle_lattice(grey: GreyImage) -> Lattice | None:
    """Find the largest lattice of asymmetric circles of any size. None where there is none."""
    lattice = build_circle_lattice(detect_dark_blobs(grey.image_8bit, expected_count=_MIN_LATTICE_POINTS).points_px)
    return lattice if lattice is not None and is_circle_lattice(grey.level, lattice) else None


def is_circle_lattice(level: FloatArray, lattice: Lattice) -> bool:
    """True if the spots of a lattice are circles with light between them.

    Dark squares of a chessboard form the same lattice and are dark in their corners too; between spots of noise it is
    not light.
    """
    board_map = lattice.board_map()
    if board_map is None:
        return False

    def levels_at(*offsets: tuple[float, float]) -> FloatArray:
        levels = sample_nearest(level, board_map(lattice.positions[:, None] + np.array(offsets)).reshape(-1, 2))
        return levels[np.isfinite(levels)]

    centres = levels_at((0.0, 0.0))
    gaps = levels_at((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
    tips = levels_at((0.45, 0.45), (0.45, -0.45), (-0.45, 0.45), (-0.45, -0.45))
    halfway = (np.median(centres) + np.median(gaps)) / 2
    return bool(
        np.mean(centres < halfway) > _MIN_CLEAR_FRACTION
        and np.mean(gaps > halfway) > _MIN_CLEAR_FRACTION
        and np.mean(tips > halfway) > _MIN_LIGHT_TIP_FRACTION
    )


def build_circle_lattice(points_px: FloatArray) -> Lattice | None:
    """Connect points to the largest lattice of asymmetric circles. None where there is none.

    Neighbours are at steps of (1, -1) and (1, 1), right-handed, as in rows shifted by half a distance; which of the two
    directions are the rows is not known.
    """
    index, steps = connect_neighbours(points_px)
    if len(index) < _MIN_LATTICE_POINTS:
        return None
    return Lattice.from_positions(points_px[index], np.column_stack([steps.sum(axis=1), steps[:, 1] - steps[:, 0]]))


def connect_neighbours(points_px: FloatArray) -> tuple[NDArray[np.int64], IntArray]:
    """Find the largest set of points of which each is a neighbour of another in one of two directions.

    Returns their indices, (m,) int64, and the number of steps along the two directions, right-handed, from the first
    point, (m, 2) int32; both may be empty.
    """
    best: dict[int, tuple[int, int]] = {}
    if len(points_px) >= _MIN_LATTICE_POINTS:
        tree = KDTree(points_px)
        near = np.asarray(tree.query(points_px, k=5)[1], dtype=np.int64)
        middle = np.median(points_px, axis=0)
        for seed in np.argsort(np.linalg.norm(points_px - middle, axis=1))[:_MAX_SEEDS]:
            if int(seed) in best:
                continue
            positions = _grow_from_seed(points_px, tree, int(seed), near[seed, 1:])
            if len(positions) > len(best):
                best = positions
    steps = np.array(list(best.values()), dtype=np.int32).reshape(-1, 2)
    return np.array(list(best), dtype=np.int64), steps


def _grow_from_seed(points: FloatArray, tree: KDTree, seed: int, near: NDArray[np.int64]) -> dict[int, tuple[int, int]]:
    """Number the points from a seed outwards by steps along two directions, each step predicted from the one before."""
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
    positions = {seed: (0, 0)}
    queue = [(seed, first, second)]
    occupied = {(0, 0)}
    while queue:
        index, one, two = queue.pop(0)
        a, b = positions[index]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = sign * (one, two)[axis]
            position = (a + sign, b) if axis == 0 else (a, b + sign)
            distance, found = tree.query(points[index] + step)
            is_far = distance > _MAX_STEP_DEVIATION * float(np.hypot(*step))
            if is_far or position in occupied or int(found) in positions:
                continue
            positions[int(found)] = position
            occupied.add(position)
            measured = sign * (points[found] - points[index])
            queue.append((int(found), measured, two) if axis == 0 else (int(found), one, measured))
    return positions


def find_chessboard_lattice(grey: GreyImage) -> Lattice | None:
    """Find the largest chessboard in view. None where there is none.

    Corners must be crossings of four alternating flat squares, which excludes gaps between circles, markers and noise.
    """
    for longest_px in _SEARCHES_PX:
        image, factor = grey.downscale(longest_px)
        saddles = _find_saddles(image)
        index, steps = connect_neighbours(saddles)
        if len(index) >= _MIN_CORNERS and (np.ptp(steps, axis=0) < _SIDE - 4).all():
            lattice = grow_chessboard(grey.level, (saddles[index] + 0.5) / factor - 0.5, steps)
            if lattice is not None:
                return lattice
        if factor == 1.0:
            break
    return None


def _find_saddles(image: NDArray[np.uint8]) -> FloatArray:
    """(n, 2) float64: the strongest saddle points, where the determinant of the second derivatives is most negative."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SADDLE_BLUR_PX)
    by_xx, by_yy = cv2.Sobel(smooth, cv2.CV_32F, 2, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    strength = cv2.Sobel(smooth, cv2.CV_32F, 1, 1) ** 2 - by_xx * by_yy
    highest = strength == cv2.dilate(strength, np.ones((7, 7), dtype=np.uint8))
    row, column = np.nonzero(highest & (strength > _MIN_SADDLE_STRENGTH * strength.max()))
    strongest = np.argsort(-strength[row, column])[:_MAX_SADDLES]
    return np.column_stack([column, row])[strongest].astype(np.float64)


def grow_chessboard(level: FloatArray, points_px: FloatArray, steps: IntArray) -> Lattice | None:
    """Grow the chessboard around a seed of corners, (n, 2) px, with column and row of each, (n, 2) int.

    Drops seed corners without a crossing. None where too few remain, or the squares are circles.
    """
    column, row = (steps - steps.min(axis=0) + (_SIDE - 1 - np.ptp(steps, axis=0)) // 2).T
    refined = refine_corners(level, _VIRTUAL_BOARD, row * _SIDE + column, points_px, keep_disturbed=True)
    for growth_step in range(_MAX_GROWTH_STEPS):
        if refined is None:
            return None
        corner, points = refined.view.corner, refined.view.points_px
        crossing = _crossing_steps(level, refined.board_map, corner)
        if not np.isfinite(crossing).all(axis=1).any():
            return None
        polarity = 1.0 if np.nanmedian(crossing.sum(axis=1)) > 0 else -1.0
        strength = (polarity * crossing).min(axis=1)
        median_strength = float(np.nanmedian(strength))
        is_crossing = strength > _MIN_CROSSING_STRENGTH * median_strength
        min_count = max(_MIN_CORNERS, 0 if growth_step else _MIN_CROSSING_FRACTION * len(points_px))
        if not median_strength > 0 or is_crossing.sum() < min_count:
            return None
        neighbours = neighbour_corners(corner[is_crossing], _SIDE, _SIDE)
        predicted = refined.board_map(_virtual_position(neighbours))
        strength = (polarity * _crossing_steps(level, refined.board_map, neighbours)).min(axis=1)
        is_new = strength > _MIN_CROSSING_STRENGTH * median_strength
        all_corners = np.concatenate([corner[is_crossing], neighbours[is_new]])
        rough_px = np.concatenate([points[is_crossing], predicted[is_new]])
        grown = refine_corners(level, _VIRTUAL_BOARD, all_corners, rough_px, keep_disturbed=True)
        if grown is None or set(grown.view.corner.tolist()) <= set(corner.tolist()):
            return _build_chessboard_lattice(level, grown)
        refined = grown
    return _build_chessboard_lattice(level, refined)


def _build_chessboard_lattice(level: FloatArray, refined: RefinedCorners | None) -> Lattice | None:
    if refined is None or _has_round_squares(level, refined.board_map, refined.view.corner):
        return None
    positions = _virtual_position(refined.view.corner).astype(np.int32)
    inside = _without_sparse_borders(positions)
    if inside.sum() < _MIN_CORNERS:
        return None
    return Lattice.from_positions(refined.view.points_px[inside], positions[inside])


def _without_sparse_borders(positions: IntArray) -> NDArray[np.bool_]:
    """(n,) bool: positions (n, 2) that remain after removing outermost lines that are less than half complete.

    Where the light ends on the paper next to the print, the outermost squares and lit and dark paper may alternate at
    one or two places of the print's outer edge. The extra line would shift all numbers by one square.
    """
    remaining = np.ones(len(positions), dtype=np.bool_)
    while remaining.any():
        first, last = positions[remaining].min(axis=0), positions[remaining].max(axis=0)
        lines = [remaining & (positions[:, axis] == end[axis]) for axis in (0, 1) for end in (first, last)]
        lengths = np.repeat((last - first + 1)[::-1], 2)
        sparse = [line for line, length in zip(lines, lengths, strict=True) if 2 * line.sum() < length]
        if not sparse:
            break
        remaining &= ~sparse[0]
    return remaining


def _virtual_position(corner: IntArray) -> FloatArray:
    row, column = np.divmod(corner, _SIDE)
    return np.column_stack([column, row]).astype(np.float64)


def _crossing_steps(level: FloatArray, board_map: BoardMap, corner: IntArray) -> FloatArray:
    """(n, 4) float64: the steps between the four squares around each corner, with the sign expected from the corner's
    number, less the variation within the squares. All have one sign at a crossing. NaN where a square is out of view.
    """
    centres = _virtual_position(corner)[:, None] + _SQUARE_CENTRES
    squares = sample_nearest(level, board_map(centres[:, :, None] + _SQUARE_SAMPLES))
    mean, spread = squares.mean(axis=-1), squares.std(axis=-1).mean(axis=-1)
    row, column = np.divmod(corner, _SIDE)
    sign = np.where((row + column) % 2 == 0, 1.0, -1.0)[:, None]
    steps = sign * np.stack([mean[:, i] - mean[:, j] for i in (0, 1) for j in (2, 3)], axis=1)
    return np.asarray(np.sign(steps) * np.maximum(np.abs(steps) - spread[:, None], 0))


def _has_round_squares(level: FloatArray, board_map: BoardMap, corner: IntArray) -> bool:
    """True if the dark squares are light at their tips, as circles are."""
    centres = _virtual_position(corner) + 0.5
    centre_levels = sample_nearest(level, board_map(centres))
    tips = sample_nearest(level, board_map(centres[:, None] + _SQUARE_TIPS)).mean(axis=1)
    valid = np.isfinite(centre_levels) & np.isfinite(tips)
    if valid.sum() < 4:
        return False
    threshold = (np.percentile(centre_levels[valid], 90) + np.percentile(centre_levels[valid], 10)) / 2
    dark = valid & (centre_levels < threshold)
    return bool(dark.any() and np.median(tips[dark]) > threshold)


def has_markers(level: FloatArray, lattice: Lattice) -> bool:
    """True if grey levels vary within the light squares far more than within the dark ones."""
    board_map = lattice.board_map()
    if board_map is None:
        return False
    x, y = np.meshgrid(np.arange(lattice.columns - 1) + 0.5, np.arange(lattice.rows - 1) + 0.5)
    centres = np.stack([x.ravel(), y.ravel()], axis=-1)
    squares = sample_nearest(level, board_map(centres[:, None] + _SQUARE_SAMPLES))
    odd = (np.floor(x) + np.floor(y)).ravel() % 2 == 1
    spread, high = squares.std(axis=1), squares.max(axis=1)
    light, dark = (odd, ~odd) if np.nanmedian(high[odd]) > np.nanmedian(high[~odd]) else (~odd, odd)
    step = np.nanmedian(high[light]) - np.nanmedian(high[dark])
    return bool(np.nanmedian(spread[light]) > max(0.2 * step, 3 * np.nanmedian(spread[dark])))
