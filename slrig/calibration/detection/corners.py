"""Subpixel corners and circles: a model of the blurred print fitted to the pixels around each one.

A corner is the intersection of two straight edges. With d1, d2 the distances of a pixel from the edges and s the blur,

    I = b + b' . r + (a + a' . r) erf(d1 / (sqrt(2) s)) erf(d2 / (sqrt(2) s)),    r = the pixel's offset from the start,

exact for a Gaussian blur and perpendicular edges. Edges at another angle change I by a term that is the same at r and
-r about the corner, so the corner does not move. At the corner of a marker one of the four squares has another level:
(1 + erf) / 2 for each erf. A circle is an ellipse |Q (p - c)| = 1,

    I = b + b' . r + (a + a' . r) erf(d / (sqrt(2) s)),    d = (|Q (p - c)| - 1) / |gradient of |Q (p - c)||.

Both are fitted by least squares (Levenberg-Marquardt). The covariance of a point is e^2 (J^T J)^-1 with e^2 the mean
squared residual of its own fit, and so contains noise, edge contrast and model errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.model import FloatArray, IntArray

_MIN_CUBIC_POINTS, _MIN_QUADRATIC_POINTS = 30, 14
"""Fewest points for all terms of third degree, and for those of second degree with one of third."""
_MIN_GRID_STEPS = 3
"""Fewest distinct columns and rows for any polynomial terms."""
_MAP_ITERATIONS = 4
_HORIZON = 1e-9
_DARK_LEVEL, _MIN_CONTRAST, _MAX_CLIPPED_FRACTION = 0.06, 0.04, 0.15
_DEFOCUSED_PX = 4.0
SIGMA_FLOOR_PX = 0.003
"""Least standard deviation of a coordinate: the error that remains on noiseless images."""
MAX_SIGMA_PX = 0.5
"""A point with a larger standard deviation was not found."""
_MIN_HALF_PX, _MAX_HALF_PX = 3, 12
_PATCH_SQUARES = 0.45
_MIN_SIDE_PX = 4.0
_MAP_TOLERANCE_PX = 1.5
_MAX_RESIDUAL_RATIO = 4.0
"""A corner whose residual over the view's median exceeds this is disturbed by something else: the end of the light, a
shadow, a reflection, dirt."""
_FIT_ITERATIONS = 20
_CONVERGED_PX = 1e-4
_MAX_DAMPING = 1e4
_MIN_BLUR_PX, _MAX_BLUR_PX = 0.25, 20.0
_ROOT_2 = float(np.sqrt(2))
_ERF_SLOPE = float(np.sqrt(2 / np.pi))
_Model = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From parameters (n, k) and pixels (n, m, 2) to grey levels (n, m) and their derivatives (n, m, k)."""


@dataclass(frozen=True, slots=True)
class BoardMap:
    """A smooth map from the plane of a board to an image: q = homography(position), then q plus a polynomial of q.

    With k1, p1 and p2 of Brown's lens that polynomial is q |q|^2 and terms of second degree, for any centre of the
    lens; k2 adds q |q|^4 and terms of third and fourth degree.

    homography : (3, 3) float64; coefficients : (terms,) float64, px, of `_polynomial_terms`; centre : (2,) float64 px
    and half_extent : px, box of q in the fit; limit : (2,) float64, range of the polynomial over half_extent, one grid
    step beyond the box. Outside, the polynomial stays constant, so that the map extrapolates like the homography.
    """

    homography: FloatArray
    coefficients: FloatArray
    centre: FloatArray
    half_extent: float
    limit: FloatArray
    degree: int

    def __call__(self, positions: FloatArray) -> FloatArray:
        """(..., 2) float64, px: image positions of board positions (..., 2)."""
        flat = _apply_homography(self.homography, positions)
        if not self.degree:
            return flat
        normalised = np.clip((flat - self.centre) / self.half_extent, -self.limit, self.limit)
        return np.asarray(flat + _polynomial_terms(normalised, self.degree) @ self.coefficients)

    def jacobian(self, positions: FloatArray, *, step: float) -> FloatArray:
        """(..., 2, 2) float64: derivative of (x, y) in the image, rows, by (x, y) on the board, columns."""
        columns = [(self(positions + step * unit) - self(positions - step * unit)) / (2 * step) for unit in np.eye(2)]
        return np.stack(columns, axis=-1)


