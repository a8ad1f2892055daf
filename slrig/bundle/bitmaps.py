"""BMP frames, as the programs of cameras save them: uncompressed, 8 bits with a palette or 24 bits of colour."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from slrig.model import Pixels

SIGNATURE = b"BM"
_FILE_HEADER, _INFO_HEADER = 14, 40
_BITS = {8: 1, 24: 3}
"""Bytes of a sample, by bits."""


@dataclass(frozen=True, slots=True)
class Bitmap:
    """A BMP's header. first_byte : of the rows, each of `stride` bytes; upside_down : the last row comes first, as is
    usual. palette_entries : of 4 bytes each, behind the header.
    """

    width: int
    height: int
    bits: int
    first_byte: int
    stride: int
    upside_down: bool
    header_bytes: int
    palette_entries: int

    @classmethod
    def of(cls, data: bytes) -> Bitmap:
        """Read the header. Raises ValueError with words for what it is instead of a BMP that can be read."""
        if len(data) < _FILE_HEADER + _INFO_HEADER:
            message = f"{len(data)} bytes without a header"
            raise ValueError(message)
        (first_byte,) = struct.unpack_from("<I", data, 10)
        size, width, height, _, bits, compression, _, _, _, colours = struct.unpack_from("<IiiHHIIiiI", data, 14)
        if size < _INFO_HEADER or width < 1 or height == 0:
            message = f"a header of {size} bytes for {width} x {height} pixels"
            raise ValueError(message)
        if bits not in _BITS or compression:
            message = f"{bits} bits, {'compressed' if compression else 'uncompressed'}"
            raise ValueError(message)
        entries = (colours or 256) if bits == 8 else 0
        found = cls(
            width, abs(height), bits, first_byte, -(-bits * width // 32) * 4, height > 0, _FILE_HEADER + size, entries
        )
        if found.header_bytes + 4 * entries > first_byte or entries > 256:
            message = "a palette that overlaps its pixels"
            raise ValueError(message)
        if first_byte + found.stride * found.height > len(data):
            message = f"one cut after {len(data)} bytes"
            raise ValueError(message)
        return found

    def decoded(self, data: bytes) -> Pixels:
        """(H, W) or, in colour, (H, W, 3) uint8, blue, green, red. Raises ValueError for a sample without a colour."""
        rows = np.frombuffer(data, np.uint8, self.stride * self.height, self.first_byte).reshape(self.height, -1)
        rows = rows[:: -1 if self.upside_down else 1, : self.width * _BITS[self.bits]]
        if self.bits == 24:
            return np.ascontiguousarray(rows).reshape(self.height, self.width, 3)
        if int(rows.max()) >= self.palette_entries:
            message = f"a sample of {int(rows.max())} and a palette of {self.palette_entries}"
            raise ValueError(message)
        colours = np.frombuffer(data, np.uint8, 4 * self.palette_entries, self.header_bytes).reshape(-1, 4)[:, :3]
        grey = (colours == colours[:, :1]).all()
        return np.ascontiguousarray(colours[rows, 0] if grey else colours[rows])
