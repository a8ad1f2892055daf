"""What the parameters of a calibration are called, and mean; and how its numbers are written."""

from __future__ import annotations

import math

PARAMETERS = {
    "fx": ("focal length across", "The larger, the narrower the view."),
    "fy": ("focal length down", "The same as across where pixels are square."),
    "cx": ("principal point across", "The column where the optical axis meets the image."),
    "cy": ("principal point down", "The row; with lens shift it lies near or beyond the image's edge, as it should."),
    "k1": ("radial distortion", "How much straight lines bend: negative, outwards like a barrel."),
    "k2": ("radial distortion", "The same, felt towards the corners."),
    "p1": ("tangential distortion", "A lens that is tilted or off centre, down."),
    "p2": ("tangential distortion", "A lens that is tilted or off centre, across."),
    "k3": ("radial distortion", "Bending that is felt in the outermost corners only."),
    "x_mm": ("place, x", "Its centre of projection, to the right of the first camera's."),
    "y_mm": ("place, y", "The same, below it."),
    "z_mm": ("place, z", "The same, in front of it."),
}
"""By parameter of a device, what it is called and what it means."""


def rounded(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, never as a power of ten.

    >>> rounded(0.17672), rounded(0.000591), rounded(1253.4), rounded(0.0)
    ('0.177', '0.000591', '1253', '0')
    """
    if not value or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
