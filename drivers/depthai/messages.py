"""Frames as the library delivers them: whether one is whole, when it was exposed, its brightness and colour.

The library's time stamp is that of the first byte on the sensor's bus: a few microseconds after the exposure's end, of
the first row where the shutter rolls (github.com/luxonis/depthai/issues/795). It counts in the library's clock, which
is CLOCK_MONOTONIC.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.depthai.library import microseconds, nanoseconds
from drivers.depthai.options import OakStream
from drivers.v4l2.formats import from_luma
from slrig.model import Pixels


@dataclass(frozen=True, slots=True)
class OakFrame:
    """A whole frame, as it came. `t_start_ns` and `t_end_ns` are those of the first row, CLOCK_MONOTONIC.

    message : the library's `ImgFrame`; its pixels are copied only if the frame is wanted.
    """

    message: Any
    number: int
    t_start_ns: int
    t_end_ns: int
    received_ns: int
    exposure_us: int
    iso: int
    lens_position: int


def find_frame_fault(message: Any, stream: OakStream, received_ns: int, err_ns: int, vendor: Any) -> str | None:
    """Say what makes a frame unusable; None if it is whole.

    A frame that was cut on its way has less data than its header announces; one whose header was damaged has another
    size or kind than was asked for. A frame that says it ends later than it came would pass for a fresh one.
    """
    size, kind = stream.size, frame_type(stream, vendor)
    if message.getType() != kind or (message.getWidth(), message.getHeight()) != (size.width_px, size.height_px):
        return f"{message.getWidth()} x {message.getHeight()} {message.getType()} where {size} {kind} was asked for"
    stride, rows = message.getStride(), size.height_px * (3 if stream.colour else 2) // 2
    if stride < size.width_px or len(message.getData()) < stride * rows:
        return f"{len(message.getData())} bytes where {stride} x {rows} were announced"
    if microseconds(message.getExposureTime()) <= 0:
        return "no exposure told"
    if nanoseconds(message.getTimestamp()) - err_ns > received_ns:
        return "stamped later than it came"
    return None


def read_frame(message: Any, received_ns: int, vendor: Any) -> OakFrame:
    """Read what a whole frame says of itself."""
    offsets = vendor.CameraExposureOffset
    return OakFrame(
        message=message,
        number=message.getSequenceNum(),
        t_start_ns=nanoseconds(message.getTimestamp(offsets.START)),
        t_end_ns=nanoseconds(message.getTimestamp(offsets.END)),
        received_ns=received_ns,
        exposure_us=microseconds(message.getExposureTime()),
        iso=message.getSensitivity(),
        lens_position=message.getLensPosition(),
    )


def read_luminance(message: Any, stream: OakStream) -> Pixels:
    """(H, W) uint8, a copy: the grey levels, or a colour frame's luminance, which NV12 begins with."""
    stride, size = message.getStride(), stream.size
    plane = np.asarray(message.getData(), dtype=np.uint8)[: stride * size.height_px]
    return plane.reshape(size.height_px, stride)[:, : size.width_px].copy()


def colour_reader(message: Any, luma: Pixels) -> Callable[[], Pixels]:
    """What makes a colour frame of its brightness and of the differences of blue and red, copied, which follow it in
    NV12: in turn, half as many rows and columns.
    """
    stride, (rows, columns) = message.getStride(), luma.shape
    planes = np.asarray(message.getData(), dtype=np.uint8)[stride * rows :][: stride * (rows // 2)]
    differences = planes.reshape(-1, stride)[:, :columns].copy()
    return lambda: from_luma(luma, differences[:, ::2], differences[:, 1::2])


def frame_type(stream: OakStream, vendor: Any) -> Any:
    """The library's name of the frames' layout."""
    return vendor.ImgFrame.Type.NV12 if stream.colour else vendor.ImgFrame.Type.GRAY8
