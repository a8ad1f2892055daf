"""Campaign: the network of two rigs is cut for a minute in the middle of their scans. Prints what became of them.

Run it by name: `pytest -s -o faulthandler_timeout=0 tests/bench/test_pool_cut.py`. Nothing passes between the services
and the pool's scheduler, its store and the catalogue's database, and nobody is told; SLRIG_CUT_S says how long.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from tests.bench.pool_campaign import committed, require_catalogued, two_services, wait_for
from tests.e2e.conftest import Start
from tests.e2e.pool_processes import Pool, Wire
from tests.postgres import Postgres

CUT_S = float(os.environ.get("SLRIG_CUT_S", "60"))
EVERY_S = 4.0
EACH = round(CUT_S / EVERY_S) + 10
"""Scans of each rig: some are before the cut, and some after it."""


def now_s(folder: Path) -> float:
    """The time by the clock of files."""
    (folder / "now").touch()
    return (folder / "now").stat().st_mtime


def test_scans_go_on_while_the_network_is_cut(
    pool: Pool, catalogue: Postgres, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wires = [*pool.wires, Wire(catalogue.port)]
    monkeypatch.setenv("SLRIG_CATALOGUE", catalogue.address().replace(str(catalogue.port), str(wires[-1].port)))
    services = two_services(pool.service(wired=True), start, tmp_path, monkeypatch)
    before = len(committed(services))
    for service in services:
        with service.client() as client:
            client.scans.start(repeat=EACH, every_s=EVERY_S, if_busy="queue")
    wait_for(services, before + 6)
    for wire in wires:
        wire.cut()
    cut_at_s = now_s(tmp_path)
    time.sleep(CUT_S)
    known = catalogue.execute("select job from finished_job")
    for wire in wires:
        wire.mend()
    mended_at_s = now_s(tmp_path)
    wait_for(services, before + 2 * EACH)
    for service in services:
        # The pool is found again, while nobody starts anything.
        with service.client() as client:
            while client.scan().report["computed"]["where"] != "pool":
                pass
    require_catalogued(catalogue, services)

    told: Counter[tuple[str, str, str]] = Counter()
    ends_at_s = {folder: (folder / "report.json").stat().st_mtime for folder in committed(services)}
    for folder, at_s in ends_at_s.items():
        section = json.loads((folder / "report.json").read_text())["computed"]
        when = "before" if at_s < cut_at_s else "cut" if at_s < mended_at_s else "after"
        told[when, section["where"], re.sub(r"\d+", "N", section.get("because", ""))] += 1
    print(f"\n{len(ends_at_s)} scans, cut for {CUT_S:.0f} s, load {os.getloadavg()[0]:.1f}")  # noqa: T201
    for key, count in sorted(told.items()):
        print(f"{count:4} {key[0]:7} {key[1]:6} {key[2]}")  # noqa: T201
    for service in services:
        moments = sorted(at_s for folder, at_s in ends_at_s.items() if folder.is_relative_to(service.data))
        gap_s = max(later - earlier for earlier, later in pairwise(moments))
        print(f"{service.data.name}: at most {gap_s:.0f} s between the ends of two scans")  # noqa: T201
    during = {folder.name for folder, at_s in ends_at_s.items() if cut_at_s < at_s < mended_at_s}
    assert len(during) >= CUT_S / EVERY_S / 2
    # What ended while it was away was brought up afterwards.
    assert len(during - {job for (job,) in known}) > len(during) / 2
    wires[-1].close()
    assert [service.stop() for service in services] == [0, 0]
