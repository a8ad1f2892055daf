"""How the numbers of a calibration are written."""

from __future__ import annotations

import math


def rounded(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, never as a power of ten.

    >>> rounded(0.17672), rounded(0.000591), rounded(1253.4), rounded(0.0)
    ('0.177', '0.000591', '1253', '0')
    """
    if not value or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
