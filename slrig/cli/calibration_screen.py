"""A solved calibration told on one screen: the verdict, the error in mm, the devices, what was left out and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from slrig.calibrate.words import rounded

_COLOURS = {"good": "green", "usable": "yellow"}
_NAMES = {
    "fx": "focal x, px",
    "fy": "focal y, px",
    "cx": "principal x, px",
    "cy": "principal y, px",
}
_MOST_REASONS = 4
_MOST_POSES = 6


def outcome(pose: Mapping[str, Any]) -> str:
    """What became of a pose, as the service tells of it, in a word."""
    words: dict[bool | None, str] = {True: "accepted", False: "refused", None: pose["state"]}
    return words[pose["accepted"]]


def refused(session: Mapping[str, Any]) -> dict[str, str]:
    """By name, why the poses of a session were refused that were."""
    return {pose["name"]: pose["error"]["detail"] for pose in session["shot"] if pose["accepted"] is False}


def tell_result(document: Mapping[str, Any], console: Console) -> None:
    """Print what `pose_judging.summary` of a session holds, and which poses were `refused` or have `remarks`."""
    verdict = document["verdict"]
    words = verdict["grade"].replace("_", " ")
    heading = Text.assemble(
        (f" {words.upper()} ", f"bold reverse {_COLOURS.get(verdict['grade'], 'red')}"),
        f"  {_sentence(verdict['summary'], words)}",
    )
    console.print(heading)
    for words in document.get("scale", ()):
        console.print(_listed("!", words))
    for reason in verdict["reasons"][:_MOST_REASONS]:
        console.print(_listed("·", reason))
    more = len(verdict["reasons"]) - _MOST_REASONS
    if more > 0:
        console.print(f"   and {more} more, in the report and in --json", style="dim", highlight=False)
    console.print()
    console.print(_devices(document["devices"]))
    console.print()
    console.print(_figures(document))
    _tell_named(console, "left out", document["outliers"])
    _tell_named(console, "refused", document.get("refused", {}))
    remarks = {name: "; ".join(words) for name, words in document.get("remarks", {}).items() if words}
    _tell_named(console, "remarks", remarks)


def figure_words(value: float | None, sigma: float | None) -> str:
    """A number with its standard deviation to two digits, and so many decimals itself.

    >>> figure_words(1810.4, 0.213), figure_words(0.0, 0.0), figure_words(None, None)
    ('1810.40 ± 0.21', '0 (held)', '–')
    """
    if value is None:
        return "–"
    if not sigma:
        return f"{value:g} (held)"
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 9)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _sentence(summary: str, words: str) -> str:
    """The summary without the verdict's own word, which stands before it already.

    >>> _sentence("good: a point is expected within 0.01 mm", "good")
    'a point is expected within 0.01 mm'
    """
    return summary.removeprefix(words).lstrip(":; ")


def _devices(devices: Mapping[str, Mapping[str, Any]]) -> Table:
    # Three devices with all their lens terms just fit on 80 columns.
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 0, 0, 1))
    table.add_column("", no_wrap=True)
    for name in devices:
        table.add_column(Text(name), justify="right")
    found = list(devices.values())
    table.add_row("rms, px", *(_px(device["rms_px"]) for device in found), style="bold")
    table.add_row("held out, px", *(_held_out(device) for device in found))
    table.add_row("noise alone, px", *(_px(device["stated_rms_px"]) for device in found))
    for key, name in _NAMES.items():
        table.add_row(name, *(figure_words(*device["values"][key]) for device in found))
    for term in dict.fromkeys(term for device in found for term in device["distortion"]):
        cells = (figure_words(*device["values"].get(term, (None, None))) for device in found)
        table.add_row(f"lens {term}", *cells)
    return table


def _figures(document: Mapping[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    expected = document["expected"]
    low, high = expected["volume_mm"]
    sides = " × ".join(f"{most - least:.0f}" for least, most in zip(low, high, strict=True))
    # Results on record from before one camera could be calibrated alone do not say across.
    way = "across the line of sight " if expected.get("across") else ""
    words = f"a point {_mm(expected['point_mm'])} (1 σ) {way}by the calibration"
    if expected["total_mm"] is not None:
        words += f", {_mm(expected['total_mm'])} with its noise"
    if expected["length_share"] is not None:
        words += f"; a length {rounded(1000 * expected['length_share'])} mm per metre"
    table.add_row("error", words)
    table.add_row("volume", f"{sides} mm, where the board was held")
    for pair in document["baselines"]:
        length = figure_words(pair["length_mm"]["value"], pair["length_mm"]["sigma"])
        names = Text(f"{pair['first']} – {pair['second']}: {length} mm apart, at {pair['angle_deg']['value']:.1f}°")
        table.add_row("baseline", names)
    if document.get("board"):
        table.add_row("board", Text(document["board"]["words"].removeprefix("the board ")))
    left_out, refused = len(document["outliers"]), len(document.get("refused", {}))
    table.add_row("poses", f"{len(document['poses'])} used of {len(document['poses']) + left_out + refused}")
    return table


def _tell_named(console: Console, heading: str, words: Mapping[str, str]) -> None:
    if not words:
        return
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for at, (name, reason) in enumerate(list(words.items())[:_MOST_POSES]):
        table.add_row(heading if at == 0 else "", Text(name), Text(reason))
    if len(words) > _MOST_POSES:
        table.add_row("", f"and {len(words) - _MOST_POSES} more", "")
    console.print(table)


def _listed(mark: str, words: str) -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_row(f" {mark}", Text(words, overflow="fold"))
    return table


def _px(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{rounded(value)} mm"


def _held_out(device: Mapping[str, Any]) -> str:
    held, rms = device["held_out_rms_px"], device["rms_px"]
    if held is None or not rms:
        return "too few poses"
    return f"{held:.3f} (× {held / rms:.2f})"
