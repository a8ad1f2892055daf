"""One X server for all tests of the driver, its two outputs in order before each of them."""

from __future__ import annotations

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
    """What the output on the right shows."""
    pixels = OutputPixels(server.display, (SIZE.width_px, 0), SIZE)
    yield pixels
    pixels.close()
