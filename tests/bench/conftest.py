"""Fixtures of other rooms that campaigns use, and a catalogue's database."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.conftest import pool, start
from tests.postgres import LOGIN, Postgres

__all__ = ["catalogue", "pool", "start"]


@pytest.fixture
def catalogue(monkeypatch: pytest.MonkeyPatch) -> Iterator[Postgres]:
    """The database of a catalogue, for services that are started from now on."""
    with Postgres() as server:
        monkeypatch.setenv("SLRIG_CATALOGUE", server.address())
        monkeypatch.setenv("SLRIG_CATALOGUE_LOGIN", LOGIN)
        yield server
