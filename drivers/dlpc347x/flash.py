"""The block of patterns in the engine's flash: how it is made, and what it holds.

The engine keeps a pattern as one line of bits, which all rows (columns) of its mirrors repeat. Format: TI's own source
(dlpc347x_internal_patterns.c, `DLPC347X_INT_PAT_GeneratePatternDataBlock`, in github.com/isabella232/LightField under
dlp-4710/dlpc347x). Compiled for this once, it gave the same bytes for both mirrors that are served. A later edition, in
github.com/Practice3DVision/SLMaster, has the same sizes, headers and lines. Numbers have their low byte first:

    "PATN"  start and size of the sets (4, 4), start and size of the order (4, 4)
    order   entries (4); of each: set, patterns, LEDs, 0, which are inverted (8), light, dark before
            and after (4 each)
    sets    how many (4), the start of each (4); of each: patterns, 1 if these are columns, bits of depth, 0,
            bytes of data (4), data

A line begins with mirrors beyond the picture, low bits first, and is filled up to whole words of 4 bytes. Of the
DLP4710 and its two controllers the editions tell in two ways in which order their halves lie, and which way round they
are: so it is not served.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.pattern_engine.patterns import describe_pattern, pattern_plane
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

MAX_PATTERNS = 64
"""Of a set of 1 bit: an entry of the order has as many bits that say which are inverted."""
_BLOCK = struct.Struct("<4sIIII")
_ENTRY = struct.Struct("<BBBxQIII")
_SET = struct.Struct("<BBBxI")
HEAD_BYTES = _BLOCK.size
_DARK_US = (1000, 1000, 1000)

PatternLine = tuple[int, bytes]
"""1 where a pattern is of columns, 0 where of rows, and its bits."""


@dataclass(frozen=True, slots=True)
class Dlpc347xMirrors:
    """A mirror array. before, after : mirrors beyond the picture, of (rows, columns)."""

    name: str
    size: Size
    before: tuple[int, int]
    after: tuple[int, int]


@dataclass(frozen=True, slots=True)
class FlashedLine:
    """Where a pattern lies: the number of its set, and its own within it."""

    set: int
    index: int


@dataclass(frozen=True, slots=True)
class LineEncoder:
    """How patterns become lines: of which mirrors, and which ways are turned round, of (rows, columns)."""

    mirrors: Dlpc347xMirrors
    turned: tuple[bool, bool]

    def encode(self, sequence: PatternSequence, index: int) -> tuple[PatternLine, ...]:
        """Return a pattern as a line of columns, or of rows, or, where it lights all mirrors or none, as both.
        Raises UnsupportedByDeviceError: it has shades of grey.
        """
        plane = pattern_plane(sequence, index)
        rows, columns = sequence.profiles[index].shape
        lines = [(1, plane[0])] * (rows == 1) + [(0, plane[:, 0])] * (columns == 1)
        return tuple((way, self._pack(line[::-1] if self.turned[way] else line, way)) for way, line in lines)

    def _pack(self, line: NDArray[np.bool_], columns: int) -> bytes:
        bits = np.pad(line, (self.mirrors.before[columns], self.mirrors.after[columns]))
        packed = np.packbits(bits, bitorder="little").tobytes()
        return packed + bytes(-len(packed) % 4)


def build_block(sequence: PatternSequence, lines: LineEncoder) -> bytes:
    """Return the block that holds a sequence: columns, then rows, in sets with white and black; and an order that is
    dark.
    """
    found = [lines.encode(sequence, index) for index in range(len(sequence))]
    sets: list[bytes] = []
    for way in (1, 0):
        both, own = (
            list(dict.fromkeys(bits for line in found if len(line) == ways for each, bits in line if each == way))
            for ways in (2, 1)
        )
        room = MAX_PATTERNS - len(both)
        for start in range(0, len(own) or way, room):
            held = both + own[start : start + room]
            if held:
                sets.append(_SET.pack(len(held), way, 1, sum(map(len, held))) + b"".join(held))
    order = struct.pack("<I", 1) + _ENTRY.pack(0, 1, 0, 0, *_DARK_US)
    begin = HEAD_BYTES + len(order)
    starts = [begin + 4 + 4 * len(sets) + sum(map(len, sets[:number])) for number in range(len(sets))]
    content = struct.pack(f"<I{len(sets)}I", len(sets), *starts) + b"".join(sets)
    return _BLOCK.pack(b"PATN", begin, len(content), HEAD_BYTES, len(order)) + order + content


def block_size(head: bytes) -> int:
    """Return how many bytes a block has, by its first 20; 0 where there is none."""
    name, sets, size, _, _ = _BLOCK.unpack(head)
    return sets + size if name == b"PATN" else 0


def find_lines(block: bytes) -> dict[PatternLine, tuple[FlashedLine, ...]]:
    """Return where a block holds each line of 1 bit. Raises ValueError or struct.error: it is none."""
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
    sequence: PatternSequence, lines: LineEncoder, held: Mapping[PatternLine, tuple[FlashedLine, ...]]
) -> tuple[FlashedLine, ...]:
    """Return where each pattern lies: all in one set where one holds them all.
    Raises UnsupportedByDeviceError: the flash lacks patterns; the message says what to do.
    """
    found = [
        {place.set: place for line in lines.encode(sequence, index) for place in reversed(held.get(line, ()))}
        for index in range(len(sequence))
    ]
    missing = [describe_pattern(sequence.patterns[index]) for index, places in enumerate(found) if not places]
    if missing:
        message = (
            f"the engine's flash lacks {len(missing)} of {len(found)} patterns ({', '.join(missing[:3])}); write all "
            "that this rig shows into it: slrig patterns RIG"
        )
        raise UnsupportedByDeviceError(message)
    common = set.intersection(*(set(places) for places in found))
    return tuple(places[min(common or places)] for places in found)
