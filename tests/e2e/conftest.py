"""The service as a process of its own, over a small rendered rig."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slrig.client import Client
from tests.e2e.forking import ForkedCommand, worker_of
from tests.e2e.pool_processes import Pool
from tests.npm import lacking

if TYPE_CHECKING:
    from playwright.sync_api import Browser

KEY = "the key of the tests"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_BROWSER_OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
STOP_LIMIT_S = 30.0
"""How long a test waits for the service to end after SIGTERM: 1 to 2 s on a quiet machine, 4 beside six busy ones."""

SCENE = """
name = "plate"
[[object]]
name = "plate"
shape = "plane"
size_mm = [160.0, 130.0]
rotation_deg = [8.0, -12.0, 0.0]
albedo = 0.8
"""

RIG = """
name = "small"
[head]
driver = "simulated"
scene = "scene.toml"
samples_per_axis = 2
{head}
[head.projector]
size_px = [256, 192]
focal_px = [1100.0, 1101.0]
position_mm = [105.0, -10.0, -590.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
gamma = 1.8
[[head.camera]]
name = "left"
size_px = [240, 192]
saturation_s = 0.02
focal_px = [950.0, 951.0]
position_mm = [-150.0, -12.0, -560.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
{faults}
"""


def write_rig(folder: Path, *, scene: str = SCENE, head: str = "", faults: str = "") -> Path:
    """Write a small rendered rig and its scene into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene)
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(head=head, faults=faults))
    return rig


class ServiceProcess:
    """A running `slrig serve`; `url` is where it said that it is.

    fresh : in a Python of its own, for tests of what its start loads, and of limits that it inherits. port : any free
    one unless one is named.
    """

    def __init__(self, rig: Path, data: Path, *, fresh: bool = False, port: int = 0) -> None:
        self.data = data
        self.log = data.with_suffix(".log")
        command = ["serve", str(rig), "--port", str(port), "--data", str(data)]
        environment = {
            # Tests ask as fast as they can.
            "SLRIG_REQUESTS_PER_S": "100000",
            **os.environ,
            "SLRIG_API_KEY": KEY,
            "SLRIG_MIN_FREE_BYTES": "0",
            "PYTHONUNBUFFERED": "1",
        }
        # What a command does by itself about OpenBLAS's threads: the tests' own setting would hide it.
        environment.pop("OPENBLAS_NUM_THREADS", None)
        self.process: subprocess.Popen[bytes] | ForkedCommand
        # What is to be preloaded is read as a program begins.
        if fresh or "LD_PRELOAD" in environment:
            with self.log.open("ab") as log:
                self.process = subprocess.Popen(  # noqa: S603 - our own command
                    [sys.executable, "-m", "slrig.cli", *command], stdout=subprocess.PIPE, stderr=log, env=environment
                )
        else:
            self.process = ForkedCommand(command, environment, self.log)
        assert self.process.stdout is not None
        greeting = self.process.stdout.readline().decode()
        assert " at http://" in greeting, self.log.read_text()
        self.url = greeting.split(" at ")[1].split(",")[0]

    def client(self, key: str | None = KEY) -> Client:
        return Client(self.url, key)

    def worker_id(self) -> int:
        """The process id of the reconstruction process."""
        if (forked := worker_of(self.process.pid)) is not None:
            return forked
        for line in Path(f"/proc/{self.process.pid}/task").glob("*/children"):
            for child in line.read_text().split():
                if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
        message = "the service has no reconstruction process"
        raise AssertionError(message)

    def stop(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it as a service manager would, or a terminal that is closed, and return its exit code."""
        self.process.send_signal(how)
        return self._gone(STOP_LIMIT_S)

    def kill(self) -> None:
        """End it as a power cut would."""
        self.process.kill()
        self._gone(STOP_LIMIT_S)

    def _gone(self, limit_s: float) -> int:
        code = self.process.wait(limit_s)
        if self.process.stdout is not None:
            self.process.stdout.close()
        return code


Start = Callable[..., ServiceProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a service on a rig and a data folder; whatever still runs at the end of the test is killed."""
    running: list[ServiceProcess] = []

    def started(rig: Path, data: Path = tmp_path / "data", *, fresh: bool = False, port: int = 0) -> ServiceProcess:
        service = ServiceProcess(rig, data, fresh=fresh, port=port)
        running.append(service)
        return service

    yield started
    for service in running:
        if service.process.poll() is None:
            service.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium. Playwright does not start twice at a time in a process, and others' event loops not beside it."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        lacking("needs Chromium: apt install chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        lacking("needs Playwright, to drive a browser: pip install -e '.[browser]'")
    with sync_playwright() as driver:
        # Drawn by the processor, as on a laptop without a GPU.
        opened = driver.chromium.launch(executable_path=path, args=list(_BROWSER_OPTIONS))
        yield opened
        opened.close()


@pytest.fixture
def pool(tmp_path: Path) -> Iterator[Pool]:
    try:
        import distributed
        import flask_cors
        import moto
        import obstore
    except ImportError:
        lacking("needs a pool's libraries, and an S3 server: pip install -e '.[pool,s3]'")
    del distributed, flask_cors, moto, obstore
    with ExitStack() as stack:
        yield Pool(tmp_path, stack)
