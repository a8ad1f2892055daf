"""Measurements in frames, on arrays: exposure, response to grey values, orientation, blur and halos.

Orientation. Projector position (column, row) over camera pixel (x, y) is nearly an affine map. A camera and a projector
on the same side of a surface both have x to the right and y down, so the determinant of the map is positive for every
rotation of either of them; it is negative if one of the two pictures is mirrored.

Blur, as the standard deviation of a Gaussian. Bars of a period P, half of it lit, are shown with their inverse: their
difference over white − black is a square wave of ±1, and its mean square G falls with the blur σ of everything between
projector and pixel,

    G(σ/P) = Σ over odd k of 8/(π k)² · exp(−(2π k σ/P)²),

independent of the surface's albedo and of the phase of the pixels within the bars. The blur of both lenses and of the
camera's square pixels (variance 1/12) add up in σ². Edges in the white frame (print, texture, an object before another)
have the camera's part alone.

Halos. Light adds up, and lenses only spread it, so across an edge of a projected bar the picture rises from dark to
bright and never beyond either. Sharpening does exceed them: it subtracts a blurred copy, so the bright side of an edge
gets brighter than white and the dark side darker than black, some pixels from the edge. Let d be the frame of a Gray
bit less that of its inverse, over white less black: d goes from −1 to 1 at an edge of wide bars, and its excess over
the level farther away is the overshoot. White less black cancels the albedo. The level of the same bar as reference
cancels stray light and changes of the lamp between frames. A curve between light and grey levels keeps the order of
levels, so it makes no halo. The median over many profiles across edges of both directions cancels noise and print on
the object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Pinhole, Pixels

_HALO_REACH_PX = 14
_LEVEL_FROM_PX = 9.0
_SAMPLES_PER_PX = 4
_MIN_PROFILES = 100
_MAX_PROFILES = 20_000

MIN_SNR = 10.0
"""White less black over noise, median of the lit pixels: with less, stripes and codes get lost."""

MAX_WHITE_SHARE = 0.9
"""Share of full scale that the brightest lit pixels reach in a good exposure."""

_MIN_CONTRAST_DN = 2.0
_MIN_CONTRAST_SNR = 6.0
_MIN_CONTRAST_SHARE = 0.1
_BRIGHT_PERCENTILE = 99.0
_ROUNDING_VARIANCE = 1 / 12

_MIN_CODED_PIXELS = 50
_KEPT_QUANTILE = 0.8
_FIT_ROUNDS = 4
_MIN_EDGES = 40
_BEST_SQUARE = 0.6
_MIN_SQUARE, _MAX_SQUARE = 0.02, 0.985
_EDGE_REACH_PX = 12.0
_EDGE_STEP_PX = 0.25
_MAX_EDGES = 6000
_MIN_EDGE_SNR = 12.0
_MAX_TRAVEL = 1.25
_MAX_SIDE_DRIFT = 0.05
_LOW_CROSSING, _HIGH_CROSSING = 0.2, 0.8
_CROSSING_SIGMAS = 1.6832  # between a fifth and four fifths of a Gaussian's integral
_SHARPEST_PERCENTILE = 20.0


@dataclass(frozen=True, slots=True)
class Halo:
    """Overshoot at edges that a camera sharpens.

    overshoot ± error : excess over the level next to an edge, as a share of the step; standard error.
    reach_px : distance of its maximum from the edge. slope_per_px : of the edge, share of the step per pixel.
    profiles : number of profiles.
    """

    overshoot: float
    error: float
    reach_px: float
    slope_per_px: float
    profiles: int

    @property
    def shift_px(self) -> float:
        """Lower limit of the shift of a stripe next to print that changes the brightness threefold, at the worst place.

        A halo moves another edge of the same step by overshoot over slope. White less black has a halo too where print
        changes, which increases that at least 1.8 times: the lowest factor in simulated images.
        """
        return 1.8 * self.overshoot / self.slope_per_px


def measure_halo(signals: Iterable[FloatArray], usable: NDArray[np.bool_]) -> Halo | None:
    """Return the halo at edges of bars; None if too few edges are far enough from others.

    signals : (H, W) float64 each, d of the module for one bit; edges along rows and along columns count.
    usable : (H, W) bool, pixels that are lit and not saturated.
    """
    profiles = np.concatenate(
        [
            np.zeros((0, 2 * _HALO_REACH_PX * _SAMPLES_PER_PX + 1)),
            *(
                _edge_profiles(turned, mask)
                for each in signals
                for turned, mask in ((each, usable), (each.T, usable.T))
            ),
        ]
    )
    if len(profiles) < _MIN_PROFILES:
        return None
    profiles = profiles[np.random.default_rng(0).permutation(len(profiles))[:_MAX_PROFILES]]
    # The mean of both sides: a halo that is clipped on one side counts half.
    median = np.median(profiles, axis=0)
    rise = 0.5 * (median - median[::-1])
    offset_px = np.linspace(-_HALO_REACH_PX, _HALO_REACH_PX, len(rise))
    is_far = offset_px >= _LEVEL_FROM_PX
    level = float(rise[is_far].mean())
    is_near = (offset_px > 0) & ~is_far
    peak = int(np.argmax(np.where(is_near, rise, -np.inf)))
    # Standard error of a median of normal noise.
    error = 1.25 * float(profiles[:, peak].std()) / len(profiles) ** 0.5
    slope = float(np.gradient(rise, offset_px)[len(rise) // 2])
    if level <= 0 or slope <= 0:
        return None
    overshoot = max(float(rise[peak]) / level - 1, 0.0) / 2
    return Halo(overshoot, error / level / 2, float(offset_px[peak]), slope / level / 2, len(profiles))


def _edge_profiles(signal: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    """(n, k) float64: the signal along rows around each change of its sign, rising, with no other change in reach."""
    width = signal.shape[1]
    is_crossing = (signal[:, :-1] * signal[:, 1:] < 0) & usable[:, :-1] & usable[:, 1:]
    rows, columns = np.nonzero(is_crossing)
    inside = (columns >= _HALO_REACH_PX + 1) & (columns < width - _HALO_REACH_PX - 2)
    rows, columns = rows[inside], columns[inside]
    if not len(rows):
        return np.zeros((0, 2 * _HALO_REACH_PX * _SAMPLES_PER_PX + 1))
    window = columns[:, None] + np.arange(-_HALO_REACH_PX - 1, _HALO_REACH_PX + 3)
    is_isolated = usable[rows[:, None], window].all(axis=1) & (
        is_crossing[rows[:, None], window[:, :-1]].sum(axis=1) == 1
    )
    rows, columns, window = rows[is_isolated], columns[is_isolated], window[is_isolated]
    values = signal[rows[:, None], window]
    before, after = signal[rows, columns], signal[rows, columns + 1]
    fraction = before / (before - after)
    # Linear interpolation flattens a halo a little, and makes none.
    offsets = np.linspace(-_HALO_REACH_PX, _HALO_REACH_PX, 2 * _HALO_REACH_PX * _SAMPLES_PER_PX + 1)
    positions = _HALO_REACH_PX + 1 + fraction[:, None] + offsets
    lower = np.clip(np.floor(positions).astype(int), 0, values.shape[1] - 2)
    weight = positions - lower
    each_row = np.arange(len(values))[:, None]
    sampled = values[each_row, lower] * (1 - weight) + values[each_row, lower + 1] * weight
    return np.asarray(sampled * np.sign(after)[:, None], np.float64)


@dataclass(frozen=True, slots=True)
class LightLevels:
    """Means of white and black frames of one camera, and their derived values, in digital numbers (DN).

    black, white, contrast : (H, W) float64; contrast is white − black. lit : (H, W) bool, where white exceeds black by
    more than noise and by a tenth of the bright pixels' contrast: glow and reflections are weaker. usable : lit and
    never saturated, which is at full scale. noise_dn : standard deviation of one white frame, from the usable pixels.
    bright_dn : the 99th percentile of white where it is lit, or of the whole image if nothing is.
    saturated_share : of the lit pixels. black_saturated_share : of all pixels, in black frames.
    """

    black: FloatArray
    white: FloatArray
    contrast: FloatArray
    lit: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    noise_dn: float
    bright_dn: float
    saturated_share: float
    black_saturated_share: float
    full_scale: int

    @property
    def lit_share(self) -> float:
        """Share of the image that the projector lights."""
        return float(self.lit.mean())

    @property
    def contrast_dn(self) -> float:
        """Median of white − black over the lit pixels; NaN if there are none."""
        return float(np.median(self.contrast[self.lit])) if self.lit.any() else float("nan")

    @property
    def ambient_dn(self) -> float:
        """Median of the black frame over the lit pixels; NaN if there are none."""
        return float(np.median(self.black[self.lit])) if self.lit.any() else float("nan")

    @property
    def snr(self) -> float:
        """Contrast over noise."""
        return self.contrast_dn / self.noise_dn

    @property
    def lit_box(self) -> tuple[int, int, int, int]:
        """First and last row, first and last column of the lit part, without its outer hundredth on each side."""
        rows, columns = np.nonzero(self.lit)
        top, bottom = np.percentile(rows, (1, 99))
        left, right = np.percentile(columns, (1, 99))
        return round(top), round(bottom), round(left), round(right)

    def relative_level(self, image: Pixels, exponent: float = 1.0) -> float:
        """Return the position of an image between black, 0, and white, 1, over the usable pixels. exponent : of the
        camera, whose values grow with the light to that power.
        """
        level, black, white = (each[self.usable] ** (1 / exponent) for each in (image, self.black, self.white))
        return float((level - black).sum() / (white - black).sum())

    def longest_exposure_s(self, exposure_s: float) -> float:
        """Return the exposure at which the brightest lit pixels reach MAX_WHITE_SHARE of full scale, from this
        exposure.

        The sensor is taken as linear. A saturated frame gives an upper limit only: half of its exposure is returned.
        """
        if self.saturated_share > 0.005 or self.black_saturated_share > 0.005:
            return exposure_s / 2
        return exposure_s * MAX_WHITE_SHARE * self.full_scale / max(self.bright_dn, 1.0)

    def shortest_exposure_s(self, exposure_s: float) -> float:
        """Return the exposure with MIN_SNR, from this exposure and its noise: an upper limit."""
        return exposure_s * MIN_SNR / max(self.snr, 1e-3)


def light_levels(white: Sequence[Pixels], black: Sequence[Pixels], *, full_scale: int) -> LightLevels:
    """Return the levels of two or more (H, W) frames of steady white and of steady black each."""
    dark, bright = np.stack(black).astype(np.float64), np.stack(white).astype(np.float64)
    mean_dark, mean_bright = dark.mean(axis=0), bright.mean(axis=0)
    contrast = mean_bright - mean_dark
    variance = dark.var(axis=0, ddof=1) / len(dark) + bright.var(axis=0, ddof=1) / len(bright)
    noise_dn = float(np.sqrt(np.mean(variance) + _ROUNDING_VARIANCE))
    threshold = max(
        _MIN_CONTRAST_DN, _MIN_CONTRAST_SNR * noise_dn, _MIN_CONTRAST_SHARE * float(np.percentile(contrast, 99.5))
    )
    lit = np.asarray(contrast > threshold, np.bool_)
    saturated = np.asarray((bright >= full_scale).any(axis=0), np.bool_)
    usable = lit & ~saturated
    white_variance = bright.var(axis=0, ddof=1)[usable if usable.any() else lit if lit.any() else np.ones_like(lit)]
    return LightLevels(
        black=mean_dark,
        white=mean_bright,
        contrast=contrast,
        lit=lit,
        usable=usable,
        noise_dn=float(np.sqrt(white_variance.mean() + _ROUNDING_VARIANCE)),
        bright_dn=float(np.percentile(mean_bright[lit] if lit.any() else mean_bright, _BRIGHT_PERCENTILE)),
        saturated_share=float(np.mean(saturated[lit])) if lit.any() else 0.0,
        black_saturated_share=float(np.mean(mean_dark >= full_scale)),
        full_scale=full_scale,
    )


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """Light of grey values, by the law ((value − black_knee)/(white_knee − black_knee))^gamma between the knees.

    values : (n,) float64, 0 to 255, rising. light : (n,) float64, never falling, 0 for black and 1 for white. Values
    below black_knee are all black, those above white_knee all white. residual : rms of the measured light from the law.
    reversal : the largest fall of measured light from one value to a higher one. A camera's curve is undone as far as
    it is a power of the exposure.
    """

    values: FloatArray
    light: FloatArray
    gamma: float
    black_knee: float
    white_knee: float
    residual: float
    reversal: float


def fit_response_curve(values: Sequence[float], light: Sequence[float]) -> ResponseCurve:
    """Fit the curve through measured light, 0 for black and 1 for white, of rising grey values, 5 or more.

    >>> curve = fit_response_curve(range(0, 256, 15), [(v / 255) ** 2.2 for v in range(0, 256, 15)])
    >>> round(curve.gamma, 3), round(abs(curve.black_knee), 1), round(curve.white_knee, 1)
    (2.2, 0.0, 255.0)
    """
    # Together they take a second to import, and are needed here only.
    from scipy.optimize import isotonic_regression, least_squares

    grey, measured = np.asarray(values, np.float64), np.asarray(light, np.float64)
    monotone = np.asarray(isotonic_regression(measured).x, np.float64)

    def residuals(law: FloatArray) -> FloatArray:
        return np.asarray(_response_law(grey, *law) - measured, np.float64)

    starts = [(gamma, 2.0, 253.0) for gamma in (0.6, 1.0, 2.2)]
    fits = [
        least_squares(residuals, start, bounds=([0.2, 0.0, 140.0], [5.0, 110.0, 255.0]), x_scale=(1, 50, 50))
        for start in starts
    ]
    best = min(fits, key=lambda fit: float(fit.cost))
    gamma, black_knee, white_knee = (float(each) for each in best.x)
    return ResponseCurve(
        values=grey,
        light=monotone,
        gamma=gamma,
        black_knee=black_knee,
        white_knee=white_knee,
        residual=float(np.sqrt(np.mean(np.square(best.fun)))),
        reversal=float(max(np.max(np.maximum.accumulate(measured) - measured), 0.0)),
    )


def fit_camera_exponent(exposures_s: Sequence[float], contrast_dn: Sequence[float]) -> float:
    """Return the exponent by which values above black grow with the exposure: 1 for a linear camera.

    >>> round(fit_camera_exponent([0.001, 0.002, 0.004], [10.0, 20.0, 40.0]), 6)
    1.0
    """
    return float(np.polyfit(np.log(exposures_s), np.log(contrast_dn), 1)[0])


def _response_law(values: FloatArray, gamma: float, black_knee: float, white_knee: float) -> FloatArray:
    inside = np.clip((values - black_knee) / (white_knee - black_knee), 0.0, 1.0)
    return np.asarray(inside**gamma, np.float64)


@dataclass(frozen=True, slots=True)
class Orientation:
    """Affine map from camera to projector. jacobian : (2, 2) float64, d(column, row)/d(x, y)."""

    jacobian: FloatArray

    @property
    def is_mirrored(self) -> bool:
        """True if one of the two pictures is a mirror image."""
        return bool(np.linalg.det(self.jacobian) < 0)

    @property
    def camera_px(self) -> float:
        """Length of one projector pixel in camera pixels, mean over directions."""
        return float(abs(np.linalg.det(self.jacobian)) ** -0.5)

    @property
    def turn_deg(self) -> float:
        """Direction in the image in which projector columns grow, −180 to 180, clockwise."""
        across = np.linalg.inv(self.jacobian)[:, 0]
        return math.degrees(math.atan2(across[1], across[0]))


def fit_orientation(column_px: FloatArray, row_px: FloatArray, known: NDArray[np.bool_]) -> Orientation | None:
    """Fit the map by least squares, without the fifth of the pixels with the greatest residuals; None if it is not
    determined.

    column_px, row_px : (H, W) float64, the projector position of each camera pixel, where it is `known`.
    """
    y, x = np.nonzero(known)
    if len(x) < _MIN_CODED_PIXELS:
        return None
    positions = np.column_stack([column_px[y, x], row_px[y, x]])
    base = np.column_stack([np.ones(len(x)), x, y])
    is_inlier = np.ones(len(x), np.bool_)
    weights = np.zeros((3, 2))
    for _ in range(_FIT_ROUNDS):
        weights = np.asarray(np.linalg.lstsq(base[is_inlier], positions[is_inlier], rcond=None)[0], np.float64)
        residual = np.linalg.norm(base @ weights - positions, axis=1)
        is_inlier = residual <= np.quantile(residual, _KEPT_QUANTILE)
    jacobian = np.asarray(weights[1:].T, np.float64)
    if np.linalg.matrix_rank(jacobian, tol=1e-3) != 2:
        return None
    return Orientation(jacobian)


def expected_orientation(camera: Pinhole, projector: Pinhole) -> Orientation | None:
    """Return the map that a calibration predicts for a surface that faces both devices; None if they have no common
    view.

    The surface is where the optical axes are nearest to each other, normal to the direction between them. Lens
    distortion is ignored: it turns nothing.
    """
    between = camera.rotation[2] + projector.rotation[2]
    if np.linalg.norm(between) < 1e-6:
        return None
    normal = np.asarray(between / np.linalg.norm(between), np.float64)
    meeting = _nearest_point_of_axes(camera, projector)
    if meeting is None:
        meeting = np.asarray(camera.centre_mm + 1000.0 * camera.rotation[2], np.float64)
    pixel = _project(camera, meeting)
    if pixel is None:
        return None
    hits = [
        _project(projector, _intersect_ray(camera, pixel + step, meeting, normal))
        for step in np.array([[0, 0], [1, 0], [0, 1]])
    ]
    if any(hit is None for hit in hits):
        return None
    origin, right, down = (np.asarray(hit, np.float64) for hit in hits)
    return Orientation(np.column_stack([right - origin, down - origin]))


def depth_mm_per_px(camera: Pinhole, projector: Pinhole) -> float:
    """Return the shift of a point if the camera's pixel is wrong by one, where the axes are nearest to each other.

    NaN if they are parallel: the working distance is unknown then. Lens distortion is ignored.
    """
    meeting = _nearest_point_of_axes(camera, projector)
    pixel = None if meeting is None else _project(camera, meeting)
    if meeting is None or pixel is None:
        return float("nan")
    # The plane of light of the column through the point holds the projector's vertical and its centre.
    ray = meeting - projector.centre_mm
    sheet = np.cross(ray, projector.rotation[1])
    sheet = np.asarray(sheet / np.linalg.norm(sheet), np.float64)
    return float(np.linalg.norm(_intersect_ray(camera, pixel + np.array([1.0, 0.0]), meeting, sheet) - meeting))


def _nearest_point_of_axes(camera: Pinhole, projector: Pinhole) -> FloatArray | None:
    """Return the point with the least sum of squared distances from both axes; None if they are parallel."""
    axes = [(device.rotation[2], device.centre_mm) for device in (camera, projector)]
    projections = [np.eye(3) - np.outer(axis, axis) for axis, _ in axes]
    matrix = projections[0] + projections[1]
    if np.linalg.cond(matrix) >= 1e6:
        return None
    target = sum((each @ centre for each, (_, centre) in zip(projections, axes, strict=True)), np.zeros(3))
    return np.asarray(np.linalg.solve(matrix, target), np.float64)


def angle_between_deg(one: Orientation, other: Orientation) -> float:
    """Angle between two orientations, 0 to 180."""
    return abs((one.turn_deg - other.turn_deg + 180) % 360 - 180)


def _project(device: Pinhole, point_mm: FloatArray) -> FloatArray | None:
    homogeneous = device.matrix @ (device.rotation @ point_mm + device.translation_mm)
    return None if homogeneous[2] <= 0 else np.asarray(homogeneous[:2] / homogeneous[2], np.float64)


def _intersect_ray(camera: Pinhole, pixel: FloatArray, point_mm: FloatArray, normal: FloatArray) -> FloatArray:
    ray = camera.rotation.T @ np.linalg.solve(camera.matrix, np.array([*pixel, 1.0]))
    distance = normal @ (point_mm - camera.centre_mm) / (normal @ ray)
    return np.asarray(camera.centre_mm + distance * ray, np.float64)


@dataclass(frozen=True, slots=True)
class BarContrast:
    """Contrast of bars of one period. period_px : projector pixels. square : G of the module, corrected for noise."""

    period_px: float
    square: float


def bar_contrast(difference: FloatArray, contrast: FloatArray, *, noise_dn: float, period_px: float) -> BarContrast:
    """Return G over given pixels: bit − inverse and white − black, (n,) DN; noise_dn is that of one frame."""
    power = float(np.mean(difference**2)) - 2 * noise_dn**2
    return BarContrast(period_px, power / float(np.mean(contrast**2)))


def bar_blur_px(bars: Sequence[BarContrast]) -> float | None:
    """Return σ in projector pixels, from the most sensitive bars; inf if even the widest bars are invisible.

    None if even the finest are sharp: σ is less than about a fiftieth of their period.

    >>> powers = [BarContrast(period_px, square_wave_power(1.5 / period_px)) for period_px in (16.0, 64.0)]
    >>> round(bar_blur_px(powers), 3)
    1.5
    """
    sensitive = [each for each in bars if _MIN_SQUARE < each.square < _MAX_SQUARE]
    if not sensitive:
        return None if all(each.square >= _MAX_SQUARE for each in bars) else float("inf")
    best = min(sensitive, key=lambda each: abs(each.square - _BEST_SQUARE))
    shares = np.geomspace(1e-3, 1.0, 4000)
    powers = np.array([square_wave_power(float(share)) for share in shares])
    return best.period_px * float(np.interp(-best.square, -powers, shares))


def square_wave_power(blur_over_period: float) -> float:
    """G of the module.

    >>> round(square_wave_power(0.0), 3)
    1.0
    """
    odd = np.arange(1, 2001, 2)
    return float(np.sum(8 / (np.pi * odd) ** 2 * np.exp(-((2 * np.pi * odd * blur_over_period) ** 2))))


@dataclass(frozen=True, slots=True)
class EdgeBlur:
    """Blur of the sharpest edges in an image, pixels, including the pixel's own; and the number of edge points used."""

    sigma_px: float
    edges: int


