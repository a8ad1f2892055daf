"""What the driver asks of a library for GenICam cameras, whichever it is: Aravis, or a GenTL producer."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.genicam.features import Features
from slrig.devices import CameraState
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size


@dataclass(frozen=True, slots=True)
class RawImage:
    """An image as it lies in memory; so many bytes follow each row."""

    data: bytes
    size: Size
    padding_bytes: int


@dataclass(frozen=True, slots=True)
class RawFrame:
    """What a library delivered of a frame.

    block_id : the camera's number of it. arrived_ns : when it came, CLOCK_MONOTONIC; not before it did. stamp_ns : the
    camera's own time, 0 if there is none. image : None if it is not whole.
    """

    block_id: int
    arrived_ns: int
    stamp_ns: int
    image: RawImage | None


class GenICamStream(Protocol):
    """A running acquisition."""

    def take(self, most_s: float) -> RawFrame | None:
        """Return the next frame, waiting for it no longer than that; None if none came."""
        ...

    def end(self) -> None:
        """Stop, whatever state the camera is in. What has not been taken is gone."""
        ...


class GenICamConnection(ABC):
    """An open device. One thread uses it; one of the library may tell that it is lost.

    Parameters
    ----------
    name
        The camera's, for messages.
    """

    _camera: Any
    """`Aravis.Camera`, or what does the same calls."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state = CameraState(name)
        self._lost = threading.Event()
        self.features = Features(name, self.asking, self.kind)

    @property
    def is_lost(self) -> bool:
        """Whether the device has gone since it was opened."""
        return self._lost.is_set()

    @contextmanager
    def asking(self, doing: str) -> Iterator[Any]:
        """The camera as `Aravis.Camera` presents it, for the block.

        Raises
        ------
        DeviceStateError
            It was closed.
        DeviceGoneError
            It is lost, before or by what the block asked.
        DeviceError
            What `told` makes of the library's errors.
        """
        self.state.require_open()
        if self._lost.is_set():
            raise self.gone(doing)
        try:
            with self.told(doing):
                yield self._camera
        except DeviceGoneError:
            self._lost.set()
            raise

    def gone(self, doing: str) -> DeviceGoneError:
        """The error of a device that is lost."""
        message = f"camera '{self.name}' is gone ({doing}); check its cable and power, and open the rig again"
        return DeviceGoneError(message)

    def latch(self) -> tuple[int, int, int] | None:
        """Host's time, the device's, host's time again, ns; None if it has no clock that can be looked at."""
        command, value = "TimestampLatch", "TimestampLatchValue"
        try:
            if not (self.features.has(command) and self.features.has(value)):
                return None
            before_ns = time.monotonic_ns()
            self.features.execute(command)
            after_ns = time.monotonic_ns()
            return before_ns, self.features.whole(value), after_ns
        except UnsupportedByDeviceError:
            return None

    @property
    def has_stamps(self) -> bool:
        """Whether frames may carry the device's own time."""
        return True

    @abstractmethod
    def told(self, doing: str) -> AbstractContextManager[None]:
        """Turn the library's errors within the block into slrig's."""

    @abstractmethod
    def kind(self, feature: str) -> str:
        """Boolean, Enumeration, String, Integer, Float, or what else the library calls a feature that it has."""

    @abstractmethod
    def start(self, buffers: int) -> GenICamStream:
        """Start the acquisition, with room for so many frames. No frame of an earlier one comes out of it."""

    @abstractmethod
    def close(self) -> None:
        """Let the device go. Idempotent; works after it is lost."""
