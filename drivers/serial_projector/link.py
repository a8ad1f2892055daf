"""One command, one answer, over a line that loses and damages bytes: sent again until it is answered, obeyed once.

A command that is sent again keeps its number, and the box answers a number that it has obeyed already with what it
answered then. So an answer that is lost costs time, and never shows a pattern twice.
"""

from __future__ import annotations

import binascii
import importlib
import os
import secrets
import threading
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any

from drivers.serial_port import SLICE_S, BytePort
from slrig.devices import Clock, FoundDevice, SystemClock
from slrig.errors import DeviceError, DeviceStateError, LibraryMissingError

NUMBERS = 10_000
MAX_LINE_BYTES = 240


BY_ID = Path("/dev/serial/by-id")
MICROPYTHON_RP2 = (0x2E8A, 0x0005)
"""USB ids of an RP2040 that runs MicroPython."""
MAX_TRIES = 12
_NS_PER_S = 1_000_000_000
_EVENTS = 4096


class RefusalCode(IntEnum):
    """Why a box does not obey, the code of an ERR line."""

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
    """Why a box went dark by itself, the code of a FAULT event."""

    WATCHDOG = 1
    ON_TIME = 2
    DUTY = 3
    LIGHT = 4


class SequenceMode(IntEnum):
    """What starts each pattern of a sequence: the box's own clock, or a TRIG from the host."""

    FREE = 0
    STEP = 1


@dataclass(frozen=True, slots=True)
class BoxAnswer:
    """A line that answers a command of ours. code : None for OK, else what `RefusalCode` lists (or a number beyond it)."""

    session: str
    number: int
    code: int | None
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BoxEvent:
    """A line that answers nothing: `! FRAME 3 123456`."""

    name: str
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class UnreadableLine:
    """The box says that it could not read a line."""


BoxLine = BoxAnswer | BoxEvent | UnreadableLine


def encode_line(text: str) -> bytes:
    """Return a line as it goes over the wire.

    >>> framed("1A2B 7 SHOW 3").rstrip()
    b'1A2B 7 SHOW 3*FFE7'
    """
    body = text.encode("ascii")
    return b"%s*%04X\n" % (body, binascii.crc_hqx(body, 0xFFFF))


def parse_line(line: bytes) -> BoxLine | None:
    """Return what a line that came in says; None where it is damaged, or no SLTP at all."""
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
    """Cuts what comes in, in pieces of any size, into lines."""

    _rest: bytes = field(default=b"")

    def lines(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete now, without their ends; empty ones are left out."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        # A line that is too long is damaged in any case.
        self._rest = self._rest[-2 * MAX_LINE_BYTES :]
        return [line for line in whole if line.strip(b"\r")]


def find_ports(by_id: Path = BY_ID) -> tuple[FoundDevice, ...]:
    """Return the USB serial ports, each by a name that stays the same where it has one. Raises LibraryMissingError."""
    try:
        list_ports = importlib.import_module("serial.tools.list_ports")
    except ImportError as missing:
        install = "pip install pyserial"
        message = f"driver 'serial_projector' needs pyserial, which is not installed ({missing}); {install}"
        raise LibraryMissingError(message, install=install) from missing
    lasting = _links_by_target(by_id)
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    return tuple(
        FoundDevice("serial_projector", lasting.get(os.path.realpath(port.device), port.device), _label(port))
        for port in ports
        if port.vid is not None
    )


def _label(port: Any) -> str:
    """What the system says of a port, and that nobody asked it."""
    name = " ".join(filter(None, (port.manufacturer, port.product))) or "USB serial port"
    serial = f", serial number {port.serial_number}" if port.serial_number else ""
    likely = "MicroPython on an RP2040: " if (port.vid, port.pid) == MICROPYTHON_RP2 else ""
    return f"{likely}{name} ({port.device}, {port.vid:04X}:{port.pid or 0:04X}{serial}), not asked whether it is a box"


def _links_by_target(folder: Path) -> dict[str, str]:
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir(), reverse=True)}
    except OSError:
        return {}


class BoxRefusedError(DeviceError):
    """The box answered, and does not obey. `number` is one of `RefusalCode` (or a number that newer firmware knows)."""

    def __init__(self, verb: str, number: int, words: tuple[str, ...]) -> None:
        self.verb, self.number, self.words = verb, number, words
        name = RefusalCode(number).name.lower() if number in set(RefusalCode) else "unknown"
        super().__init__(f"the trigger box refused {verb}: error {number} ({name}) {' '.join(words)}".rstrip())


class NoAnswerError(DeviceError):
    """No answer came, however often the command was sent: the box may have obeyed, or never heard of it."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What the box answered. It obeyed at some instant between `sent_ns` and `received_ns` (the link's clock)."""

    words: tuple[str, ...]
    sent_ns: int
    received_ns: int


@dataclass(slots=True)
class LinkCounters:
    """What the line did: commands, sent again, damaged lines that came in, answers to somebody else."""

    commands: int = 0
    again: int = 0
    damaged: int = 0
    others: int = 0


@dataclass(slots=True)
class BoxLink:
    """Commands to one box. One thread at a time uses it; `closing` ends a wait from another one.

    reply_s : how long an answer may take, beyond what the command itself takes. deadline_s : after which a command is
    not sent again. clock : of both, and of the answers' instants.
    """

    port: BytePort
    reply_s: float
    deadline_s: float
    # So many that two hosts hardly share one; never the number of a session before.
    session: str = field(default_factory=lambda: secrets.token_hex(2).upper())
    closing: threading.Event = field(default_factory=threading.Event)
    events: deque[BoxEvent] = field(default_factory=lambda: deque(maxlen=_EVENTS))
    tally: LinkCounters = field(default_factory=LinkCounters)
    clock: Clock = field(default_factory=SystemClock)
    _number: int = 0
    _splitter: LineSplitter = field(default_factory=LineSplitter)
    _waiting: deque[bytes] = field(default_factory=deque)

    def replace_port(self, port: BytePort) -> None:
        """Go on over another port. What was under way on the old one is lost."""
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

        Parameters
        ----------
        takes_s
            How long the box may be busy with it.
        while_closing
            Ask although `closing` is set.

        Raises
        ------
        RefusedError
            The box does not obey.
        SilentError
            No answer.
        DeviceGoneError
            The port is gone.
        DeviceStateError
            `closing` was set meanwhile.
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
            f"asked the trigger box for {verb} {sent} times in {took_s:.2f} s, found no answer "
            f"({self.tally.damaged} damaged lines so far); check its cable, its power and the baud rate"
        )
        raise NoAnswerError(message)

    def after(self, seconds: float) -> int:
        """The time in so many seconds, ns."""
        return self.clock.now_ns() + round(seconds * _NS_PER_S)

    def _answer(self, until_ns: int, while_closing: bool) -> BoxAnswer | None:
        """The answer to the command that was sent last; None when it is time to send it again."""
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
                        # That may have been it: a little longer, for what else is under way.
                        until_ns = min(until_ns, self.after(SLICE_S))
            if self.closing.is_set() and not while_closing:
                message = "the projector was closed while it waited for the trigger box; open the rig again"
                raise DeviceStateError(message)
            left_s = (until_ns - self.clock.now_ns()) / _NS_PER_S
            if left_s <= 0:
                return None
            self._waiting.extend(self._splitter.lines(self.port.read(min(left_s, SLICE_S))))
