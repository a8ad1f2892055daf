"""The block of patterns in the engine's flash: encoding and decoding.

The engine stores a pattern as one line of bits, which all rows (columns) of its mirrors repeat. Format: TI's own source
(dlpc347x_internal_patterns.c, `DLPC347X_INT_PAT_GeneratePatternDataBlock`, in github.com/isabella232/LightField under
dlp-4710/dlpc347x); its output, compiled for this test, is identical for both supported mirror arrays. A later edition,
in github.com/Practice3DVision/SLMaster, has the same sizes, headers and lines. Numbers are little endian:

    "PATN"  start and size of the sets (4, 4), start and size of the order (4, 4)
    order   entries (4); of each: set, patterns, LEDs, 0, which are inverted (8), light, dark before
            and after (4 each)
    sets    how many (4), the start of each (4); of each: patterns, 1 if these are columns, bits of depth, 0,
            bytes of data (4), data

A line begins with mirrors outside the picture, low bits first, and is padded to whole words of 4 bytes. For the DLP4710
and its two controllers the editions differ in the order and direction of the halves: it is not supported.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.pattern_engine.projector import describe_pattern, pattern_plane
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

MAX_PATTERNS = 64
"""Patterns in a set of 1 bit: an entry of the order has this number of inversion bits."""
_BLOCK = struct.Struct("<4sIIII")
_ENTRY = struct.Struct("<BBBxQIII")
_SET = struct.Struct("<BBBxI")
HEAD_BYTES = _BLOCK.size
_DARK_US = (1000, 1000, 1000)

PatternLine = tuple[int, bytes]
"""1 for a pattern of columns, 0 of rows, and its bits."""


@dataclass(frozen=True, slots=True)
class Dlpc347xMirrors:
    """A mirror array. before, after : number of mirrors outside the picture, of (rows, columns)."""

    name: str
    size: Size
    before: tuple[int, int]
    after: tuple[int, int]


@dataclass(frozen=True, slots=True)
class FlashedLine:
    """Location of a pattern: the number of its set, and its index within it."""

    set: int
    index: int


@dataclass(frozen=True, slots=True)
class LineEncoder:
    """Encodes patterns as lines for a mirror array. mirrored : reversal of (rows, columns)."""

    mirrors: Dlpc347xMirrors
    mirrored: tuple[bool, bool]

    def encode(self, sequence: PatternSequence, index: int) -> tuple[PatternLine, ...]:
        """Return a pattern as a line of columns or rows, or as both if it is uniform. Raises UnsupportedByDeviceError
        if it has shades of grey.
        """
        plane = pattern_plane(sequence, index)
        rows, columns = sequence.profiles[index].shape
        lines = [(1, plane[0])] * (rows == 1) + [(0, plane[:, 0])] * (columns == 1)
        return tuple((way, self._pack(line[::-1] if self.mirrored[way] else line, way)) for way, line in lines)

    def _pack(self, line: NDArray[np.bool_], columns: int) -> bytes:
        bits = np.pad(line, (self.mirrors.before[columns], self.mirrors.after[columns]))
        packed = np.packbits(bits, bitorder="little").tobytes()
        return packed + bytes(-len(packed) % 4)


def build_block(sequence: PatternSequence, lines: LineEncoder) -> bytes:
    """Return the block that holds a sequence: columns, then rows, in sets with white and black; and a dark order."""
    found = [lines.encode(sequence, index) for index in range(len(sequence))]
    sets: list[bytes] = []
    for way in (1, 0):
        both, own = (
            list(dict.fromkeys(bits for line in found if len(line) == ways for each, bits in line if each == way))
            for ways in (2, 1)
        )
        room = MAX_PATTERNS - len(both)
        for start in range(0, len(own) or way, room):
            members = both + own[start : start + room]
            if members:
                sets.append(_SET.pack(len(members), way, 1, sum(map(len, members))) + b"".join(members))
    order = struct.pack("<I", 1) + _ENTRY.pack(0, 1, 0, 0, *_DARK_US)
    begin = HEAD_BYTES + len(order)
    starts = [begin + 4 + 4 * len(sets) + sum(map(len, sets[:number])) for number in range(len(sets))]
    content = struct.pack(f"<I{len(sets)}I", len(sets), *starts) + b"".join(sets)
    return _BLOCK.pack(b"PATN", begin, len(content), HEAD_BYTES, len(order)) + order + content


def block_size(head: bytes) -> int:
    """Return the size of a block from its first 20 bytes; 0 if there is none."""
    name, sets, size, _, _ = _BLOCK.unpack(head)
    return sets + size if name == b"PATN" else 0


def find_lines(block: bytes) -> dict[PatternLine, tuple[FlashedLine, ...]]:
    """Return the locations of each 1-bit line in a block. Raises ValueError or struct.error if it is not a block."""
    found: dict[PatternLine, tuple[FlashedLine, ...]] = {}
    _, begin, _, _, _ = _BLOCK.unpack_from(block)
    (count,) = struct.unpack_from("<I", block, begin)
    for number, start in enumerate(struct.unpack_from(f"<{count}I", block, begin + 4)):
        patterns, columns, depth, size = _SET.unpack_from(block, start)
        if depth != 1 or not patterns:
            continue
        length = size // patterns
        for index in range(patterns):
            at = start + _SET.size + index * length
            key = columns, block[at : at + length]
            found[key] = (*found.get(key, ()), FlashedLine(number, index))
    return found


def locate_patterns(
    sequence: PatternSequence, lines: LineEncoder, available: Mapping[PatternLine, tuple[FlashedLine, ...]]
) -> tuple[FlashedLine, ...]:
    """Return the location of each pattern, in a single set if possible. Raises UnsupportedByDeviceError if the flash
    lacks patterns; the message contains the remedy.
    """
    found = [
        {place.set: place for line in lines.encode(sequence, index) for place in reversed(available.get(line, ()))}
        for index in range(len(sequence))
    ]
    missing = [describe_pattern(sequence.patterns[index]) for index, places in enumerate(found) if not places]
    if missing:
        message = (
            f"the engine's flash lacks {len(missing)} of {len(found)} patterns ({', '.join(missing[:3])}); write all "
            "patterns of this rig into it: slrig patterns RIG"
        )
        raise UnsupportedByDeviceError(message)
    common = set.intersection(*(set(places) for places in found))
    return tuple(places[min(common or places)] for places in found)
