"""The kernel's video interface (V4L2): structures, request numbers, flags, and errors.

Sources: `include/uapi/linux/videodev2.h` and `v4l2-controls.h`, and the kernel's documentation "Video for Linux API".
Names are the kernel's, without the prefix. `ctypes` lays structures out for the running machine.
"""

from __future__ import annotations

import ctypes
import errno
import os
from contextlib import suppress
from pathlib import Path

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

CAPTURE = 1
"""Buffer type: frames of a camera in one plane."""
MMAP = 1
"""Buffer memory: mapped memory of the driver."""
FIELD_ANY = 0
FIELD_NONE = 1

CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000

BUFFER_ERROR = 0x40
STAMP_MASK = 0xE000
STAMP_MONOTONIC = 0x2000
STAMP_SOURCE_MASK = 0x7_0000
STAMP_SOURCE_START = 0x1_0000

SIZES_DISCRETE = 1

CONTROL_DISABLED = 0x1
CONTROL_READ_ONLY = 0x4
CONTROL_WRITE_ONLY = 0x40
CONTROL_NEXT = 0x8000_0000
CONTROL_MENUS = (3, 9)
"""Types of controls whose numbers are menu entries."""

GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.ENOENT})
"""Errors of a device that is no longer connected."""
REFUSED = frozenset({errno.EINVAL, errno.ERANGE, errno.ENOTTY, errno.EOPNOTSUPP})
"""Errors of a request that the device does not support."""


def _u32(*names: str) -> tuple[tuple[str, type[ctypes.c_uint32]], ...]:
    return tuple((name, ctypes.c_uint32) for name in names)


class Capability(ctypes.Structure):
    """`v4l2_capability`: identity and capabilities of a device."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        *_u32("version", "capabilities", "device_caps"),
        ("reserved", ctypes.c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """`v4l2_fmtdesc`: one pixel format that the device offers."""

    _fields_ = (
        *_u32("index", "type", "flags"),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """`v4l2_pix_format`: size, pixel format and layout of a frame."""

    _fields_ = (
        *_u32("width", "height", "pixelformat", "field", "bytesperline", "sizeimage", "colorspace", "priv", "flags"),
        *_u32("ycbcr_enc", "quantization", "xfer_func"),
    )


class _FormatUnion(ctypes.Union):
    # The window of an overlay holds pointers, so the kernel's union is aligned as a pointer is.
    _fields_ = (("pix", PixFormat), ("raw", ctypes.c_uint8 * 200), ("pointer", ctypes.c_void_p))


class Format(ctypes.Structure):
    """`v4l2_format`."""

    _fields_ = (("type", ctypes.c_uint32), ("fmt", _FormatUnion))


class _SizeSteps(ctypes.Structure):
    _fields_ = _u32("min_width", "max_width", "step_width", "min_height", "max_height", "step_height")


class _SizeDiscrete(ctypes.Structure):
    _fields_ = (("width", ctypes.c_uint32), ("height", ctypes.c_uint32))


class _SizeUnion(ctypes.Union):
    _fields_ = (("discrete", _SizeDiscrete), ("stepwise", _SizeSteps))


class FrameSize(ctypes.Structure):
    """`v4l2_frmsizeenum`: one size, or a range of sizes, of a pixel format."""

    _fields_ = (
        *_u32("index", "pixel_format", "type"),
        ("size", _SizeUnion),
        ("reserved", ctypes.c_uint32 * 2),
    )


class Fraction(ctypes.Structure):
    """`v4l2_fract`."""

    _fields_ = (("numerator", ctypes.c_uint32), ("denominator", ctypes.c_uint32))


class _IntervalSteps(ctypes.Structure):
    _fields_ = (("min", Fraction), ("max", Fraction), ("step", Fraction))


class _IntervalUnion(ctypes.Union):
    _fields_ = (("discrete", Fraction), ("stepwise", _IntervalSteps))


class FrameInterval(ctypes.Structure):
    """`v4l2_frmivalenum`: one time per frame, or a range of them, of a pixel format and size."""

    _fields_ = (
        *_u32("index", "pixel_format", "width", "height", "type"),
        ("interval", _IntervalUnion),
        ("reserved", ctypes.c_uint32 * 2),
    )


class CaptureParameters(ctypes.Structure):
    """`v4l2_captureparm`: the time per frame."""

    _fields_ = (
        ("capability", ctypes.c_uint32),
        ("capturemode", ctypes.c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", ctypes.c_uint32),
        ("readbuffers", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 4),
    )


class _ParametersUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParameters), ("raw", ctypes.c_uint8 * 200))


class StreamParameters(ctypes.Structure):
    """`v4l2_streamparm`."""

    _fields_ = (("type", ctypes.c_uint32), ("parm", _ParametersUnion))


class BufferRequest(ctypes.Structure):
    """`v4l2_requestbuffers`."""

    _fields_ = (
        *_u32("count", "type", "memory", "capabilities"),
        ("flags", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 3),
    )


class TimeValue(ctypes.Structure):
    """`timeval`; on 32-bit machines the request number distinguishes its two forms."""

    _fields_ = (("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long))


class _BufferMemory(ctypes.Union):
    _fields_ = (
        ("offset", ctypes.c_uint32),
        ("userptr", ctypes.c_ulong),
        ("planes", ctypes.c_void_p),
        ("fd", ctypes.c_int32),
    )


class Buffer(ctypes.Structure):
    """`v4l2_buffer`: a frame's memory, time stamp, sequence number and flags."""

    _fields_ = (
        *_u32("index", "type", "bytesused", "flags", "field"),
        ("timestamp", TimeValue),
        ("timecode", ctypes.c_uint32 * 4),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("m", _BufferMemory),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
    )


