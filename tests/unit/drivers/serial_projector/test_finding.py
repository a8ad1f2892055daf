"""Ports are found without opening one, and named so that the name stays."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.serial_port import resolved
from drivers.serial_projector import find_devices, finding, open_projector
from slrig.errors import LibraryMissingError


def port(device: str, **known: object) -> SimpleNamespace:
    fields = {"vid": None, "pid": None, "manufacturer": None, "product": None, "serial_number": None}
    return SimpleNamespace(device=device, **{**fields, **known})


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Three ports; one of them has a lasting name."""
    dev = tmp_path / "dev"
    dev.mkdir()
    for name in ("ttyACM0", "ttyUSB1", "ttyS0"):
        (dev / name).touch()
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    (by_id / "usb-MicroPython_Board_in_FS_mode_e66-if00").symlink_to(dev / "ttyACM0")
    found = [
        port(str(dev / "ttyUSB1"), vid=0x1A86, pid=0x7523, product="USB Serial"),
        port(str(dev / "ttyS0")),
        port(str(dev / "ttyACM0"), vid=0x2E8A, pid=5, manufacturer="MicroPython", product="Board", serial_number="e66"),
    ]
    monkeypatch.setattr(importlib.import_module("serial.tools.list_ports"), "comports", lambda: found)

    def refused(*_: object, **__: object) -> object:
        message = "a port was opened"
        raise AssertionError(message)

    monkeypatch.setattr(importlib.import_module("serial"), "Serial", refused)
    return tmp_path


def test_usb_ports_are_found_by_lasting_names_and_not_opened(ports: Path) -> None:
    pico, bridge = finding.found_ports(ports / "by-id")
    assert pico.driver == bridge.driver == "serial_projector"
    assert pico.device == str(ports / "by-id" / "usb-MicroPython_Board_in_FS_mode_e66-if00")
    assert pico.label.startswith("MicroPython on an RP2040: MicroPython Board (")
    assert "2E8A:0005, serial number e66" in pico.label
    assert bridge.device == str(ports / "dev" / "ttyUSB1")
    assert "USB Serial" in bridge.label
    assert "not asked" in bridge.label
    # Without lasting names, the ports' own are used.
    assert [each.device for each in finding.found_ports(ports / "none")] == [
        str(ports / "dev" / "ttyACM0"),
        str(ports / "dev" / "ttyUSB1"),
    ]


def test_names_that_are_no_link_are_left_as_they_are() -> None:
    for name in ("/dev/ttyACM0", "COM3", "socket://localhost:4000", "usb-none"):
        assert resolved(name) == name


def test_without_pyserial_the_driver_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ["serial", *(name for name in sys.modules if name.startswith("serial."))]:
        monkeypatch.setitem(sys.modules, name, None)
    for call in (find_devices, lambda: open_projector({"port": "/dev/ttyACM0"}, Path())):
        with pytest.raises(LibraryMissingError) as missing:
            call()
        assert missing.value.install == "pip install pyserial"
