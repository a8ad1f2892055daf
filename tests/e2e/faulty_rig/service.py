"""The desk, where a test decides what the faulty rig meets, and the real service on such a rig.

The desk lives in the process of the test, so that its records survive the service.
"""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from slrig.bundle import write_calibration
from slrig.client import Client
from slrig.client.connection import StateChange
from slrig.errors import ServiceError
from tests.e2e.conftest import KEY, ServiceProcess
from tests.e2e.faulty_rig.driver import CAMERA_NAME, calibration

WAIT_S = 60.0
"""How long a test waits for what must come; a pass never waits for it to run out."""

ANY = -1
"""A number that stands for every number."""


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a device. `number` : of the pattern shown or the frame read; 0 for all other steps."""

    device: str
    name: str
    number: int = ANY

    def __str__(self) -> str:
        return f"{self.device} {self.name}" + (f" {self.number}" if self.number > 0 else "")

    def meets(self, device: str, name: str, number: int) -> bool:
        return (self.device, self.name) == (device, name) and self.number in {ANY, number}


@dataclass(slots=True)
class Hold:
    """A step at which the rig waits. `reached` : it does; `go` : it need not any more; `steps` : what it did so far."""

    step: Step
    steps: list[tuple[str, str, int]]
    reached: threading.Event = field(default_factory=threading.Event)
    go: threading.Event = field(default_factory=threading.Event)

    def until_reached(self) -> None:
        assert self.reached.wait(WAIT_S), f"the rig did not come to {self.step}, only to {self.steps}"


class Desk:
    """Answers the driver. A context manager."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="desk-")
        self.path = Path(self._folder.name, "desk")
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._changed = threading.Condition()
        self._faults: dict[Step, str] = {}
        self._unplugged: set[str] = set()
        self._holds: list[Hold] = []
        self.steps: list[tuple[str, str, int]] = []
        self.light: list[tuple[str, bool]] = []

    def __enter__(self) -> Self:
        self._listener.bind(str(self.path))
        self._listener.listen()
        threading.Thread(target=self._accept, name="desk", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.lift()
        self._listener.close()
        self._folder.cleanup()

    def fault(self, step: Step, what: str) -> None:
        """Have a step fail, each time, until `lift`. A device that is unplugged cannot be opened until then, either."""
        with self._changed:
            self._faults[step] = what

    def lift(self) -> None:
        with self._changed:
            self._faults.clear()
            self._unplugged.clear()
            for hold in self._holds:
                hold.go.set()
            self._holds.clear()

    @contextmanager
    def held(self, step: Step) -> Iterator[Hold]:
        """Have the rig wait at a step, the next time that it comes there; it goes on at the end of the block."""
        hold = Hold(step, self.steps)
        with self._changed:
            self._holds.append(hold)
        try:
            yield hold
        finally:
            hold.go.set()
            with self._changed:
                self._holds = [each for each in self._holds if each is not hold]

    @property
    def lit(self) -> bool:
        with self._changed:
            return bool(self.light) and self.light[-1][1]

    def was_lit(self) -> bool:
        """Whether there was any light since `forget`: a projector that never shone proves nothing by its darkness."""
        with self._changed:
            return any(lit for _, lit in self.light)

    def shines(self) -> bool:
        """Wait until the projector gives light; return whether it did."""
        return self._wait(lambda: self.light[-1:] and self.light[-1][1])

    def dark(self) -> bool:
        """Wait until the projector is dark; return whether it became so."""
        return self._wait(lambda: not (self.light[-1:] and self.light[-1][1]))

    def came(self, device: str, step: str) -> bool:
        """Wait until a device comes to a step; return whether it did."""
        return self._wait(lambda: any(each[:2] == (device, step) for each in self.steps))

    def _wait(self, condition: Callable[[], object]) -> bool:
        with self._changed:
            return bool(self._changed.wait_for(condition, WAIT_S))

    def forget(self) -> None:
        """Begin a new record. The last order to the projector stays."""
        with self._changed:
            del self.light[:-1]
            self.steps.clear()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), name="desk-line", daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        # A driver in a process that is killed leaves in the middle of a message.
        with suppress(OSError, ValueError), connection, connection.makefile("rwb", buffering=0) as stream:
            for line in stream:
                message = json.loads(line)
                if "light" in message:
                    with self._changed:
                        self.light.append((message["command"], message["light"]))
                        self._changed.notify_all()
                    answer = "go"
                else:
                    answer = self._answer(message["device"], message["step"], message["number"])
                stream.write(json.dumps(answer).encode() + b"\n")

    def _answer(self, device: str, step: str, number: int) -> str:
        with self._changed:
            self.steps.append((device, step, number))
            self._changed.notify_all()
            hold = next(
                (each for each in self._holds if each.step.meets(device, step, number) and not each.reached.is_set()),
                None,
            )
            if hold is not None:
                hold.reached.set()
        if hold is not None:
            hold.go.wait()
        with self._changed:
            what = next((each for at, each in self._faults.items() if at.meets(device, step, number)), "go")
            if what == "unplug":
                self._unplugged.add(device)
            return "unplug" if device in self._unplugged else what


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
call_s = {call_s}
[[camera]]
name = "{camera}"
driver = "faulty"
desk = "{desk}"
trigger = "{trigger}"
exposure_s = 0.002
call_s = {call_s}
[positioner]
driver = "faulty"
desk = "{desk}"
"""
_METADATA = "Metadata-Version: 2.1\nName: faulty-rig\nVersion: 1.0\n"
_ENTRIES = f"""
[slrig.cameras]
faulty = {__package__}.driver:open_camera
[slrig.projectors]
faulty = {__package__}.driver:open_projector
[slrig.positioners]
faulty = {__package__}.driver:open_positioner
"""


def serve(
    folder: Path,
    desk: Desk,
    trigger: str = "software",
    *,
    shutdown_s: float = SHUTDOWN_S,
    call_s: float = 0.0,
    **settings: Any,
) -> ServiceProcess:
    """Start the service on a faulty rig with its driver installed; again on the same data in the same folder.

    With a hardware trigger its projector plays. shutdown_s : how long the service waits for a driver at its end.
    call_s : see `slrig.devices.CallLimits`; 0 for the usual limits.
    """
    info = folder / "site" / "faulty_rig-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(_METADATA)
    (info / "entry_points.txt").write_text(_ENTRIES)
    write_calibration(folder / "calibration.json", calibration())
    rig = folder / "rig.toml"
    plays = "true" if trigger == "hardware" else "false"
    rig.write_text(_RIG.format(desk=desk.path, plays=plays, trigger=trigger, camera=CAMERA_NAME, call_s=call_s))
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
