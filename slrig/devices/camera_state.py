"""Which calls a driver's camera takes now, and the refusal of the others, in the same words for all drivers."""

from __future__ import annotations

import threading

from slrig.devices.camera import CameraInfo, CameraSettings, Trigger
from slrig.errors import DeviceStateError, UnsupportedByDeviceError


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
            message = f"camera '{self.name}' is closed; open the rig again"
            raise DeviceStateError(message)

    def require_armed(self, trigger: Trigger | None = None) -> None:
        """Raise DeviceStateError unless the camera is armed, for this trigger if one is given."""
        self.require_open()
        if self.armed is None:
            message = f"camera '{self.name}' is not armed{_for(trigger)}; call arm first"
            raise DeviceStateError(message)
        if trigger not in (None, self.armed):
            found = "runs free" if self.armed is Trigger.FREE else f"is armed{_for(self.armed)}"
            message = f"camera '{self.name}' {found}; read a frame, or arm it{_for(trigger)}"
            raise DeviceStateError(message)

    def require_settable(self) -> None:
        """Raise DeviceStateError of an armed camera, and after `close`."""
        self.require_open()
        if self.armed is not None:
            message = f"camera '{self.name}' is armed; disarm it before changing its settings"
            raise DeviceStateError(message)

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
            message = f"camera '{self.name}' is armed already; disarm it first"
            raise DeviceStateError(message)
        if count < 1 or trigger not in info.triggers:
            message = (
                f"camera '{self.name}': asked for {count} frames by {trigger} trigger, it gives 1 or more by: "
                f"{', '.join(sorted(info.triggers))}{hint}"
            )
            raise UnsupportedByDeviceError(message)


def _for(trigger: Trigger | None) -> str:
    return "" if trigger is None else f" for {trigger} triggers"
