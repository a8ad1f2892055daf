"""The history of a rig's health as one SVG picture: expected error, residuals, thresholds, recalibrations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import pairwise

from markupsafe import Markup

from slrig.calibration.health.verdict import THRESHOLDS, HealthState, Thresholds
from slrig.reports.drawing import drawing, shape
from slrig.verify.store import VerificationRecord

WIDTH, HEIGHT = 760.0, 470.0
_LEFT, _RIGHT = 64.0, 118.0
_TOP, _PANEL, _GAP = 34.0, 168.0, 52.0
_END = WIDTH - _RIGHT
_COLOURS = {
    HealthState.GOOD: "#2b7a4b",
    HealthState.WATCH: "#c77700",
    HealthState.STALE: "#b3261e",
    HealthState.UNKNOWN: "#6b7280",
}
_LINES = ("#1c4e80", "#7a3e9d", "#00798c", "#8a5a00", "#5b6b1f", "#a3336b")
_INK, _FAINT, _PALE = "#1f2937", "#d8dee6", "#9aa5b1"
_STEPS_S = (60, 300, 900, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 1209600, 2592000, 7776000, 31536000)
_STYLE = (
    "text{font:11px system-ui,sans-serif;fill:#1f2937}.title{font-size:13px;font-weight:600}"
    ".end{text-anchor:end}.middle{text-anchor:middle}.faint{fill:#6b7280}"
)

Records = Sequence[VerificationRecord]


def health_svg(records: Records, /, *, thresholds: Thresholds = THRESHOLDS) -> Markup:
    """The picture of verifications, oldest first. With none it says so in words."""
    style = shape("style", _STYLE)
    if not records:
        words = "Nothing was verified yet. POST /rig/verification shoots one."
        return drawing(WIDTH, 120, words, [style, shape("text", words, x=WIDTH / 2, y=60, class_="middle")])
    second = _TOP + _PANEL + _GAP
    parts = [
        style,
        shape("rect", width=WIDTH, height=HEIGHT, fill="#ffffff"),
        *_errors(records, thresholds, _TOP),
        *_residuals(records, thresholds, second),
        *_recalibrations(records, second + _PANEL),
        *_times(records, second + _PANEL),
    ]
    words = f"health of the rig over {len(records)} verifications, now {records[-1].health.state}"
    return drawing(WIDTH, HEIGHT, words, parts)


def _span(records: Records) -> timedelta:
    return max(records[-1].at - records[0].at, timedelta(minutes=1))


def _x(records: Records, at: datetime) -> float:
    return _LEFT + (_END - _LEFT) * ((at - records[0].at) / _span(records))


def _times(records: Records, y: float) -> list[Markup]:
    """The horizontal axis."""
    first, last, span_s = records[0].at, records[-1].at, _span(records).total_seconds()
    step_s = next((step for step in _STEPS_S if span_s / step <= 7), _STEPS_S[-1])
    form = "%H:%M" if step_s < 86400 else "%d %b"
    start = first.timestamp()
    moment = math.ceil(start / step_s) * step_s
    parts = []
    while moment <= start + span_s:
        at = first + timedelta(seconds=moment - start)
        x = _x(records, at)
        parts.append(shape("path", d=f"M{x:.1f} {y:.1f}v5", stroke=_INK))
        parts.append(shape("text", at.strftime(form), x=x, y=y + 18, class_="middle"))
        moment += step_s
    day = f"{first:%d %b %Y %H:%M} to {last:%d %b %Y %H:%M} {first:%Z}"
    return [*parts, shape("text", day, x=_LEFT, y=y + 36, class_="faint")]


class _Panel:
    """A panel with a vertical axis from 0. Values are one for each record, None where it tells none."""

    def __init__(self, records: Records, top: float, most: float, title: str) -> None:
        self._records, self._top = records, top
        step = _round_step(max(most, 1e-9) * 1.15 / 4)
        self._most = step * math.ceil(max(most, 1e-9) * 1.08 / step)
        self.parts = [shape("text", title, x=_LEFT, y=top - 12, class_="title")]
        for number in range(round(self._most / step) + 1):
            y = self._y(number * step)
            self.parts.append(shape("path", d=f"M{_LEFT} {y:.1f}H{_END}", stroke=_FAINT))
            self.parts.append(shape("text", f"{number * step:.4g}", x=_LEFT - 8, y=y + 4, class_="end"))

    def _y(self, value: float) -> float:
        return self._top + _PANEL * (1 - min(max(value / self._most, 0.0), 1.0))

    def limit(self, value: float, words: str, colour: str) -> None:
        """A dashed line with its name beside it, unless it lies above the panel."""
        if value <= self._most:
            y = self._y(value)
            self.parts.append(shape("path", d=f"M{_LEFT} {y:.1f}H{_END}", stroke=colour, stroke_dasharray="6 4"))
            self.parts.append(shape("text", words, x=_END + 6, y=y + 4, fill=colour))

    def line(self, values: Sequence[float | None], colour: str, *, wide: float = 1.6) -> None:
        """A line through values; a calibration begins a new one, and so does a gap."""
        path, pen, calibration = "", "M", ""
        for record, value in zip(self._records, values, strict=True):
            pen = "M" if value is None or record.calibration != calibration else pen
            calibration = record.calibration
            if value is not None:
                path += f"{pen}{_x(self._records, record.at):.1f} {self._y(value):.1f}"
                pen = "L"
        self.parts.append(shape("path", d=path or "M0 0", fill="none", stroke=colour, stroke_width=wide))

    def dots(self, values: Sequence[float | None]) -> None:
        """A dot at each value, in the colour of the record's state."""
        for record, value in zip(self._records, values, strict=True):
            if value is not None:
                health, x = record.health, _x(self._records, record.at)
                told = shape("title", f"{record.at:%d %b %H:%M}: {health.state}. {'; '.join(health.reasons)}")
                dot = shape("circle", told, cx=x, cy=self._y(value), r=3.2, fill=_COLOURS[health.state])
                self.parts.append(dot)


