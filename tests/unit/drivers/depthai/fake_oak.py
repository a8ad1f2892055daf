"""OAK devices without hardware: `depthai` itself, with the two classes that need a device replaced."""

from __future__ import annotations

import importlib.util
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from queue import Empty, SimpleQueue
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.depthai.library import load_depthai
from slrig.model import Size
from tests.contract.stage import Stage

# A check that is never run is no check: on CI the library must be there.
if importlib.util.find_spec("depthai") is None and not os.environ.get("CI"):
    pytest.skip("the library depthai is not installed: pip install 'slrig[depthai]'", allow_module_level=True)
dai: Any = load_depthai()

DEVICE = "14442C10D13EABCE00"
ADDRESS = "1.2.3"


@dataclass
class Fault:
    """What goes wrong: shares of all frames, and of each sensor its own."""

    dropped: float = 0.0
    damaged: float = 0.0
    repeated: float = 0.0
    late_s: float = 0.0
    settling_frames: int = 2
    stuck_exposure_us: int | None = None
    stuck_lens: bool = False
    stamped_ahead_s: float = 0.0


@dataclass
class Chip:
    """A sensor that is fitted to the device."""

    socket: str = "CAM_B"
    name: str = "OV9282"
    colour: bool = False
    autofocus: bool = False


@dataclass
class FakeOak:
    """A device on the bench: what it has, what it sees, what goes wrong with it, and what was asked of it."""

    stage: Stage
    chips: Sequence[Chip] = (Chip("CAM_B"), Chip("CAM_C"))
    fault: Fault = field(default_factory=Fault)
    seed: int = 0
    plugged_in: bool = True
    held_elsewhere: bool = False
    forbidden: bool = False
    refuses: str | None = None
    calibration: Any = None
    infrared: bool = True
    infrared_obeys: bool = True
    opened: int = 0
    closed: int = 0
    asked: list[str] = field(default_factory=list)
    sensors: dict[str, Any] = field(default_factory=dict)
    ticks: Ticks | None = None
    unplugged: threading.Event = field(default_factory=threading.Event)

    @property
    def info(self) -> Any:
        states, status = dai.XLinkDeviceState, dai.XLinkError_t
        return dai.DeviceInfo(
            ADDRESS,
            DEVICE,
            states.X_LINK_BOOTED if self.held_elsewhere else states.X_LINK_UNBOOTED,
            dai.XLinkProtocol.X_LINK_USB_VSC,
            dai.XLinkPlatform.X_LINK_MYRIAD_X,
            status.X_LINK_INSUFFICIENT_PERMISSIONS if self.forbidden else status.X_LINK_SUCCESS,
        )

    @property
    def held_here(self) -> bool:
        return self.opened > self.closed

    def unplug(self) -> None:
        self.plugged_in = False
        self.unplugged.set()

    def pulse(self) -> None:
        """An edge on FSIN: at the same time for all, however late their threads come to it."""
        edge_ns = time.monotonic_ns()
        for sensor in self.sensors.values():
            sensor.edges_ns.put(edge_ns)

    @contextmanager
    def connected(self) -> Iterator[None]:
        oak = self

        class Device(FakeDevice):
            def __init__(self, info: Any) -> None:
                super().__init__(oak, info)

            @staticmethod
            def getAllAvailableDevices() -> list[Any]:  # noqa: N802 - the library's names
                there = oak.plugged_in and not oak.held_elsewhere and not oak.held_here
                return [oak.info] if there else []

            @staticmethod
            def getAllConnectedDevices() -> list[Any]:  # noqa: N802
                return [oak.info] if oak.plugged_in and not oak.held_here else []

        with mock.patch.object(dai, "Device", Device), mock.patch.object(dai, "Pipeline", HostOnlyPipeline):
            yield


