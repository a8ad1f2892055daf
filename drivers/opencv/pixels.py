"""What OpenCV hands over, in grey and in colour: raw buffers of the kernel, JPEGs as sent, decoded pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.v4l2.formats import LAYOUTS, CorruptFrameError, colour_image, grey_image
from slrig.model import CameraFormat, Pixels, Size


@dataclass(frozen=True, slots=True)
class Picture:
    """What comes from OpenCV: the pixel format of raw data (None: decoded pictures), the camera's format, and whether
    there is colour in it.
    """

    code: str | None
    format: CameraFormat
    has_colour: bool = False

    def grey(self, data: NDArray[Any]) -> Pixels:
        """Return (H, W), uint8 up to 8 bit and uint16 beyond.

        Raises
        ------
        CorruptFrameError
            Parts of it are missing, or it is of another extent, or brighter than the format allows.
        """
        image = self._decoded(data) if self.code is None else self._read(data, self.code)
        if image.shape != self.format.size.shape:
            message = f"it is {image.shape[1]} x {image.shape[0]}, the camera's frames are {self.format.size}"
            raise CorruptFrameError(message)
        wanted = np.uint8 if self.format.bit_depth <= 8 else np.uint16
        brightest = int(image.max(initial=0))
        if image.dtype != wanted or brightest > self.format.full_scale:
            message = f"it is {image.dtype} up to {brightest}, {self.format.bit_depth} bits end at " + str(
                self.format.full_scale
            )
            raise CorruptFrameError(message)
        return image

    def _decoded(self, data: NDArray[Any]) -> Pixels:
        if data.ndim == 3 and data.shape[2] == 3:
            return np.asarray(cv2.cvtColor(data, cv2.COLOR_BGR2GRAY))
        return np.ascontiguousarray(data[..., 0] if data.ndim == 3 else data)

    def colour(self, data: NDArray[Any]) -> Pixels:
        """Return (H, W, 3), blue, green and red, of data that `grey` has taken and that has colour."""
        return data if self.code is None else self._read(data, self.code, colour_image)

    def _read(self, data: NDArray[Any], code: str, made: Callable[..., Pixels] = grey_image) -> Pixels:
        layout, size = LAYOUTS[code], self.format.size
        plain = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        return made(plain, layout, size, stride_bytes=len(plain) // size.height_px)


def raw_picture(code: str | None, size: Size, bit_depth: int | None) -> Picture:
    """Return what frames of this pixel format and extent are; of None, decoded pictures of 8 bits.

    bit_depth : how many bits of a 16-bit sample are used; None for all of them.
    """
    depth = 8 if code is None else LAYOUTS[code].bit_depth
    form = CameraFormat(size, bit_depth if depth == 16 and bit_depth is not None else depth)
    return Picture(code, form, code is None or LAYOUTS[code].has_colour)


def decoded_picture(data: NDArray[Any], bit_depth: int | None) -> Picture:
    """Return what a source's frames are, from the first that OpenCV has decoded.

    Raises
    ------
    CorruptFrameError
        Its samples are neither of 8 nor of 16 bits.
    """
    if data.dtype not in (np.uint8, np.uint16):
        message = f"its samples are {data.dtype}, expected uint8 or uint16"
        raise CorruptFrameError(message)
    rows, columns = data.shape[:2]
    depth = 8 if data.dtype == np.uint8 else bit_depth or 16
    return Picture(None, CameraFormat(Size(columns, rows), depth), data.shape[2:] == (3,))
