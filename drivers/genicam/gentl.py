"""Cameras behind a GenTL producer, through harvesters: producers, node map, connection and stream.

A producer is the part of a vendor's driver that speaks GenTL: a .cti file from the maker of the camera or of its
interface card. harvesters (Apache 2.0) and the `genicam` wheel beneath it (EMVA, three-clause BSD) include none for a
real camera. A process can load a producer only once, so its cameras share it.

A GenTL producer does not report when a frame arrived, so a thread takes each frame as it comes. The thread polls once a
millisecond without waiting, because harvesters' wheel holds Python's lock while it waits. Frames are read from raw
memory, since harvesters does not remove padding.
"""

# ruff: noqa: D102 - the methods of NodeMapCamera are named as in Aravis
from __future__ import annotations

import importlib
import os
import queue
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from drivers.genicam.connection import GenICamConnection, GenICamStream, GentlOptions, RawFrame, RawImage
from drivers.libraries import loading
from slrig.devices import FoundDevice
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError, UnsupportedByDeviceError
from slrig.model import Size

INSTALL = "pip install 'slrig[gentl]'"
PATHS = "GENICAM_GENTL64_PATH"

_GONE = ("IoException", "TimeoutException", "InvalidHandleException", "NotInitializedException", "ClosedException")
_BUSY = ("AccessDeniedException", "ResourceInUseException", "BusyException")
_REFUSED = ("AccessException", "InvalidArgumentException", "LogicalErrorException", "OutOfRangeException")


_loaded: dict[Path, GentlProducer] = {}
_lock = threading.Lock()
EXPOSURE_US = ("ExposureTime", "ExposureTimeAbs")
GAIN = ("Gain", "GainAbs", "GainRaw")
_USB = ("U3V", "USB3Vision")
_KINDS = ("Boolean", "Enumeration", "String", "Integer", "Float", "Command", "Register", "Category")
_LOOK_S = 0.001
_ASK_S = 1e-5
"""Polling time of harvesters. With 0 it would never return, and with much less it may not poll at all."""


@lru_cache(maxsize=1)
def load_harvesters() -> Any:
    """Return the module `harvesters.core`. Raises LibraryMissingError if it, or its wheel of GenICam, is not
    installed.
    """
    with loading("gentl", "harvesters", install=INSTALL, packages="harvesters genicam"):
        return importlib.import_module("harvesters.core")


@contextmanager
def translate_gentl_errors(name: str, doing: str) -> Iterator[None]:
    """Translate errors of producers and node maps within the block into slrig's, as `translate_aravis_errors`."""
    load_harvesters()
    gentl, genapi = importlib.import_module("genicam.gentl"), importlib.import_module("genicam.genapi")
    errors: tuple[type[Exception], ...] = (gentl.GenericException, genapi.GenericException)
    try:
        yield
    except errors as cause:
        what = f"camera '{name}', {doing}: {str(cause).split(' : ')[0]}"
        if isinstance(cause, tuple(getattr(gentl, each) for each in _BUSY)):
            raise DeviceBusyError(f"{what}; another program controls the camera: close that program") from cause
        if isinstance(cause, tuple(getattr(genapi, each) for each in _REFUSED)):
            message = f"{what}; request what the camera's manual offers"
            raise UnsupportedByDeviceError(message) from cause
        if isinstance(cause, (genapi.TimeoutException, *(getattr(gentl, each) for each in _GONE))):
            message = f"{what}; the camera does not answer: check its cable and power, and open it again"
            raise DeviceGoneError(message) from cause
        raise DeviceError(f"{what}; check the camera's cable and power, and try again") from cause


def producer_files() -> tuple[Path, ...]:
    """Return the installed producers: every .cti file in the folders that GENICAM_GENTL64_PATH names."""
    folders = [Path(folder) for folder in os.environ.get(PATHS, "").split(os.pathsep) if folder]
    return tuple(sorted({file.resolve() for folder in folders for file in folder.glob("*.cti")}))