def fit_board_map(positions: FloatArray, points_px: FloatArray) -> BoardMap | None:
    """Fit the map from board positions (n, 2) to image points (n, 2). None if they do not determine one.

    The polynomial has 15 terms for 30 points or more, 7 for 14 or more, and none below: few points bend a polynomial
    more than a lens bends a board.
    """
    if len(positions) < 4:
        return None
    homography, _ = cv2.findHomography(positions, points_px, 0)
    if homography is None or not np.isfinite(homography).all():
        return None
    homography = np.asarray(homography, dtype=np.float64)
    grid_steps = min(len(np.unique(np.round(positions[:, axis], 6))) for axis in (0, 1))
    degree = 3 if len(positions) >= _MIN_CUBIC_POINTS else 2 if len(positions) >= _MIN_QUADRATIC_POINTS else 0
    degree = min(degree, grid_steps - 1) if grid_steps >= _MIN_GRID_STEPS else 0
    projected = _apply_homography(homography, positions)
    least, most = projected.min(axis=0), projected.max(axis=0)
    centre, half_extent = (least + most) / 2, max(float((most - least).max()) / 2, 1e-9)
    limit = (most - least) / 2 / half_extent + 2.5 / max(grid_steps - 1, 1)
    coefficients = np.zeros(_polynomial_terms(np.zeros((1, 2)), degree).shape[-1])
    for _ in range(_MAP_ITERATIONS if degree else 0):
        # A Gauss-Newton step in both: the homography fitted to distorted points alone is not the undistorted one.
        projected = _apply_homography(homography, positions)
        terms = _polynomial_terms((projected - centre) / half_extent, degree)
        deviation = points_px - projected - terms @ coefficients
        design = np.concatenate([_homography_jacobian(homography, positions), terms], axis=2)
        design = design.reshape(-1, 8 + len(coefficients))
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        step, *_ = np.linalg.lstsq(design / scale, deviation.ravel(), rcond=1e-9)
        step = step / scale
        homography = homography + np.append(step[:8], 0.0).reshape(3, 3)
        coefficients = coefficients + step[8:]
    return BoardMap(homography, coefficients, centre, half_extent, limit, degree)


def _apply_homography(homography: FloatArray, positions: FloatArray) -> FloatArray:
    """(..., 2) float64: positions mapped by the homography alone."""
    homogeneous = positions @ homography[:, :2].T + homography[:, 2]
    depth = homogeneous[..., 2:]
    # A position on the horizon maps to a point very far away.
    return np.asarray(homogeneous[..., :2] / np.where(np.abs(depth) < _HORIZON, _HORIZON, depth))


def _homography_jacobian(homography: FloatArray, positions: FloatArray) -> FloatArray:
    """(n, 2, 8) float64: derivative of an image position by the first eight elements of the homography."""
    full = np.column_stack([positions, np.ones(len(positions))])
    projected, depth = _apply_homography(homography, positions), (full @ homography[2])[:, None]
    depth = np.where(np.abs(depth) < _HORIZON, _HORIZON, depth)
    derivative = np.zeros((len(positions), 2, 8))
    derivative[:, 0, :3] = derivative[:, 1, 3:6] = full / depth
    derivative[:, :, 6:] = -projected[:, :, None] * full[:, None, :2] / depth[:, :, None]
    return derivative


def _polynomial_terms(normalised: FloatArray, degree: int) -> FloatArray:
    """(..., 2, terms) float64: contribution of each term to x and y. First-degree terms belong to the homography."""
    x, y = normalised[..., 0], normalised[..., 1]
    square = x * x + y * y
    if degree < 3:
        products, radial = [x * x, x * y, y * y], square
    else:
        products, radial = [x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], square * square
    zero = np.zeros_like(x)
    to_x = np.stack([*products, *[zero] * len(products), radial * x], axis=-1)
    to_y = np.stack([*[zero] * len(products), *products, radial * y], axis=-1)
    return np.stack([to_x, to_y], axis=-2)


