"""Pixel formats: a buffer's bytes as a grey image, and in colour.

Bayer samples are raw, and turned to grey by OpenCV's interpolation: a stripe detector needs one brightness per pixel,
and under any light that is not white for this sensor the bare samples are a chequered pattern that it would take for
stripes. The interpolation costs resolution (each grey value is a mean over 3 x 3 pixels) and mixes red, green and blue
as 0.30, 0.59, 0.11; a monochrome sensor is the better choice. MJPG costs more: its blocks of 8 x 8 pixels are coarse.
Luma of YUV formats and MJPG is as the camera encodes it, in general not proportional to light; nor are their colours,
which come of luma and of differences of bent red, green and blue by the weights of Rec. 601, as JFIF has them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.v4l2 import jpeg
from slrig.model import Pixels, Size

Bytes = NDArray[np.uint8]


class CorruptFrameError(ValueError):
    """A buffer does not hold a whole frame. The message says what is wrong; the frame is passed over."""


class SamplePacking(StrEnum):
    """How samples lie in memory."""

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
    """How a pixel format is read. bayer : the first row's two colours and the second row's, None for grey.

    red_first : of two differences of colour, that of red comes before that of blue.
    """

    bit_depth: int
    packing: SamplePacking
    bayer: str | None = None
    red_first: bool = False

    @property
    def is_luma(self) -> bool:
        """Whether the samples are the luma of a colour image."""
        return self.packing in (SamplePacking.EVEN_BYTES, SamplePacking.ODD_BYTES, SamplePacking.JPEG)

    @property
    def has_colour(self) -> bool:
        """Whether `colour_image` reads it."""
        return self.bayer is not None or self.is_luma


def _layouts() -> dict[str, PixelLayout]:
    found = {
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
    # The kernel's four characters follow no rule here, so each is written out: 8, 10, 12, 16 bit, then packed 10, 12.
    kinds = (
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
        for code, (bit_depth, packing) in zip(codes, kinds, strict=True):
            found[code] = PixelLayout(bit_depth, packing, bayer)
    return found


LAYOUTS = _layouts()
"""Every pixel format that can be read, by its four characters."""

PREFERRED = (
    *("Y12 ", "Y12P", "Y10 ", "Y10P", "Y14 ", "GREY", "Y16 "),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth in (10, 12)),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth == 8),
    *(code for code, layout in LAYOUTS.items() if layout.bayer and layout.bit_depth == 16),
    *("YUYV", "UYVY", "YVYU", "VYUY", "MJPG", "JPEG"),
)
"""Which format is taken when none is asked for: linear before encoded, grey before colour, deep before shallow.

Y16 comes late: most sensors fill only some of its bits, and which of them no driver tells (option `bit_depth`).
"""

# OpenCV names a mosaic by the second row's second and third sample; these names are by the first pixel's.
_DEMOSAIC = {
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
}


def min_stride_bytes(layout: PixelLayout, size: Size) -> int:
    """Bytes that one row of samples takes, without padding; 0 for a compressed format."""
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


def prepare(layout: PixelLayout) -> None:
    """Do what takes long before frames come."""
    if layout.packing is SamplePacking.JPEG:
        jpeg.prepare()


def grey_image(
    data: Bytes, layout: PixelLayout, size: Size, *, stride_bytes: int, limited_luma: bool = False
) -> Pixels:
    """Return a buffer as an image of its own, (H, W), uint8 up to 8 bit and uint16 beyond, right-aligned.

    Parameters
    ----------
    data
        (n,) uint8: the bytes that the driver says it used.
    layout, size
        Of the pixel format.
    stride_bytes
        From one row to the next.
    limited_luma
        Spread luma from 16..235 to 0..255.

    Raises
    ------
    CorruptFrameError
        Bytes are missing, or the JPEG is damaged.
    """
    if layout.packing is SamplePacking.JPEG:
        image = _decode_jpeg(data, size, cv2.IMREAD_GRAYSCALE)
    else:
        image = _UNPACK[layout.packing](_rows(data, layout, size, stride_bytes), size)
    if layout.bayer is not None:
        image = np.asarray(cv2.cvtColor(image, _DEMOSAIC[layout.bayer]))
    if limited_luma and layout.is_luma:
        image = _SPREAD[image]
    return image


def colour_image(
    data: Bytes, layout: PixelLayout, size: Size, *, stride_bytes: int, limited_luma: bool = False
) -> Pixels:
    """Return a buffer of a layout that `has_colour` as (H, W, 3), blue, green and red, of `grey_image`'s type.
    Parameters, and what is raised, as there.
    """
    if layout.packing is SamplePacking.JPEG:
        image = _decode_jpeg(data, size, cv2.IMREAD_COLOR)
    else:
        rows = _rows(data, layout, size, stride_bytes)
        image = _UNPACK[layout.packing](rows, size)
        if layout.bayer is not None:
            return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_Bayer{layout.bayer}2BGR")))
        first = 1 if layout.packing is SamplePacking.EVEN_BYTES else 0
        image = bgr_from_luma(
            image, *(rows[:, first + 2 * (second != layout.red_first) :: 4] for second in (False, True))
        )
    return _SPREAD[image] if limited_luma else image


def bgr_from_luma(luma: Pixels, blue: Bytes, red: Bytes) -> Pixels:
    """(H, W, 3) uint8, blue, green and red, of luma (H, W) and of the differences of blue and red, of fewer rows or
    columns: full range, 128 is none.
    """
    planes = [
        cv2.resize(np.ascontiguousarray(each), luma.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for each in (red, blue)
    ]
    return np.asarray(cv2.cvtColor(cv2.merge([luma, *planes]), cv2.COLOR_YCrCb2BGR), dtype=np.uint8)


def _rows(data: Bytes, layout: PixelLayout, size: Size, stride_bytes: int) -> Bytes:
    """(H, least stride): the bytes of each row without padding; the last row may come without."""
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

_SPREAD: NDArray[np.uint8] = np.clip(np.rint((np.arange(256) - 16.0) * 255 / 219), 0, 255).astype(np.uint8)


def _decode_jpeg(data: Bytes, size: Size, flag: int) -> Pixels:
    if len(data) < 4 or data[0] != 0xFF or data[1] != 0xD8:
        message = f"{len(data)} bytes came that do not begin as a JPEG does"
        raise CorruptFrameError(message)
    fault = jpeg.fault_of(data)
    if fault:
        message = f"the JPEG is damaged: {fault}"
        raise CorruptFrameError(message)
    image = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape[:2] != size.shape:
        found = "nothing" if image is None else f"{image.shape[1]} x {image.shape[0]}"
        message = f"the JPEG decodes to {found}, expected {size}"
        raise CorruptFrameError(message)
    return np.asarray(image, dtype=np.uint8)
