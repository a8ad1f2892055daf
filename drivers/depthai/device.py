"""An OAK device, opened once per process for all its cameras: one pipeline, frames synchronised on the host.

A running pipeline cannot be changed, so it starts when the first camera is used, with every camera opened by then. A
thread takes the delivered frames, checks them and distributes them to the cameras.

The library's time stamp is that of the first byte on the sensor's bus: a few microseconds after the end of the
exposure, of the first row for a rolling shutter (github.com/luxonis/depthai/issues/795). It counts in the library's
clock, which is CLOCK_MONOTONIC.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np

from drivers.depthai.library import (
    UDEV_RULE,
    OakSensor,
    OakStream,
    find_available,
    is_permitted,
    load_depthai,
    microseconds,
    nanoseconds,
    read_sensors,
)
from drivers.v4l2.formats import bgr_from_luma
from slrig.devices import FoundDevice
from slrig.errors import (
    CalibrationError,
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    UnsupportedByDeviceError,
)
from slrig.model import Pixels

MAX_WAITING_FRAMES = 4
"""Number of frames stored for a reader while a camera runs freely; older ones are stale."""
STAMP_ERR_NS = {"USB": 600_000, "network": 1_500_000}
"""Error of the device's clock: three times the standard deviations that Luxonis states (200 µs by USB, 500 µs by
Ethernet; docs.luxonis.com, Device, host clock syncing)."""
_QUEUED_MESSAGES = 16
_LISTEN = timedelta(milliseconds=200)
_CLOSE_S = 10.0
_MAX_CLOCK_OFFSET_NS = 5_000_000
_DEVICES: dict[str, OakDevice] = {}
_DEVICES_LOCK = threading.Lock()


@dataclass(frozen=True, slots=True)
class OakFrame:
    """A complete frame. `t_start_ns` and `t_end_ns` are those of the first row, CLOCK_MONOTONIC.

    message : the library's `ImgFrame`; its pixels are copied only if the frame is used.
    """

    message: Any
    number: int
    t_start_ns: int
    t_end_ns: int
    received_ns: int
    exposure_us: int
    iso: int
    lens_position: int


def find_frame_fault(message: Any, stream: OakStream, received_ns: int, err_ns: int, vendor: Any) -> str | None:
    """Return the reason why a frame is unusable; None if it is complete.

    A truncated frame has less data than its header announces; a frame with a damaged header has a wrong size or type. A
    frame that claims to end after it arrived would pass as a new one.
    """
    size, kind = stream.size, frame_type(stream, vendor)
    if message.getType() != kind or (message.getWidth(), message.getHeight()) != (size.width_px, size.height_px):
        return f"{message.getWidth()} x {message.getHeight()} {message.getType()} where {size} {kind} was requested"
    stride, rows = message.getStride(), size.height_px * (3 if stream.colour else 2) // 2
    if stride < size.width_px or len(message.getData()) < stride * rows:
        return f"{len(message.getData())} bytes where {stride} x {rows} were announced"
    if microseconds(message.getExposureTime()) <= 0:
        return "no exposure time given"
    if nanoseconds(message.getTimestamp()) - err_ns > received_ns:
        return "time stamp later than its arrival"
    return None


def read_frame(message: Any, received_ns: int, vendor: Any) -> OakFrame:
    """Read the metadata of a complete frame."""
    offsets = vendor.CameraExposureOffset
    return OakFrame(
        message=message,
        number=message.getSequenceNum(),
        t_start_ns=nanoseconds(message.getTimestamp(offsets.START)),
        t_end_ns=nanoseconds(message.getTimestamp(offsets.END)),
        received_ns=received_ns,
        exposure_us=microseconds(message.getExposureTime()),
        iso=message.getSensitivity(),
        lens_position=message.getLensPosition(),
    )


def read_luminance(message: Any, stream: OakStream) -> Pixels:
    """Copy the grey levels, or the luminance of a colour frame, with which NV12 begins: (H, W) uint8."""
    stride, size = message.getStride(), stream.size
    plane = np.asarray(message.getData(), dtype=np.uint8)[: stride * size.height_px]
    return plane.reshape(size.height_px, stride)[:, : size.width_px].copy()


def colour_reader(message: Any, luma: Pixels) -> Callable[[], Pixels]:
    """Return a function that makes a colour frame from its luminance and chrominance.

    The chrominance, copied here, follows the luminance in NV12: blue and red in turn, half as many rows and columns.
    """
    stride, (rows, columns) = message.getStride(), luma.shape
    planes = np.asarray(message.getData(), dtype=np.uint8)[stride * rows :][: stride * (rows // 2)]
    differences = planes.reshape(-1, stride)[:, :columns].copy()
    return lambda: bgr_from_luma(luma, differences[:, ::2], differences[:, 1::2])


def frame_type(stream: OakStream, vendor: Any) -> Any:
    """Return the library's type of the frames."""
    return vendor.ImgFrame.Type.NV12 if stream.colour else vendor.ImgFrame.Type.GRAY8


