"""Engines found in /sys, and the one that a rig file means."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from drivers import dlpc350, dlpc900
from drivers.dlpc350.projector import DLPC350
from drivers.dlpc900.projector import DLPC900
from drivers.pattern_engine.finding import engines, found_devices, resolved
from drivers.pattern_engine.link import Kind, Link
from slrig.errors import ConfigError, DeviceGoneError, WrongSystemError
from tests.contract.dlpc350_device import Cable, FakeEngine
from tests.contract.dlpc900_device import Fake900

ENGINE = "0003:00000451:00006401"
MOUSE = "0003:0000046D:0000C077"


def plug(sysfs: Path, number: int, *, hid: str = ENGINE, serial: str = "", port: str = "") -> None:
    folder = sysfs / f"hidraw{number}" / "device"
    folder.mkdir(parents=True)
    (folder / "uevent").write_text(
        f"DRIVER=hid-generic\nHID_ID={hid}\nHID_NAME=Texas Instruments DLPC350\nHID_PHYS={port}\nHID_UNIQ={serial}\n"
    )


def test_engines_are_distinguished_from_other_devices(tmp_path: Path) -> None:
    plug(tmp_path, 0, hid=MOUSE, serial="M")
    plug(tmp_path, 10, serial="B")
    plug(tmp_path, 2, serial="A")
    (tmp_path / "hidraw3").mkdir()
    found = engines(DLPC350, tmp_path)
    assert [(node.name, str(node.path)) for node in found] == [("A", "/dev/hidraw2"), ("B", "/dev/hidraw10")]
    (first, _) = found_devices(DLPC350, tmp_path)
    assert (first.driver, first.device) == ("dlpc350", "A")
    assert first.label == "Texas Instruments DLPC350 (/dev/hidraw2)"


def test_a_name_never_stands_for_two(tmp_path: Path) -> None:
    for number, port in ((0, "usb-1/input0"), (1, "usb-2/input0"), (2, ""), (3, "")):
        plug(tmp_path, number, serial="LCR2", port=port)
    assert [node.name for node in engines(DLPC350, tmp_path)] == [
        "usb-1/input0",
        "usb-2/input0",
        "/dev/hidraw2",
        "/dev/hidraw3",
    ]


def test_the_engine_that_is_meant(tmp_path: Path) -> None:
    plug(tmp_path, 0, serial="A")
    (only,) = engines(DLPC350, tmp_path)
    assert resolved(None, (only,)) is resolved("A", (only,)) is resolved("/dev/hidraw0", (only,)) is only
    with pytest.raises(DeviceGoneError, match=r'light engine "B", plugged in: A \(/dev/hidraw0\)'):
        resolved("B", (only,))
    plug(tmp_path, 1, serial="B")
    with pytest.raises(ConfigError, match=r"A .*; B .*; write device"):
        resolved(None, engines(DLPC350, tmp_path))
    assert resolved("B", engines(DLPC350, tmp_path)).path == Path("/dev/hidraw1")


def test_the_first_interface_of_an_engine_is_found(tmp_path: Path) -> None:
    for number, port in enumerate(("usb-1/input1", "usb-1/input0")):
        plug(tmp_path, number, hid="0003:00000451:0000C900", serial="LCR3", port=port)
    assert [(node.name, str(node.path)) for node in engines(DLPC900, tmp_path)] == [("LCR3", "/dev/hidraw1")]


def test_none_is_no_error_for_the_finder_and_one_for_a_rig(tmp_path: Path) -> None:
    assert engines(DLPC350, tmp_path / "none") == ()
    assert dlpc900.find_devices() == ()
    with pytest.raises(DeviceGoneError, match="asked for a light engine, plugged in: none"):
        dlpc900.open_projector({}, tmp_path)


@pytest.mark.parametrize(
    ("driver", "hid", "engine", "options"),
    [
        (dlpc350, ENGINE, FakeEngine({}), {"patterns": "p"}),
        (dlpc900, "0003:00000451:0000C900", Fake900(), {}),
    ],
)
def test_a_rig_opens_the_engine_that_it_means(
    driver: Any,
    hid: str,
    engine: FakeEngine,
    options: dict[str, object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number, serial in enumerate("AB"):
        plug(tmp_path, number, hid=hid, serial=serial)
    opened: list[Path] = []

    def open_link(path: Path, kind: Kind) -> Link:
        opened.append(path)
        return Link(Cable(engine).host, "light engine", kind)

    monkeypatch.setattr("drivers.pattern_engine.finding.engines", partial(engines, sysfs=tmp_path))
    monkeypatch.setattr("drivers.pattern_engine.link.open_link", open_link)
    projector = driver.open_projector({"device": "B", **options}, tmp_path)
    assert (projector.info.serial, opened) == ("B", [Path("/dev/hidraw1")])
    projector.close()


def test_other_systems_have_no_hidraw(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    told = r"^%s: Linux only: .*/dev/hidraw.*, and this is macOS; run"
    for driver, name, options in ((dlpc350, "dlpc350", {"patterns": "p"}), (dlpc900, "dlpc900", {})):
        with pytest.raises(WrongSystemError, match=told % name):
            driver.find_devices()
        # What else is wrong does not matter then.
        for table in (options, {"colour": "none such"}):
            with pytest.raises(WrongSystemError, match=told % name):
                driver.open_projector(table, tmp_path)
