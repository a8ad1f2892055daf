"""Corners and circles to a hundredth of a pixel: a model of the blurred print, fitted to each one's own pixels.

A corner is where two straight edges cross. With d1, d2 the distances of a pixel from the edges and s the blur,

    I = b + b' . r + (a + a' . r) erf(d1 / (sqrt(2) s)) erf(d2 / (sqrt(2) s)),    r = the pixel's place from the start,

exact for a Gaussian blur and edges at right angles. Edges that meet at another angle change I by a term that is the
same at r and -r about the corner, so the corner's place stays. A circle is an ellipse |Q (p - c)| = 1,

    I = b + b' . r + (a + a' . r) erf(d / (sqrt(2) s)),    d = (|Q (p - c)| - 1) / |gradient of |Q (p - c)||.

Both are least squares by Levenberg and Marquardt; the covariance of a place is e^2 (J^T J)^-1 with e^2 the fit's own
mean squared residual, so that noise, slope of the edges and whatever the model does not say all are in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from slrig.model import FloatArray

_TURNS = 20
_SETTLED_PX = 1e-4
_STUCK = 1e4
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.25, 20.0
_ROOT_2 = float(np.sqrt(2))
_SLOPE = float(np.sqrt(2 / np.pi))

Model = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From parameters (n, k) and pixels (n, m, 2) to grey levels (n, m) and their derivatives (n, m, k)."""


@dataclass(frozen=True, slots=True)
class FittedPlaces:
    """Places that were fitted. points_px : (n, 2) float64; sigma_px : (n,) float64, NaN where the fit failed;
    blur_px : (n,) float64, the standard deviation of the blur, the pixel's own extent included.
    """

    points_px: FloatArray
    sigma_px: FloatArray
    blur_px: FloatArray


def patch_offsets(half_px: int) -> NDArray[np.int64]:
    """(m, 2) int64: (x, y) of the pixels of a square patch from its middle."""
    reach = np.arange(-half_px, half_px + 1)
    x, y = np.meshgrid(reach, reach)
    return np.column_stack([x.ravel(), y.ravel()])


def fitted_corners(
    image: FloatArray, start_px: FloatArray, edges: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int
) -> FittedPlaces:
    """Corners where two edges cross.

    image : (H, W) float64; start_px : (n, 2) float64, within two pixels or so; edges : (n, 2, 2) float64, the
    directions of the two edges at each, rows; usable : (n, m) bool, which pixels of the patch of `half_px` about the
    nearest pixel belong to the four squares that meet there.
    """
    pixels, grey, usable = _patches(image, start_px, usable, half_px)
    normal = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    angles = np.arctan2(normal[..., 1], normal[..., 0])
    zero = np.zeros((len(start_px), 1))
    level = _mean(grey, usable)[:, None]
    start = np.hstack([zero, zero, angles, zero + 1.0, level, zero, zero, zero, zero, zero])
    start[:, 8] = _amplitude(_corner_model, start, 8, pixels, grey, usable)
    return _fitted(_corner_model, start, pixels, grey, usable, start_px, reach_px=0.5 * half_px)


def fitted_circles(
    image: FloatArray, start_px: FloatArray, shape: FloatArray, usable: NDArray[np.bool_], /, *, half_px: int
) -> tuple[FittedPlaces, FloatArray]:
    """Centres of the ellipses that circles look like, and their shapes.

    shape : (n, 2, 2) float64, symmetric: |shape @ (p - centre)| = 1 on the outline. The other arguments are those of
    `fitted_corners`. Returns the places and the fitted shapes, (n, 2, 2) float64. An ellipse's centre is not where the
    circle's centre is seen: see `slrig.calibration.boards.circles`.
    """
    pixels, grey, usable = _patches(image, start_px, usable, half_px)
    zero = np.zeros((len(start_px), 1))
    level = _mean(grey, usable)[:, None]
    upper = shape[:, [0, 0, 1], [0, 1, 1]]
    start = np.hstack([zero, zero, upper, zero + 1.0, level, zero, zero, zero, zero, zero])
    start[:, 9] = _amplitude(_circle_model, start, 9, pixels, grey, usable)
    solved = _solved(_circle_model, start, pixels, grey, usable, blur=5)
    places = _places(_circle_model, solved, pixels, grey, usable, start_px, blur=5, reach_px=0.5 * half_px)
    q = solved
    return places, np.stack([q[:, [2, 3]], q[:, [3, 4]]], axis=1)


def _fitted(
    model: Model,
    start: FloatArray,
    pixels: FloatArray,
    grey: FloatArray,
    usable: NDArray[np.bool_],
    start_px: FloatArray,
    *,
    reach_px: float,
) -> FittedPlaces:
    solved = _solved(model, start, pixels, grey, usable, blur=4)
    return _places(model, solved, pixels, grey, usable, start_px, blur=4, reach_px=reach_px)


