"""The kernel's virtual video device `vivid`, from its far side: controls that inject faults, and a video output.

With "Loop Video" on, every frame of a capture node is what the output beside it shows at that instant, where both agree
on format and timing (kernel documentation, "The Virtual Video Test Driver"; Linux 6.11 has another control for it).
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import select
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from pathlib import Path

from drivers.v4l2 import kernel
from tests.contract.guest.machine import Module

LOOPED, BARE = 6, 3


class Control(IntEnum):
    """Ids of vivid's own controls. TIMESTAMP_SOURCE: 0 end of frame, 1 start of exposure. OSD_TEXT: 2 none."""

    TEST_PATTERN = 0x00F0F000
    OSD_TEXT = 0x00F0F001
    TIMESTAMP_SOURCE = 0x00F0F018
    DROPPED_PERCENT = 0x00F0F040
    DISCONNECT = 0x00F0F041
    BUFFER_ERROR = 0x00F0F042
    FATAL_ERROR = 0x00F0F046


def modules() -> tuple[Module, ...]:
    """Instances with one capture node each: `LOOPED` with an output beside it (HDMI), `BARE` as plain webcams."""
    count = LOOPED + BARE

    def each(looped: str, bare: str) -> str:
        return ",".join([looped] * LOOPED + [bare] * BARE)

    options = {
        "n_devs": str(count),
        "node_types": each("0x101", "0x1"),
        "num_inputs": each("1", "1"),
        "input_types": each("0x3", "0x0"),
        "num_outputs": each("1", "0"),
        "output_types": each("0x1", "0x0"),
    }
    return (Module("vivid", " ".join(f"{name}={value}" for name, value in options.items())),)


def nodes() -> Mapping[str, Path]:
    """The device file of each node by its name: 'vivid-000-vid-cap' and so on."""
    folders = Path("/sys/class/video4linux").iterdir()
    return {(folder / "name").read_text().strip(): Path("/dev") / folder.name for folder in folders}


class _Timings(ctypes.Structure):
    """struct v4l2_dv_timings, of which extent and speed are looked at."""

    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (
        ("type", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("interlaced", ctypes.c_uint32),
        ("polarities", ctypes.c_uint32),
        ("pixel_clock_hz", ctypes.c_uint64),
        ("rest", ctypes.c_uint8 * 104),
    )


class _ListedTimings(ctypes.Structure):
    _fields_ = (("index", ctypes.c_uint32), ("reserved", ctypes.c_uint32 * 3), ("timings", _Timings))


_OUTPUT = 2
_S_DV_TIMINGS, _ENUM_DV_TIMINGS = (
    3 << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number
    for kind, number in ((_Timings, 87), (_ListedTimings, 98))
)


class Node:
    """An open node of the device."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def set(self, control: int, value: int = 1) -> None:
        self._ask(kernel.S_CTRL, kernel.ControlValue(control, value))

    def set_named(self, name: str, value: int) -> None:
        """Set a control that is known by name only. Raises LookupError if there is none."""
        query = kernel.ControlDescription(id=kernel.CONTROL_NEXT)
        while True:
            try:
                self._ask(kernel.QUERYCTRL, query)
            except OSError as error:
                message = f"{self.path} has no control '{name}'"
                raise LookupError(message) from error
            if query.name.decode() == name:
                self.set(query.id, value)
                return
            query.id |= kernel.CONTROL_NEXT

    def set_timing(self, width_px: int, height_px: int) -> None:
        """Choose the signal's timing: of the progressive ones of this extent the fastest. Raises LookupError."""
        fits: list[_Timings] = []
        listed = _ListedTimings()
        # The list ends with an error.
        with suppress(OSError):
            while True:
                self._ask(_ENUM_DV_TIMINGS, listed)
                timings = listed.timings
                if (timings.width, timings.height, timings.interlaced) == (width_px, height_px, 0):
                    fits.append(_Timings.from_buffer_copy(timings))
                listed.index += 1
        if not fits:
            message = f"{self.path} knows no timing of {width_px} x {height_px}"
            raise LookupError(message)
        self._ask(_S_DV_TIMINGS, max(fits, key=lambda timings: timings.pixel_clock_hz))

    def _ask(self, request: int, argument: ctypes.c_int | ctypes.Structure) -> None:
        fcntl.ioctl(self._file, request, argument)


class Output(Node):
    """An output node that shows one picture until it is given the next."""

    def __init__(self, path: Path, pixel_format: str, width_px: int, height_px: int, *, dark: bytes) -> None:
        super().__init__(path)
        form = kernel.Format(type=_OUTPUT)
        pix = form.fmt.pix
        pix.width, pix.height, pix.pixelformat = width_px, height_px, kernel.fourcc_code(pixel_format)
        pix.field = kernel.FIELD_NONE
        self._ask(kernel.S_FMT, form)
        request = kernel.BufferRequest(count=2, type=_OUTPUT, memory=kernel.MMAP)
        self._ask(kernel.REQBUFS, request)
        if request.count != 2 or len(dark) != pix.sizeimage:
            name = kernel.fourcc_text(pix.pixelformat)
            message = f"{path}: {request.count} buffers of {pix.sizeimage} bytes, format {name}"
            raise RuntimeError(message)
        self._memory: list[mmap.mmap] = []
        for index in range(request.count):
            buffer = kernel.Buffer(index=index, type=_OUTPUT, memory=kernel.MMAP)
            self._ask(kernel.QUERYBUF, buffer)
            self._memory.append(mmap.mmap(self._file, buffer.length, offset=buffer.m.offset))
            self._queue(index, dark)
        self._ask(kernel.STREAMON, ctypes.c_int(_OUTPUT))
        self._free, _ = self._flipped()

    def close(self) -> None:
        """Idempotent. What is mapped keeps the file open, so it goes first."""
        while self._memory:
            self._memory.pop().close()
        super().close()

    def show(self, picture: bytes) -> int:
        """Show a picture; return when it replaced the one before, CLOCK_MONOTONIC in ns, cut to whole microseconds."""
        self._queue(self._free, picture)
        self._free, at_ns = self._flipped()
        return at_ns

    def _queue(self, index: int, picture: bytes) -> None:
        self._memory[index][: len(picture)] = picture
        buffer = kernel.Buffer(index=index, type=_OUTPUT, memory=kernel.MMAP)
        buffer.bytesused, buffer.field = len(picture), kernel.FIELD_NONE
        self._ask(kernel.QBUF, buffer)

    def _flipped(self) -> tuple[int, int]:
        """Wait for the picture before to come back: vivid keeps the last one for as long as there is no other."""
        waiting = select.poll()
        waiting.register(self._file, select.POLLOUT)
        if not waiting.poll(5000):
            message = f"{self.path} did not change its picture in 5 s"
            raise TimeoutError(message)
        buffer = kernel.Buffer(type=_OUTPUT, memory=kernel.MMAP)
        self._ask(kernel.DQBUF, buffer)
        return buffer.index, (buffer.timestamp.tv_sec * 1_000_000 + buffer.timestamp.tv_usec) * 1_000
