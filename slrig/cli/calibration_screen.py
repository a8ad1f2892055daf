"""A calibration on one screen: what a solve found, or what the poses so far cover and what is still wanted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from rich.console import Console, Group
from rich.table import Column, Table
from rich.text import Text

from slrig.calibrate.words import rounded
from slrig.calibration import CELLS, MIN_HALVED_POSES
from slrig.cli.display import counted, plain_table
from slrig.errors import ConfigError
from slrig.printable import printable

_COLOURS = {"good": "green", "usable": "yellow"}
_NAMES = {
    "fx": "focal x, px",
    "fy": "focal y, px",
    "cx": "principal x, px",
    "cy": "principal y, px",
}
_DIFFERENCES = {
    "focal_percent": "focal length, %",
    "principal_px": "principal point, px",
    "rotation_deg": "turned, °",
    "baseline_mm": "baseline, mm",
}
_MOST_REASONS, _MOST_REMARKS = 4, 3
_MOST_POSES = 6

_SHADES = ("", "bold #10301c on #8fd19e", "bold #10301c on #5cb57c", "bold white on #338857", "bold white on #1f6b41")
"""By how many poses cover a cell, the last for all above."""

_TARGET = "bold black on #f2c14e"
_EMPTY, _BEYOND = "·", " "


def outcome(pose: Mapping[str, Any]) -> str:
    """What became of a pose, as the service tells of it, in a word."""
    words: dict[bool | None, str] = {True: "accepted", False: "refused", None: pose["state"]}
    return words[pose["accepted"]]


def refused(session: Mapping[str, Any]) -> dict[str, str]:
    """By name, why the poses of a session were refused that were."""
    return {pose["name"]: pose["error"]["detail"] for pose in session["shot"] if pose["accepted"] is False}


def tell_session(session: Mapping[str, Any]) -> None:
    """Print a calibration that a service keeps: its result, or what it covers and what to do next."""
    console = Console()
    board = "imported" if session["board"] is None else session["board"]["title"]
    heading = [session["id"], session["label"], f"rig '{session['rig']}'", board, session["state"]]
    console.print(Text(printable(" · ".join(each for each in heading if each)), style="bold"))
    if session["active"]:
        console.print("Scans use it.", style="green")
    if session["result"] is not None:
        console.print()
        tell_result({**session["result"], "refused": refused(session)}, console)
    if session["error"] is not None:
        console.print(Text(session["error"]["detail"], style="red"))
    if session["coverage"] is not None and session["state"] != "solved":
        console.print()
        console.print(coverage_picture(session["coverage"], session["next_move"], {}))
        tell_next(session["next_move"], console)


def tell_comparison(found: Mapping[str, Any]) -> None:
    """Print what the second of two calibrations says otherwise than the first."""
    console = Console()
    for words in found["words"]:
        console.print(_listed("·", words))
    table = plain_table("second − first", *(Column(Text(name), justify="right") for name in found["devices"]))
    for key, words in _DIFFERENCES.items():
        table.add_row(words, *(_difference(device[key]) for device in found["devices"].values()))
    console.print()
    console.print(table)


def checked(document: Mapping[str, Any]) -> dict[str, Any]:
    """Of what `pose_judging.summary` holds, the check by odd and even poses, and what it stands beside.

    Raises ConfigError where there is none: too few poses, or solved before solves were checked.
    """
    if document.get("odd_even") is None:
        message = (
            f"odd and even poses were not solved apart: expected {MIN_HALVED_POSES} poses or more, each half of which "
            f"determines a calibration, found {len(document['poses'])} that could be used. Add poses, and solve again; "
            "what was solved before solves were checked so is checked by that, too"
        )
        raise ConfigError(message)
    return {key: document[key] for key in ("odd_even", "expected", "poses", "outliers")}


def tell_check(found: Mapping[str, Any]) -> None:
    """Print what `checked` returns."""
    console, halves = Console(), found["odd_even"]
    console.print(_listed("·" if halves["fits"] else "!", halves["words"]))
    console.print()
    table = plain_table(Column(style="bold", no_wrap=True), Column(), show_header=False)
    table.add_row("poses", f"{halves['poses'][0]} odd, {halves['poses'][1]} even")
    table.add_row("difference", f"{_mm(halves['difference_mm'])}, rms over the volume")
    table.add_row(
        "stated", f"{_mm(halves['stated_mm'])} (1 σ) for it; {_mm(found['expected']['point_mm'])} for all poses"
    )
    table.add_row("taken out", f"{rounded(halves['turn_deg'])}° and {_mm(halves['shift_mm'])}, which change no shape")
    console.print(table)


def tell_result(document: Mapping[str, Any], console: Console) -> None:
    """Print what `pose_judging.summary` of a session holds, and which poses were `refused` or have `remarks`."""
    verdict = document["verdict"]
    words = verdict["grade"].replace("_", " ")
    mark = (f" {words.upper()} ", f"bold reverse {_COLOURS.get(verdict['grade'], 'red')}")
    # The summary without the verdict's own word, which stands before it already.
    console.print(Text.assemble(mark, f"  {verdict['summary'].removeprefix(words).lstrip(':; ')}"))
    for reason in verdict["reasons"][:_MOST_REASONS]:
        console.print(_listed("·", reason))
    more = len(verdict["reasons"]) - _MOST_REASONS
    if more > 0:
        console.print(f"   and {more} more, in the report and in --json", style="dim", highlight=False)
    for remark in verdict.get("remarks", ())[:_MOST_REMARKS]:
        console.print(_listed("·", remark), style="dim")
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


def _devices(devices: Mapping[str, Mapping[str, Any]]) -> Table:
    # Three devices with all their lens terms just fit on 80 columns.
    heads = (Column("", no_wrap=True), *(Column(Text(name), justify="right") for name in devices))
    table = plain_table(*heads, padding=(0, 0, 0, 1))
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
    table = plain_table(Column(style="bold", no_wrap=True), Column(), show_header=False)
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
    if expected.get("board_mm"):
        words += f"; of the point's error {_mm(expected['board_mm'])} by the size of the board"
    table.add_row("error", words)
    if (halves := document.get("odd_even")) is not None:
        apart = f"odd and even poses differ by {_mm(halves['difference_mm'])}, {halves['ratio']:.2f} × what is stated"
        table.add_row("check", f"{apart} for halves")
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
    heads = (Column(style="bold", no_wrap=True), Column(no_wrap=True), Column(overflow="fold"))
    table = plain_table(*heads, show_header=False)
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


def _difference(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if found["sigma"] is None:
        return f"{found['value']:+.4f}"
    return f"{found['value']:+.4f} ± {found['sigma']:.4f} ({found['sigmas']:.1f} σ)"


def coverage_picture(
    coverage: Mapping[str, Any], next_move: Mapping[str, Any] | None, sizes_px: Mapping[str, Sequence[int]]
) -> Group:
    """Cells of each device side by side, each with the number of poses that it was seen in; then what is wanted.

    coverage, next_move : as a calibration session tells them over HTTP. sizes_px : (width, height) by camera: with it
    the cells where the board should go next are marked.
    """
    table = Table.grid(padding=(0, 4, 0, 0))
    blocks = []
    for name, device in coverage.get("devices", {}).items():
        aim = _aim(next_move, name, sizes_px)
        blocks.append(Group(Text(name, style="bold"), *_rows(device, aim), *_covered(device)))
    if blocks:
        table.add_row(*blocks)
    wanted = Table.grid(padding=(0, 2))
    for at, each in enumerate(coverage.get("missing", ())):
        wanted.add_row(Text("wanted" if at == 0 else "", style="bold"), Text(each, style="dim"))
    return Group(table, Text(""), wanted) if wanted.row_count else Group(table)


def tell_next(next_move: Mapping[str, Any] | None, console: Console) -> None:
    """Print what to do with the board next, and why."""
    if next_move is None:
        return
    heading, style = ("enough", "bold green") if next_move["enough"] else ("next", "bold #f2c14e")
    table = Table.grid(padding=(0, 2))
    table.add_row(Text(heading, style=style), Text(next_move["words"]))
    console.print(table)


def _rows(device: Mapping[str, Any], aim: Sequence[Sequence[bool]]) -> list[Text]:
    rows = []
    reachable = device.get("reachable")
    for row, counts in enumerate(device["cells"]):
        line = Text()
        for column, count in enumerate(counts):
            here = reachable is None or reachable[row][column]
            mark = str(min(int(count), 9)) if count else _EMPTY if here else _BEYOND
            aimed = bool(aim) and aim[row][column]
            style = _TARGET if aimed else _SHADES[min(int(count), len(_SHADES) - 1)]
            # Brackets where colours do not show.
            line.append(f"[{mark}]" if aimed else f" {mark} ", style=style or "dim")
        rows.append(line)
    return rows


def _covered(device: Mapping[str, Any]) -> list[Text]:
    about_across, about_down = device["tilted"]
    facts = [
        f"{device['share']:.0%} of the cells",
        f"{counted(device['depths'], 'distance')}, {counted(device['turns'], 'turn')}",
        f"tilted {about_across} × up-down, {about_down} × left-right",
    ]
    near, far = device["distance_mm"]
    if near is not None and far is not None:
        facts.append(f"{near:.0f} mm away" if f"{near:.0f}" == f"{far:.0f}" else f"{near:.0f} to {far:.0f} mm away")
    return [Text(each, style="dim") for each in facts]


def _aim(next_move: Mapping[str, Any] | None, name: str, sizes_px: Mapping[str, Sequence[int]]) -> list[list[bool]]:
    """For each cell whether its middle lies in the outline where the board should go; empty where nothing tells."""
    if next_move is None or next_move.get("camera") != name or name not in sizes_px:
        return []
    outline = next_move.get("outline_px") or []
    if len(outline) < 3:
        return []
    polygon = np.array(outline, np.float32)
    xs, ys = ((np.arange(CELLS) + 0.5) / CELLS * side for side in sizes_px[name])
    return [[cv2.pointPolygonTest(polygon, (x, y), measureDist=False) > 0 for x in xs] for y in ys]
