"""Corners and circles to a hundredth of a pixel: a model of the blurred print, fitted to the pixels around each one.

A corner is where two straight edges cross. With d1, d2 the distances of a pixel from the edges and s the blur,

    I = b + b' . r + (a + a' . r) erf(d1 / (sqrt(2) s)) erf(d2 / (sqrt(2) s)),    r = the pixel's place from the start,

exact for a Gaussian blur and edges at right angles. Edges that meet at another angle change I by a term that is the
same at r and -r about the corner, so the corner's place stays. At the corner of a marker one square of the four has
another level: (1 + erf) / 2 for each erf. A circle is an ellipse |Q (p - c)| = 1,

    I = b + b' . r + (a + a' . r) erf(d / (sqrt(2) s)),    d = (|Q (p - c)| - 1) / |gradient of |Q (p - c)||.

Both are least squares by Levenberg and Marquardt; the covariance of a place is e^2 (J^T J)^-1 with e^2 the fit's own
mean squared residual, so that noise, slope of the edges and whatever the model does not say all are in it.
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

_CUBIC, _QUADRATIC = 30, 14
"""Fewest points for all terms of third degree, and for those of second with one of third."""
_SPAN = 3
"""Fewest different columns and rows for a rest at all."""
_MAP_ITERATIONS = 4
_HORIZON = 1e-9


@dataclass(frozen=True, slots=True)
class BoardMap:
    """A smooth map of the plane of a board into an image: q = homography(place), then q + a polynomial of q.

    With k1, p1 and p2 of Brown's lens that polynomial is q |q|^2 and terms of second degree, wherever the lens has its
    centre; k2 adds q |q|^4 and terms of third and fourth degree.

    homography : (3, 3) float64; rest : (terms,) float64, px, over those of `_terms`; middle : (2,) float64 px, half :
    px, the box of q that it was fitted to; bound : (2,) float64, how far the rest goes on, over `half`: a step of the
    grid beyond the box. Farther out it stays what it is there, so that an extrapolation is no wilder than the
    homography's.
    """

    homography: FloatArray
    rest: FloatArray
    middle: FloatArray
    half: float
    bound: FloatArray
    degree: int

    def __call__(self, places: FloatArray) -> FloatArray:
        """(..., 2) float64, px: where places of the board, (..., 2), lie in the image."""
        flat = _flat(self.homography, places)
        if not self.degree:
            return flat
        within = np.clip((flat - self.middle) / self.half, -self.bound, self.bound)
        return np.asarray(flat + _terms(within, self.degree) @ self.rest)

    def jacobian(self, places: FloatArray, *, step: float) -> FloatArray:
        """(..., 2, 2) float64: derivative of (x, y) in the image, rows, by (x, y) on the board, columns."""
        columns = [(self(places + step * unit) - self(places - step * unit)) / (2 * step) for unit in np.eye(2)]
        return np.stack(columns, axis=-1)


def fitted_map(places: FloatArray, points_px: FloatArray) -> BoardMap | None:
    """The map that best takes places of the board (n, 2) to points of the image (n, 2); None if they determine none.

    The rest has 15 terms with 30 points or more, 7 with 14 or more, and none below: a few points bend a polynomial more
    than a lens bends a board.
    """
    if len(places) < 4:
        return None
    homography, _ = cv2.findHomography(places, points_px, 0)
    if homography is None or not np.isfinite(homography).all():
        return None
    homography = np.asarray(homography, dtype=np.float64)
    steps = np.array([len(np.unique(np.round(places[:, axis], 6))) for axis in (0, 1)])
    spans = int(steps.min())
    degree = 3 if len(places) >= _CUBIC else 2 if len(places) >= _QUADRATIC else 0
    degree = min(degree, spans - 1) if spans >= _SPAN else 0
    flat = _flat(homography, places)
    least, most = flat.min(axis=0), flat.max(axis=0)
    middle, half = (least + most) / 2, max(float((most - least).max()) / 2, 1e-9)
    bound = (most - least) / 2 / half + 2.5 / max(spans - 1, 1)
    rest = np.zeros(_terms(np.zeros((1, 2)), degree).shape[-1])
    for _ in range(_MAP_ITERATIONS if degree else 0):
        # One step of Gauss and Newton in both: the homography that the bent points alone give is not the straight one.
        flat = _flat(homography, places)
        terms = _terms((flat - middle) / half, degree)
        off = points_px - flat - terms @ rest
        design = np.concatenate([_by_homography(homography, places), terms], axis=2).reshape(-1, 8 + len(rest))
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        step, *_ = np.linalg.lstsq(design / scale, off.ravel(), rcond=1e-9)
        step = step / scale
        homography = homography + np.append(step[:8], 0.0).reshape(3, 3)
        rest = rest + step[8:]
    return BoardMap(homography, rest, middle, half, bound, degree)


def _flat(homography: FloatArray, places: FloatArray) -> FloatArray:
    """(..., 2) float64: places through the homography alone."""
    homogeneous = places @ homography[:, :2].T + homography[:, 2]
    below = homogeneous[..., 2:]
    # A place on the horizon is nowhere in the image: very far away will do.
    return np.asarray(homogeneous[..., :2] / np.where(np.abs(below) < _HORIZON, _HORIZON, below))


def _by_homography(homography: FloatArray, places: FloatArray) -> FloatArray:
    """(n, 2, 8) float64: derivative of a place in the image by the first eight numbers of the homography."""
    full = np.column_stack([places, np.ones(len(places))])
    flat, below = _flat(homography, places), (full @ homography[2])[:, None]
    below = np.where(np.abs(below) < _HORIZON, _HORIZON, below)
    derivative = np.zeros((len(places), 2, 8))
    derivative[:, 0, :3] = derivative[:, 1, 3:6] = full / below
    derivative[:, :, 6:] = -flat[:, :, None] * full[:, None, :2] / below[:, :, None]
    return derivative


def _terms(within: FloatArray, degree: int) -> FloatArray:
    """(..., 2, terms) float64: what each term adds to x and to y; terms of first degree are the homography's."""
    x, y = within[..., 0], within[..., 1]
    square = x * x + y * y
    if degree < 3:
        products, radial = [x * x, x * y, y * y], square
    else:
        products, radial = [x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], square * square
    nothing = np.zeros_like(x)
    to_x = np.stack([*products, *[nothing] * len(products), radial * x], axis=-1)
    to_y = np.stack([*[nothing] * len(products), *products, radial * y], axis=-1)
    return np.stack([to_x, to_y], axis=-2)


