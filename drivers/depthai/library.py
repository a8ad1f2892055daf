"""The library DepthAI, the OAK devices it finds, and the properties of their sensors.

https://docs.luxonis.com/hardware/platform/deploy/frame-sync lists the sensors with a global shutter, and those that
expose at any time when triggered (snapshot). The others can only be synchronised to a continuous stream at their own
frame rate, which cannot wait for a pattern.

Availability is checked before opening, because opening an absent device blocks for seconds. The library is loaded when
a device is first requested, because its import takes seconds.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.libraries import loading
from slrig.bundle import Strict
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError
from slrig.model import Size

DEFAULT_FPS = 20.0

Socket = Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D", "CAM_E", "CAM_F", "CAM_G", "CAM_H"]
TriggerCount = Annotated[int, Field(ge=0, le=255)]
PixelExtent = Annotated[int, Field(ge=16, le=16384)]


class OakOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "depthai"` (in addition to name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """The device's id as `slrig devices` lists it, or its address or USB port. Several tables may name the same device:
    it is opened once, and its cameras are synchronised frame by frame."""

    socket: Socket
    """Camera of the device. On an OAK-D, CAM_A is the colour camera, CAM_B the left and CAM_C the right mono camera."""

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)] | None = None
    """[width, height] of the frames; default: the sensor's size."""

    fps: Annotated[float, Field(ge=1, le=240, json_schema_extra={"unit": "Hz"})] = DEFAULT_FPS
    """Frame rate of the sensor; it limits the exposure. The same for all cameras of a device."""

    focus: Annotated[int, Field(ge=0, le=255)] | None = None
    """Lens position of a camera with autofocus (which is switched off); default: the position of the factory
    calibration."""

    colour_temperature_k: Annotated[int, Field(ge=1000, le=12000)] = 5000
    """Fixed white balance of a colour camera."""

    external_trigger: bool = False
    """A rising edge on the pin FSIN starts each exposure. The same for all cameras of a device. Needs frames of the
    sensor's full height: with fewer rows, none come."""

    trigger_burst: Annotated[tuple[TriggerCount, TriggerCount], Field(strict=False)] = (1, 0)
    """With an external trigger: how many frames each edge takes, and how many of them are thrown away; one must be
    left. Luxonis' examples have [4, 3]: try that if [1, 0] gives no frames. The frame that is left then begins three
    frame times after its edge, so its pattern must be lit for as long."""


@dataclass(frozen=True, slots=True)
class OakStream:
    """Stream of one camera: options, completed with the device's properties.

    focus : None for a camera without autofocus. colour : frames are NV12, else GRAY8.
    """

    socket: str
    size: Size
    fps: float
    colour: bool
    focus: int | None
    colour_temperature_k: int
    external_trigger: bool
    trigger_burst: tuple[int, int]

    @property
    def period_ns(self) -> int:
        """Frame period, ns."""
        return round(1e9 / self.fps)


UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"'


GLOBAL_SHUTTER = frozenset({"OV9281", "OV9282", "OV9782", "OV7251", "AR0234"})
SNAPSHOT = frozenset({"OV9282", "OV9782", "AR0234"})
INSTALL = "pip install 'slrig[depthai]'"
ENVIRONMENT = {
    # Without this it warns of every invisible bus (in a container without USB, for example).
    "DEPTHAI_LEVEL": "error",
    # Switch off usage reports and update checks.
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS": "1",
}
"""Variables that the library reads on import; values set by the user are kept."""
_MICROSECOND = timedelta(microseconds=1)


def is_permitted(info: Any, vendor: Any) -> bool:
    """True if this user may open the device."""
    return bool(info.status != vendor.XLinkError_t.X_LINK_INSUFFICIENT_PERMISSIONS)


def find_available(device: str, vendor: Any) -> Any:
    """Return the library's description of a device that can be opened, by id, address or port.

    Raises DeviceBusyError if another program holds it, DeviceGoneError if it is not connected, and DeviceError if this
    user may not open it.
    """
    info = _find_by_name(device, vendor.Device.getAllAvailableDevices())
    if info is not None and is_permitted(info, vendor):
        return info
    connected = vendor.Device.getAllConnectedDevices()
    info = info or _find_by_name(device, connected)
    if info is None:
        connected_ids = ", ".join(sorted(other.deviceId or other.name for other in connected)) or "none"
        message = (
            f"OAK device '{device}' not found; found: {connected_ids}. Plug it in, wait for it to start, and write its "
            "id as `slrig devices` shows it"
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
        f"OAK device '{device}': this user may not open it; write {UDEV_RULE} into "
        "/etc/udev/rules.d/80-movidius.rules, run `udevadm control --reload-rules && udevadm trigger`, and plug it in "
        "again"
    )


@dataclass(frozen=True, slots=True)
class OakSensor:
    """One camera on a device. `name` is the chip's; `fastest_fps` is 0 if unknown."""

    socket: str
    name: str
    size: Size
    colour: bool
    autofocus: bool
    fastest_fps: float

    @property
    def global_shutter(self) -> bool:
        """True if all rows are exposed together. Unknown sensors are assumed to have a rolling shutter."""
        return self.name.upper() in GLOBAL_SHUTTER

    @property
    def snapshot(self) -> bool:
        """True if an edge on FSIN starts an exposure at any time."""
        return self.name.upper() in SNAPSHOT

    def longest_skew_ns(self, fps: float) -> int:
        """Maximum delay of the last row's exposure after the first row's, ns.

        All rows are read out within one period of the fastest full-frame mode.
        """
        if self.global_shutter:
            return 0
        return round(1e9 / max(self.fastest_fps, fps))


def read_sensors(features: Iterable[Any], vendor: Any) -> Mapping[str, OakSensor]:
    """Return the mono and colour cameras of a device by socket."""
    kinds = vendor.CameraSensorType
    found = {}
    for feature in features:
        # The first type is the default.
        kind = feature.supportedTypes[0] if feature.supportedTypes else kinds.MONO
        if kind not in (kinds.MONO, kinds.COLOR) or feature.width < 1 or feature.height < 1:
            continue
        full_frame_rates = [
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
            fastest_fps=max(full_frame_rates, default=0.0),
        )
    return found


def load_depthai() -> Any:
    """Return the module `depthai`, version 3.12 or later. Raises LibraryMissingError if it is missing, broken or too
    old.
    """
    for variable, value in ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    with loading("depthai", "depthai", install=INSTALL, packages="depthai"):
        vendor = importlib.import_module("depthai")
    if not hasattr(vendor.Pipeline, "setStopOnDeviceLoss"):
        found = getattr(vendor, "__version__", "an unknown version")
        message = f"OAK cameras need depthai 3.12 or later, found {found}: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL)
    return vendor


def nanoseconds(span: timedelta) -> int:
    """Convert a duration of the library to ns; its resolution is a microsecond.

    >>> nanoseconds(timedelta(milliseconds=2))
    2000000
    """
    return span // _MICROSECOND * 1_000


def microseconds(span: timedelta) -> int:
    """Convert a duration of the library to µs."""
    return span // _MICROSECOND
