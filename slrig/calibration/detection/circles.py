"""Asymmetric circles: the spots by OpenCV (`SimpleBlobDetector`), each circle by a fit, and its true centre.

A circle is seen as an ellipse, and the ellipse's centre is not where the circle's centre is seen: under perspective it
lies farther away from the camera, and a lens moves it too. The map from the board to the image, fitted to all centres,
says by how much: it takes the outline of each circle into the image, an ellipse is fitted to that, and the distance of
the ellipse's centre from the mapped centre is taken off what was measured. The map was fitted to shifted centres, so
this is done again until nothing changes. The printed circles' radius is measured in passing.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardView
from slrig.calibration.detection.corners import (
    FLOOR_PX,
    WORST_SIGMA_PX,
    BoardMap,
    FittedPlaces,
    Grey,
    fitted_circles,
    fitted_map,
    patch_offsets,
)
from slrig.calibration.detection.diagnosis import UNMIRRORED, half_words, other_words, unclear_words
from slrig.calibration.detection.lattice import (
    Blobs,
    Lattice,
    dark_blobs,
    half_turn_looks_same,
    lattice_of,
    of_circles,
    pointing_right,
    right_handed,
)
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray

_TURNS = 3
_RING_PX, _RING_BLURS = 4.0, 3.2
_OUTLINE = 48
_LEAST_FOUND = 0.8
_SMALL_PX = 4.0
_MOST_SPOTS = 2


def circles_view(grey: Grey, board: Board) -> BoardView:
    """See `slrig.calibration.detection.detection.find_board`."""
    blobs = dark_blobs(grey.eight, most=board.corner_count)
    lattice = lattice_of(blobs.points_px)
    if lattice is not None and not of_circles(grey.level, lattice):
        lattice = None
    rough_px = None if lattice is None else _grid(lattice, board)
    if lattice is None or rough_px is None:
        raise PoseRefusedError(_cause(grey, board, blobs, lattice))
    view = placed_circles(grey.level, board, rough_px, blobs)
    found = 0 if view is None else len(view.corner)
    if view is None or found < _LEAST_FOUND * board.corner_count:
        raise PoseRefusedError(unclear_words(grey, board, found, "circles"))
    return view


def placed_circles(level: FloatArray, board: Board, rough_px: FloatArray, blobs: Blobs) -> BoardView | None:
    """Every circle's true centre from rough ones, (n, 2) px, all of the board's and in its order. None if it fails."""
    places = board.points_mm[:, :2] / board.square_mm
    board_map = fitted_map(places, rough_px)
    if board_map is None:
        return None
    radius = _first_radius(board_map, places, rough_px, blobs)
    fit, radius = _ellipses(level, board_map, places, rough_px, radius)
    good = np.isfinite(fit.sigma_px) & (fit.sigma_px < WORST_SIGMA_PX)
    centres_px = fit.points_px.copy()
    for _ in range(_TURNS):
        board_map = fitted_map(places[good], centres_px[good])
        if board_map is None:
            return None
        centres_px = fit.points_px - _ellipse_shift(board_map, places, radius)
        aside = np.linalg.norm(centres_px - board_map(places), axis=1)
        good &= aside < max(1.5, 5 * float(np.median(aside[good])))
    corner = np.flatnonzero(good).astype(np.int32)
    return BoardView(corner, centres_px[good], np.hypot(fit.sigma_px[good], FLOOR_PX))


def circles_again(grey: Grey, board: Board, view: BoardView) -> BoardView:
    """See `slrig.calibration.detection.detection.placed_again`."""
    places = board.points_mm[:, :2] / board.square_mm
    board_map = fitted_map(places[view.corner], view.points_px)
    found = None
    if board_map is not None:
        blobs = dark_blobs(grey.eight, most=board.corner_count)
        found = placed_circles(grey.level, board, board_map(places), blobs)
    return BoardView(np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0)) if found is None else found


def circle_blur_px(level: FloatArray, view: BoardView, board: Board) -> FloatArray:
    """(n,) float64: standard deviation of the blur of each circle's outline."""
    places = board.points_mm[view.corner, :2] / board.square_mm
    board_map = fitted_map(places, view.points_px)
    if board_map is None:
        return np.full(len(view.corner), np.nan)
    eight = np.clip(255 * level / max(float(np.percentile(level, 99.9)), 1e-9), 0, 255).astype(np.uint8)
    radius = _first_radius(board_map, places, view.points_px, dark_blobs(eight, most=board.corner_count))
    fit, _ = _ellipses(level, board_map, places, view.points_px, radius)
    return np.where(np.isfinite(fit.sigma_px), fit.blur_px, np.nan)


