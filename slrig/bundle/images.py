"""Frame files: PNG, TIFF, BMP and JPEG, their headers read before a pixel is decoded.

A few hundred kilobytes can declare an image of gigabytes, so extent and depth come from the header, and only a file
that fits what bundle.json declares is decoded. A PNG's chunks are walked with their checksums: a cut or damaged file is
told as that, not as a strange image. So are TIFF pages without compression or with zlib; a fault inside LZW data, which
has no checksum, shows only where the decoder stumbles, and one inside a JPEG as a strange image.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
import tifffile

from slrig.bundle.frame_headers import BMP_SIGNATURE, JPEG_SIGNATURE, TIFF_SIGNATURES, Bitmap, Jpeg, tiff_page_count
from slrig.bundle.png import COLOUR, FILTERS, GREY, HEADER, SIGNATURE, png_file, rows_above_added
from slrig.errors import BundleError
from slrig.model import CameraFormat, Pixels, Size

TIFF_ZLIB = (8, 32946)  # compression: Adobe's deflate and the older one
TIFF_COMPRESSIONS = (1, 5, *TIFF_ZLIB)  # none, LZW
MOST_FILE_BYTES = 2**31
TIFF_FAULTS = (
    tifffile.TiffFileError,
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
"""What reading a damaged TIFF header may raise."""


def read_pages(path: Path, pages: Sequence[int], camera: CameraFormat) -> dict[int, Pixels]:
    """Return the wanted pages of a frame file, each (H, W) uint8 or uint16 of the camera's extent.

    Samples are right-aligned; colour becomes grey with the weights of Rec. 601.
    Raises BundleError: the file is missing, cut, damaged, of another kind, extent or depth, or has no such page.
    """
    return read_with_colour(path, pages, camera)[0]


def read_colour(path: Path, camera: CameraFormat) -> Pixels:
    """Return a file's picture in colour, (H, W, 3) of blue, green and red. Raises BundleError: see `read_pages`; or it
    is grey, or a sample lies beyond the camera's full scale.
    """
    found = read_with_colour(path, (0,), camera, coloured=(0,))[1]
    if not found:
        wanted = f"a colour image with samples of 0 to {camera.full_scale}"
        _refuse(path, wanted, "a grey one, or a brighter sample", "save it in colour, or leave colour_file out")
    return found[0]


def read_with_colour(
    path: Path, pages: Sequence[int], camera: CameraFormat, *, coloured: Collection[int] = ()
) -> tuple[dict[int, Pixels], dict[int, Pixels]]:
    """As `read_pages`, and of the pages `coloured` those that are in colour, (H, W, 3) of blue, green and red. Colour
    that does not fit the camera's full scale is left out: the grey of it may. Raises as `read_pages` does.
    """
    data = _read_bytes(path)
    readers = {SIGNATURE: _png, BMP_SIGNATURE: _bitmap, JPEG_SIGNATURE: _jpeg}
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
    grey = {page: _grey(path, page, image, camera) for page, image in images.items()}
    kept = {page: image for page, image in images.items() if page in coloured and image is not None and image.ndim == 3}
    return grey, {page: image for page, image in kept.items() if int(image.max()) <= camera.full_scale}


def frame_format(path: Path) -> CameraFormat:
    """Extent and bits of the samples, 8 or 16, of the first page of a frame file, by its header alone.
    Raises BundleError: the file is missing or cut, or is none that `read_pages` reads.
    """
    data = _read_bytes(path)
    try:
        if data.startswith(SIGNATURE) and data[12:16] == b"IHDR" and len(data) >= 33:
            width, height, bits = HEADER.unpack(data[16:29])[:3]
        elif data.startswith(BMP_SIGNATURE):
            bitmap = Bitmap.of(data)
            width, height, bits = bitmap.width, bitmap.height, 8
        elif data.startswith(JPEG_SIGNATURE):
            jpeg = Jpeg.of(data)
            width, height, bits = jpeg.width, jpeg.height, 8
        elif data.startswith(TIFF_SIGNATURES):
            tiff_page_count(data)
            with tifffile.TiffFile(io.BytesIO(data)) as tiff:
                page = tiff.pages[0]
                width, height, bits = page.imagewidth, page.imagelength, page.bitspersample
        else:
            raise ValueError(f"a file that begins with {data[:8]!r}")
        if bits not in (8, 16):
            raise ValueError(f"samples of {bits} bits")
        return CameraFormat(Size(width, height), bits)
    except TIFF_FAULTS as cause:
        expected = "a whole PNG, TIFF, BMP or JPEG file of 8 or 16 bits"
        raise BundleError(f"{path}: expected {expected}, found {cause}; save the frame as PNG") from cause


def _refuse(path: Path, expected: str, found: str, remedy: str) -> NoReturn:
    raise BundleError(f"{path}: expected {expected}, found {found}; {remedy}")


def _read_bytes(path: Path) -> bytes:
    try:
        size_bytes = path.stat().st_size
        if size_bytes > MOST_FILE_BYTES:
            _refuse(path, f"at most {MOST_FILE_BYTES} bytes", f"{size_bytes}", "split the frames over several files")
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
    width, height, bits, colour, _, _, interlaced = HEADER.unpack(data[16:29])
    if colour not in (GREY, COLOUR):
        kind = "a palette" if colour == 3 else "an alpha channel"
        _refuse(path, "a grey or colour PNG", f"one with {kind}", "save the frame as grey")
    if interlaced:
        _refuse(path, "a PNG line by line", "an interlaced one", "save the frame without interlacing")
    _check_header(path, width, height, bits, camera)
    place = len(SIGNATURE)
    packed = bytearray()
    while True:
        length, kind_of_chunk = struct.unpack(">I4s", data[place : place + 8].ljust(8, b"\xff"))
        end = place + 12 + length
        if end > len(data):
            _refuse(path, "a whole PNG file", f"one cut after {len(data)} bytes", "copy the frame again")
        if zlib.crc32(memoryview(data)[place + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            _refuse(path, "a sound PNG file", f"a wrong checksum at byte {end - 4}", "copy the frame again")
        if kind_of_chunk == b"tRNS":
            _refuse(path, "a grey or colour PNG", "one with a transparent colour", "save the frame as grey")
        if kind_of_chunk == b"IDAT":
            packed += memoryview(data)[place + 8 : end - 4]
        if kind_of_chunk == b"IEND":
            break
        place = end
    row_bytes = 1 + width * bits // 8 * (3 if colour == COLOUR else 1)
    rows = _inflated(packed, row_bytes * height)
    if rows is None or len(rows) != row_bytes * height or max(rows[::row_bytes]) > FILTERS:
        return None
    image = rows_above_added(rows, height, bits) if colour == GREY else None
    if image is not None:
        return image
    # The decoder gets a file of these rows alone: nothing that a stranger packed, and no chunk that the walk passed.
    return _decoded(png_file(data[16:29], zlib.compress(rows, 0)))


def _inflated(packed: bytearray | memoryview, most_bytes: int) -> bytes | None:
    """What a zlib stream unpacks to, if it is whole, sound, and no longer than this."""
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(packed, most_bytes + 1)
    except zlib.error:
        return None
    return found if unpacker.eof and len(found) <= most_bytes else None


def _bitmap(path: Path, data: bytes, camera: CameraFormat) -> Pixels:
    try:
        found = Bitmap.of(data)
        _check_header(path, found.width, found.height, 8, camera)
        return found.decoded(data)
    except ValueError as cause:
        _refuse(path, "a whole, uncompressed BMP of 8 or 24 bits", str(cause), "save the frame as PNG")


def _jpeg(path: Path, data: bytes, camera: CameraFormat) -> Pixels | None:
    try:
        found = Jpeg.of(data)
    except ValueError as cause:
        _refuse(path, "a whole JPEG of 8 bits, grey or in colour", str(cause), "copy the frame again")
    _check_header(path, found.width, found.height, 8, camera)
    return _decoded(found.plain(data))


def _check_tiff(path: Path, data: bytes, pages: Sequence[int], camera: CameraFormat) -> None:
    try:
        count = tiff_page_count(data)
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            if max(pages) >= count:
                _refuse(path, f"a page {max(pages)}", f"{count} pages", "correct `page`, which counts from 0")
            for index in dict.fromkeys(pages):
                page = tiff.pages[index]
                kind = getattr(page.photometric, "name", str(page.photometric))
                if (kind, page.samplesperpixel) not in (("MINISBLACK", 1), ("RGB", 3)) or page.sampleformat != 1:
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
    # OpenCV goes on after a fault in an 8-bit TIFF and returns what it has, so zlib and its checksum are asked first.
    # Tiles at an edge are padded, and strips may all name the same bytes: four times the page is enough for all.
    left = 2**16 + page.imagewidth * page.imagelength * page.samplesperpixel * page.bitspersample // 2
    for offset, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        unpacked = _inflated(memoryview(data)[offset : offset + size], left)
        if unpacked is None:
            _refuse(path, f"sound data on page {index}", "data that cannot be unpacked", "copy the frame again")
        left -= len(unpacked)


def _decoded(data: bytes) -> Pixels | None:
    """The one image of a file whose header was checked; None where OpenCV cannot decode it."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _tiff_page(data: bytes, page: int) -> Pixels | None:
    pages = (page, page + 1)
    try:
        decoded, images = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED, None, pages)
    except cv2.error:
        # libtiff is stricter than the header's check in some tags.
        return None
    return images[0] if decoded and images else None


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
