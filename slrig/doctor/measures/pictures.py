"""How a projector's picture lies in a camera's image, and how sharp it is there.

How a projector's picture lies in a camera's image: mirrored, turned, and how large.

Projector position (column, row) over camera pixel (x, y) is close to an affine map. A camera and a projector that look
at the same side of a surface both have x to the right and y down, so the map's determinant is positive, however either
of them is turned; it is negative where one of the two pictures is mirrored.

How blurred projected bars and seen edges are, as the standard deviation of a Gaussian.

Bars of a period P, half of it lit, shown with their inverse: their difference over white − black is a square wave of
±1, and its mean square G falls with the blur σ of everything between projector and pixel,

    G(σ/P) = Σ over odd k of 8/(π k)² · exp(−(2π k σ/P)²),

whatever the surface's albedo and the place of the pixels within the bars. The blur of both lenses and of the camera's
square pixels (variance 1/12) add up in σ². Edges in the white frame (print, texture, an object before another) have the
camera's part alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Pinhole

_FEWEST_PIXELS = 50
_TRIMMED = 0.8
_ROUNDS = 4
_FEWEST_EDGES = 40
_BEST_SQUARE = 0.6
_LEAST_SQUARE, _MOST_SQUARE = 0.02, 0.985
_REACH_PX = 12.0
_STEP_PX = 0.25
_MOST_EDGES = 6000
_CLEAR = 12.0
_CLEAN = 1.25
_EVEN = 0.05
_LOW, _HIGH = 0.2, 0.8
_CROSSING_SIGMAS = 1.6832  # between a fifth and four fifths of a Gaussian's integral
_SHARPEST = 20.0


@dataclass(frozen=True, slots=True)
class Orientation:
    """The affine map from camera to projector. jacobian : (2, 2) float64, d(column, row)/d(x, y)."""

    jacobian: FloatArray

    @property
    def mirrored(self) -> bool:
        """Whether one of the two pictures is a mirror image."""
        return bool(np.linalg.det(self.jacobian) < 0)

    @property
    def camera_px(self) -> float:
        """How many camera pixels one projector pixel is long, on average over directions."""
        return float(abs(np.linalg.det(self.jacobian)) ** -0.5)

    @property
    def turn_deg(self) -> float:
        """By how much the picture is turned in the image, −180 to 180, clockwise; that of its rows if mirrored.

        The direction in the image in which projector columns grow.
        """
        across = np.linalg.inv(self.jacobian)[:, 0]
        return math.degrees(math.atan2(across[1], across[0]))


def orientation(column_px: FloatArray, row_px: FloatArray, known: NDArray[np.bool_]) -> Orientation | None:
    """Fit the map by least squares, leaving out the fifth of the pixels that it fits worst; None where it is not told.

    column_px, row_px : (H, W) float64, the projector position that each camera pixel shows, where it is `known`.
    """
    y, x = np.nonzero(known)
    if len(x) < _FEWEST_PIXELS:
        return None
    seen = np.column_stack([column_px[y, x], row_px[y, x]])
    base = np.column_stack([np.ones(len(x)), x, y])
    kept = np.ones(len(x), np.bool_)
    weights = np.zeros((3, 2))
    for _ in range(_ROUNDS):
        weights = np.asarray(np.linalg.lstsq(base[kept], seen[kept], rcond=None)[0], np.float64)
        off = np.linalg.norm(base @ weights - seen, axis=1)
        kept = off <= np.quantile(off, _TRIMMED)
    jacobian = np.asarray(weights[1:].T, np.float64)
    if np.linalg.matrix_rank(jacobian, tol=1e-3) != 2:
        return None
    return Orientation(jacobian)


def expected_orientation(camera: Pinhole, projector: Pinhole) -> Orientation | None:
    """Return the map that a calibration foresees for a surface that faces both devices; None if they never meet.

    The surface stands where the optical axes come nearest to each other, across the direction between them. Lens
    distortion is left out: it turns nothing.
    """
    between = camera.rotation[2] + projector.rotation[2]
    if np.linalg.norm(between) < 1e-6:
        return None
    normal = np.asarray(between / np.linalg.norm(between), np.float64)
    meeting = _meeting(camera, projector)
    if meeting is None:
        meeting = np.asarray(camera.centre_mm + 1000.0 * camera.rotation[2], np.float64)
    pixel = _image_of(camera, meeting)
    if pixel is None:
        return None
    hits = [
        _image_of(projector, _met(camera, pixel + step, meeting, normal)) for step in np.array([[0, 0], [1, 0], [0, 1]])
    ]
    if any(hit is None for hit in hits):
        return None
    origin, right, down = (np.asarray(hit, np.float64) for hit in hits)
    return Orientation(np.column_stack([right - origin, down - origin]))


def depth_mm_per_px(camera: Pinhole, projector: Pinhole) -> float:
    """Return how far a point moves that is triangulated one camera pixel beside its column, where the axes meet.

    NaN where they do not meet: nothing says at which distance the rig works. Lens distortion is left out.
    """
    meeting = _meeting(camera, projector)
    pixel = None if meeting is None else _image_of(camera, meeting)
    if meeting is None or pixel is None:
        return float("nan")
    # The sheet of light of the column through the point: it holds the projector's own vertical, and its centre.
    ray = meeting - projector.centre_mm
    sheet = np.cross(ray, projector.rotation[1])
    sheet = np.asarray(sheet / np.linalg.norm(sheet), np.float64)
    return float(np.linalg.norm(_met(camera, pixel + np.array([1.0, 0.0]), meeting, sheet) - meeting))


def _meeting(camera: Pinhole, projector: Pinhole) -> FloatArray | None:
    """The point with the least sum of squared distances from both axes; None where they are parallel."""
    axes = [(device.rotation[2], device.centre_mm) for device in (camera, projector)]
    projections = [np.eye(3) - np.outer(axis, axis) for axis, _ in axes]
    matrix = projections[0] + projections[1]
    if np.linalg.cond(matrix) >= 1e6:
        return None
    target = sum((each @ centre for each, (_, centre) in zip(projections, axes, strict=True)), np.zeros(3))
    return np.asarray(np.linalg.solve(matrix, target), np.float64)


def apart_deg(one: Orientation, other: Orientation) -> float:
    """The angle between two turns, 0 to 180."""
    return abs((one.turn_deg - other.turn_deg + 180) % 360 - 180)


def _image_of(device: Pinhole, point_mm: FloatArray) -> FloatArray | None:
    seen = device.matrix @ (device.rotation @ point_mm + device.translation_mm)
    return None if seen[2] <= 0 else np.asarray(seen[:2] / seen[2], np.float64)


def _met(camera: Pinhole, pixel: FloatArray, point_mm: FloatArray, normal: FloatArray) -> FloatArray:
    ray = camera.rotation.T @ np.linalg.solve(camera.matrix, np.array([*pixel, 1.0]))
    distance = normal @ (point_mm - camera.centre_mm) / (normal @ ray)
    return np.asarray(camera.centre_mm + distance * ray, np.float64)


@dataclass(frozen=True, slots=True)
class BarContrast:
    """What bars of one period show. period_px : projector pixels. square : G of the module; noise is taken out."""

    period_px: float
    square: float


def bar_contrast(difference: FloatArray, contrast: FloatArray, *, noise_dn: float, period_px: float) -> BarContrast:
    """Return G over given pixels: bit − inverse and white − black, (n,) DN; noise_dn is that of one frame."""
    power = float(np.mean(difference**2)) - 2 * noise_dn**2
    return BarContrast(period_px, power / float(np.mean(contrast**2)))


def bar_blur_px(bars: Sequence[BarContrast]) -> float | None:
    """Return σ in projector pixels from the bars that tell it best; inf where even the widest are gone.

    None where even the finest are sharp: σ is less than a fiftieth or so of their period.

    >>> round(bar_blur_px([BarContrast(16.0, square_left(1.5 / 16)), BarContrast(64.0, square_left(1.5 / 64))]), 3)
    1.5
    """
    tell = [each for each in bars if _LEAST_SQUARE < each.square < _MOST_SQUARE]
    if not tell:
        return None if all(each.square >= _MOST_SQUARE for each in bars) else float("inf")
    best = min(tell, key=lambda each: abs(each.square - _BEST_SQUARE))
    shares = np.geomspace(1e-3, 1.0, 4000)
    left = np.array([square_left(float(share)) for share in shares])
    return best.period_px * float(np.interp(-best.square, -left, shares))


def square_left(blur_over_period: float) -> float:
    """G of the module.

    >>> round(square_left(0.0), 3)
    1.0
    """
    odd = np.arange(1, 2001, 2)
    return float(np.sum(8 / (np.pi * odd) ** 2 * np.exp(-((2 * np.pi * odd * blur_over_period) ** 2))))


@dataclass(frozen=True, slots=True)
class EdgeBlur:
    """The blur of the sharpest edges in an image, pixels, the pixel's own included; from how many clear edge points."""

    sigma_px: float
    edges: int


