"""SLTP/1 lines as the host writes and reads them."""

from __future__ import annotations

import binascii
from dataclasses import dataclass, field
from enum import IntEnum

NUMBERS = 10_000
MAX_LINE_BYTES = 240


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
