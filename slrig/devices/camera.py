"""What slrig asks of a camera, and which calls a driver's camera takes now, refused alike by all drivers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Declared by a device: after how long without progress a call of it counts as hung.

    call_s : any call but `read`; a sequence is sent over a slow wire, a camera's streams are set up.
    read_slack_s : how much longer than twice its time-out a `read` may take.
    computed : the device is rendered or replayed. There is nothing to unplug, and no cable to check.
    """

    call_s: float = 30.0
    read_slack_s: float = 5.0
    computed: bool = False


DEFAULT_LIMITS = CallLimits()

COMPUTED_LIMITS = CallLimits(call_s=600.0, read_slack_s=600.0, computed=True)
"""Of what is rendered or replayed: as long as the machine takes beside its other work. A frame of 12 megapixels takes a
few seconds on a quiet one."""

_thread_local = threading.local()


def progress_reporter() -> Callable[[str], None]:
    """What to tell, in the call under way, what the driver is at: "tracing light, 30 %". A call that goes on telling is
    not taken for hung, and people are shown what it tells.

    Ask for it on the thread that was called; it may then be told on any. Where nobody listens it does nothing.
    """
    listener: Callable[[str], None] = getattr(_thread_local, "listener", _ignore_progress)
    return listener


@contextmanager
def listen_for_progress(listener: Callable[[str], None]) -> Iterator[None]:
    """Have `listener` told, within the block, what a driver called on this thread is at."""
    before = getattr(_thread_local, "listener", _ignore_progress)
    _thread_local.listener = listener
    try:
        yield
    finally:
        _thread_local.listener = before


def _ignore_progress(_doing: str) -> None:
    pass


class Trigger(StrEnum):
    """What starts an exposure. `FREE`: the camera runs by itself; `SOFTWARE`: `Camera.trigger`; `HARDWARE`: a wire."""

    FREE = "free"
    SOFTWARE = "software"
    HARDWARE = "hardware"


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Declared data about a camera. `triggers` are the ways in which an exposure can be started.

    `limits` say how long its calls may take. `notes` say what a person should know of how it runs, each in a sentence
    with what to do about it. `colour` : its frames can be had in colour, see `Frame.colour`.
    """

    name: str
    model: str
    serial: str
    format: CameraFormat
    triggers: frozenset[Trigger]
    exposure_range_s: tuple[float, float]
    gain_range: tuple[float, float]
    limits: CallLimits = DEFAULT_LIMITS
    notes: tuple[str, ...] = ()
    colour: bool = False


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a camera is asked for."""

    exposure_s: float
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class AppliedSettings:
    """What the camera says it uses, read back after it was set.

    least_period_s : the least time from the start of one exposure to the start of the next with these settings, which
    is the period of a camera that runs by itself; None where the device does not tell.
    """

    exposure_s: float
    gain: float
    min_period_s: float | None = None


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


class CameraState:
    """Open, armed or closed. A driver's camera asks it before it touches the device.

    name : the camera's, as the rig file calls it. armed : what it is armed for, None if it is not; the driver sets it.
    closed : set once the camera is, by any thread; whoever waits for a frame waits for this, too.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.armed: Trigger | None = None
        self.closed = threading.Event()

    def close(self) -> bool:
        """Not armed, and closed for good. Return whether it was open until now."""
        self.armed = None
        was_open = not self.closed.is_set()
        self.closed.set()
        return was_open

    def require_open(self) -> None:
        """Raise DeviceStateError after `close`."""
        if self.closed.is_set():
            raise DeviceStateError(f"camera '{self.name}' is closed; open the rig again")

    def require_armed(self, trigger: Trigger | None = None) -> None:
        """Raise DeviceStateError unless the camera is armed, for this trigger if one is given."""
        self.require_open()
        if self.armed is None:
            raise DeviceStateError(f"camera '{self.name}' is not armed{_for_trigger(trigger)}; call arm first")
        if trigger not in (None, self.armed):
            found = "runs free" if self.armed is Trigger.FREE else f"is armed{_for_trigger(self.armed)}"
            raise DeviceStateError(f"camera '{self.name}' {found}; read a frame, or arm it{_for_trigger(trigger)}")

    def require_settable(self) -> None:
        """Raise DeviceStateError of an armed camera, and after `close`."""
        self.require_open()
        if self.armed is not None:
            raise DeviceStateError(f"camera '{self.name}' is armed; disarm it before changing its settings")

    def check_settings(
        self, settings: CameraSettings, info: CameraInfo, *, within: float = 1e-9, hint: str = "choose such a value"
    ) -> None:
        """Refuse to set an armed camera, or values out of its declared ranges.

        within : how far out of its range a value may be, as a share of it. hint : how a refusal ends.

        Raises DeviceStateError: the camera is armed or closed; UnsupportedByDeviceError: a value is out of range.
        """
        self.require_settable()
        for what, asked, (least, most) in (
            ("exposure_s", settings.exposure_s, info.exposure_range_s),
            ("gain", settings.gain, info.gain_range),
        ):
            if not least * (1 - within) <= asked <= most * (1 + within):
                takes = f"{least:.6g} to {most:.6g}" if least < most else f"{least:.6g} only"
                message = f"camera '{self.name}': asked for {what} {asked:.6g}, it takes {takes}; {hint}"
                raise UnsupportedByDeviceError(message)

    def check_arming(self, count: int, trigger: Trigger, info: CameraInfo, *, hint: str = "") -> None:
        """Refuse to arm a camera that is armed, or for what it does not declare.

        hint : how a refusal ends.

        Raises DeviceStateError: the camera is armed already, or closed; UnsupportedByDeviceError: it has no such
        trigger, or no frame was asked for.
        """
        self.require_open()
        if self.armed is not None:
            raise DeviceStateError(f"camera '{self.name}' is armed already; disarm it first")
        if count < 1 or trigger not in info.triggers:
            raise UnsupportedByDeviceError(
                f"camera '{self.name}': asked for {count} frames by {trigger} trigger, it gives 1 or more by: "
                f"{', '.join(sorted(info.triggers))}{hint}"
            )


def _for_trigger(trigger: Trigger | None) -> str:
    return "" if trigger is None else f" for {trigger} triggers"