@dataclass(frozen=True, slots=True)
class GreyImage:
    """A grey image. level : (H, W) float64, 1 is full scale; image_8bit : (H, W) uint8, its middle 99.8 % stretched."""

    level: FloatArray
    image_8bit: NDArray[np.uint8]

    @classmethod
    def from_pixels(cls, image: NDArray[Any], full_scale: float) -> GreyImage:
        """Build from pixels (H, W) that clip at full_scale. Raises ValueError for a small, coloured or non-finite
        image.
        """
        if image.ndim != 2 or min(image.shape) < 16 or not full_scale > 0:
            message = f"expected a grey image of 16 x 16 pixels or more, found {image.shape}, full scale {full_scale:g}"
            raise ValueError(message)
        level = image.astype(np.float64) / full_scale
        if not np.isfinite(level).all():
            message = "expected an image of finite grey levels, found NaN or infinity"
            raise ValueError(message)
        low, high = np.percentile(level[::2, ::2], [0.1, 99.9])
        stretched = (level - low) * (255 / max(high - low, 1e-6))
        return cls(level, np.clip(np.round(stretched), 0, 255).astype(np.uint8))

    def downscale(self, longest_px: int) -> tuple[NDArray[np.uint8], float]:
        """Return the 8-bit image with its longer side at most longest_px, and the scale factor."""
        factor = min(1.0, longest_px / max(self.image_8bit.shape))
        if factor == 1.0:
            return self.image_8bit, 1.0
        small = cv2.resize(self.image_8bit, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8), factor

    def likely_cause(self) -> str:
        """Describe the most likely reason why no board is found in this image, and what to do."""
        low, high = np.percentile(self.level, [1, 99])
        if high < _DARK_LEVEL:
            return (
                f"the image is too dark, 99 % of it is below {100 * high:.1f} % of full scale: lengthen the exposure "
                "or bring light on the board"
            )
        clipped = float(np.mean(self.level >= 0.995))
        if clipped > _MAX_CLIPPED_FRACTION:
            return f"{100 * clipped:.0f} % of the image is clipped to white: shorten the exposure"
        if high - low < _MIN_CONTRAST:
            return (
                f"the image has almost no contrast, {100 * (high - low):.1f} % of full scale between its darkest and "
                "its brightest percent: take the lens cap off, or turn the board's printed side to the camera"
            )
        if self.is_blurred():
            return (
                f"the image is out of focus, or moved while it was taken: its sharpest edges are blurred over "
                f"{self._edge_blur_px():.0f} pixels (standard deviation): focus the lens on the board and hold it still"
            )
        return (
            "light and focus are good, so the board is most likely not in view, partly covered, or too far away: "
            "bring all of it into the image, its squares at least 12 pixels wide, tilted by less than 60 degrees"
        )

    def is_blurred(self) -> bool:
        """True if even the sharpest edges are blurred over several pixels."""
        return self._edge_blur_px() > _DEFOCUSED_PX

    def _edge_blur_px(self) -> float:
        """Standard deviation of the blur of the steepest edges, from their height over their slope."""
        smooth = cv2.GaussianBlur(self.level, (0, 0), 1.0)
        slope = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0) / 8, cv2.Sobel(smooth, cv2.CV_64F, 0, 1) / 8)
        low, high = np.percentile(self.level, [1, 99])
        steepest = float(np.percentile(slope, 99.9))
        return float((high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9))


@dataclass(frozen=True, slots=True)
class PointFit:
    """Fitted points. points_px : (n, 2) float64; sigma_px : (n,) float64, NaN where the fit failed; blur_px : (n,)
    float64, standard deviation of the blur, the pixel's own extent included; residual : (n,) float64, rms grey level.
    """

    points_px: FloatArray
    sigma_px: FloatArray
    blur_px: FloatArray
    residual: FloatArray

    @property
    def is_valid(self) -> NDArray[np.bool_]:
        """(n,) bool: False where the fit failed or is too uncertain."""
        return np.isfinite(self.sigma_px) & (self.sigma_px < MAX_SIGMA_PX)


@dataclass(frozen=True, slots=True)
class RefinedCorners:
    """Refined corners: the view, the map fitted to them, and the blur at each, (n,) float64 px."""

    view: BoardView
    board_map: BoardMap
    blur_px: FloatArray


