"""Files that lie or burst: images, arrays and archives whose headers, sizes and contents do not agree. Seeded."""

from __future__ import annotations

import io
import random
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import cv2
import numpy as np

from slrig.bundle.images import PNG_HEADER, PNG_SIGNATURE

WIDTH, HEIGHT = 64, 48
"""Of the images that the files are made of, in pixels."""

BURST_BYTES = 160_000_000
"""What a file of some hundred kilobytes bursts into."""

HUGE = (2**31 - 1, 2**31 - 1)

_Image = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH), np.uint8)


@cache
def burst(window: int = 15) -> bytes:
    """A stream of zlib, or of raw deflate (-15), that bursts."""
    packer = zlib.compressobj(9, zlib.DEFLATED, window)
    part = bytes(10_000_000)
    parts = [packer.compress(part) for _ in range(BURST_BYTES // len(part))]
    return b"".join([*parts, packer.flush()])


def _encoded(ending: str, *options: int) -> bytes:
    return cv2.imencode(ending, _Image, options)[1].tobytes()


def _chunk(kind: bytes, data: bytes, length: int | None = None) -> bytes:
    size = struct.pack(">I", len(data) if length is None else length)
    return size + kind + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))


def png(
    size: tuple[int, int] = (WIDTH, HEIGHT), *, bits: int = 8, colour: int = 0, interlaced: int = 0,
    data: bytes | None = None, before: bytes = b"", after: bytes = b"",
) -> bytes:  # fmt: skip
    header = _chunk(b"IHDR", PNG_HEADER.pack(*size, bits, colour, 0, 0, interlaced))
    rows = zlib.compress(bytes((WIDTH + 1) * HEIGHT)) if data is None else data
    return PNG_SIGNATURE + header + before + _chunk(b"IDAT", rows) + after + _chunk(b"IEND", b"")


PNG: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: png(HUGE),
    "wide": lambda: png((2**31 - 1, 1)),
    "of 2 Gpx": lambda: png((46_000, 46_000)),
    "without width": lambda: png((0, HEIGHT)),
    "burst": lambda: png(data=burst()),
    "burst of the size": lambda: png((20_000, 20_000), data=burst()),
    "burst of colours": lambda: png((WIDTH, HEIGHT), colour=2, data=burst()),
    "burst of text": lambda: png(before=_chunk(b"zTXt", b"a\0\0" + burst())),
    "burst of a profile": lambda: png(before=_chunk(b"iCCP", b"a\0\0" + burst())),
    "interlaced burst": lambda: png(interlaced=1, data=burst()),
    "short data": lambda: png((WIDTH, 2 * HEIGHT)),
    "long data": lambda: png((WIDTH, HEIGHT // 2)),
    "many chunks": lambda: png(before=_chunk(b"tEXt", b"a\0b") * 50_000),
    "many data": lambda: png(data=b"", after=_chunk(b"IDAT", b"x") * 50_000),
    "endless chunk": lambda: png(before=_chunk(b"tEXt", b"a", 2**32 - 1)),
    "negative chunk": lambda: png(before=_chunk(b"tEXt", b"a", 2**31 + 5)),
    "a bit of 64": lambda: png(bits=64),
    "colour 7": lambda: png(colour=7),
    "two headers": lambda: png(before=_chunk(b"IHDR", PNG_HEADER.pack(*HUGE, 8, 0, 0, 0, 0))),
    "animated": lambda: png(before=_chunk(b"acTL", struct.pack(">II", 2**31 - 1, 0))),
}


def _jpeg(at: bytes, offset: int, form: str, *values: int) -> bytes:
    data = bytearray(_encoded(".jpg"))
    struct.pack_into(form, data, data.index(at) + offset, *values)
    return bytes(data)


def _jpeg_with(segment: bytes) -> bytes:
    data = _encoded(".jpg")
    return data[:2] + segment + data[2:]


def _scans() -> bytes:
    data = _encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    scan = data[data.index(b"\xff\xda") : -2]
    return data[:-2] + scan * 2000 + data[-2:]


JPEG: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: _jpeg(b"\xff\xc0", 5, ">HH", 65535, 65535),
    "wide": lambda: _jpeg(b"\xff\xc0", 5, ">HH", HEIGHT, 65535),
    "without height": lambda: _jpeg(b"\xff\xc0", 5, ">H", 0),
    "small": lambda: _jpeg(b"\xff\xc0", 5, ">HH", 8, 8),
    "of 255 components": lambda: _jpeg(b"\xff\xc0", 9, ">B", 255),
    "of samples of 4 x 4": lambda: _jpeg(b"\xff\xc0", 11, ">B", 0x44),
    "many scans": _scans,
    "many tables": lambda: _jpeg_with((b"\xff\xdb\x00\x43\x00" + bytes(64)) * 20_000),
    "many comments": lambda: _jpeg_with(b"\xff\xfe\x00\x03x" * 50_000),
    "without an end": lambda: _encoded(".jpg")[:-2],
    "an endless segment": lambda: _jpeg_with(b"\xff\xe1\xff\xff"),
    "a segment of 0": lambda: _jpeg_with(b"\xff\xe1\x00\x00"),
    "restarts": lambda: _jpeg_with(b"\xff\xdd\x00\x04\x00\x01"),
    "only a beginning": lambda: b"\xff\xd8\xff",
}


