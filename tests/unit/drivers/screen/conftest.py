"""One X server for all tests of the driver, its two outputs in order before each of them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from slrig.devices import Projector
from slrig.model import Size
from tests.contract.screen_bench import let_go
from tests.contract.screen_server import DummyServer, OutputPixels

SIZE = Size(128, 96)
LEFT, RIGHT = "DUMMY0", "DUMMY1"

OPEN: list[Projector] = []
"""What a test has opened: closed after it, however it went."""


PROGRAM = """
import sys
from pathlib import Path
from drivers.screen import open_projector
from slrig.errors import DeviceError
from tests.contract.screen_bench import rig_options, sequence
from tests.unit.drivers.screen.conftest import RIGHT, SIZE

options = rig_options(RIGHT, SIZE, backend=sys.argv[1], dark_after_s=float(sys.argv[2]))
projector = open_projector(options, Path())
projector.load(sequence(SIZE))
projector.show(int(sys.argv[3]))
print("shown", flush=True)
sys.stdin.readline()
for _ in range(2):
    try:
        projector.show(1)
    except DeviceError as error:
        print(type(error).__name__, flush=True)
projector.close()
print("closed", flush=True)
"""


def started(
    backend: str, dark_after_s: float, pattern: int = 0, *, display: str | None = None
) -> subprocess.Popen[str]:
    """A process of its own that shows a pattern, and when it gets a line another one, twice."""
    child = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", PROGRAM, backend, str(dark_after_s), str(pattern)],
        env={**os.environ, "DISPLAY": display or os.environ["DISPLAY"]},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "shown\n"
    return child


@pytest.fixture(scope="session")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DummyServer]:
    with DummyServer(tmp_path_factory.mktemp("xorg")) as server:
        yield server


@pytest.fixture
def server(running: DummyServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[DummyServer]:
    """The server, with an output of `SIZE` on either side; the environment's."""
    monkeypatch.setenv("DISPLAY", running.display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    running.arrange(**{LEFT: SIZE, RIGHT: SIZE})
    yield running
    while OPEN:
        OPEN.pop().close()
    let_go(LEFT, RIGHT)


@pytest.fixture
def right(server: DummyServer) -> Iterator[OutputPixels]:
    pixels = OutputPixels(server.display, (SIZE.width_px, 0), SIZE)
    yield pixels
    pixels.close()
