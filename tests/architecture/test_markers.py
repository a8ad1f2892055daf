"""CI collects tests with some markers from a few places only: there are none elsewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("marker", ["alone", "one_core"])
def test_ci_collects_every_test_with_a_marker(marker: str) -> None:
    (command,) = re.findall(rf"^pytest -m {marker} .*$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    places = [ROOT / word for word in shlex.split(command) if word.startswith("tests/")]
    assert places
    marked = [path for path in (ROOT / "tests").rglob("*.py") if f"mark.{marker}" in path.read_text(encoding="utf-8")]
    assert marked
    assert [str(path) for path in marked if not any(path.is_relative_to(place) for place in places)] == []