class FakeDevice:
    """The members of `depthai.Device` that the driver uses, under the library's names."""

    def __init__(self, oak: FakeOak, info: Any) -> None:
        assert info.deviceId == DEVICE
        if oak.refuses is not None:
            raise RuntimeError(oak.refuses)
        oak.opened += 1
        self.oak = oak
        self._closed = False

    def setMaxReconnectionAttempts(self, attempts: int) -> None:  # noqa: N802
        self.oak.asked.append(f"reconnect {attempts}")

    def getProductName(self) -> str:  # noqa: N802
        return "OAK-D-PRO"

    def getDeviceName(self) -> str:  # noqa: N802
        return ""

    def getConnectedCameraFeatures(self) -> list[Any]:  # noqa: N802
        features = []
        size = self.oak.stage.format.size
        for chip in self.oak.chips:
            mode = dai.CameraSensorConfig()
            mode.width, mode.height, mode.maxFps = size.width_px, size.height_px, 240
            feature = dai.CameraFeatures()
            feature.socket = getattr(dai.CameraBoardSocket, chip.socket)
            feature.sensorName, feature.hasAutofocus = chip.name, chip.autofocus
            feature.width, feature.height = size.width_px, size.height_px
            feature.supportedTypes = [dai.CameraSensorType.COLOR if chip.colour else dai.CameraSensorType.MONO]
            feature.configs = [mode]
            features.append(feature)
        return features

    def getIrDrivers(self) -> list[tuple[str, int, int]]:  # noqa: N802
        return [("LM3644", 2, 0x63)] if self.oak.infrared else []

    def setIrLaserDotProjectorIntensity(self, intensity: float) -> bool:  # noqa: N802
        self.oak.asked.append(f"dots {intensity}")
        return self.oak.infrared_obeys

    def setIrFloodLightIntensity(self, intensity: float) -> bool:  # noqa: N802
        self.oak.asked.append(f"flood {intensity}")
        return self.oak.infrared_obeys

    def readCalibration2(self) -> Any:  # noqa: N802
        if self.oak.calibration is None:
            message = "No calibration flashed"
            raise RuntimeError(message)
        return self.oak.calibration

    def isClosed(self) -> bool:  # noqa: N802
        return self._closed or self.oak.unplugged.is_set()

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.oak.closed += 1
        if self.oak.unplugged.is_set():
            message = "X_LINK_ERROR"
            raise dai.XLinkError(message)


