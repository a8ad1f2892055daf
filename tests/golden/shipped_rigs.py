"""Rigs of `slrig/examples/rigs`, with some of their text or of their scene's replaced."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

from slrig.examples import EXAMPLES

SMALL = {
    "size_px = [480, 384]": "size_px = [240, 192]",
    "principal_px = [241.4, 189.7]": "principal_px = [121.4, 93.7]",
}
"""Of the relief's rig: the middle quarter of its camera's image."""
GRAINY = 'texture = { kind = "noise", contrast = 0.25, scale_mm = 6.0 }'
PAINT = f"albedo = 0.85\n{GRAINY}"
"""Of the relief."""


def rig_file(folder: Path, rig: str, *, scene: Mapping[str, str], head: Mapping[str, str]) -> Path:
    """A rig and its scene in a folder, each with some of its text replaced."""
    text = (EXAMPLES / "rigs" / f"{rig}.toml").read_text(encoding="utf-8")
    name = tomllib.loads(text)["head"]["scene"]
    (folder / "scene.toml").write_text(replaced((EXAMPLES / "rigs" / name).read_text(encoding="utf-8"), scene))
    path = folder / "rig.toml"
    path.write_text(replaced(text, {name: "scene.toml", **head}))
    return path


def replaced(text: str, changes: Mapping[str, str]) -> str:
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text
