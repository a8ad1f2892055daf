"""Runs `slrig calibrate` in this process."""

from __future__ import annotations

from typer.testing import Result

from tests.unit.command import refused, slrig

__all__ = ["refused", "run"]


def run(*arguments: object) -> Result:
    return slrig("calibrate", *arguments)
