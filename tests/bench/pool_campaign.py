"""What the campaigns against a pool share: two rigs whose scans are their own, and what must hold afterwards."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import ServiceProcess, Start, write_rig
from tests.postgres import Postgres

HALVED = {
    "[256, 192]": "[128, 96]", "[1100.0, 1101.0]": "[550.0, 550.5]",
    "[240, 192]": "[120, 96]", "[950.0, 951.0]": "[475.0, 475.5]",
}  # fmt: skip
"""Sizes and focal lengths of the tests' rig: 10 000 points, which take as long as their transport."""

LIMIT_S = 120.0
"""So long no scan may end."""


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