class FrameQueue:
    """Frames of one camera from the receiving thread to the reader. Thread-safe.

    Counts lost frames by gaps in the sequence numbers; damaged frames leave gaps as well.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[OakFrame] = deque(maxlen=MAX_WAITING_FRAMES)
        self._last_number = -1
        self._lost = 0
        self._damage = ""
        self._ended: str | None = None

    @property
    def losses(self) -> tuple[int, str]:
        """Number of frames lost since `begin`, and the fault of the last damaged one."""
        with self._changed:
            return self._lost, self._damage

    def begin(self, capacity: int = MAX_WAITING_FRAMES) -> None:
        """Drop waiting frames and reset the counter."""
        with self._changed:
            self._waiting = deque(maxlen=capacity)
            self._lost, self._damage = 0, ""

    def put(self, delivery: OakFrame) -> None:
        """Add a frame. Repeated frames are dropped; a gap in the numbers counts as lost."""
        with self._changed:
            if delivery.number <= self._last_number:
                return
            if self._last_number >= 0:
                self._lost += delivery.number - self._last_number - 1
            self._last_number = delivery.number
            self._waiting.append(delivery)
            self._changed.notify_all()

    def note_damage(self, fault: str) -> None:
        """Note the fault of a frame. It is counted by its gap, since its own number may be damaged."""
        with self._changed:
            self._damage = fault

    def count_loss(self) -> None:
        """Count one more frame that the reader had to skip."""
        with self._changed:
            self._lost += 1

    def take(self, until_ns: int) -> OakFrame | None:
        """Return the oldest waiting frame, or None if none arrives by this time (CLOCK_MONOTONIC). Raises
        DeviceGoneError if no more frames will arrive.
        """
        with self._changed:
            while True:
                if self._ended is not None:
                    raise DeviceGoneError(self._ended)
                if self._waiting:
                    return self._waiting.popleft()
                left_ns = until_ns - time.monotonic_ns()
                if left_ns <= 0:
                    return None
                self._changed.wait(left_ns / 1e9)

    def end(self, reason: str) -> None:
        """Mark that no more frames will arrive. The first reason is kept."""
        with self._changed:
            if self._ended is None:
                self._ended = reason
            self._waiting.clear()
            self._changed.notify_all()


@dataclass(frozen=True, slots=True)
class CameraLink:
    """A camera that uses a device: its stream, its first settings (`start`) and the queue of its frames."""

    stream: OakStream
    start: Callable[[Any], None]
    frames: FrameQueue


class OakDevice:
    """An open device. Made by `open_device`; its cameras `join` and `leave`, the last one closes it.

    Raises DeviceBusyError, DeviceGoneError or DeviceError if it cannot be opened.
    """

    def __init__(self, info: Any, vendor: Any) -> None:
        self._vendor = vendor
        self.device_id: str = info.deviceId or info.name
        self.address: str = info.name
        require_one_clock(vendor)
        with _translate_errors(self.device_id, vendor):
            self._device = vendor.Device(info)
        try:
            with _translate_errors(self.device_id, vendor):
                # A reconnected device would have other settings, so reconnection is disabled.
                self._device.setMaxReconnectionAttempts(0)
                self.model: str = self._device.getProductName() or self._device.getDeviceName() or "OAK"
                self.sensors: Mapping[str, OakSensor] = read_sensors(self._device.getConnectedCameraFeatures(), vendor)
                self._pipeline = vendor.Pipeline(self._device)
                self._pipeline.setStopOnDeviceLoss(True)
            by_network = info.protocol == vendor.XLinkProtocol.X_LINK_TCP_IP
            self.err_ns = STAMP_ERR_NS["network" if by_network else "USB"]
        except BaseException:
            with suppress(Exception):
                self._device.close()
            raise
        self._lock = threading.Lock()
        self._links: dict[str, CameraLink] = {}
        self._running: Mapping[str, CameraLink] | None = None
        self._controls: dict[str, Any] = {}
        self._users: set[str] = set()
        self._closing = threading.Event()
        self._listener: threading.Thread | None = None
        self._gone: str | None = None
        self._refusal: str | None = None

    def factory_calibration(self) -> Any:
        """Return the library's handler of the factory calibration. Raises CalibrationError if there is none."""
        with _translate_errors(self.device_id, self._vendor):
            try:
                return self._device.readCalibration2()
            except self._vendor.XLinkError:
                raise
            except RuntimeError as cause:
                message = (
                    f"OAK device '{self.device_id}' stores no calibration ({cause}); calibrate the rig with "
                    "a board instead"
                )
                raise CalibrationError(message) from cause

    def join(self, link: CameraLink) -> FrameQueue:
        """Use one camera; return the queue of its frames.

        Raises
        ------
        DeviceBusyError
            The camera is in use already, or the device streams without it.
        ConfigError
            Its settings differ from those of the device's other cameras.
        DeviceGoneError
            The device was unplugged.
        """
        stream = link.stream
        with self._lock:
            self._require_connected()
            if stream.socket in self._users:
                message = (
                    f"camera {stream.socket} of OAK device '{self.device_id}' is open already; close it first, or name "
                    "another socket"
                )
                raise DeviceBusyError(message)
            for other in self._links.values():
                for key, requested, current in (
                    ("fps", stream.fps, other.stream.fps),
                    ("external_trigger", stream.external_trigger, other.stream.external_trigger),
                ):
                    if stream.socket != other.stream.socket and requested != current:
                        message = (
                            f"camera {stream.socket} of OAK device '{self.device_id}': {key} is {requested}, that of "
                            f"its camera {other.stream.socket} is {current}; one device exposes its cameras together: "
                            "write the same for all of them"
                        )
                        raise ConfigError(message)
            if self._running is None:
                self._links[stream.socket] = link
            elif stream.socket not in self._running or self._running[stream.socket].stream != stream:
                message = (
                    f"OAK device '{self.device_id}' is streaming from {', '.join(sorted(self._running))} already, and "
                    f"{stream.socket} cannot be added or changed now; open all its cameras before the first is used"
                )
                raise DeviceBusyError(message)
            self._users.add(stream.socket)
            return self._links[stream.socket].frames

    def leave(self, socket: str) -> None:
        """Stop using one camera; close the device after the last one. Works after an unplug."""
        with self._lock:
            self._users.discard(socket)
            if self._running is None:
                self._links.pop(socket, None)
        self.close_unless_used()

    def close_unless_used(self) -> None:
        """Close the device if no camera uses it. Works after an unplug."""
        with _DEVICES_LOCK, self._lock:
            if not self._users:
                self._close()

    def close(self) -> None:
        """Close the device, also if cameras use it. Idempotent; works after an unplug."""
        with _DEVICES_LOCK, self._lock:
            self._close()

    def start(self) -> None:
        """Start streaming from every camera that has joined. Idempotent. Raises UnsupportedByDeviceError if the device
        refuses the streams, DeviceGoneError if it was unplugged.
        """
        with self._lock:
            self._require_connected()
            if self._running is not None:
                return
            if self._refusal is None:
                try:
                    queue = self._build_pipeline()
                    self._pipeline.start()
                except Exception as cause:  # noqa: BLE001 - the library raises its own and Python's errors
                    self._note_refusal(cause)
            if self._refusal is not None:
                raise UnsupportedByDeviceError(self._refusal)
            self._running = dict(self._links)
            self._listener = threading.Thread(
                target=self._listen, args=(queue,), name=f"oak-{self.device_id}", daemon=True
            )
            self._listener.start()
            self._darken()

    def _note_refusal(self, cause: Exception) -> None:
        """Note why the device does not stream: a partly built pipeline cannot be built again."""
        if self._device.isClosed():
            self._end(f"OAK device '{self.device_id}' is gone ({cause}); plug it in and open it again")
            self._require_connected()
        streams = ", ".join(f"{link.stream.size} from {socket}" for socket, link in self._links.items())
        self._refusal = (
            f"OAK device '{self.device_id}': requested {streams}, the device refuses: {cause}; choose another size_px "
            "or fps, and open it again"
        )

    def send(self, socket: str, control: Any) -> None:
        """Send settings to a camera. Raises DeviceGoneError."""
        with self._lock:
            self._require_connected()
            try:
                self._controls[socket].send(control)
            except (RuntimeError, self._vendor.MessageQueue.QueueException) as cause:
                self._end(f"OAK device '{self.device_id}' is gone ({cause}); plug it in and open it again")
                self._require_connected()

    def _build_pipeline(self) -> Any:
        """Build the pipeline; return its output queue."""
        vendor, pipeline = self._vendor, self._pipeline
        outputs = {}
        for socket, link in self._links.items():
            stream = link.stream
            camera = pipeline.create(vendor.node.Camera).build(
                getattr(vendor.CameraBoardSocket, socket), sensorFps=stream.fps
            )
            link.start(camera.initialControl)
            outputs[socket] = camera.requestOutput(
                (stream.size.width_px, stream.size.height_px),
                frame_type(stream, vendor),
                resizeMode=vendor.ImgResizeMode.CROP,
                fps=stream.fps,
                enableUndistortion=False,
            )
            self._controls[socket] = camera.inputControl.createInputQueue()
        if len(outputs) == 1:
            return next(iter(outputs.values())).createOutputQueue(maxSize=_QUEUED_MESSAGES, blocking=False)
        sync = pipeline.create(vendor.node.Sync)
        sync.setRunOnHost(True)
        sync.setSyncThreshold(timedelta(microseconds=min(link.stream.period_ns for link in self._links.values()) / 2e3))
        for socket, output in outputs.items():
            output.link(sync.inputs[socket])
        return sync.out.createOutputQueue(maxSize=_QUEUED_MESSAGES, blocking=False)

    def _darken(self) -> None:
        """Switch the device's own infrared light off: its dot pattern would spoil every frame."""
        with _translate_errors(self.device_id, self._vendor):
            if not self._device.getIrDrivers():
                return
            results = [self._device.setIrLaserDotProjectorIntensity(0.0), self._device.setIrFloodLightIntensity(0.0)]
        if not any(results):
            message = (
                f"OAK device '{self.device_id}' does not switch its infrared light off, which would overlay the "
                "patterns; unplug it, plug it in again, and update depthai"
            )
            raise DeviceError(message)

    def _listen(self, queue: Any) -> None:
        """Distribute frames until the pipeline ends: the body of the device's thread."""
        try:
            while not self._closing.is_set():
                message = queue.get(_LISTEN)
                received_ns = time.monotonic_ns()
                if message is not None:
                    self._distribute(message, received_ns)
                elif not self._pipeline.isRunning():
                    break
            reason = "the pipeline has ended"
        except Exception as cause:  # noqa: BLE001 - readers must be notified of every error
            reason = str(cause)
        self._end(
            f"OAK device '{self.device_id}' was closed; open it again"
            if self._closing.is_set()
            else f"OAK device '{self.device_id}' is gone ({reason}); plug it in and open it again"
        )

    def _distribute(self, message: Any, received_ns: int) -> None:
        for socket, link in (self._running or {}).items():
            frame = message[socket] if isinstance(message, self._vendor.MessageGroup) else message
            fault = find_frame_fault(frame, link.stream, received_ns, self.err_ns, self._vendor)
            if fault is not None:
                link.frames.note_damage(fault)
            else:
                link.frames.put(read_frame(frame, received_ns, self._vendor))

    def _end(self, reason: str) -> None:
        self._gone = self._gone or reason
        for link in (self._running or self._links).values():
            link.frames.end(self._gone)

    def _require_connected(self) -> None:
        if self._gone is not None:
            raise DeviceGoneError(self._gone)

    def _close(self) -> None:
        _DEVICES.pop(self.device_id, None)
        if self._closing.is_set():
            return
        self._closing.set()
        # The library may wait for a device that no longer answers; the caller must not.
        closing = threading.Thread(target=self._shut_down, name=f"oak-{self.device_id}-closing", daemon=True)
        try:
            closing.start()
        except RuntimeError:
            # The interpreter is shutting down, and starts no more threads.
            self._shut_down()
        else:
            closing.join(_CLOSE_S)

    def _shut_down(self) -> None:
        with suppress(Exception):
            self._pipeline.stop()
        with suppress(Exception):
            # A pipeline that is destroyed earlier waits for its threads with the interpreter's lock held.
            self._pipeline.wait()
        with suppress(Exception):
            self._device.close()
        if self._listener is not None:
            # A thread that returns from the library after the interpreter has ended crashes the program.
            self._listener.join()