_DARK, _FAINT, _CLIPPED = 0.06, 0.04, 0.15
_BLURRED_PX = 4.0


@dataclass(frozen=True, slots=True)
class Grey:
    """An image twice. level : (H, W) float64, 1 is full scale; eight : (H, W) uint8, its middle 99.8 % stretched."""

    level: FloatArray
    eight: NDArray[np.uint8]

    @classmethod
    def of(cls, image: NDArray[Any], full_scale: float) -> Grey:
        """The image and its stretched copy."""
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

    def reduced(self, longest_px: int) -> tuple[NDArray[np.uint8], float]:
        """The 8-bit image with its longer side at most this long, and the factor it was scaled by."""
        factor = min(1.0, longest_px / max(self.eight.shape))
        if factor == 1.0:
            return self.eight, 1.0
        small = cv2.resize(self.eight, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8), factor

    def likely_cause(self) -> str:
        """Why no board is found in this image, most likely, and what to do about it."""
        low, high = np.percentile(self.level, [1, 99])
        if high < _DARK:
            return (
                f"the image is too dark, its brightest hundredth begins at {100 * high:.1f} % of full scale: "
                "lengthen the exposure or bring light on the board"
            )
        clipped = float(np.mean(self.level >= 0.995))
        if clipped > _CLIPPED:
            return f"{100 * clipped:.0f} % of the image is clipped to white: shorten the exposure"
        if high - low < _FAINT:
            return (
                f"the image has next to no contrast, {100 * (high - low):.1f} % of full scale from its darkest to its "
                "brightest hundredth: take the lens cap off, or turn the board's printed side to the camera"
            )
        if self.blurred():
            return (
                f"the image is out of focus, or moved while it was taken: its sharpest edges are blurred over "
                f"{self._blur_px():.0f} pixels (standard deviation): focus the lens on the board and hold it still"
            )
        return (
            "light and focus look well, so the board is most likely not in view, covered in part, or too far away: "
            "bring all of it into the image, its squares at least 12 pixels wide, tilted by less than 60 degrees"
        )

    def blurred(self) -> bool:
        """Whether even its sharpest edges are blurred over several pixels."""
        return self._blur_px() > _BLURRED_PX

    def _blur_px(self) -> float:
        """Standard deviation of the blur of the image's steepest edges, from their slope over their height."""
        smooth = cv2.GaussianBlur(self.level, (0, 0), 1.0)
        slope = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0) / 8, cv2.Sobel(smooth, cv2.CV_64F, 0, 1) / 8)
        low, high = np.percentile(self.level, [1, 99])
        steepest = float(np.percentile(slope, 99.9))
        return float((high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9))


