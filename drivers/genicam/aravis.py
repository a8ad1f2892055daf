"""GigE Vision and USB3 Vision cameras through Aravis: loading the library, connection, stream and device list.

Aravis (LGPL) comes from the system's packages and is reached through GObject introspection: PyGObject and the
`Aravis-0.8` typelib. Neither has wheels, so the error message names the packages to install.
"""

from __future__ import annotations

import importlib
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from drivers.genicam.connection import GenICamConnection, GenicamOptions, GenICamStream, RawFrame, RawImage
from drivers.genicam.link import find_forbidden
from drivers.libraries import loading
from slrig.devices import FoundDevice
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

_BUILDS = "libcairo2-dev gcc pkg-config python3-dev"


PROTOCOLS = ("GigEVision", "USB3Vision")
"""Protocols of the devices that this driver opens; Aravis lists others as well."""
_LATCH = 0x0944
_LATCH_BIT = 2
_LATCHED_HIGH, _LATCHED_LOW = 0x0948, 0x094C
_OLDEST_NS = 60_000_000_000
_CLOCK_TRIES = 5
_CLOCK_TIGHT_NS = 20_000


@dataclass(frozen=True, slots=True)
class AravisLibrary:
    """The loaded library: the `Aravis` namespace, and the class of its errors."""

    aravis: Any
    error: type[Exception]


@lru_cache(maxsize=1)
def load_aravis() -> AravisLibrary:
    """Load Aravis once. Raises LibraryMissingError if PyGObject or the Aravis typelib is not installed."""
    with loading("genicam", "Aravis 0.8 and PyGObject", install=install_command(), packages="PyGObject"):
        gi = importlib.import_module("gi")
        try:
            gi.require_version("Aravis", "0.8")
        except ValueError as missing:
            # The system has no typelib of that name.
            raise ModuleNotFoundError(str(missing)) from missing
        aravis = importlib.import_module("gi.repository.Aravis")
        error = importlib.import_module("gi.repository.GLib").Error
    return AravisLibrary(aravis, error)


def install_command(python: tuple[int, int] = sys.version_info[:2], system: str = sys.platform) -> str:
    """Return the command that installs the missing libraries, for a version of Python and a system as in
    `sys.platform`.

    PyGObject from 3.51 on builds against girepository 2.0, which is newer than the systems with Python 3.11 and 3.12;
    the extra requires an older PyGObject there.

    >>> "libgirepository1.0-dev" in install_command((3, 11)), "libgirepository-2.0-dev" in install_command((3, 13))
    (True, True)
    >>> install_command(system="win32")
    "pip install 'slrig[genicam]' (Aravis with its introspection data first)"
    """
    if system != "linux":
        return "pip install 'slrig[genicam]' (Aravis with its introspection data first)"
    introspection = "libgirepository-2.0-dev" if python >= (3, 13) else "libgirepository1.0-dev"
    return f"sudo apt install gir1.2-aravis-0.8 {introspection} {_BUILDS} && pip install 'slrig[genicam]'"


@contextmanager
def translate_aravis_errors(name: str, doing: str) -> Iterator[None]:
    """Translate Aravis errors within the block into slrig's; the message names the camera and the action.

    Raises
    ------
    DeviceGoneError
        The device does not answer (after several attempts by Aravis), or is not connected.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        It has no such feature, or refused the value.
    DeviceError
        Anything else.
    """
    loaded = load_aravis()
    try:
        yield
    except loaded.error as cause:
        raise _slrig_error(loaded.aravis, name, doing, cause) from cause


def _slrig_error(aravis: Any, name: str, doing: str, cause: Any) -> DeviceError:
    what = f"camera '{name}', {doing}: {cause.message}"
    if cause.domain == "arv-gc-error-quark":
        return UnsupportedByDeviceError(f"{what}; request what the camera's manual offers")
    if cause.domain != "arv-device-error-quark":
        return DeviceError(f"{what}; check the camera's cable and power, and try again")
    codes = aravis.DeviceError
    if cause.code in {int(codes.NOT_CONNECTED), int(codes.TIMEOUT), int(codes.NOT_FOUND)}:
        return DeviceGoneError(f"{what}; the camera does not answer: check its cable and power, and open it again")
    if cause.code in {int(codes.NOT_CONTROLLER), int(codes.PROTOCOL_ERROR_ACCESS_DENIED)}:
        return DeviceBusyError(f"{what}; another program controls the camera: close that program")
    if cause.code in {int(codes.PROTOCOL_ERROR_BUSY), int(codes.TRANSFER_ERROR), int(codes.UNKNOWN)}:
        return DeviceError(f"{what}; check the camera's cable and load, and try again")
    return UnsupportedByDeviceError(f"{what}; request what the camera's manual offers")