@contextmanager
def _translate_errors(device_id: str, vendor: Any) -> Iterator[None]:
    """Translate the library's errors into slrig's."""
    try:
        yield
    except RuntimeError as cause:
        text = str(cause)
        if "ALREADY_IN_USE" in text or "already in use" in text:
            message = f"OAK device '{device_id}' is held by another program ({text}); close that program"
            raise DeviceBusyError(message) from cause
        if isinstance(cause, vendor.XLinkError) or "NOT_FOUND" in text or "No available devices" in text:
            message = f"OAK device '{device_id}' is gone ({text}); plug it in and open it again"
            raise DeviceGoneError(message) from cause
        message = f"OAK device '{device_id}' fails: {text}; unplug it, plug it in, and try again"
        raise DeviceError(message) from cause


def require_one_clock(vendor: Any) -> None:
    """Check that the library's time stamps count in CLOCK_MONOTONIC. Raises DeviceError."""
    # On a busy machine this thread may pause between readings: a value between before and after is not an offset.
    before_ns, now_ns, after_ns = time.monotonic_ns(), nanoseconds(vendor.Clock.now()), time.monotonic_ns()
    offset_ns = now_ns - min(max(now_ns, before_ns), after_ns)
    if abs(offset_ns) > _MAX_CLOCK_OFFSET_NS:
        message = (
            f"the clock of depthai {vendor.__version__} is {offset_ns / 1e6:.0f} ms off CLOCK_MONOTONIC, in which "
            "frames are timed; report it, and use depthai 3.12"
        )
        raise DeviceError(message)


