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
"""Bytes allowed between the last block of a JPEG and its end marker: some cameras leave a few there."""


class CorruptFrameError(ValueError):
    """A buffer does not hold a whole frame, for the cause in the message; the frame is skipped."""


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
    JPEG = "jpeg"


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Layout of a pixel format. bayer : the first row's two colours and the second row's, None for grey.

    red_first : the colour difference of red comes before that of blue.
    """

    bit_depth: int
    packing: SamplePacking
    bayer: str | None = None
    red_first: bool = False

    @property
    def is_luma(self) -> bool:
        """True if the samples are the luma of a colour image."""
        return self.packing in (SamplePacking.EVEN_BYTES, SamplePacking.ODD_BYTES, SamplePacking.JPEG)

    @property
    def has_colour(self) -> bool:
        """True if `colour_image` can read it."""
        return self.bayer is not None or self.is_luma


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
    *("YUYV", "UYVY", "YVYU", "VYUY", "MJPG", "JPEG"),
)
"""Order in which formats are preferred: linear before encoded, grey before colour, deep before shallow.

Y16 comes late: most sensors fill only some of its bits, and drivers do not report which (option `bit_depth`).
"""


_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def min_stride_bytes(layout: PixelLayout, size: Size) -> int:
    """Return the bytes of one row of samples without padding; 0 for a compressed format."""
    width = size.width_px
    match layout.packing:
        case SamplePacking.BYTES:
            return width
        case SamplePacking.WORDS | SamplePacking.EVEN_BYTES | SamplePacking.ODD_BYTES:
            return 2 * width
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
        Bytes are missing, or the JPEG is damaged.
    """
    if layout.packing is SamplePacking.JPEG:
        image = _decode_jpeg(data, size, "GRAY")[..., 0]
    else:
        image = _UNPACK[layout.packing](_rows(data, layout, size, stride_bytes), size)
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
    else:
        rows = _rows(data, layout, size, stride_bytes)
        image = _UNPACK[layout.packing](rows, size)
        if layout.bayer is not None:
            return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_Bayer{layout.bayer}2BGR")))
        first = 1 if layout.packing is SamplePacking.EVEN_BYTES else 0
        blue, red = (rows[:, first + 2 * (second != layout.red_first) :: 4] for second in (False, True))
        image = bgr_from_luma(image, blue, red)
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


def _rows(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> Bytes:
    """Return the bytes of each row without padding, (H, smallest stride); the last row may come without padding."""
    used = min_stride_bytes(layout, size)
    stride = max(stride_bytes, used)
    needed = stride * (size.height_px - 1) + used
    if len(data) < needed:
        message = f"{len(data)} bytes of {needed} came"
        raise CorruptFrameError(message)
    return np.lib.stride_tricks.as_strided(data, (size.height_px, used), (stride, 1), writeable=False)


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
        if stray is not None and int(stray[1]) <= _MAX_STRAY_BYTES:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace, strict=False))
        if _NO_END in str(error) and data[-2:].tobytes() != _JPEG_END:
            # Some cameras leave the end marker out; data that end early are found with it, too.
            return _decode_jpeg(np.append(data, np.frombuffer(_JPEG_END, np.uint8)), size, colorspace)
        message = f"the JPEG is damaged: {error}"
        raise CorruptFrameError(message) from error
    message = f"the JPEG decodes to {width_px} x {height_px}, expected {size}"
    raise CorruptFrameError(message)
