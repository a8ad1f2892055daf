"""The history of a rig's health as one SVG picture: expected error, residuals, thresholds, recalibrations."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise

from markupsafe import Markup

from slrig.calibrate.verification import VerificationRecord
from slrig.calibration.health import THRESHOLDS, HealthState, Thresholds
from slrig.reports.drawing import shape
from slrig.reports.trend import (
    END,
    GAP,
    GREEN,
    GREY,
    INK,
    LEFT,
    ORANGE,
    PALE,
    PANEL,
    RED,
    TOP,
    Panel,
    nothing_yet,
    times,
    trend,
    x_of,
)

HEIGHT = 470.0
_COLOURS = {HealthState.GOOD: GREEN, HealthState.WATCH: ORANGE, HealthState.STALE: RED, HealthState.UNKNOWN: GREY}
_LINES = ("#1c4e80", "#7a3e9d", "#00798c", "#8a5a00", "#5b6b1f", "#a3336b")

Records = Sequence[VerificationRecord]


def health_svg(records: Records, /, *, thresholds: Thresholds = THRESHOLDS) -> Markup:
    """The picture of verifications, oldest first. With none it says so in words."""
    if not records:
        return nothing_yet("Nothing was verified yet. POST /rig/verification shoots one.")
    second = TOP + PANEL + GAP
    parts = [
        *_errors(records, thresholds, TOP),
        *_residuals(records, thresholds, second),
        *_recalibrations(records, second + PANEL),
        *times(_moments(records), second + PANEL),
    ]
    words = f"health of the rig over {len(records)} verifications, now {records[-1].health.state}"
    return trend(words, HEIGHT, parts)


def _moments(records: Records) -> list[datetime]:
    return [record.at for record in records]


def _errors(records: Records, at: Thresholds, top: float) -> list[Markup]:
    errors = [record.found.expected_mm for record in records]
    known = [error for error in errors if error is not None]
    # A calibration that says nothing of its own error expects none.
    if not any(known):
        words = "No verification tells an expected error: they are of scans, or the calibration does not tell its own."
        return [shape("text", words, x=LEFT, y=top + 20)]
    stated = next((record.found.stated_mm for record in reversed(records) if record.found.stated_mm), 0.0)
    panel = Panel(
        _moments(records), top, max(*known, 1.2 * at.watch_error_ratio * stated), "Expected error of a scan, mm"
    )
    if stated:
        panel.limit(stated, "stated", _COLOURS[HealthState.UNKNOWN])
        for state, ratio in ((HealthState.WATCH, at.watch_error_ratio), (HealthState.STALE, at.stale_error_ratio)):
            panel.limit(ratio * stated, f"{state}, {ratio:g} x", _COLOURS[state])
    panel.line(errors, PALE, of=[record.calibration for record in records])
    for record, error in zip(records, errors, strict=True):
        if error is not None:
            words = f"{record.health.state}. {'; '.join(record.health.reasons)}"
            panel.dot(record.at, error, _COLOURS[record.health.state], words)
    for number, state in enumerate((HealthState.GOOD, HealthState.WATCH, HealthState.STALE)):
        x = END - 190 + 64 * number
        panel.parts.append(shape("circle", cx=x, cy=top - 16, r=3.2, fill=_COLOURS[state]))
        panel.parts.append(shape("text", str(state), x=x + 8, y=top - 12))
    return panel.parts


def _residuals(records: Records, at: Thresholds, top: float) -> list[Markup]:
    all_pairs = [{(pair.first, pair.second): pair for pair in record.found.pairs} for record in records]
    known = [max(pair.rms_px, abs(pair.mean_px)) for pairs in all_pairs for pair in pairs.values()]
    panel = Panel(_moments(records), top, max([*known, 1.2 * at.watch_mean_px]), "Disagreement of two devices, px")
    panel.limit(at.watch_mean_px, "watch (mean)", _COLOURS[HealthState.WATCH])
    panel.limit(at.stale_mean_px, "stale (mean)", _COLOURS[HealthState.STALE])
    of = [record.calibration for record in records]
    for number, name in enumerate(dict.fromkeys(name for pairs in all_pairs for name in pairs)):
        colour, x = _LINES[number % len(_LINES)], LEFT + 256 + 130 * number
        panel.line([abs(pairs[name].mean_px) if name in pairs else None for pairs in all_pairs], colour, of=of)
        panel.line([pairs[name].rms_px if name in pairs else None for pairs in all_pairs], colour, of=of, wide=0.7)
        panel.parts.append(shape("path", d=f"M{x:.1f} {top - 16:.1f}h14", stroke=colour, stroke_width=2))
        panel.parts.append(shape("text", " - ".join(name), x=x + 18, y=top - 12))
    note = shape("text", "thick: mean, thin: rms", x=END, y=top + PANEL + 36, class_="faint end")
    return [*panel.parts, note]


def _recalibrations(records: Records, bottom: float) -> list[Markup]:
    parts = []
    for before, after in pairwise(records):
        if before.calibration != after.calibration:
            x = (x_of(_moments(records), before.at) + x_of(_moments(records), after.at)) / 2
            parts.append(shape("path", d=f"M{x:.1f} {TOP}V{bottom:.1f}", stroke=INK, stroke_dasharray="2 3"))
            parts.append(shape("text", "calibrated", x=x + 4, y=TOP + 12))
    return parts
