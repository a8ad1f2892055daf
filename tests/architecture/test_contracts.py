"""The dependency rule is held by import-linter, and import-linter notices when it is broken."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("slrig", "drivers", "simulated_rig")


def _lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `lint-imports` on the checkout in `folder`, which hides any installed slrig."""
    # The module that the command `lint-imports` starts; a child, so that its imports do not stay in this process.
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]
    return subprocess.run(  # noqa: S603 - our own interpreter and a fixed command
        [*command, "--no-cache"],
        cwd=folder,
        env={"PYTHONPATH": str(folder), "PATH": "", "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the source that a test may spoil."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_the_contracts_are_kept() -> None:
    result = _lint(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_broken_contracts_are_noticed(checkout: Path) -> None:
    with (checkout / "slrig" / "bundle" / "storage.py").open("a") as file:
        file.write("\nimport slrig.discovery\n")
    with (checkout / "slrig" / "patterns" / "gray.py").open("a") as file:
        file.write("\nimport pydantic\n")
    (checkout / "slrig" / "helpers.py").write_text('"""A room that is not in the plan."""\n')
    result = _lint(checkout)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "slrig.bundle is not allowed to import slrig.discovery" in result.stdout
    assert "slrig.patterns is not allowed to import pydantic" in result.stdout
    assert "slrig.helpers" in result.stdout
