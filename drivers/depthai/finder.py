"""The OAK devices that are plugged in."""

from __future__ import annotations

from typing import Any

from drivers.depthai.board import open_device_ids
from drivers.depthai.library import load_depthai
from drivers.depthai.presence import UDEV_RULE, is_permitted
from slrig.devices import FoundDevice


def find_devices() -> tuple[FoundDevice, ...]:
    """Every OAK device that the library sees on USB and on the network, in half a second.

    Raises
    ------
    LibraryMissingError
        The library is not installed.
    """
    vendor = load_depthai()
    found = {info.deviceId or info.name: info for info in vendor.Device.getAllConnectedDevices()}
    held = open_device_ids()
    return tuple(
        FoundDevice("depthai", device, _label(info, device in held, vendor)) for device, info in sorted(found.items())
    ) + tuple(
        FoundDevice("depthai", device, "OAK device, in use by this process") for device in sorted(held - set(found))
    )


def _label(info: Any, held: bool, vendor: Any) -> str:
    where = f"OAK device at {info.name}" if info.name else "OAK device"
    if held:
        return f"{where}, in use by this process"
    if not is_permitted(info, vendor):
        return f"{where}, not permitted: it needs the udev rule {UDEV_RULE}"
    if info.state == vendor.XLinkDeviceState.X_LINK_BOOTED:
        return f"{where}, in use by another program"
    return where
