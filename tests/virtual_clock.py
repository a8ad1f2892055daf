"""Time for tests: it passes at once, and only where somebody waits for it."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable


class VirtualClock:
    """Implements `slrig.devices.Clock`. A wait for an instant moves the clock there. For one thread at a time."""

    def __init__(self, now_ns: int = 10**12) -> None:
        self._now_ns = now_ns
        self._due: list[tuple[int, int, Callable[[], object]]] = []
        self._order = itertools.count()

    def now_ns(self) -> int:
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        while not stop.is_set() and self._due and self._due[0][0] <= t_ns:
            due_ns, _, act = heapq.heappop(self._due)
            self._now_ns = max(self._now_ns, due_ns)
            act()
        if not stop.is_set():
            self._now_ns = max(self._now_ns, t_ns)

    def advance(self, seconds: float) -> None:
        """Let so much time pass."""
        self.wait_until(self._now_ns + round(seconds * 1e9), threading.Event())

    def call_at(self, t_ns: int, act: Callable[[], object]) -> None:
        """Have something happen when a wait reaches an instant."""
        heapq.heappush(self._due, (t_ns, next(self._order), act))