FLOOR_PX = 0.003
"""Least deviation of a coordinate: what remains on noiseless renderings of tilted, distorted, shaded boards."""

WORST_SIGMA_PX = 0.5
"""A place that is worse known than this was not found."""

_LEAST_HALF_PX, _MOST_HALF_PX = 3, 12
_SHARE = 0.45
_LEAST_SIDE_PX = 4.0
_ASIDE_PX = 1.5
_MISFIT = 4.0
"""A corner whose fit leaves so many times what is usual in the view is crossed by something else: the end of the light,
a shadow, a reflection, dirt. It is off by up to seventeen of its own deviations where the light ends on it."""
_FIT_ITERATIONS = 20
_SETTLED_PX = 1e-4
_STUCK = 1e4
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.25, 20.0
_ROOT_2 = float(np.sqrt(2))
_SLOPE = float(np.sqrt(2 / np.pi))

_Model = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From parameters (n, k) and pixels (n, m, 2) to grey levels (n, m) and their derivatives (n, m, k)."""


@dataclass(frozen=True, slots=True)
class FittedPlaces:
    """Places that were fitted. points_px : (n, 2) float64; sigma_px : (n,) float64, NaN where the fit failed;
    blur_px : (n,) float64, the standard deviation of the blur, the pixel's own extent included. rest : (n,) float64,
    the rms grey level that the model leaves.
    """

    points_px: FloatArray
    sigma_px: FloatArray
    blur_px: FloatArray
    rest: FloatArray


@dataclass(frozen=True, slots=True)
class PlacedCorners:
    """Corners that were placed: the view, the map that they follow, and the blur at each, (n,) float64 px."""

    view: BoardView
    board_map: BoardMap
    blur_px: FloatArray


def placed_corners(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, *, light_first: bool = False,
    crossed: bool = False,
) -> PlacedCorners | None:  # fmt: skip
    """Corners of a chessboard or ChArUco board from rough places: those that a fit could place. None if too few.

    level : (H, W) float64; corner : (n,) int32, rising; rough_px : (n, 2) float64; light_first : as of `BoardView`;
    crossed : with those that are crossed by something else, such as the end of the light, and so are off.
    """
    squares = board.points_mm[:, :2] / board.square_mm
    for again in (False, True):
        board_map = fitted_map(squares[corner], rough_px)
        if board_map is None:
            return None
        fit = _fit(level, board, corner, rough_px, board_map, light_first)
        if fit is None:
            return None
        good = np.isfinite(fit.sigma_px) & (fit.sigma_px < WORST_SIGMA_PX)
        if good.any() and not crossed:
            good &= fit.rest < _MISFIT * np.median(fit.rest[good])
        corner, rough_px = corner[good], fit.points_px[good]
        sigma, blur = fit.sigma_px[good], fit.blur_px[good]
        if len(corner) < 4:
            return None
        keep = _on_the_map(squares[corner], rough_px)
        corner, rough_px, sigma, blur = corner[keep], rough_px[keep], sigma[keep], blur[keep]
        if keep.all() or again:
            break
    final = fitted_map(squares[corner], rough_px)
    if final is None:
        return None
    view = BoardView(corner.astype(np.int32), rough_px, np.hypot(sigma, FLOOR_PX), light_first)
    return PlacedCorners(view, final, blur)


def _on_the_map(squares: FloatArray, points_px: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which points lie where their neighbours say, within a few times the usual distance."""
    keep = np.ones(len(points_px), dtype=bool)
    for _ in range(3):
        board_map = fitted_map(squares[keep], points_px[keep])
        if board_map is None:
            break
        aside = np.linalg.norm(points_px - board_map(squares), axis=1)
        now = aside < max(_ASIDE_PX, 5 * float(np.median(aside[keep])))
        if (now == keep).all():
            break
        keep = now
    return keep