class AravisConnection(GenICamConnection):
    """An open device. Aravis signals the loss of control on its own thread.

    name : for messages. Raises LibraryMissingError (Aravis is not installed), DeviceGoneError (no such camera answers)
    and DeviceBusyError (another program controls it).
    """

    def __init__(self, name: str, options: GenicamOptions) -> None:
        super().__init__(name)
        aravis = load_aravis().aravis
        self._options = options
        self._camera = _open_device(aravis, name, options.device)
        self._device = self._camera.get_device()
        self._is_gige = bool(self._camera.is_gv_device())
        self._device.set_register_cache_policy(aravis.RegisterCachePolicy.DISABLE)
        # Not a bound method: that would create a reference cycle with the device.
        lost = self._lost
        self._handler = self._device.connect("control-lost", lambda *_: lost.set())
        try:
            self._require_control(options.device)
        except BaseException:
            self.close()
            raise

    def translate_errors(self, doing: str) -> AbstractContextManager[None]:
        """See `GenICamConnection`."""
        return translate_aravis_errors(self.name, doing)

    def feature_type(self, feature: str) -> str:
        """See `GenICamConnection`."""
        aravis = load_aravis().aravis
        with self.access(f"feature {feature}"):
            node = self._device.get_feature(feature)
        for kind in ("Boolean", "Enumeration", "String", "Integer", "Float"):
            if isinstance(node, getattr(aravis, f"Gc{kind}")):
                return kind
        return type(node).__name__.removeprefix("Gc").removesuffix("Node")

    def start(self, buffers: int) -> GenICamStream:
        """See `GenICamConnection`. Uses a new `Aravis.Stream`, which returns no buffer of an earlier one."""
        aravis = load_aravis().aravis
        with self.access("opening a stream") as camera:
            stream = camera.create_stream(None, None)
        if stream is None:
            message = f"camera '{self.name}' gave no stream; close other programs that read from it, and try again"
            raise DeviceError(message)
        if isinstance(stream, aravis.GvStream):
            resend = aravis.GvStreamPacketResend
            stream.set_property("packet-resend", resend.ALWAYS if self._options.packet_resend else resend.NEVER)
            stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.AUTO)
        with self.access("starting") as camera:
            payload = camera.get_payload()
            for _ in range(buffers):
                stream.push_buffer(aravis.Buffer.new_allocate(payload))
            camera.start_acquisition()
        return AravisStream(self, stream)

    def latch(self) -> tuple[int, int, int] | None:
        """See `GenICamConnection`. GigE Vision has standard registers for it, USB3 Vision features."""
        if not self._is_gige:
            return super().latch()
        try:
            return self._latch_gige()
        except UnsupportedByDeviceError:
            return None

    @property
    def is_usb(self) -> bool:
        """See `GenICamConnection`."""
        return bool(self._camera.is_uv_device())

    @property
    def has_stamps(self) -> bool:
        """See `GenICamConnection`."""
        return not self._is_gige or self._device.get_timestamp_tick_frequency() > 0

    def close(self) -> None:
        """Close the device. Idempotent; works after it is lost."""
        if not self.state.close():
            return
        with suppress(Exception):
            self._device.disconnect(self._handler)
        references, self._device, self._camera = [self._camera, self._device], None, None
        self.release(references)

    def release(self, references: list[Any]) -> None:
        """Drop Aravis objects; the list has the only references to them."""
        if self._lost.is_set():
            # Their destructors contact the lost device and wait 5 s for an answer.
            threading.Thread(target=references.clear, name=f"releasing {self.name}", daemon=True).start()
        else:
            references.clear()

    def _latch_gige(self) -> tuple[int, int, int] | None:
        frequency_hz = self._device.get_timestamp_tick_frequency()
        if not frequency_hz:
            return None
        with self.access("reading its clock"):
            before_ns = time.monotonic_ns()
            self._device.write_register(_LATCH, _LATCH_BIT)
            after_ns = time.monotonic_ns()
            high, low = (self._device.read_register(address) for address in (_LATCHED_HIGH, _LATCHED_LOW))
        seconds, ticks = divmod((high & 0xFFFFFFFF) << 32 | low & 0xFFFFFFFF, frequency_hz)
        return before_ns, seconds * 10**9 + ticks * 10**9 // frequency_hz, after_ns

    def _require_control(self, device: str) -> None:
        if self._is_gige and not self._device.is_controller():
            message = (
                f"camera '{self.name}': another program controls {device}; close it, or wait some seconds if it has "
                "just ended"
            )
            raise DeviceBusyError(message)

    def prepare_link(self) -> None:
        """See `GenICamConnection`."""
        if not self._is_gige:
            return
        aravis, options = load_aravis().aravis, self._options
        kind = aravis.GvStreamOption
        with self.access("setting up the network") as camera:
            camera.gv_set_stream_options(kind.NONE if options.packet_socket else kind.PACKET_SOCKET_DISABLED)
            if options.packet_delay_ns is not None:
                camera.gv_set_packet_delay(options.packet_delay_ns)
            if options.packet_size_bytes is None:
                camera.gv_auto_packet_size()
                return
            camera.gv_set_packet_size_adjustment(aravis.GvPacketSizeAdjustment.NEVER)
            camera.gv_set_packet_size(options.packet_size_bytes)
            got = camera.gv_get_packet_size()
        if got != options.packet_size_bytes:
            message = (
                f"camera '{self.name}': requested packet_size_bytes {options.packet_size_bytes}, it uses {got}; "
                "write that, or leave it out"
            )
            raise DeviceError(message)


