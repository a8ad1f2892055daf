"""Pixel formats: a buffer's bytes as a grey image and as a colour image.

OpenCV's interpolation makes raw Bayer samples grey: stripe detection needs one brightness per pixel, and under any
light that is not white for this sensor the raw samples are a chequered pattern. The interpolation costs resolution
(each grey value is a mean over 3 x 3 pixels) and mixes red, green and blue as 0.30, 0.59, 0.11; a monochrome sensor is
the better choice. MJPG costs more: its blocks of 8 x 8 pixels are coarse. Luma of YUV formats and MJPG is as the camera
encodes it, in general not proportional to light. Their colours are computed from luma and colour differences by the
weights of Rec. 601, as JFIF defines them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from slrig.model import Pixels, Size

Bytes = NDArray[np.uint8]


# OpenCV names a mosaic by the second row's second and third sample; these names are by the first pixel's.
_DEMOSAIC = {
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
}
_FULL_RANGE: NDArray[np.uint8] = np.clip(np.rint((np.arange(256) - 16.0) * 255 / 219), 0, 255).astype(np.uint8)
"""Luma of 16..235 as 0..255."""
_NO_END = "Premature end of JPEG file"
_STRAY_BYTES = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MAX_STRAY_BYTES = 16
"""Bytes allowed between the last block of a JPEG and its end marker: some cameras leave a few there. Zeros are padding,
however many."""


class CorruptFrameError(ValueError):
    """A buffer does not hold a whole frame, for the cause in the message; the frame is skipped."""


class PaddedFrameError(CorruptFrameError):
    """A JPEG has bytes between its last block and its end: it was damaged, or its camera pads every frame so."""


class SamplePacking(StrEnum):
    """Arrangement of samples in memory."""

    BYTES = "bytes"
    WORDS = "words"
    """Two bytes, little endian, right-aligned."""
    MIPI10 = "mipi10"
    """Four samples' upper eight bits, then a byte with the lower two bits of each."""
    MIPI12 = "mipi12"
    """Two samples' upper eight bits, then a byte with the lower four bits of each."""
    EVEN_BYTES = "even bytes"
    """Luma first: Y U Y V."""
    ODD_BYTES = "odd bytes"
    """Colour first: U Y V Y."""
    PLANE_AND_PAIRS = "plane and pairs"
    """All luma, then U V U V with half as many rows."""
    PLANES = "planes"
    """All luma, then all U and all V, each with half as many rows and columns, and half the stride."""
    TRIPLES = "triples"
    """Three colours, one byte each."""
    JPEG = "jpeg"


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Layout of a pixel format. bayer : the first row's two colours and the second row's, None for grey.

    red_first : red, or its colour difference, comes before blue. shift : bits by which 16-bit words hold their samples
    shifted up.
    """

    bit_depth: int
    packing: SamplePacking
    bayer: str | None = None
    red_first: bool = False
    shift: int = 0

    @property
    def is_luma(self) -> bool:
        """True if the samples are the luma of a colour image."""
        return self.packing in _COLOUR_DIFFERENCES or self.packing is SamplePacking.JPEG

    @property
    def has_colour(self) -> bool:
        """True if `colour_image` can read it."""
        return self.bayer is not None or self.is_luma or self.packing is SamplePacking.TRIPLES


def _layouts() -> dict[str, PixelLayout]:
    layouts = {
        "GREY": PixelLayout(8, SamplePacking.BYTES),
        "Y10 ": PixelLayout(10, SamplePacking.WORDS),
        "Y12 ": PixelLayout(12, SamplePacking.WORDS),
        "Y14 ": PixelLayout(14, SamplePacking.WORDS),
        "Y16 ": PixelLayout(16, SamplePacking.WORDS),
        "Y10P": PixelLayout(10, SamplePacking.MIPI10),
        "Y12P": PixelLayout(12, SamplePacking.MIPI12),
        "YUYV": PixelLayout(8, SamplePacking.EVEN_BYTES),
        "YVYU": PixelLayout(8, SamplePacking.EVEN_BYTES, red_first=True),
        "UYVY": PixelLayout(8, SamplePacking.ODD_BYTES),
        "VYUY": PixelLayout(8, SamplePacking.ODD_BYTES, red_first=True),
        "NV12": PixelLayout(8, SamplePacking.PLANE_AND_PAIRS),
        "NV21": PixelLayout(8, SamplePacking.PLANE_AND_PAIRS, red_first=True),
        "YU12": PixelLayout(8, SamplePacking.PLANES),
        "YV12": PixelLayout(8, SamplePacking.PLANES, red_first=True),
        "RGB3": PixelLayout(8, SamplePacking.TRIPLES, red_first=True),
        "BGR3": PixelLayout(8, SamplePacking.TRIPLES),
        "MJPG": PixelLayout(8, SamplePacking.JPEG),
        "JPEG": PixelLayout(8, SamplePacking.JPEG),
    }
    # The kernel's codes of Bayer formats follow no rule: 8, 10, 12, 16 bit, then packed 10, 12.
    packings = (
        (8, SamplePacking.BYTES),
        (10, SamplePacking.WORDS),
        (12, SamplePacking.WORDS),
        (16, SamplePacking.WORDS),
        (10, SamplePacking.MIPI10),
        (12, SamplePacking.MIPI12),
    )
    for bayer, codes in {
        "BGGR": ("BA81", "BG10", "BG12", "BYR2", "pBAA", "pBCC"),
        "GBRG": ("GBRG", "GB10", "GB12", "GB16", "pGAA", "pGCC"),
        "GRBG": ("GRBG", "BA10", "BA12", "GR16", "pgAA", "pgCC"),
        "RGGB": ("RGGB", "RG10", "RG12", "RG16", "pRAA", "pRCC"),
    }.items():
        for code, (bit_depth, packing) in zip(codes, packings, strict=True):
            layouts[code] = PixelLayout(bit_depth, packing, bayer)
    return layouts


LAYOUTS = _layouts()
"""Every pixel format that can be read, by its four characters."""

PREFERRED = (
    *("Y12 ", "Y12P", "Y10 ", "Y10P", "Y14 ", "GREY", "Y16 "),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth in (10, 12)),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth == 8),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth == 16),
    *("YUYV", "UYVY", "YVYU", "VYUY", "NV12", "NV21", "YU12", "YV12", "RGB3", "BGR3", "MJPG", "JPEG"),
)
"""Order in which formats are preferred: linear before encoded, grey before colour, deep before shallow.