def edge_blur(image: FloatArray, region: NDArray[np.bool_], *, noise_dn: float) -> EdgeBlur | None:
    """Return the blur of the sharpest fifth of clear, isolated edges in an image; None if there are too few.

    image : (H, W) float64, DN. region : (H, W) bool, where edges count. noise_dn : of the image.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    down, right = np.gradient(smooth)
    slope = np.hypot(right, down)
    # A Gaussian of 1 px leaves a third of the noise, and differences reduce it further.
    floor = max(_MIN_EDGE_SNR * noise_dn * 0.2, 0.02 * float(np.ptp(smooth)) / _EDGE_REACH_PX)
    rows, columns = np.nonzero(_ridge_mask(slope, right, down) & region & (slope > floor))
    if len(rows) < _MIN_EDGES:
        return None
    chosen = np.random.default_rng(0).permutation(len(rows))[:_MAX_EDGES]
    rows, columns = rows[chosen], columns[chosen]
    offset_px = np.arange(-_EDGE_REACH_PX, _EDGE_REACH_PX + _EDGE_STEP_PX / 2, _EDGE_STEP_PX)
    unit_x, unit_y = right[rows, columns] / slope[rows, columns], down[rows, columns] / slope[rows, columns]
    at_x = (columns[:, None] + offset_px * unit_x[:, None]).astype(np.float32)
    at_y = (rows[:, None] + offset_px * unit_y[:, None]).astype(np.float32)
    height, width = image.shape
    inside = ((at_x >= 1) & (at_x <= width - 2) & (at_y >= 1) & (at_y <= height - 2)).all(axis=1)
    if np.count_nonzero(inside) < _MIN_EDGES:
        return None
    profiles = cv2.remap(image.astype(np.float32), at_x[inside], at_y[inside], cv2.INTER_CUBIC).astype(np.float64)
    widths = _edge_widths(profiles, offset_px, noise_dn)
    if len(widths) < _MIN_EDGES:
        return None
    return EdgeBlur(float(np.percentile(widths, _SHARPEST_PERCENTILE)), len(widths))


def _ridge_mask(slope: FloatArray, right: FloatArray, down: FloatArray) -> NDArray[np.bool_]:
    """(H, W) bool: steeper than both neighbours across the edge, along the nearer axis."""
    steep = np.pad(slope, 1)
    is_ridge_in_x = (slope >= steep[1:-1, :-2]) & (slope > steep[1:-1, 2:])
    is_ridge_in_y = (slope >= steep[:-2, 1:-1]) & (slope > steep[2:, 1:-1])
    return np.where(np.abs(right) >= np.abs(down), is_ridge_in_x, is_ridge_in_y)


def _edge_widths(profiles: FloatArray, offset_px: FloatArray, noise_dn: float) -> FloatArray:
    """(n,) float64: σ of the profiles that are one clear step between two even sides. profiles : (m, k) float64."""
    side = round(2.0 / _EDGE_STEP_PX)
    low, high = profiles[:, :side].mean(axis=1), profiles[:, -side:].mean(axis=1)
    step = high - low
    travel = np.abs(np.diff(profiles[:, :: side // 2], axis=1)).sum(axis=1)
    noise_travel = 1.1 * noise_dn * (profiles.shape[1] // (side // 2))
    drift = np.maximum(_side_drift(profiles[:, :side]), _side_drift(profiles[:, -side:]))
    is_step = (
        (step > _MIN_EDGE_SNR * noise_dn)
        & (travel < _MAX_TRAVEL * step + noise_travel)
        & (drift < _MAX_SIDE_DRIFT * step + noise_dn)
    )
    risen = np.maximum.accumulate((profiles[is_step] - low[is_step, None]) / step[is_step, None], axis=1)
    return (
        _crossing_position(risen, offset_px, _HIGH_CROSSING) - _crossing_position(risen, offset_px, _LOW_CROSSING)
    ) / _CROSSING_SIGMAS


def _side_drift(side: FloatArray) -> FloatArray:
    """(n,) float64: rise or fall within one end of the profiles, (n, k), from its halves."""
    half = side.shape[1] // 2
    return np.asarray(2 * np.abs(side[:, half:].mean(axis=1) - side[:, :half].mean(axis=1)), np.float64)


def _crossing_position(risen: FloatArray, offset_px: FloatArray, share: float) -> FloatArray:
    """(n,) float64: position at which each of the rising profiles (n, k) passes `share`."""
    after = np.clip(np.argmax(risen > share, axis=1), 1, None)
    row = np.arange(len(risen))
    below, above = risen[row, after - 1], risen[row, after]
    fraction = np.divide(share - below, above - below, out=np.zeros_like(below), where=above > below)
    return np.asarray(offset_px[after] - _EDGE_STEP_PX * (1 - fraction), np.float64)
