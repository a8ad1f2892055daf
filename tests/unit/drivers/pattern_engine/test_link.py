"""Reports on the wire, byte by byte, and what becomes of an engine that does not answer."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest

from drivers.dlpc350.projector import DLPC350
from drivers.pattern_engine.link import Link, open_link
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError
from tests.contract.dlpc350_device import Cable, FakeEngine
from tests.unit.drivers.conftest import OPENED

SHORT_S = 0.05


@contextmanager
def wired(*, before: bytes = b"") -> Iterator[tuple[Link, socket.socket]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if before:
        far.send(before)
    link = Link(near.detach(), "light engine", DLPC350, answer_s=SHORT_S if before else 5.0)
    try:
        with far:
            yield link, far
    finally:
        link.close()


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine({})


def linked(engine: FakeEngine) -> Link:
    OPENED.append(Link(Cable(engine).host, "light engine", DLPC350, answer_s=5.0))
    return OPENED[-1]


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
        with pytest.raises(DeviceError, match="asked to send 507 bytes at once, it takes 506"):
            link.write(0x1A34, bytes(507))
        far.send(answered(5, b"\7"))
        with pytest.raises(DeviceError, match="asked for 8 bytes of 0x1a29, it gave 1"):
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
    assert link.read(0x1A0C, 1) == b"\0"


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
        with pytest.raises(DeviceBusyError, match="another program holds it"):
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
