"""Asymmetric circles: spots by OpenCV (`SimpleBlobDetector`), a fit to each circle, and its true centre.

A circle appears as an ellipse. Under perspective and through a lens, the ellipse's centre is not the image of the
circle's centre. The map from board to image, fitted to all centres, gives the difference: it maps the outline of each
circle into the image, an ellipse is fitted to it, and the offset of the ellipse's centre from the mapped centre is
subtracted from the measured point. The map is then fitted again, a fixed number of times. The radius of the printed
circles is estimated too.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardView
from slrig.calibration.detection.corners import (
    SIGMA_FLOOR_PX,
    BoardMap,
    GreyImage,
    PointFit,
    fit_board_map,
    fit_circles,
    patch_offsets,
)
from slrig.calibration.detection.diagnosis import (
    MIRROR_REMEDY,
    explain_other_board,
    explain_partial_board,
    require_most_corners,
)
from slrig.calibration.detection.lattice import (
    Blobs,
    Lattice,
    build_circle_lattice,
    detect_dark_blobs,
    has_half_turn_symmetry,
    is_circle_lattice,
    make_right_handed,
    orient_x_right,
)
from slrig.errors import PoseRefusedError, setting
from slrig.model import FloatArray

_CENTRE_ITERATIONS = 3
_RING_PX, _RING_BLURS = 4.0, 3.2
_OUTLINE_POINTS = 48
_MIN_RADIUS_PX = 4.0
_MAX_SPOT_RATIO = 2


def find_circles(grey: GreyImage, board: Board) -> BoardView:
    """Find asymmetric circles in an image. See `slrig.calibration.detection.detection.find_board`."""
    blobs = detect_dark_blobs(grey.image_8bit, expected_count=board.corner_count)
    lattice = build_circle_lattice(blobs.points_px)
    if lattice is not None and not is_circle_lattice(grey.level, lattice):
        lattice = None
    rough_px = None if lattice is None else _order_circles(lattice, board)
    if lattice is None or rough_px is None:
        raise PoseRefusedError(_explain_circles(grey, board, blobs, lattice))
    view = refine_circles(grey.level, board, rough_px, blobs)
    return require_most_corners(grey, board, view, "circles")


def refine_circles(level: FloatArray, board: Board, rough_px: FloatArray, blobs: Blobs) -> BoardView | None:
    """Refine every circle's centre from rough ones, (n, 2) px, of the whole board in its order. None if it fails."""
    positions = board.points_mm[:, :2] / board.square_mm
    board_map = fit_board_map(positions, rough_px)
    if board_map is None:
        return None
    radius = _initial_radius(board_map, positions, rough_px, blobs)
    fit, radius = _fit_ellipses(level, board_map, positions, rough_px, radius)
    valid = fit.is_valid
    centres_px = fit.points_px.copy()
    for _ in range(_CENTRE_ITERATIONS):
        board_map = fit_board_map(positions[valid], centres_px[valid])
        if board_map is None:
            return None
        centres_px = fit.points_px - _ellipse_shift(board_map, positions, radius)
        distance = np.linalg.norm(centres_px - board_map(positions), axis=1)
        valid &= distance < max(1.5, 5 * float(np.median(distance[valid])))
    corner = np.flatnonzero(valid).astype(np.int32)
    return BoardView(corner, centres_px[valid], np.hypot(fit.sigma_px[valid], SIGMA_FLOOR_PX))


def refine_circles_view(grey: GreyImage, board: Board, view: BoardView) -> BoardView:
    """Refine the circles of a view in another image. See `slrig.calibration.detection.detection.refine_view`."""
    positions = board.points_mm[:, :2] / board.square_mm
    board_map = fit_board_map(positions[view.corner], view.points_px)
    found = None
    if board_map is not None:
        blobs = detect_dark_blobs(grey.image_8bit, expected_count=board.corner_count)
        found = refine_circles(grey.level, board, board_map(positions), blobs)
    return BoardView.empty() if found is None else found


