"""What the kernel's refusals mean. Requests and structures are held by the fake kernel (test_camera.py)."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.v4l2 import kernel
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

NODE = Path("/dev/video7")


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
