"""The frames of one camera on their way from the thread that receives them to the one that owns the camera."""

from __future__ import annotations

import threading
import time
from collections import deque

from drivers.depthai.messages import OakFrame
from slrig.errors import DeviceGoneError

MAX_WAITING_FRAMES = 4
"""How many frames wait for a reader while a camera runs by itself; older ones are stale."""


class FrameQueue:
    """Safe between threads. Counts what was lost: gaps in the sequence numbers, which damaged frames leave, too."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[OakFrame] = deque(maxlen=MAX_WAITING_FRAMES)
        self._last_number = -1
        self._lost = 0
        self._why_lost = ""
        self._ended: str | None = None

    @property
    def lost(self) -> tuple[int, str]:
        """How many frames were lost since `begin`, and what was wrong with the last damaged one."""
        with self._changed:
            return self._lost, self._why_lost

    def begin(self, kept: int = MAX_WAITING_FRAMES) -> None:
        """Forget what is waiting, and count anew."""
        with self._changed:
            self._waiting = deque(maxlen=kept)
            self._lost, self._why_lost = 0, ""

    def put(self, delivery: OakFrame) -> None:
        """Take a frame. One that came before is dropped; a gap in the numbers before it counts as lost."""
        with self._changed:
            if delivery.number <= self._last_number:
                return
            if self._last_number >= 0:
                self._lost += delivery.number - self._last_number - 1
            self._last_number = delivery.number
            self._waiting.append(delivery)
            self._changed.notify_all()

    def damaged(self, fault: str) -> None:
        """Note what was wrong with a frame. The gap that it leaves counts it: its own number may be damaged, too."""
        with self._changed:
            self._why_lost = fault

    def lose(self) -> None:
        """Count one more frame that the reader had to pass over."""
        with self._changed:
            self._lost += 1

    def take(self, until_ns: int) -> OakFrame | None:
        """Return the oldest frame that waits, or None if none came until then (CLOCK_MONOTONIC).

        Raises
        ------
        DeviceGoneError
            No frame will come any more.
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
        """No frame will come any more. The first reason stays."""
        with self._changed:
            if self._ended is None:
                self._ended = reason
            self._waiting.clear()
            self._changed.notify_all()
