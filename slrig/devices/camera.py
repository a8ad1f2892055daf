"""Camera protocol, the values it exchanges, and the state checks that all camera drivers share."""

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
    """Time without progress after which a call of a device counts as hung.

    call_s : for any call except `read`; it includes sending a sequence over a slow wire and starting a camera's stream.
    read_slack_s : time that `read` may take beyond twice its time-out.
    computed : the device is rendered or replayed, so it has no cable to check.
    """

    call_s: float = 30.0
    read_slack_s: float = 5.0
    computed: bool = False


DEFAULT_LIMITS = CallLimits()

COMPUTED_LIMITS = CallLimits(call_s=600.0, read_slack_s=600.0, computed=True)
"""For rendered and replayed devices, whose calls take as long as the load of the machine requires."""

_thread_local = threading.local()


def progress_reporter() -> Callable[[str], None]:
    """Return a function with which a driver reports progress of the current call, such as "tracing light, 30 %".

    Reports are displayed to the user, and a call that keeps reporting does not count as hung. Call this on the thread
    of the driver call; the returned function works on any thread, and does nothing without a listener.
    """
    listener: Callable[[str], None] = getattr(_thread_local, "listener", _ignore_progress)
    return listener


@contextmanager
def listen_for_progress(listener: Callable[[str], None]) -> Iterator[None]:
    """Pass to `listener` the progress that drivers called on this thread report within the block."""
    previous = getattr(_thread_local, "listener", _ignore_progress)
    _thread_local.listener = listener
    try:
        yield
    finally:
        _thread_local.listener = previous


def _ignore_progress(_text: str) -> None:
    pass


class Trigger(StrEnum):
    """Source of an exposure. `FREE`: the camera runs freely; `SOFTWARE`: `Camera.trigger`; `HARDWARE`: a wire."""

    FREE = "free"
    SOFTWARE = "software"
    HARDWARE = "hardware"


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Declared data of a camera.

    triggers : supported triggers. limits : time-outs of its calls. notes : remarks for the user about the camera's
    set-up, each a sentence with the remedy. colour : True if its frames have `Frame.colour`. exposed_by_pulse : True if
    a wire's pulse is its exposure, so that it cannot report how long it exposed.
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
    exposed_by_pulse: bool = False


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Requested settings of a camera."""

    exposure_s: float
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class AppliedSettings:
    """Settings read back from a camera.

    min_period_s : shortest time from the start of one exposure to the next, which is the period of a free-running
    camera; None if the device does not report it.
    """

    exposure_s: float
    gain: float
    min_period_s: float | None = None


@runtime_checkable
class Camera(Protocol):
    """A camera, used by one thread. Order: configure, arm, then trigger and read; disarm and close at any time."""

    @property
    def info(self) -> CameraInfo:
        """Declared data; readable in every state."""
        ...

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """Set exposure and gain, and return the values read back.
        Raises UnsupportedByDeviceError: a value is out of range; DeviceStateError: the camera is armed or closed.
        """
        ...

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare for `count` frames; a free-running camera may deliver more. Raises UnsupportedByDeviceError,
        DeviceStateError.
        """
        ...

    def trigger(self) -> None:
        """Start one exposure. Raises DeviceStateError unless the camera is armed for software triggers."""
        ...

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """Return the next frame of which every row began after `after_ns` (the rig's clock), time-stamp
        error subtracted; discard earlier frames.

        Raises FrameTimeoutError: no such frame came within `timeout_s`; DeviceGoneError: the device was unplugged;
        DeviceStateError: the camera is not armed.
        """
        ...

    def disarm(self) -> None:
        """Stop the exposures. Idempotent."""
        ...

    def close(self) -> None:
        """Release the device. Idempotent; works after an unplug and in every state."""
        ...


class CameraState:
    """State of a driver's camera: open, armed or closed. The driver checks it before each access to the device.

    name : name of the camera in the rig file. armed : trigger that the camera is armed for, or None; set by the driver.
    closed : event that any thread sets when the camera is closed; a thread that waits for a frame also waits for it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.armed: Trigger | None = None
        self.closed = threading.Event()

    def close(self) -> bool:
        """Mark the camera as closed. Return True if it was open."""
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
        """Raise DeviceStateError if the camera is armed or closed."""
        self.require_open()
        if self.armed is not None:
            raise DeviceStateError(f"camera '{self.name}' is armed; disarm it before changing its settings")

    def check_settings(
        self, settings: CameraSettings, info: CameraInfo, *, within: float = 1e-9, hint: str = "choose such a value"
    ) -> None:
        """Check that the camera can be configured and that the values are in its declared ranges.

        within : relative tolerance of the ranges. hint : end of the error message.

        Raises DeviceStateError: the camera is armed or closed; UnsupportedByDeviceError: a value is out of range.
        """
        self.require_settable()
        for name, requested, (low, high) in (
            ("exposure_s", settings.exposure_s, info.exposure_range_s),
            ("gain", settings.gain, info.gain_range),
        ):
            if not low * (1 - within) <= requested <= high * (1 + within):
                range_text = f"{low:.6g} to {high:.6g}" if low < high else f"{low:.6g} only"
                message = f"camera '{self.name}': requested {name} {requested:.6g}, it takes {range_text}; {hint}"
                raise UnsupportedByDeviceError(message)

    def check_arming(self, count: int, trigger: Trigger, info: CameraInfo, *, hint: str = "") -> None:
        """Check that the camera can be armed. hint : end of the error message.

        Raises DeviceStateError: the camera is armed already, or closed; UnsupportedByDeviceError: the trigger is not
        among the declared ones, or `count` is less than 1.
        """
        self.require_open()
        if self.armed is not None:
            raise DeviceStateError(f"camera '{self.name}' is armed already; disarm it first")
        if count < 1 or trigger not in info.triggers:
            raise UnsupportedByDeviceError(
                f"camera '{self.name}': requested {count} frames by {trigger} trigger, it gives 1 or more by: "
                f"{', '.join(sorted(info.triggers))}{hint}"
            )


def _for_trigger(trigger: Trigger | None) -> str:
    return "" if trigger is None else f" for {trigger} triggers"
