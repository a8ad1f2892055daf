"""Headers of BMP, JPEG and TIFF frames, as the programs of cameras, webcams and phones save them.

BMP frames are uncompressed, of 8 bits with a palette or 24 bits of colour. JPEG frames are those of ITU-T T.81. What
their compression errs by is no matter of headers: reconstruction reads it from the pixels, whatever file they are in.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from slrig.model import Pixels

BMP_SIGNATURE = b"BM"
_FILE_HEADER, _INFO_HEADER = 14, 40
_BITS = {8: 1, 24: 3}
"""Bytes of a sample, by bits."""

JPEG_SIGNATURE = b"\xff\xd8\xff"
_END = b"\xff\xd9"
_FRAMES = {0xC0, 0xC1, 0xC2}
"""Baseline, extended sequential and progressive, all with Huffman codes: what everybody writes."""
_OTHER_FRAMES = {0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)}
_TABLES, _SCAN = 0xDB, 0xDA
_REMARKS = {*range(0xE1, 0xEE), 0xEF, 0xFE}
"""Applications' own segments but JFIF's and Adobe's, which say how colours are coded, and comments."""
_NEXT_SCAN, _MOST_SCANS = b"\xff\xda", 64
"""Each scan of a progressive file costs a pass over all pixels; usual are ten."""

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
MOST_TIFF_PAGES = 65536
"""As many as a page's number in bundle.json can name."""
MOST_TIFF_TAGS = 256


def tiff_page_count(data: bytes) -> int:
    """How many pages the chain of a TIFF's directories has, walked before anybody reads one.
    Raises ValueError with words for a chain that leads out of the file, comes back to itself or does not end.
    """
    order = "<" if data.startswith(b"II") else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    count_of, tag_bytes, next_of, first = ("Q", 20, "Q", 8) if big else ("H", 12, "I", 4)
    seen: set[int] = set()
    try:
        (place,) = struct.unpack_from(order + next_of, data, first)
        while place:
            if place in seen or len(seen) == MOST_TIFF_PAGES:
                raise ValueError(f"a chain of pages that does not end after {len(seen)}")
            seen.add(place)
            (tags,) = struct.unpack_from(order + count_of, data, place)
            if tags > MOST_TIFF_TAGS:
                raise ValueError(f"{tags} tags on page {len(seen) - 1}")
            (place,) = struct.unpack_from(
                order + next_of, data, place + struct.calcsize(order + count_of) + tags * tag_bytes
            )
    except (struct.error, OverflowError) as cause:
        raise ValueError(f"a chain of pages cut after {len(seen)}") from cause
    return len(seen)


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
            raise ValueError(f"{len(data)} bytes without a header")
        (first_byte,) = struct.unpack_from("<I", data, 10)
        size, width, height, _, bits, compression, _, _, _, colours = struct.unpack_from("<IiiHHIIiiI", data, 14)
        if size < _INFO_HEADER or width < 1 or height == 0:
            raise ValueError(f"a header of {size} bytes for {width} x {height} pixels")
        if bits not in _BITS or compression:
            raise ValueError(f"{bits} bits, {'compressed' if compression else 'uncompressed'}")
        entries = (colours or 256) if bits == 8 else 0
        found = cls(
            width, abs(height), bits, first_byte, -(-bits * width // 32) * 4, height > 0, _FILE_HEADER + size, entries
        )
        if found.header_bytes + 4 * entries > first_byte or entries > 256:
            raise ValueError("a palette that overlaps its pixels")
        if first_byte + found.stride * found.height > len(data):
            raise ValueError(f"one cut after {len(data)} bytes")
        return found

    def decoded(self, data: bytes) -> Pixels:
        """(H, W) or, in colour, (H, W, 3) uint8, blue, green, red. Raises ValueError for a sample without a colour."""
        rows = np.frombuffer(data, np.uint8, self.stride * self.height, self.first_byte).reshape(self.height, -1)
        rows = rows[:: -1 if self.upside_down else 1, : self.width * _BITS[self.bits]]
        if self.bits == 24:
            return np.ascontiguousarray(rows).reshape(self.height, self.width, 3)
        if int(rows.max()) >= self.palette_entries:
            raise ValueError(f"a sample of {int(rows.max())} and a palette of {self.palette_entries}")
        colours = np.frombuffer(data, np.uint8, 4 * self.palette_entries, self.header_bytes).reshape(-1, 4)[:, :3]
        grey = (colours == colours[:, :1]).all()
        return np.ascontiguousarray(colours[rows, 0] if grey else colours[rows])


@dataclass(frozen=True, slots=True)
class Jpeg:
    """A JPEG's header. components : 1 or 3; remarks : first byte and end of each segment that has no part in the
    picture, as Exif.
    """

    width: int
    height: int
    components: int
    remarks: tuple[tuple[int, int], ...]

    def plain(self, data: bytes) -> bytes:
        """The file without its remarks, for a decoder that would read them."""
        ends = (0, *(end for _, end in self.remarks))
        return b"".join(data[a:b] for a, b in zip(ends, (*(a for a, _ in self.remarks), len(data)), strict=True))

    @classmethod
    def of(cls, data: bytes) -> Jpeg:
        """Read the header. Raises ValueError with words for what it is instead of a JPEG that can be read."""
        tables: set[int] = set()
        frame: tuple[int, int, int, int] | None = None
        remarks = []
        place = 2
        while True:
            marker, length = struct.unpack(">HH", data[place : place + 4].ljust(4, b"\0"))
            kind, segment = marker & 0xFF, data[place + 4 : place + 2 + length]
            if marker >> 8 != 0xFF or length < 2 or len(segment) != length - 2:
                raise ValueError(f"a header that breaks off at byte {place}")
            if kind in _OTHER_FRAMES:
                raise ValueError("a lossless, hierarchical or arithmetic one")
            if kind in _FRAMES:
                frame = _frame(segment)
            elif kind == _TABLES:
                tables |= _table_numbers(segment)
            elif kind in _REMARKS:
                remarks.append((place, place + 2 + length))
            place += 2 + length
            if kind == _SCAN:
                break
        if frame is None or frame[3] not in tables:
            raise ValueError("a header without an image or its quantisers")
        if not data.rstrip(b"\0").endswith(_END):
            raise ValueError(f"one cut after {len(data)} bytes")
        if data.count(_NEXT_SCAN, place) >= _MOST_SCANS:
            raise ValueError(f"one of more than {_MOST_SCANS} scans")
        height, width, components, _ = frame
        return cls(width, height, components, tuple(remarks))


def _frame(segment: bytes) -> tuple[int, int, int, int]:
    """Height, width, components, and the quantisers of the first one, which is the grey."""
    if len(segment) < 9:
        raise ValueError("a header without an image")
    bits, height, width, components = struct.unpack_from(">BHHB", segment)
    if bits != 8 or components not in (1, 3) or not height or not width:
        raise ValueError(f"{width} x {height} samples of {bits} bits, {components} for each pixel")
    return height, width, components, segment[8]


def _table_numbers(segment: bytes) -> set[int]:
    """The numbers of the tables of quantisers that a segment holds."""
    found, place = set(), 0
    while place < len(segment):
        size = 129 if segment[place] >> 4 else 65
        if place + size > len(segment):
            raise ValueError("a header with a part of a table")
        found.add(segment[place] & 15)
        place += size
    return found
