"""Runs `slrig` in this process."""

from __future__ import annotations

from functools import cache

from typer import testing
from typer.testing import CliRunner, Result

from slrig.cli.commands import app

# Building the commands takes 40 ms, and CliRunner would do it for each call.
testing._get_command = cache(testing._get_command)  # type: ignore[attr-defined]


def slrig(*words: object, typed: str | None = None, **env: str) -> Result:
    """Run a command. typed : what a person types; env : environment variables."""
    return CliRunner().invoke(app, [*map(str, words)], input=typed, env=env)


def done(*words: object, **env: str) -> str:
    """What a command prints that succeeds."""
    result = slrig(*words, **env)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(result: Result) -> str:
    """The words of a command that asks for something to be put right: one screen, exit code 2."""
    assert result.exit_code == 2, result.output
    assert result.stderr.count("error: ") == 1
    assert "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) < 30
    return result.stderr.partition("error: ")[2]
