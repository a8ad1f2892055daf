"""Light in digital numbers: how white and black differ, and how grey values become light.

What steady white and black frames say about a camera's view of a projector: how much is lit, and how well exposed.

A pixel is lit when white lies above black by more than noise can, and by a tenth of what bright pixels show: glow and
reflections are weaker. A sample at full scale is saturated. The sensor is taken as linear: values above its black level
grow with the exposure.

How grey values become light, from frames of even grey fields: a monotone curve, its gamma and its ends.

The curve is that of projector and camera together. Frames of one picture at several exposures tell the camera's part:
values above black grow with the exposure to the power of the camera's own exponent, 1 for a linear sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Pixels

USUAL_SNR = 10.0
"""White less black over noise, of the middle lit pixel: with less, stripes and codes get lost."""

HIGHEST_SHARE = 0.9
"""Of full scale: brightest lit pixels that are exposed well stay below it."""

_LEAST_DN = 2.0
_CLEAR = 6.0
_FAINT = 0.1
_BRIGHT_PERCENTILE = 99.0
_ROUNDING_VARIANCE = 1 / 12


@dataclass(frozen=True, slots=True)
class LightLevels:
    """Means of white and black frames of one camera, and what they tell; lengths of light in digital numbers (DN).

    black, white, contrast : (H, W) float64, DN; contrast is white − black. lit : (H, W) bool; usable : lit and never
    saturated. noise_dn : standard deviation of one white frame at the middle usable pixel. bright_dn : the 99th
    percentile of white where it is lit, of the whole image where nothing is.
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
        """Which part of the image the projector lights."""
        return float(self.lit.mean())

    @property
    def contrast_dn(self) -> float:
        """White − black of the middle lit pixel; NaN where nothing is lit."""
        return float(np.median(self.contrast[self.lit])) if self.lit.any() else float("nan")

    @property
    def ambient_dn(self) -> float:
        """The black frame at the middle lit pixel; NaN where nothing is lit."""
        return float(np.median(self.black[self.lit])) if self.lit.any() else float("nan")

    @property
    def snr(self) -> float:
        """Contrast over noise of the middle lit pixel."""
        return self.contrast_dn / self.noise_dn

    @property
    def box(self) -> tuple[int, int, int, int]:
        """First and last row, first and last column of the lit part, but for a hundredth of it on each side."""
        rows, columns = np.nonzero(self.lit)
        top, bottom = np.percentile(rows, (1, 99))
        left, right = np.percentile(columns, (1, 99))
        return round(top), round(bottom), round(left), round(right)

    def level(self, image: Pixels) -> float:
        """Where an image lies between black, 0, and white, 1, over the usable pixels."""
        seen = (image - self.black)[self.usable].sum()
        return float(seen / self.contrast[self.usable].sum())

    def longest_exposure_s(self, exposure_s: float) -> float:
        """The exposure at which the brightest lit pixels reach HIGHEST_SHARE of full scale, from what this one gave.

        Of a saturated frame nothing is known but that it is less: half is taken.
        """
        if self.saturated_share > 0.005 or self.black_saturated_share > 0.005:
            return exposure_s / 2
        return exposure_s * HIGHEST_SHARE * self.full_scale / max(self.bright_dn, 1.0)

    def shortest_exposure_s(self, exposure_s: float) -> float:
        """The exposure at which the middle lit pixel has USUAL_SNR, if noise stayed what it is: an upper limit."""
        return exposure_s * USUAL_SNR / max(self.snr, 1e-3)


