"""Time and light in the rendered world: its clock, and what the projector has been showing when."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

from simulated_rig.light import LightTable

NS_PER_S = 1_000_000_000

_MAX_CHANGES = 256


def nanoseconds(seconds: float) -> int:
    """Whole nanoseconds of a time in seconds."""
    return round(seconds * NS_PER_S)


class VirtualClock:
    """Time that passes only when somebody waits: as fast as possible, and the same in every run."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """See `slrig.devices.Clock`."""
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `slrig.devices.Clock`. Returns at once; no time passes for a device that has stopped."""
        if stop.is_set():
            return
        with self._lock:
            self._now_ns = max(self._now_ns, t_ns)


@dataclass(frozen=True, slots=True)
class LightFlicker:
    """Light that swings about its mean, 1 + depth · sin(2π f t): the mains' in a lamp, or a colour wheel's."""

    frequency_hz: float
    depth: float

    def mean(self, t_start_ns: int, t_end_ns: int) -> float:
        """The mean of an interval: 1 over whole periods."""
        middle_s, half_s = (t_start_ns + t_end_ns) / 2 / NS_PER_S, (t_end_ns - t_start_ns) / 2 / NS_PER_S
        turn = 2 * math.pi * self.frequency_hz
        left = math.sin(turn * half_s) / (turn * half_s) if half_s > 0 else 1.0
        return 1 + self.depth * left * math.sin(turn * middle_s)


class Lamp:
    """What the projector shows, and showed: a list of changes in time. Dark at first. Safe between threads."""

    def __init__(self, dark: LightTable, flicker: LightFlicker | None = None) -> None:
        self._dark = dark
        self.flicker = flicker
        self._changes: deque[tuple[int, LightTable]] = deque([(0, dark)], maxlen=_MAX_CHANGES)
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
        """Each light shown in an interval, with the fraction of the interval that it was on; fractions sum to 1.

        A lamp that flickers gives more or less than that.
        """
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
                swing = 1.0 if self.flicker is None else self.flicker.mean(begin, end)
                shown.append(((end - begin) / span * swing, changes[i][1]))
                begin = end
        return shown
