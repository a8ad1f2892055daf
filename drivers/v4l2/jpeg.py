"""Whether a JPEG is whole: its entropy-coded data are walked, code by code, without making an image.

A decoder fills in what a lost USB packet left out and says nothing: the image has the right size and is wrong. Here the
codes themselves are counted: every block must be there, every code must exist, and no more than a little may be left.
A damaged bit that happens to give valid codes of the same number is not found; a missing packet is.

Facts: ITU-T T.81, sections B (markers) and F.2 (sequential Huffman decoding), and tables K.3 to K.6, which cameras
leave out of every frame and every decoder knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_START, _END, _FRAMES, _TABLES, _INTERVAL, _SCAN = 0xD8, 0xD9, (0xC0, 0xC1), 0xC4, 0xDD, 0xDA
_LONE = frozenset({0x01, *range(0xD0, 0xD8)})
_EXTRA_BYTES = 16
"""Real cameras leave a few bytes behind the last block."""

_FAULTS = {
    1: "its data end early",
    2: "it holds a code that does not exist",
    3: "a block has too many coefficients",
    4: "a restart marker is missing or out of turn",
    5: "data are left behind its last block",
}


_DC_VALUES = bytes(range(12))
_AC_LUMA = bytes.fromhex(
    "0102030004110512213141061351610722711432 8191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738"
    "393a434445464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5"
    "a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
)
_AC_CHROMA = bytes.fromhex(
    "0001020311040521310612415107617113223281081442 91a1b1c109233352f0156272d10a162434e125f11718191a262728292a353637"
    "38393a434445464748494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3"
    "a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
_USUAL_TABLES = {
    0x00: (bytes((0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0)), _DC_VALUES),
    0x01: (bytes((0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0)), _DC_VALUES),
    0x10: (bytes((0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125)), _AC_LUMA),
    0x11: (bytes((0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119)), _AC_CHROMA),
}
"""By class (upper four bits: 0 DC, 1 AC) and number: how many codes have each length, and their values in order."""


@dataclass(slots=True)
class _Outline:
    """What the markers of a JPEG say. components : by identifier, the sampling factors (horizontal, vertical)."""

    width: int = 0
    height: int = 0
    components: dict[int, tuple[int, int]] = field(default_factory=dict)
    tables: dict[int, tuple[bytes, bytes]] = field(default_factory=lambda: dict(_USUAL_TABLES))
    interval: int = 0
    scan: tuple[tuple[int, int], ...] = ()
    """Per component of the scan: its identifier, and its two tables' numbers, DC in the upper four bits."""
    data_begin: int = 0


def fault_of(data: Bytes) -> str:
    """Return what is wrong with a JPEG, in words; "" if it is whole, or of a kind that cameras do not send.

    data : (n,) uint8. Sequential Huffman-coded JPEGs of one scan are walked; others are left to the decoder.
    """
    outline = _outline(data)
    if isinstance(outline, str):
        return outline
    blocks = _blocks_of_a_unit(outline)
    if not blocks:
        return ""
    numbers = sorted({number for block in blocks for number in block})
    tables = np.stack([_lookup(*outline.tables[number]) for number in numbers])
    order = np.array([[numbers.index(number) for number in block] for block in blocks], np.int64)
    verdict = _walker()(data, outline.data_begin, _units(outline), order, tables, outline.interval, _EXTRA_BYTES)
    return _FAULTS.get(int(verdict), "")


def prepare() -> None:
    """Compile the walk, or load it: not while a frame is waited for."""
    _walker()(np.zeros(4, np.uint8), 0, 0, np.zeros((1, 2), np.int64), np.zeros((1, 65_536), np.uint16), 0, 16)


def _outline(data: Bytes) -> _Outline | str:
    """Read the markers up to the scan; in words, why that cannot be done."""
    outline, at, size = _Outline(), 2, len(data)
    while True:
        while at < size and data[at] != 0xFF:
            at += 1
        while at < size and data[at] == 0xFF:
            at += 1
        if at + 3 > size:
            return "its markers end early"
        marker = int(data[at])
        at += 1
        if marker in _LONE:
            continue
        length = int(data[at]) << 8 | int(data[at + 1])
        part = bytes(data[at + 2 : at + length])
        if marker == _END or length < 2 or len(part) != length - 2:
            return "its markers end early"
        try:
            _note(outline, marker, part)
        except (IndexError, KeyError):
            return f"its marker {marker:#04x} is damaged"
        at += length
        if marker == _SCAN:
            outline.data_begin = at
            return outline


