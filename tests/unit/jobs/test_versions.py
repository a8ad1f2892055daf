"""What the bytes of a result depend on."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from slrig.jobs import versions as module


def test_two_states_of_one_version_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for code in ("", "", "one = 1"):
        (tmp_path / "kernel.py").write_text(code)
        monkeypatch.setattr(module, "_PACKAGE", tmp_path)
        module.versions.cache_clear()
        found.append(dict(module.versions()))
    module.versions.cache_clear()
    assert found[0] == found[1] != found[2]
    assert found[0]["numba"] == version("numba")
