"""What a camera streams: the sensor's mode, the format of the pixels, and how they lie in memory."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.v4l2.formats import Layout, Packing, colour_image, grey_image
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Pixels, Size

_UNPACKED = re.compile(r"^(S(?P<bayer>[RGB]{4})|R)(?P<depth>8|10|12|14|16)$")
_LEAST_MAIN = (64, 64)
"""picamera2 always makes a main stream; beside a raw one nobody reads it."""


@dataclass(frozen=True, slots=True)
class Stream:
    """The stream that is read, as it was configured."""

    name: str
    layout: Layout
    size: Size
    stride_bytes: int

    def colour(self, data: NDArray[np.uint8]) -> Callable[[], Pixels] | None:
        """What makes (H, W, 3), blue, green and red, of a buffer; None where there is none."""
        if not self.layout.has_colour:
            return None
        return partial(colour_image, data, self.layout, self.size, stride_bytes=self.stride_bytes)

    def image(self, data: NDArray[np.uint8]) -> Pixels:
        """(H, W): the image in a buffer. Raises ValueError: it is too short."""
        return grey_image(data, self.layout, self.size, stride_bytes=self.stride_bytes)


def configured(camera: Any, name: str, *, raw: bool, size_px: tuple[int, int] | None) -> Stream:
    """Configure the camera for a stream, and read back what it made of that.

    Raises
    ------
    UnsupportedByDeviceError
        The sensor has no such mode, or libcamera gives another extent or a format that is not read.
    """
    modes = [mode for mode in camera.sensor_modes if "size" in mode]
    sizes = sorted({tuple(mode["size"]) for mode in modes}, key=lambda size: size[0] * size[1])
    wanted = sizes[-1] if size_px is None and sizes else size_px
    offered = ", ".join(f"{width} x {height}" for width, height in sizes) or "none that has an extent"
    if wanted not in sizes:
        message = f"camera '{name}': asked for size_px {wanted}, its sensor has the modes {offered}; choose one of them"
        raise UnsupportedByDeviceError(message)
    mode = max((mode for mode in modes if tuple(mode["size"]) == wanted), key=lambda mode: mode["bit_depth"])
    sensor = {"output_size": wanted, "bit_depth": mode["bit_depth"]}
    if raw:
        table = {"raw": {"format": mode["unpacked"], "size": wanted}, "main": {"size": _LEAST_MAIN}}
    else:
        table = {"main": {"format": "YUV420", "size": wanted}}
    camera.configure(camera.create_video_configuration(**table, sensor=sensor, controls={}, display=None, encode=None))
    which = "raw" if raw else "main"
    got = camera.camera_configuration()[which]
    layout = _layout(got["format"])
    if layout is None or tuple(got["size"]) != wanted:
        message = (
            f"camera '{name}': asked for {table[which]}, libcamera gives {got['format']}, {got['size']}; "
            f'write pixels = "{"luma" if raw else "raw"}", or another size_px (the sensor has {offered})'
        )
        raise UnsupportedByDeviceError(message)
    return Stream(which, layout, Size(*wanted), got["stride"])


def _layout(form: str) -> Layout | None:
    """How a format of libcamera's lies in memory; None if it is not read.

    >>> _layout("SRGGB10").bayer, _layout("R8").packing.name, _layout("RGGB16_PISP_COMP1")
    ('RGGB', 'BYTES', None)
    """
    if form == "YUV420":
        # Planes: all luma first, then the colours, which are not looked at.
        return Layout(8, Packing.BYTES)
    found = _UNPACKED.match(form)
    if found is None:
        return None
    depth = int(found["depth"])
    return Layout(depth, Packing.BYTES if depth == 8 else Packing.WORDS, found["bayer"])