class GentlProducer:
    """A loaded producer. Get one by `use_producer`."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._harvester = load_harvesters().Harvester()
        self._harvester.add_file(str(file))
        self._harvester.update()
        self.users = 0

    @property
    def devices(self) -> tuple[Any, ...]:
        """Devices found when it was loaded, as harvesters' `DeviceInfo`."""
        return tuple(self._harvester.device_info_list)

    def acquirer(self, device: Any) -> Any:
        """Open a device, as harvesters' `ImageAcquirer`. Raises GenTL's errors."""
        key = load_harvesters().ParameterKey
        # The wheel blocks every other thread while it waits: it must not wait. Chunks are not read.
        settings = {key.TIMEOUT_PERIOD_ON_UPDATE_EVENT_DATA_CALL: 0, key.ENABLE_AUTO_CHUNK_DATA_UPDATE: False}
        with _preserve_interrupt_handler():
            return self._harvester.create(device, config=load_harvesters().ParameterSet(settings))

    def close(self) -> None:
        """Unload the producer and close all its devices."""
        self._harvester.reset()


def acquire_producer(file: Path) -> GentlProducer:
    """Return the producer of a file, loading it if necessary; call `release_producer` after use. Raises
    LibraryMissingError if harvesters is not installed, or the file does not exist.
    """
    if not file.is_file():
        message = f"GenTL producer {file} not found; install the one that comes with the camera, and write its path"
        raise LibraryMissingError(message, install=f"the camera maker's GenTL producer, as {file}")
    with _lock:
        producer = _loaded.get(file) or GentlProducer(file)
        _loaded[file] = producer
        producer.users += 1
        return producer


def release_producer(file: Path) -> None:
    """Release a producer; the last user closes it."""
    with _lock:
        producer = _loaded[file]
        producer.users -= 1
        if not producer.users:
            del _loaded[file]
            producer.close()


@contextmanager
def use_producer(file: Path) -> Iterator[GentlProducer]:
    """Provide a producer for the block."""
    producer = acquire_producer(file)
    try:
        yield producer
    finally:
        release_producer(file)


def list_gentl_cameras() -> tuple[tuple[str, str], ...]:
    """Return id and label of every camera behind the installed producers, opening none. Raises LibraryMissingError."""
    load_harvesters()
    found = []
    for file in producer_files():
        with use_producer(file) as producer:
            for device in producer.devices:
                parts = filter(None, (device_field(device, each) for each in ("vendor", "model", "serial_number")))
                found.append((device.id_, f"{' '.join(parts)} ({device_field(device, 'tl_type')}, {file.name})"))
    return tuple(sorted(found))


def device_field(device: Any, what: str) -> str:
    """Return a producer's information on a device, "" if it has none."""
    with suppress(importlib.import_module("genicam.gentl").GenericException):
        return str(getattr(device, what) or "")
    return ""


@contextmanager
def _preserve_interrupt_handler() -> Iterator[None]:
    """Restore the Ctrl-C handler, which harvesters replaces."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


def feature_type(node: Any) -> str:
    """Return Boolean, Enumeration, String, Integer, Float, or another of GenApi's interface types."""
    genapi = importlib.import_module("genicam.genapi")
    principal = node.node.principal_interface_type
    return next((kind for kind in _KINDS if principal == getattr(genapi.EInterfaceType, f"intfI{kind}")), "unknown")


