"""Campaigns of harm at random instants: the service, its worker or its disk fail, and nothing is lost or poisoned.

    SLRIG_ENDS=100 SLRIG_REFUSALS=30 pytest -s -o faulthandler_timeout=0 tests/bench/test_random_harm.py

Ends: service and worker are killed or stopped during work of every kind. Refusals: the disk refuses the service's
records during a scan, and five scans follow. Records that are read-only are refused within the process by
`tests/unit/scan/test_runner.py`: a file that the kernel makes read-only under SQLite's shared memory ends the
process with SIGBUS, which no service can take.
"""

from __future__ import annotations

import os
import random
import resource
import select
import signal
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from slrig.scan.artefacts import decode_mesh_ply
from tests.e2e.conftest import ServiceProcess, Start
from tests.e2e.faulty_rig.service import half_written
from tests.e2e.schedules import at_once
from tests.e2e.test_calibration_walk import BOARD, Caller, write_rig

SEED = int(os.environ.get("SLRIG_SEED", "1"))
LIMIT_S = 180.0
KINDS = ("scan", "pose", "solve", "verification", "schedule")
FINAL = {"succeeded", "failed", "cancelled", "interrupted", "solved", "skipped", "missed"}
FIRST = int(os.environ.get("SLRIG_FIRST", "0"))
ENDS = int(os.environ.get("SLRIG_ENDS", "20"))
HARM = ("service", "worker", "both", "stopped")
SPAN_S = {"scan": 4.0, "pose": 3.0, "solve": 2.5, "verification": 3.0, "schedule": 3.0}
"""How long each takes on two cores, with a margin: an instant may come after the end, too."""

REFUSALS = int(os.environ.get("SLRIG_REFUSALS", "6"))
AFTER = 5
LOCKED_S = 7.0


def calibrated_rig(folder: Path) -> Path:
    """A rig with a board, a positioner, and the calibration that it was rendered by."""
    return write_rig(folder, carries="true")


def ends(descriptor: int, limit_s: float = 30.0) -> bool:
    """Whether the process of a descriptor ends in time."""
    ended = bool(select.select([descriptor], [], [], limit_s)[0])
    os.close(descriptor)
    return ended


class Work:
    """Work of one kind under way: `state` is None until it is over."""

    def __init__(self, service: ServiceProcess, kind: str, made: dict[str, Any], schedule: dict[str, Any]) -> None:
        self.kind = kind
        with Caller(service) as caller:
            if kind == "scan":
                self.path = caller.post("/scan", 202, if_busy="queue")["links"]["self"]
            elif kind == "pose":
                self.path = caller.post(made["links"]["pose"], 202, position=7, if_busy="queue")["links"]["self"]
            elif kind == "solve":
                caller.post(made["links"]["solve"], 202)
                self.path = made["links"]["self"]
            elif kind == "verification":
                asked = {"board": BOARD, "position": 1, "if_busy": "queue"}
                self.path = caller.post("/rig/verification", 202, **asked)["links"]["self"]
            else:
                at_once(caller, service, schedule)
                self.path = schedule["links"]["runs"]

    def found(self, service: ServiceProcess) -> dict[str, Any]:
        with Caller(service) as caller:
            found = caller.get(self.path)
        latest: dict[str, Any] = found["runs"][0] if self.kind == "schedule" else found
        return latest

    def over(self, service: ServiceProcess) -> dict[str, Any]:
        """What became of it."""
        deadline, pause = time.monotonic() + LIMIT_S, threading.Event()
        while (found := self.found(service))["state"] not in FINAL:
            assert time.monotonic() < deadline, found
            pause.wait(0.1)
        return found


