"""How grey values become light, from frames of even grey fields: a monotone curve, its gamma and its ends.

The curve is that of projector and camera together. Frames of one picture at several exposures tell the camera's part:
values above black grow with the exposure to the power of the camera's own exponent, 1 for a linear sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.model import FloatArray


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
