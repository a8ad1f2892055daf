"""Campaign: the disk refuses the service's records at random instants of a scan, and five scans come after each.

Records that are read-only are refused within the process by `tests/unit/scan/test_refused_records.py`: a file that the
kernel makes read-only under SQLite's shared memory ends the process with SIGBUS, which no service can take.

Run it by name: `SLRIG_REFUSALS=30 pytest -s -o faulthandler_timeout=0 tests/bench/test_random_refusals.py`.
"""

from __future__ import annotations

import os
import random
import resource
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from slrig.scan.artefacts import decode_mesh_ply
from tests.bench.random_harm import calibrated_rig, scanned, whole
from tests.e2e.conftest import ServiceProcess, Start
from tests.e2e.test_calibration_walk import Caller

COUNT = int(os.environ.get("SLRIG_REFUSALS", "6"))
SEED = int(os.environ.get("SLRIG_SEED", "1"))
AFTER = 5
LOCKED_S = 7.0


@contextmanager
def full(service: ServiceProcess) -> Iterator[None]:
    """No file of the service may grow: what a full disk does."""
    soft, hard = resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (0, hard))
    yield
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def locked(service: ServiceProcess) -> Iterator[None]:
    """Another program has the records locked."""
    other = sqlite3.connect(service.data / "slrig.sqlite", timeout=30, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    yield
    other.execute("ROLLBACK")
    other.close()


WAYS: tuple[tuple[Callable[[ServiceProcess], Any], float], ...] = ((full, 0.0), (locked, LOCKED_S))


def faults_of(service: ServiceProcess, scan: dict[str, Any], ratio: float) -> list[str]:
    """What is not this scan's own in what it has."""
    place = service.data / "scans" / scan["id"]
    with Caller(service) as caller:
        report = caller.get(scan["links"]["files"]["report.json"])
    mesh = decode_mesh_ply((place / "mesh.ply").read_bytes())
    found = []
    if report["plan"]["depth_edge_ratio"] != ratio:
        found.append(f"{scan['id']}: another scan's report")
    if scan["summary"]["mesh"] != report["mesh"]:
        found.append(f"{scan['id']}: another scan's summary")
    if report["mesh"]["figures"]["triangles"] != len(mesh.faces):
        found.append(f"{scan['id']}: another scan's mesh")
    return found


def test_refused_records_poison_no_later_scan(start: Start, tmp_path: Path) -> None:
    chance, pause, numbers = random.Random(SEED), threading.Event(), count()
    service = start(calibrated_rig(tmp_path / "rig"))
    with Caller(service) as caller:
        caller.ready()
    told: Counter[tuple[str, str]] = Counter()

    def asked() -> dict[str, Any]:
        number = next(numbers)
        # Each has a plan of its own, and every second one a mesh of another kind.
        return {
            "patterns": {"line_shift": number % 2 == 0},
            "reconstruction": {"depth_edge_ratio": 6.0 + number / 1000},
        }

    for number in range(COUNT):
        way, lasts_s = WAYS[number % len(WAYS)]
        plan = asked()
        with service.client() as client:
            scan = client.scans.start(if_busy="queue", **plan)
            pause.wait(chance.uniform(0, 4.0))
            with way(service):
                pause.wait(lasts_s or chance.uniform(0.2, 5.0))
            for _ in client.follow(scan["links"]["events"]):
                pass
            scan = client.get(scan["links"]["self"])
        cause = "" if scan["error"] is None else scan["error"]["type"]
        told[way.__name__, f"{scan['state']} {cause}"] += 1
        print(f"{number}: {way.__name__}: {scan['state']} {cause}", flush=True)  # noqa: T201
        assert cause in ("", "/problems/storage"), scan["error"]
        ratio = plan["reconstruction"]["depth_edge_ratio"]
        wrong = faults_of(service, scan, ratio) if scan["state"] == "succeeded" else []
        for _ in range(AFTER):
            plan = asked()
            later = scanned(service, **plan)
            assert later["state"] == "succeeded", later["error"]
            wrong += faults_of(service, later, plan["reconstruction"]["depth_edge_ratio"])
        assert wrong + whole(service) == []
    for key, times in sorted(told.items()):
        print(*key, times)  # noqa: T201
    assert service.stop() == 0