class ControlDescription(ctypes.Structure):
    """`v4l2_queryctrl`: a control's name, type and range."""

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    )


class ControlValue(ctypes.Structure):
    """`v4l2_control`."""

    _fields_ = (("id", ctypes.c_uint32), ("value", ctypes.c_int32))


class LongControlValue(ctypes.Structure):
    """`v4l2_ext_control` of a 64-bit control. Packed: its value, lower half first, is not aligned."""

    _fields_ = (
        *_u32("id", "size", "reserved2"),
        ("halves", ctypes.c_uint32 * 2),
    )


class LongControlValues(ctypes.Structure):
    """`v4l2_ext_controls`: a list of values to read."""

    _fields_ = (
        *_u32("which", "count", "error_idx"),
        ("request_fd", ctypes.c_int32),
        ("reserved", ctypes.c_uint32),
        ("controls", ctypes.POINTER(LongControlValue)),
    )


def _request(direction: int, number: int, kind: type[ctypes.Structure] | type[ctypes.c_int]) -> int:
    # asm-generic/ioctl.h: two bits of direction, fourteen of size, eight of type ('V'), eight of number.
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


_WRITE, _READ, _BOTH = 1, 2, 3

QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_BOTH, 2, FormatDescription)
G_FMT = _request(_BOTH, 4, Format)
S_FMT = _request(_BOTH, 5, Format)
REQBUFS = _request(_BOTH, 8, BufferRequest)
QUERYBUF = _request(_BOTH, 9, Buffer)
QBUF = _request(_BOTH, 15, Buffer)
DQBUF = _request(_BOTH, 17, Buffer)
STREAMON = _request(_WRITE, 18, ctypes.c_int)
STREAMOFF = _request(_WRITE, 19, ctypes.c_int)
G_PARM = _request(_BOTH, 21, StreamParameters)
S_PARM = _request(_BOTH, 22, StreamParameters)
G_CTRL = _request(_BOTH, 27, ControlValue)
S_CTRL = _request(_BOTH, 28, ControlValue)
QUERYCTRL = _request(_BOTH, 36, ControlDescription)
G_EXT_CTRLS = _request(_BOTH, 71, LongControlValues)
ENUM_FRAMESIZES = _request(_BOTH, 74, FrameSize)
ENUM_FRAMEINTERVALS = _request(_BOTH, 75, FrameInterval)


def open_node(node: Path) -> int:
    """Open a device node without blocking. Raises OSError."""
    return os.open(node, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)


def ioctl(handle: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
    """Send a request; the answer is written into `argument`. Raises OSError."""
    # Imported here, so that this module can be imported on other systems.
    import fcntl

    while True:
        try:
            fcntl.ioctl(handle, request, argument)
        except InterruptedError:
            continue
        return


def fourcc_text(code: int) -> str:
    """Return a pixel format's four characters.

    >>> fourcc_text(0x59455247)
    'GREY'
    """
    return (code & 0x7FFF_FFFF).to_bytes(4, "little").decode("ascii", "replace")


def fourcc_code(text: str) -> int:
    """Return a pixel format's number; short names are padded with blanks, as in the kernel.

    >>> fourcc_text(fourcc_code("Y16"))
    'Y16 '
    """
    return int.from_bytes(text.ljust(4).encode("ascii"), "little")


def device_error(node: Path, action: str, error: OSError) -> DeviceError:
    """Return the error for a request that the kernel refused, with what to do about it."""
    number = error.errno or 0
    cause = f"{node}: {action}: {os.strerror(number)}"
    if number in GONE:
        return DeviceGoneError(
            f"{cause}; the camera is gone: plug it in again, and reopen it (slrig devices lists the connected ones)"
        )
    if number == errno.EBUSY:
        holders = list_holders(node)
        by = f" by {', '.join(holders)}" if holders else ""
        return DeviceBusyError(f"{cause}; it is held{by}: close that program (fuser -v {node} lists its users)")
    if number in (errno.EACCES, errno.EPERM):
        return DeviceError(
            f"{cause}; you may not open it: add yourself to its group (sudo usermod -aG video $USER), and log in again"
        )
    if number == errno.ENOSPC:
        return UnsupportedByDeviceError(
            f"{cause}; the USB bus has not enough bandwidth left for this stream: plug the cameras into different USB "
            "controllers (lsusb -t). Many webcams request the whole bus for any format: for a raw one, sudo "
            "modprobe -r uvcvideo and sudo modprobe uvcvideo quirks=0x80 makes the kernel compute its need. Or "
            'request a smaller size_px, a lower frame_rate_hz, or pixel_format = "MJPG"'
        )
    if number in REFUSED:
        return UnsupportedByDeviceError(f"{cause}; the device cannot do that (slrig devices lists the cameras)")
    return DeviceError(f"{cause}; see the kernel's log: dmesg | tail")


def stream_error(node: Path, action: str, error: OSError) -> DeviceError:
    """As `device_error` for a request about frames, where EIO means that the stream has failed."""
    if error.errno == errno.EIO:
        return DeviceGoneError(
            f"{node}: {action}: {os.strerror(errno.EIO)}; its stream has failed: plug it in again, and reopen it"
        )
    return device_error(node, action, error)


def list_holders(node: Path) -> tuple[str, ...]:
    """List the other programs that have a node open, as far as visible: "name (process id)"."""
    found = []
    target = os.path.realpath(node)
    for process in Path("/proc").glob("[0-9]*"):
        # Processes may end meanwhile, and those of other users cannot be read.
        with suppress(OSError):
            if int(process.name) == os.getpid():
                continue
            if any(os.path.realpath(link) == target for link in (process / "fd").iterdir()):
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
                found.append(f"{name} ({process.name})")
    return tuple(found)
