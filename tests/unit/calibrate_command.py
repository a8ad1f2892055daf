"""Runs `slrig calibrate` in this process."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from slrig.cli.commands import app


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def refused(result: Result) -> str:
    """The words of a command that asks for something to be put right: one screen, exit code 2."""
    assert result.exit_code == 2, result.output
    assert result.stderr.count("error: ") == 1
    assert "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) < 30
    return result.stderr.partition("error: ")[2]
