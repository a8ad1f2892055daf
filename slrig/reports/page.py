"""Reports as single pages of HTML, filled in from templates, and the drawings (SVG) in them. Values are escaped unless
they are `Markup`.

A page holds everything that it shows: style, drawings and pictures (JPEG). It runs no script and requests nothing, so
that it can be mailed, printed and kept next to its subject.
"""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from slrig.model import FloatArray, Pixels

_TEMPLATES = Environment(
    loader=PackageLoader("slrig.reports"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.tests["nan"] = math.isnan


def filled(template: str, /, **values: object) -> str:
    """The page that a template of slrig/reports/templates makes of values."""
    return _TEMPLATES.get_template(template).render(values)


def begun(text: str) -> str:
    """A text as the beginning of a sentence: unlike `str.capitalize`, it changes the first letter only.

    >>> begun("camera 'B' moved")
    "Camera 'B' moved"
    """
    return text[:1].upper() + text[1:]


_TEMPLATES.filters["begun"] = begun


def jpeg_uri(picture: Pixels, quality: int) -> str:
    """A picture, (H, W, 3) uint8, blue, green, red, as an address that holds it as JPEG.

    That is a twentieth of a PNG file's size, and a page holds dozens. Raises ValueError if it cannot be written so.
    """
    written, data = cv2.imencode(".jpg", np.ascontiguousarray(picture), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not written:
        message = f"a picture of {picture.shape} could not be written as JPEG"
        raise ValueError(message)
    return "data:image/jpeg;base64," + b64encode(data.tobytes()).decode("ascii")


WIDTH = 360.0
"""Width of a drawing, in its own units; it scales with the page."""

_STOPS = np.array(
    [(23, 44, 82), (24, 86, 122), (28, 132, 138), (82, 178, 127), (176, 211, 94), (250, 226, 88)], dtype=np.float64
)
"""A ramp from dark blue to yellow of steadily rising lightness: it prints, and everyone can read it."""


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


def drawing(width: float, height: float, title: str, parts: Iterable[str], *, class_: str = "chart") -> Markup:
    """A picture with a title for those who cannot see it."""
    box = f"0 0 {width:.6g} {height:.6g}"
    address = "http://www.w3.org/2000/svg"
    return shape("svg", *parts, class_=class_, viewBox=box, role="img", aria_label=title, xmlns=address)


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
    """A bar of the ramp with the values at its ends, and their unit next to it."""
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
    title = f"colours from {least:.3g} to {most:.3g} {unit}"
    return drawing(1.9 * width, 26.0, title, [*bars, *ends], class_="legend")


TREND_WIDTH = 760.0
LEFT, RIGHT, TOP, PANEL, GAP = 64.0, 118.0, 34.0, 168.0, 52.0
END = TREND_WIDTH - RIGHT
INK, FAINT, PALE = "#1f2937", "#d8dee6", "#9aa5b1"
GREEN, ORANGE, RED, GREY = "#2b7a4b", "#c77700", "#b3261e", "#6b7280"
_STEPS_S = (60, 300, 900, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 1209600, 2592000, 7776000, 31536000)
_STYLE = (
    "text{font:11px system-ui,sans-serif;fill:#1f2937}.title{font-size:13px;font-weight:600}"
    ".end{text-anchor:end}.middle{text-anchor:middle}.faint{fill:#6b7280}"
)

Moments = Sequence[datetime]
"""Moments of the drawn values, oldest first."""


def trend(title: str, height: float, parts: Sequence[str]) -> Markup:
    """The whole picture."""
    back = shape("rect", width=TREND_WIDTH, height=height, fill="#ffffff")
    return drawing(TREND_WIDTH, height, title, [shape("style", _STYLE), back, *parts])


def nothing_yet(text: str) -> Markup:
    """A picture of a text, where there is nothing to draw."""
    return drawing(
        TREND_WIDTH,
        120,
        text,
        [shape("style", _STYLE), shape("text", text, x=TREND_WIDTH / 2, y=60, class_="middle")],
    )


def _span(moments: Moments) -> timedelta:
    return max(moments[-1] - moments[0], timedelta(minutes=1))


def x_of(moments: Moments, at: datetime) -> float:
    """Abscissa of a moment."""
    return LEFT + (END - LEFT) * ((at - moments[0]) / _span(moments))


def times(moments: Moments, y: float) -> list[Markup]:
    """The horizontal axis."""
    first, last, span_s = moments[0], moments[-1], _span(moments).total_seconds()
    step_s = next((step for step in _STEPS_S if span_s / step <= 7), _STEPS_S[-1])
    form = "%H:%M" if step_s < 86400 else "%d %b"
    start = first.timestamp()
    moment = math.ceil(start / step_s) * step_s
    parts = []
    while moment <= start + span_s:
        at = first + timedelta(seconds=moment - start)
        x = x_of(moments, at)
        parts.append(shape("path", d=f"M{x:.1f} {y:.1f}v5", stroke=INK))
        parts.append(shape("text", at.strftime(form), x=x, y=y + 18, class_="middle"))
        moment += step_s
    day = f"{first:%d %b %Y %H:%M} to {last:%d %b %Y %H:%M} {first:%Z}"
    return [*parts, shape("text", day, x=LEFT, y=y + 36, class_="faint")]


class Panel:
    """A panel with a vertical axis from 0. Values are one for each moment, None without one."""

    def __init__(self, moments: Moments, top: float, most: float, title: str) -> None:
        self._moments, self._top = moments, top
        step = _round_step(max(most, 1e-9) * 1.15 / 4)
        self._most = step * math.ceil(max(most, 1e-9) * 1.08 / step)
        self.parts = [shape("text", title, x=LEFT, y=top - 12, class_="title")]
        for number in range(round(self._most / step) + 1):
            y = self._y(number * step)
            self.parts.append(shape("path", d=f"M{LEFT} {y:.1f}H{END}", stroke=FAINT))
            self.parts.append(shape("text", f"{number * step:.4g}", x=LEFT - 8, y=y + 4, class_="end"))

    def _y(self, value: float) -> float:
        return self._top + PANEL * (1 - min(max(value / self._most, 0.0), 1.0))

    def limit(self, value: float, label: str, colour: str) -> None:
        """A dashed line with its name next to it, unless it lies above the panel."""
        if value <= self._most:
            y = self._y(value)
            self.parts.append(shape("path", d=f"M{LEFT} {y:.1f}H{END}", stroke=colour, stroke_dasharray="6 4"))
            self.parts.append(shape("text", label, x=END + 6, y=y + 4, fill=colour))

    def line(self, values: Sequence[float | None], colour: str, *, of: Sequence[str], wide: float = 1.6) -> None:
        """A line through values; a gap begins a new one, and so does a value that is `of` something else."""
        path, pen, before = "", "M", ""
        for at, value, source in zip(self._moments, values, of, strict=True):
            pen = "M" if value is None or source != before else pen
            before = source
            if value is not None:
                path += f"{pen}{x_of(self._moments, at):.1f} {self._y(value):.1f}"
                pen = "L"
        self.parts.append(shape("path", d=path or "M0 0", fill="none", stroke=colour, stroke_width=wide))

    def bar(self, at: datetime, value: float, sigma: float, colour: str) -> None:
        """A deviation either way of a value."""
        x, low, high = x_of(self._moments, at), self._y(value - sigma), self._y(value + sigma)
        self.parts.append(shape("path", d=f"M{x:.1f} {low:.1f}V{high:.1f}", stroke=colour))

    def dot(self, at: datetime, value: float, colour: str, text: str) -> None:
        """A dot at a value, and a text that is shown under a pointer."""
        title, x = shape("title", f"{at:%d %b %H:%M}: {text}"), x_of(self._moments, at)
        self.parts.append(shape("circle", title, cx=x, cy=self._y(value), r=3.2, fill=colour))


def _round_step(step: float) -> float:
    size = 10.0 ** math.floor(math.log10(step))
    return next(factor * size for factor in (1, 2, 2.5, 5, 10) if factor * size >= step * 0.999)
