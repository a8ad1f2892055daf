"""A bundle written on a thread of its own, so that the disk never holds up the camera.

Frames wait in a queue of bounded size: a disk that cannot keep up slows the capture down rather than fill the memory.
"""

from __future__ import annotations

import queue
import threading
from types import TracebackType
from typing import Self

from slrig.bundle import BundleWriter
from slrig.bundle.refused import Refused
from slrig.model import Shot

MOST_WAITING_BYTES = 256 * 2**20
"""How much of frames may wait for the disk."""

_LEAST_FRAME_BYTES = 2**18  # a smaller camera's frames do not wait in thousands


class Recorder:
    """Hands frames to a writer in the order in which they came. A context manager, within the writer's own.

    Leaving it well waits until everything is written; leaving it with an error writes no more. Either way nobody uses
    the writer afterwards. What the writer raises is raised by the next call, or at the end.
    """

    def __init__(self, writer: BundleWriter, *, most_bytes: int = MOST_WAITING_BYTES) -> None:
        self._writer = writer
        self._most_bytes = most_bytes
        self._waiting: queue.Queue[Shot | Refused | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._stopped = False
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        return self

    def add(self, shot: Shot) -> None:
        """Have a frame written; waits while too many are waiting already. Raises as `BundleWriter.add` does."""
        self._put(shot)

    def refuse(self, refused: Refused) -> None:
        """Have a refused frame kept apart. Raises as `BundleWriter.refuse` does."""
        self._put(refused)

    def finish(self) -> None:
        """Wait until everything is written. Idempotent. Raises what the writer raised."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._thread = None
        if self._error is not None:
            raise self._error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.finish()
        elif self._thread is not None:
            self._stopped = True
            self._waiting.put(None)
            self._thread.join()

    def _put(self, item: Shot | Refused) -> None:
        if self._error is not None:
            raise self._error
        if self._thread is None:
            shot = item if isinstance(item, Shot) else item.shot
            size = _LEAST_FRAME_BYTES if shot is None else max(shot.image.nbytes, _LEAST_FRAME_BYTES)
            self._waiting = queue.Queue(max(1, self._most_bytes // size))
            self._thread = threading.Thread(target=self._write, name="slrig-recorder", daemon=True)
            self._thread.start()
        self._waiting.put(item)

    def _write(self) -> None:
        while (item := self._waiting.get()) is not None:
            if self._stopped:
                continue
            try:
                if isinstance(item, Shot):
                    self._writer.add(item)
                else:
                    self._writer.refuse(item)
            except Exception as error:  # noqa: BLE001 - it is raised again on the thread that captures
                # Go on taking frames, so that whoever captures never waits for room, and write none of them.
                self._error, self._stopped = error, True