def bmp(
    width: int = WIDTH, height: int = HEIGHT, *, bits: int = 8, compression: int = 0, colours: int = 0,
    first: int = 1078, header: int = 40, data: bytes = bytes(WIDTH * HEIGHT),
) -> bytes:  # fmt: skip
    info = struct.pack("<IiiHHIIiiII", header, width, height, 1, bits, compression, 0, 0, 0, colours, 0)
    return b"BM" + struct.pack("<IHHI", 0, 0, 0, first) + info + bytes(1024) + data


BMP: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: bmp(*HUGE),
    "wide": lambda: bmp(2**31 - 1, 1, bits=32),
    "negative": lambda: bmp(-WIDTH, HEIGHT),
    "the least height": lambda: bmp(WIDTH, -(2**31)),
    "no height": lambda: bmp(WIDTH, 0),
    "runs": lambda: bmp(60_000, 60_000, compression=1),
    "a PNG within": lambda: bmp(*HUGE, compression=5),
    "endless colours": lambda: bmp(colours=2**32 - 1),
    "pixels at the end": lambda: bmp(first=2**32 - 1),
    "pixels at the start": lambda: bmp(first=0),
    "a header of 4 GB": lambda: bmp(header=2**32 - 1),
    "cut": lambda: bmp(data=b"abc"),
    "1 bit": lambda: bmp(2**20, 2**20, bits=1),
}

_Entry = tuple[int, int, int, int]
"""Code, kind, number of values, and the value or its place."""


def _directory(entries: list[_Entry], following: int) -> bytes:
    body = b"".join(struct.pack("<HHII", *each) for each in sorted(entries))
    return struct.pack("<H", len(entries)) + body + struct.pack("<I", following)


def _page(
    width: int = WIDTH, height: int = HEIGHT, *, bits: int = 8, samples: int = 1, compression: int = 1,
    strips: tuple[int, int] = (1, 8), lengths: tuple[int, int] = (1, WIDTH * HEIGHT), rows: int = HEIGHT,
) -> list[_Entry]:  # fmt: skip
    return [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, bits), (259, 3, 1, compression), (262, 3, 1, 1),
        (273, 4, *strips), (277, 3, 1, samples), (278, 4, 1, rows), (279, 4, *lengths),
    ]  # fmt: skip


def tiff(entries: list[_Entry], *, data: bytes = bytes(WIDTH * HEIGHT), following: int = 0) -> bytes:
    return b"II*\0" + struct.pack("<I", 8 + len(data)) + data + _directory(entries, following)


def _chain(count: int, entries: list[_Entry], data: bytes = bytes(WIDTH * HEIGHT), last: int = 0) -> bytes:
    size = 6 + 12 * len(entries)
    first = 8 + len(data)
    places = [first + number * size for number in range(1, count)] + [last]
    return b"II*\0" + struct.pack("<I", first) + data + b"".join(_directory(entries, place) for place in places)


