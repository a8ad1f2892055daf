"""The clock of a replayed recording, and its speed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

_TICK_NS = 1_000
_GLANCE_S = 0.05
_LEAD_NS = 1_000_000
"""From the first `show` to the recording's first frame: margin so that the frame is not late."""


class ReplayClock:
    """The rig's clock, ns. Devices advance it to the recorded times; it never runs by itself.

    Implements `slrig.devices.Clock`.

    At speed 0 it starts at 0 and jumps, so a replay is as fast as the disk. At a speed above 0 it starts at
    CLOCK_MONOTONIC, and a jump takes the recording's time divided by the speed. A caller that is slower than the
    recording is not delayed further, and still finds the recorded times.

    Parameters
    ----------
    speed
        Seconds of the recording per second; 0 for no pacing.
    real_ns, wait
        The pacing clock, and a function that waits for some seconds; by default until `release`.
    """

    def __init__(
        self,
        speed: float = 0.0,
        *,
        real_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self._speed = speed
        self._released = threading.Event()
        self._real_ns = real_ns
        self._wait = self._released.wait if wait is None else wait
        self._now_ns = real_ns() if speed else 0
        self._held_ns = self._now_ns
        self._paced_from_ns = (self._now_ns, self._now_ns)
        self._origin_ns: int | None = None
        self._rewound = True

    def now_ns(self) -> int:
        """See `slrig.devices.Clock`."""
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `slrig.devices.Clock`."""
        while not stop.is_set() and (left_s := self._left_s(t_ns)) > 0:
            self._wait(min(left_s, _GLANCE_S))
        if not stop.is_set():
            self._now_ns = max(self._now_ns, t_ns)

    def rewind(self) -> None:
        """Restart the recording with the next shown pattern, unless that is still to come in it."""
        self._rewound = True

    def recorded_ns(self, time_s: float | None) -> int:
        """Return the time at which a frame of this recorded time is due; 0 if the recording has no time."""
        return 0 if time_s is None or self._origin_ns is None else self._origin_ns + round(time_s * 1e9)

    def hold(self, until_ns: int) -> None:
        """Keep the light unchanged until an exposure has ended."""
        self._held_ns = max(self._held_ns, until_ns)

    def change_light(self, time_s: float | None = None) -> int:
        """Advance to the end of all exposures, and at least to a recorded time; return the new time."""
        earliest_ns = max(self._now_ns, self._held_ns) + _TICK_NS
        if time_s is not None:
            if self._rewound and (self._origin_ns is None or self.recorded_ns(time_s) < earliest_ns):
                self._begin(earliest_ns, time_s)
            self._rewound = False
        self._now_ns = max(earliest_ns, self.recorded_ns(time_s))
        self._pace(self._now_ns)
        return self._now_ns

    def wait_until_reached(self, at_ns: int, within_s: float) -> bool:
        """Wait until the clock may be at `at_ns`; return False at once if that would take longer than `within_s`."""
        if self._left_s(at_ns) > within_s:
            return False
        self._pace(at_ns)
        return True

    def pass_time(self, seconds: float) -> None:
        """Let time pass, also in real time if the replay is paced."""
        passed_ns = round(seconds * 1e9 * (self._speed or 1))
        self._now_ns = self._held_ns = max(self._now_ns + passed_ns, self._held_ns)
        if self._speed:
            self._wait(seconds)

    def release(self) -> None:
        """End all waits. For `close`, from any thread."""
        self._released.set()

    def _begin(self, earliest_ns: int, time_s: float) -> None:
        self._now_ns = max(earliest_ns, self._real_ns()) if self._speed else earliest_ns
        self._origin_ns = self._now_ns + _LEAD_NS - round(time_s * 1e9)
        self._paced_from_ns = (self._real_ns(), self._now_ns)

    def _left_s(self, at_ns: int) -> float:
        if not self._speed or self._released.is_set():
            return 0.0
        real_ns, rig_ns = self._paced_from_ns
        return (real_ns - self._real_ns() + math.ceil((at_ns - rig_ns) / self._speed)) / 1e9

    def _pace(self, at_ns: int) -> None:
        while (left_s := self._left_s(at_ns)) > 0:
            self._wait(left_s)