def _fit(
    level: FloatArray, board: Board, corner: IntArray, rough_px: FloatArray, board_map: BoardMap, light_first: bool
) -> FittedPlaces | None:
    """The fit at each corner; None where squares would be smaller than can be told, or the map has a fold in them."""
    squares = board.points_mm[corner, :2] / board.square_mm
    slope = board_map.jacobian(squares, step=0.05)
    area = np.linalg.det(slope)
    if not np.isfinite(slope).all() or np.median(np.abs(area)) < _LEAST_SIDE_PX**2:
        return None
    # A corner where the map is folded is none; any square stands in for its own.
    folded = np.abs(area) < 0.1 * np.median(np.abs(area))
    slope[folded] = slope[int(np.argmax(~folded))]
    sides = np.linalg.norm(slope, axis=1)
    half_px = int(np.clip(np.round(_SHARE * np.median(sides.min(axis=1))), _LEAST_HALF_PX, _MOST_HALF_PX))
    offsets = patch_offsets(half_px) + (np.round(rough_px) - rough_px)[:, None]
    # Places of the pixels from the corner, in squares; straight within so short a way.
    local = np.einsum("nij,nmj->nmi", np.linalg.inv(slope), offsets)
    usable = np.abs(local).max(axis=-1) < _SHARE
    if board.kind is BoardKind.CHARUCO:
        inset = (1 - float(board.marker_mm or 0) / board.square_mm) / 2
        clear = (np.abs(local) - inset) * sides[:, None]
        # Of the two squares on this diagonal, light or dark by the corner's number, only the light ones hold a marker.
        row, column = np.divmod(corner, board.columns)
        same_sign = (local[..., 0] > 0) == (local[..., 1] > 0)
        light = same_sign == ((row + column) % 2 != int(light_first))[:, None]
        usable &= ~(light & (clear.min(axis=-1) > -1.0))
    edges = slope.transpose(0, 2, 1) / sides[..., None]
    return fitted_corners(level, rough_px, edges, usable, half_px=half_px)


def patch_offsets(half_px: int) -> NDArray[np.int64]:
    """(m, 2) int64: (x, y) of the pixels of a square patch from its middle."""
    reach = np.arange(-half_px, half_px + 1)
    x, y = np.meshgrid(reach, reach)
    return np.column_stack([x.ravel(), y.ravel()])


def fitted_corners(
    image: FloatArray, start_px: FloatArray, edges: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int,
    outer: bool = False,
) -> FittedPlaces:  # fmt: skip
    """Corners where two edges cross, or end in one another.

    image : (H, W) float64; start_px : (n, 2) float64, within two pixels or so; edges : (n, 2, 2) float64, the
    directions of the two edges at each, rows; usable : (n, m) bool, which pixels of the patch of `half_px` about the
    nearest pixel belong to the four squares that meet there. outer : only the square differs that lies to the right of
    both edges, as one looks along them in an image whose rows count downwards.
    """
    model = partial(_corner_model, least=0.5) if outer else _corner_model
    return _fitted(model, np.arctan2(edges[..., 0], -edges[..., 1]), image, start_px, usable, half_px)[0]


