"""Pixel formats of the PFNC (Pixel Format Naming Convention), decoded to grey and to colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import Pixels, Size

Bytes = NDArray[np.uint8]


_GREY_CONVERSIONS = {
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "RGB": cv2.COLOR_RGB2GRAY,
    "BGR": cv2.COLOR_BGR2GRAY,
}


class PixelPacking(Enum):
    """Layout of samples in memory: each in 8 or 16 bits (little endian, right aligned), or packed.

    `LSB` is PFNC's "p": a stream of bits, least significant first. `GIGE` is GigE Vision's "Packed": of two samples,
    the high bits are bytes 0 and 2, and their low bits share byte 1.
    """

    BYTE = 1
    WORD = 2
    LSB = 3
    GIGE = 4


@dataclass(frozen=True, slots=True)
class PfncFormat:
    """Format: bits per sample, packing, and colours. `mosaic` is "" for grey, a Bayer pattern such as RGGB, or RGB or
    BGR.
    """

    name: str
    bit_depth: int
    packing: PixelPacking
    mosaic: str = ""

    @property
    def samples(self) -> int:
        """Samples per pixel."""
        return 3 if self.mosaic in {"RGB", "BGR"} else 1

    def size_bytes(self, size: Size) -> int:
        """Number of bytes of an image."""
        count = size.width_px * size.height_px * self.samples
        bits = {
            PixelPacking.BYTE: 8,
            PixelPacking.WORD: 16,
            PixelPacking.LSB: self.bit_depth,
            PixelPacking.GIGE: 12,
        }[self.packing]
        return -(-count * bits // 8)


def _build_formats() -> Mapping[str, PfncFormat]:
    mosaics = {"Mono": "", "BayerRG": "RGGB", "BayerGR": "GRBG", "BayerGB": "GBRG", "BayerBG": "BGGR"}
    found = []
    for family, mosaic in mosaics.items():
        found.append(PfncFormat(f"{family}8", 8, PixelPacking.BYTE, mosaic))
        found += [PfncFormat(f"{family}{depth}", depth, PixelPacking.WORD, mosaic) for depth in (10, 12, 14, 16)]
        found += [PfncFormat(f"{family}{depth}p", depth, PixelPacking.LSB, mosaic) for depth in (10, 12)]
        found += [PfncFormat(f"{family}{depth}Packed", depth, PixelPacking.GIGE, mosaic) for depth in (10, 12)]
    found += [PfncFormat("RGB8", 8, PixelPacking.BYTE, "RGB"), PfncFormat("BGR8", 8, PixelPacking.BYTE, "BGR")]
    return {form.name: form for form in found}


FORMATS: Mapping[str, PfncFormat] = _build_formats()
"""Every supported format by its PFNC name."""


def decode_pixels(
    data: bytes, form: PfncFormat, size: Size, *, padding_bytes: int = 0, in_colour: bool = False
) -> Pixels:
    """Decode the image in a buffer: (H, W) uint8 or uint16, or with in_colour (H, W, 3), blue, green and red.

    A Bayer mosaic is interpolated and converted to luma (OpenCV), so a mono camera is sharper. Samples beyond the bit
    depth are clipped; `padding_bytes` follow every row of an unpacked format.

    Raises
    ------
    ValueError
        The buffer is too short, or pads the rows of a packed format.
    """
    if form.packing in {PixelPacking.LSB, PixelPacking.GIGE}:
        if padding_bytes:
            message = f"{form.name}: rows are padded by {padding_bytes} bytes, which a packed format cannot be"
            raise ValueError(message)
        packed = _take_bytes(data, form.size_bytes(size), form)
        flat = (
            _unpack_lsb(packed, form.bit_depth)
            if form.packing is PixelPacking.LSB
            else _unpack_gige(packed, form.bit_depth)
        )
        image: Pixels = flat[: size.width_px * size.height_px].reshape(size.shape)
    else:
        row_bytes = size.width_px * form.samples * form.packing.value
        stride = row_bytes + padding_bytes
        raw = _take_bytes(data, stride * size.height_px - padding_bytes, form)
        # The last row need not be padded.
        padded = np.concatenate([raw, np.zeros(padding_bytes, np.uint8)]) if padding_bytes else raw
        rows = np.ascontiguousarray(padded.reshape(size.height_px, stride)[:, :row_bytes])
        if form.packing is PixelPacking.WORD:
            image = np.minimum(rows.view("<u2"), np.uint16(2**form.bit_depth - 1))
        else:
            image = rows
    if not form.mosaic:
        return image
    if form.samples > 1:
        image = image.reshape(*size.shape, form.samples)
    if not in_colour:
        return np.asarray(cv2.cvtColor(image, _GREY_CONVERSIONS[form.mosaic]))
    if form.samples > 1:
        return image if form.mosaic == "BGR" else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_Bayer{form.mosaic}2BGR")))


def _take_bytes(data: bytes, count: int, form: PfncFormat) -> Bytes:
    if len(data) < count:
        message = f"{form.name}: expected {count} bytes, found {len(data)}"
        raise ValueError(message)
    return np.frombuffer(data, np.uint8, count)


def _byte_groups(packed: Bytes, group: int) -> NDArray[np.uint16]:
    """(n, group) uint16: the bytes in groups of padded samples; the last group is padded with zeros."""
    short = -len(packed) % group
    padded = np.concatenate([packed, np.zeros(short, np.uint8)]) if short else packed
    return padded.reshape(-1, group).astype(np.uint16)


def _unpack_lsb(packed: Bytes, bit_depth: int) -> NDArray[np.uint16]:
    if bit_depth == 12:
        low, middle, high = _byte_groups(packed, 3).T
        return np.stack([low | (middle & 0x0F) << 8, middle >> 4 | high << 4], axis=1).ravel()
    a, b, c, d, e = _byte_groups(packed, 5).T
    samples = [a | (b & 0x03) << 8, b >> 2 | (c & 0x0F) << 6, c >> 4 | (d & 0x3F) << 4, d >> 6 | e << 2]
    return np.stack(samples, axis=1).ravel()


def _unpack_gige(packed: Bytes, bit_depth: int) -> NDArray[np.uint16]:
    first, low, second = _byte_groups(packed, 3).T
    bits = bit_depth - 8
    mask = (1 << bits) - 1
    return np.stack([first << bits | low & mask, second << bits | low >> 4 & mask], axis=1).ravel()
