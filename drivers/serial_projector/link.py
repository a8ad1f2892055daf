"""The serial link to a trigger box: its ports, SLTP/1 lines, and commands that are repeated until answered.

A repeated command keeps its number, and the box answers a number that it has already executed with its earlier answer.
A lost answer therefore costs time, and never shows a pattern twice.

Finding uses information of the system alone: opening a port restarts many boards, and disturbs other devices.
"""

from __future__ import annotations

import binascii
import os
import secrets
import threading
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any

from drivers.serial_port import SLICE_S, BytePort, serial_module
from slrig.devices import Clock, FoundDevice, SystemClock
from slrig.errors import DeviceError, DeviceStateError

NUMBERS = 10_000
MAX_LINE_BYTES = 240


BY_ID = Path("/dev/serial/by-id")
MICROPYTHON_RP2 = (0x2E8A, 0x0005)
"""USB ids of an RP2040 that runs MicroPython."""
MAX_TRIES = 12
_NS_PER_S = 1_000_000_000
_EVENTS = 4096


class RefusalCode(IntEnum):
    """Reason of a refusal, the code of an ERR line."""

    FRAMING = 1
    VERB = 2
    STATE = 3
    RANGE = 4
    BUSY = 5
    HARDWARE = 6
    FAULT = 7
    SESSION = 8
    PATTERNS = 9
    LIMIT = 10


class BoxFault(IntEnum):
    """Reason why a box went dark on its own, the code of a FAULT event."""

    WATCHDOG = 1
    ON_TIME = 2
    DUTY = 3
    LIGHT = 4


class SequenceMode(IntEnum):
    """Start of each pattern of a sequence: by the box's own clock, or by a TRIG from the host."""

    FREE = 0
    STEP = 1


@dataclass(frozen=True, slots=True)
class BoxAnswer:
    """Answer to a command. code : None for OK, else of `RefusalCode` (or an unknown number)."""

    session: str
    number: int
    code: int | None
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BoxEvent:
    """Line that answers no command: `! FRAME 3 123456`."""

    name: str
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class UnreadableLine:
    """The box reports that it could not read a line."""


BoxLine = BoxAnswer | BoxEvent | UnreadableLine


def encode_line(text: str) -> bytes:
    """Encode a line for the wire.

    >>> encode_line("1A2B 7 SHOW 3").rstrip()
    b'1A2B 7 SHOW 3*FFE7'
    """
    body = text.encode("ascii")
    return b"%s*%04X\n" % (body, binascii.crc_hqx(body, 0xFFFF))


def parse_line(line: bytes) -> BoxLine | None:
    """Parse a received line; None if it is damaged or not SLTP."""
    body, star, crc = line.rstrip(b"\r\n").rpartition(b"*")
    if not star or len(line) > MAX_LINE_BYTES + 2 or b"%04X" % binascii.crc_hqx(body, 0xFFFF) != crc:
        return None
    try:
        words = body.decode("ascii").split(" ")
    except UnicodeDecodeError:
        return None
    match words:
        case ["!", name, *rest]:
            return BoxEvent(name, tuple(rest))
        case ["?", *_]:
            return UnreadableLine()
        case [session, number, "OK", *rest] if number.isdigit():
            return BoxAnswer(session, int(number), None, tuple(rest))
        case [session, number, "ERR", code, *rest] if number.isdigit() and code.isdigit():
            return BoxAnswer(session, int(number), int(code), tuple(rest))
        case _:
            return None


@dataclass(slots=True)
class LineSplitter:
    """Splits received data, in pieces of any size, into lines."""

    _rest: bytes = field(default=b"")

    def lines(self, data: bytes) -> list[bytes]:
        """Return the completed lines without their ends; empty ones are omitted."""
        *complete, self._rest = (self._rest + data).split(b"\n")
        # A longer line is invalid in any case.
        self._rest = self._rest[-2 * MAX_LINE_BYTES :]
        return [line for line in complete if line.strip(b"\r")]


def find_ports(by_id: Path = BY_ID) -> tuple[FoundDevice, ...]:
    """Return the USB serial ports, each by a persistent name if available. Raises LibraryMissingError."""
    list_ports = serial_module("serial_projector", "serial.tools.list_ports")
    persistent = _links_by_target(by_id)
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    return tuple(
        FoundDevice("serial_projector", persistent.get(os.path.realpath(port.device), port.device), _label(port))
        for port in ports
        if port.vid is not None
    )


def _label(port: Any) -> str:
    """Label of a port from the system's information."""
    name = " ".join(filter(None, (port.manufacturer, port.product))) or "USB serial port"
    serial = f", serial number {port.serial_number}" if port.serial_number else ""
    prefix = "MicroPython on an RP2040: " if (port.vid, port.pid) == MICROPYTHON_RP2 else ""
    return f"{prefix}{name} ({port.device}, {port.vid:04X}:{port.pid or 0:04X}{serial}), may be a trigger box"


def _links_by_target(folder: Path) -> dict[str, str]:
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir(), reverse=True)}
    except OSError:
        return {}


