"""EDID: how a display identifies itself over its cable (VESA E-EDID, release A, base block)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_HEADER = bytes.fromhex("00ffffffffffff00")
_DESCRIPTORS = (54, 72, 90, 108)
_NAME, _SERIAL = 0xFC, 0xFF


@dataclass(frozen=True, slots=True)
class Edid:
    """A display's maker (three letters), model name and serial number; name and serial may be empty."""

    maker: str
    name: str
    serial: str

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.name) if part)


def parse_edid(block: bytes) -> Edid | None:
    """Parse an EDID; return None if it is damaged or of another kind.

    >>> parse_edid(b"") is None
    True
    """
    base = block[:128]
    if len(base) < 128 or base[:8] != _HEADER or sum(base) % 256:
        return None
    (packed,) = struct.unpack_from(">H", base, 8)
    maker = "".join(chr(64 + (packed >> shift & 31)) for shift in (10, 5, 0))
    texts = {
        base[at + 3]: base[at + 5 : at + 18].split(b"\n")[0].decode("latin-1").strip()
        for at in _DESCRIPTORS
        if base[at : at + 3] == b"\x00\x00\x00"
    }
    (number,) = struct.unpack_from("<I", base, 12)
    return Edid(maker, texts.get(_NAME, ""), texts.get(_SERIAL, "") or (str(number) if number else ""))