def session(service: ServiceProcess) -> tuple[dict[str, Any], dict[str, Any]]:
    """A calibration of six poses, and a paused schedule of verifications."""
    with Caller(service) as caller:
        made = caller.opened()
        caller.post(f"{made['links']['self']}/script", 202, positions=list(range(1, 7)))
        assert [pose["state"] for pose in caller.settled(made)["shot"]] == ["succeeded"] * 6
        schedule = caller.post(
            "/schedule", 201, cron="* * * * *", task="verification", options={"board": BOARD, "position": 1}
        )
        caller.post(schedule["links"]["pause"], 200)
    return made, schedule


def whole(service: ServiceProcess) -> list[str]:
    """What is wrong with the records and files of a service that does nothing."""
    faults = [f"half written: {name}" for name in half_written(service.data)]
    with Caller(service) as caller:
        for scan in caller.get("/scan?limit=200")["scans"]:
            place = service.data / "scans" / scan["id"]
            missing = [name for name in ("mesh.ply", "report.json") if not (place / name).is_file()]
            if scan["state"] == "succeeded" and missing:
                faults.append(f"scan {scan['id']} succeeded without {missing}")
            if scan["state"] not in FINAL:
                faults.append(f"scan {scan['id']} is {scan['state']}")
        for listed in caller.get("/calibration")["calibrations"]:
            made = caller.get(listed["links"]["self"])
            place = service.data / "calibrations" / made["id"]
            for pose in made["shot"]:
                if pose["state"] not in FINAL:
                    faults.append(f"{pose['name']} is {pose['state']}")
                if pose["accepted"] and not (place / "poses" / f"{pose['number']:02d}" / "reading.npz").is_file():
                    faults.append(f"{pose['name']} was accepted without its reading")
            if made["result"] is not None and set(made["links"]["files"]) < {"calibration.json", "report.html"}:
                faults.append(f"calibration {made['id']} was solved without its files")
    return faults


def scanned(service: ServiceProcess, **asked: Any) -> dict[str, Any]:
    """A scan from its start to its end."""
    with service.client() as client:
        scan = client.scans.start(if_busy="queue", **asked)
        for _ in client.follow(scan["links"]["events"]):
            pass
        return client.get(scan["links"]["self"])


def test_random_ends_lose_nothing(start: Start, tmp_path: Path) -> None:
    chance, pause = random.Random(SEED), threading.Event()
    rig = calibrated_rig(tmp_path / "rig")
    service = start(rig)
    made, schedule = session(service)
    told: Counter[tuple[str, str, str]] = Counter()
    for number in range(FIRST, ENDS):
        kind, harm = KINDS[number % len(KINDS)], HARM[number // len(KINDS) % len(HARM)]
        with Caller(service) as caller:
            caller.ready()
        work = Work(service, kind, made, schedule)
        worker = service.worker_id()
        watched = os.pidfd_open(worker)
        pause.wait(chance.uniform(0, SPAN_S[kind]))
        if harm == "stopped":
            os.kill(worker, signal.SIGSTOP)
        if harm in ("worker", "both"):
            os.kill(worker, signal.SIGKILL)
        if harm in ("service", "both"):
            service.kill()
            assert ends(watched), f"{number}: the worker outlives the service"
            service = start(rig)
        else:
            # One that stands still is ended by the service when it is next asked for something.
            found = work.over(service)
            after = scanned(service)
            if harm == "stopped" and after["state"] != "succeeded":
                assert after["error"]["type"] == "/problems/worker-lost", after
                print(f"{number}: the next scan met the stopped worker")  # noqa: T201
            assert ends(watched), f"{number}: the worker is still there"
        found = work.over(service)
        error = found.get("error") or {}
        cause = error.get("type", found.get("reason") or "")
        told[kind, harm, found["state"]] += 1
        print(f"{number}: {kind}, {harm}: {found['state']} {cause}", flush=True)  # noqa: T201
        assert "unexpected" not in cause, found
        last = scanned(service)
        assert last["state"] == "succeeded", (number, kind, harm, last["error"])
        assert whole(service) == [], (number, kind, harm)
    for key, times in sorted(told.items()):
        print(*key, times)  # noqa: T201
    assert service.stop() == 0


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

    for number in range(REFUSALS):
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
