"""Drawings over a device's image, as SVG: what is left over in each cell, and where the board was held."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slrig.calibration.solution import CELLS, DeviceResiduals
from slrig.model import FloatArray, Size
from slrig.sessions.markup import Markup, joined, tag

WIDTH = 360.0
"""Width of a drawing, in its own units; it scales with the page."""

_ARROW_SHARE = 0.42
_STOPS = np.array(
    [(23, 44, 82), (24, 86, 122), (28, 132, 138), (82, 178, 127), (176, 211, 94), (250, 226, 88)], dtype=np.float64
)
"""A ramp from dark blue to yellow whose lightness rises steadily, so that it prints and everyone can read it."""


def ramp_colour(share: float) -> str:
    """The colour of a value between 0 (dark blue) and 1 (yellow), as CSS.

    >>> ramp_colour(0.0), ramp_colour(1.0)
    ('#172c52', '#fae258')
    """
    place = min(max(share, 0.0), 1.0) * (len(_STOPS) - 1)
    below = min(int(place), len(_STOPS) - 2)
    mixed = _STOPS[below] + (place - below) * (_STOPS[below + 1] - _STOPS[below])
    return "#" + "".join(f"{round(part):02x}" for part in mixed)


def ink_on(share: float) -> str:
    """The colour of text that can be read on `ramp_colour(share)`."""
    return "#10202f" if share > 0.5 else "#ffffff"


def legend(least: float, most: float, unit: str) -> Markup:
    """A bar of the ramp with the values at its ends, and their unit in words beside it."""
    steps, width = 24, 150.0
    shares = [(at + 0.5) / steps for at in range(steps)]
    bars = [
        tag("rect", x=width * (share - 0.5 / steps), width=width / steps + 0.5, height=9, fill=ramp_colour(share))
        for share in shares
    ]
    ends = [
        tag("text", f"{least:.3g}", y=22, class_="tick"),
        tag("text", f"{most:.3g}", x=width, y=22, class_="tick end"),
        tag("text", unit, x=width + 8, y=9, class_="tick"),
    ]
    words = f"colours from {least:.3g} to {most:.3g} {unit}"
    return drawing(1.9 * width, 26.0, words, [*bars, *ends], class_="legend")


def drawing(width: float, height: float, words: str, parts: Sequence[Markup], *, class_: str = "chart") -> Markup:
    """A picture with words for those who cannot see it."""
    return tag(
        "svg",
        *parts,
        class_=class_,
        viewBox=f"0 0 {width:.6g} {height:.6g}",
        role="img",
        aria_label=words,
        xmlns="http://www.w3.org/2000/svg",
    )


def residual_map(residuals: DeviceResiduals, size: Size, *, name: str, most_px: float) -> Markup:
    """Cells over the image, each with its rms as number and colour, and its mean residual as an arrow.

    most_px : the rms of the brightest colour. The longest arrow is as long as fits; a caption has to say its length.
    """
    height = _height(size)
    wide, high = WIDTH / CELLS, height / CELLS
    scale = _ARROW_SHARE * min(wide, high) / max(longest_arrow_px(residuals), 1e-9)
    parts = []
    for row, column in np.ndindex(CELLS, CELLS):
        x, y = column * wide, row * high
        rms = float(residuals.map_rms_px[row, column])
        count = int(residuals.map_count[row, column])
        if math.isnan(rms):
            empty = tag("title", "nothing was seen here")
            parts.append(tag("rect", empty, x=x, y=y, width=wide, height=high, class_="unseen"))
            continue
        share = rms / most_px
        mean = residuals.map_mean_px[row, column]
        told = tag("title", f"rms {rms:.3f} px of {count:,}; mean {mean[0]:+.3f}, {mean[1]:+.3f} px")
        parts.append(tag("rect", told, x=x, y=y, width=wide, height=high, fill=ramp_colour(share), class_="cell"))
        parts.append(_arrow(x + wide / 2, y + 0.62 * high, scale * mean, ink_on(share)))
        number = tag("text", f"{rms:.3f}", x=x + wide / 2, y=y + 11, class_="cell-value", fill=ink_on(share))
        parts.append(number)
    return drawing(WIDTH, height, f"{name}: what is left over, cell by cell", parts)


def longest_arrow_px(residuals: DeviceResiduals) -> float:
    """The length of the longest mean residual of a cell, px; 0 where no cell has one."""
    lengths = np.hypot(*np.moveaxis(residuals.map_mean_px, -1, 0))
    return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else 0.0


def coverage_map(size: Size, outlines: Sequence[FloatArray], points_px: FloatArray, *, name: str) -> Markup:
    """The image with the board's outline in every pose, cut at the image's edge, and every point that was used.

    outlines : (k, 2) each, pixels; points_px : (n, 2) float64, pixels.
    """
    height = _height(size)
    scale = WIDTH / size.width_px
    clip = f"image-of-{name}"
    window = tag("clipPath", tag("rect", width=WIDTH, height=height), id=clip)
    boards = [
        tag("polygon", points=" ".join(f"{x:.1f},{y:.1f}" for x, y in (outline + 0.5) * scale), class_="board")
        for outline in outlines
    ]
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in (points_px + 0.5) * scale)
    inside = tag("g", *boards, tag("path", d=dots, class_="dots"), clip_path=f"url(#{clip})")
    grid = tag("path", d=_grid(WIDTH, height), class_="grid")
    frame = tag("rect", x=0.5, y=0.5, width=WIDTH - 1, height=height - 1, class_="frame")
    return drawing(WIDTH, height, f"{name}: where the board was held", [window, grid, inside, frame])


def _height(size: Size) -> float:
    return WIDTH * size.height_px / size.width_px


def _grid(width: float, height: float) -> str:
    steps = range(1, CELLS)
    return "".join(f"M{width * at / CELLS:.1f} 0v{height:.1f}M0 {height * at / CELLS:.1f}h{width:.1f}" for at in steps)


def _arrow(x: float, y: float, along: FloatArray, ink: str) -> Markup:
    """An arrow about its middle; a dot where it would be too short to see."""
    length = float(np.hypot(*along))
    if length < 1.5:
        return tag("circle", cx=x, cy=y, r=1.2, fill=ink)
    tip, tail = np.array([x, y]) + along / 2, np.array([x, y]) - along / 2
    ahead = along / length * min(5.0, length / 2)
    aside = np.array([-ahead[1], ahead[0]]) * 0.55
    left, right = tip - ahead + aside, tip - ahead - aside
    path = f"M{_at(tail)}L{_at(tip)}M{_at(left)}L{_at(tip)}L{_at(right)}"
    return joined(tag("path", d=path, class_="arrow", stroke=ink))


def _at(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"
