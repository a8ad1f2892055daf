"""When a frame was exposed, from the little that OpenCV tells: see the package's docstring for the rules."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass

from drivers.v4l2.timing import Exposure

_OTHER_CLOCK_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class Grabbed:
    """When a frame was taken over from OpenCV, ns: asked for, returned, and of that time asleep (`slept_ns`)."""

    asked_ns: int
    returned_ns: int
    slept_ns: int


def by_stamp(stamp_ns: int, grabbed: Grabbed, *, exposure_ns: int, period_ns: int) -> Exposure:
    """Return when a frame with the kernel's stamp was exposed, whatever instant of the frame the stamp names."""
    latest_ns = min(stamp_ns + period_ns + exposure_ns, grabbed.returned_ns)
    return Exposure(stamp_ns - period_ns - exposure_ns, latest_ns)


def is_of_this_clock(stamp_ns: int, grabbed: Grabbed) -> bool:
    """Whether a stamp can be one of CLOCK_MONOTONIC: other clocks give themselves away."""
    return abs(grabbed.returned_ns - stamp_ns) < _OTHER_CLOCK_NS


class Arrivals:
    """When the frames of a source without time stamps were exposed.

    A frame arrived after the queue was last seen empty, and the queue was empty when the reader slept in wait for a
    frame. Half a frame period counts as a wait: what a reader that never catches up sleeps now and then, for a lock or
    for its memory, does not.

    Parameters
    ----------
    exposure_ns, delay_ns, period_ns
        The longest exposure, the longest delay, and the shortest time from frame to frame.
    """

    def __init__(self, *, exposure_ns: int, delay_ns: int, period_ns: int) -> None:
        self.exposure_ns = exposure_ns
        self._delay_ns = delay_ns
        self._wait_ns = period_ns // 2
        self._empty_ns: int | None = None
        self.queued = 0
        """Frames since the queue was last seen empty."""

    def exposed(self, grabbed: Grabbed) -> Exposure | None:
        """Return when a frame was exposed; None while nothing tells for how long it had been waiting."""
        if grabbed.slept_ns >= self._wait_ns:
            self._empty_ns = grabbed.asked_ns
            self.queued = 0
        self.queued += 1
        if self._empty_ns is None:
            return None
        return Exposure(self._empty_ns - self._delay_ns - self.exposure_ns, grabbed.returned_ns)


class Sleep:
    """How long the calling thread has slept between two instants; to be made and used by that thread.

    Time on the processor is no sleep, nor, where the kernel tells it (Linux), is waiting for one.
    """

    def __init__(self) -> None:
        self._file: int | None = None
        with suppress(OSError):
            self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)

    def awake_ns(self) -> int:
        """Time so far that the thread was not asleep, ns."""
        queued_ns = 0
        if self._file is not None:
            with suppress(OSError, IndexError, ValueError):
                queued_ns = int(os.pread(self._file, 128, 0).split()[1])
        return time.thread_time_ns() + queued_ns

    def close(self) -> None:
        """Let the kernel's file go."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
