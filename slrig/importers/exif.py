"""The focal length that a picture states of the camera that took it, in its EXIF tags.

The 35 mm equivalent is the focal length of the same angle of view along the diagonal of 36 x 24 mm (CIPA DCG-001).
Names of tags and types are those of EXIF 2.32 (CIPA DC-008) and TIFF 6.0.
"""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path

from slrig.model import Size

_FILM_DIAGONAL_MM = math.hypot(36, 24)
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit; inches where it is absent
_POINTER, _FOCAL, _FILM_FOCAL, _ZOOM = 0x8769, 0x920A, 0xA405, 0xA404
_PLANE_RESOLUTION, _PLANE_UNIT, _WIDTH, _HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
_FORMATS = {3: "H", 4: "L", 5: "LL"}  # SHORT, LONG, RATIONAL
_MAX_HEAD_BYTES, _MAX_BYTES, _MAX_TAGS = 2**17, 2**26, 500
_SAME_SHAPE = 0.01  # relative
_PLAUSIBLE = (0.1, 100.0)  # focal length over the diagonal of the picture


def read_focal_px(path: Path, size: Size) -> float | None:
    """Focal length in pixels that the file of a picture of this extent states; None where it states none, is damaged,
    or shows a part of what the lens saw: cropped or zoomed pictures have another principal point.
    """
    with path.open("rb") as file:
        data = file.read(_MAX_HEAD_BYTES)
        if data.startswith((b"II", b"MM")):
            # A TIFF may have its directories behind its pixels.
            data += file.read(_MAX_BYTES)
        else:
            found = re.search(rb"\xff\xe1..Exif\0\0", data, re.DOTALL) if data.startswith(b"\xff\xd8") else None
            data = data[found.end() :] if found else b""
    try:
        return _focal_px(_read_tags(data), size)
    except (struct.error, ArithmeticError, ValueError):
        return None


def _read_tags(data: bytes) -> dict[int, float]:
    """Numbers of the first directory and of its EXIF directory. Raises struct.error: it is damaged."""
    order = "<" if data[:2] == b"II" else ">"
    tags: dict[int, float] = {}
    (place,) = struct.unpack_from(f"{order}L", data, 4)
    for _ in range(2):
        (count,) = struct.unpack_from(f"{order}H", data, place)
        for index in range(min(count, _MAX_TAGS)):
            at = place + 2 + 12 * index
            tag, kind, length = struct.unpack_from(f"{order}HHL", data, at)
            if kind not in _FORMATS or length != 1:
                continue
            form = order + _FORMATS[kind]
            (start,) = struct.unpack_from(f"{order}L", data, at + 8) if kind == 5 else (at + 8,)
            value = struct.unpack_from(form, data, start)
            tags[tag] = value[0] / value[1] if len(value) == 2 and value[1] else value[0] if len(value) == 1 else 0.0
        place = int(tags.pop(_POINTER, 0))
        if not place:
            break
    return tags


def _focal_px(tags: dict[int, float], size: Size) -> float | None:
    # A picture may be stored upright, and its sides told as the sensor has them.
    short, long = sorted((size.width_px, size.height_px))
    recorded_short, recorded_long = sorted((tags.get(_WIDTH) or size.width_px, tags.get(_HEIGHT) or size.height_px))
    shape = recorded_long / recorded_short * short / long
    if abs(shape - 1) > _SAME_SHAPE or tags.get(_ZOOM, 0) > 1 + _SAME_SHAPE:
        return None
    diagonal = math.hypot(short, long)
    focal = tags.get(_FILM_FOCAL, 0) / _FILM_DIAGONAL_MM * diagonal
    if not focal:
        # Pixels of the picture as the camera recorded it.
        unit = _UNIT_MM.get(int(tags.get(_PLANE_UNIT, 2)), math.nan)
        focal = tags.get(_FOCAL, 0) * tags.get(_PLANE_RESOLUTION, 0) / unit * long / recorded_long
    return focal if _PLAUSIBLE[0] < focal / diagonal < _PLAUSIBLE[1] else None