def _note(outline: _Outline, marker: int, part: bytes) -> None:
    if marker in _FRAMES:
        outline.height, outline.width = part[1] << 8 | part[2], part[3] << 8 | part[4]
        for first in range(6, 6 + 3 * part[5], 3):
            outline.components[part[first]] = (part[first + 1] >> 4, part[first + 1] & 15)
    elif marker == _TABLES:
        while part:
            count = sum(part[1:17])
            outline.tables[part[0]] = (part[1:17], part[17 : 17 + count])
            part = part[17 + count :]
    elif marker == _INTERVAL:
        outline.interval = part[0] << 8 | part[1]
    elif marker == _SCAN:
        outline.scan = tuple((part[1 + 2 * place], part[2 + 2 * place]) for place in range(part[0]))


def _blocks_of_a_unit(outline: _Outline) -> list[tuple[int, int]]:
    """The DC and AC table of each block of a coded unit, in order; empty for JPEGs of another kind."""
    if not outline.components or len(outline.scan) != len(outline.components):
        return []
    blocks = []
    for identifier, numbers in outline.scan:
        across, down = outline.components.get(identifier, (0, 0))
        pair = (numbers >> 4, 0x10 | numbers & 15)
        if not across or not down or not set(pair) <= set(outline.tables):
            return []
        # A single component is not interleaved: its units are single blocks, whatever its factors are.
        blocks += [pair] * (across * down if len(outline.scan) > 1 else 1)
    return blocks


def _units(outline: _Outline) -> int:
    across = max(factors[0] for factors in outline.components.values()) if len(outline.scan) > 1 else 1
    down = max(factors[1] for factors in outline.components.values()) if len(outline.scan) > 1 else 1
    return -(-outline.width // (8 * across)) * -(-outline.height // (8 * down))


@cache
def _lookup(lengths: bytes, values: bytes) -> NDArray[np.uint16]:
    """(65536,) uint16: for the next sixteen bits, the code's length in the upper byte and its value; 0 for no code."""
    table = np.zeros(65_536, np.uint16)
    code, place = 0, 0
    for length, count in enumerate(lengths, start=1):
        for _ in range(count):
            if place >= len(values) or code >> length:
                return table
            first = code << (16 - length)
            table[first : first + (1 << (16 - length))] = length << 8 | values[place]
            code, place = code + 1, place + 1
        code <<= 1
    return table


@cache
def _walker() -> Callable[..., int]:
    # Imported here: most cameras send no JPEG, and numba takes its time.
    from slrig.kernels import kernel

    walker: Callable[..., int] = kernel(_walk, in_every_scan=False)
    return walker


def _walk(
    data: Bytes, at: int, units: int, order: NDArray[np.int64], tables: NDArray[np.uint16], interval: int, extra: int
) -> int:
    """Walk the codes of a scan; 0 if all are there, else the number of a fault.

    order : (b, 2) int64, the DC and AC table of each block of a unit; tables : (t, 65536) uint16.
    """
    size = len(data)
    bits, held, marker, restarts, behind = 0, 0, False, 0, 0
    for unit in range(units):
        if interval > 0 and unit > 0 and unit % interval == 0:
            behind = held // 8
            bits, held, marker = 0, 0, False
            while at + 1 < size and not (data[at] == 0xFF and data[at + 1] != 0 and data[at + 1] != 0xFF):
                at += 1
                behind += 1
            if behind > extra:
                return 5
            if at + 1 >= size or data[at + 1] != 0xD0 + restarts % 8:
                return 4
            at += 2
            restarts += 1
        for block in range(len(order)):
            coefficient = 0
            while coefficient < 64:
                # Keep 32 bits: a code and the number that follows it have 31 at most.
                while held < 32 and not marker:
                    if at >= size or (data[at] == 0xFF and (at + 1 >= size or data[at + 1] != 0)):
                        marker = True
                    else:
                        bits = bits << 8 | int(data[at])
                        held += 8
                        at += 2 if data[at] == 0xFF else 1
                window = (bits >> (held - 16)) & 0xFFFF if held >= 16 else (bits << (16 - held)) & 0xFFFF
                entry = int(tables[order[block, 0 if coefficient == 0 else 1], window])
                length, value = entry >> 8, entry & 0xFF
                if length == 0:
                    return 1 if held < 16 else 2
                number_bits = value if coefficient == 0 else value & 15
                held -= length + number_bits
                if held < 0:
                    return 1
                bits &= (1 << held) - 1
                if coefficient == 0:
                    coefficient = 1
                elif number_bits == 0 and value != 0xF0:
                    break
                else:
                    coefficient += (value >> 4) + 1
                    if coefficient > 64:
                        return 3
    behind = held // 8
    while at < size and not (data[at] == 0xFF and at + 1 < size and data[at + 1] == 0xD9):
        behind += 1
        at += 1
        if behind > extra:
            return 5
    return 0
