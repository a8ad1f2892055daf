"""Fixtures of other rooms that campaigns use."""

from tests.e2e.conftest import start

__all__ = ["start"]
