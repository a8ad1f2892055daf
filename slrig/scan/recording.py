"""A bundle written on a thread of its own, so that the disk never holds up the camera.

Frames wait in a queue of bounded size: a disk that cannot keep up slows the capture down rather than fill the memory.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Self

from slrig.bundle import BundleWriter
from slrig.bundle.refused import Refused
from slrig.model import Shot

MOST_WAITING_BYTES = 256 * 2**20
"""How much of frames may wait for the disk."""


class Recorder:
    """Hands frames to a writer in the order in which they came. A context manager, within the writer's own.

    Leaving it well waits until everything is written; leaving it with an error writes no more. Either way nobody uses
    the writer afterwards. What the writer raises is raised by the next call, or at the end.
    """

    def __init__(self, writer: BundleWriter, *, most_bytes: int = MOST_WAITING_BYTES) -> None:
        self._writer = writer
        self._most_bytes = most_bytes
        self._changed = threading.Condition()
        self._waiting: deque[Shot | Refused] = deque()
        self._waiting_bytes = 0
        self._ending = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="slrig-recorder", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def add(self, shot: Shot) -> None:
        """Have a frame written; waits while too much is waiting already. Raises as `BundleWriter.add` does."""
        self._put(shot)

    def refuse(self, refused: Refused) -> None:
        """Have a refused frame kept apart. Raises as `BundleWriter.refuse` does."""
        self._put(refused)

    def finish(self) -> None:
        """Wait until everything is written. Idempotent. Raises what the writer raised."""
        self._end(drop=False)
        if self._error is not None:
            raise self._error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.finish()
        else:
            self._end(drop=True)

    def _end(self, *, drop: bool) -> None:
        with self._changed:
            self._ending = True
            if drop:
                self._waiting.clear()
            self._changed.notify_all()
        self._thread.join()

    def _put(self, item: Shot | Refused) -> None:
        size = _bytes(item)
        with self._changed:
            # One frame may always wait, however large it is.
            self._changed.wait_for(
                lambda: self._error is not None or not self._waiting or self._waiting_bytes + size <= self._most_bytes
            )
            if self._error is not None:
                raise self._error
            self._waiting.append(item)
            self._waiting_bytes += size
            self._changed.notify_all()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ending)
                if not self._waiting:
                    return
                item = self._waiting.popleft()
            try:
                if isinstance(item, Shot):
                    self._writer.add(item)
                else:
                    self._writer.refuse(item)
            except Exception as error:  # noqa: BLE001 - it is raised again on the thread that captures
                with self._changed:
                    self._error = error
                    self._waiting.clear()
                    self._changed.notify_all()
                return
            with self._changed:
                self._waiting_bytes -= _bytes(item)
                self._changed.notify_all()


def _bytes(item: Shot | Refused) -> int:
    shot = item if isinstance(item, Shot) else item.shot
    return 0 if shot is None else shot.image.nbytes
