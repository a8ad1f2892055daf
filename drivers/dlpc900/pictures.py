"""Patterns as pictures of 24 bit planes, encoded for the controller.

Bit order: plane n is bit n of a pixel's 24 (bit position, DLPU018 table 2-137), and a pixel's bytes are sent with bits
16 to 23 first, then 8 to 15, then 0 to 7. No guide states this; it follows TI's own program (pattern.c, `PTN_Merge` and
`PTN_SwapColors`, then compress.c, `AddPixel`, in github.com/RhojAnn/DLPC900_CLI under lib) and a third-party program
for a LightCrafter 6500 (erle.py in github.com/csi-dcsc/Pycrafter6500).

Header, 48 bytes: DLPU018 table 2-106, and TI's splash.c (`SPL_Header_t`). Encoding: the enhanced run-length encoding of
DLPU018 section 2.4.3.2, and TI's compress.c (`RLE_CompressBMPSpl`, `RLE_DecompressBMPSpl`):

    n pixel      n times this pixel
    0 n pixels   these n pixels, n > 1
    0 1 n        n pixels as in the previous line
    0 1 0        the end; then zeros up to a multiple of 4 bytes

A number below 128 is one byte; others are two, 0x80 | n & 0x7F and n >> 7. Lines follow one another without a mark.

A picture holds patterns of one direction, columns or rows: so either all its lines are equal, or each is one run.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.pattern_engine.patterns import Plane, pattern_plane, plane_keys
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

PLANES = 24
MAX_ENTRIES = 400
"""Entries of the pattern table (DLPU018 revision J, table 2-139)."""
MAX_PICTURES = 18
"""Picture indices are 0 to 17 (DLPU018 table 2-139)."""
_HEADER = struct.Struct("<4sHHI8sIBBB21x")
_ENHANCED = 2


@dataclass(frozen=True, slots=True)
class MemoryPlane:
    """Location of a pattern in the engine's memory."""

    picture: int
    plane: int


@dataclass(frozen=True, slots=True)
class PatternMemory:
    """Pictures for the engine. places : location of each pattern, and at the end of a dark one; pictures : (H, W)
    uint32, bit n of a pixel is plane n.
    """

    places: tuple[MemoryPlane, ...]
    pictures: tuple[NDArray[np.uint32], ...]


def pack_sequence(sequence: PatternSequence) -> PatternMemory:
    """Return the pictures that hold a sequence, each pattern once, and a dark one. Raises UnsupportedByDeviceError if a
    pattern has shades of grey, or there are too many.
    """
    dark = np.zeros(sequence.projector.shape, np.bool_)
    planes = [*(pattern_plane(sequence, index) for index in range(len(sequence))), dark]
    found: dict[bytes, MemoryPlane] = {}
    groups: list[tuple[bool, list[Plane]]] = []
    places = []
    for plane in planes:
        key, _ = plane_keys(plane)
        if key not in found:
            by_rows = bool((plane[:, :1] == plane).all()) and not (plane == plane[0, 0]).all()
            at = next((at for at, (rows, group) in enumerate(groups) if rows == by_rows and len(group) < PLANES), None)
            if at is None:
                at = len(groups)
                groups.append((by_rows, []))
            found[key] = MemoryPlane(at, len(groups[at][1]))
            groups[at][1].append(plane)
        places.append(found[key])
    if len(places) > MAX_ENTRIES or len(groups) > MAX_PICTURES:
        message = (
            f"the sequence has {len(sequence)} patterns in {len(groups)} pictures, the engine takes "
            f"{MAX_ENTRIES - 1} in {MAX_PICTURES}; scan one axis only, or with a shorter line_shift_period_px"
        )
        raise UnsupportedByDeviceError(message)
    return PatternMemory(tuple(places), tuple(_merge_planes(group, sequence.projector) for _, group in groups))


def _merge_planes(planes: Sequence[Plane], size: Size) -> NDArray[np.uint32]:
    pixels = np.zeros(size.shape, np.uint32)
    for number, plane in enumerate(planes):
        pixels |= plane.astype(np.uint32) << np.uint32(number)
    return pixels


def encode_picture(picture: NDArray[np.uint32]) -> bytes:
    """Encode a picture, or one half of it, with its header, for sending."""
    rows, columns = picture.shape
    lines = []
    before: NDArray[np.uint32] | None = None
    for line in picture:
        same = before is not None and np.array_equal(line, before)
        lines.append(b"\0\1" + _encode_count(columns) if same else _encode_line(line))
        before = line
    data = b"".join(lines) + b"\0\1\0"
    data += bytes(-len(data) % 4)
    return _HEADER.pack(b"Spld", columns, rows, len(data), b"\xff" * 8, 0, 0, _ENHANCED, 1) + data


def _encode_line(line: NDArray[np.uint32]) -> bytes:
    """Encode runs of two pixels and more, and single pixels between them uncompressed."""
    starts = np.flatnonzero(np.diff(line, prepend=~line[:1]))
    lengths = np.diff(starts, append=line.size)
    out = bytearray()
    single: list[int] = []
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        if length == 1:
            single.append(start)
            continue
        out += _encode_raw(line[single]) + _encode_count(length) + _encode_pixel(line[start])
        single = []
    return bytes(out + _encode_raw(line[single]))


def _encode_raw(pixels: NDArray[np.uint32]) -> bytes:
    if pixels.size == 0:
        return b""
    # A single pixel is a run of one: "0 1" has another meaning.
    head = b"\1" if pixels.size == 1 else b"\0" + _encode_count(pixels.size)
    return head + b"".join(_encode_pixel(pixel) for pixel in pixels)


def _encode_pixel(pixel: np.uint32) -> bytes:
    return int(pixel).to_bytes(3, "big")


def _encode_count(count: int) -> bytes:
    return bytes([count]) if count < 128 else bytes([0x80 | count & 0x7F, count >> 7])
