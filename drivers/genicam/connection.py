"""An open GenICam device under our control: how it is got, what it offers, and how it is let go."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from drivers.genicam.features import Features
from drivers.genicam.library import library, told
from drivers.genicam.options import GenicamOptions
from slrig.devices import CameraState
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

PROTOCOLS = ("GigEVision", "USB3Vision")
"""What this driver opens of the things that Aravis lists."""

_LATCH = 0x0944
_LATCH_BIT = 2
_LATCHED_HIGH, _LATCHED_LOW = 0x0948, 0x094C


class Connection:
    """An open device. One thread uses it; Aravis' own thread tells when control is lost.

    Parameters
    ----------
    name
        The camera's, for messages.
    options
        `GenicamOptions`.

    Raises
    ------
    LibraryMissingError
        Aravis is not installed.
    DeviceGoneError
        No such camera answers.
    DeviceBusyError
        Another program controls it.
    """

    def __init__(self, name: str, options: GenicamOptions) -> None:
        aravis = library().aravis
        self.name = name
        self.state = CameraState(name)
        self._lost = threading.Event()
        self._camera = _opened(aravis, name, options.device)
        self._device = self._camera.get_device()
        self._is_gige = bool(self._camera.is_gv_device())
        self._device.set_register_cache_policy(aravis.RegisterCachePolicy.DISABLE)
        # Not a method of ours: the device would keep us, and we it.
        lost = self._lost
        self._handler = self._device.connect("control-lost", lambda *_: lost.set())
        self.features = Features(name, self.asking)
        try:
            self._require_control(options.device)
            if self._is_gige:
                self._prepare_network(aravis, options)
        except BaseException:
            self.close()
            raise

    @property
    def is_lost(self) -> bool:
        """Whether the device has gone since it was opened."""
        return self._lost.is_set()

    @contextmanager
    def asking(self, doing: str) -> Iterator[Any]:
        """The `Aravis.Camera`, for the block.

        Raises
        ------
        DeviceStateError
            It was closed.
        DeviceGoneError
            It is lost, before or by what the block asked.
        DeviceError
            What `told` makes of Aravis' errors.
        """
        self.state.require_open()
        if self._lost.is_set():
            raise self.gone(doing)
        try:
            with told(self.name, doing):
                yield self._camera
        except DeviceGoneError:
            self._lost.set()
            raise

    def gone(self, doing: str) -> DeviceGoneError:
        """The error of a device that is lost."""
        message = f"camera '{self.name}' is gone ({doing}); check its cable and power, and open the rig again"
        return DeviceGoneError(message)

    def stream(self, options: GenicamOptions) -> Any:
        """Return a new `Aravis.Stream`: no buffer of an earlier one can come out of it."""
        aravis = library().aravis
        with self.asking("opening a stream") as camera:
            stream = camera.create_stream(None, None)
        if stream is None:
            message = f"camera '{self.name}' gave no stream; close other programs that read from it, and try again"
            raise DeviceError(message)
        if isinstance(stream, aravis.GvStream):
            resend = aravis.GvStreamPacketResend
            stream.set_property("packet-resend", resend.ALWAYS if options.packet_resend else resend.NEVER)
            stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.AUTO)
        return stream

    def latch(self) -> tuple[int, int, int] | None:
        """Host's time, the device's, host's time again, ns; None if it has no clock that can be looked at.

        GigE Vision has it in registers that every device shares, USB3 Vision in features.
        """
        try:
            return self._latched_gige() if self._is_gige else self._latched_feature()
        except UnsupportedByDeviceError:
            return None

    @property
    def has_stamps(self) -> bool:
        """Whether frames carry the device's own time."""
        return not self._is_gige or self._device.get_timestamp_tick_frequency() > 0

    def close(self) -> None:
        """Let the device go. Idempotent; works after it is lost."""
        if not self.state.close():
            return
        with suppress(Exception):
            self._device.disconnect(self._handler)
        held, self._device, self._camera = [self._camera, self._device], None, None
        self.let_go(held)

    def let_go(self, held: list[Any]) -> None:
        """Drop Aravis' objects, the only references to which are in the list."""
        if self._lost.is_set():
            # Each of them says goodbye to the device first, and waits 5 s for an answer that will not come.
            threading.Thread(target=held.clear, name=f"goodbye to {self.name}", daemon=True).start()
        else:
            held.clear()

    def _latched_gige(self) -> tuple[int, int, int] | None:
        frequency_hz = self._device.get_timestamp_tick_frequency()
        if not frequency_hz:
            return None
        with self.asking("looking at its clock"):
            before_ns = time.monotonic_ns()
            self._device.write_register(_LATCH, _LATCH_BIT)
            after_ns = time.monotonic_ns()
            high, low = (self._device.read_register(address) for address in (_LATCHED_HIGH, _LATCHED_LOW))
        seconds, ticks = divmod((high & 0xFFFFFFFF) << 32 | low & 0xFFFFFFFF, frequency_hz)
        return before_ns, seconds * 10**9 + ticks * 10**9 // frequency_hz, after_ns

    def _latched_feature(self) -> tuple[int, int, int] | None:
        command, value = "TimestampLatch", "TimestampLatchValue"
        if not (self.features.has(command) and self.features.has(value)):
            return None
        before_ns = time.monotonic_ns()
        self.features.execute(command)
        after_ns = time.monotonic_ns()
        return before_ns, self.features.whole(value), after_ns

    def _require_control(self, device: str) -> None:
        if self._is_gige and not self._device.is_controller():
            message = (
                f"camera '{self.name}': another program controls {device}; close it, or wait some seconds if it has "
                "just ended"
            )
            raise DeviceBusyError(message)

    def _prepare_network(self, aravis: Any, options: GenicamOptions) -> None:
        kind = aravis.GvStreamOption
        with self.asking("setting up the network") as camera:
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
                f"camera '{self.name}': asked for packet_size_bytes {options.packet_size_bytes}, it gives {got}; write "
                "that, or leave it out"
            )
            raise DeviceError(message)


def _opened(aravis: Any, name: str, device: str) -> Any:
    try:
        with told(name, f"opening {device}"):
            return aravis.Camera.new(device)
    except DeviceGoneError as error:
        known = ", ".join(label for _, label in listed()) or "none"
        message = (
            f"camera '{name}': no GenICam camera '{device}' answers; found: {known}. Check cable, power, and that its "
            "IP address lies in the network of this machine's card"
        )
        raise DeviceGoneError(message) from error


def listed() -> tuple[tuple[str, str], ...]:
    """Id and label of every camera that answers. Opens nothing; takes Aravis about one second."""
    aravis = library().aravis
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
            found.append((identity, f"{' '.join(filter(None, parts))} ({protocol}, {where}): {identity}"))
    return tuple(sorted(found))