def circle_blur_px(level: FloatArray, view: BoardView, board: Board) -> FloatArray:
    """(n,) float64: standard deviation of the blur of each circle's outline."""
    positions = board.points_mm[view.corner, :2] / board.square_mm
    board_map = fit_board_map(positions, view.points_px)
    if board_map is None:
        return np.full(len(view.corner), np.nan)
    image_8bit = np.clip(255 * level / max(float(np.percentile(level, 99.9)), 1e-9), 0, 255).astype(np.uint8)
    blobs = detect_dark_blobs(image_8bit, expected_count=board.corner_count)
    radius = _initial_radius(board_map, positions, view.points_px, blobs)
    fit, _ = _fit_ellipses(level, board_map, positions, view.points_px, radius)
    return np.where(np.isfinite(fit.sigma_px), fit.blur_px, np.nan)


def _order_circles(lattice: Lattice, board: Board) -> FloatArray | None:
    """(n, 2) float64: the centres in the order of the board; None where the lattice is another board.

    Raises PoseRefusedError where left and right are swapped.
    """
    points_px = _match_board(lattice, board, mirrored=False)
    if points_px is None:
        points_px = _find_with_opencv(lattice, board)
    if points_px is None and _match_board(lattice, board, mirrored=True) is not None:
        message = f"a mirrored print: this {board.title} is in view with left and right swapped: {MIRROR_REMEDY}"
        raise PoseRefusedError(message)
    return None if points_px is None else orient_x_right(points_px, board)


def _match_board(lattice: Lattice, board: Board, *, mirrored: bool) -> FloatArray | None:
    """(n, 2) float64: the lattice's points in the board's order, if it is the whole board and nothing else."""
    across, down = (np.round(board.points_mm[:, :2] / board.square_mm)).astype(int).T
    board_index = {place: index for index, place in enumerate(zip(across.tolist(), down.tolist(), strict=True))}
    if len(lattice.positions) != len(board_index):
        return None
    positions: Any = lattice.positions * [-1, 1] if mirrored else lattice.positions
    for _ in range(4):
        positions = np.column_stack([-positions[:, 1], positions[:, 0]])
        order = [board_index.get((x, y), -1) for x, y in (positions - positions.min(axis=0)).tolist()]
        if min(order) >= 0:
            points_px = np.zeros((len(board_index), 2))
            points_px[order] = lattice.points_px
            return points_px
    return None


def _find_with_opencv(lattice: Lattice, board: Board) -> FloatArray | None:
    """(n, 2) float64: the same by `findCirclesGrid`, which can leave out other spots.

    Only for few spots: among thousands OpenCV takes minutes.
    """
    if not board.corner_count < len(lattice.points_px) <= _MAX_SPOT_RATIO * board.corner_count:
        return None
    candidates: Any = lattice.points_px.astype(np.float32).reshape(-1, 1, 2)
    parameters = cv2.CirclesGridFinderParameters()
    flags = cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    found, centres = cv2.findCirclesGrid(candidates, (board.columns, board.rows), flags, None, parameters)
    if not found:
        return None
    grid = np.asarray(centres, dtype=np.float64).reshape(board.rows, board.columns, 2)
    if make_right_handed(grid) is not grid and has_half_turn_symmetry(board):
        return None
    # With an odd number of rows the print is its own mirror image with the rows in reverse order.
    return make_right_handed(grid).reshape(-1, 2)


def _initial_radius(board_map: BoardMap, positions: FloatArray, points_px: FloatArray, blobs: Blobs) -> float:
    """Radius of the circles over `square_mm`, from the nearest spots."""
    scale = np.sqrt(np.abs(np.linalg.det(board_map.jacobian(positions, step=0.05))))
    if not len(blobs.points_px):
        return 0.5
    distance = np.linalg.norm(blobs.points_px[None] - points_px[:, None], axis=2)
    radius = blobs.radius_px[distance.argmin(axis=1)] / scale
    return float(np.clip(np.median(radius[distance.min(axis=1) < 0.3 * scale] if len(radius) else 0.5), 0.1, 0.7))


