"""The host's end of a line: ports, lines and their damage, commands sent again, and the box's clock."""

from __future__ import annotations

import importlib
import random
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.serial_port import resolve_port
from drivers.serial_projector.client import MAX_DRIFT, BoxClock
from drivers.serial_projector.device import wire
from drivers.serial_projector.link import (
    MAX_LINE_BYTES,
    MAX_TRIES,
    NUMBERS,
    BoxAnswer,
    BoxEvent,
    BoxFault,
    BoxLink,
    BoxRefusedError,
    LineSplitter,
    NoAnswerError,
    RefusalCode,
    SequenceMode,
    UnreadableLine,
    encode_line,
    find_ports,
    parse_line,
)
from slrig.errors import DeviceGoneError, DeviceStateError
from tests.unit.drivers.serial_projector.line import Noise
from tests.virtual_clock import VirtualClock

SHOW_3 = encode_line("1A2B 7 SHOW 3")

# Lines.


def test_the_checksum_is_the_one_with_the_published_check_value() -> None:
    assert wire.crc16(b"123456789") == 0x29B1
    assert encode_line("123456789") == b"123456789*29B1\n"


def test_host_and_box_write_the_same_lines_and_have_the_same_numbers() -> None:
    for text in ("1A2B 7 SHOW 3", "! DONE 26", "x", "a b " * 50):
        assert wire.encode_line(text) == encode_line(text)
        assert wire.decode_line(encode_line(text)[:-1]) == text
    for kind in (RefusalCode, BoxFault, SequenceMode):
        assert {each.name: each.value for each in kind} == {each.name: getattr(wire, each.name) for each in kind}
    assert (wire.NUMBERS, wire.MAX_LINE_BYTES) == (NUMBERS, MAX_LINE_BYTES)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("1A2B 7 OK 3 120", BoxAnswer("1A2B", 7, None, ("3", "120"))),
        ("1A2B 7 OK", BoxAnswer("1A2B", 7, None, ())),
        ("1A2B 7 ERR 4 26 of 26", BoxAnswer("1A2B", 7, 4, ("26", "of", "26"))),
        ("! FRAME 3 120", BoxEvent("FRAME", ("3", "120"))),
        ("? ERR 1 bad frame", UnreadableLine()),
        ("1A2B seven OK", None),
        ("1A2B 7 MAYBE", None),
        ("hello", None),
    ],
)
def test_lines_are_distinguished(text: str, line: object) -> None:
    assert parse_line(encode_line(text)) == line
    assert parse_line(encode_line(text)[:-1] + b"\r\n") == line


def test_a_damaged_line_is_never_taken_for_another_one() -> None:
    for at in range(len(SHOW_3) - 1):
        for bit in range(8):
            flipped = SHOW_3[:at] + bytes([SHOW_3[at] ^ 1 << bit]) + SHOW_3[at + 1 : -1]
            assert parse_line(flipped) is None
            assert wire.decode_line(flipped) is None
    # Bursts of up to 16 bits are always found; what is longer slips through once in 65 536.
    noise, survived = Noise(corruption=1.0, seed=3), 0
    for _ in range(5_000):
        for each in LineSplitter().lines(noise.through(SHOW_3) + b"\n"):
            answer = wire.decode_line(each)
            survived += answer is not None
            assert answer in {None, "1A2B 7 SHOW 3"}
    # A line that lost its end, or has noise before it, may still be whole.
    assert survived < 500


def test_bytes_come_in_pieces_of_any_size_and_need_no_end() -> None:
    text = b"".join(encode_line(f"1A2B {number} PING") for number in range(50))
    rng = random.Random(1)
    splitter, lines = LineSplitter(), []
    while text:
        size = rng.randrange(1, 40)
        lines += splitter.lines(text[:size])
        text = text[size:]
    assert len(lines) == 50
    assert all(isinstance(wire.decode_line(line), str) for line in lines)
    # A line without end does not fill the memory.
    for _ in range(1_000):
        assert splitter.lines(b"x" * 100) == []
    assert splitter.lines(b"\n" + SHOW_3)[1:] == [SHOW_3[:-1]]


# Commands.


class ScriptedPort:
    """A port whose far end is a script: what it answers to each line, told its number."""

    def __init__(self, answers: Callable[[bytes, int], bytes], clock: VirtualClock) -> None:
        self.written: list[bytes] = []
        self._answers, self._clock = answers, clock
        self._waiting, self._never = b"", threading.Event()

    def write(self, data: bytes) -> None:
        self.written.append(data)
        self._waiting += self._answers(data, len(self.written))

    def read(self, timeout_s: float) -> bytes:
        if not self._waiting:
            self._clock.wait_until(self._clock.now_ns() + round(timeout_s * 1e9), self._never)
        data, self._waiting = self._waiting, b""
        return data

    def close(self) -> None:
        self.written.append(b"closed")


