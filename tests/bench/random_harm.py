"""What the campaigns of random harm share: a calibrated rig, work of each kind, and what must hold afterwards."""

from __future__ import annotations

import os
import select
import threading
import time
from pathlib import Path
from typing import Any

from tests.e2e.conftest import ServiceProcess
from tests.e2e.faulty_rig.service import half_written
from tests.e2e.schedules import at_once
from tests.e2e.test_calibration_walk import BOARD, Caller, write_rig

KINDS = ("scan", "pose", "solve", "verification", "schedule")
LIMIT_S = 180.0
FINAL = {"succeeded", "failed", "cancelled", "interrupted", "solved", "skipped", "missed"}


def calibrated_rig(folder: Path) -> Path:
    """A rig with a board, a positioner, and the calibration that it was rendered by."""
    return write_rig(folder, carries="true")


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


def alive(process: int) -> int:
    """A descriptor of a process that tells when it ends."""
    return os.pidfd_open(process)


def ends(descriptor: int, limit_s: float = 30.0) -> bool:
    """Whether a process ends in time."""
    ended = bool(select.select([descriptor], [], [], limit_s)[0])
    os.close(descriptor)
    return ended


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
