"""Frame files: PNG, TIFF, BMP and JPEG; headers are checked before a pixel is decoded.

A few hundred kilobytes can declare an image of gigabytes, so extent and depth come from the header, and only a file
that fits bundle.json is decoded. The checksums of all chunks of a PNG are verified, so that a cut or damaged file is
reported as damaged. The same holds for TIFF pages without compression or with zlib; damaged LZW data, which have no
checksum, are noticed only if the decoder fails, and damage within a JPEG may give a wrong image.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
from isal import isal_zlib

from slrig.errors import BundleError
from slrig.model import CameraFormat, Pixels, Size

BMP_SIGNATURE = b"BM"
_FILE_HEADER, _INFO_HEADER = 14, 40
_BITS = {8: 1, 24: 3, 32: 4}
"""Bytes of a pixel, by bits."""
_BMP_MASKS = struct.pack("<3I", 0xFF0000, 0xFF00, 0xFF)
"""Bits of red, green and blue in a pixel of 32, where a BMP states them."""

JPEG_SIGNATURE = b"\xff\xd8\xff"
_END = b"\xff\xd9"
_FRAME_MARKERS = {0xC0, 0xC1, 0xC2}
"""Baseline, extended sequential and progressive, all with Huffman codes: the common ones."""
_UNSUPPORTED_FRAMES = {0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)}
_TABLES, _SCAN = 0xDB, 0xDA
_METADATA_MARKERS = {*range(0xE1, 0xEE), 0xEF, 0xFE}
"""Comments, and segments of applications except those of JFIF and Adobe, which define the colours."""
_NEXT_SCAN, _MAX_SCANS = b"\xff\xda", 64
"""Each scan of a progressive file takes a pass over all pixels; most files have ten."""

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
MAX_TIFF_PAGES = 4096
"""Ten times as many as a long sequence at six exposures: each costs time and memory before any is read."""
MAX_TIFF_TAGS = 256
_MIN_TIFF_VALUE_BYTES = 2**16
_TIFF_VALUE_BYTES = np.array([1, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 1, 1, 8, 8, 8])
"""Of each kind of value, by its number."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_GREY, PNG_COLOUR = 0, 2
PNG_SAMPLES = {PNG_GREY: 1, PNG_COLOUR: 3, 4: 2, 6: 4}
"""Samples of a pixel by kind of colour; 4 and 6 are grey and colour with alpha."""
PNG_MAX_FILTER = 4
"""Highest filter number."""

_UP = 2
_LEVEL = 1
PNG_HEADER = struct.Struct(">IIBBBBB")
"""Width, height, bits, colour, and methods of compression, filtering and interlacing."""

