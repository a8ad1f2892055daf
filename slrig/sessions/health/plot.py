"""The history of a rig's health as one SVG picture: expected error, residuals, thresholds, recalibrations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from functools import partial
from itertools import pairwise

from slrig.calibration.health.verdict import THRESHOLDS, HealthState, Thresholds
from slrig.sessions.calibration.charts import drawing
from slrig.sessions.health.store import VerificationRecord
from slrig.sessions.markup import Markup, joined, tag

WIDTH, HEIGHT = 760.0, 470.0
_LEFT, _RIGHT = 64.0, 118.0
_TOP, _PANEL, _GAP = 34.0, 168.0, 52.0
_COLOURS = {
    HealthState.GOOD: "#2b7a4b",
    HealthState.WATCH: "#c77700",
    HealthState.STALE: "#b3261e",
    HealthState.UNKNOWN: "#6b7280",
}
_LINES = ("#1c4e80", "#7a3e9d", "#00798c", "#8a5a00", "#5b6b1f", "#a3336b")
_INK, _FAINT = "#1f2937", "#d8dee6"
_STEPS_S = (60, 300, 900, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 1209600, 2592000, 7776000, 31536000)
_STYLE = (
    "text{font:11px system-ui,sans-serif;fill:#1f2937}.title{font-size:13px;font-weight:600}"
    ".end{text-anchor:end}.middle{text-anchor:middle}.faint{fill:#6b7280}"
)

Value = Callable[[VerificationRecord], float | None]


def health_svg(records: Sequence[VerificationRecord], /, *, thresholds: Thresholds = THRESHOLDS) -> Markup:
    """The picture of verifications, oldest first. With none it says so in words."""
    if not records:
        words = "Nothing was verified yet. POST /rig/verification shoots one."
        text = tag("text", words, x=WIDTH / 2, y=60, class_="middle")
        return drawing(WIDTH, 120, words, [tag("style", _STYLE), text])
    axis = _Time(records)
    second = _TOP + _PANEL + _GAP
    last = records[-1]
    words = f"health of the rig over {len(records)} verifications, now {last.health.state}"
    return drawing(
        WIDTH,
        HEIGHT,
        words,
        [
            tag("style", _STYLE),
            tag("rect", width=WIDTH, height=HEIGHT, fill="#ffffff"),
            _errors(records, axis, _TOP, thresholds),
            _residuals(records, axis, second, thresholds),
            _recalibrations(records, axis),
            axis.drawn(second + _PANEL),
        ],
    )


class _Time:
    """The horizontal axis."""

    def __init__(self, records: Sequence[VerificationRecord]) -> None:
        self.first, self.last = records[0].at, records[-1].at
        self._span_s = max((self.last - self.first).total_seconds(), 60.0)

    def x(self, at: datetime) -> float:
        wide = WIDTH - _LEFT - _RIGHT
        return _LEFT + wide * (at - self.first).total_seconds() / self._span_s

    def drawn(self, y: float) -> Markup:
        step_s = next((step for step in _STEPS_S if self._span_s / step <= 7), _STEPS_S[-1])
        start = self.first.timestamp()
        moment = math.ceil(start / step_s) * step_s
        parts = []
        form = "%H:%M" if step_s < 86400 else "%d %b"
        while moment <= start + self._span_s:
            at = self.first + timedelta(seconds=moment - start)
            parts.append(tag("path", d=f"M{self.x(at):.1f} {y:.1f}v5", stroke=_INK))
            parts.append(tag("text", at.strftime(form), x=self.x(at), y=y + 18, class_="middle"))
            moment += step_s
        day = f"{self.first:%d %b %Y %H:%M} to {self.last:%d %b %Y %H:%M} {self.first:%Z}"
        parts.append(tag("text", day, x=_LEFT, y=y + 36, class_="faint"))
        return joined(*parts)


class _Panel:
    """A panel with a vertical axis from 0."""

    def __init__(self, axis: _Time, top: float, most: float, title: str) -> None:
        self._axis, self._top = axis, top
        self._step = _round_step(max(most, 1e-9) * 1.15 / 4)
        self.most = self._step * math.ceil(max(most, 1e-9) * 1.08 / self._step)
        self.title = title

    def y(self, value: float) -> float:
        return self._top + _PANEL * (1 - min(max(value / self.most, 0.0), 1.0))

    def frame(self) -> Markup:
        parts = [tag("text", self.title, x=_LEFT, y=self._top - 12, class_="title")]
        for number in range(round(self.most / self._step) + 1):
            value = number * self._step
            y = self.y(value)
            parts.append(tag("path", d=f"M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}", stroke=_FAINT))
            parts.append(tag("text", f"{value:.4g}", x=_LEFT - 8, y=y + 4, class_="end"))
        return joined(*parts)

    def limit(self, value: float, words: str, colour: str) -> Markup | None:
        if value > self.most:
            return None
        y = self.y(value)
        return joined(
            tag("path", d=f"M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}", stroke=colour, stroke_dasharray="6 4"),
            tag("text", words, x=WIDTH - _RIGHT + 6, y=y + 4, fill=colour),
        )

    def line(self, records: Sequence[VerificationRecord], value: Value, colour: str, *, wide: float = 1.6) -> Markup:
        path, pen, calibration = [], "M", None
        for record in records:
            found = value(record)
            # A calibration begins a new line.
            pen = "M" if found is None or record.calibration != calibration else pen
            calibration = record.calibration
            if found is not None:
                path.append(f"{pen}{self._axis.x(record.at):.1f} {self.y(found):.1f}")
                pen = "L"
        return tag("path", d="".join(path) or "M0 0", fill="none", stroke=colour, stroke_width=wide)

    def dots(self, records: Sequence[VerificationRecord], value: Value) -> Markup:
        parts = []
        for record in records:
            found = value(record)
            if found is None:
                continue
            told = tag("title", f"{record.at:%d %b %H:%M}: {record.health.state}. {'; '.join(record.health.reasons)}")
            colour = _COLOURS[record.health.state]
            parts.append(tag("circle", told, cx=self._axis.x(record.at), cy=self.y(found), r=3.2, fill=colour))
        return joined(*parts)


def _errors(records: Sequence[VerificationRecord], axis: _Time, top: float, at: Thresholds) -> Markup:
    stated = next((record.look.stated_mm for record in reversed(records) if record.look.stated_mm), None)
    known = [record.look.expected_mm for record in records if record.look.expected_mm is not None]
    if not known:
        return tag("text", "No verification tells an expected error: they are all of scans.", x=_LEFT, y=top + 20)
    panel = _Panel(axis, top, max(*known, 1.2 * at.watch_error_ratio * (stated or 0.0)), "Expected error of a scan, mm")
    limits: list[Markup | None] = []
    if stated:
        limits = [panel.limit(stated, "stated", "#6b7280")]
        limits += [
            panel.limit(
                at.watch_error_ratio * stated, f"watch, {at.watch_error_ratio:g} x", _COLOURS[HealthState.WATCH]
            ),
            panel.limit(
                at.stale_error_ratio * stated, f"stale, {at.stale_error_ratio:g} x", _COLOURS[HealthState.STALE]
            ),
        ]

    def expected(record: VerificationRecord) -> float | None:
        return record.look.expected_mm

    legend = [
        joined(
            tag("circle", cx=WIDTH - _RIGHT - 190 + 64 * number, cy=top - 16, r=3.2, fill=_COLOURS[state]),
            tag("text", str(state), x=WIDTH - _RIGHT - 182 + 64 * number, y=top - 12),
        )
        for number, state in enumerate((HealthState.GOOD, HealthState.WATCH, HealthState.STALE))
    ]
    return joined(
        panel.frame(), *limits, panel.line(records, expected, "#9aa5b1"), panel.dots(records, expected), *legend
    )  # fmt: skip


def _residuals(records: Sequence[VerificationRecord], axis: _Time, top: float, at: Thresholds) -> Markup:
    pairs = list(dict.fromkeys((pair.first, pair.second) for record in records for pair in record.look.pairs))
    known = [max(pair.rms_px, abs(pair.mean_px)) for record in records for pair in record.look.pairs]
    panel = _Panel(axis, top, max([*known, 1.2 * at.watch_mean_px]), "Disagreement of two devices, px")
    lines: list[Markup] = []
    for number, (first, second) in enumerate(pairs):
        colour = _LINES[number % len(_LINES)]

        def of(record: VerificationRecord, name: str, first: str = first, second: str = second) -> float | None:
            for pair in record.look.pairs:
                if (pair.first, pair.second) == (first, second):
                    return abs(float(getattr(pair, name)))
            return None

        lines.append(panel.line(records, partial(of, name="mean_px"), colour))
        lines.append(panel.line(records, partial(of, name="rms_px"), colour, wide=0.7))
        x = _LEFT + 230 + 130 * number
        lines.append(tag("path", d=f"M{x:.1f} {top - 16:.1f}h14", stroke=colour, stroke_width=2))
        lines.append(tag("text", f"{first} - {second}", x=x + 18, y=top - 12))
    limits = (
        panel.limit(at.watch_mean_px, "watch (mean)", _COLOURS[HealthState.WATCH]),
        panel.limit(at.stale_mean_px, "stale (mean)", _COLOURS[HealthState.STALE]),
    )
    note = tag("text", "thick: mean, thin: rms", x=WIDTH - _RIGHT + 6, y=top + _PANEL + 4, class_="faint")
    return joined(panel.frame(), *limits, *lines, note)


def _recalibrations(records: Sequence[VerificationRecord], axis: _Time) -> Markup:
    bottom = _TOP + 2 * _PANEL + _GAP
    parts = []
    for before, after in pairwise(records):
        if before.calibration != after.calibration:
            x = (axis.x(before.at) + axis.x(after.at)) / 2
            parts.append(tag("path", d=f"M{x:.1f} {_TOP}V{bottom:.1f}", stroke=_INK, stroke_dasharray="2 3"))
            parts.append(tag("text", "calibrated", x=x + 4, y=_TOP + 12))
    return joined(*parts)


def _round_step(step: float) -> float:
    size = 10.0 ** math.floor(math.log10(step))
    return next(factor * size for factor in (1, 2, 2.5, 5, 10) if factor * size >= step * 0.999)
