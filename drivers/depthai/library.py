"""The vendor's library, loaded when a device is first asked for: importing it takes seconds."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError
from slrig.model import Size

UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"'


GLOBAL_SHUTTER = frozenset({"OV9281", "OV9282", "OV9782", "OV7251", "AR0234"})
SNAPSHOT = frozenset({"OV9282", "OV9782", "AR0234"})
INSTALL = "pip install 'slrig[depthai]'"
ENVIRONMENT = {
    # It warns of every bus that it cannot see (a container without USB, for example).
    "DEPTHAI_LEVEL": "error",
    # It reports its use to its maker, and asks there for news. A rig tells nobody what it does.
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS": "1",
}
"""What the library reads when it is imported; what the user has set stays."""
_MICROSECOND = timedelta(microseconds=1)


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


@dataclass(frozen=True, slots=True)
class OakSensor:
    """One camera on a device. `name` is the chip's; `fastest_fps` is 0 where the device does not tell."""

    socket: str
    name: str
    size: Size
    colour: bool
    autofocus: bool
    fastest_fps: float

    @property
    def global_shutter(self) -> bool:
        """All rows are exposed together. A sensor that is not known is taken to roll."""
        return self.name.upper() in GLOBAL_SHUTTER

    @property
    def snapshot(self) -> bool:
        """An edge on FSIN starts an exposure at any time."""
        return self.name.upper() in SNAPSHOT

    def longest_skew_ns(self, fps: float) -> int:
        """How much later the last row may be exposed than the first, at most, ns.

        Rows are read out one after the other within one period of the fastest mode that reads them all.
        """
        if self.global_shutter:
            return 0
        return round(1e9 / max(self.fastest_fps, fps))


def read_sensors(features: Iterable[Any], vendor: Any) -> Mapping[str, OakSensor]:
    """The cameras that a device says it has, by socket; others than mono and colour are left out."""
    kinds = vendor.CameraSensorType
    found = {}
    for feature in features:
        # The first is what the sensor is used for unless asked otherwise.
        kind = feature.supportedTypes[0] if feature.supportedTypes else kinds.MONO
        if kind not in (kinds.MONO, kinds.COLOR) or feature.width < 1 or feature.height < 1:
            continue
        whole = [
            config.maxFps
            for config in feature.configs
            if (config.width, config.height) == (feature.width, feature.height)
        ]
        found[feature.socket.name] = OakSensor(
            socket=feature.socket.name,
            name=feature.sensorName,
            size=Size(feature.width, feature.height),
            colour=kind == kinds.COLOR,
            autofocus=feature.hasAutofocus,
            fastest_fps=max(whole, default=0.0),
        )
    return found


def load_depthai() -> Any:
    """Return the module `depthai`, version 3.12 or later.

    Raises
    ------
    LibraryMissingError
        It is not installed, cannot be loaded, or is too old.
    """
    # Asking whether it is there takes no time; importing it does.
    if importlib.util.find_spec("depthai") is None:
        message = f"OAK cameras need the library depthai, which is not installed: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL)
    for variable, value in ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    try:
        vendor = importlib.import_module("depthai")
    except ImportError as cause:
        message = f"OAK cameras need the library depthai, which is installed and cannot be loaded ({cause}): {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL) from cause
    if not hasattr(vendor.Pipeline, "setStopOnDeviceLoss"):
        found = getattr(vendor, "__version__", "an unknown version")
        message = f"OAK cameras need depthai 3.12 or later, found {found}: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL)
    return vendor


def nanoseconds(span: timedelta) -> int:
    """A duration of the library's, ns; its resolution is a microsecond.

    >>> nanoseconds(timedelta(milliseconds=2))
    2000000
    """
    return span // _MICROSECOND * 1_000


def microseconds(span: timedelta) -> int:
    """A duration of the library's, µs."""
    return span // _MICROSECOND