TIFF_ZLIB = (8, 32946)  # compression: Adobe's deflate and the older one
_TIFF_KINDS = (("MINISBLACK", 1), ("RGB", 3), ("RGB", 4))  # photometric interpretation and samples of a pixel
TIFF_COMPRESSIONS = (1, 5, *TIFF_ZLIB)  # none, LZW
MAX_FILE_BYTES = 2**31
TIFF_FAULTS = (
    struct.error,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors of reading a damaged TIFF header."""


def count_tiff_pages(data: bytes) -> int:
    """Return the number of pages of a TIFF, by following the chain of its directories before any of them is read.
    Raises ValueError with a description of a chain that leads out of the file, is circular or does not end, or of
    directories with more values than the file has bytes: many may share one long table, and each is read.
    """
    order = "<" if data.startswith(b"II") else ">"
    is_big = data[2:4] in (b"+\0", b"\0+")
    count_format, tag_bytes, offset_format, first = ("Q", 20, "Q", 8) if is_big else ("H", 12, "I", 4)
    tag = np.dtype([("code", f"{order}u2"), ("kind", f"{order}u2"), ("count", f"{order}u{8 if is_big else 4}"),
                    ("value", f"V{8 if is_big else 4}")])  # fmt: skip
    visited: set[int] = set()
    value_bytes = 0.0
    try:
        (offset,) = struct.unpack_from(order + offset_format, data, first)
        while offset:
            if offset in visited or len(visited) == MAX_TIFF_PAGES:
                raise ValueError(f"a chain of pages that does not end after {len(visited)}")
            visited.add(offset)
            (tags,) = struct.unpack_from(order + count_format, data, offset)
            if tags > MAX_TIFF_TAGS:
                raise ValueError(f"{tags} tags on page {len(visited) - 1}")
            offset += struct.calcsize(order + count_format)
            entries = np.frombuffer(data[offset : offset + tags * tag_bytes].ljust(tags * tag_bytes), tag)
            kinds = np.minimum(entries["kind"], len(_TIFF_VALUE_BYTES) - 1)
            value_bytes += float(np.dot(entries["count"].astype(np.float64), _TIFF_VALUE_BYTES[kinds]))
            if value_bytes > 2 * len(data) + _MIN_TIFF_VALUE_BYTES:
                raise ValueError(f"{value_bytes:.0f} bytes of tags in {len(data)}")
            (offset,) = struct.unpack_from(order + offset_format, data, offset + tags * tag_bytes)
    except (struct.error, OverflowError) as cause:
        raise ValueError(f"a chain of pages cut after {len(visited)}") from cause
    return len(visited)


@dataclass(frozen=True, slots=True)
class BmpHeader:
    """Header of a BMP. first_byte : of the rows, each of `stride` bytes. upside_down : True if the last row comes
    first, as usual. palette_entries : of 4 bytes each, after the header.
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
    def from_bytes(cls, data: bytes) -> BmpHeader:
        """Read the header. Raises ValueError with a description of a file that is damaged or not supported."""
        if len(data) < _FILE_HEADER + _INFO_HEADER:
            raise ValueError(f"{len(data)} bytes without a header")
        (first_byte,) = struct.unpack_from("<I", data, 10)
        size, width, height, _, bits, compression, _, _, _, colours = struct.unpack_from("<IiiHHIIiiI", data, 14)
        if size < _INFO_HEADER or width < 1 or height == 0:
            raise ValueError(f"a header of {size} bytes for {width} x {height} pixels")
        has_masks = (bits, compression) == (32, 3) and data[54:66] == _BMP_MASKS
        if bits not in _BITS or (compression and not has_masks):
            raise ValueError(f"{bits} bits, {'compressed' if compression else 'uncompressed'}")
        entries = (colours or 256) if bits == 8 else 0
        header = cls(
            width, abs(height), bits, first_byte, -(-bits * width // 32) * 4, height > 0, _FILE_HEADER + size, entries
        )
        if header.header_bytes + 4 * entries > first_byte or entries > 256:
            raise ValueError("a palette that overlaps its pixels")
        if first_byte + header.stride * header.height > len(data):
            raise ValueError(f"one cut after {len(data)} bytes")
        return header

    def decode(self, data: bytes) -> Pixels:
        """Return (H, W) or, in colour, (H, W, 3) or (H, W, 4) uint8, BGR, with alpha if there is any.
        Raises ValueError if a sample is not in the palette.
        """
        rows = np.frombuffer(data, np.uint8, self.stride * self.height, self.first_byte).reshape(self.height, -1)
        rows = rows[:: -1 if self.upside_down else 1, : self.width * _BITS[self.bits]]
        if self.bits != 8:
            pixels = np.ascontiguousarray(rows).reshape(self.height, self.width, -1)
            # The fourth byte is often unused.
            return pixels if pixels[..., 3:].any() else np.ascontiguousarray(pixels[..., :3])
        if int(rows.max()) >= self.palette_entries:
            raise ValueError(f"a sample of {int(rows.max())} and a palette of {self.palette_entries}")
        colours = np.frombuffer(data, np.uint8, 4 * self.palette_entries, self.header_bytes).reshape(-1, 4)[:, :3]
        is_grey = (colours == colours[:, :1]).all()
        return np.ascontiguousarray(colours[rows, 0] if is_grey else colours[rows])


@dataclass(frozen=True, slots=True)
class JpegHeader:
    """Header of a JPEG. components : 1 or 3. metadata : start and end of each segment without effect on the picture,
    such as Exif.
    """

    width: int
    height: int
    components: int
    metadata: tuple[tuple[int, int], ...]

    def without_metadata(self, data: bytes) -> bytes:
        """Return the file without metadata, which a decoder would read."""
        ends = (0, *(end for _, end in self.metadata))
        return b"".join(data[a:b] for a, b in zip(ends, (*(a for a, _ in self.metadata), len(data)), strict=True))

    @classmethod
    def from_bytes(cls, data: bytes) -> JpegHeader:
        """Read the header. Raises ValueError with a description of a file that is damaged or not supported."""
        tables: set[int] = set()
        frame: tuple[int, int, int, int] | None = None
        metadata = []
        offset = 2
        while True:
            marker, length = struct.unpack(">HH", data[offset : offset + 4].ljust(4, b"\0"))
            kind, segment = marker & 0xFF, data[offset + 4 : offset + 2 + length]
            if marker >> 8 != 0xFF or length < 2 or len(segment) != length - 2:
                raise ValueError(f"a header that breaks off at byte {offset}")
            if kind in _UNSUPPORTED_FRAMES:
                raise ValueError("a lossless, hierarchical or arithmetic one")
            if kind in _FRAME_MARKERS:
                frame = _frame(segment)
            elif kind == _TABLES:
                tables |= _table_numbers(segment)
            elif kind in _METADATA_MARKERS:
                metadata.append((offset, offset + 2 + length))
            offset += 2 + length
            if kind == _SCAN:
                break
        if frame is None or frame[3] not in tables:
            raise ValueError("a header without an image or its quantisers")
        if not data.rstrip(b"\0").endswith(_END):
            raise ValueError(f"one cut after {len(data)} bytes")
        if data.count(_NEXT_SCAN, offset) >= _MAX_SCANS:
            raise ValueError(f"one of more than {_MAX_SCANS} scans")
        height, width, components, _ = frame
        return cls(width, height, components, tuple(metadata))


def _frame(segment: bytes) -> tuple[int, int, int, int]:
    """Return height, width, number of components, and the quantiser of the first component, which is grey."""
    if len(segment) < 9:
        raise ValueError("a header without an image")
    bits, height, width, components = struct.unpack_from(">BHHB", segment)
    if bits != 8 or components not in (1, 3) or not height or not width:
        raise ValueError(f"{width} x {height} samples of {bits} bits, {components} for each pixel")
    return height, width, components, segment[8]


def _table_numbers(segment: bytes) -> set[int]:
    """Return the numbers of the quantisation tables in a segment."""
    numbers, offset = set(), 0
    while offset < len(segment):
        size = 129 if segment[offset] >> 4 else 65
        if offset + size > len(segment):
            raise ValueError("a header with a part of a table")
        numbers.add(segment[offset] & 15)
        offset += size
    return numbers


def encode_frame(image: Pixels, name: str) -> bytes:
    """Encode a frame, (H, W) or, blue, green and red, (H, W, 3) uint8 or uint16, as PNG. name : for messages.
    Raises BundleError: the image has another shape or type.
    """
    kind = {(): PNG_GREY, (3,): PNG_COLOUR}.get(image.shape[2:])
    if image.ndim < 2 or kind is None or image.size == 0 or image.dtype not in (np.uint8, np.uint16):
        raise BundleError(f"{name}: expected an image of 8 or 16 bits, found {image.shape} {image.dtype}")
    height, width = image.shape[:2]
    # A PNG's colours are red, green and blue.
    ordered = image if kind == PNG_GREY else cv2.cvtColor(image, cv2.COLOR_BGR2RGB).reshape(height, -1)
    samples = np.ascontiguousarray(ordered, dtype=">u2" if image.itemsize == 2 else np.uint8).view(np.uint8)
    rows = np.zeros((height, 1 + samples.shape[1]), dtype=np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = samples[0]
    np.subtract(samples[1:], samples[:-1], out=rows[1:, 1:])
    header = PNG_HEADER.pack(width, height, 8 * image.itemsize, kind, 0, 0, 0)
    return assemble_png(header, isal_zlib.compress(rows, _LEVEL))


def assemble_png(header: bytes, compressed: bytes) -> bytes:
    """Return a PNG with these contents of its IHDR and IDAT chunks."""
    parts = [PNG_SIGNATURE]
    for name, data in ((b"IHDR", header), (b"IDAT", compressed), (b"IEND", b"")):
        checksum = zlib.crc32(data, zlib.crc32(name))
        parts += [struct.pack(">I", len(data)), name, data, struct.pack(">I", checksum)]
    return b"".join(parts)


def undo_up_filter(rows: bytes, height: int, bits: int) -> Pixels | None:
    """Return the (H, W) image of rows that were all filtered by differences to the row above; None if they were not.

    rows : decompressed rows of a grey image, each with the number of its filter first.
    """
    filtered = np.frombuffer(rows, dtype=np.uint8).reshape(height, -1)
    if (filtered[:, 0] != _UP).any():
        return None
    samples = np.zeros((height, filtered.shape[1] - 1), dtype=np.uint8)
    samples[0] = filtered[0, 1:]
    # Row by row: np.cumsum along columns takes fifteen times as long.
    for above, row, differences in zip(samples, samples[1:], filtered[1:, 1:], strict=False):
        np.add(above, differences, out=row)
    return samples if bits == 8 else samples.view(">u2").astype(np.uint16)


def read_pages(path: Path, pages: Sequence[int], camera: CameraFormat) -> dict[int, Pixels]:
    """Return pages of a frame file, each (H, W) uint8 or uint16 of the camera's extent.

    Samples are right-aligned; colour becomes grey with the weights of Rec. 601; an opaque alpha channel is ignored.
    Raises BundleError: the file is missing, cut, damaged, transparent, of another kind, extent or depth, or has no such
    page.
    """
    return read_with_colour(path, pages, camera)[0]


def read_colour(path: Path, camera: CameraFormat) -> Pixels:
    """Return the colour picture in a file, (H, W, 3) of blue, green and red.
    Raises BundleError: see `read_pages`; or the picture is grey, or a sample is above the camera's full scale.
    """
    found = read_with_colour(path, (0,), camera, colour_pages=(0,))[1]
    if not found:
        wanted = f"a colour image with samples of 0 to {camera.full_scale}"
        _refuse(path, wanted, "a grey one, or a brighter sample", "save it in colour, or leave colour_file out")
    return found[0]


def read_with_colour(
    path: Path, pages: Sequence[int], camera: CameraFormat, *, colour_pages: Collection[int] = ()
) -> tuple[dict[int, Pixels], dict[int, Pixels]]:
    """Return pages as `read_pages` does, and the colour of those in `colour_pages` that have any.

    Colour is (H, W, 3) of blue, green and red. Colour above the camera's full scale is omitted, because its grey may
    still fit. Raises as `read_pages` does.
    """
    data = _read_bytes(path)
    readers = {PNG_SIGNATURE: _png, BMP_SIGNATURE: _bitmap, JPEG_SIGNATURE: _jpeg}
    read = next((each for signature, each in readers.items() if data.startswith(signature)), None)
    if data.startswith(TIFF_SIGNATURES):
        _check_tiff(path, data, pages, camera)
        images = {page: _tiff_page(data, page) for page in dict.fromkeys(pages)}
    elif read is not None:
        if set(pages) != {0}:
            _refuse(path, "page 0 only, for it holds one image", f"page {max(pages)}", "write page 0 or use a TIFF")
        images = {0: read(path, data, camera)}
    else:
        found = "an empty file" if not data else f"a file that begins with {data[:8]!r}"
        _refuse(path, "a PNG, TIFF, BMP or JPEG file", found, "save the frame as PNG")
    images = {page: _opaque(path, page, image) for page, image in images.items()}
    grey = {page: _grey(path, page, image, camera) for page, image in images.items()}
    colours = {
        page: image for page, image in images.items() if page in colour_pages and image is not None and image.ndim == 3
    }
    return grey, {page: image for page, image in colours.items() if int(image.max()) <= camera.full_scale}


def read_frame_format(path: Path) -> CameraFormat:
    """Return extent and bits of the samples, 8 or 16, of the first page of a frame file, from its header alone.
    Raises BundleError: the file is missing or cut, or `read_pages` does not read it.
    """
    return read_page_formats(path)[0]


def read_page_formats(path: Path) -> dict[int, CameraFormat]:
    """Return extent and bits of the samples of the pages of a frame file, by number, from its headers alone: of the
    first page, and of those others that have samples of 8 or 16 bits. Raises as `read_frame_format` does.
    """
    data = _read_bytes(path)
    others: list[tuple[int, int, int]] = []
    try:
        if data.startswith(PNG_SIGNATURE) and data[12:16] == b"IHDR" and len(data) >= 33:
            width, height, bits = PNG_HEADER.unpack(data[16:29])[:3]
        elif data.startswith(BMP_SIGNATURE):
            bitmap = BmpHeader.from_bytes(data)
            width, height, bits = bitmap.width, bitmap.height, 8
        elif data.startswith(JPEG_SIGNATURE):
            jpeg = JpegHeader.from_bytes(data)
            width, height, bits = jpeg.width, jpeg.height, 8
        elif data.startswith(TIFF_SIGNATURES):
            from tifffile import TiffFile

            count_tiff_pages(data)
            with TiffFile(io.BytesIO(data)) as tiff:
                sizes = [(page.imagewidth, page.imagelength, page.bitspersample) for page in tiff.pages]
                (width, height, bits), *others = sizes
        else:
            raise ValueError(f"a file that begins with {data[:8]!r}")
        if bits not in (8, 16):
            raise ValueError(f"samples of {bits} bits")
        pages = enumerate([(width, height, bits), *others])
        return {page: CameraFormat(Size(w, h), depth) for page, (w, h, depth) in pages if depth in (8, 16)}
    except TIFF_FAULTS as cause:
        expected = "a whole PNG, TIFF, BMP or JPEG file of 8 or 16 bits"
        raise BundleError(f"{path}: expected {expected}, found {cause}; save the frame as PNG") from cause


def _refuse(path: Path, expected: str, found: str, remedy: str) -> NoReturn:
    raise BundleError(f"{path}: expected {expected}, found {found}; {remedy}")


def _read_bytes(path: Path) -> bytes:
    try:
        size_bytes = path.stat().st_size
        if size_bytes > MAX_FILE_BYTES:
            _refuse(path, f"at most {MAX_FILE_BYTES} bytes", f"{size_bytes}", "split the frames over several files")
        return path.read_bytes()
    except OSError as cause:
        raise BundleError(
            f"{path}: expected a frame file, found: {cause.strerror}; "
            "copy the file into the bundle or remove its entry from bundle.json"
        ) from cause


def _check_header(path: Path, width: int, height: int, bits: int, camera: CameraFormat) -> None:
    rows, columns = camera.size.shape
    if (height, width) != (rows, columns):
        _refuse(
            path,
            f"{columns} x {rows} pixels as bundle.json declares",
            f"{width} x {height}",
            "correct size_px of the camera or replace the frame",
        )
    wanted = 8 if camera.bit_depth <= 8 else 16
    if bits != wanted:
        _refuse(
            path,
            f"{wanted}-bit samples for a bit_depth of {camera.bit_depth}",
            f"{bits}-bit samples",
            "correct bit_depth of the camera; all frames of one camera have one depth",
        )


def _png(path: Path, data: bytes, camera: CameraFormat) -> Pixels | None:
    if len(data) < 33 or data[12:16] != b"IHDR":
        _refuse(path, "a whole PNG file", f"{len(data)} bytes without a header", "copy the frame again")
    width, height, bits, colour, _, _, interlaced = PNG_HEADER.unpack(data[16:29])
    if colour not in PNG_SAMPLES:
        _refuse(path, "a grey or colour PNG", "one with a palette", "save the frame as grey")
    if interlaced:
        _refuse(path, "a PNG line by line", "an interlaced one", "save the frame without interlacing")
    _check_header(path, width, height, bits, camera)
    offset = len(PNG_SIGNATURE)
    compressed = bytearray()
    while True:
        length, kind_of_chunk = struct.unpack(">I4s", data[offset : offset + 8].ljust(8, b"\xff"))
        end = offset + 12 + length
        if end > len(data):
            _refuse(path, "a whole PNG file", f"one cut after {len(data)} bytes", "copy the frame again")
        if zlib.crc32(memoryview(data)[offset + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            _refuse(path, "a sound PNG file", f"a wrong checksum at byte {end - 4}", "copy the frame again")
        if kind_of_chunk == b"tRNS":
            _refuse(path, "a grey or colour PNG", "one with a transparent colour", "save the frame as grey")
        if kind_of_chunk == b"IDAT":
            compressed += memoryview(data)[offset + 8 : end - 4]
        if kind_of_chunk == b"IEND":
            break
        offset = end
    row_bytes = 1 + width * bits // 8 * PNG_SAMPLES[colour]
    rows = _inflate(compressed, row_bytes * height)
    if rows is None or len(rows) != row_bytes * height or max(rows[::row_bytes]) > PNG_MAX_FILTER:
        return None
    image = undo_up_filter(rows, height, bits) if colour == PNG_GREY else None
    if image is not None:
        return image
    # For safety, the decoder gets a new file with these rows alone.
    return _decode(assemble_png(data[16:29], zlib.compress(rows, 0)))


def _inflate(compressed: bytearray | memoryview, max_bytes: int) -> bytes | None:
    """Decompress a zlib stream; None if it is cut, damaged, or longer than `max_bytes`."""
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(compressed, max_bytes + 1)
    except zlib.error:
        return None
    return data if unpacker.eof and len(data) <= max_bytes else None


def _bitmap(path: Path, data: bytes, camera: CameraFormat) -> Pixels:
    try:
        header = BmpHeader.from_bytes(data)
        _check_header(path, header.width, header.height, 8, camera)
        return header.decode(data)
    except ValueError as cause:
        _refuse(path, "a whole, uncompressed BMP of 8, 24 or 32 bits", str(cause), "save the frame as PNG")


def _jpeg(path: Path, data: bytes, camera: CameraFormat) -> Pixels | None:
    try:
        header = JpegHeader.from_bytes(data)
    except ValueError as cause:
        _refuse(path, "a whole JPEG of 8 bits, grey or in colour", str(cause), "copy the frame again")
    _check_header(path, header.width, header.height, 8, camera)
    return _decode(header.without_metadata(data))


def _check_tiff(path: Path, data: bytes, pages: Sequence[int], camera: CameraFormat) -> None:
    # Takes 30 ms to import, and most bundles hold PNG.
    from tifffile import TiffFile

    try:
        count = count_tiff_pages(data)
        with TiffFile(io.BytesIO(data)) as tiff:
            if max(pages) >= count:
                _refuse(path, f"a page {max(pages)}", f"{count} pages", "correct `page`, which counts from 0")
            for index in dict.fromkeys(pages):
                page = tiff.pages[index]
                kind = getattr(page.photometric, "name", str(page.photometric))
                if (kind, page.samplesperpixel) not in _TIFF_KINDS or page.sampleformat != 1:
                    _refuse(
                        path,
                        f"unsigned grey or colour samples on page {index}",
                        f"{kind} with {page.samplesperpixel} samples of format {int(page.sampleformat)}",
                        "save the frame as grey",
                    )
                _check_header(path, page.imagewidth, page.imagelength, page.bitspersample, camera)
                if page.compression not in TIFF_COMPRESSIONS:
                    kind = getattr(page.compression, "name", str(page.compression))
                    _refuse(path, "a TIFF without compression, or with zlib or LZW", kind, "save the frame as PNG")
                codes = [tag.code for tag in page.tags]
                if len(set(codes)) < len(codes):
                    _refuse(path, f"each tag once on page {index}", "one twice", "save the frame as PNG")
                ends = (offset + size for offset, size in zip(page.dataoffsets, page.databytecounts, strict=True))
                if max(ends, default=0) > len(data):
                    _refuse(path, "a whole TIFF file", f"one cut after {len(data)} bytes", "copy the frame again")
                if page.compression in TIFF_ZLIB:
                    _check_zlib(path, index, data, page)
    except BundleError:
        raise
    except TIFF_FAULTS as cause:
        message = f"{path}: expected a sound TIFF file, found a damaged header ({cause}); copy the frame again"
        raise BundleError(message) from cause


def _check_zlib(path: Path, index: int, data: bytes, page: Any) -> None:
    # OpenCV returns the rest of a damaged 8-bit TIFF without an error, so zlib verifies the checksum first. Tiles at
    # an edge are padded, and several strips may share their bytes: four times the page is enough for all.
    remaining_bytes = 2**16 + page.imagewidth * page.imagelength * page.samplesperpixel * page.bitspersample // 2
    for offset, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        decompressed = _inflate(memoryview(data)[offset : offset + size], remaining_bytes)
        if decompressed is None:
            _refuse(path, f"sound data on page {index}", "data that cannot be unpacked", "copy the frame again")
        remaining_bytes -= len(decompressed)


def _decode(data: bytes) -> Pixels | None:
    """Decode the one image of a file with a checked header; None if OpenCV cannot decode it."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _tiff_page(data: bytes, page: int) -> Pixels | None:
    pages = (page, page + 1)
    try:
        decoded, images = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED, None, pages)
    except cv2.error:
        # libtiff is stricter than `_check_tiff` in some tags.
        return None
    return images[0] if decoded and images else None


def _opaque(path: Path, page: int, image: Pixels | None) -> Pixels | None:
    """Return an image without its alpha channel, grey if all colours are. Raises BundleError: it is transparent."""
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return image
    if int(image[..., 3].min()) < np.iinfo(image.dtype).max:
        where = int((image[..., 3] < np.iinfo(image.dtype).max).sum())
        _refuse(path, "an opaque image", f"{where} transparent pixels on page {page}", "save the frame without alpha")
    colours = image[..., :3]
    return np.ascontiguousarray(colours[..., 0] if (colours == colours[..., :1]).all() else colours)


def _grey(path: Path, page: int, image: Pixels | None, camera: CameraFormat) -> Pixels:
    if image is None:
        _refuse(path, f"a sound image on page {page}", "data that cannot be decoded", "copy the frame again")
    if image.ndim == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if image.shape != camera.size.shape or image.dtype not in (np.uint8, np.uint16):
        _refuse(path, f"{camera.size} grey samples", f"{image.shape} {image.dtype}", "save the frame as grey")
    brightest = int(image.max())
    if brightest > camera.full_scale:
        _refuse(
            path,
            f"samples of 0 to {camera.full_scale} for a bit_depth of {camera.bit_depth}",
            f"a sample of {brightest}",
            "right-align the samples or correct bit_depth",
        )
    return image
