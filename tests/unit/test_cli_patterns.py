"""`slrig patterns` where there is nothing to flash; where there is, tests/e2e/test_live_rig.py uses it."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from slrig.cli.commands import app
from tests.e2e.conftest import write_rig


def test_a_projector_that_shows_any_pattern_needs_none_written(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["patterns", str(write_rig(tmp_path))])
    assert done.exit_code == 2
    assert "shows any pattern: nothing to flash" in " ".join(done.stderr.split())
    assert {path.name for path in tmp_path.iterdir()} == {"rig.toml", "scene.toml"}
