"""Campaign: every part of a pool killed at random instants while two rigs have scans reconstructed by it.

Run it by name: `pytest -s -o faulthandler_timeout=0 tests/bench/test_pool_kills.py`. SLRIG_KILLS says how many kills,
SLRIG_SEED when they come; scans are 100 to 35 kills. What is killed is started again, as by a service manager. The
store is of the harder kind: moto's comes back empty, and without its bucket.
"""

from __future__ import annotations

import json
import os
import random
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from slrig.jobs.worker import Worker
from slrig.scan.job import PIPELINE, reconstruction
from slrig.scan.plan import ReconstructionPlan
from tests.bench.processes import alive, ends
from tests.e2e.conftest import ServiceProcess, Start, write_rig
from tests.e2e.faulty_rig.service import half_written
from tests.e2e.pool_processes import Pool, Process
from tests.postgres import LOGIN, Postgres

SEED = int(os.environ.get("SLRIG_SEED", "1"))
HARM = (["worker", "its process"] * 2 + ["scheduler", "store", "database"]) * 5
KILLS = int(os.environ.get("SLRIG_KILLS", str(len(HARM))))
SCANS_EACH = max(round(KILLS * 100 / len(HARM) / 2), 2)
SCAN_S = 3.0
"""About how long a scan takes: a kill comes at most so long after the end of another one."""

RESTART_S = 1.0
"""How long a service manager waits before it starts again what has ended."""

HALVED = {
    "[256, 192]": "[128, 96]", "[1100.0, 1101.0]": "[550.0, 550.5]",
    "[240, 192]": "[120, 96]", "[950.0, 951.0]": "[475.0, 475.5]",
}  # fmt: skip
"""Sizes and focal lengths of the tests' rig: 10 000 points, which take as long as their transport."""

LIMIT_S = 120.0
"""So long no scan may end."""


@pytest.fixture
def catalogue(monkeypatch: pytest.MonkeyPatch) -> Iterator[Postgres]:
    """The database of a catalogue, for services that are started from now on."""
    with Postgres() as server:
        monkeypatch.setenv("SLRIG_CATALOGUE", server.address())
        monkeypatch.setenv("SLRIG_CATALOGUE_LOGIN", LOGIN)
        yield server


def committed(services: list[ServiceProcess]) -> list[Path]:
    """The folders of the scans that are finished."""
    return [folder for each in services for folder in (each.data / "scans").iterdir()]


def wait_for(services: list[ServiceProcess], count: int) -> None:
    """Wait until so many scans are finished."""
    found, since_s = -1, time.monotonic()
    while (now := len(committed(services))) < count:
        if now != found:
            found, since_s = now, time.monotonic()
        assert time.monotonic() - since_s < LIMIT_S, f"{now} of {count} scans are finished, and no other one follows"
        time.sleep(0.05)


