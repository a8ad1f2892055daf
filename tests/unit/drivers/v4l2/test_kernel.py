"""Structures and requests against what a C compiler makes of linux/videodev2.h on a 64-bit machine."""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.v4l2 import kernel
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

NODE = Path("/dev/video7")

pytestmark = pytest.mark.skipif(ctypes.sizeof(ctypes.c_void_p) != 8, reason="the numbers are those of 64-bit machines")


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("QUERYCAP", 0x80685600),
        ("ENUM_FMT", 0xC0405602),
        ("G_FMT", 0xC0D05604),
        ("S_FMT", 0xC0D05605),
        ("REQBUFS", 0xC0145608),
        ("QUERYBUF", 0xC0585609),
        ("QBUF", 0xC058560F),
        ("DQBUF", 0xC0585611),
        ("STREAMON", 0x40045612),
        ("STREAMOFF", 0x40045613),
        ("G_PARM", 0xC0CC5615),
        ("S_PARM", 0xC0CC5616),
        ("G_CTRL", 0xC008561B),
        ("S_CTRL", 0xC008561C),
        ("QUERYCTRL", 0xC0445624),
        ("ENUM_FRAMESIZES", 0xC02C564A),
        ("ENUM_FRAMEINTERVALS", 0xC034564B),
        ("G_EXT_CTRLS", 0xC0205647),
    ],
)
def test_requests_have_the_kernels_numbers(name: str, number: int) -> None:
    assert getattr(kernel, name) == number


@pytest.mark.parametrize(
    ("structure", "field", "offset"),
    [
        (kernel.Capability, "bus_info", 48),
        (kernel.Capability, "device_caps", 88),
        (kernel.FormatDescription, "pixelformat", 44),
        (kernel.Format, "fmt", 8),
        (kernel.PixelFormat, "sizeimage", 20),
        (kernel.FrameSize, "size", 12),
        (kernel.StreamParameters, "parm", 4),
        (kernel.CaptureParameters, "timeperframe", 8),
        (kernel.Buffer, "bytesused", 8),
        (kernel.Buffer, "timestamp", 24),
        (kernel.Buffer, "sequence", 56),
        (kernel.Buffer, "m", 64),
        (kernel.Buffer, "length", 72),
        (kernel.ControlDescription, "minimum", 40),
        (kernel.ControlDescription, "flags", 56),
    ],
)
def test_fields_lie_where_the_kernel_has_them(structure: type[ctypes.Structure], field: str, offset: int) -> None:
    assert getattr(structure, field).offset == offset


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENODEV, DeviceGoneError, "plug it in again"),
        (errno.EIO, DeviceError, "dmesg"),
        (errno.EBUSY, DeviceBusyError, "fuser -v /dev/video7"),
        (errno.EACCES, DeviceError, "usermod -aG video"),
        (errno.ENOSPC, UnsupportedByDeviceError, "different USB controllers"),
        (errno.EINVAL, UnsupportedByDeviceError, "cannot do that"),
        (errno.ENOMEM, DeviceError, "dmesg"),
    ],
)
def test_a_refusal_tells_what_to_do(number: int, kind: type[DeviceError], words: str) -> None:
    found = kernel.fault(NODE, "starting the stream", OSError(number, os.strerror(number)))
    assert type(found) is kind
    assert words in str(found)
    assert str(found).startswith("/dev/video7: starting the stream: ")


def test_only_a_streams_fault_says_that_the_stream_has_died() -> None:
    broken = OSError(errno.EIO, os.strerror(errno.EIO))
    assert type(kernel.stream_fault(NODE, "taking a frame", broken)) is DeviceGoneError
    assert type(kernel.stream_fault(NODE, "taking a frame", OSError(errno.ENOMEM, "memory"))) is DeviceError


def test_a_program_that_holds_a_device_is_named(tmp_path: Path) -> None:
    node = tmp_path / "video0"
    node.touch()
    program = "import sys; held = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", program, str(node)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "open\n"
        message = str(kernel.fault(node, "opening", OSError(errno.EBUSY, "busy")))
        holder.communicate()
    assert f"({holder.pid})" in message
    assert kernel.holders_of(node) == ()
