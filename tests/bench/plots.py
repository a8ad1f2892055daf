"""Figures of the benches as SVG: the same bytes for the same numbers, on white, with text that stays text."""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

MOST_BYTES = 60_000
FIGURES = Path(__file__).parent / "figures"
# Okabe & Ito, "Color Universal Design": told apart by colour-blind eyes too.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#7f5539", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P")
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_COMMENT = re.compile(r"\s*<!--.*?-->", re.DOTALL)
_INDENT = re.compile(r"\n\s+")
_STYLE: Mapping[str, object] = {
    "svg.hashsalt": "slrig",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "legend.frameon": False,
}


def require_matplotlib() -> None:
    """Skip the bench where matplotlib is not installed."""
    pytest.importorskip("matplotlib", reason="the plots need matplotlib: pip install '.[bench]'")


@dataclass(frozen=True, slots=True)
class Curve:
    """Points joined in order, each with a text beside it. faint : dotted, in the colour of the curve before.

    ring : index of the point that stands for the default, None for no ring.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    texts: Sequence[str]
    ring: int | None = None
    faint: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """One set of axes. limit_y, limit_x : where a goal is drawn, None for none; ticks : (x, text), or matplotlib's."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    limit_y: float | None = None
    limit_x: float | None = None
    y_from: float | None = None
    y_to: float | None = None
    ticks: Sequence[tuple[float, str]] = ()


def write_figure(path: Path, panels: Sequence[Panel], *, title: str, columns: int, note: str) -> None:
    """Draw the panels side by side, `columns` in a row, and write them as one SVG of at most 60 kB.

    The folder of `path` must exist; nothing half written is left there.
    """
    matplotlib: Any = importlib.import_module("matplotlib")
    figures: Any = importlib.import_module("matplotlib.figure")
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(dict(_STYLE)):
        figure = figures.Figure(figsize=(3.1 * columns, 2.7 * rows + 0.9), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, place in enumerate(axes.flat):
            if index < len(panels):
                _draw(place, panels[index])
            else:
                place.set_visible(False)
        figure.suptitle(f"{title}\n{note}", fontsize=9)
        handles, labels = axes[0][0].get_legend_handles_labels()
        if len(labels) > 1 and all([c.label for c in panel.curves] == labels for panel in panels):
            figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
        else:
            for place, panel in zip(axes.flat, panels, strict=False):
                if len(panel.curves) > 1:
                    place.legend(fontsize=7)
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    # A hundredth of a point is finer than any screen.
    text = _LONG_NUMBER.sub(lambda found: f"{float(found[0]):.2f}", _COMMENT.sub("", drawn.getvalue()))
    text = _INDENT.sub("\n", text).replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")
    assert len(text) < MOST_BYTES, f"{path.name} has {len(text)} bytes, too many for a README: draw less"
    staged = path.with_suffix(".partial")
    staged.write_text(text, encoding="utf-8")
    staged.replace(path)


def _draw(place: Any, panel: Panel) -> None:
    number = -1
    for index, curve in enumerate(panel.curves):
        number += not curve.faint
        colour = COLOURS[number % len(COLOURS)]
        place.plot(
            curve.x, curve.y, label=curve.label, color=colour, linewidth=1.2,
            linestyle=":" if curve.faint else "-", marker="" if curve.faint else MARKERS[number % len(MARKERS)],
            markersize=4,
        )  # fmt: skip
        for x, y, text in zip(curve.x, curve.y, curve.texts, strict=True):
            if text:
                place.annotate(text, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6.5, color=colour)
        if curve.ring is not None and index == 0:
            place.plot(
                [curve.x[curve.ring]], [curve.y[curve.ring]], "o", markersize=11, markerfacecolor="white",
                markeredgecolor="black", zorder=1.5,
            )  # fmt: skip
    if panel.limit_y is not None:
        place.axhline(panel.limit_y, color="black", linestyle="--", linewidth=0.8)
    if panel.limit_x is not None:
        place.axvline(panel.limit_x, color="black", linestyle="--", linewidth=0.8)
    if panel.ticks:
        place.set_xticks([at for at, _ in panel.ticks], [text for _, text in panel.ticks])
    place.set_ylim(bottom=panel.y_from, top=panel.y_to)
    place.set_title(panel.title)
    place.set_xlabel(panel.x_label)
    place.set_ylabel(panel.y_label)