Y16 comes late: most sensors fill only some of its bits, and drivers do not report which (option `bit_depth`).
"""


_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def min_stride_bytes(layout: PixelLayout, size: Size) -> int:
    """Return the bytes of one row of samples without padding; 0 for a compressed format."""
    width = size.width_px
    match layout.packing:
        case SamplePacking.BYTES | SamplePacking.PLANE_AND_PAIRS | SamplePacking.PLANES:
            return width
        case SamplePacking.WORDS | SamplePacking.EVEN_BYTES | SamplePacking.ODD_BYTES:
            return 2 * width
        case SamplePacking.TRIPLES:
            return 3 * width
        case SamplePacking.MIPI10:
            return (width + 3) // 4 * 5
        case SamplePacking.MIPI12:
            return (width + 1) // 2 * 3
        case SamplePacking.JPEG:
            return 0


def grey_image(
    data: Bytes, layout: PixelLayout, size: Size, *, stride_bytes: int, limited_luma: bool = False
) -> Pixels:
    """Convert a buffer to a grey image, (H, W), uint8 up to 8 bit and uint16 beyond, right-aligned.

    Parameters
    ----------
    data
        (n,) uint8: the bytes that the driver reports as used.
    layout, size
        Of the pixel format.
    stride_bytes
        From one row to the next.
    limited_luma
        Expand luma from 16..235 to 0..255.

    Raises
    ------
    CorruptFrameError
        Bytes are missing, samples exceed the bit depth, or the JPEG is damaged.
    """
    if layout.packing is SamplePacking.JPEG:
        image = _decode_jpeg(data, size, "GRAY")[..., 0]
    elif layout.packing is SamplePacking.TRIPLES:
        image = np.asarray(cv2.cvtColor(_triples(data, layout, size, stride_bytes), cv2.COLOR_BGR2GRAY))
    else:
        image = _samples(data, layout, size, stride_bytes)
    if layout.bayer is not None:
        image = np.asarray(cv2.cvtColor(image, _DEMOSAIC[layout.bayer]))
    if limited_luma and layout.is_luma:
        image = _FULL_RANGE[image]
    return image


def colour_image(
    data: Bytes, layout: PixelLayout, size: Size, *, stride_bytes: int, limited_luma: bool = False
) -> Pixels:
    """Convert a buffer of a layout that `has_colour` to (H, W, 3), blue, green, red. See `grey_image`."""
    if layout.packing is SamplePacking.JPEG:
        image = _decode_jpeg(data, size, "BGR")
    elif layout.packing is SamplePacking.TRIPLES:
        return _triples(data, layout, size, stride_bytes).copy()
    else:
        image = _samples(data, layout, size, stride_bytes)
        if layout.bayer is not None:
            return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_Bayer{layout.bayer}2BGR")))
        blue, red = _COLOUR_DIFFERENCES[layout.packing](data, layout, size, stride_bytes)
        image = bgr_from_luma(image, *((red, blue) if layout.red_first else (blue, red)))
    return _FULL_RANGE[image] if limited_luma else image


def bgr_from_luma(luma: Pixels, blue: Bytes, red: Bytes) -> Pixels:
    """Convert luma, (H, W), and full-range colour differences to (H, W, 3) uint8, blue, green, red.

    blue, red : differences with 128 for none; they may have fewer rows and columns.
    """
    planes = [
        cv2.resize(np.ascontiguousarray(each), luma.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for each in (red, blue)
    ]
    return np.asarray(cv2.cvtColor(cv2.merge([luma, *planes]), cv2.COLOR_YCrCb2BGR), dtype=np.uint8)


def _plane(data: Bytes, shape: tuple[int, int], stride_bytes: int, first: int = 0) -> Bytes:
    """Return a view of (rows, bytes) that begin at `first`; the last row may come without its padding."""
    rows, used = shape
    stride = max(stride_bytes, used)
    needed = first + stride * (rows - 1) + used
    if len(data) < needed:
        message = f"{len(data)} bytes of {needed} came"
        raise CorruptFrameError(message)
    return np.lib.stride_tricks.as_strided(data[first:], shape, (stride, 1), writeable=False)


def _rows(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> Bytes:
    return _plane(data, (size.height_px, min_stride_bytes(layout, size)), stride_bytes)


def _samples(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> Pixels:
    if layout.packing in _COLOUR_DIFFERENCES:
        # Whether they are whole: grey images are made of luma alone.
        _COLOUR_DIFFERENCES[layout.packing](data, layout, size, stride_bytes)
    image = _UNPACK[layout.packing](_rows(data, layout, size, stride_bytes), size)
    if layout.packing is not SamplePacking.WORDS or layout.bit_depth == 16:
        return image
    image >>= layout.shift
    largest = int(image.max())
    if largest >> layout.bit_depth:
        message = (
            f"a sample of {largest} came, and {layout.bit_depth} bits hold {2**layout.bit_depth - 1} at most: this "
            f"receiver stores samples shifted up, as those of Jetson do; write sample_shift = {16 - layout.bit_depth}, "
            "or the shift in its documents"
        )
        raise CorruptFrameError(message)
    return image


def _triples(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> Bytes:
    """Return a view of (H, W, 3), blue, green, red."""
    image = _rows(data, layout, size, stride_bytes).reshape(*size.shape, 3)
    return image[..., ::-1] if layout.red_first else image


def _from_rows(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> tuple[Bytes, Bytes]:
    rows = _rows(data, layout, size, stride_bytes)
    first = 1 if layout.packing is SamplePacking.EVEN_BYTES else 0
    return rows[:, first::4], rows[:, first + 2 :: 4]


def _from_pairs(data: Bytes, _layout: PixelLayout, size: Size, stride_bytes: int) -> tuple[Bytes, Bytes]:
    stride = max(stride_bytes, size.width_px)
    shape = ((size.height_px + 1) // 2, (size.width_px + 1) // 2 * 2)
    pairs = _plane(data, shape, stride, stride * size.height_px)
    return pairs[:, ::2], pairs[:, 1::2]


def _from_planes(data: Bytes, _layout: PixelLayout, size: Size, stride_bytes: int) -> tuple[Bytes, Bytes]:
    stride = max(stride_bytes, size.width_px)
    shape, half, first = (
        ((size.height_px + 1) // 2, (size.width_px + 1) // 2),
        (stride + 1) // 2,
        stride * size.height_px,
    )
    return _plane(data, shape, half, first), _plane(data, shape, half, first + half * shape[0])


_COLOUR_DIFFERENCES: dict[SamplePacking, Callable[[Bytes, PixelLayout, Size, int], tuple[Bytes, Bytes]]] = {
    SamplePacking.EVEN_BYTES: _from_rows,
    SamplePacking.ODD_BYTES: _from_rows,
    SamplePacking.PLANE_AND_PAIRS: _from_pairs,
    SamplePacking.PLANES: _from_planes,
}
"""Views of the first and the second colour difference of each packing; they raise CorruptFrameError."""


def _from_bytes(rows: Bytes, size: Size) -> Pixels:
    return rows[:, : size.width_px].copy()


def _from_words(rows: Bytes, size: Size) -> Pixels:
    return np.ascontiguousarray(rows).view("<u2").astype(np.uint16)[:, : size.width_px]


def _from_mipi10(rows: Bytes, size: Size) -> Pixels:
    groups = rows.reshape(size.height_px, -1, 5).astype(np.uint16)
    low = groups[..., 4:] >> np.array([0, 2, 4, 6], np.uint16) & 3
    return np.ascontiguousarray((groups[..., :4] << 2 | low).reshape(size.height_px, -1)[:, : size.width_px])


def _from_mipi12(rows: Bytes, size: Size) -> Pixels:
    groups = rows.reshape(size.height_px, -1, 3).astype(np.uint16)
    low = groups[..., 2:] >> np.array([0, 4], np.uint16) & 15
    return np.ascontiguousarray((groups[..., :2] << 4 | low).reshape(size.height_px, -1)[:, : size.width_px])


def _from_even_bytes(rows: Bytes, size: Size) -> Pixels:
    return np.ascontiguousarray(rows[:, 0 : 2 * size.width_px : 2])


def _from_odd_bytes(rows: Bytes, size: Size) -> Pixels:
    return np.ascontiguousarray(rows[:, 1 : 2 * size.width_px : 2])


_UNPACK: dict[SamplePacking, Callable[[Bytes, Size], Pixels]] = {
    SamplePacking.BYTES: _from_bytes,
    SamplePacking.PLANE_AND_PAIRS: _from_bytes,
    SamplePacking.PLANES: _from_bytes,
    SamplePacking.WORDS: _from_words,
    SamplePacking.MIPI10: _from_mipi10,
    SamplePacking.MIPI12: _from_mipi12,
    SamplePacking.EVEN_BYTES: _from_even_bytes,
    SamplePacking.ODD_BYTES: _from_odd_bytes,
}


def _decode_jpeg(data: Bytes, size: Size, colorspace: str) -> Pixels:
    """Decode a whole JPEG to (H, W, 1 or 3). Raises CorruptFrameError where a decoder would fill in lost data."""
    if data[:2].tobytes() != _JPEG_START:
        message = f"{len(data)} bytes came that do not begin as a JPEG does"
        raise CorruptFrameError(message)
    try:
        height_px, width_px, *_ = simplejpeg.decode_jpeg_header(data, strict=True)
        if (height_px, width_px) == size.shape:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace, strict=True))
    except ValueError as error:
        stray = _STRAY_BYTES.search(str(error))
        if stray is not None:
            count = int(stray[1])
            if count <= _MAX_STRAY_BYTES or not _before_end(data, count).any():
                return np.asarray(simplejpeg.decode_jpeg(data, colorspace, strict=False))
            message = f"{count} bytes are between the last block of the JPEG and its end"
            raise PaddedFrameError(message) from error
        if _NO_END in str(error) and data[-2:].tobytes() != _JPEG_END:
            # Some cameras leave the end marker out; data that end early are found with it, too.
            return _decode_jpeg(np.append(data, np.frombuffer(_JPEG_END, np.uint8)), size, colorspace)
        message = f"the JPEG is damaged: {error}"
        raise CorruptFrameError(message) from error
    message = f"the JPEG decodes to {width_px} x {height_px}, expected {size}"
    raise CorruptFrameError(message)


def _before_end(data: Bytes, count: int) -> Bytes:
    """Return the bytes before the last end marker."""
    end = data.tobytes().rfind(_JPEG_END)
    return data[max(end - count, 0) : end]
