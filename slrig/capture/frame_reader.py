"""Reading free-running cameras beside what the projector is told: one thread for each camera, frames in one queue."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping

from slrig.devices import Camera
from slrig.errors import FrameTimeoutError
from slrig.model import Frame

_LOOK_S = 0.25
"""How long one read may take: so soon a reader notices that it shall end, where its camera gives no frames."""

Arrival = tuple[str, Frame | Exception]
"""A camera's name in its rig, and its next frame or what its driver raised."""


class FrameReader:
    """Reads every frame of several armed cameras until it is stopped.

    Meanwhile nobody else calls these cameras: each has one thread at a time. What a driver raises ends its camera's
    thread; a frame that does not come raises nothing here.
    """

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._arrived: queue.SimpleQueue[Arrival] = queue.SimpleQueue()
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Begin to read. The cameras are armed."""
        for name, camera in self._cameras.items():
            thread = threading.Thread(
                target=self._read, args=(name, camera), name=f"slrig-frames of {name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def next(self, timeout_s: float) -> Arrival | None:
        """Return what came first of what waits, in the order of its arrival; None if nothing comes in that time."""
        try:
            return self._arrived.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def stop(self) -> None:
        """Read no more, and return when every camera is let go. Idempotent."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _read(self, name: str, camera: Camera) -> None:
        while not self._stopped.is_set():
            try:
                frame = camera.read(0, _LOOK_S)
            except FrameTimeoutError:
                continue
            except Exception as error:  # noqa: BLE001 - it is raised on the thread that captures
                self._arrived.put((name, error))
                return
            self._arrived.put((name, frame))
