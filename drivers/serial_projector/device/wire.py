"""SLTP/1 on the wire: lines with their checksums, and the numbers of errors, faults and modes.

Runs unchanged in MicroPython and in CPython.
"""

# MicroPython has no `__future__`.

VERSION = 1
MAX_LINE_BYTES = 240
NUMBERS = 10000

# Errors, as in `<session> <number> ERR <code> <words>`.
FRAMING, VERB, STATE, RANGE, BUSY, HARDWARE, FAULT, SESSION, PATTERNS, LIMIT = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10

# Faults, as in `! FAULT <code>`: reasons why the box went dark by itself.
WATCHDOG, ON_TIME, DUTY, LIGHT = 1, 2, 3, 4

# Modes of SEQ.
FREE, STEP = 0, 1


def _table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021) if value & 0x8000 else value << 1
        table.append(value & 0xFFFF)
    return table


_CRC16 = _table()


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, neither reflected nor inverted."""
    value = 0xFFFF
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _CRC16[value >> 8 ^ byte]
    return value


def encode_line(text: str) -> bytes:
    """Encode a line for the wire."""
    body = text.encode("ascii")
    return body + b"*" + f"{crc16(body):04X}".encode("ascii") + b"\n"


def decode_line(line: bytes) -> "str | None":
    """Return the text of a received line (without its end); None if it is damaged."""
    line = line.rstrip(b"\r")
    body, star, crc = line[:-5], line[-5:-4], line[-4:]
    if star != b"*" or len(line) > MAX_LINE_BYTES or f"{crc16(body):04X}".encode("ascii") != crc:
        return None
    for byte in body:
        if not 32 <= byte < 127:
            return None
    return body.decode("ascii")