class BoxRefusedError(DeviceError):
    """The box refused a command. `number` is of `RefusalCode` (or an unknown number of newer firmware)."""

    def __init__(self, verb: str, number: int, words: tuple[str, ...]) -> None:
        self.verb, self.number, self.words = verb, number, words
        name = RefusalCode(number).name.lower() if number in set(RefusalCode) else "unknown"
        super().__init__(f"the trigger box refused {verb}: error {number} ({name}) {' '.join(words)}".rstrip())


class NoAnswerError(DeviceError):
    """No answer arrived after all repetitions: the box may or may not have executed the command."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer of the box. It executed the command between `sent_ns` and `received_ns` (the link's clock)."""

    words: tuple[str, ...]
    sent_ns: int
    received_ns: int


@dataclass(slots=True)
class LinkCounters:
    """Counters of the link: commands, repetitions, damaged lines, answers to another host."""

    commands: int = 0
    again: int = 0
    damaged: int = 0
    others: int = 0


@dataclass(slots=True)
class BoxLink:
    """Commands to one box. Used by one thread at a time; setting `closing` ends a wait from another thread.

    reply_s : longest time for an answer, beyond the command's own duration. deadline_s : after it, a command is not
    repeated. clock : of both, and of the answers' instants.
    """

    port: BytePort
    reply_s: float
    deadline_s: float
    # Random, so that it differs from other hosts' and earlier sessions.
    session: str = field(default_factory=lambda: secrets.token_hex(2).upper())
    closing: threading.Event = field(default_factory=threading.Event)
    events: deque[BoxEvent] = field(default_factory=lambda: deque(maxlen=_EVENTS))
    tally: LinkCounters = field(default_factory=LinkCounters)
    clock: Clock = field(default_factory=SystemClock)
    _number: int = 0
    _splitter: LineSplitter = field(default_factory=LineSplitter)
    _waiting: deque[bytes] = field(default_factory=deque)

    def replace_port(self, port: BytePort) -> None:
        """Continue on another port. Pending data of the old one is dropped."""
        self.port, self._splitter = port, LineSplitter()
        self._waiting.clear()

    def ask(
        self,
        verb: str,
        *numbers: int | str,
        takes_s: float = 0.0,
        tries: int = MAX_TRIES,
        deadline_s: float | None = None,
        while_closing: bool = False,
    ) -> Reply:
        """Send a command until it is answered; return the answer.

        takes_s : duration of the command itself. while_closing : send it even if `closing` is set. Raises
        BoxRefusedError (the box refuses), NoAnswerError, DeviceGoneError (the port is gone) and DeviceStateError
        (`closing` was set meanwhile).
        """
        self._number = (self._number + 1) % NUMBERS
        line = encode_line(" ".join(map(str, (self.session, self._number, verb, *numbers))))
        until_ns = self.after(self.deadline_s if deadline_s is None else deadline_s)
        self.tally.commands += 1
        first_ns = self.clock.now_ns()
        sent = 0
        while sent < tries and (sent == 0 or self.clock.now_ns() < until_ns):
            self.port.write(line)
            self.tally.again += sent > 0
            sent += 1
            answer = self._answer(self.after(self.reply_s + takes_s), while_closing)
            if answer is not None:
                if answer.code is not None:
                    raise BoxRefusedError(verb, answer.code, answer.words)
                return Reply(answer.words, first_ns, self.clock.now_ns())
        took_s = (self.clock.now_ns() - first_ns) / _NS_PER_S
        message = (
            f"the trigger box did not answer {verb}, sent {sent} times in {took_s:.2f} s "
            f"({self.tally.damaged} damaged lines so far); check its cable, its power and the baud rate"
        )
        raise NoAnswerError(message)

    def after(self, seconds: float) -> int:
        """Return the time `seconds` from now, ns."""
        return self.clock.now_ns() + round(seconds * _NS_PER_S)

    def _answer(self, until_ns: int, while_closing: bool) -> BoxAnswer | None:
        """Return the answer to the last command; None when it should be repeated."""
        while True:
            while self._waiting:
                raw = self._waiting.popleft()
                match parse_line(raw):
                    case BoxAnswer() as answer if answer.session != self.session:
                        self.tally.others += 1
                    case BoxAnswer() as answer if answer.number == self._number:
                        return answer
                    case BoxEvent() as event:
                        self.events.append(event)
                    case UnreadableLine():
                        return None
                    case None:
                        self.tally.damaged += 1
                        # It may have been the answer: wait only briefly for other lines.
                        until_ns = min(until_ns, self.after(SLICE_S))
            if self.closing.is_set() and not while_closing:
                message = "the projector was closed while it waited for the trigger box; open the rig again"
                raise DeviceStateError(message)
            left_s = (until_ns - self.clock.now_ns()) / _NS_PER_S
            if left_s <= 0:
                return None
            self._waiting.extend(self._splitter.lines(self.port.read(min(left_s, SLICE_S))))
