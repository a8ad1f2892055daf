"""Draws the rooms of slrig on their floors: `python -m tests.architecture.drawing` writes .github/architecture.svg."""

from __future__ import annotations

import ast
import textwrap
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DRAWING = ROOT / ".github" / "architecture.svg"

_WIDTH, _MARGIN, _GAP = 1180, 20, 6
_PER_ROW = 6
_LINE_HEIGHT = 14
_LETTERS_PER_PX = 1 / 5.6
_STYLE = (
    "text{font-family:sans-serif;font-size:11px;fill:#1f2933}.name{font-weight:bold;font-size:13px}"
    ".floor{fill:#f3f5f7}.room{fill:#ffffff;stroke:#9aa5b1}.other{fill:#e6f0ea;stroke:#9aa5b1}"
)


def floors() -> list[list[str]]:
    """The layers of the import contract, from top to bottom."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(each["layers"] for each in contracts if each.get("containers") == ["slrig"])
    return [[name.strip() for name in layer.split("|")] for layer in layers]


def subject(package: str) -> str:
    """The first sentence of a package's or module's docstring."""
    base = ROOT.joinpath(*package.split("."))
    path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.split("\n\n")[0].replace("\n", " ").partition(". ")[0].rstrip(".")


def drawing() -> str:
    """The SVG: one band a layer, in which a room may import from lower bands only."""
    body: list[str] = []
    y = _MARGIN
    entries = ["drivers", "simulated_rig"]
    y += _band(body, y, [(name, subject(name)) for name in entries], kind="other")
    for floor in floors():
        y += _band(body, y, [(name, subject(f"slrig.{name}")) for name in floor], kind="room")
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {y}" width="{_WIDTH}" height="{y}">'
    return "\n".join([head, f"<style>{_STYLE}</style>", *body, "</svg>", ""])


def _band(body: list[str], top: int, rooms: list[tuple[str, str]], *, kind: str) -> int:
    """Draw one layer from `top` down, and return its height with the gap below it."""
    y = top + _GAP
    boxes: list[str] = []
    for start in range(0, len(rooms), _PER_ROW):
        row = rooms[start : start + _PER_ROW]
        width = (_WIDTH - 2 * _MARGIN - (len(row) - 1) * _GAP) // len(row)
        texts = [textwrap.wrap(about, int((width - 16) * _LETTERS_PER_PX)) for _, about in row]
        height = 26 + max(map(len, texts)) * _LINE_HEIGHT
        for column, ((name, _), lines) in enumerate(zip(row, texts, strict=True)):
            x = _MARGIN + column * (width + _GAP)
            boxes.append(f'<rect class="{kind}" x="{x}" y="{y}" width="{width}" height="{height}" rx="4"/>')
            boxes.append(f'<text class="name" x="{x + 8}" y="{y + 17}">{escape(name)}</text>')
            for number, line in enumerate(lines, 1):
                boxes.append(f'<text x="{x + 8}" y="{y + 17 + number * _LINE_HEIGHT}">{escape(line)}</text>')
        y += height + _GAP
    body.append(f'<rect class="floor" x="0" y="{top}" width="{_WIDTH}" height="{y - top}"/>')
    body += boxes
    return y - top + _GAP // 2


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
