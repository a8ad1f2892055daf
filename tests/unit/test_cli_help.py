"""What `slrig` says of itself: help that fits a terminal, its version, and the words that a shell completes."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version

import pytest
import typer
from typer.testing import CliRunner

from slrig.cli.commands import app

COLUMNS = 80


def commands() -> list[tuple[str, ...]]:
    """Every command and group of commands, as it is typed."""
    found: list[tuple[str, ...]] = [()]

    def walk(group: object, words: tuple[str, ...]) -> None:
        for name, command in getattr(group, "commands", {}).items():
            found.append((*words, name))
            walk(command, (*words, name))

    walk(typer.main.get_command(app), ())
    return found


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_help_fits_a_terminal_of_80_columns(words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": str(COLUMNS)})
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= COLUMNS
    # Nothing is cut, neither an option's name nor the sentence beside a command's.
    assert [line for line in lines if ("..." in line or "…" in line) and not line.startswith("Usage:")] == []
    # And no text stands in a strip of a few words.
    indents = [len(line) - len(line.lstrip()) for line in lines if line.startswith("   ")]
    assert max(indents, default=0) <= COLUMNS // 2


def test_version_is_told_without_loading_what_scans() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"slrig {version('slrig')}\n")
    code = (
        "import sys, slrig.cli\nsys.argv = ['slrig', '--version']\n"
        "try: slrig.cli.main()\nexcept SystemExit: print(sorted({'numpy', 'rich', 'pydantic'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert found.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("typed", "completed"),
    [("slrig sc", {"scan", "schedule"}), ("slrig calibrate so", {"solve"}), ("slrig scan --exp", {"--exposure-s"})],
)
def test_a_shell_completes_commands_and_options(typed: str, completed: set[str]) -> None:
    words = {"_SLRIG_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    found = subprocess.run(
        [sys.executable, "-m", "slrig.cli"], capture_output=True, text=True, check=False, env={**os.environ, **words}
    )
    assert set(found.stdout.split()) == completed