class AravisStream:
    """Implements `GenICamStream` on a running `Aravis.Stream`."""

    def __init__(self, connection: AravisConnection, stream: Any) -> None:
        self._connection = connection
        self._stream = stream

    def take(self, max_s: float) -> RawFrame | None:
        """See `GenICamStream`."""
        if max_s > 0:
            buffer = self._stream.timeout_pop_buffer(round(max_s * 1e6) + 1)
        else:
            buffer = self._stream.try_pop_buffer()
        if buffer is None:
            return None
        try:
            arrived_ns = _arrival_ns(buffer)
            image = None
            if buffer.get_status() == load_aravis().aravis.BufferStatus.SUCCESS:
                size = Size(buffer.get_image_width(), buffer.get_image_height())
                image = RawImage(buffer.get_data(), size, buffer.get_image_padding()[0])
            return RawFrame(int(buffer.get_frame_id()), arrived_ns, int(buffer.get_timestamp()), image)
        finally:
            self._stream.push_buffer(buffer)

    def end(self) -> None:
        """See `GenICamStream`."""
        connection = self._connection
        if not connection.is_lost:
            # If the camera is lost only now, the next call that needs it reports that.
            with suppress(DeviceError), connection.access("stopping") as camera:
                camera.stop_acquisition()
        references, self._stream = [self._stream], None
        connection.release(references)


def _open_device(aravis: Any, name: str, device: str) -> Any:
    try:
        with translate_aravis_errors(name, f"opening {device}"):
            return aravis.Camera.new(device)
    except DeviceGoneError as error:
        known = ", ".join(each.label for each in find_devices())
        message = (
            f"camera '{name}': no GenICam camera '{device}' answers; found: {known or 'none'}. Check cable, power, and "
            "that its IP address is in the network of this machine's card"
        )
        raise DeviceGoneError(message) from error


def _arrival_ns(buffer: Any) -> int:
    """Arrival of the frame's first packet, CLOCK_MONOTONIC, from the wall-clock time that Aravis records."""
    now_ns, wall_ns = _read_clocks()
    ago_ns = wall_ns - int(buffer.get_system_timestamp())
    # If the wall clock was set meanwhile, now is the only safe bound.
    return now_ns - ago_ns if 0 <= ago_ns < _OLDEST_NS else now_ns


def _read_clocks() -> tuple[int, int]:
    """Read CLOCK_MONOTONIC and the wall clock at nearly the same instant, the best of a few tries."""
    best_ns, found = _OLDEST_NS, (0, 0)
    for _ in range(_CLOCK_TRIES):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < best_ns:
            # The later reading: a frame must never be dated before its arrival.
            best_ns, found = after_ns - before_ns, (after_ns, wall_ns)
        if best_ns < _CLOCK_TIGHT_NS:
            break
    return found


def find_devices() -> tuple[FoundDevice, ...]:
    """List every GigE Vision and USB3 Vision camera that answers Aravis, which takes about one second, and those that
    this user may not open. Opens none. Raises LibraryMissingError.
    """
    aravis = load_aravis().aravis
    aravis.update_device_list()
    found = []
    for index in range(aravis.get_n_devices()):
        protocol = aravis.get_device_protocol(index)
        if protocol in PROTOCOLS:
            identity = aravis.get_device_id(index)
            parts = (
                aravis.get_device_vendor(index),
                aravis.get_device_model(index),
                aravis.get_device_serial_nbr(index),
            )
            where = aravis.get_device_address(index)
            label = f"{' '.join(filter(None, parts))} ({protocol}, {where}): {identity}"
            found.append(FoundDevice("genicam", identity, label))
    return (*sorted(found, key=lambda device: device.device), *find_forbidden())