def _fit_ellipses(
    level: FloatArray, board_map: BoardMap, positions: FloatArray, rough_px: FloatArray, radius: float
) -> tuple[PointFit, float]:
    """Fit the ellipse of each circle. Returns the fit and the circles' radius over `square_mm`."""
    slope = board_map.jacobian(positions, step=0.05)
    ring_px = _RING_PX
    while True:
        left, sizes, _ = np.linalg.svd(slope * radius)
        shape = np.einsum("nij,nj,nkj->nik", left, 1 / sizes, left)
        half_px = int(np.clip(np.ceil(sizes[:, 0].max() + ring_px), 4, 90))
        offsets = patch_offsets(half_px) + (np.round(rough_px) - rough_px)[:, None]
        relative_radius = np.linalg.norm(np.einsum("nij,nmj->nmi", shape, offsets), axis=-1)
        outline_distance = np.abs(relative_radius - 1) * sizes.min(axis=1)[:, None]
        # Half way to the nearest other circle, at a diagonal of `square_mm`.
        usable = (relative_radius * radius < 0.95 * np.sqrt(0.5)) & (outline_distance < ring_px)
        fit, shapes = fit_circles(level, rough_px, shape, usable, half_px=half_px)
        valid = fit.is_valid
        if not valid.any():
            return fit, radius
        area = np.abs(np.linalg.det(shapes)) * np.abs(np.linalg.det(slope))
        radius = float(np.median(1 / np.sqrt(area[valid])))
        required_px = min(_RING_BLURS * float(np.median(fit.blur_px[valid])), float(np.median(sizes)))
        if ring_px > _RING_PX or required_px <= ring_px:
            return fit, radius
        ring_px = required_px


def _ellipse_shift(board_map: BoardMap, positions: FloatArray, radius: float) -> FloatArray:
    """(n, 2) float64, px: from the image of each circle's centre to the centre of its ellipse."""
    angle = np.arange(_OUTLINE_POINTS) * (2 * np.pi / _OUTLINE_POINTS)
    outline = positions[:, None] + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    mapped = board_map(positions)
    offset = board_map(outline) - mapped[:, None]
    scale = np.sqrt((offset**2).mean(axis=(1, 2)))[:, None]
    x, y = offset[..., 0] / scale, offset[..., 1] / scale
    # a x^2 + b x y + c y^2 + d x + e y = 1, with its centre where both derivatives vanish.
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    conic = np.matmul(np.linalg.pinv(design), np.ones((len(positions), _OUTLINE_POINTS, 1)))[..., 0]
    a, b, c, d, e = conic.T
    hessian = np.stack([np.stack([2 * a, b], axis=-1), np.stack([b, 2 * c], axis=-1)], axis=-2)
    centre = np.linalg.solve(hessian, -np.stack([d, e], axis=-1)[..., None])[..., 0]
    return np.asarray(centre * scale)


def _explain_other_circles(board: Board, lattice: Lattice) -> str:
    """Describe the difference between the circles in view and the board, and what to do."""
    found, expected = sorted((lattice.columns, lattice.rows)), sorted((2 * board.columns, board.rows))
    if found == sorted((2 * board.rows, board.columns)):
        return (
            f"another board: expected circles in {board.rows} rows of {board.columns}, found {board.columns} rows of "
            f"{board.rows}: swap them, {setting('corners')} {board.rows}x{board.columns} (circles in a row, then rows)"
        )
    return (
        f"another board: expected circles in {board.rows} rows of {board.columns} ({expected[1]} by {expected[0]} half "
        f"distances), found a grid of {found[1]} by {found[0]} half distances: use the other board, give the circles "
        f"of this one as {setting('corners')} (circles in a row, then rows), or remove what covers a part of it"
    )


def _explain_circles(grey: GreyImage, board: Board, blobs: Blobs, lattice: Lattice | None) -> str:
    """Describe why these circles are not found, and what to do."""
    other_board = explain_other_board(grey, board)
    if other_board or lattice is None:
        return other_board or f"no {board.title} found: {grey.likely_cause()}"
    clipped_sides = lattice.clipped_sides(grey.level.shape)
    complete_count = (lattice.columns * lattice.rows + 1) // 2
    extent = {lattice.columns, lattice.rows}
    if not lattice.may_be_part_of(board) or (
        extent != {2 * board.columns, board.rows} and len(lattice.positions) >= complete_count - 1 and not clipped_sides
    ):
        return _explain_other_circles(board, lattice)
    part = f"{len(lattice.positions)} of {board.corner_count} circles"
    radius = float(np.median(blobs.radius_px))
    if radius < _MIN_RADIUS_PX and not clipped_sides:
        return (
            f"{board.title}: only {part} are found, {2 * radius:.0f} pixels wide: bring the board closer, until they "
            f"are {2 * _MIN_RADIUS_PX:.0f} pixels wide or more"
        )
    return explain_partial_board(part, clipped_sides)
