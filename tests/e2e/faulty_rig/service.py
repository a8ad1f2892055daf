"""The real service on a faulty rig: its files, its process, and what a client finds."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from slrig.bundle import write_calibration
from slrig.client import Client
from tests.e2e.conftest import ServiceProcess
from tests.e2e.faulty_rig import scenery
from tests.e2e.faulty_rig.desk import Desk

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


@contextmanager
def installed(folder: Path, *, shutdown_s: float = SHUTDOWN_S) -> Iterator[None]:
    """Have the faulty driver installed for the services that are started within the block.

    shutdown_s : how long they wait for a driver at their end.
    """
    info = folder / "faulty_rig-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(_METADATA)
    (info / "entry_points.txt").write_text(_ENTRIES)
    with pytest.MonkeyPatch.context() as patch:
        for path in (CHECKOUT, folder):
            patch.setenv("PYTHONPATH", str(path), prepend=":")
        patch.setenv("SLRIG_SHUTDOWN_S", str(shutdown_s))
        patch.setenv("PYTHONFAULTHANDLER", "1")
        yield


def write_rig(folder: Path, desk: Desk, trigger: str) -> Path:
    """Write the rig file of a faulty rig; with a hardware trigger its projector plays."""
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder / "calibration.json", scenery.calibration())
    rig = folder / f"{trigger}.toml"
    plays = "true" if trigger == "hardware" else "false"
    rig.write_text(_RIG.format(desk=desk.path, plays=plays, trigger=trigger, camera=scenery.CAMERA_NAME))
    return rig


def ended(client: Client, scan: dict[str, Any]) -> dict[str, Any]:
    """The scan once it is over."""
    for _ in client.follow(scan["links"]["events"]):
        pass
    return client.get(scan["links"]["self"])


def scanned(client: Client) -> dict[str, Any]:
    """A scan from its start to its end."""
    return ended(client, client.scans.start(if_busy="queue"))


def half_written(data: Path) -> list[str]:
    """What lies in the data folder and should not: leftovers of writing, and scans that no record knows whole."""
    with sqlite3.connect(data / "slrig.sqlite") as database:
        states = dict(database.execute("select id, state from job").fetchall())
    database.close()
    # A scan whose frames are all there is completed at the next start, which clears its folder first.
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


def gone(service: ServiceProcess, limit_s: float) -> int:
    """The exit code of a service that is about to end; if it does not, its log tells where each thread is."""
    try:
        code = service.process.wait(limit_s)
    except subprocess.TimeoutExpired as error:
        service.process.send_signal(signal.SIGABRT)
        service.process.wait()
        message = f"the service did not end within {limit_s:g} s:\n{service.log.read_text()}"
        raise AssertionError(message) from error
    if service.process.stdout is not None:
        service.process.stdout.close()
    return code
