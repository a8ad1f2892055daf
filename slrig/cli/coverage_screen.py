"""What the poses so far cover, as a picture in the terminal: cells of every image, and what is still wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

_SHADES = ("", "bold #10301c on #8fd19e", "bold #10301c on #5cb57c", "bold white on #338857", "bold white on #1f6b41")
"""By how many poses cover a cell, the last for all above."""

_TARGET = "bold black on #f2c14e"
_EMPTY, _BEYOND = "·", " "


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
        blocks.append(Group(Text(name, style="bold"), *_rows(device, aim), *_facts(device)))
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


def _facts(device: Mapping[str, Any]) -> list[Text]:
    about_across, about_down = device["tilted"]
    facts = [
        f"{device['share']:.0%} of the cells",
        f"{_counted(device['depths'], 'distance')}, {_counted(device['turns'], 'turn')}",
        f"tilted {about_across} × up-down, {about_down} × left-right",
    ]
    near, far = device["distance_mm"]
    if near is not None and far is not None:
        facts.append(f"{near:.0f} mm away" if f"{near:.0f}" == f"{far:.0f}" else f"{near:.0f} to {far:.0f} mm away")
    return [Text(each, style="dim") for each in facts]


def _counted(count: int, what: str) -> str:
    """A number of things.

    >>> _counted(1, "turn"), _counted(3, "turn")
    ('1 turn', '3 turns')
    """
    return f"{count} {what}{'s' * (count != 1)}"


def _aim(next_move: Mapping[str, Any] | None, name: str, sizes_px: Mapping[str, Sequence[int]]) -> list[list[bool]]:
    """For each cell whether its middle lies in the outline where the board should go; empty where nothing tells."""
    if next_move is None or next_move.get("camera") != name or name not in sizes_px:
        return []
    outline = next_move.get("outline_px") or []
    if len(outline) < 3:
        return []
    width, height = sizes_px[name]
    cells = 6
    middles = [
        [((column + 0.5) / cells * width, (row + 0.5) / cells * height) for column in range(cells)]
        for row in range(cells)
    ]
    return [[_inside(x, y, outline) for x, y in row] for row in middles]


def _inside(x: float, y: float, outline: Sequence[Sequence[float]]) -> bool:
    """Whether a point lies in a polygon: a line from it to the right crosses the border an odd number of times.

    >>> _inside(1, 1, [(0, 0), (2, 0), (2, 2), (0, 2)]), _inside(3, 1, [(0, 0), (2, 0), (2, 2), (0, 2)])
    (True, False)
    """
    crossings = 0
    for (x1, y1), (x2, y2) in zip(outline, [*outline[1:], outline[0]], strict=True):
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
            crossings += 1
    return crossings % 2 == 1
