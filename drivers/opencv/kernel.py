"""What the kernel says of a camera and OpenCV keeps to itself: whether it is there, and whether it is free."""

from __future__ import annotations

import os
from ctypes import Structure
from pathlib import Path

from drivers.v4l2 import kernel
from slrig.errors import DeviceGoneError, SlrigError


def require_free(path: str) -> None:
    """Raise unless a camera is there and nobody streams from it: only who does may free its buffers.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        It is not there, is used, gives no frames, may not be opened.
    """
    none = kernel.BufferRequest(count=0, type=kernel.CAPTURE, memory=kernel.MMAP)
    _asked(path, "asking for frames", kernel.REQBUFS, none)


def require_present(path: str, otherwise: DeviceGoneError) -> None:
    """Raise `otherwise` unless the camera answers."""
    try:
        _asked(path, "asking what it is", kernel.QUERYCAP, kernel.Capability())
    except SlrigError as error:
        raise otherwise from error


def _asked(path: str, doing: str, request: int, argument: Structure) -> None:
    try:
        handle = kernel.open_node(Path(path))
        try:
            kernel.ask(handle, request, argument)
        finally:
            os.close(handle)
    except OSError as error:
        raise kernel.fault(Path(path), doing, error) from error
