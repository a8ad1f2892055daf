"""The real service on a faulty rig: its files, its process, and a client that follows a scan to the end."""

from __future__ import annotations

import os
import sqlite3
import threading
from pathlib import Path
from typing import Any

from slrig.bundle import write_calibration
from slrig.client import Client
from slrig.client.events import StateChange
from slrig.errors import ServiceError
from tests.e2e.conftest import KEY, ServiceProcess
from tests.e2e.faulty_rig import scenery
from tests.e2e.faulty_rig.desk import WAIT_S, Desk

CHECKOUT = Path(__file__).parents[3]
SHUTDOWN_S = 1.0
"""Short, for drivers that never return."""

_RIG = """
name = "bench"
calibration = "calibration.json"
[projector]
driver = "faulty"
desk = "{desk}"
plays = {plays}
[[camera]]
name = "{camera}"
driver = "faulty"
desk = "{desk}"
trigger = "{trigger}"
exposure_s = 0.002
"""
_METADATA = "Metadata-Version: 2.1\nName: faulty-rig\nVersion: 1.0\n"
_ENTRIES = f"""
[slrig.cameras]
faulty = {__package__}.driver:open_camera
[slrig.projectors]
faulty = {__package__}.driver:open_projector
"""


def serve(
    folder: Path, desk: Desk, trigger: str = "software", *, shutdown_s: float = SHUTDOWN_S, **settings: Any
) -> ServiceProcess:
    """Start the service on a faulty rig with its driver installed; again on the same data in the same folder.

    With a hardware trigger its projector plays. shutdown_s : how long the service waits for a driver at its end.
    """
    info = folder / "site" / "faulty_rig-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(_METADATA)
    (info / "entry_points.txt").write_text(_ENTRIES)
    write_calibration(folder / "calibration.json", scenery.calibration())
    rig = folder / "rig.toml"
    plays = "true" if trigger == "hardware" else "false"
    rig.write_text(_RIG.format(desk=desk.path, plays=plays, trigger=trigger, camera=scenery.CAMERA_NAME))
    path = [str(info.parent), str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])]
    driver: dict[str, Any] = {
        "PYTHONPATH": os.pathsep.join(path),
        "PYTHONFAULTHANDLER": "1",
        "SLRIG_SHUTDOWN_S": str(shutdown_s),
    }
    return ServiceProcess(rig, folder / "data", **driver, **settings)


def half_written(data: Path) -> list[str]:
    """What lies in the data folder and should not: leftovers of writing, and scans that no record knows whole."""
    with sqlite3.connect(data / "slrig.sqlite") as database:
        states = dict(database.execute("select id, state from job").fetchall())
    database.close()
    # A scan with all its frames is completed at the next start, which clears its folder first.
    computing = [data / ".incoming" / scan for scan, state in states.items() if state == "computing"]
    found = [path for path in data.rglob("*.part") if not any(path.is_relative_to(folder) for folder in computing)]
    found += (path for path in (data / ".incoming").iterdir() if path not in computing)
    found += (data / ".orphans").glob("*")
    for folder in (data / "scans").iterdir():
        state = states.get(folder.name)
        mesh = (folder / "mesh.ply").is_file() and (folder / "report.json").is_file()
        if state is None or mesh != (state == "succeeded") or not (folder / "bundle").is_dir():
            found.append(folder)
    return [str(path.relative_to(data)) for path in found]


class Follower:
    """Follows a scan by one event stream, on a thread of its own, and does not connect again. `states` : in order."""

    def __init__(self, service: ServiceProcess, scan: dict[str, Any]) -> None:
        self._url, self._scan = service.url, scan
        self.states: list[str] = []
        self._began = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()
        assert self._began.wait(WAIT_S)

    def last(self) -> str:
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()
        return self.states[-1]

    def _follow(self) -> None:
        with Client(self._url, KEY, pause=_give_up) as client:
            try:
                for event in client.follow(self._scan["links"]["events"]):
                    if isinstance(event, StateChange):
                        self.states.append(event.state)
                    self._began.set()
            except ServiceError:
                # The stream broke off, or there is nothing more to connect to.
                return


def _give_up(_: float) -> None:
    raise ServiceError("the stream broke off")
