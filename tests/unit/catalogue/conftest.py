"""A catalogue of either kind, empty."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.catalogue.store import Catalogue, open_catalogue
from tests.postgres import LOGIN, Postgres


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path}/fleet.sqlite"
        return
    server: Postgres = request.getfixturevalue("postgres")
    name = f"fleet_{os.urandom(4).hex()}"
    server.execute(f"CREATE DATABASE {name}")
    yield server.address(name)
    server.execute(f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture
def catalogue(address: str) -> Iterator[Catalogue]:
    found = open_catalogue(address, LOGIN, None)
    yield found
    found.close()
