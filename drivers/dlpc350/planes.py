"""Bit planes: 24 of them as a picture for the engine's flash.

Plane n of a picture is bit n of green for n = 0 to 7, bit n - 8 of red up to 15, bit n - 16 of blue up to 23, the least
significant first: DLPU010, "Pattern Number Mapping", as copied at github.com/agmarrugo/bit-plane-image-coding; and the
LightCrafter 4500 user's guide (DLPU011), "Relationship Between Bit-Planes and 24-bit RGB Images". TI's program takes
pictures of 912 x 1140 pixels with 24 bits per pixel.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.pattern_engine.planes import Plane
from slrig.errors import ConfigError
from slrig.model import Size

MIRRORS = Size(912, 1140)
"""Columns and rows of the DLP4500, addressed as the controller addresses them."""
PLANES = 24

_FILE_HEADER = struct.Struct("<2sIHHI")
_PICTURE_HEADER = struct.Struct("<IiiHHIIiiII")
_CHANNELS = (1, 2, 0)
"""Where green, red and blue lie in a BMP's pixel."""


def encode_picture(planes: Sequence[Plane]) -> bytes:
    """Return up to 24 planes as a BMP file of 24 bits per pixel; those that are left are dark."""
    pixels = np.zeros((*MIRRORS.shape, 3), np.uint8)
    for number, plane in enumerate(planes):
        pixels[..., _CHANNELS[number // 8]] |= plane.astype(np.uint8) << np.uint8(number % 8)
    # Rows from the bottom up; 912 pixels of 3 bytes fill whole words.
    data = pixels[::-1].tobytes()
    offset = _FILE_HEADER.size + _PICTURE_HEADER.size
    header = _PICTURE_HEADER.pack(40, MIRRORS.width_px, MIRRORS.height_px, 1, 24, 0, len(data), 2835, 2835, 0, 0)
    return _FILE_HEADER.pack(b"BM", offset + len(data), 0, 0, offset) + header + data


def decode_planes(picture: bytes, name: str) -> tuple[Plane, ...]:
    """Return the 24 planes of a BMP file. Raises ConfigError, naming it, if it is none of 912 x 1140 with 24 bits."""
    least = _FILE_HEADER.size + _PICTURE_HEADER.size
    kind, offset, width, height, bits, packing = b"", 0, 0, 0, 0, 0
    if len(picture) >= least:
        kind, _, _, _, offset = _FILE_HEADER.unpack_from(picture)
        _, width, height, _, bits, packing, *_ = _PICTURE_HEADER.unpack_from(picture, _FILE_HEADER.size)
    rows, columns = MIRRORS.shape
    size = rows * columns * 3
    fits = (kind, width, abs(height), bits, packing) == (b"BM", columns, rows, 24, 0)
    if not fits or len(picture) < offset + size:
        message = (
            f"{name}: expected a BMP file of {MIRRORS} pixels with 24 bits each, found {width} x {height} with {bits} "
            f"bits, {len(picture)} bytes; take the one that this driver wrote"
        )
        raise ConfigError(message)
    pixels = np.frombuffer(picture, np.uint8, size, offset).reshape(rows, columns, 3)
    upright: NDArray[Any] = pixels[::-1] if height > 0 else pixels
    channels = [np.ascontiguousarray(upright[..., channel]) for channel in _CHANNELS]
    return tuple(channels[number // 8] & np.uint8(1 << number % 8) != 0 for number in range(PLANES))
