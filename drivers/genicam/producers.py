"""GenTL producers, loaded by harvesters when they are first needed, and what their errors mean.

A producer is the part of a vendor's driver that speaks GenTL: a .cti file, from the maker of the camera or of its
interface card. harvesters (Apache 2.0) and the `genicam` wheel beneath it (EMVA, three-clause BSD) bring none that
serves a real camera. A producer can be loaded only once by a process, so the cameras of one share it.
"""

from __future__ import annotations

import importlib
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError, UnsupportedByDeviceError

INSTALL = "pip install 'slrig[gentl]'"
PATHS = "GENICAM_GENTL64_PATH"

_GONE = ("IoException", "TimeoutException", "InvalidHandleException", "NotInitializedException", "ClosedException")
_BUSY = ("AccessDeniedException", "ResourceInUseException", "BusyException")
_REFUSED = ("AccessException", "InvalidArgumentException", "LogicalErrorException", "OutOfRangeException")


@lru_cache(maxsize=1)
def load_harvesters() -> Any:
    """The only module of harvesters.

    Raises
    ------
    LibraryMissingError
        harvesters, or the wheel of GenICam that it needs, is not installed.
    """
    try:
        return importlib.import_module("harvesters.core")
    except ImportError as cause:
        message = f"the gentl driver needs harvesters, found: {cause}; {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL) from cause


@contextmanager
def translate_gentl_errors(name: str, doing: str) -> Iterator[None]:
    """Turn the errors of producers and node maps within the block into ours.

    Raises
    ------
    DeviceGoneError
        The device does not answer any more.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        It has no such feature, or refused the value.
    DeviceError
        Anything else.
    """
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
            message = f"{what}; look up what the camera offers in its manual, and ask for that"
            raise UnsupportedByDeviceError(message) from cause
        if isinstance(cause, (genapi.TimeoutException, *(getattr(gentl, each) for each in _GONE))):
            message = f"{what}; the camera does not answer: check its cable and power, and open it again"
            raise DeviceGoneError(message) from cause
        raise DeviceError(f"{what}; check the camera's cable and power, and try again") from cause


def producer_files() -> tuple[Path, ...]:
    """The producers that are installed: every .cti file in the folders that GENICAM_GENTL64_PATH names."""
    folders = [Path(folder) for folder in os.environ.get(PATHS, "").split(os.pathsep) if folder]
    return tuple(sorted({file.resolve() for folder in folders for file in folder.glob("*.cti")}))


class GentlProducer:
    """A producer in use. Get one by `use_producer`."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._harvester = load_harvesters().Harvester()
        self._harvester.add_file(str(file))
        self._harvester.update()
        self.users = 0

    @property
    def devices(self) -> tuple[Any, ...]:
        """What it saw when it was loaded, as harvesters' `DeviceInfo`."""
        return tuple(self._harvester.device_info_list)

    def acquirer(self, device: Any) -> Any:
        """Open a device, as harvesters' `ImageAcquirer`. Raises what GenTL does."""
        key = load_harvesters().ParameterKey
        # A wait of the wheel keeps every other thread waiting, too: it must not wait. Chunks are not read.
        settings = {key.TIMEOUT_PERIOD_ON_UPDATE_EVENT_DATA_CALL: 0, key.ENABLE_AUTO_CHUNK_DATA_UPDATE: False}
        with _preserve_interrupt_handler():
            return self._harvester.create(device, config=load_harvesters().ParameterSet(settings))

    def close(self) -> None:
        """Let the producer go, with all that it opened."""
        self._harvester.reset()


_loaded: dict[Path, GentlProducer] = {}
_lock = threading.Lock()


def acquire_producer(file: Path) -> GentlProducer:
    """Return the producer of a file, loaded if it is not yet; `release_producer` it after use.

    Raises
    ------
    LibraryMissingError
        harvesters is not installed, or there is no such file.
    """
    if not file.is_file():
        message = f"there is no GenTL producer {file}; install the one that comes with the camera, and write its path"
        raise LibraryMissingError(message, install=f"the camera maker's GenTL producer, as {file}")
    with _lock:
        producer = _loaded.get(file) or GentlProducer(file)
        _loaded[file] = producer
        producer.users += 1
        return producer


def release_producer(file: Path) -> None:
    """Give a producer back; the last one closes it."""
    with _lock:
        producer = _loaded[file]
        producer.users -= 1
        if not producer.users:
            del _loaded[file]
            producer.close()


@contextmanager
def use_producer(file: Path) -> Iterator[GentlProducer]:
    """A producer, for the block."""
    producer = acquire_producer(file)
    try:
        yield producer
    finally:
        release_producer(file)


def list_gentl_cameras() -> tuple[tuple[str, str], ...]:
    """Id and label of every camera behind the producers that are installed. Opens none.

    Raises
    ------
    LibraryMissingError
        harvesters is not installed.
    """
    load_harvesters()
    found = []
    for file in producer_files():
        with use_producer(file) as producer:
            for device in producer.devices:
                parts = filter(None, (device_field(device, each) for each in ("vendor", "model", "serial_number")))
                found.append((device.id_, f"{' '.join(parts)} ({device_field(device, 'tl_type')}, {file.name})"))
    return tuple(sorted(found))


def device_field(device: Any, what: str) -> str:
    """What a producer tells of a device, "" if it does not."""
    with suppress(importlib.import_module("genicam.gentl").GenericException):
        return str(getattr(device, what) or "")
    return ""


@contextmanager
def _preserve_interrupt_handler() -> Iterator[None]:
    """Keep the handler of Ctrl-C, which harvesters sets to its own."""
    kept = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, kept)