def answer(data: bytes, text: str) -> bytes:
    session, number = data.decode().split()[:2]
    return encode_line(f"{session} {number} {text}")


def silence(_data: bytes, _count: int) -> bytes:
    return b""


def link(answers: Callable[[bytes, int], bytes], *, reply_s: float = 0.05, deadline_s: float = 5.0) -> BoxLink:
    clock = VirtualClock()
    return BoxLink(ScriptedPort(answers, clock), reply_s, deadline_s, clock=clock)


def written(of: BoxLink) -> list[bytes]:
    assert isinstance(of.port, ScriptedPort)
    return of.port.written


def took_s(of: BoxLink) -> float:
    return of.clock.now_ns() / 1e9 - 1


def test_a_command_is_sent_again_as_it_was_until_it_is_answered() -> None:
    asked = link(lambda data, count: answer(data, "OK 3 99") if count == 4 else b"")
    reply = asked.ask("SHOW", 3)
    assert reply.words == ("3", "99")
    assert (reply.sent_ns, reply.received_ns) == (10**9, 10**9 + 150_000_000)
    assert len(set(written(asked))) == 1
    assert asked.tally.again == 3


@pytest.mark.parametrize(("deadline_s", "tries"), [(5.0, MAX_TRIES), (0.12, 3)])
def test_tries_end_by_their_number_or_a_deadline(deadline_s: float, tries: int) -> None:
    asked = link(silence, deadline_s=deadline_s)
    with pytest.raises(NoAnswerError, match=f"SHOW, sent {tries} times in {tries * 0.05:.2f} s"):
        asked.ask("SHOW", 3)
    assert len(written(asked)) == tries <= 12


@pytest.mark.parametrize(
    ("early", "again", "most_s", "damaged"),
    [
        (lambda _data: encode_line("? ERR 1 bad frame"), 9, 0.0, 0),
        (lambda data: answer(data, "OK 1").replace(b"OK 1", b"OK 2"), 9, 9 * 0.021, 9),
    ],
    ids=["that the box could not read", "whose answer was damaged"],
)
def test_a_line_is_sent_again_soon(early: Callable[[bytes], bytes], again: int, most_s: float, damaged: int) -> None:
    asked = link(lambda data, n: early(data) if n < 10 else answer(data, "OK 1"), reply_s=5.0, deadline_s=60.0)
    assert asked.ask("STOP").words == ("1",)
    assert took_s(asked) <= most_s
    assert (asked.tally.again, asked.tally.damaged) == (again, damaged)


def test_stale_and_foreign_answers_are_passed_over() -> None:
    def answers(data: bytes, count: int) -> bytes:
        session, number = data.decode().split()[:2]
        stale = encode_line(f"{session} {(int(number) - 1) % 10_000} OK stale")
        return encode_line("ZZZZ 1 OK foreign") + stale + encode_line("! FRAME 3 120") + answer(data, f"OK {count}")

    asked = link(answers)
    assert asked.ask("PING").words == ("1",)
    assert asked.ask("PING").words == ("2",)
    assert asked.tally.others == 2
    assert list(asked.events) == [BoxEvent("FRAME", ("3", "120"))] * 2


def test_each_command_has_its_number_and_each_link_its_session() -> None:
    sent = link(lambda data, _count: answer(data, "OK"))
    sent._number = 9_997
    for _ in range(4):
        sent.ask("PING")
    assert [int(line.split()[1]) for line in written(sent)] == [9_998, 9_999, 0, 1]
    assert {line.split()[0] for line in written(sent)} == {sent.session.encode()}
    assert len({link(silence).session for _ in range(20)}) > 15


def test_a_refusal_keeps_its_code_and_words() -> None:
    asked = link(lambda data, _count: answer(data, "ERR 4 26 of 26"))
    with pytest.raises(BoxRefusedError, match=r"refused SHOW: error 4 \(range\) 26 of 26") as refusal:
        asked.ask("SHOW", 26)
    assert (refusal.value.number, refusal.value.words) == (4, ("26", "of", "26"))
    with pytest.raises(BoxRefusedError, match=r"error 77 \(unknown\)"):
        link(lambda data, _count: answer(data, "ERR 77 new")).ask("SHOW", 1)


def test_a_wait_ends_when_the_projector_is_closed_and_a_port_that_is_gone_is_reported() -> None:
    asked = link(silence, reply_s=60.0, deadline_s=600.0)
    asked.closing.set()
    with pytest.raises(DeviceStateError):
        asked.ask("SHOW", 1)
    assert took_s(asked) < 0.1

    def gone(_data: bytes, _count: int) -> bytes:
        message = "gone"
        raise DeviceGoneError(message)

    with pytest.raises(DeviceGoneError):
        link(gone).ask("PING")


