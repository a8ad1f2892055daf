"""Fixtures of other rooms that benches use."""

from tests.e2e.conftest import pool, start

__all__ = ["pool", "start"]
