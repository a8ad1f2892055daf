"""A camera behind a GenTL producer, through harvesters: how it is got, how its frames come, and how it is let go.

A GenTL producer does not tell when a frame arrived, so a thread takes each one as it comes. That thread looks once a
millisecond and does not wait: harvesters' wheel keeps Python's lock while it waits for a frame, and nothing else would
run meanwhile. Frames are read as they lie in memory; harvesters' own reading of them does not take off padding.
"""

from __future__ import annotations

import importlib
import queue
import threading
import time
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from drivers.genicam import producers
from drivers.genicam.connection import GenICamConnection, GenICamStream, RawFrame, RawImage
from drivers.genicam.nodes import NodeMapCamera, feature_type
from drivers.genicam.options import GentlOptions
from slrig.errors import DeviceError, DeviceGoneError, LibraryMissingError
from slrig.model import Size

_LOOK_S = 0.001
_ASK_S = 1e-5
"""harvesters asks again and again for so long. With 0 it would never stop, and with much less it may not ask at all."""


class GentlConnection(GenICamConnection):
    """An open device.

    Parameters
    ----------
    name
        The camera's, for messages.
    options
        `GentlOptions`.
    folder
        Where the producer's path counts from.

    Raises
    ------
    LibraryMissingError
        harvesters is not installed, or there is no producer.
    DeviceGoneError
        No such camera answers.
    DeviceBusyError
        Another program controls it.
    """

    def __init__(self, name: str, options: GentlOptions, folder: Path) -> None:
        super().__init__(name)
        producers.load_harvesters()
        files = producers.producer_files() if options.producer is None else ((folder / options.producer).resolve(),)
        if not files:
            message = (
                f"camera '{name}': no GenTL producer is known; install the one that comes with the camera, and write "
                f"the path of its .cti file as producer, or set {producers.PATHS} to its folder"
            )
            raise LibraryMissingError(message, install="the camera maker's GenTL producer (a .cti file)")
        self._file, self._acquirer = self._opened(files, options.device)
        self._camera = NodeMapCamera(name, self._acquirer.remote_device.node_map, self._acquirer.device)

    def told(self, doing: str) -> AbstractContextManager[None]:
        """See `GenICamConnection`."""
        return producers.translate_gentl_errors(self.name, doing)

    def kind(self, feature: str) -> str:
        """See `GenICamConnection`."""
        with self.asking(f"feature {feature}") as camera:
            return feature_type(camera.node(feature))

    def start(self, buffers: int) -> GenICamStream:
        """See `GenICamConnection`. The producer's queue is emptied when an acquisition ends."""
        with self.asking("starting"):
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
        producers.release_producer(self._file)

    def _opened(self, files: tuple[Path, ...], device: str) -> tuple[Path, Any]:
        """The producer that has the device, which is then in use, and the device's acquirer."""
        known = []
        for file in files:
            producer = producers.acquire_producer(file)
            try:
                for found in producer.devices:
                    if device in {found.id_, producers.device_field(found, "serial_number")}:
                        with self.told(f"opening {device}"):
                            return file, producer.acquirer(found)
                    known.append(found.id_)
            except BaseException:
                producers.release_producer(file)
                raise
            producers.release_producer(file)
        message = (
            f"camera '{self.name}': no GenTL camera '{device}' answers; found: {', '.join(known) or 'none'} (by "
            f"{', '.join(file.name for file in files)}). Check cable and power, and close the maker's viewer"
        )
        raise DeviceGoneError(message)


class GentlStream:
    """Implements `GenICamStream` on an acquisition that runs.

    Parameters
    ----------
    connection
        Whose it is.
    acquirer
        harvesters' `ImageAcquirer`.
    lost
        Set when frames cannot be asked for any more.
    """

    def __init__(self, connection: GentlConnection, acquirer: Any, lost: threading.Event) -> None:
        self._acquirer = acquirer
        self._lost = lost
        self._told = connection.told
        self._came: queue.SimpleQueue[RawFrame] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._pump, name=f"frames of {connection.name}", daemon=True)
        self._thread.start()

    def take(self, most_s: float) -> RawFrame | None:
        """See `GenICamStream`."""
        try:
            return self._came.get(timeout=most_s) if most_s > 0 else self._came.get_nowait()
        except queue.Empty:
            return None

    def end(self) -> None:
        """See `GenICamStream`."""
        self._ending.set()
        self._thread.join()
        # A camera that is lost only now is told of by the next call that needs it.
        with suppress(DeviceError), self._told("stopping"):
            self._acquirer.stop()

    def _pump(self) -> None:
        while not self._ending.is_set():
            try:
                with self._told("taking a frame"):
                    # Frames that are not whole do not come; they are counted by the gap that they leave.
                    buffer = self._acquirer.try_fetch(timeout=_ASK_S, is_raw=True)
                    if buffer is not None:
                        self._came.put(_read_buffer(buffer, time.monotonic_ns()))
                        buffer.parent.queue_buffer(buffer)
                        continue
            except DeviceError:
                self._lost.set()
                return
            self._ending.wait(_LOOK_S)


def _read_buffer(buffer: Any, arrived_ns: int) -> RawFrame:
    """A frame that came whole, with what its producer tells of it."""
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
