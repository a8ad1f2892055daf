"""The time in which a rig lives: the system's monotonic clock, or that of an instrument with a time of its own."""

from __future__ import annotations

import threading
import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """A rig's time, ns: that of its time stamps."""

    def now_ns(self) -> int:
        """The time now."""
        ...

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """Return when it is `t_ns` or later, or as soon as `stop` is set."""
        ...


@runtime_checkable
class KeepsTime(Protocol):
    """A head whose time stamps do not count in CLOCK_MONOTONIC, as that of a rendered rig on virtual time."""

    @property
    def clock(self) -> Clock:
        """The time of its devices."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `Clock`."""
        while (left_ns := t_ns - self.now_ns()) > 0:
            if stop.wait(left_ns / 1e9):
                return
