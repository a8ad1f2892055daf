"""What slrig asks of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from slrig.devices.limits import USUAL, CallLimits
from slrig.model import CameraFormat, Frame


class Trigger(StrEnum):
    """What starts an exposure. `FREE`: the camera runs by itself; `SOFTWARE`: `Camera.trigger`; `HARDWARE`: a wire."""

    FREE = "free"
    SOFTWARE = "software"
    HARDWARE = "hardware"


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Declared data about a camera. `triggers` are the ways in which an exposure can be started.

    `limits` say how long its calls may take.
    """

    name: str
    model: str
    serial: str
    format: CameraFormat
    triggers: frozenset[Trigger]
    exposure_range_s: tuple[float, float]
    gain_range: tuple[float, float]
    limits: CallLimits = USUAL


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a camera is asked for."""

    exposure_s: float
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class AppliedSettings:
    """What the camera says it uses, read back after it was set."""

    exposure_s: float
    gain: float


@runtime_checkable
class Camera(Protocol):
    """A camera. One thread owns it. Order: configure, arm, then trigger and read; disarm and close at any time."""

    @property
    def info(self) -> CameraInfo:
        """Declared data; readable in every state."""
        ...

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """Set exposure and gain, and return what the device reads back.
        Raises UnsupportedByDeviceError: the value is outside what the device can do; DeviceStateError: the camera is
        armed or closed.
        """
        ...

    def arm(self, count: int, trigger: Trigger) -> None:
        """Get ready for `count` frames. Raises UnsupportedByDeviceError, DeviceStateError."""
        ...

    def trigger(self) -> None:
        """Start one exposure (software trigger). Raises DeviceStateError unless armed for it."""
        ...

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """Return the next frame whose whole exposure lies after `after_ns` (the rig's clock).

        Frames that began earlier are stale and are passed over; they never come back.

        Raises FrameTimeoutError: no such frame came in `timeout_s`; DeviceGoneError: the device was unplugged;
        DeviceStateError: the camera is not armed.
        """
        ...

    def disarm(self) -> None:
        """Stop waiting for frames. Idempotent."""
        ...

    def close(self) -> None:
        """Let the device go. Idempotent; works after an unplug and in every state."""
        ...