class Ticks:
    """When each frame's exposure ends: one clock for all sensors of a device, as its boards have."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ends_ns: list[int] = []

    def end_ns(self, number: int, period_ns: int) -> int:
        with self._lock:
            while len(self._ends_ns) <= number:
                last_ns = self._ends_ns[-1] if self._ends_ns else time.monotonic_ns()
                # A host that was held up sees a pause, not a burst.
                self._ends_ns.append(max(last_ns, time.monotonic_ns() - period_ns) + period_ns)
            return self._ends_ns[number]


HostOnly: Any = dai.Pipeline
Node: Any = dai.node.ThreadedHostNode


class HostOnlyPipeline(HostOnly):  # type: ignore[misc]
    """A pipeline without a device, in which cameras are host nodes."""

    def __init__(self, device: FakeDevice) -> None:
        super().__init__(False)
        self._oak = device.oak
        self._oak.ticks = Ticks()

    def create(self, kind: Any) -> Any:
        if kind is not dai.node.Camera:
            return super().create(kind)
        sensor = super().create(FakeSensor)
        sensor.oak = self._oak
        return sensor


class FakeSensor(Node):  # type: ignore[misc]
    """Plays `depthai.node.Camera`: one sensor before the stage."""

    oak: FakeOak

    def __init__(self) -> None:
        super().__init__()
        self.output = self.createOutput()
        self.inputControl = self.createInput()
        self.initialControl = dai.CameraControl()
        self.told = threading.Event()
        """Set when a setting has come in since the start: the library hands them over in a thread of its own."""
        self.edges_ns: SimpleQueue[int] = SimpleQueue()
        self._settings: list[tuple[int, Any]] = []

    def build(self, socket: Any, *, sensorFps: float) -> FakeSensor:
        self.socket, self._fps = socket.name, sensorFps
        self.oak.sensors[self.socket] = self
        self._rng = np.random.default_rng((self.oak.seed, socket.value))
        return self

    def requestOutput(  # noqa: N802
        self, size: tuple[int, int], kind: Any, *, resizeMode: Any, fps: float, enableUndistortion: bool
    ) -> Any:
        assert resizeMode == dai.ImgResizeMode.CROP
        assert fps == self._fps
        assert not enableUndistortion
        assert Size(*size) == self.oak.stage.format.size, "the stage has one size"
        self._kind = kind
        return self.output

    def run(self) -> None:
        command = dai.CameraControl.Command
        control = self.initialControl
        snapshot = control.getCommand(command.EXTERNAL_TRIGGER)
        assert control.getCommand(command.AE_MANUAL)
        exposure_us, iso = _exposure_us(control), control.getSensitivity()
        lens = 77 if self.oak.fault.stuck_lens else control.getLensPosition()
        number = 0
        while self.isRunning() and not self.oak.unplugged.is_set():
            for fresh in iter(self.inputControl.tryGet, None):
                self._settings.append((number + self.oak.fault.settling_frames, fresh))
                self.told.set()
            while self._settings and self._settings[0][0] <= number:
                _, fresh = self._settings.pop(0)
                exposure_us, iso = _exposure_us(fresh), fresh.getSensitivity()
            used_us = self.oak.fault.stuck_exposure_us or exposure_us
            if snapshot:
                try:
                    end_ns = self.edges_ns.get(timeout=0.02) + used_us * 1_000
                except Empty:
                    continue
            else:
                assert self.oak.ticks is not None
                end_ns = self.oak.ticks.end_ns(number, round(1e9 / self._fps))
            # Settings, losses and lateness are each sensor's own; a cable is everyone's.
            late_ns = round(self._rng.random() * self.oak.fault.late_s * 1e9)
            if self.oak.unplugged.wait(max(end_ns + late_ns - time.monotonic_ns(), 0) / 1e9):
                break
            self._deliver(number, end_ns, used_us, iso, lens)
            number += 1
        if self.oak.unplugged.is_set():
            self.stopPipeline()

    def _deliver(self, number: int, end_ns: int, used_us: int, iso: int, lens: int) -> None:
        fault = self.oak.fault
        if self._rng.random() < fault.dropped:
            return
        image = self.oak.stage.exposed(end_ns - used_us * 1_000, end_ns, gain=iso / 100).astype(np.uint8)
        frame = dai.ImgFrame()
        frame.setType(self._kind)
        rows, columns = image.shape
        frame.setWidth(columns)
        frame.setHeight(rows)
        # Rows are padded in the device's memory.
        stride = columns + 16
        frame.setStride(stride)
        planes = np.zeros((rows * (3 if self._kind == dai.ImgFrame.Type.NV12 else 2) // 2, stride), np.uint8)
        planes[:rows, :columns] = image
        # Grey of NV12, and a little red in the lower half.
        planes[rows:] = 128
        planes[rows + rows // 4 :, 1:columns:2] = 148
        frame.setData(self._damaged(frame, planes) if self._rng.random() < fault.damaged else planes.ravel())
        stamp = timedelta(microseconds=end_ns // 1_000) + timedelta(seconds=fault.stamped_ahead_s)
        frame.setTimestamp(stamp)
        frame.setTimestampDevice(stamp)
        frame.setSequenceNum(number)
        frame.cam.exposureTimeUs, frame.cam.sensitivityIso, frame.cam.lensPosition = used_us, iso, lens
        for _ in range(2 if self._rng.random() < fault.repeated else 1):
            self.output.send(frame)

    def _damaged(self, frame: Any, planes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut the data, or break the header; what is left of the picture is noise either way."""
        noise = self._rng.integers(0, 256, planes.size, dtype=np.uint8)
        if self._rng.random() < 0.5:
            return noise[: planes.size // 3]
        frame.setHeight(planes.shape[0] // 2)
        return noise


def _exposure_us(control: Any) -> int:
    return int(control.getExposureTime() // timedelta(microseconds=1))