def _corner_model(given: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, two angles of the normals, blur, b, b'x, b'y, a, a'x, a'y."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - given[:, :1], y - given[:, 1:2]
    blur = given[:, 4:5]
    rises, slopes, turned, distances, normals = [], [], [], [], []
    for angle in (given[:, 2:3], given[:, 3:4]):
        cosine, sine = np.cos(angle), np.sin(angle)
        distance = cosine * off_x + sine * off_y
        scaled = distance / blur
        rises.append(erf(scaled / _ROOT_2))
        slopes.append(_SLOPE / blur * np.exp(-0.5 * scaled**2))
        turned.append(-sine * off_x + cosine * off_y)
        distances.append(scaled)
        normals.append((cosine, sine))
    step = given[:, 8:9] + given[:, 9:10] * x + given[:, 10:11] * y
    both = rises[0] * rises[1]
    by_first, by_second = step * slopes[0] * rises[1], step * slopes[1] * rises[0]
    one = np.ones_like(x)
    derivative = np.stack(
        [
            -(by_first * normals[0][0] + by_second * normals[1][0]),
            -(by_first * normals[0][1] + by_second * normals[1][1]),
            by_first * turned[0],
            by_second * turned[1],
            -(by_first * distances[0] + by_second * distances[1]),
            one,
            x,
            y,
            both,
            both * x,
            both * y,
        ],
        axis=-1,
    )
    return given[:, 5:6] + given[:, 6:7] * x + given[:, 7:8] * y + step * both, derivative


def _circle_model(given: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters: x, y, Q's three numbers, blur, b, b'x, b'y, a, a'x, a'y."""
    x, y = pixels[..., 0], pixels[..., 1]
    off_x, off_y = x - given[:, :1], y - given[:, 1:2]
    q_xx, q_xy, q_yy = given[:, 2:3], given[:, 3:4], given[:, 4:5]
    across, down = q_xx * off_x + q_xy * off_y, q_xy * off_x + q_yy * off_y
    radius = np.maximum(np.hypot(across, down), 1e-6)
    slope_x, slope_y = (q_xx * across + q_xy * down) / radius, (q_xy * across + q_yy * down) / radius
    steep = np.maximum(np.hypot(slope_x, slope_y), 1e-9)
    blur = given[:, 5:6]
    scaled = (radius - 1) / steep / blur
    rise = erf(scaled / _ROOT_2)
    step = given[:, 9:10] + given[:, 10:11] * x + given[:, 11:12] * y
    by_distance = step * _SLOPE / blur * np.exp(-0.5 * scaled**2)
    one = np.ones_like(x)
    derivative = np.stack(
        [
            -by_distance * slope_x / steep,
            -by_distance * slope_y / steep,
            by_distance * across * off_x / radius / steep,
            by_distance * (across * off_y + down * off_x) / radius / steep,
            by_distance * down * off_y / radius / steep,
            -by_distance * scaled,
            one,
            x,
            y,
            rise,
            rise * x,
            rise * y,
        ],
        axis=-1,
    )
    return given[:, 6:7] + given[:, 7:8] * x + given[:, 8:9] * y + step * rise, derivative


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


def _amplitude(
    model: Model, start: FloatArray, which: int, pixels: FloatArray, grey: FloatArray, usable: NDArray[np.bool_]
) -> FloatArray:
    """The step's height that fits best while all else is as at the start."""
    _, derivative = model(start, pixels)
    unit = derivative[..., which] * usable
    unit -= _mean(unit, usable)[:, None] * usable
    return np.asarray((unit * grey).sum(axis=1) / np.maximum((unit**2).sum(axis=1), 1e-12))


def _solved(
    model: Model, start: FloatArray, pixels: FloatArray, grey: FloatArray, usable: NDArray[np.bool_], *, blur: int
) -> FloatArray:
    """Parameters (n, k) after Levenberg and Marquardt, every patch with its own damping."""
    given = start.copy()
    damping = np.full(len(start), 1e-3)
    settled = np.zeros(len(start), dtype=bool)
    level, derivative = model(given, pixels)
    rest = (grey - level) * usable
    cost = (rest**2).sum(axis=1)
    for _ in range(_TURNS):
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
    return given


def _places(
    model: Model,
    solved: FloatArray,
    pixels: FloatArray,
    grey: FloatArray,
    usable: NDArray[np.bool_],
    start_px: FloatArray,
    *,
    blur: int,
    reach_px: float,
) -> FittedPlaces:
    level, derivative = model(solved, pixels)
    weighted = derivative * usable[..., None]
    freedom = usable.sum(axis=1) - solved.shape[1]
    variance = (((grey - level) * usable) ** 2).sum(axis=1) / np.maximum(freedom, 1)
    normal = np.matmul(weighted.transpose(0, 2, 1), weighted)
    # Scaled, so that a grey level and a pixel do not have to share one unit.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-30))
    inverse = np.linalg.pinv(normal / scale[:, :, None] / scale[:, None, :], hermitian=True)
    spread = np.einsum("nii->ni", inverse)[:, :2] / scale[:, :2] ** 2
    sigma = np.sqrt(variance * spread.mean(axis=1))
    moved = np.hypot(solved[:, 0], solved[:, 1])
    sigma = np.where((freedom > solved.shape[1]) & (moved <= reach_px), sigma, np.nan)
    return FittedPlaces(start_px + solved[:, :2], sigma, solved[:, blur])
