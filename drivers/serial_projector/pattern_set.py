"""The checksum of a pattern sequence, and the files from which a light engine's flash and its box are filled.

A box steps through what was flashed and cannot be sent an image, so host and box compare checksums. A pattern's is the
CRC-32 (ISO-HDLC, zlib's) of its image: one byte per pixel, 0 to 255, row by row from the top left. A sequence's is the
CRC-32 of those of its patterns in their order, four bytes each, most significant first: a box that holds one number per
pattern can tell the checksum of any run of them.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels

DESCRIPTION = "patterns.json"


def pattern_checksum(image: Pixels) -> int:
    """CRC-32 of one pattern's image, (H, W) uint8.

    >>> hex(pattern_crc32(np.array([[0, 255], [255, 0]], np.uint8)))
    '0xcf81683'
    """
    return zlib.crc32(image.tobytes())


def pattern_checksums(sequence: PatternSequence) -> tuple[int, ...]:
    """CRC-32 of every pattern of a sequence.

    Raises
    ------
    UnsupportedByDeviceError
        A pattern has more than 8 bits.
    """
    deep = [index for index, profile in enumerate(sequence.profiles) if profile.dtype != np.uint8]
    if deep:
        message = f"patterns {deep} have more than 8 bits, a pattern set for a trigger box has 8; encode them with 8"
        raise UnsupportedByDeviceError(message)
    return tuple(pattern_checksum(sequence.image(index)) for index in range(len(sequence)))


def sequence_checksum(each: Sequence[int]) -> int:
    """CRC-32 of a sequence, from those of its patterns.

    >>> f"{crc32_of_all([0x0CF81683, 0x00000000]):08X}"
    '46D5955C'
    """
    return zlib.crc32(b"".join(crc32.to_bytes(4, "big") for crc32 in each))


def export_patterns(sequence: PatternSequence, folder: Path) -> None:
    """Write the images for the light engine's flash, `000.png` …, and `patterns.json` for the box.

    Raises
    ------
    DeviceError
        The folder cannot be written.
    UnsupportedByDeviceError
        A pattern has more than 8 bits.
    """
    size = sequence.projector
    each = pattern_checksums(sequence)
    description = {
        "size_px": [size.width_px, size.height_px],
        "crc32": [f"{crc32:08X}" for crc32 in each],
        "crc32_of_all": f"{sequence_checksum(each):08X}",
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(len(sequence)):
            encoded, png = cv2.imencode(".png", np.ascontiguousarray(sequence.image(index)))
            if not encoded:
                message = f"pattern {index} could not be encoded as PNG; report it"
                raise DeviceError(message)
            (folder / f"{index:03d}.png").write_bytes(png.tobytes())
        (folder / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        message = f"export_folder: {folder} cannot be written ({error}); name another folder"
        raise DeviceError(message) from error