def _errors(records: Records, at: Thresholds, top: float) -> list[Markup]:
    errors = [record.found.expected_mm for record in records]
    known = [error for error in errors if error is not None]
    # A calibration that says nothing of its own error expects none.
    if not any(known):
        words = "No verification tells an expected error: they are of scans, or the calibration does not tell its own."
        return [shape("text", words, x=_LEFT, y=top + 20)]
    stated = next((record.found.stated_mm for record in reversed(records) if record.found.stated_mm), 0.0)
    panel = _Panel(records, top, max(*known, 1.2 * at.watch_error_ratio * stated), "Expected error of a scan, mm")
    if stated:
        panel.limit(stated, "stated", _COLOURS[HealthState.UNKNOWN])
        for state, ratio in ((HealthState.WATCH, at.watch_error_ratio), (HealthState.STALE, at.stale_error_ratio)):
            panel.limit(ratio * stated, f"{state}, {ratio:g} x", _COLOURS[state])
    panel.line(errors, _PALE)
    panel.dots(errors)
    for number, state in enumerate((HealthState.GOOD, HealthState.WATCH, HealthState.STALE)):
        x = _END - 190 + 64 * number
        panel.parts.append(shape("circle", cx=x, cy=top - 16, r=3.2, fill=_COLOURS[state]))
        panel.parts.append(shape("text", str(state), x=x + 8, y=top - 12))
    return panel.parts


def _residuals(records: Records, at: Thresholds, top: float) -> list[Markup]:
    all_pairs = [{(pair.first, pair.second): pair for pair in record.found.pairs} for record in records]
    known = [max(pair.rms_px, abs(pair.mean_px)) for pairs in all_pairs for pair in pairs.values()]
    panel = _Panel(records, top, max([*known, 1.2 * at.watch_mean_px]), "Disagreement of two devices, px")
    panel.limit(at.watch_mean_px, "watch (mean)", _COLOURS[HealthState.WATCH])
    panel.limit(at.stale_mean_px, "stale (mean)", _COLOURS[HealthState.STALE])
    for number, name in enumerate(dict.fromkeys(name for pairs in all_pairs for name in pairs)):
        colour, x = _LINES[number % len(_LINES)], _LEFT + 256 + 130 * number
        panel.line([abs(pairs[name].mean_px) if name in pairs else None for pairs in all_pairs], colour)
        panel.line([pairs[name].rms_px if name in pairs else None for pairs in all_pairs], colour, wide=0.7)
        panel.parts.append(shape("path", d=f"M{x:.1f} {top - 16:.1f}h14", stroke=colour, stroke_width=2))
        panel.parts.append(shape("text", " - ".join(name), x=x + 18, y=top - 12))
    note = shape("text", "thick: mean, thin: rms", x=_END, y=top + _PANEL + 36, class_="faint end")
    return [*panel.parts, note]


def _recalibrations(records: Records, bottom: float) -> list[Markup]:
    parts = []
    for before, after in pairwise(records):
        if before.calibration != after.calibration:
            x = (_x(records, before.at) + _x(records, after.at)) / 2
            parts.append(shape("path", d=f"M{x:.1f} {_TOP}V{bottom:.1f}", stroke=_INK, stroke_dasharray="2 3"))
            parts.append(shape("text", "calibrated", x=x + 4, y=_TOP + 12))
    return parts


def _round_step(step: float) -> float:
    size = 10.0 ** math.floor(math.log10(step))
    return next(factor * size for factor in (1, 2, 2.5, 5, 10) if factor * size >= step * 0.999)
