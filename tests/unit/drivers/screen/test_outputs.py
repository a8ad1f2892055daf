"""Outputs of a real X server: those that would not show patterns as they are, and what happens while one is open."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.screen import find_devices, open_projector, x11
from drivers.screen.x11 import XConnection
from slrig.devices import FoundDevice, Projector
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size
from tests.contract.screen_bench import let_go, rig_options, sequence
from tests.contract.screen_server import DummyServer, OutputPixels
from tests.unit.drivers.screen.conftest import LEFT, OPEN, RIGHT, SIZE, started

FAR_S = 10.0
_NEVER = "never shown"

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("server")]


def opened(**options: object) -> Projector:
    projector = open_projector(rig_options(RIGHT, SIZE, **options), Path())
    OPEN.append(projector)
    return projector


@contextmanager
def showing(**options: object) -> Iterator[Projector]:
    projector = opened(**options)
    try:
        projector.load(sequence(SIZE))
        yield projector
    finally:
        projector.close()


@contextmanager
def client(server: DummyServer) -> Iterator[XConnection]:
    connection = XConnection(server.display)
    yield connection
    connection.close()


def awaited(condition: Callable[[], bool]) -> bool:
    until_s = time.monotonic() + FAR_S
    while not condition():
        if time.monotonic() > until_s:
            return False
    return True


def output_property(connection: XConnection, output: str, name: str, value: str) -> None:
    """Set a word as a property of an output, as graphics drivers do."""
    resources = connection.ask("GetScreenResourcesCurrent", connection.screen.root, extension="RANDR")
    number, atom = resources.outputs[int(output.removeprefix("DUMMY"))], x11.atom(connection, name)
    data = x11.atom(connection, value).to_bytes(4, "little")
    connection.do("ChangeOutputProperty", number, atom, 4, 32, 0, 1, data, extension="RANDR")


def test_outputs_are_found() -> None:
    assert find_devices() == (
        FoundDevice("screen", LEFT, f"{LEFT} ({SIZE} at 120.00 Hz)"),
        FoundDevice("screen", RIGHT, f"{RIGHT} ({SIZE} at 120.00 Hz)"),
    )


def test_no_session_has_no_outputs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":2047")
    assert find_devices() == ()
    monkeypatch.delenv("DISPLAY")
    assert find_devices() == ()
    with pytest.raises(UnsupportedByDeviceError, match="needs an X server"):
        opened(backend="x11")
    with pytest.raises(DeviceError, match="no X server answers at display ':2047'"):
        opened(display=":2047")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("--mode", "160x120-own"), "its mode is 160 x 120"),
        (("--gamma", "1.3:1:1"), "--gamma 1:1:1 --brightness 1"),
        (("--brightness", "0.8"), "--gamma 1:1:1 --brightness 1"),
        (("--same-as", LEFT), f"{LEFT} shows the same part of the screen"),
        (("--pos", "64x0"), f"{LEFT} shows the same part of the screen"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_an_inexact_output_is_refused_and_corrected_by_the_command_in_the_message(
    server: DummyServer, right: OutputPixels, command: tuple[str, str], words: str
) -> None:
    server.mode(RIGHT, Size(160, 120))
    # A desktop that stays as wide as it is, whatever becomes of the output.
    server.run("xrandr", "--fb", "512x512", "--output", RIGHT, *command)
    before = right.colours()
    with pytest.raises(UnsupportedByDeviceError) as caught:
        opened()
    assert words in str(caught.value)
    # Refused before anything was put on it.
    assert np.array_equal(right.colours(), before)
    for line in str(caught.value).splitlines()[1:]:
        mending = line.split("; ")[-1].split("then: ")[-1]
        server.run(*mending.replace("--mode 128x96", "--mode 128x96-own").split())
    opened().close()


def test_a_panned_output_is_refused_and_corrected_by_the_command_in_the_message(tmp_path: Path) -> None:
    # On a server of its own: some of it stays.
    with DummyServer(tmp_path) as panning, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", panning.display)
        panning.arrange(**{LEFT: SIZE, RIGHT: SIZE})
        panning.run("xrandr", "--fb", "512x512", "--output", RIGHT, "--panning", "256x192+128+0")
        with pytest.raises(UnsupportedByDeviceError, match="256 x 192 pixels that moves with the pointer") as caught:
            opened()
        panning.run(*str(caught.value).splitlines()[1].split("; ")[-1].split())
        opened().close()
        let_go(RIGHT)


def test_changes_of_levels_are_read_from_the_graphics_drivers_properties(server: DummyServer) -> None:
    with client(server) as connection:
        output_property(connection, RIGHT, "Broadcast RGB", "Limited 16:235")
        with pytest.raises(UnsupportedByDeviceError, match="16 to 235"):
            opened()
        output_property(connection, RIGHT, "Broadcast RGB", "Full")
    opened().close()


def test_an_output_in_use_is_refused_with_its_process(right: OutputPixels) -> None:
    with showing() as projector:
        projector.show(0)
        with pytest.raises(DeviceBusyError, match=f"in use by process {os.getpid()} "):
            opened()
        # The one who was there first is not disturbed.
        assert right.colours().min() == 255
    opened().close()


@pytest.mark.parametrize(
    ("backend", "command", "words"),
    [
        ("x11", ("--gamma", "1:1:1.4"), "gamma"),
        ("x11", ("--mode", "160x120-own"), "its mode is 160 x 120"),
        ("sdl", ("--mode", "160x120-own"), "its mode is 160 x 120"),
        ("x11", ("--off",), "switched off|nothing is connected"),
    ],
)
def test_an_output_that_is_changed_is_refused_with_the_next_pattern_or_sequence(
    server: DummyServer, right: OutputPixels, backend: str, command: tuple[str, ...], words: str
) -> None:
    server.mode(RIGHT, Size(160, 120))
    with showing(backend=backend) as projector:
        projector.show(0)
        server.run("xrandr", "--output", RIGHT, *command)
        # A ramp is asked for with each sequence, whether the output is there with each pattern.
        with pytest.raises((UnsupportedByDeviceError, DeviceGoneError), match=words):
            projector.load(sequence(SIZE)) if words == "gamma" else projector.show(0)
        if "--off" not in command:
            assert not right.colours().any()
        if words == "gamma":
            with pytest.raises(DeviceStateError, match="no sequence is loaded"):
                projector.show(0)


@pytest.mark.parametrize("backend", ["x11", "sdl"])
def test_a_window_that_came_above_the_patterns_goes_below_them(
    server: DummyServer, right: OutputPixels, backend: str
) -> None:
    with showing(backend=backend) as projector, client(server) as connection:
        projector.show(0)
        x11.black_window(connection, SIZE.width_px, 0, SIZE)
        assert not right.colours().any()
        projector.show(0)
        assert right.colours().min() == 255


def test_pixels_that_are_not_the_patterns_are_found_once_per_sequence(
    right: OutputPixels, monkeypatch: pytest.MonkeyPatch
) -> None:
    with showing() as projector, monkeypatch.context() as patch:
        patch.setattr("drivers.screen.output.fill_tiled", lambda *_: None)
        with pytest.raises(UnsupportedByDeviceError, match=r"of 12288 pixels are not the pattern's.*#ffffff was shown"):
            projector.show(0)
        assert not right.colours().any()
        patch.undo()
        projector.show(0)
        assert right.colours().min() == 255


def test_a_compositor_that_redirects_the_window_is_refused_unless_trusted(server: DummyServer) -> None:
    with client(server) as connection:
        connection.ask("QueryVersion", 0, 4, extension="Composite")
        owner = x11.hidden_window(connection)
        words = b"fancy effects"
        name = x11.atom(connection, "_NET_WM_NAME")
        connection.do("ChangeProperty", 0, owner, name, 31, 8, len(words), words)
        x11.take_selection(connection, x11.atom(connection, "_NET_WM_CM_S0"), owner, from_another=True)
        connection.do("RedirectSubwindows", connection.screen.root, 0, extension="Composite")
        with pytest.raises(UnsupportedByDeviceError, match=r"drawn by a compositor \(fancy effects\)"), showing():
            pytest.fail(_NEVER)
        with showing(trust_compositor=True) as projector:
            projector.show(0)


def test_the_server_does_not_blank_its_displays(server: DummyServer) -> None:
    def is_saving(connection: XConnection) -> bool:
        info = connection.ask("QueryInfo", connection.screen.root, extension="MIT-SCREEN-SAVER")
        return bool(info.state == 1)

    with client(server) as connection:
        server.run("xset", "s", "1", "1")
        assert awaited(lambda: is_saving(connection))
        with showing() as projector:
            # It woke them, and keeps them awake for longer than the second after which they slept.
            until_s = time.monotonic() + 1.5
            while time.monotonic() < until_s:
                projector.show(0)
                assert not is_saving(connection)
        assert awaited(lambda: is_saving(connection))
        server.run("xset", "s", "reset", "s", "off")


@pytest.mark.parametrize("backend", ["x11", "sdl"])
def test_the_end_of_the_server_is_reported_and_survived(tmp_path: Path, backend: str) -> None:
    # In a process of its own: Xlib may end it.
    with DummyServer(tmp_path) as mortal:
        mortal.arrange(**{LEFT: SIZE, RIGHT: SIZE})
        with started(backend, dark_after_s=0.0, display=mortal.display) as child:
            mortal.kill()
            said, _ = child.communicate("go on\n", timeout=60)
    assert said.split() == ["DeviceGoneError", "DeviceGoneError", "closed"]
    assert child.returncode == 0
