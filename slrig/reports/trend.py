"""Figures over time as SVG: panels with a vertical axis from 0, one below another, and the moments below the last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timedelta

from markupsafe import Markup

from slrig.reports.drawing import drawing, shape

WIDTH = 760.0
LEFT, RIGHT, TOP, PANEL, GAP = 64.0, 118.0, 34.0, 168.0, 52.0
END = WIDTH - RIGHT
INK, FAINT, PALE = "#1f2937", "#d8dee6", "#9aa5b1"
GREEN, ORANGE, RED, GREY = "#2b7a4b", "#c77700", "#b3261e", "#6b7280"
_STEPS_S = (60, 300, 900, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 1209600, 2592000, 7776000, 31536000)
_STYLE = (
    "text{font:11px system-ui,sans-serif;fill:#1f2937}.title{font-size:13px;font-weight:600}"
    ".end{text-anchor:end}.middle{text-anchor:middle}.faint{fill:#6b7280}"
)

Moments = Sequence[datetime]
"""Of what is drawn, oldest first."""


def trend(words: str, height: float, parts: Sequence[str]) -> Markup:
    """The whole picture."""
    back = shape("rect", width=WIDTH, height=height, fill="#ffffff")
    return drawing(WIDTH, height, words, [shape("style", _STYLE), back, *parts])


def nothing_yet(words: str) -> Markup:
    """A picture of these words, where there is nothing to draw."""
    return drawing(
        WIDTH, 120, words, [shape("style", _STYLE), shape("text", words, x=WIDTH / 2, y=60, class_="middle")]
    )


def _span(moments: Moments) -> timedelta:
    return max(moments[-1] - moments[0], timedelta(minutes=1))


def x_of(moments: Moments, at: datetime) -> float:
    """Where a moment is."""
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
    """A panel with a vertical axis from 0. Values are one for each moment, None where it tells none."""

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

    def limit(self, value: float, words: str, colour: str) -> None:
        """A dashed line with its name beside it, unless it lies above the panel."""
        if value <= self._most:
            y = self._y(value)
            self.parts.append(shape("path", d=f"M{LEFT} {y:.1f}H{END}", stroke=colour, stroke_dasharray="6 4"))
            self.parts.append(shape("text", words, x=END + 6, y=y + 4, fill=colour))

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

    def dot(self, at: datetime, value: float, colour: str, words: str) -> None:
        """A dot at a value, and words that show where a pointer rests on it."""
        told, x = shape("title", f"{at:%d %b %H:%M}: {words}"), x_of(self._moments, at)
        self.parts.append(shape("circle", told, cx=x, cy=self._y(value), r=3.2, fill=colour))


def _round_step(step: float) -> float:
    size = 10.0 ** math.floor(math.log10(step))
    return next(factor * size for factor in (1, 2, 2.5, 5, 10) if factor * size >= step * 0.999)
