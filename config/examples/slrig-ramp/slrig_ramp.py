"""A camera before a grey ramp: what a slrig driver is, in one module."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, CameraState, FoundDevice, Trigger
from slrig.errors import DeviceGoneError, FrameTimeoutError
from slrig.model import CameraFormat, Frame, Pixels, Size

SIZE, EXPOSURES_S, STAMP_ERROR_NS = Size(160, 120), (0.001, 0.1), 10_000


class Sensor:
    """Stands for your device's library: exposes back to back, keeps four frames, stamps each when it ends."""

    def start(self, exposure_s: float) -> None:
        """Begin exposing back to back."""
        self.exposure_ns, self.begun_ns, self.number = round(exposure_s * 1e9), time.monotonic_ns(), -1

    def wait(self, timeout_s: float) -> tuple[int, int, Pixels] | None:
        """The oldest frame that is kept, or the next: number, end of exposure, image. None if none comes in time."""
        number = max(self.number + 1, (time.monotonic_ns() - self.begun_ns) // self.exposure_ns - 4)
        end_ns = self.begun_ns + (number + 1) * self.exposure_ns
        left_s = (end_ns - time.monotonic_ns()) / 1e9
        time.sleep(min(max(left_s, 0.0), timeout_s))
        if left_s > timeout_s:
            return None
        self.number = number
        return number, end_ns, self.exposed(end_ns - self.exposure_ns, end_ns)

    def exposed(self, start_ns: int, end_ns: int) -> Pixels:
        """Image of an exposure: a horizontal ramp, brighter the longer the exposure."""
        ramp = np.linspace(0, 2.55e-6 * (end_ns - start_ns), SIZE.width_px)
        return np.tile(np.clip(ramp, 0, 255).astype(np.uint8), (SIZE.height_px, 1))


class RampCamera:
    """Implements slrig.devices.Camera."""

    def __init__(self, name: str, device: str) -> None:
        free = frozenset({Trigger.FREE})
        self.info = CameraInfo(name, "ramp camera", device, CameraFormat(SIZE, 8), free, EXPOSURES_S, (1.0, 1.0))
        self.sensor, self.exposure_s, self.state = Sensor(), EXPOSURES_S[0], CameraState(name)

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """Set exposure and gain; return what the device applied."""
        self.state.check_settings(settings, self.info)
        self.exposure_s = settings.exposure_s
        return AppliedSettings(self.exposure_s, 1.0)  # of a real device: what was read back

    def arm(self, count: int, trigger: Trigger) -> None:
        """Start delivering frames."""
        self.state.check_arming(count, trigger, self.info)
        self.sensor.start(self.exposure_s)
        self.state.armed, self.last, self.dropped = trigger, -1, 0

    def trigger(self) -> None:
        """Refuse: this camera runs by itself."""
        self.state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """Return the first frame whose whole exposure began after `after_ns`."""
        self.state.require_armed()
        give_up_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while (left_ns := give_up_ns - time.monotonic_ns()) > 0:
            came = self.sensor.wait(left_ns / 1e9)
            self.state.require_armed()  # another thread may have closed it meanwhile
            if came is None:
                break
            number, end_ns, image = came
            start_ns = end_ns - round(self.exposure_s * 1e9)
            self.last, self.dropped = number, self.dropped + number - self.last - 1
            if start_ns - STAMP_ERROR_NS >= after_ns:  # the rule; what began before is stale, and gone for good
                name, exposure_s = self.info.name, self.exposure_s
                return Frame(name, image, start_ns, end_ns, STAMP_ERROR_NS, number, self.dropped, exposure_s, 1.0)
        raise FrameTimeoutError(f"camera '{self.info.name}': no frame that began after {after_ns} ns in {timeout_s} s")

    def disarm(self) -> None:
        """Stop delivering frames."""
        self.state.armed = None

    def close(self) -> None:
        """Release the device."""
        self.state.close()


class Options(BaseModel, extra="forbid"):
    """Options of the driver in a rig file."""

    device: str = "ramp-0"


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:  # noqa: ARG001 - it reads no files
    """Open the camera that a rig file names; `folder` is the rig file's."""
    device = Options.model_validate(options).device
    if device != "ramp-0":
        raise DeviceGoneError(f"camera '{name}': asked for '{device}', found ramp-0; correct device in the rig file")
    return RampCamera(name, device)


def find_devices() -> tuple[FoundDevice, ...]:
    """List the connected devices."""
    return (FoundDevice("ramp", "ramp-0", "grey ramp"),)