def refine_corners(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, *, light_first: bool = False,
    keep_disturbed: bool = False,
) -> RefinedCorners | None:  # fmt: skip
    """Refine corners of a chessboard or ChArUco board from rough positions. None if too few of the fits succeed.

    level : (H, W) float64; corner : (n,) int; rough_px : (n, 2) float64; light_first : as in `BoardView`;
    keep_disturbed : keep corners that the end of the light or the like disturbs.
    """
    order = np.argsort(corner)
    corner, rough_px = corner[order].astype(np.int32), rough_px[order]
    squares = board.points_mm[:, :2] / board.square_mm
    for repeated in (False, True):
        board_map = fit_board_map(squares[corner], rough_px)
        if board_map is None:
            return None
        fit = _fit_at_corners(level, board, corner, rough_px, board_map, light_first)
        if fit is None:
            return None
        valid = fit.is_valid
        if valid.any() and not keep_disturbed:
            valid &= fit.residual < _MAX_RESIDUAL_RATIO * np.median(fit.residual[valid])
        corner, rough_px = corner[valid], fit.points_px[valid]
        sigma, blur = fit.sigma_px[valid], fit.blur_px[valid]
        if len(corner) < 4:
            return None
        consistent = _map_inliers(squares[corner], rough_px)
        corner, rough_px, sigma, blur = corner[consistent], rough_px[consistent], sigma[consistent], blur[consistent]
        if consistent.all() or repeated:
            break
    final = fit_board_map(squares[corner], rough_px)
    if final is None:
        return None
    view = BoardView(corner, rough_px, np.hypot(sigma, SIGMA_FLOOR_PX), light_first)
    return RefinedCorners(view, final, blur)