def _grid(lattice: Lattice, board: Board) -> FloatArray | None:
    """(n, 2) float64: the centres in the board's own order; None where the lattice is no such board.

    Raises PoseRefusedError where left and right are changed over.
    """
    points_px = _matched(lattice, board, mirrored=False)
    if points_px is None:
        points_px = _by_opencv(lattice, board)
    if points_px is None:
        if _matched(lattice, board, mirrored=True) is not None:
            message = f"a mirrored print: this {board.title} is in view, left and right changed over: {UNMIRRORED}"
            raise PoseRefusedError(message)
        return None
    return pointing_right(points_px, board)


def _matched(lattice: Lattice, board: Board, *, mirrored: bool) -> FloatArray | None:
    """(n, 2) float64: the lattice's points in the board's order, if it is the whole board and nothing else."""
    across, down = (np.round(board.points_mm[:, :2] / board.square_mm)).astype(int).T
    wanted = {place: index for index, place in enumerate(zip(across.tolist(), down.tolist(), strict=True))}
    if len(lattice.places) != len(wanted):
        return None
    places: Any = lattice.places * [-1, 1] if mirrored else lattice.places
    for _ in range(4):
        places = np.column_stack([-places[:, 1], places[:, 0]])
        order = [wanted.get((x, y), -1) for x, y in (places - places.min(axis=0)).tolist()]
        if min(order) >= 0:
            points_px = np.zeros((len(wanted), 2))
            points_px[order] = lattice.points_px
            return points_px
    return None


def _by_opencv(lattice: Lattice, board: Board) -> FloatArray | None:
    """(n, 2) float64: the same by `findCirclesGrid`, which can leave out spots that are no circles of the board.

    It is given few enough spots that it ends soon: among thousands it takes minutes.
    """
    if not board.corner_count < len(lattice.points_px) <= _MOST_SPOTS * board.corner_count:
        return None
    candidates: Any = lattice.points_px.astype(np.float32).reshape(-1, 1, 2)
    parameters = cv2.CirclesGridFinderParameters()
    flags = cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    found, centres = cv2.findCirclesGrid(candidates, (board.columns, board.rows), flags, None, parameters)
    if not found:
        return None
    grid = np.asarray(centres, dtype=np.float64).reshape(board.rows, board.columns, 2)
    if right_handed(grid) is not grid and half_turn_looks_same(board):
        return None
    # With an odd number of rows the print is its own mirror image, the last row in the first one's place.
    return right_handed(grid).reshape(-1, 2)


def _first_radius(board_map: BoardMap, places: FloatArray, points_px: FloatArray, blobs: Blobs) -> float:
    """The circles' radius over `square_mm`, from the size of the spots nearest to them."""
    scale = np.sqrt(np.abs(np.linalg.det(board_map.jacobian(places, step=0.05))))
    if not len(blobs.points_px):
        return 0.5
    apart = np.linalg.norm(blobs.points_px[None] - points_px[:, None], axis=2)
    radius = blobs.radius_px[apart.argmin(axis=1)] / scale
    return float(np.clip(np.median(radius[apart.min(axis=1) < 0.3 * scale] if len(radius) else 0.5), 0.1, 0.7))


