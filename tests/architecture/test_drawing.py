"""The architecture page: its drawing is current, and the names on it exist."""

from __future__ import annotations

import importlib
import re

import pytest

from tests.architecture.drawing import DRAWING, ROOT, drawing

PAGE = (ROOT / "slrig" / "README.md").read_text(encoding="utf-8")


def test_the_drawing_is_current() -> None:
    assert DRAWING.read_text(encoding="utf-8") == drawing(), "run: python -m tests.architecture.drawing"


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(slrig(?:\.\w+)+)`", PAGE))))
def test_a_name_on_the_architecture_page_exists(name: str) -> None:
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            found = getattr(found, attribute)
        return