def _map_inliers(squares: FloatArray, points_px: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: points within a few times the median distance from the map fitted to all."""
    inliers: NDArray[np.bool_] = np.ones(len(points_px), dtype=bool)
    for _ in range(3):
        board_map = fit_board_map(squares[inliers], points_px[inliers])
        if board_map is None:
            break
        distance = np.linalg.norm(points_px - board_map(squares), axis=1)
        updated = distance < max(_MAP_TOLERANCE_PX, 5 * float(np.median(distance[inliers])))
        if (updated == inliers).all():
            break
        inliers = updated
    return inliers


def _fit_at_corners(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, board_map: BoardMap, light_first: bool
) -> PointFit | None:
    """Fit each corner. None where the squares are too small or the map is folded in them."""
    squares = board.points_mm[corner, :2] / board.square_mm
    slope = board_map.jacobian(squares, step=0.05)
    area = np.linalg.det(slope)
    if not np.isfinite(slope).all() or np.median(np.abs(area)) < _MIN_SIDE_PX**2:
        return None
    # The fit fails at a corner where the map is folded; any other square replaces its own.
    folded = np.abs(area) < 0.1 * np.median(np.abs(area))
    slope[folded] = slope[int(np.argmax(~folded))]
    sides = np.linalg.norm(slope, axis=1)
    half_px = int(np.clip(np.round(_PATCH_SQUARES * np.median(sides.min(axis=1))), _MIN_HALF_PX, _MAX_HALF_PX))
    offsets = patch_offsets(half_px) + (np.round(rough_px) - rough_px)[:, None]
    # Offsets of the pixels from the corner, in squares; linear over so short a distance.
    local = np.einsum("nij,nmj->nmi", np.linalg.inv(slope), offsets)
    usable = np.abs(local).max(axis=-1) < _PATCH_SQUARES
    if board.kind is BoardKind.CHARUCO:
        inset = (1 - float(board.marker_mm or 0) / board.square_mm) / 2
        clear = (np.abs(local) - inset) * sides[:, None]
        # Only light squares hold a marker; the corner's number says which diagonal is light.
        row, column = np.divmod(corner, board.columns)
        same_sign = (local[..., 0] > 0) == (local[..., 1] > 0)
        light = same_sign == ((row + column) % 2 != int(light_first))[:, None]
        usable &= ~(light & (clear.min(axis=-1) > -1.0))
    edges = slope.transpose(0, 2, 1) / sides[..., None]
    return fit_corners(level, rough_px, edges, usable, half_px=half_px)


def patch_offsets(half_px: int) -> NDArray[np.int64]:
    """(m, 2) int64: (x, y) of the pixels of a square patch from its centre."""
    reach = np.arange(-half_px, half_px + 1)
    x, y = np.meshgrid(reach, reach)
    return np.column_stack([x.ravel(), y.ravel()])


def fit_corners(
    image: FloatArray, start_px: FloatArray, edges: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int,
    outer: bool = False,
) -> PointFit:  # fmt: skip
    """Fit corners where two edges cross, or where two edges end.

    image : (H, W) float64; start_px : (n, 2) float64, within about two pixels; edges : (n, 2, 2) float64, directions of
    the two edges at each corner, rows; usable : (n, m) bool, pixels of the patch of `half_px` around the nearest pixel
    that belong to the four squares at the corner. outer : only the square to the right of both edges differs, as seen
    along them in an image whose rows count downwards.
    """
    model = partial(_corner_model, least=0.5) if outer else _corner_model
    return _fit_patches(model, np.arctan2(edges[..., 0], -edges[..., 1]), image, start_px, usable, half_px)[0]


def fit_circles(
    image: FloatArray, start_px: FloatArray, shape: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int
) -> tuple[PointFit, FloatArray]:
    """Fit the ellipses that circles appear as.

    shape : (n, 2, 2) float64, symmetric: |shape @ (p - centre)| = 1 on the outline. Other arguments as in
    `fit_corners`. Returns the ellipse centres and the fitted shapes, (n, 2, 2) float64. The image of a circle's centre
    is not the ellipse's centre: see `slrig.calibration.detection.circles`.
    """
    positions, q = _fit_patches(_circle_model, shape[:, [0, 0, 1], [0, 1, 1]], image, start_px, usable, half_px)
    return positions, np.stack([q[:, [2, 3]], q[:, [3, 4]]], axis=1)


def _corner_model(parameters: FloatArray, pixels: FloatArray, *, least: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, two angles of the normals, blur, b, b'x, b'y, a, a'x, a'y. least : 0.5 for (1 + erf) / 2."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - parameters[:, :1], y - parameters[:, 1:2]
    blur, step = parameters[:, 4:5], parameters[:, 8:9] + parameters[:, 9:10] * x + parameters[:, 10:11] * y
    cosine, sine = np.cos(parameters[:, 2:4]).T[..., None], np.sin(parameters[:, 2:4]).T[..., None]
    scaled = (cosine * off_x + sine * off_y) / blur
    rises = least + (1 - least) * erf(scaled / _ROOT_2)
    by = step * ((1 - least) * _ERF_SLOPE / blur * np.exp(-0.5 * scaled**2)) * rises[::-1]
    turned = by * (-sine * off_x + cosine * off_y)
    by_shape = [-(by * cosine).sum(axis=0), -(by * sine).sum(axis=0), *turned, -(by * scaled).sum(axis=0)]
    return _grey_levels(parameters[:, 5:8], x, y, step, rises[0] * rises[1], by_shape)


def _circle_model(parameters: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, three elements of Q, blur, b, b'x, b'y, a, a'x, a'y."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - parameters[:, :1], y - parameters[:, 1:2]
    q_xx, q_xy, q_yy = parameters[:, 2:3], parameters[:, 3:4], parameters[:, 4:5]
    across, down = q_xx * off_x + q_xy * off_y, q_xy * off_x + q_yy * off_y
    radius = np.maximum(np.hypot(across, down), 1e-6)
    slope_x, slope_y = (q_xx * across + q_xy * down) / radius, (q_xy * across + q_yy * down) / radius
    steep = np.maximum(np.hypot(slope_x, slope_y), 1e-9)
    blur, step = parameters[:, 5:6], parameters[:, 9:10] + parameters[:, 10:11] * x + parameters[:, 11:12] * y
    scaled = (radius - 1) / steep / blur
    by_distance = step * _ERF_SLOPE / blur * np.exp(-0.5 * scaled**2)
    by_shape = [
        -by_distance * slope_x / steep, -by_distance * slope_y / steep, by_distance * across * off_x / radius / steep,
        by_distance * (across * off_y + down * off_x) / radius / steep, by_distance * down * off_y / radius / steep,
        -by_distance * scaled,
    ]  # fmt: skip
    return _grey_levels(parameters[:, 6:9], x, y, step, erf(scaled / _ROOT_2), by_shape)


def _grey_levels(
    base: FloatArray, x: FloatArray, y: FloatArray, step: FloatArray, rise: FloatArray, by_shape: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """I = base + step rise, and its derivatives: by the shape, then by b, b', a and a'. base : (n, 3), b and b'."""
    level = base[:, :1] + base[:, 1:2] * x + base[:, 2:3] * y + step * rise
    return level, np.stack([*by_shape, np.ones_like(x), x, y, rise, rise * x, rise * y], axis=-1)


def _patches(
    image: FloatArray, start_px: FloatArray, usable: NDArray[np.bool_], half_px: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Pixels of each patch relative to its start (n, m, 2), their grey levels (n, m), and which are usable.

    Keeps only the usable pixels of each patch, padded to the greatest number of them.
    """
    offsets = patch_offsets(half_px)
    nearest = np.round(start_px).astype(np.int64)
    pixel = nearest[:, None] + offsets
    height, width = image.shape
    inside = (pixel[..., 0] >= 0) & (pixel[..., 1] >= 0) & (pixel[..., 0] < width) & (pixel[..., 1] < height)
    usable = usable & inside
    usable_first = np.argsort(~usable, axis=1, kind="stable")[:, : max(int(usable.sum(axis=1).max()), 1)]
    usable = np.take_along_axis(usable, usable_first, axis=1)
    pixel = np.take_along_axis(pixel, usable_first[..., None], axis=1)
    grey = image[np.clip(pixel[..., 1], 0, height - 1), np.clip(pixel[..., 0], 0, width - 1)]
    return pixel - start_px[:, None], np.asarray(grey, dtype=np.float64), usable


def _masked_mean(grey: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    return np.asarray((grey * usable).sum(axis=1) / np.maximum(usable.sum(axis=1), 1))


def _fit_patches(
    model: _Model, shape: FloatArray, image: FloatArray, start_px: FloatArray, usable: NDArray[np.bool_], half_px: int
) -> tuple[PointFit, FloatArray]:
    """Fit every patch by Levenberg-Marquardt with its own damping. Returns the points and the parameters (n, k).

    shape : (n, s) float64, start values of the model's parameters between position and blur.
    """
    pixels, grey, usable = _patches(image, start_px, usable, half_px)
    blur = 2 + shape.shape[1]
    parameters = np.zeros((len(start_px), blur + 7))
    parameters[:, 2:blur], parameters[:, blur], parameters[:, blur + 1] = shape, 1.0, _masked_mean(grey, usable)
    # Step height of the best fit with all other parameters at their start values.
    unit = model(parameters, pixels)[1][..., blur + 4] * usable
    unit -= _masked_mean(unit, usable)[:, None] * usable
    parameters[:, blur + 4] = (unit * grey).sum(axis=1) / np.maximum((unit**2).sum(axis=1), 1e-12)
    damping = np.full(len(parameters), 1e-3)
    converged = np.zeros(len(parameters), dtype=bool)
    level, derivative = model(parameters, pixels)
    residual = (grey - level) * usable
    cost = (residual**2).sum(axis=1)
    for _ in range(_FIT_ITERATIONS):
        weighted = derivative * usable[..., None]
        normal_matrix = np.matmul(weighted.transpose(0, 2, 1), weighted)
        slope = np.matmul(weighted.transpose(0, 2, 1), residual[..., None])
        scale = np.einsum("nii->ni", normal_matrix)
        damped = normal_matrix + (damping[:, None] * scale + 1e-12)[:, :, None] * np.eye(parameters.shape[1])
        step = np.linalg.solve(damped, slope)[..., 0]
        trial = parameters + step
        trial[:, blur] = np.clip(trial[:, blur], _MIN_BLUR_PX, _MAX_BLUR_PX)
        new_level, new_derivative = model(trial, pixels)
        new_residual = (grey - new_level) * usable
        new_cost = (new_residual**2).sum(axis=1)
        better = new_cost <= cost
        parameters = np.where(better[:, None], trial, parameters)
        residual = np.where(better[:, None], new_residual, residual)
        derivative = np.where(better[:, None, None], new_derivative, derivative)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-9, 1e6)
        converged |= (better & (np.abs(step[:, :2]) < _CONVERGED_PX).all(axis=1)) | (damping > _MAX_DAMPING)
        if converged.all():
            break
    weighted = derivative * usable[..., None]
    degrees = usable.sum(axis=1) - parameters.shape[1]
    variance = cost / np.maximum(degrees, 1)
    normal_matrix = np.matmul(weighted.transpose(0, 2, 1), weighted)
    # Scaled, because grey levels and pixels have different units.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal_matrix), 1e-30))
    inverse = np.linalg.pinv(normal_matrix / scale[:, :, None] / scale[:, None, :], hermitian=True)
    spread = np.einsum("nii->ni", inverse)[:, :2] / scale[:, :2] ** 2
    sigma = np.sqrt(variance * spread.mean(axis=1))
    shift_px = np.hypot(parameters[:, 0], parameters[:, 1])
    sigma = np.where((degrees > parameters.shape[1]) & (shift_px <= 0.5 * half_px), sigma, np.nan)
    return PointFit(start_px + parameters[:, :2], sigma, parameters[:, blur], np.sqrt(variance)), parameters