# The box's clock on the host's: the bounds hold, whatever the line does.

BEGUN_NS = 5_000_000_000


class Truth:
    """A box whose clock began at BEGUN_NS and is off by `drift`."""

    def __init__(self, drift: float) -> None:
        self.drift = drift

    def device_us(self, host_ns: float) -> int:
        return round((host_ns - BEGUN_NS) * (1 + self.drift) / 1000)

    def exchange(self, clock: BoxClock, sent_ns: int, there_ns: int, back_ns: int) -> None:
        clock.note(self.device_us(sent_ns + there_ns), sent_ns, sent_ns + there_ns + back_ns)


@pytest.mark.parametrize("drift", [0.0, 30e-6, -30e-6, 0.9 * MAX_DRIFT, -0.9 * MAX_DRIFT])
def test_the_error_that_is_stated_holds(drift: float) -> None:
    rng, truth, clock = random.Random(drift), Truth(drift), BoxClock()
    now_ns = BEGUN_NS + 10**9
    for _ in range(400):
        now_ns += round(rng.uniform(0.01e9, 0.6e9))
        there_ns, back_ns = (round(rng.expovariate(1 / 200_000)) + 20_000 for _ in range(2))
        truth.exchange(clock, now_ns, there_ns, back_ns)
        asked_ns = now_ns + round(rng.uniform(-0.5e9, 0.5e9))
        t_ns, error_ns = clock.host_ns(truth.device_us(asked_ns))
        # The box's own counter has steps of 1 µs.
        assert abs(t_ns - asked_ns) <= error_ns + 1_000


def test_drift_falls_out_with_time() -> None:
    truth, clock = Truth(200e-6), BoxClock()
    errors_ns = []
    for step in range(240):
        now_ns = BEGUN_NS + step * 250_000_000
        truth.exchange(clock, now_ns, 100_000, 100_000)
        errors_ns.append(clock.host_ns(truth.device_us(now_ns + 200_000_000))[1])
    low, high = clock.rate
    assert low <= 1 / (1 + 200e-6) <= high
    assert high - low < 12e-6
    # At first, 0.2 s ahead may be off by 0.1 % of it; after a minute the exchange alone is left.
    assert errors_ns[0] > 250_000
    assert max(errors_ns[120:]) < 110_000


def test_the_shortest_exchange_counts_and_a_retry_widens_and_does_not_mislead() -> None:
    truth, clock = Truth(0.0), BoxClock()
    # Obeyed at once, answered 300 ms later: the answer was lost twice.
    truth.exchange(clock, BEGUN_NS, 50_000, 300_000_000)
    t_ns, error_ns = clock.host_ns(truth.device_us(BEGUN_NS + 50_000))
    assert abs(t_ns - BEGUN_NS - 50_000) <= error_ns <= 151_000_000
    for step, there_ns in enumerate((5_000_000, 50_000, 9_000_000, 2_000_000)):
        truth.exchange(clock, BEGUN_NS + step * 20_000_000, there_ns, there_ns)
    assert clock.host_ns(truth.device_us(BEGUN_NS + 60_000_000))[1] < 100_000


def test_a_clock_that_jumps_is_learnt_again_and_one_that_was_never_read_is_not_known() -> None:
    clock = BoxClock()
    with pytest.raises(ValueError, match="no exchange"):
        clock.host_ns(0)
    Truth(0.0).exchange(clock, BEGUN_NS, 50_000, 50_000)
    clock.note(7, BEGUN_NS + 10**9, BEGUN_NS + 10**9 + 100_000)
    t_ns, error_ns = clock.host_ns(7)
    assert abs(t_ns - BEGUN_NS - 10**9 - 50_000) <= error_ns <= 51_000


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
    pico, bridge = find_ports(ports / "by-id")
    assert pico.driver == bridge.driver == "serial_projector"
    assert pico.device == str(ports / "by-id" / "usb-MicroPython_Board_in_FS_mode_e66-if00")
    assert pico.label.startswith("MicroPython on an RP2040: MicroPython Board (")
    assert "2E8A:0005, serial number e66" in pico.label
    assert bridge.device == str(ports / "dev" / "ttyUSB1")
    assert "USB Serial" in bridge.label
    assert "may be a trigger box" in bridge.label
    # Without lasting names, the ports' own are used.
    assert [each.device for each in find_ports(ports / "none")] == [
        str(ports / "dev" / "ttyACM0"),
        str(ports / "dev" / "ttyUSB1"),
    ]


def test_names_that_are_no_link_are_left_as_they_are() -> None:
    for name in ("/dev/ttyACM0", "COM3", "socket://localhost:4000", "usb-none"):
        assert resolve_port(name) == name
