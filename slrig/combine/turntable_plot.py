"""How the axis of a turntable has moved, as one SVG picture: every axis that was found, beside the first of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from slrig.bundle import AxisSource, ChangeEntry
from slrig.model import AXIS_SPAN_MM
from slrig.reports.drawing import shape
from slrig.reports.trend import (
    END,
    GAP,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PANEL,
    TOP,
    Panel,
    nothing_yet,
    times,
    trend,
)

_HEIGHT = 470.0
_COLOURS = {AxisSource.BOARD: GREY, AxisSource.DOCUMENT: GREY, AxisSource.MODEL: GREEN}


def turntable_svg(history: Sequence[ChangeEntry], /) -> Markup:
    """The picture of all axes that were found, from old to new. With none it says so in words."""
    if not history:
        return nothing_yet("No axis was found yet. POST /rig/turntable/axis calibrates one.")
    moments = [each.at for each in history]
    apart = [_apart(history[0], each) for each in history]
    second = TOP + PANEL + GAP
    turns = [each.direction_sigma_deg for each in history]
    ends = [each.point_sigma_mm + AXIS_SPAN_MM * np.deg2rad(each.direction_sigma_deg) for each in history]
    parts = _panel(
        history, f"From the first axis, up to {AXIS_SPAN_MM:g} mm along it, mm", TOP, [mm for mm, _ in apart], ends
    )
    parts += _panel(history, "Its direction from the first one's, °", second, [deg for _, deg in apart], turns)
    for number, (colour, words) in enumerate(((GREY, "board"), (GREEN, "model"), (ORANGE, "not taken"))):
        x = END - 190 + 64 * number
        parts += [shape("circle", cx=x, cy=TOP - 16, r=3.2, fill=colour), shape("text", words, x=x + 8, y=TOP - 12)]
    words = f"the axis of the turntable as it was found {len(history)} times, now {apart[-1][0]:.3g} mm from the first"
    return trend(words, _HEIGHT, [*parts, *times(moments, second + PANEL)])


def _panel(
    history: Sequence[ChangeEntry], title: str, top: float, values: Sequence[float], sigmas: Sequence[float]
) -> list[Markup]:
    most = max(value + sigma for value, sigma in zip(values, sigmas, strict=True))
    panel = Panel([each.at for each in history], top, most, title)
    taken = [value if each.taken else None for value, each in zip(values, history, strict=True)]
    panel.line(taken, PALE, of=[""] * len(taken))
    for each, value, sigma in zip(history, values, sigmas, strict=True):
        colour = _COLOURS[each.source] if each.taken else ORANGE
        words = f"{each.source} {each.of}: {value:.4g} ± {sigma:.2g}" + ("" if each.taken else ", not taken")
        panel.bar(each.at, value, sigma, colour)
        panel.dot(each.at, value, colour, words)
    return panel.parts


def _apart(first: ChangeEntry, later: ChangeEntry) -> tuple[float, float]:
    """How far two axes are apart at most, mm, up to 50 mm either way of the later one's point, and their angle, °."""
    way, other = np.array(first.direction), np.array(later.direction)
    ends = [np.array(later.point_mm) + s * other - np.array(first.point_mm) for s in (-AXIS_SPAN_MM, AXIS_SPAN_MM)]
    sine = min(float(np.linalg.norm(np.cross(way, other))), 1.0)
    return max(float(np.linalg.norm(np.cross(way, end))) for end in ends), float(np.rad2deg(np.arcsin(sine)))
