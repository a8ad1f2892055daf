"""The Arduino's whole firmware on its processor in a simulator, under the driver: its serial port, timer and pins."""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.serial_projector.client import SerialProjectorOptions
from drivers.serial_projector.link import LineSplitter, encode_line
from drivers.serial_projector.projector import HEADER, SerialProjector, export_patterns
from slrig.errors import DeviceError, UnsupportedByDeviceError
from tests.unit.drivers.serial_projector.conftest import SEQUENCE
from tests.unit.drivers.serial_projector.remote import ARDUINO, HERE, compiled, simulator
from tests.virtual_clock import VirtualClock

pytestmark = pytest.mark.slow

CYCLES_PER_US = 16
TICK_CYCLES = 8
"""Of Timer 1."""
PULSE_LESS_US = 14
RAM_BEGIN = 0x100


@dataclass
class Arduino:
    """The board on a serial line, in its own time: the clock's. Implements `drivers.serial_port.BytePort`.

    changes : (cycle, pin, level) of every change. lowest_stack : the lowest stack pointer so far.
    """

    firmware: Path
    clock: VirtualClock
    changes: list[tuple[int, str, int]] = field(default_factory=list)
    lowest_stack: int = 0xFFFF

    def __post_init__(self) -> None:
        command = [str(simulator()), "board", str(self.firmware)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603
        self._began_ns, self._cycle = self.clock.now_ns(), 0
        self._received = b""
        self._never, self._lock = threading.Event(), threading.RLock()
        self.do("ready 1")

    def do(self, command: str) -> None:
        """Give the simulator a command."""
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def catch_up(self) -> None:
        """Let the board go on to the present."""
        assert self._process.stdout is not None
        with self._lock:
            cycles = (self.clock.now_ns() - self._began_ns) * CYCLES_PER_US // 1000 - self._cycle
            if cycles <= 0:
                return
            self.do(f"run {cycles}")
            while (words := self._process.stdout.readline().split())[1] != "end":
                if words[1] == "uart":
                    self._received += bytes.fromhex(words[2])
                else:
                    self.changes.append((int(words[0]), words[1], int(words[2])))
            self._cycle, self.lowest_stack = int(words[0]), int(words[2])

    def read(self, timeout_s: float) -> bytes:
        """See `BytePort`."""
        until_ns = self.clock.now_ns() + round(timeout_s * 1e9)
        while True:
            self.catch_up()
            with self._lock:
                data, self._received = self._received, b""
            if data or self.clock.now_ns() >= until_ns:
                return data
            self.clock.wait_until(min(self.clock.now_ns() + 1_000_000, until_ns), self._never)

    def write(self, data: bytes) -> None:
        """See `BytePort`."""
        self.catch_up()
        with self._lock:
            self.do(f"send {data.hex()}")

    def close(self) -> None:
        """See `BytePort`."""

    def end(self) -> None:
        """Switch the simulator off."""
        self._process.kill()
        self._process.communicate()

    def spans(self, pin: str, level: int = 1) -> list[tuple[int, int]]:
        """Cycles at which a pin took a level, and left it again."""
        changes = [(cycle, to) for cycle, each, to in self.changes if each == pin]
        return [(begun, ended) for (begun, to), (ended, _) in pairwise(changes) if to == level]


Make = Callable[..., Arduino]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[Arduino] = []

    def board(*options: str, sources: tuple[Path, ...] = (ARDUINO / "main.c", ARDUINO / "protocol.c")) -> Arduino:
        export_patterns(SEQUENCE, tmp_path)
        firmware = compiled(*sources, include=tmp_path, options=options)
        made.append(Arduino(firmware, VirtualClock(threads=["serial projector"])))
        return made[-1]

    yield board
    for each in made:
        each.end()


def opened(board: Arduino, **options: float) -> SerialProjector:
    table = SerialProjectorOptions(port="the line", **options)  # type: ignore[arg-type]
    return SerialProjector(lambda: board, table, export_folder=Path(), clock=board.clock)


@pytest.mark.parametrize("level", [1, 0])
def test_pulses_last_what_was_ordered_to_the_timers_tick(make: Make, level: int) -> None:
    board = make(f"-DCAMERA_LEVEL={level}")
    projector = opened(board)
    projector.load(SEQUENCE)
    for exposure_s in (0.0002, 0.005, 0.0328, 0.0985):
        board.changes.clear()
        projector.play(exposure_s, exposure_s + 0.012)
        board.clock.advance(len(SEQUENCE) * (exposure_s + 0.012) + 0.03)
        board.catch_up()
        pulses, lit = board.spans("camera", level), board.spans("lamp")
        assert len(pulses) == len(lit) == len(SEQUENCE)
        ordered = (exposure_s * 1e6 - PULSE_LESS_US) * CYCLES_PER_US
        assert max(abs(end - begin - ordered) for begin, end in pulses) <= TICK_CYCLES
        for (begin, end), (on, off) in zip(pulses, lit, strict=True):
            assert on < begin < end + PULSE_LESS_US * CYCLES_PER_US < off
            # `hold_us`, and what a program with all else to do may be late by.
            assert 2000 <= (off - on) / CYCLES_PER_US - exposure_s * 1e6 <= 3000
        periods_us = [(later - earlier) / CYCLES_PER_US for (earlier, _), (later, _) in pairwise(pulses)]
        assert max(abs(each - exposure_s * 1e6 - 12_000) for each in periods_us) < 1000
    # A pulse ends with its light, so that the next play's first one is whole.
    projector.play(0.0985, 0.12)
    board.clock.advance(0.05)
    board.catch_up()
    board.changes.clear()
    projector.stop()
    board.clock.advance(0.05)
    board.catch_up()
    gone, rest = board.changes
    assert (gone[1:], rest[1:]) == (("lamp", 0), ("camera", 1 - level))
    assert rest[0] - gone[0] <= 40 * CYCLES_PER_US
    projector.close()


def test_patterns_are_shown_and_stamped_and_the_light_ends_with_its_host(make: Make) -> None:
    board = make()
    with pytest.raises(UnsupportedByDeviceError, match="cannot dim"):
        opened(board, brightness=0.5)
    projector = opened(board, watchdog_s=0.5)
    assert projector.info.model == "slrig-arduino 1.0.0"
    projector.load(SEQUENCE)
    shown = projector.show(5)
    assert [what for _, what, to in board.changes if to][-7:] == ["home", *["step"] * 5, "lamp"]
    lit_ns = board._began_ns + board.changes[-1][0] * 1000 // CYCLES_PER_US
    assert abs(shown.t_visible_ns - lit_ns) <= shown.t_err_ns
    # The engine does not get ready: dark, and said so.
    board.do("ready 0")
    with pytest.raises(DeviceError, match="not READY"):
        projector.show(6)
    board.do("ready 1")
    projector.blank()
    projector.show(1)
    projector.client.abandon()
    board.clock.advance(0.45)
    board.catch_up()
    assert board.changes[-1][1:] == ("lamp", 1)
    board.clock.advance(0.1)
    board.catch_up()
    assert board.changes[-1][1:] == ("lamp", 0)
    projector.close()
    sizes = subprocess.run(["avr-size", board.firmware], capture_output=True, text=True, check=True).stdout  # noqa: S603, S607
    _, data, bss, *_ = map(int, re.findall(r"^ *(\d+)\s+(\d+)\s+(\d+)", sizes, re.MULTILINE)[0])
    assert board.lowest_stack - (RAM_BEGIN + data + bss) > 64, "the stack must not come near the variables"


def test_its_clock_never_goes_back(make: Make) -> None:
    board = make(sources=(HERE / "clock.c", ARDUINO / "protocol.c"))
    # Sixty turns of the timer, most of which end before its interrupt may count them.
    board.clock.advance(2.0)
    board.catch_up()
    assert [(pin, level) for _, pin, level in board.changes if pin != "camera"] == [("step", 1)]


def test_bytes_that_come_without_a_pause_are_all_read(make: Make) -> None:
    board = make()
    hello, status = encode_line("1A2B 1 HELLO 1 2000 60000 1000 1000"), encode_line("1A2B 3 STATUS")
    pick = encode_line("1A2B 2 PICK 0 " + " ".join(["0000ABCD"] * 16))
    board.clock.advance(0.01)
    answers: list[bytes] = []
    for line in (b"XTR", b"\n", hello, pick, status):
        board.write(line)
        board.clock.advance(0.06)
        answers += LineSplitter().lines(board.read(0))
    assert [answer.split()[1:3] for answer in answers] == [[b"ERR", b"1"], [b"1", b"OK"], [b"2", b"OK"], [b"3", b"OK"]]


def test_the_header_lists_what_is_flashed(tmp_path: Path) -> None:
    export_patterns(SEQUENCE, tmp_path)
    header = (tmp_path / HEADER).read_text()
    assert header.startswith("#define WIDTH_PX 400\n#define HEIGHT_PX 300\n#define PATTERNS 0x")
    assert header.count("0x") == len(SEQUENCE)