class NodeMapCamera:
    """A camera's features through GenApi's node map, with the methods of `Aravis.Camera` that this driver calls.

    Each may raise GenApi's and GenTL's errors. name : for messages. nodes : its `NodeMap`. device : the producer's
    description of the device.
    """

    def __init__(self, name: str, nodes: Any, device: Any) -> None:
        self._name = name
        self._nodes = nodes
        self._device = device
        self._access = importlib.import_module("genicam.genapi").EAccessMode

    def node(self, feature: str) -> Any:
        """Return a feature's node. Raises UnsupportedByDeviceError if the camera has no such feature."""
        if not self._nodes.has_node(feature):
            message = (
                f"camera '{self._name}' has no feature {feature}, which the gentl driver needs; use another camera"
            )
            raise UnsupportedByDeviceError(message)
        return self._nodes.get_node(feature)

    def is_feature_available(self, feature: str) -> bool:
        return self._nodes.has_node(feature) and self._is_offered(self.node(feature))

    def dup_available_enumerations_as_strings(self, feature: str) -> list[str]:
        return [entry.symbolic for entry in self.node(feature).entries if self._is_offered(entry)]

    def get_string(self, feature: str) -> str:
        return str(self._read(feature))

    def set_string(self, feature: str, value: str) -> None:
        self.node(feature).value = value

    def get_boolean(self, feature: str) -> bool:
        return bool(self._read(feature))

    set_boolean = set_integer = set_float = set_string

    def get_integer(self, feature: str) -> int:
        return int(self._read(feature))

    def get_integer_bounds(self, feature: str) -> tuple[int, int]:
        node = self.node(feature)
        return int(node.min), int(node.max)

    def get_integer_increment(self, feature: str) -> int:
        return int(self.node(feature).inc)

    def get_float(self, feature: str) -> float:
        return float(self._read(feature))

    def get_float_bounds(self, feature: str) -> tuple[float, float]:
        node = self.node(feature)
        return float(node.min), float(node.max)

    def execute_command(self, feature: str) -> None:
        self.node(feature).execute()

    def stop_acquisition(self) -> None:
        for feature, stop in (("AcquisitionStop", self.execute_command), ("TLParamsLocked", self._unlock)):
            if self.is_feature_available(feature):
                stop(feature)

    def get_width_bounds(self) -> tuple[int, int]:
        return self.get_integer_bounds("Width")

    def get_height_bounds(self) -> tuple[int, int]:
        return self.get_integer_bounds("Height")

    def get_exposure_time(self) -> float:
        return self.get_float(self._first(EXPOSURE_US))

    def get_exposure_time_bounds(self) -> tuple[float, float]:
        return self.get_float_bounds(self._first(EXPOSURE_US))

    def set_exposure_time(self, exposure_us: float) -> None:
        self._set_number(self._first(EXPOSURE_US), exposure_us)

    def is_gain_available(self) -> bool:
        return any(map(self.is_feature_available, GAIN))

    def get_gain(self) -> float:
        return self.get_float(self._first(GAIN))

    def get_gain_bounds(self) -> tuple[float, float]:
        return self.get_float_bounds(self._first(GAIN))

    def set_gain(self, gain: float) -> None:
        self._set_number(self._first(GAIN), gain)

    def is_software_trigger_supported(self) -> bool:
        source = "TriggerSource"
        return (
            self._nodes.has_node("TriggerSoftware")
            and self.is_feature_available(source)
            and "Software" in self.dup_available_enumerations_as_strings(source)
        )

    def software_trigger(self) -> None:
        self.execute_command("TriggerSoftware")

    def get_payload(self) -> int:
        return self.get_integer("PayloadSize")

    def get_vendor_name(self) -> str:
        return str(self._device.vendor)

    def get_model_name(self) -> str:
        return str(self._device.model)

    def get_device_serial_number(self) -> str:
        return str(self._device.serial_number)

    def get_device_id(self) -> str:
        return str(self._device.id_)

    def _read(self, feature: str) -> Any:
        # Bypass the node map's cache: a camera may have adjusted the written value.
        verify, ignore_cache = False, True
        return self.node(feature).get_value(verify, ignore_cache)

    def _unlock(self, feature: str) -> None:
        self.node(feature).value = 0

    def _set_number(self, feature: str, value: float) -> None:
        node = self.node(feature)
        node.value = round(value) if feature_type(node) == "Integer" else value

    def _first(self, features: tuple[str, ...]) -> str:
        """Return the first feature that the camera offers, or the first of all if it offers none."""
        return next(filter(self.is_feature_available, features), features[0])

    def _is_offered(self, node: Any) -> bool:
        return node.get_access_mode() in {self._access.WO, self._access.RO, self._access.RW}