def _shared(pages: int) -> bytes:
    """Pages that all name one long table of strips."""
    table = struct.pack("<I", 8) * 100_000
    return _chain(pages, _page(strips=(100_000, 8), lengths=(100_000, 8), rows=1), table)


def _packed(compression: int, data: bytes, **options: Any) -> bytes:
    return tiff(_page(compression=compression, lengths=(1, len(data)), **options), data=data)


TIFF: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: tiff(_page(2**32 - 1, 2**32 - 1)),
    "huge and packed": lambda: _packed(8, zlib.compress(bytes(1000)), width=60_000, height=60_000, rows=60_000),
    "burst": lambda: _packed(8, burst()),
    "burst of the size": lambda: _packed(8, burst(), width=20_000, height=20_000, rows=20_000),
    "old burst": lambda: _packed(32946, burst()),
    "runs": lambda: _packed(32773, b"\x81\0" * 100_000, width=60_000, height=60_000, rows=60_000),
    "words": lambda: _packed(5, bytes(range(256)) * 400, width=60_000, height=60_000, rows=60_000),
    "itself": lambda: tiff(_page(), following=8 + WIDTH * HEIGHT),
    "a ring": lambda: _chain(5, _page(), last=8 + WIDTH * HEIGHT),
    "a page beyond the end": lambda: tiff(_page(), following=2**32 - 1),
    "many pages": lambda: _chain(65_000, _page()),
    "more pages": lambda: _chain(70_000, _page()),
    "pages that share a table": lambda: _shared(4000),
    "many strips": lambda: tiff(_page(strips=(2**28, 8), lengths=(2**28, 8))),
    "strips for all bytes": lambda: tiff(_page(strips=(25_000, 8), lengths=(25_000, 8), rows=1), data=bytes(100_000)),
    "a strip beyond the end": lambda: tiff(_page(strips=(1, 2**31))),
    "a strip of 4 GB": lambda: tiff(_page(lengths=(1, 2**32 - 1))),
    "65535 samples": lambda: tiff(_page(samples=65535)),
    "65535 bits": lambda: tiff(_page(bits=65535)),
    "no rows": lambda: tiff(_page(rows=0)),
    "values of no kind": lambda: tiff([*_page(), (305, 99, 2**31, 8)]),
    "a text of 2 GB": lambda: tiff([*_page(), (305, 2, 2**31, 8)]),
    "fractions by 0": lambda: tiff([*_page(), (282, 5, 1, 8)]),
    "a long description": lambda: tiff([*_page(), (270, 2, 3000, 8)], data=b"{" * 3000),
    "tags twice": lambda: tiff([*_page(), *_page(2**20, 2**20)]),
    "tiles of 0": lambda: tiff([*_page(), (322, 4, 1, 0), (323, 4, 1, 0), (324, 4, 1, 8), (325, 4, 1, 9)]),
    "tiles of 2 GB": lambda: tiff([*_page(), (322, 4, 1, 2**16), (323, 4, 1, 2**16), (324, 4, 1, 8), (325, 4, 1, 9)]),
    "great and empty": lambda: b"II+\0\x08\0\0\0" + struct.pack("<Q", 2**63),
    "great tags": lambda: b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 2**63 - 1),
}


def npy(header: str, data: bytes = bytes(1000), *, length: int | None = None) -> bytes:
    text = header.encode("latin-1") + b"\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", min(len(text), 65535) if length is None else length) + text + data


def _array(shape: str, kind: str = "'<f8'") -> bytes:
    return npy(f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}")


NPY: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: _array("(1000000000000,)"),
    "of 40 GB": lambda: _array("(5000000000,)"),
    "of 2 GB": lambda: _array("(250000000,)"),
    "overflowing": lambda: _array("(4294967296, 4294967296, 4294967296)"),
    "beyond numbers": lambda: _array(f"({10**40},)"),
    "negative": lambda: _array("(-5, -5)"),
    "of many sides": lambda: _array("(" + "1, " * 70 + ")"),
    "of objects": lambda: _array("(3,)", "'|O'"),
    "of nothing": lambda: _array("(1000000000000,)", "'|V0'"),
    "of wide text": lambda: _array("(0,)", "'|S2147483647'"),
    "of fields": lambda: _array("(9,)", "[('a', '<f8', (100000, 100000))]"),
    "nested": lambda: npy("(" * 9000),
    "long": lambda: npy(" " * 60_000),
    "code": lambda: npy("__import__('os').abort()"),
    "a header beyond the end": lambda: npy("{}", b"", length=65535),
    "version 9": lambda: b"\x93NUMPY\x09\0" + bytes(100),
    "cut": lambda: b"\x93NUMPY",
}


