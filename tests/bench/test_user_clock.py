"""What a user's clock shows: from the last frame to each file of a scan, and from one scan to the next.

    pytest tests/bench/test_user_clock.py -s

The frames of the bench scan (`test_pipeline_speed`) are played to a real service at 30 a second by the replay driver,
so that nothing is rendered beside what is measured. Medians; processor seconds are those of the service and its worker.
"""

from __future__ import annotations

import json
import os
import statistics
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.client import HTTPConnection
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from slrig.client import Client
from slrig.client.connection import Captured, FileReady, Progress, StateChange
from slrig.scan.plan import ScanPlan
from tests.bench.test_pipeline_speed import RIG
from tests.bench.test_whole_commands import rendered, told
from tests.e2e.conftest import KEY, ServiceProcess, Start

RUNS, ROW = 5, 10
FRAMES_PER_S = 30
VIEWERS, MOST_SLOWER = 20, 1.02
TO_MESH_S, TO_ALL_S, BETWEEN_S = 0.40, 0.80, 0.10


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig that plays the frames of the bench scan, without their truth."""
    folder = tmp_path_factory.mktemp("clock")
    description = rendered(folder / "scan", RIG, ScanPlan()) / "bundle.json"
    recorded = json.loads(description.read_text())
    for number, frame in enumerate(recorded["frames"]):
        frame["time_s"] = number / FRAMES_PER_S
    description.write_text(json.dumps(recorded))
    (folder / "rig.toml").write_text('name = "clock"\n[head]\ndriver = "replay"\nbundle = "scan/bundle"\nspeed = 1\n')
    return folder / "rig.toml"


@dataclass(frozen=True)
class Clock:
    """When what was told of a scan, by the clock of who asked for it.

    captured_s : the last frame is proven; free_s : the rig is free; files_s : each file can be fetched; over_s : the
    scan has succeeded.
    """

    posted_s: float
    began_s: float
    captured_s: float
    free_s: float
    files_s: Mapping[str, float]
    over_s: float


class Watched:
    """A scan that is followed; `until` goes on to the next event of a kind."""

    def __init__(self, client: Client) -> None:
        self.posted_s = time.perf_counter()
        self.scan = client.scans.start()
        self._events = client.follow(self.scan["links"]["events"])
        self._times: dict[str, float] = {}
        self._files: dict[str, float] = {}

    def until(self, state: str) -> None:
        for event in self._events:
            now = time.perf_counter()
            if isinstance(event, FileReady):
                self._files[event.name] = now
            elif isinstance(event, Progress) and event.stage == "capture":
                self._times["captured"] = now
            elif isinstance(event, StateChange | Captured):
                reached = event.state if isinstance(event, StateChange) else "free"
                self._times[reached] = now
                if reached == state:
                    return
        message = f"the scan did not come to {state}: {self._times}"
        raise AssertionError(message)

    def clock(self) -> Clock:
        self.until("succeeded")
        seen = self._times
        return Clock(
            self.posted_s, seen["capturing"], seen["captured"], seen["free"], self._files, seen["succeeded"]
        )  # fmt: skip


def processor_s(service: ServiceProcess) -> float:
    """Seconds that the service and its worker have computed."""
    ticks = 0
    for process in (service.process.pid, service.worker_id()):
        ticks += sum(map(int, Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


def warmed(client: Client) -> None:
    for _ in range(2):
        Watched(client).clock()


def test_from_the_last_frame_to_each_file(start: Start, replayed: Path) -> None:
    service = start(replayed)
    with service.client() as client:
        warmed(client)
        before_s = processor_s(service)
        clocks = [Watched(client).clock() for _ in range(RUNS)]
        computed_s = (processor_s(service) - before_s) / RUNS

    def median(of: Callable[[Clock], float]) -> float:
        return statistics.median(of(each) for each in clocks)

    rows: dict[str, tuple[float, float | None]] = {
        "POST to last frame": (median(lambda c: c.captured_s - c.posted_s), None),
        "last frame to free rig": (median(lambda c: c.free_s - c.captured_s), None),
    }
    for name in clocks[0].files_s:
        goal = TO_MESH_S if name == "mesh.ply" else None
        taken = [each.files_s[name] - each.captured_s for each in clocks]
        rows[f"last frame to {name}"] = (statistics.median(taken), goal)
    rows["last frame to the end"] = (median(lambda c: c.over_s - c.captured_s), TO_ALL_S)
    rows["processor seconds, service and worker"] = (computed_s, None)
    told(f"one scan at a time, medians of {RUNS}", rows)


def test_from_one_scan_to_the_next(start: Start, replayed: Path) -> None:
    service = start(replayed)
    with service.client() as client:
        warmed(client)
        followed = []
        for _ in range(ROW):
            followed.append(Watched(client))
            followed[-1].until("free")
        clocks = [each.clock() for each in followed]
    cycle_s = statistics.median(b.posted_s - a.posted_s for a, b in pairwise(clocks))
    capture_s = statistics.median(each.captured_s - each.began_s for each in clocks)
    rows: dict[str, tuple[float, float | None]] = {
        "capture": (capture_s, None),
        "from one scan to the next": (cycle_s, capture_s + BETWEEN_S),
        "last frame to mesh.ply": (statistics.median(c.files_s["mesh.ply"] - c.captured_s for c in clocks), None),
        "last POST to last end": (clocks[-1].over_s - clocks[-1].posted_s, None),
    }
    told(f"{ROW} scans in a row, each sent when the rig is free", rows)


def test_viewers_do_not_slow_a_capture(start: Start, replayed: Path) -> None:
    """Twenty people look: each follows the scan and wants a picture, and their page asks after the rig each second."""
    service = start(replayed)
    over = threading.Event()

    def look(scan: Mapping[str, Any] | None) -> None:
        with service.client() as client:
            while not over.is_set():
                if scan is None:
                    client.get("/rig")
                    over.wait(1.0)
                else:
                    for _ in client.follow(scan["links"]["events"]):
                        pass
                    return

    def capture_s(viewers: int) -> float:
        over.clear()
        watched = Watched(client)
        looking = [threading.Thread(target=look, args=(each,)) for each in viewers * [watched.scan] + viewers * [None]]
        pictures = [previewing(service) for _ in range(viewers)]
        for thread in looking:
            thread.start()
        clock = watched.clock()
        over.set()
        for thread in looking:
            thread.join()
        for connection in pictures:
            connection.close()
        return clock.captured_s - clock.began_s

    with service.client() as client:
        warmed(client)
        pairs = [(capture_s(0), capture_s(VIEWERS)) for _ in range(RUNS)]
    alone_s, watched_s = (statistics.median(each) for each in zip(*pairs, strict=True))
    told(
        f"capture of a scan, medians of {RUNS}",
        {"capture alone": (alone_s, None), f"beside {VIEWERS} viewers": (watched_s, MOST_SLOWER * alone_s)},
    )


def previewing(service: ServiceProcess) -> HTTPConnection:
    """Somebody who looks through the camera; while it is held no picture comes."""
    parts = urlsplit(service.url)
    connection = HTTPConnection(str(parts.hostname), parts.port, timeout=30)
    connection.request("GET", "/preview/left?light=white", headers={"Authorization": f"Bearer {KEY}"})
    return connection
