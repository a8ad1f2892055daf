"""Buffers shared with the kernel: queued, filled by the camera, taken in order, given back."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import select
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.v4l2 import kernel
from drivers.v4l2.timing import Stamp, StampSource
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError

_BROKEN = select.POLLERR | select.POLLHUP | select.POLLNVAL


@dataclass(frozen=True, slots=True)
class Taken:
    """A filled buffer that is ours until it is given back. `corrupt`: the driver says that its data are damaged."""

    index: int
    bytes_used: int
    corrupt: bool
    sequence: int
    stamp: Stamp


class Waker:
    """Ends a wait from another thread, once and for all."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()

    @property
    def handle(self) -> int:
        """Readable once woken."""
        return self._read

    def wake(self) -> None:
        """End every wait, this one and those to come."""
        with suppress(OSError):
            os.write(self._write, b"\0")

    def close(self) -> None:
        """Give the pipe back. Nobody may wait any more."""
        os.close(self._read)
        os.close(self._write)


class Stream:
    """The buffers of an open device. Holding them keeps other programs from streaming; `release` gives them back.

    Raises
    ------
    DeviceBusyError
        Another program streams from the device.
    DeviceError
        The device failed, or does not map buffers.
    """

    def __init__(self, handle: int, node: Path, count: int, waker: Waker) -> None:
        self._handle = handle
        self._node = node
        self._waker = waker
        self._maps: list[mmap.mmap] = []
        self._queued_ns: list[int] = []
        self._on = False
        request = kernel.BufferRequest(count=count, type=kernel.CAPTURE, memory=kernel.MMAP)
        self._ask("asking for buffers", kernel.REQBUFS, request)
        if request.count < 1:
            message = f"{node}: asked for {count} buffers, driver gives none; close other programs, or ask for fewer"
            raise UnsupportedByDeviceError(message)
        try:
            for index in range(request.count):
                buffer = self._buffer(index)
                self._ask("asking for a buffer's place", kernel.QUERYBUF, buffer)
                self._maps.append(
                    mmap.mmap(handle, buffer.length, mmap.MAP_SHARED, mmap.PROT_READ, offset=buffer.m.offset)
                )
                self._queued_ns.append(0)
        except OSError as error:
            self.release()
            raise kernel.fault(node, "mapping a buffer", error) from error
        except DeviceError:
            self.release()
            raise

    def start(self) -> None:
        """Queue every buffer and let the frames come."""
        for index in range(len(self._maps)):
            self._queue(index)
        self._ask("starting the stream", kernel.STREAMON, ctypes.c_int(kernel.CAPTURE))
        self._on = True

    def take(self, until_ns: int) -> Taken | None:
        """Take the oldest filled buffer, waiting for it until then (CLOCK_MONOTONIC); None if none came.

        Raises
        ------
        DeviceGoneError
            The device is gone, or its stream has died.
        DeviceStateError
            The waker has been used.
        """
        poll = select.poll()
        poll.register(self._handle, select.POLLIN)
        poll.register(self._waker.handle, select.POLLIN)
        left_ms = 0.0
        while True:
            events = dict(poll.poll(left_ms))
            if self._waker.handle in events:
                message = f"{self._node}: the camera was closed while a frame was waited for; open it again"
                raise DeviceStateError(message)
            if self._handle in events:
                taken = self._dequeue()
                if taken is not None:
                    return taken
                if events[self._handle] & _BROKEN:
                    message = (
                        f"{self._node}: the stream has died; the camera is gone or has failed: plug it in again, and "
                        "reopen it"
                    )
                    raise DeviceGoneError(message)
            left_ms = (until_ns - time.monotonic_ns()) / 1e6
            if left_ms <= 0:
                return None

    def data(self, taken: Taken) -> NDArray[np.uint8]:
        """(n,) uint8, a copy of the used bytes of a buffer, which may then be given back."""
        return np.frombuffer(self._maps[taken.index][: taken.bytes_used], dtype=np.uint8)

    def give_back(self, taken: Taken) -> None:
        """Let the camera fill the buffer again."""
        self._queue(taken.index)

    def stop(self) -> None:
        """End the stream, whatever state the device is in. Every buffer is ours again. Idempotent."""
        if self._on:
            self._on = False
            with suppress(DeviceError):
                self._ask("stopping the stream", kernel.STREAMOFF, ctypes.c_int(kernel.CAPTURE))

    def release(self) -> None:
        """Stop, and give the buffers back. Idempotent; works after an unplug."""
        self.stop()
        while self._maps:
            self._maps.pop().close()
        with suppress(DeviceError):
            none = kernel.BufferRequest(count=0, type=kernel.CAPTURE, memory=kernel.MMAP)
            self._ask("giving the buffers back", kernel.REQBUFS, none)

    def _buffer(self, index: int = 0) -> kernel.Buffer:
        return kernel.Buffer(index=index, type=kernel.CAPTURE, memory=kernel.MMAP)

    def _queue(self, index: int) -> None:
        # Noted before the request: the camera may fill the buffer while it is still under way.
        self._queued_ns[index] = time.monotonic_ns()
        self._ask("queueing a buffer", kernel.QBUF, self._buffer(index))

    def _dequeue(self) -> Taken | None:
        buffer = self._buffer()
        try:
            kernel.ask(self._handle, kernel.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise kernel.stream_fault(self._node, "taking a frame", error) from error
        index = int(buffer.index)
        stamp_ns = buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1000
        stamp = Stamp(_source(buffer.flags), stamp_ns, self._queued_ns[index], time.monotonic_ns())
        corrupt = bool(buffer.flags & kernel.BUFFER_ERROR)
        return Taken(index, int(buffer.bytesused), corrupt, int(buffer.sequence), stamp)

    def _ask(self, doing: str, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        try:
            kernel.ask(self._handle, request, argument)
        except OSError as error:
            raise kernel.stream_fault(self._node, doing, error) from error


def _source(flags: int) -> StampSource:
    if flags & kernel.STAMP_MASK != kernel.STAMP_MONOTONIC:
        return StampSource.NONE
    if flags & kernel.STAMP_SOURCE_MASK == kernel.STAMP_SOURCE_START:
        return StampSource.EXPOSURE_START
    return StampSource.FRAME_END
