"""`slrig fleet`, and what a service answers to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.catalogue.store import Catalogue, open_catalogue
from tests.postgres import LOGIN, Postgres
from tests.unit.api.conftest import ServedBench, client_of
from tests.unit.catalogue.test_store import job, row, unseen_for_an_hour
from tests.unit.command import slrig


@pytest.fixture
def address(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/fleet.sqlite"


@pytest.fixture
def catalogue(address: str) -> Iterator[Catalogue]:
    found = open_catalogue(address, None, None)
    found.open()
    yield found
    found.close()


def test_a_fleet_is_listed_with_its_ages(address: str, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    told = slrig("fleet", "--catalogue", address)
    assert (told.exit_code, "no rig writes to" in told.output) == (0, True), told.output
    for name in ("hall-1", "hall-2"):
        catalogue.see(row(name))
    catalogue.copy([job("hall-1", state="failed", fault_message="too dark"), job("hall-2")])
    unseen_for_an_hour(catalogue, "hall-2")
    told = slrig("fleet", SLRIG_CATALOGUE=address)
    _, one, two = [line.split() for line in told.output.splitlines() if line.strip() and "━" not in line]
    assert one[:2] == ["hall-1", "busy"]
    assert {"failed", "3,", "4", "copy"} <= set(one)
    assert two[:5] == ["hall-2", "unseen", "60", "min", "ago"]
    assert "?" in two
    told = slrig("fleet", "--catalogue", address, "--json")
    assert [each["state"] for each in json.loads(told.output)["rigs"]] == ["busy", "unseen"]


@pytest.mark.slow
def test_a_service_says_what_its_catalogue_says_or_what_to_set(address: str, tmp_path: Path) -> None:
    without = ServedBench(tmp_path / "without")
    with client_of(without) as client:
        refused = client.get("/fleet")
        assert (refused.status_code, "catalogue_login_file" in refused.json()["detail"]) == (404, True)
        assert client.get("/rig").json()["fleet"] is False
        assert "slrig_catalogue" not in client.get("/metrics").text
    without.unpatch()
    served = ServedBench(tmp_path / "data", catalogue=address)
    assert served.service.copier is not None
    with client_of(served) as client:
        assert client.get("/rig").json()["fleet"] is True
        while served.service.copier.status().fault is not None:
            served.service.copier._ending.wait(0.01)
        found = client.get("/fleet").json()
        assert [each["name"] for each in found["rigs"]] == ["bench"]
        told = slrig("fleet", "--catalogue", address, "--json")
        (here,), (there,) = found["rigs"], json.loads(told.output)["rigs"]
        assert here | {"seen_s": 0} == there | {"seen_s": 0}
        assert "slrig_catalogue_waiting 0.0" in client.get("/metrics").text
    served.unpatch()


@pytest.mark.slow
def test_login_is_in_no_answer(postgres: Postgres, tmp_path: Path) -> None:
    login = tmp_path / "login"
    login.write_text(LOGIN + "\n")
    login.chmod(0o644)
    settings = tmp_path / "settings.toml"
    settings.write_text(f'catalogue = "{postgres.address("cli")}"\ncatalogue_login_file = "login"\n')

    def told(words: str) -> tuple[int, bool]:
        result = slrig("fleet", "--settings", settings)
        assert "another" not in result.output
        # A terminal breaks lines by how long a folder's name is.
        return result.exit_code, words in " ".join(result.output.split())

    assert told("chmod 600") == (2, True)
    login.chmod(0o600)
    assert told('database "cli" does not exist') == (2, True)
    postgres.execute("CREATE DATABASE cli")
    assert told("no rig writes to postgresql://127.0.0.1") == (0, True)
    login.write_text("slrig:another")
    assert told("password authentication failed") == (2, True)