def edge_blur(image: FloatArray, asked: NDArray[np.bool_], *, noise_dn: float) -> EdgeBlur | None:
    """Return how sharp the sharpest fifth of clear, lone edges in an image is; None where there are too few.

    image : (H, W) float64, DN. asked : (H, W) bool, where edges count. noise_dn : of the image.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    down, right = np.gradient(smooth)
    slope = np.hypot(right, down)
    # A Gaussian of 1 px leaves a third of the noise, and differences take their part of that.
    floor = max(_CLEAR * noise_dn * 0.2, 0.02 * float(np.ptp(smooth)) / _REACH_PX)
    rows, columns = np.nonzero(_ridges(slope, right, down) & asked & (slope > floor))
    if len(rows) < _FEWEST_EDGES:
        return None
    chosen = np.random.default_rng(0).permutation(len(rows))[:_MOST_EDGES]
    rows, columns = rows[chosen], columns[chosen]
    along = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    unit_x, unit_y = right[rows, columns] / slope[rows, columns], down[rows, columns] / slope[rows, columns]
    at_x = (columns[:, None] + along * unit_x[:, None]).astype(np.float32)
    at_y = (rows[:, None] + along * unit_y[:, None]).astype(np.float32)
    height, width = image.shape
    inside = ((at_x >= 1) & (at_x <= width - 2) & (at_y >= 1) & (at_y <= height - 2)).all(axis=1)
    if np.count_nonzero(inside) < _FEWEST_EDGES:
        return None
    profiles = cv2.remap(image.astype(np.float32), at_x[inside], at_y[inside], cv2.INTER_CUBIC).astype(np.float64)
    widths = _widths(profiles, along, noise_dn)
    if len(widths) < _FEWEST_EDGES:
        return None
    return EdgeBlur(float(np.percentile(widths, _SHARPEST)), len(widths))


def _ridges(slope: FloatArray, right: FloatArray, down: FloatArray) -> NDArray[np.bool_]:
    """(H, W) bool: steeper than both neighbours across the edge, along the nearer axis."""
    steep = np.pad(slope, 1)
    beside = (slope >= steep[1:-1, :-2]) & (slope > steep[1:-1, 2:])
    above = (slope >= steep[:-2, 1:-1]) & (slope > steep[2:, 1:-1])
    return np.where(np.abs(right) >= np.abs(down), beside, above)


def _widths(profiles: FloatArray, along: FloatArray, noise_dn: float) -> FloatArray:
    """(n,) float64: σ of the profiles that are one clear step between two even sides. profiles : (m, k) float64."""
    side = round(2.0 / _STEP_PX)
    low, high = profiles[:, :side].mean(axis=1), profiles[:, -side:].mean(axis=1)
    step = high - low
    travel = np.abs(np.diff(profiles[:, :: side // 2], axis=1)).sum(axis=1)
    noise_travel = 1.1 * noise_dn * (profiles.shape[1] // (side // 2))
    tilt = np.maximum(_spread(profiles[:, :side]), _spread(profiles[:, -side:]))
    clean = (step > _CLEAR * noise_dn) & (travel < _CLEAN * step + noise_travel) & (tilt < _EVEN * step + noise_dn)
    risen = np.maximum.accumulate((profiles[clean] - low[clean, None]) / step[clean, None], axis=1)
    return (_crossing(risen, along, _HIGH) - _crossing(risen, along, _LOW)) / _CROSSING_SIGMAS


def _spread(side: FloatArray) -> FloatArray:
    """(n,) float64: how far one end of a profile's side (n, k) rises or falls, by its halves."""
    half = side.shape[1] // 2
    return np.asarray(2 * np.abs(side[:, half:].mean(axis=1) - side[:, :half].mean(axis=1)), np.float64)


def _crossing(risen: FloatArray, along: FloatArray, share: float) -> FloatArray:
    """(n,) float64: where each of the rising profiles (n, k) passes `share`."""
    after = np.clip(np.argmax(risen > share, axis=1), 1, None)
    row = np.arange(len(risen))
    below, above = risen[row, after - 1], risen[row, after]
    part = np.divide(share - below, above - below, out=np.zeros_like(below), where=above > below)
    return np.asarray(along[after] - _STEP_PX * (1 - part), np.float64)
