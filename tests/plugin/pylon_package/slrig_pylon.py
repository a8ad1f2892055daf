"""Basler cameras through pylon, the SDK of their vendor: an example of a driver as a package of its own.

slrig opens Basler's GigE and USB3 cameras itself (drivers `genicam` and `gentl`). This package shows how a driver for
a vendor's SDK is made, and can be tried without a camera: pylon emulates one where PYLON_CAMEMU=1 is set.

Each exposure is started by software. When it began is not told by the camera's time stamps, whose clock is not the
host's (and which the emulated camera does not give), but bounded by the host's clock: it began after the trigger was
sent, and ended before its frame was there. `pypylon` is under BSD; the runtime that its wheels bring is Basler's.
"""

from __future__ import annotations

import importlib
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, CameraState, FoundDevice, Trigger
from slrig.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    FrameTimeoutError,
    LibraryMissingError,
    UnsupportedByDeviceError,
)
from slrig.model import CameraFormat, Frame, Size

EXPOSURE_US, GAIN = ("ExposureTime", "ExposureTimeAbs"), ("Gain",)
"""What the cameras' generations call it. A camera that has more than one of them is set by all."""

RATES_HZ = ("BslResultingAcquisitionFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")

_BIT_DEPTH = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
_OFF = ("ExposureAuto", "GainAuto", "TriggerMode")
_AS_ASKED = 0.01
_SLICE_MS = 50
_READY_MS = 500
_CLOCK_ERROR_NS = 1_000