def two_services(
    environment: Mapping[str, str], start: Start, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> list[ServiceProcess]:
    """Start services of two rigs; each has had a scan computed by the pool. environment : what says of the pool."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    services = []
    for seed in (1, 2):
        rig = write_rig(folder / f"rig-{seed}", head=f"seed = {seed}")
        changed = {**HALVED, '"small"': f'"rig-{seed}"'}
        rig.write_text(re.sub("|".join(map(re.escape, changed)), lambda found: changed[found[0]], rig.read_text()))  # noqa: B023 - used at once
        services.append(start(rig, folder / f"data-{seed}"))
    for service in services:
        with service.client() as client:
            while client.scan().report["computed"]["where"] != "pool":
                pass
    return services


def require_catalogued(database: Postgres, services: list[ServiceProcess]) -> None:
    """Wait until the catalogue has all finished scans: each once, and those of a rig in the order of their ends."""
    found: list[Any] = []
    until_s = time.monotonic() + LIMIT_S
    while len(found) < len(committed(services)):
        assert time.monotonic() < until_s, f"the catalogue has {len(found)} of {len(committed(services))} scans"
        time.sleep(0.5)
        found = database.execute("select rig, job, finished_at, state from finished_job order by number")
    assert sorted(job for _, job, _, _ in found) == sorted(folder.name for folder in committed(services))
    assert {state for *_, state in found} == {"succeeded"}
    for name in {rig for rig, *_ in found}:
        ends_at = [at for rig, _, at, _ in found if rig == name]
        assert ends_at == sorted(ends_at)


class Killer:
    """Kills processes of a pool, and has them started again."""

    def __init__(self, pool: Pool, database: Postgres, chance: random.Random) -> None:
        self._pool, self._chance = pool, chance
        self._single: dict[str, Process | Postgres] = {
            "scheduler": pool.scheduler,
            "store": pool.store,
            "database": database,
        }
        self._returning: dict[Process | Postgres, threading.Timer] = {}

    def kill(self, what: str) -> None:
        """Kill the one of that name, or one of the workers, or the process that computes beneath one."""
        killed = self._single.get(what) or self._chance.choice(self._pool.workers)
        self._wait(killed)
        if what == "its process":
            assert isinstance(killed, Process)
            # A worker that has just begun has none yet.
            for child in import_module("psutil").Process(killed.process.pid).children():
                if "spawn_main" in " ".join(child.cmdline()):
                    child.kill()
            return
        killed.kill()
        self._returning[killed] = threading.Timer(RESTART_S, self._start_again, (killed,))
        self._returning[killed].start()

    def wait(self) -> None:
        """Wait until whatever was killed has been started again."""
        for each in list(self._returning):
            self._wait(each)

    def _wait(self, process: Process | Postgres) -> None:
        if process in self._returning:
            self._returning.pop(process).join()

    def _start_again(self, process: Process | Postgres) -> None:
        process.start() if isinstance(process, Postgres) else process.start_again()
        if process is self._pool.store:
            self._pool.store.make_bucket()


def test_kills_lose_no_scan(
    pool: Pool, catalogue: Postgres, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chance = random.Random(SEED)
    services = two_services(pool.service(), start, tmp_path, monkeypatch)
    before = len(committed(services))
    kills = sorted((chance.uniform(0, 2 * SCANS_EACH - 3), what) for what in chance.sample(HARM, KILLS))
    killer, begun_s = Killer(pool, catalogue, chance), time.monotonic()
    for service in services:
        with service.client() as client:
            client.scans.start(repeat=SCANS_EACH, if_busy="queue")
    for due, what in kills:
        wait_for(services, before + int(due))
        time.sleep(due % 1 * SCAN_S)
        print(f"{time.monotonic() - begun_s:6.1f} s, {len(committed(services)) - before:3} scans: {what}", flush=True)  # noqa: T201
        killer.kill(what)
    total = before + 2 * SCANS_EACH
    wait_for(services, total)
    took_s = time.monotonic() - begun_s
    killer.wait()

    told: Counter[tuple[str, str]] = Counter()
    for service in services:
        with service.client() as client:
            scans = client.get("/scan?limit=200")["scans"]
        assert {each["state"] for each in scans} == {"succeeded"}
        assert {each["id"] for each in scans} == {folder.name for folder in committed([service])}
        assert half_written(service.data) == []
    require_catalogued(catalogue, services)
    local, alone = Worker(PIPELINE), tmp_path / "alone"
    for folder in committed(services):
        result = alone / folder.name
        result.mkdir(parents=True)
        local.run(reconstruction(PIPELINE, folder / "bundle", result, ReconstructionPlan()))
        assert (result / "mesh.ply").read_bytes() == (folder / "mesh.ply").read_bytes(), folder
        section: dict[str, Any] = json.loads((folder / "report.json").read_text())["computed"]
        assert section["host"], section
        assert (section["where"] == "local") == ("because" in section)
        told[section["where"], re.sub(r"\d+ s", "N s", section.get("because", ""))] += 1
    local.close()
    assert len({(alone / folder.name / "mesh.ply").read_bytes() for folder in committed(services)}) == total
    print(f"{total} scans in {took_s:.0f} s, {KILLS} kills, load {os.getloadavg()[0]:.1f}")  # noqa: T201
    for (where, because), count in told.most_common():
        print(f"{count:4} {where:6} {because}")  # noqa: T201

    watched = [alive(service.worker_id()) for service in services]
    for service in services:
        assert service.stop() == 0
    assert all(map(ends, watched))
    for each in (*pool.workers, pool.scheduler):
        each.process.terminate()
        assert each.process.wait(30) == 0
    assert {path.name for path in pool.scratch.rglob("*") if path.is_file()} <= {"global.lock", "purge.lock"}
