"""Two rigs and one catalogue with a database that is killed: scans go on, and each arrives there once, in order."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.conftest import ServiceProcess, Start, write_rig
from tests.e2e.schedules import awaited
from tests.postgres import LOGIN, PASSWORD, Postgres


def scans(service: ServiceProcess, count: int) -> list[str]:
    with service.client() as client:
        return [str(client.scan().id) for _ in range(count)]


def copied(server: Postgres, rig: str) -> list[str]:
    rows = server.execute(f"SELECT job FROM finished_job WHERE rig = '{rig}' ORDER BY number", "fleet")  # noqa: S608
    return [job for (job,) in rows]


def has_come(server: Postgres, wanted: dict[str, list[str]]) -> None:
    awaited(lambda: all(len(copied(server, rig)) >= len(ids) for rig, ids in wanted.items()), "the copies")
    assert {rig: copied(server, rig) for rig in wanted} == wanted


@pytest.mark.slow
def test_a_killed_database_costs_no_scan_and_no_row(start: Start, tmp_path: Path) -> None:
    with Postgres() as server:
        server.execute("CREATE DATABASE fleet")
        login = tmp_path / "login"
        login.touch(0o600)
        login.write_text(LOGIN)
        settings = {
            "SLRIG_CATALOGUE": server.address("fleet"),
            "SLRIG_CATALOGUE_LOGIN_FILE": str(login),
            "SLRIG_KEEP_SCANS": "1",
        }
        services = {}
        for name in ("hall-1", "hall-2"):
            rig = write_rig(tmp_path / name)
            rig.write_text(rig.read_text().replace('name = "small"', f'name = "{name}"', 1))
            services[name] = start(rig, tmp_path / f"{name}-data", **settings)
        wanted = {name: scans(service, 2) for name, service in services.items()}
        has_come(server, wanted)
        server.kill()
        for name, service in services.items():
            wanted[name] += scans(service, 2)
        server.start()
        has_come(server, wanted)
        server.kill()
        wanted["hall-1"] += scans(services["hall-1"], 1)
        # The rig, too, before it could report: what it has to report is on its disk.
        services["hall-1"].kill()
        server.start()
        services["hall-1"] = start(tmp_path / "hall-1" / "rig.toml", services["hall-1"].data, **settings)
        has_come(server, wanted)
        with services["hall-2"].client() as client:
            rigs = client.system.fleet()["rigs"]
        assert [(each["name"], each["scans_of_day"], each["uncopied"]) for each in rigs] == [
            ("hall-1", 5, 0), ("hall-2", 4, 0),
        ]  # fmt: skip
        for each in services.values():
            assert each.stop() == 0
        states = server.execute("SELECT state FROM rig", "fleet")
        assert states == [["stopped"], ["stopped"]]
        logs = "".join(each.log.read_text() for each in services.values())
        assert "the catalogue is not told of this rig" in logs
        assert PASSWORD not in logs