def _ellipses(
    level: FloatArray, board_map: BoardMap, places: FloatArray, rough_px: FloatArray, radius: float
) -> tuple[FittedPlaces, float]:
    """The ellipse of each circle, and the circles' radius over `square_mm` that they tell of."""
    slope = board_map.jacobian(places, step=0.05)
    ring_px = _RING_PX
    while True:
        left, sizes, _ = np.linalg.svd(slope * radius)
        shape = np.einsum("nij,nj,nkj->nik", left, 1 / sizes, left)
        half_px = int(np.clip(np.ceil(sizes[:, 0].max() + ring_px), 4, 90))
        offsets = patch_offsets(half_px) + (np.round(rough_px) - rough_px)[:, None]
        out = np.linalg.norm(np.einsum("nij,nmj->nmi", shape, offsets), axis=-1)
        from_outline = np.abs(out - 1) * sizes.min(axis=1)[:, None]
        # Half way to the nearest other circle, which stands a diagonal of `square_mm` away.
        usable = (out * radius < 0.95 * np.sqrt(0.5)) & (from_outline < ring_px)
        fit, shapes = fitted_circles(level, rough_px, shape, usable, half_px=half_px)
        good = np.isfinite(fit.sigma_px) & (fit.sigma_px < WORST_SIGMA_PX)
        if not good.any():
            return fit, radius
        area = np.abs(np.linalg.det(shapes)) * np.abs(np.linalg.det(slope))
        radius = float(np.median(1 / np.sqrt(area[good])))
        needed_px = min(_RING_BLURS * float(np.median(fit.blur_px[good])), float(np.median(sizes)))
        if ring_px > _RING_PX or needed_px <= ring_px:
            return fit, radius
        ring_px = needed_px


def _ellipse_shift(board_map: BoardMap, places: FloatArray, radius: float) -> FloatArray:
    """(n, 2) float64, px: from each circle's centre as it is seen to the centre of the ellipse that it is seen as."""
    angle = np.arange(_OUTLINE) * (2 * np.pi / _OUTLINE)
    outline = places[:, None] + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    seen = board_map(places)
    off = board_map(outline) - seen[:, None]
    scale = np.sqrt((off**2).mean(axis=(1, 2)))[:, None]
    x, y = off[..., 0] / scale, off[..., 1] / scale
    # a x^2 + b x y + c y^2 + d x + e y = 1; its centre is where both derivatives vanish.
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    conic = np.matmul(np.linalg.pinv(design), np.ones((len(places), _OUTLINE, 1)))[..., 0]
    a, b, c, d, e = conic.T
    bends = np.stack([np.stack([2 * a, b], axis=-1), np.stack([b, 2 * c], axis=-1)], axis=-2)
    centre = np.linalg.solve(bends, -np.stack([d, e], axis=-1)[..., None])[..., 0]
    return np.asarray(centre * scale)


def _another(board: Board, seen: Lattice) -> str:
    found, wanted = sorted((seen.columns, seen.rows)), sorted((2 * board.columns, board.rows))
    if found == sorted((2 * board.rows, board.columns)):
        return (
            f"another board: expected circles in {board.rows} rows of {board.columns}, found {board.columns} rows of "
            f"{board.rows}: turn them round, {setting('corners')} {board.rows}x{board.columns} (circles in a row, "
            "then rows)"
        )
    return (
        f"another board: expected circles in {board.rows} rows of {board.columns}, found a grid of circles over "
        f"{found[1]} by {found[0]} half distances where this one goes over {wanted[1]} by {wanted[0]}: take the other "
        f"board, or give its circles as {setting('corners')} (circles in a row, then rows), or take away what covers a "
        "part"
    )


def _cause(grey: Grey, board: Board, blobs: Blobs, seen: Lattice | None) -> str:
    """Why these circles are not found."""
    other = other_words(grey, board)
    if other or seen is None:
        return other or f"no {board.title} found: {grey.likely_cause()}"
    sides = seen.cut_sides(grey.level.shape)
    full = (seen.columns * seen.rows + 1) // 2
    extent = {seen.columns, seen.rows}
    if not seen.fits_in(board) or (
        extent != {2 * board.columns, board.rows} and len(seen.places) >= full - 1 and not sides
    ):
        return _another(board, seen)
    part = f"{len(seen.places)} of {board.corner_count} circles"
    radius = float(np.median(blobs.radius_px))
    if radius < _SMALL_PX and not sides:
        return (
            f"{board.title}: only {part} are found, and they are {2 * radius:.0f} pixels wide: bring the board closer, "
            f"{2 * _SMALL_PX:.0f} pixels are the least"
        )
    return half_words(part, sides)