def light_levels(white: Sequence[Pixels], black: Sequence[Pixels], *, full_scale: int) -> LightLevels:
    """Return the levels of two or more (H, W) frames of steady white and of steady black each."""
    dark, bright = np.stack(black).astype(np.float64), np.stack(white).astype(np.float64)
    mean_dark, mean_bright = dark.mean(axis=0), bright.mean(axis=0)
    contrast = mean_bright - mean_dark
    variance = dark.var(axis=0, ddof=1) / len(dark) + bright.var(axis=0, ddof=1) / len(bright)
    typical = float(np.sqrt(np.mean(variance) + _ROUNDING_VARIANCE))
    threshold = max(_LEAST_DN, _CLEAR * typical, _FAINT * float(np.percentile(contrast, 99.5)))
    lit = np.asarray(contrast > threshold, np.bool_)
    saturated = np.asarray((bright >= full_scale).any(axis=0), np.bool_)
    usable = lit & ~saturated
    judged = bright.var(axis=0, ddof=1)[usable if usable.any() else lit if lit.any() else np.ones_like(lit)]
    return LightLevels(
        black=mean_dark,
        white=mean_bright,
        contrast=contrast,
        lit=lit,
        usable=usable,
        noise_dn=float(np.sqrt(judged.mean() + _ROUNDING_VARIANCE)),
        bright_dn=float(np.percentile(mean_bright[lit] if lit.any() else mean_bright, _BRIGHT_PERCENTILE)),
        saturated_share=float(np.mean(saturated[lit])) if lit.any() else 0.0,
        black_saturated_share=float(np.mean(mean_dark >= full_scale)),
        full_scale=full_scale,
    )


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """Light of grey values, by the law ((value − black_knee)/(white_knee − black_knee))^gamma between the knees.

    values : (n,) float64, 0 to 255, rising. light : (n,) float64, never falling, 0 for black and 1 for white. Values
    below black_knee are all black, those above white_knee all white. residual : rms of the measured light about the
    law. reversal : the largest fall of measured light from one value to a higher one.
    """

    values: FloatArray
    light: FloatArray
    gamma: float
    black_knee: float
    white_knee: float
    residual: float
    reversal: float


def response_curve(values: Sequence[float], light: Sequence[float]) -> ResponseCurve:
    """Return the curve through measured light, 0 for black and 1 for white, of rising grey values, 5 or more.

    >>> curve = response_curve(range(0, 256, 15), [(v / 255) ** 2.2 for v in range(0, 256, 15)])
    >>> round(curve.gamma, 3), round(abs(curve.black_knee), 1), round(curve.white_knee, 1)
    (2.2, 0.0, 255.0)
    """
    # A second to import together: only those who measure pay for it.
    from scipy.optimize import isotonic_regression, least_squares

    asked, seen = np.asarray(values, np.float64), np.asarray(light, np.float64)
    monotone = np.asarray(isotonic_regression(seen).x, np.float64)

    def off(law: FloatArray) -> FloatArray:
        return np.asarray(_law(asked, *law) - seen, np.float64)

    starts = [(gamma, 2.0, 253.0) for gamma in (0.6, 1.0, 2.2)]
    fits = [
        least_squares(off, start, bounds=([0.2, 0.0, 140.0], [5.0, 110.0, 255.0]), x_scale=(1, 50, 50))
        for start in starts
    ]
    best = min(fits, key=lambda fit: float(fit.cost))
    gamma, black_knee, white_knee = (float(each) for each in best.x)
    return ResponseCurve(
        values=asked,
        light=monotone,
        gamma=gamma,
        black_knee=black_knee,
        white_knee=white_knee,
        residual=float(np.sqrt(np.mean(np.square(best.fun)))),
        reversal=float(max(np.max(np.maximum.accumulate(seen) - seen), 0.0)),
    )


def camera_exponent(exposures_s: Sequence[float], contrast_dn: Sequence[float]) -> float:
    """The exponent by which values grow with the exposure: the slope in a doubly logarithmic plot; 1 is linear.

    >>> round(camera_exponent([0.001, 0.002, 0.004], [10.0, 20.0, 40.0]), 6)
    1.0
    """
    return float(np.polyfit(np.log(exposures_s), np.log(contrast_dn), 1)[0])


def _law(values: FloatArray, gamma: float, black_knee: float, white_knee: float) -> FloatArray:
    inside = np.clip((values - black_knee) / (white_knee - black_knee), 0.0, 1.0)
    return np.asarray(inside**gamma, np.float64)