class Options(BaseModel):
    """The keys of a `[[camera]]` table that belong to this driver."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    device: str = Field(description="Serial number, as `slrig devices` lists it.")
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = Field(default="Mono8", description="By PFNC.")
    features: Mapping[str, bool | int | float | str] = Field(
        default_factory=dict, description="Further GenICam features, set in this order and read back."
    )


class PylonCamera:
    """Implements `slrig.devices.Camera`."""

    def __init__(self, name: str, options: Options, device: Any) -> None:
        self._name = name
        self._pylon = _pylon()
        self._state = CameraState(name)
        self._camera = self._pylon.InstantCamera(device)
        self._triggers: deque[int] = deque()
        self._block: int | None = None
        self._number, self._dropped = -1, 0
        with self._told("opening it"):
            self._camera.Open()
            try:
                self._prepare(options)
                self._info = self._declared(options.pixel_format, self._camera.GetDeviceInfo())
                self._applied = self._in_use()
            except BaseException:
                self._camera.Close()
                raise

    @property
    def info(self) -> CameraInfo:
        """See `Camera`. The gain is in dB."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`."""
        self._state.check_settings(settings, self._info)
        with self._told("setting exposure and gain"):
            for names, value in ((EXPOSURE_US, settings.exposure_s * 1e6), (GAIN, settings.gain)):
                for node in self._nodes(names):
                    node.SetValue(value)
            self._applied = self._in_use()
        for what, asked, got in (
            ("exposure_s", settings.exposure_s, self._applied.exposure_s),
            ("gain", settings.gain, self._applied.gain),
        ):
            if abs(got - asked) > _AS_ASKED * abs(asked) + 1e-9:
                message = f"camera '{self._name}': asked for {what} {asked:g}, it gives {got:g}; write that"
                raise UnsupportedByDeviceError(message)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. pylon allocates its buffers anew: no frame from before can come."""
        self._state.check_arming(count, trigger, self._info)
        self._triggers.clear()
        self._block, self._number, self._dropped = None, -1, 0
        with self._told("arming it"):
            self._camera.MaxNumBuffer.SetValue(max(10, min(count + 2, 100)))
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. A camera that is not ready ignores a trigger, so that is waited for."""
        self._state.require_armed(Trigger.SOFTWARE)
        with self._told("triggering it"):
            self._camera.WaitForFrameTriggerReady(
                _READY_MS + round(self._applied.exposure_s * 1e3), self._pylon.TimeoutHandling_ThrowException
            )
            # Noted before it is sent: the exposure cannot have begun earlier.
            self._triggers.append(time.monotonic_ns())
            self._camera.ExecuteSoftwareTrigger()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. What a frame is paired with is the first trigger that it may answer, so it may only be thought
        older than it is.
        """
        self._state.require_armed()
        give_up_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        passed = 0
        while True:
            left_ns = give_up_ns - time.monotonic_ns()
            with self._told("waiting for a frame"):
                wait_ms = min(max(left_ns // 1_000_000, 0), _SLICE_MS)
                result = self._camera.RetrieveResult(wait_ms, self._pylon.TimeoutHandling_Return)
            self._state.require_armed()  # another thread may have closed it meanwhile
            if result is not None and result.IsValid():
                try:
                    frame = self._frame(result)
                finally:
                    result.Release()
                if frame is not None and frame.t_start_ns - frame.t_err_ns >= after_ns:
                    return frame
                passed += 1
            elif left_ns <= 0:
                message = (
                    f"camera '{self._name}': no frame that began after {after_ns} ns came in {timeout_s:g} s ({passed} "
                    "passed over as stale or damaged); trigger after the pattern is shown"
                )
                raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        self._state.armed = None
        with suppress(self._pylon.GenericException):
            self._camera.StopGrabbing()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        if self._state.close():
            with suppress(self._pylon.GenericException):
                self._camera.Close()

    def _frame(self, result: Any) -> Frame | None:
        """The frame; None if it is damaged, or answers no trigger."""
        there_ns = time.monotonic_ns()
        block = int(result.BlockID)
        steps = 1 if self._block is None else max(block - self._block, 1)
        self._block, self._number = block, self._number + steps
        lost = steps - 1
        for _ in range(min(lost, len(self._triggers))):
            self._triggers.popleft()
        sent_ns = self._triggers.popleft() if self._triggers else None
        if sent_ns is None or not result.GrabSucceeded():
            self._dropped += lost + 1
            return None
        self._dropped += lost
        exposure_ns = round(self._applied.exposure_s * 1e9)
        # It began between the trigger and what its arrival leaves room for; with one instant known, that is it.
        latest_ns = max(there_ns - exposure_ns, sent_ns)
        start_ns = (sent_ns + latest_ns) // 2
        return Frame(
            camera=self._name,
            image=np.array(result.Array),
            t_start_ns=start_ns,
            t_end_ns=start_ns + exposure_ns,
            t_err_ns=start_ns - sent_ns + _CLOCK_ERROR_NS,
            sequence_number=self._number,
            dropped_count=self._dropped,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
        )

    def _prepare(self, options: Options) -> None:
        """Switch off what is automatic, set format and features, and let software start each exposure."""
        for automatic in _OFF:
            for node in self._nodes((automatic,)):
                node.SetValue("Off")
        own = {"PixelFormat": options.pixel_format, "AcquisitionMode": "Continuous"}
        trigger = {"TriggerSelector": "FrameStart", "TriggerMode": "On", "TriggerSource": "Software"}
        for feature, value in {**own, **options.features, **trigger}.items():
            found = list(self._nodes((feature,)))
            if not found:
                message = f"camera '{self._name}' has no feature {feature} that can be set; take it out of features"
                raise UnsupportedByDeviceError(message)
            with self._told(f"setting {feature}"):
                found[0].SetValue(value)
            if (got := found[0].GetValue()) != value:
                message = f"camera '{self._name}': asked for {feature} {value}, it gives {got}; write that"
                raise UnsupportedByDeviceError(message)

    def _declared(self, pixel_format: str, device: Any) -> CameraInfo:
        ranges = []
        for names, unit in ((EXPOSURE_US, 1e6), (GAIN, 1.0)):
            nodes = list(self._nodes(names))
            bounds = [(node.GetMin() / unit, node.GetMax() / unit) for node in nodes] or [(1.0, 1.0)]
            ranges.append((max(least for least, _ in bounds), min(most for _, most in bounds)))
        size = Size(int(self._camera.Width.GetValue()), int(self._camera.Height.GetValue()))
        return CameraInfo(
            name=self._name,
            model=f"{device.GetVendorName()} {device.GetModelName()}",
            serial=str(device.GetSerialNumber()),
            format=CameraFormat(size, _BIT_DEPTH[pixel_format]),
            triggers=frozenset({Trigger.SOFTWARE}),
            exposure_range_s=ranges[0],
            gain_range=ranges[1],
        )

    def _in_use(self) -> AppliedSettings:
        """What the camera reads back. It gives no more than its resulting rate, nor more than fits its exposure."""
        exposure_s, gain = (
            float(next((node.GetValue() for node in self._nodes(names)), 1.0)) for names in (EXPOSURE_US, GAIN)
        )
        exposure_s /= 1e6
        rates = [node.GetValue() for node in self._nodes(RATES_HZ, access="IsReadable")]
        period_s = max(exposure_s, 1 / rates[0]) if rates and rates[0] > 0 else None
        return AppliedSettings(exposure_s, gain, period_s)

    def _nodes(self, names: tuple[str, ...], access: str = "IsWritable") -> Iterator[Any]:
        """Those of the features that the camera has, and lets be set (or read) now."""
        allows = getattr(importlib.import_module("pypylon.genicam"), access)
        yield from filter(allows, map(self._camera.GetNodeMap().GetNode, names))

    @contextmanager
    def _told(self, doing: str) -> Iterator[None]:
        """Turn pylon's errors into slrig's."""
        self._state.require_open()
        try:
            yield
        except self._pylon.GenericException as error:
            self._state.require_open()
            what = f"camera '{self._name}', {doing}: {str(error).split(' : ')[0]}"
            if self._camera.IsCameraDeviceRemoved():
                raise DeviceGoneError(f"{what}; check its cable, and open the rig again") from error
            if isinstance(error, self._pylon.OutOfRangeException | self._pylon.InvalidArgumentException):
                raise UnsupportedByDeviceError(f"{what}; write what the camera takes") from error
            raise DeviceError(f"{what}; look at the camera with Basler's pylon Viewer") from error


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a Basler camera. Raises LibraryMissingError, DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError."""
    del folder
    table = Options.model_validate(dict(options))
    factory = _pylon().TlFactory.GetInstance()
    found = {device.GetSerialNumber(): device for device in factory.EnumerateDevices()}
    if table.device not in found:
        message = f"camera '{name}': no camera '{table.device}'; found {', '.join(found) or 'none'}; correct device"
        raise DeviceGoneError(message)
    device = found[table.device]
    if not factory.IsDeviceAccessible(device):
        raise DeviceBusyError(f"camera '{name}': another program holds '{table.device}'; close that program")
    return PylonCamera(name, table, factory.CreateDevice(device))


def find_devices() -> tuple[FoundDevice, ...]:
    """Every camera that pylon sees; opens none. Raises LibraryMissingError."""
    devices = _pylon().TlFactory.GetInstance().EnumerateDevices()
    return tuple(FoundDevice("pylon", each.GetSerialNumber(), each.GetFriendlyName()) for each in devices)


def _pylon() -> Any:
    try:
        return importlib.import_module("pypylon.pylon")
    except ImportError as error:
        message = f"the pylon driver needs pypylon, found: {error}"
        raise LibraryMissingError(message, install="pip install pypylon") from error
