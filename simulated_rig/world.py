"""Time and light in the rendered world: its clock, and what the projector has been showing when."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Protocol

from simulated_rig.light import LightTable

NS_PER_S = 1_000_000_000

_CHANGES_KEPT = 256


def nanoseconds(seconds: float) -> int:
    """Whole nanoseconds of a time in seconds."""
    return round(seconds * NS_PER_S)


class Clock(Protocol):
    """The world's time, ns."""

    def now_ns(self) -> int:
        """The time now."""
        ...

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """Return when it is `t_ns` or later, or as soon as `stop` is set."""
        ...


class VirtualClock:
    """Time that passes only when somebody waits: as fast as possible, and the same in every run."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """See `Clock`."""
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `Clock`. Returns at once; no time passes for a device that has stopped."""
        if stop.is_set():
            return
        with self._lock:
            self._now_ns = max(self._now_ns, t_ns)


class MonotonicClock:
    """CLOCK_MONOTONIC: the rig takes as long as a real one."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `Clock`."""
        while (left_ns := t_ns - self.now_ns()) > 0:
            if stop.wait(left_ns / NS_PER_S):
                return


class Lamp:
    """What the projector shows, and showed: a list of changes in time. Dark at first. Safe between threads."""

    def __init__(self, dark: LightTable) -> None:
        self._dark = dark
        self._changes: deque[tuple[int, LightTable]] = deque([(0, dark)], maxlen=_CHANGES_KEPT)
        self._lock = threading.Lock()

    def show(self, table: LightTable, *, at_ns: int) -> int:
        """Change the light at `at_ns`, or right after the change before, and return when it will change."""
        with self._lock:
            at_ns = max(at_ns, self._changes[-1][0])
            self._changes.append((at_ns, table))
        return at_ns

    def darken(self, *, at_ns: int) -> None:
        """Go dark at `at_ns`, and forget every change that was still to come."""
        with self._lock:
            while len(self._changes) > 1 and self._changes[-1][0] >= at_ns:
                self._changes.pop()
            self._changes.append((at_ns, self._dark))

    def light_at(self, t_ns: int) -> LightTable:
        """The light at one instant."""
        return self.light_between(t_ns, t_ns)[0][1]

    def light_between(self, t_start_ns: int, t_end_ns: int) -> list[tuple[float, LightTable]]:
        """Each light shown in an interval, with the fraction of the interval that it was on; fractions sum to 1."""
        with self._lock:
            changes = list(self._changes)
        first = max((i for i, (at_ns, _) in enumerate(changes) if at_ns <= t_start_ns), default=0)
        span = t_end_ns - t_start_ns
        if span <= 0:
            return [(1.0, changes[first][1])]
        shown: list[tuple[float, LightTable]] = []
        begin = t_start_ns
        for i in range(first, len(changes)):
            end = min(changes[i + 1][0], t_end_ns) if i + 1 < len(changes) else t_end_ns
            if end > begin:
                shown.append(((end - begin) / span, changes[i][1]))
                begin = end
        return shown
