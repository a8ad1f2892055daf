"""Drawings as SVG, put together from shapes, and their colours. Every text and attribute in them is escaped."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from slrig.model import FloatArray

WIDTH = 360.0
"""Width of a drawing, in its own units; it scales with the page."""

_STOPS = np.array(
    [(23, 44, 82), (24, 86, 122), (28, 132, 138), (82, 178, 127), (176, 211, 94), (250, 226, 88)], dtype=np.float64
)
"""A ramp from dark blue to yellow whose lightness rises steadily, so that it prints and everyone can read it."""


def shape(name: str, /, *inside: str, **attributes: str | float) -> Markup:
    """One element. Of an attribute's name a closing underscore falls off, and other underscores become hyphens.

    Numbers get six digits at most, which is what a drawing needs.

    >>> shape("text", "2 < 3", x=1 / 3, class_="tick")
    Markup('<text x="0.333333" class="tick">2 &lt; 3</text>')
    """
    written = Markup("").join(
        Markup(' {}="{}"').format(
            key.rstrip("_").replace("_", "-"), value if isinstance(value, str) else f"{value:.6g}"
        )
        for key, value in attributes.items()
    )
    return Markup("<{0}{1}>{2}</{0}>").format(name, written, Markup("").join(inside))


def drawing(width: float, height: float, words: str, parts: Iterable[str], *, class_: str = "chart") -> Markup:
    """A picture with words for those who cannot see it."""
    box = f"0 0 {width:.6g} {height:.6g}"
    address = "http://www.w3.org/2000/svg"
    return shape("svg", *parts, class_=class_, viewBox=box, role="img", aria_label=words, xmlns=address)


def polygon(points: FloatArray, class_: str) -> Markup:
    """A closed line through points, (n, 2)."""
    return shape("polygon", points=" ".join(f"{x:.1f},{y:.1f}" for x, y in points), class_=class_)


def path(*lines: FloatArray) -> str:
    """Open lines through points, (n, 2) each, as the `d` of a path."""
    return "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) for points in lines)


def ramp(shares: FloatArray) -> NDArray[np.uint8]:
    """(..., 3) uint8, red, green, blue: the colours of values between 0 (dark blue) and 1 (yellow)."""
    places = np.linspace(0, 1, len(_STOPS))
    parts = [np.interp(shares, places, stops) for stops in _STOPS.T]
    return np.asarray(np.rint(np.stack(parts, axis=-1)), dtype=np.uint8)


def ramp_colour(share: float) -> str:
    """The colour of a value between 0 and 1, as CSS.

    >>> ramp_colour(0.0), ramp_colour(1.0)
    ('#172c52', '#fae258')
    """
    return f"#{ramp(np.array(share)).tobytes().hex()}"


def ink_on(share: float) -> str:
    """The colour of text that can be read on `ramp_colour(share)`."""
    return "#10202f" if share > 0.5 else "#ffffff"


def legend(least: float, most: float, unit: str) -> Markup:
    """A bar of the ramp with the values at its ends, and their unit in words beside it."""
    steps, width = 24, 150.0
    wide = width / steps
    bars = [
        shape("rect", x=wide * at, width=wide + 0.5, height=9, fill=ramp_colour((at + 0.5) / steps))
        for at in range(steps)
    ]
    ends = [
        shape("text", f"{least:.3g}", y=22, class_="tick"),
        shape("text", f"{most:.3g}", x=width, y=22, class_="tick end"),
        shape("text", unit, x=width + 8, y=9, class_="tick"),
    ]
    words = f"colours from {least:.3g} to {most:.3g} {unit}"
    return drawing(1.9 * width, 26.0, words, [*bars, *ends], class_="legend")
