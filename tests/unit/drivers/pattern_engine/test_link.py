"""Engines found in /sys, reports on the wire byte by byte, and engines that do not answer."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from drivers import dlpc350, dlpc900
from drivers.dlpc350.projector import DLPC350
from drivers.dlpc900.projector import DLPC900
from drivers.pattern_engine.usb import UsbController, UsbLink, choose_engine, find_engines, list_devices, open_link
from slrig.errors import ConfigError, DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError, WrongSystemError
from tests.contract.dlpc350_device import Cable, FakeEngine
from tests.contract.dlpc900_device import Fake900
from tests.unit.drivers.conftest import OPENED

SHORT_S = 0.05


@contextmanager
def wired(*, before: bytes = b"") -> Iterator[tuple[UsbLink, socket.socket]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if before:
        far.send(before)
    link = UsbLink(near.detach(), "light engine", DLPC350, answer_s=SHORT_S if before else 5.0)
    try:
        with far:
            yield link, far
    finally:
        link.close()


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine({})


def linked(engine: FakeEngine) -> UsbLink:
    link = UsbLink(Cable(engine).host, "light engine", DLPC350, answer_s=5.0)
    OPENED.append(link)
    return link


def answered(number: int, data: bytes, *, flags: int = 0xC0) -> bytes:
    message = bytes([flags, number]) + len(data).to_bytes(2, "little") + data
    return message.ljust(-(-len(message) // 64) * 64, b"\0")


def test_a_command_is_framed_as_the_manual_says() -> None:
    long = bytes(range(200))
    with wired() as (link, far):
        far.send(answered(1, b"", flags=0x40))
        # What lay there before the link was opened would be forgotten; this came after.
        link.write(0x1A24, b"\2")
        assert far.recv(100) == bytes([0, 0x40, 1, 3, 0, 0x24, 0x1A, 2]).ljust(65, b"\0")
        far.send(answered(2, b"\x42"))
        assert link.read(0x1A0C, 1) == b"\x42"
        assert far.recv(100) == bytes([0, 0xC0, 2, 2, 0, 0x0C, 0x1A]).ljust(65, b"\0")
        # What is longer than a report goes on in the next one, both ways.
        far.send(answered(3, b"", flags=0x40))
        link.write(0x1A34, long)
        reports = [far.recv(100) for _ in range(4)]
        assert all(len(report) == 65 and report[0] == 0 for report in reports)
        together = b"".join(report[1:] for report in reports)
        assert together == (bytes([0x40, 3, 202, 0, 0x34, 0x1A]) + long).ljust(256, b"\0")
        for at in (0, 64):
            far.send(answered(4, long[:100])[at : at + 64])
        assert link.read(0x1A34, 100) == long[:100]
        with pytest.raises(DeviceError, match="a command of 507 bytes is too long, the limit is 506"):
            link.write(0x1A34, bytes(507))
        far.send(answered(5, b"\7"))
        with pytest.raises(DeviceError, match="requested 8 bytes of 0x1a29, it gave 1"):
            link.read(0x1A29, 8)


def test_what_another_program_left_unread_is_forgotten() -> None:
    with wired(before=answered(1, b"\7")) as (link, _), pytest.raises(DeviceError, match="did not answer"):
        link.read(0x1A0C, 1)


def test_an_answer_to_an_earlier_command_is_passed_over(engine: FakeEngine) -> None:
    engine.faults.stale_answer = True
    engine.registers[0x1A29] = bytes(range(8))
    link = linked(engine)
    assert [link.read(0x1A29, 8) for _ in range(300)] == [bytes(range(8))] * 300


def test_a_refusal_and_a_silent_engine_are_reported_and_it_may_come_back(engine: FakeEngine) -> None:
    engine.faults.refused.add(0x1A24)
    engine.faults.silent.add(0x1A0C)
    link = linked(engine)
    with pytest.raises(DeviceError, match="refused the command 0x1a24"):
        link.write(0x1A24, b"\2")
    link._answer_s = SHORT_S
    with pytest.raises(DeviceError, match=r"did not answer the command 0x1a0c in 0\.05 s"):
        link.read(0x1A0C, 1)
    engine.faults.silent.clear()
    link._answer_s = 5.0
    assert link.read(0x1A0C, 1) == b"\2"


def test_an_unplugged_engine_is_gone_and_a_closed_link_is_closed() -> None:
    with wired() as (link, far):
        far.close()
        for _ in range(2):
            with pytest.raises(DeviceGoneError, match="is gone"):
                link.read(0x1A0C, 1)
        for _ in range(2):
            link.close()
        with pytest.raises(DeviceStateError):
            link.write(0x1A24, b"\0")


def test_a_node_that_is_not_there_or_no_engine_is_gone_and_a_held_one_is_busy(tmp_path: Path) -> None:
    path = tmp_path / "hidraw0"
    with pytest.raises(DeviceGoneError, match="No such file"):
        open_link(path, DLPC350)
    path.write_bytes(b"")
    with pytest.raises(DeviceGoneError, match="no hidraw node"):
        open_link(path, DLPC350)
    with path.open("wb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DeviceBusyError, match="another program holds"):
            open_link(path, DLPC350)


@pytest.mark.parametrize(("vendor", "product"), [(0x0451, 0x6401), (0x046D, 0xC077)])
def test_a_number_that_was_given_to_another_device_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vendor: int, product: int
) -> None:
    def answer(handle: int, request: int, into: bytearray) -> int:
        assert request == 0x80084803
        into[:] = (3).to_bytes(4, "little") + vendor.to_bytes(2, "little") + product.to_bytes(2, "little")
        return handle

    path = tmp_path / "hidraw0"
    path.write_bytes(b"")
    monkeypatch.setattr(fcntl, "ioctl", answer)
    if product == 0x6401:
        open_link(path, DLPC350).close()
    else:
        with pytest.raises(DeviceGoneError, match="found 046d:c077"):
            open_link(path, DLPC350)


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [(errno.EACCES, DeviceError, 'ATTRS{idProduct}=="6401"'), (errno.EBUSY, DeviceBusyError, "")],
)
def test_a_node_that_may_not_be_opened_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, number: int, kind: type[DeviceError], words: str
) -> None:
    monkeypatch.setattr(os, "open", mock.Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(kind) as refused:
        open_link(Path("/dev/hidraw0"), DLPC350)
    assert type(refused.value) is kind
    assert words in str(refused.value)


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
    found = find_engines(DLPC350, tmp_path)
    assert [(node.name, str(node.path)) for node in found] == [("A", "/dev/hidraw2"), ("B", "/dev/hidraw10")]
    (first, _) = list_devices(DLPC350, tmp_path)
    assert (first.driver, first.device) == ("dlpc350", "A")
    assert first.label == "Texas Instruments DLPC350 (/dev/hidraw2)"


def test_a_name_never_stands_for_two(tmp_path: Path) -> None:
    for number, port in ((0, "usb-1/input0"), (1, "usb-2/input0"), (2, ""), (3, "")):
        plug(tmp_path, number, serial="LCR2", port=port)
    assert [node.name for node in find_engines(DLPC350, tmp_path)] == [
        "usb-1/input0",
        "usb-2/input0",
        "/dev/hidraw2",
        "/dev/hidraw3",
    ]


def test_the_engine_that_is_meant(tmp_path: Path) -> None:
    plug(tmp_path, 0, serial="A")
    (only,) = find_engines(DLPC350, tmp_path)
    assert choose_engine(None, (only,)) is choose_engine("A", (only,)) is choose_engine("/dev/hidraw0", (only,)) is only
    with pytest.raises(DeviceGoneError, match=r'light engine "B" not found, plugged in: A \(/dev/hidraw0\)'):
        choose_engine("B", (only,))
    plug(tmp_path, 1, serial="B")
    with pytest.raises(ConfigError, match=r"A .*; B .*; write device"):
        choose_engine(None, find_engines(DLPC350, tmp_path))
    assert choose_engine("B", find_engines(DLPC350, tmp_path)).path == Path("/dev/hidraw1")


def test_the_first_interface_of_an_engine_is_found(tmp_path: Path) -> None:
    for number, port in enumerate(("usb-1/input1", "usb-1/input0")):
        plug(tmp_path, number, hid="0003:00000451:0000C900", serial="LCR3", port=port)
    assert [(node.name, str(node.path)) for node in find_engines(DLPC900, tmp_path)] == [("LCR3", "/dev/hidraw1")]


def test_none_is_no_error_for_the_finder_and_one_for_a_rig(tmp_path: Path) -> None:
    assert find_engines(DLPC350, tmp_path / "none") == ()
    assert dlpc900.find_devices() == ()
    with pytest.raises(DeviceGoneError, match="no light engine found, plugged in: none"):
        dlpc900.open_projector({}, tmp_path)


@pytest.mark.parametrize(
    ("driver", "hid", "engine", "options"),
    [(dlpc350, ENGINE, FakeEngine({}), {"patterns": "p"}), (dlpc900, "0003:00000451:0000C900", Fake900(), {})],
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

    def open_link(path: Path, kind: UsbController) -> UsbLink:
        opened.append(path)
        return UsbLink(Cable(engine).host, "light engine", kind)

    monkeypatch.setattr("drivers.pattern_engine.usb.find_engines", partial(find_engines, sysfs=tmp_path))
    monkeypatch.setattr("drivers.pattern_engine.usb.open_link", open_link)
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