class GentlConnection(GenICamConnection):
    """An open device.

    name : for messages. folder : folder to which the producer's path is relative. Raises LibraryMissingError
    (harvesters is not installed, or no producer is found), DeviceGoneError (no such camera answers) and DeviceBusyError
    (another program controls it).
    """

    def __init__(self, name: str, options: GentlOptions, folder: Path) -> None:
        super().__init__(name)
        load_harvesters()
        files = producer_files() if options.producer is None else ((folder / options.producer).resolve(),)
        if not files:
            message = (
                f"camera '{name}': no GenTL producer found; install the one that comes with the camera, and write "
                f"the path of its .cti file as producer, or set {PATHS} to its folder"
            )
            raise LibraryMissingError(message, install="the camera maker's GenTL producer (a .cti file)")
        self._file, self._acquirer = self._find_device(files, options.device)
        self._camera = NodeMapCamera(name, self._acquirer.remote_device.node_map, self._acquirer.device)

    def translate_errors(self, doing: str) -> AbstractContextManager[None]:
        """See `GenICamConnection`."""
        return translate_gentl_errors(self.name, doing)

    def feature_type(self, feature: str) -> str:
        """See `GenICamConnection`."""
        with self.access(f"feature {feature}") as camera:
            return feature_type(camera.node(feature))

    def prepare_link(self) -> None:
        """See `GenICamConnection`. The producer has done that."""

    @property
    def is_usb(self) -> bool:
        """See `GenICamConnection`."""
        return device_field(self._acquirer.device, "tl_type") in _USB

    def start(self, buffers: int) -> GenICamStream:
        """See `GenICamConnection`. The producer's queue is emptied when an acquisition ends."""
        with self.access("starting"):
            self._acquirer.num_buffers = max(buffers, self._acquirer.min_num_buffers)
            self._acquirer.start()
        return GentlStream(self, self._acquirer, self._lost)

    def close(self) -> None:
        """See `GenICamConnection`."""
        if not self.state.close():
            return
        acquirer, self._acquirer, self._camera = self._acquirer, None, None
        with suppress(Exception):
            acquirer.destroy()
        release_producer(self._file)

    def _find_device(self, files: tuple[Path, ...], device: str) -> tuple[Path, Any]:
        """Return the producer that has the device, acquired, and the device's acquirer."""
        known = []
        for file in files:
            producer = acquire_producer(file)
            try:
                for found in producer.devices:
                    if device in {found.id_, device_field(found, "serial_number")}:
                        with self.translate_errors(f"opening {device}"):
                            return file, producer.acquirer(found)
                    known.append(found.id_)
            except BaseException:
                release_producer(file)
                raise
            release_producer(file)
        message = (
            f"camera '{self.name}': no GenTL camera '{device}' answers; found: {', '.join(known) or 'none'} (by "
            f"{', '.join(file.name for file in files)}). Check cable and power, and close the maker's viewer"
        )
        raise DeviceGoneError(message)


class GentlStream:
    """Implements `GenICamStream` on a running acquisition.

    acquirer : harvesters' `ImageAcquirer`. lost : set when no more frames can be requested.
    """

    def __init__(self, connection: GentlConnection, acquirer: Any, lost: threading.Event) -> None:
        self._acquirer = acquirer
        self._lost = lost
        self._translate_errors = connection.translate_errors
        self._delivered: queue.SimpleQueue[RawFrame] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._pump, name=f"frames of {connection.name}", daemon=True)
        self._thread.start()

    def take(self, max_s: float) -> RawFrame | None:
        """See `GenICamStream`."""
        try:
            return self._delivered.get(timeout=max_s) if max_s > 0 else self._delivered.get_nowait()
        except queue.Empty:
            return None

    def end(self) -> None:
        """See `GenICamStream`."""
        self._ending.set()
        self._thread.join()
        # If the camera is lost only now, the next call that needs it reports that.
        with suppress(DeviceError), self._translate_errors("stopping"):
            self._acquirer.stop()

    def _pump(self) -> None:
        while not self._ending.is_set():
            try:
                with self._translate_errors("taking a frame"):
                    # Incomplete frames are not delivered; the gap in the numbers counts them.
                    buffer = self._acquirer.try_fetch(timeout=_ASK_S, is_raw=True)
                    if buffer is not None:
                        self._delivered.put(_read_buffer(buffer, time.monotonic_ns()))
                        buffer.parent.queue_buffer(buffer)
                        continue
            except DeviceError:
                self._lost.set()
                return
            self._ending.wait(_LOOK_S)


def _read_buffer(buffer: Any, arrived_ns: int) -> RawFrame:
    """Read a complete frame and its metadata."""
    width_px = _buffer_field(buffer, "width", 0)
    height_px = _buffer_field(buffer, "delivered_image_height", 0) or _buffer_field(buffer, "height", 0)
    image = None
    if width_px and height_px:
        data = bytes(memoryview(buffer.raw_buffer)[_buffer_field(buffer, "image_offset", 0) :])
        image = RawImage(data, Size(width_px, height_px), _buffer_field(buffer, "padding_x", 0))
    return RawFrame(buffer.frame_id, arrived_ns, _buffer_field(buffer, "timestamp_ns", 0), image)


def _buffer_field(buffer: Any, what: str, otherwise: int) -> int:
    with suppress(importlib.import_module("genicam.gentl").GenericException):
        return int(getattr(buffer, what))
    return otherwise


def find_gentl_devices() -> tuple[FoundDevice, ...]:
    """List every camera that an installed GenTL producer sees. Opens none. Raises LibraryMissingError."""
    return tuple(FoundDevice("gentl", identity, label) for identity, label in list_gentl_cameras())