def open_device(device: str) -> OakDevice:
    """Return a device, opened now unless this process has it open.

    Raises LibraryMissingError if the library is not installed; DeviceBusyError, DeviceGoneError or DeviceError if the
    device cannot be opened.
    """
    vendor = load_depthai()
    with _DEVICES_LOCK:
        for known in _DEVICES.values():
            if device in (known.device_id, known.address):
                return known
        opened = OakDevice(find_available(device, vendor), vendor)
        _DEVICES[opened.device_id] = opened
        return opened


@atexit.register
def close_devices() -> None:
    """Close all devices left open: the library's threads would prevent the program from ending."""
    for device in tuple(_DEVICES.values()):
        device.close()


def open_device_ids() -> frozenset[str]:
    """Return the ids of the devices that this process has open."""
    with _DEVICES_LOCK:
        return frozenset(_DEVICES)


def find_devices() -> tuple[FoundDevice, ...]:
    """List every OAK device on USB and on the network, in half a second. Raises LibraryMissingError."""
    vendor = load_depthai()
    found = {info.deviceId or info.name: info for info in vendor.Device.getAllConnectedDevices()}
    in_use = open_device_ids()
    return tuple(
        FoundDevice("depthai", device, _label(info, device in in_use, vendor)) for device, info in sorted(found.items())
    ) + tuple(
        FoundDevice("depthai", device, "OAK device, in use by this process") for device in sorted(in_use - set(found))
    )


def _label(info: Any, in_use: bool, vendor: Any) -> str:
    where = f"OAK device at {info.name}" if info.name else "OAK device"
    if in_use:
        return f"{where}, in use by this process"
    if not is_permitted(info, vendor):
        return f"{where}, not permitted: it needs the udev rule {UDEV_RULE}"
    if info.state == vendor.XLinkDeviceState.X_LINK_BOOTED:
        return f"{where}, in use by another program"
    return where
