"""Whether an OAK device is there and may be opened. Asked first: opening one that is not there blocks for seconds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError

UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"'


def is_permitted(info: Any, vendor: Any) -> bool:
    """Whether the system lets this user open a device."""
    return bool(info.status != vendor.XLinkError_t.X_LINK_INSUFFICIENT_PERMISSIONS)


def find_available(device: str, vendor: Any) -> Any:
    """Return the library's description of a device that can be opened, by id, address or port.

    Raises
    ------
    DeviceBusyError
        Another program holds it.
    DeviceGoneError
        It is not there.
    DeviceError
        The system does not let this user open it.
    """
    info = _find_by_name(device, vendor.Device.getAllAvailableDevices())
    if info is not None and is_permitted(info, vendor):
        return info
    connected = vendor.Device.getAllConnectedDevices()
    info = info or _find_by_name(device, connected)
    if info is None:
        seen = ", ".join(sorted(other.deviceId or other.name for other in connected)) or "none"
        message = (
            f"OAK device '{device}' is not there; found: {seen}. Plug it in, wait for it to start, and write its id "
            "as `slrig devices` shows it"
        )
        raise DeviceGoneError(message)
    if not is_permitted(info, vendor):
        raise DeviceError(_permission_message(device))
    message = (
        f"OAK device '{device}' is held by another program (state {info.state.name}); close that program, or unplug "
        "the device and plug it in again"
    )
    raise DeviceBusyError(message)


def _find_by_name(device: str, infos: Iterable[Any]) -> Any:
    return next((info for info in infos if device in (info.deviceId, info.name)), None)


def _permission_message(device: str) -> str:
    return (
        f"OAK device '{device}' is there and this user may not open it; write {UDEV_RULE} into "
        "/etc/udev/rules.d/80-movidius.rules, run `udevadm control --reload-rules && udevadm trigger`, and plug it in "
        "again"
    )
