"""What the kernel says of a camera and OpenCV keeps to itself: whether it is there, and whether it is free."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, SlrigError, UnsupportedByDeviceError

_QUERYCAP, _QUERYCAP_BYTES = 0x80685600, 104
_REQBUFS = 0xC0145608
_CAPTURE, _MMAP = 1, 1


def require_free(path: str) -> None:
    """Raise unless a camera is there and nobody streams from it: only who does may free its buffers.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        It is not there, is used, gives no frames, may not be opened.
    """
    _asked(path, _REQBUFS, bytearray(struct.pack("=5I", 0, _CAPTURE, _MMAP, 0, 0)))


def require_present(path: str, otherwise: DeviceGoneError) -> None:
    """Raise `otherwise` unless the camera answers."""
    try:
        _asked(path, _QUERYCAP, bytearray(_QUERYCAP_BYTES))
    except SlrigError as error:
        raise otherwise from error


def _asked(path: str, request: int, argument: bytearray) -> None:
    # Not on other systems.
    import fcntl

    handle = _told(path, lambda: os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC))
    try:
        _told(path, lambda: fcntl.ioctl(handle, request, argument))
    finally:
        os.close(handle)


def _told(path: str, call: Callable[[], int]) -> int:
    try:
        return call()
    except FileNotFoundError as error:
        message = f"{path} is not there: plug the camera in; slrig devices lists those that are"
        raise DeviceGoneError(message) from error
    except PermissionError as error:
        message = f"{path} may not be opened ({error.strerror}); add yourself to the group 'video'"
        raise DeviceError(message) from error
    except OSError as error:
        match error.errno:
            case errno.EBUSY:
                message = f"{path} is used by another program (fuser {path} names it); end that first"
                raise DeviceBusyError(message) from error
            case errno.ENXIO | errno.ENODEV:
                message = f"{path} is unplugged ({error.strerror}); plug it in again"
                raise DeviceGoneError(message) from error
            case _:
                message = f"{path} gives no frames ({error.strerror}); slrig devices lists those that do"
                raise UnsupportedByDeviceError(message) from error