def archive(*members: tuple[str, bytes], packed: bool = True) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as opened:
        for name, data in members:
            opened.writestr(name, data)
    return out.getvalue()


def _burst_member(numbers: int, declared: int | None = None) -> bytes:
    """An archive of one array that bursts. declared : its size by the directory, as it is by default."""
    head = _array(f"({numbers},)")[:-1000]
    raw = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = raw.compress(head) + raw.flush(zlib.Z_SYNC_FLUSH) + burst(-15)
    check = zlib.crc32(head)
    for _ in range(BURST_BYTES // 10_000_000):
        check = zlib.crc32(bytes(10_000_000), check)
    size = len(head) + BURST_BYTES if declared is None else declared
    name = b"a.npy"
    common = (0, 8, 0, 0, check, len(packed), size, len(name), 0)
    local = struct.pack("<4sH4H3I2H", b"PK\3\4", 20, *common) + name
    directory = struct.pack("<4s2H4H3I5H2I", b"PK\1\2", 20, 20, *common, 0, 0, 0, 0, 0) + name
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, len(directory), len(local) + len(packed), 0)
    return local + packed + directory + end


def _tar() -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as opened:
        link = tarfile.TarInfo("../../a")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        opened.addfile(link)
    return out.getvalue()


NPZ: Mapping[str, Callable[[], bytes]] = {
    "burst": lambda: _burst_member(BURST_BYTES // 8),
    "burst that says little": lambda: _burst_member(BURST_BYTES // 8, 1000),
    "burst that says much": lambda: _burst_member(2**28, 2**32 - 2),
    "huge": lambda: archive(("a.npy", _array("(1000000000000,)"))),
    "of 2 GB": lambda: archive(("a.npy", _array("(250000000,)"))),
    "many": lambda: archive(*((f"{number}.npy", _array("(1,)")[:-992]) for number in range(1000)), packed=False),
    "outside": lambda: archive(("../../a.npy", _array("(1,)"))),
    "other files": lambda: archive(("a.txt", b"abc"), ("b.npy", b"abc")),
    "an archive within": lambda: archive(("a.npy", archive(("b.npy", bytes(10**6))))),
    "of objects": lambda: archive(("a.npy", _array("(3,)", "'|O'"))),
    "empty": lambda: archive(),
    "cut": lambda: archive(("a.npy", _array("(9,)")))[:-30],
    "a tar": _tar,
    "a stream": burst,
}


def _element(kind: int, data: bytes, size: int | None = None) -> bytes:
    body = struct.pack("<II", kind, len(data) if size is None else size) + data
    return body + bytes(-len(body) % 8)


def mat(data: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + data


def _matrix(rows: int, columns: int, values: bytes = bytes(72)) -> bytes:
    flags, sides = _element(6, struct.pack("<II", 6, 0)), _element(5, struct.pack("<ii", rows, columns))
    return _element(14, flags + sides + _element(1, b"K1") + _element(9, values))


def _cells(depth: int) -> bytes:
    found = _matrix(3, 3)
    for _ in range(depth):
        flags, sides = _element(6, struct.pack("<II", 1, 0)), _element(5, struct.pack("<ii", 1, 1))
        found = _element(14, flags + sides + _element(1, b"c") + found)
    return found


MAT: Mapping[str, Callable[[], bytes]] = {
    "burst": lambda: mat(_element(15, burst())),
    "many bursts": lambda: mat(_element(15, zlib.compress(_matrix(10**6, 1, bytes(8 * 10**6)), 9)) * 200),
    "huge": lambda: mat(_matrix(2**31 - 1, 2**31 - 1)),
    "negative": lambda: mat(_matrix(-3, -3)),
    "endless": lambda: mat(_element(14, b"abc", 2**32 - 1)),
    "nested": lambda: mat(_cells(500)),
    "many": lambda: mat(_matrix(3, 3) * 20_000),
    "packed twice": lambda: mat(_element(15, zlib.compress(_element(15, zlib.compress(_matrix(3, 3)))))),
    "cut": lambda: mat(_matrix(3, 3)[:-20]),
}


def ply(
    vertices: object, faces: object = 0, *, form: str = "binary_little_endian", more: str = "",
    data: bytes = bytes(144),
) -> bytes:  # fmt: skip
    sides = "".join(f"property float {name}\n" for name in "xyz")
    corners = "property list uchar int vertex_indices\nend_header\n"
    head = f"ply\nformat {form} 1.0\n{more}element vertex {vertices}\n{sides}element face {faces}\n{corners}"
    return head.encode() + data


PLY: Mapping[str, Callable[[], bytes]] = {
    "huge": lambda: ply(2**31 - 1),
    "beyond numbers": lambda: ply(10**30),
    "negative": lambda: ply(-5),
    "no number": lambda: ply("x"),
    "huge faces": lambda: ply(3, 2**31 - 1),
    "in text": lambda: ply(2**31 - 1, form="ascii", data=b"0 0 0\n" * 20),
    "of the other order": lambda: ply(3, 2**40, form="binary_big_endian"),
    "many elements": lambda: ply(3, more="element a 2147483647\nproperty double b\n" * 2000),
    "many properties": lambda: ply(3, more="element a 1000000000\n" + "property double b\n" * 5000),
    "a long list": lambda: ply(0, 1, data=b"\xff" + bytes(100)),
    "a picture": lambda: ply(3, more="comment TextureFile /etc/passwd\n"),
    "cut": lambda: b"ply\nformat",
}

KINDS: Mapping[str, Mapping[str, Callable[[], bytes]]] = {
    ".png": PNG, ".jpg": JPEG, ".bmp": BMP, ".tif": TIFF, ".npy": NPY, ".npz": NPZ, ".mat": MAT,
    ".ply": PLY,
}  # fmt: skip

_SOUND: Mapping[str, Callable[[], bytes]] = {
    ".png": lambda: _encoded(".png"),
    ".jpg": lambda: _encoded(".jpg"),
    ".bmp": lambda: _encoded(".bmp"),
    ".tif": lambda: _encoded(".tif"),
    ".npy": lambda: npy("{'descr': '|u1', 'fortran_order': False, 'shape': (3, 32, 32), }", bytes(3072)),
    ".npz": lambda: archive(("a.npy", _SOUND[".npy"]())),
    ".mat": lambda: mat(_matrix(3, 3)),
    ".ply": lambda: ply(12),
}


def _mutated(data: bytes, chance: random.Random) -> bytes:
    """The same, cut, or with numbers of its head at their limits, or bytes at random."""
    changed = bytearray(data)
    match chance.randrange(4):
        case 0:
            del changed[chance.randrange(len(changed)) :]
        case 1:
            for _ in range(chance.randrange(1, 6)):
                changed[chance.randrange(len(changed))] = chance.randrange(256)
        case 2:
            form = chance.choice(("<I", ">I", "<H", ">H"))
            most = 2 ** (8 * struct.calcsize(form)) - 1
            at = chance.randrange(min(len(changed) - 4, 300))
            struct.pack_into(form, changed, at, chance.choice((0, 1, most, most // 2, most // 2 + 1)))
        case 3:
            at = chance.randrange(len(changed))
            changed[at:at] = changed[at : at + chance.randrange(1, 200)] * chance.randrange(1, 50)
    return bytes(changed)


def hostile_files(mutations: int, seed: int = 20) -> Iterator[tuple[str, str, bytes]]:
    """Yield kind, ending and bytes of all files by design, and of so many mutated sound ones."""
    for ending, kinds in KINDS.items():
        for name, made in kinds.items():
            yield f"{name} {ending}", ending, made()
    chance = random.Random(seed)
    for number in range(mutations):
        ending = chance.choice(list(_SOUND))
        yield f"mutated {number} {ending}", ending, _mutated(_SOUND[ending](), chance)
