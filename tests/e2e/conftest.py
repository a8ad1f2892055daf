"""The service as a process of its own, over a small rendered rig."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from slrig.client import Client
from tests.npm import lacking

if TYPE_CHECKING:
    from playwright.sync_api import Browser

KEY = "the key of the tests"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_BROWSER_OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
SLOW = "realtime = true"
"""For the head of a rendered rig: frames take as long as those of a real camera, so that a scan has a middle."""
STOP_LIMIT_S = 30.0
"""How long a test waits for the service to end after SIGTERM: 1 to 2 s on a quiet machine, 4 on a busy one."""

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
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene)
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(head=head, faults=faults))
    return rig


class ServiceProcess:
    """A running `slrig serve`; `url` is the address that it printed. port : any free one by default.

    program : a module and its arguments, in place of that command. descriptors : the most that it may have.
    """

    def __init__(
        self,
        rig: Path,
        data: Path,
        *,
        port: int = 0,
        program: Sequence[str] = (),
        descriptors: int | None = None,
        **settings: str,
    ) -> None:
        self.data = data
        self.log = data.with_suffix(".log")
        environment = {
            # Tests send requests as fast as they can.
            "SLRIG_REQUESTS_PER_S": "100000",
            **os.environ,
            "SLRIG_API_KEY": KEY,
            "SLRIG_MIN_FREE_BYTES": "0",
            "PYTHONUNBUFFERED": "1",
            **settings,
        }
        # A command limits OpenBLAS's threads by itself: the tests' own setting would hide that.
        environment.pop("OPENBLAS_NUM_THREADS", None)
        command = program or ["slrig.cli", "serve", str(rig), "--port", str(port), "--data", str(data)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(  # noqa: S603 - our own command
                [sys.executable, "-m", *command], stdout=subprocess.PIPE, stderr=log, env=environment
            )
        if descriptors is not None:
            resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE, (descriptors, descriptors))
        assert self.process.stdout is not None
        greeting = self.process.stdout.readline().decode()
        assert " at http://" in greeting, self.log.read_text()
        self.url = greeting.split(" at ")[1].split(",")[0]

    def client(self, key: str | None = KEY) -> Client:
        return Client(self.url, key)

    def worker_id(self) -> int:
        for line in Path(f"/proc/{self.process.pid}/task").glob("*/children"):
            for child in line.read_text().split():
                if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
        raise AssertionError("the service has no reconstruction process")

    def stop(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it as a service manager does, or a terminal that is closed, and return its exit code."""
        self.process.send_signal(how)
        return self.gone()

    def kill(self) -> None:
        """End it as a power cut does. Does nothing where it has ended."""
        self.process.kill()
        self.gone()

    def gone(self) -> int:
        """The exit code of a service that is about to end; if it does not end, its log has a trace of each thread."""
        try:
            code = self.process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired as error:
            self.process.send_signal(signal.SIGABRT)
            self.process.wait()
            message = f"the service did not end within {STOP_LIMIT_S:g} s:\n{self.log.read_text()}"
            raise AssertionError(message) from error
        if self.process.stdout is not None:
            self.process.stdout.close()
        return code


@contextmanager
def serving(rig: Path, data: Path, **settings: Any) -> Iterator[ServiceProcess]:
    """A service within a block. It must end in good order, unless the block ended it."""
    service = ServiceProcess(rig, data, **settings)
    try:
        yield service
        if service.process.poll() is None:
            assert service.stop() == 0
    finally:
        service.kill()


def python(
    *words: object,
    codes: Container[int] = (0,),
    folder: Path | None = None,
    timeout_s: float = 300.0,
    **settings: str,
) -> subprocess.CompletedProcess[str]:
    """Run a program as a person does, in `folder`. codes : its exit codes that are right."""
    command, environment = [sys.executable, *map(str, words)], {**os.environ, **settings}
    done = subprocess.run(  # noqa: S603 - our own programs
        command, capture_output=True, text=True, timeout=timeout_s, check=False, env=environment, cwd=folder
    )
    assert done.returncode in codes, done.stdout + done.stderr
    return done


def slrig(*words: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    done = python("-m", "slrig.cli", *words, **options)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def ended(client: Client, scan: dict[str, Any]) -> dict[str, Any]:
    for _ in client.follow(scan["links"]["events"]):
        pass
    return client.get(scan["links"]["self"])


def scanned(client: Client, **request: Any) -> dict[str, Any]:
    return ended(client, client.scans.start(**{"if_busy": "queue", **request}))


def followed_to(client: Client, scan: dict[str, Any], stage: str) -> None:
    for event in client.follow(scan["links"]["events"]):
        if stage in {getattr(event, "stage", None), getattr(event, "state", None)}:
            return
    raise AssertionError(f"the scan ended without {stage}")


Start = Callable[..., ServiceProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a service on a rig and a data folder; whatever still runs at the end of the test is killed."""
    running: list[ServiceProcess] = []

    def started(rig: Path, data: Path = tmp_path / "data", **settings: Any) -> ServiceProcess:
        running.append(ServiceProcess(rig, data, **settings))
        return running[-1]

    yield started
    for service in running:
        service.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium. A process can start Playwright only once at a time, and no other event loop with it."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        lacking("needs Chromium: apt install chromium")
    if find_spec("playwright") is None:
        lacking("needs Playwright, to drive a browser: pip install -e '.[browser]'")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        # Drawn by the processor, as on a laptop without a GPU.
        opened = driver.chromium.launch(executable_path=path, args=list(_BROWSER_OPTIONS))
        yield opened
        opened.close()