def fitted_circles(
    image: FloatArray, start_px: FloatArray, shape: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int
) -> tuple[FittedPlaces, FloatArray]:
    """Centres of the ellipses that circles look like, and their shapes.

    shape : (n, 2, 2) float64, symmetric: |shape @ (p - centre)| = 1 on the outline. The other arguments are those of
    `fitted_corners`. Returns the places and the fitted shapes, (n, 2, 2) float64. An ellipse's centre is not where the
    circle's centre is seen: see `slrig.calibration.detection.circles`.
    """
    places, q = _fitted(_circle_model, shape[:, [0, 0, 1], [0, 1, 1]], image, start_px, usable, half_px)
    return places, np.stack([q[:, [2, 3]], q[:, [3, 4]]], axis=1)


def _corner_model(given: FloatArray, pixels: FloatArray, *, least: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, two angles of the normals, blur, b, b'x, b'y, a, a'x, a'y. least : 0.5 for (1 + erf) / 2."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - given[:, :1], y - given[:, 1:2]
    blur, step = given[:, 4:5], given[:, 8:9] + given[:, 9:10] * x + given[:, 10:11] * y
    cosine, sine = np.cos(given[:, 2:4]).T[..., None], np.sin(given[:, 2:4]).T[..., None]
    scaled = (cosine * off_x + sine * off_y) / blur
    rises = least + (1 - least) * erf(scaled / _ROOT_2)
    by = step * ((1 - least) * _SLOPE / blur * np.exp(-0.5 * scaled**2)) * rises[::-1]
    turned = by * (-sine * off_x + cosine * off_y)
    by_shape = [-(by * cosine).sum(axis=0), -(by * sine).sum(axis=0), *turned, -(by * scaled).sum(axis=0)]
    return _shaded(given[:, 5:8], x, y, step, rises[0] * rises[1], by_shape)


def _circle_model(given: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, Q's three numbers, blur, b, b'x, b'y, a, a'x, a'y."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - given[:, :1], y - given[:, 1:2]
    q_xx, q_xy, q_yy = given[:, 2:3], given[:, 3:4], given[:, 4:5]
    across, down = q_xx * off_x + q_xy * off_y, q_xy * off_x + q_yy * off_y
    radius = np.maximum(np.hypot(across, down), 1e-6)
    slope_x, slope_y = (q_xx * across + q_xy * down) / radius, (q_xy * across + q_yy * down) / radius
    steep = np.maximum(np.hypot(slope_x, slope_y), 1e-9)
    blur, step = given[:, 5:6], given[:, 9:10] + given[:, 10:11] * x + given[:, 11:12] * y
    scaled = (radius - 1) / steep / blur
    by_distance = step * _SLOPE / blur * np.exp(-0.5 * scaled**2)
    by_shape = [
        -by_distance * slope_x / steep, -by_distance * slope_y / steep, by_distance * across * off_x / radius / steep,
        by_distance * (across * off_y + down * off_x) / radius / steep, by_distance * down * off_y / radius / steep,
        -by_distance * scaled,
    ]  # fmt: skip
    return _shaded(given[:, 6:9], x, y, step, erf(scaled / _ROOT_2), by_shape)


def _shaded(
    base: FloatArray, x: FloatArray, y: FloatArray, step: FloatArray, rise: FloatArray, by_shape: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """I = base + step rise, and its derivatives: by the shape, then by b, b', a and a'. base : (n, 3), b and b'."""
    level = base[:, :1] + base[:, 1:2] * x + base[:, 2:3] * y + step * rise
    return level, np.stack([*by_shape, np.ones_like(x), x, y, rise, rise * x, rise * y], axis=-1)


def _patches(
    image: FloatArray, start_px: FloatArray, usable: NDArray[np.bool_], half_px: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Pixels of each patch from its start (n, m, 2), their grey levels (n, m), and which are usable and in the image.

    Only the usable ones of each patch are kept, filled up to the greatest number of them.
    """
    offsets = patch_offsets(half_px)
    middle = np.round(start_px).astype(np.int64)
    place = middle[:, None] + offsets
    height, width = image.shape
    inside = (place[..., 0] >= 0) & (place[..., 1] >= 0) & (place[..., 0] < width) & (place[..., 1] < height)
    usable = usable & inside
    first = np.argsort(~usable, axis=1, kind="stable")[:, : max(int(usable.sum(axis=1).max()), 1)]
    usable = np.take_along_axis(usable, first, axis=1)
    place = np.take_along_axis(place, first[..., None], axis=1)
    grey = image[np.clip(place[..., 1], 0, height - 1), np.clip(place[..., 0], 0, width - 1)]
    return place - start_px[:, None], np.asarray(grey, dtype=np.float64), usable


def _mean(grey: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    return np.asarray((grey * usable).sum(axis=1) / np.maximum(usable.sum(axis=1), 1))


def _fitted(
    model: _Model, shape: FloatArray, image: FloatArray, start_px: FloatArray, usable: NDArray[np.bool_], half_px: int
) -> tuple[FittedPlaces, FloatArray]:
    """Places and parameters (n, k) after Levenberg and Marquardt, every patch with its own damping.

    shape : (n, s) float64, the model's parameters between the place and the blur, at the start.
    """
    pixels, grey, usable = _patches(image, start_px, usable, half_px)
    blur = 2 + shape.shape[1]
    given = np.zeros((len(start_px), blur + 7))
    given[:, 2:blur], given[:, blur], given[:, blur + 1] = shape, 1.0, _mean(grey, usable)
    # The step's height that fits best while all else is as at the start.
    unit = model(given, pixels)[1][..., blur + 4] * usable
    unit -= _mean(unit, usable)[:, None] * usable
    given[:, blur + 4] = (unit * grey).sum(axis=1) / np.maximum((unit**2).sum(axis=1), 1e-12)
    damping = np.full(len(given), 1e-3)
    settled = np.zeros(len(given), dtype=bool)
    level, derivative = model(given, pixels)
    rest = (grey - level) * usable
    cost = (rest**2).sum(axis=1)
    for _ in range(_FIT_ITERATIONS):
        weighted = derivative * usable[..., None]
        normal = np.matmul(weighted.transpose(0, 2, 1), weighted)
        slope = np.matmul(weighted.transpose(0, 2, 1), rest[..., None])
        scale = np.einsum("nii->ni", normal)
        damped = normal + (damping[:, None] * scale + 1e-12)[:, :, None] * np.eye(given.shape[1])
        step = np.linalg.solve(damped, slope)[..., 0]
        tried = given + step
        tried[:, blur] = np.clip(tried[:, blur], _LEAST_BLUR_PX, _MOST_BLUR_PX)
        new_level, new_derivative = model(tried, pixels)
        new_rest = (grey - new_level) * usable
        new_cost = (new_rest**2).sum(axis=1)
        better = new_cost <= cost
        given = np.where(better[:, None], tried, given)
        rest = np.where(better[:, None], new_rest, rest)
        derivative = np.where(better[:, None, None], new_derivative, derivative)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-9, 1e6)
        settled |= (better & (np.abs(step[:, :2]) < _SETTLED_PX).all(axis=1)) | (damping > _STUCK)
        if settled.all():
            break
    weighted = derivative * usable[..., None]
    freedom = usable.sum(axis=1) - given.shape[1]
    variance = cost / np.maximum(freedom, 1)
    normal = np.matmul(weighted.transpose(0, 2, 1), weighted)
    # Scaled, so that a grey level and a pixel do not have to share one unit.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-30))
    inverse = np.linalg.pinv(normal / scale[:, :, None] / scale[:, None, :], hermitian=True)
    spread = np.einsum("nii->ni", inverse)[:, :2] / scale[:, :2] ** 2
    sigma = np.sqrt(variance * spread.mean(axis=1))
    moved = np.hypot(given[:, 0], given[:, 1])
    sigma = np.where((freedom > given.shape[1]) & (moved <= 0.5 * half_px), sigma, np.nan)
    return FittedPlaces(start_px + given[:, :2], sigma, given[:, blur], np.sqrt(variance)), given
