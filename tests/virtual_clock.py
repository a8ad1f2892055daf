"""A clock of tests: time passes at once where somebody waits for it. No test waits, and a busy machine changes none."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable, Collection
from typing import ClassVar
from weakref import WeakKeyDictionary

_MOST_READINGS = 1_000_000
_PATIENCE_S = 5.0
"""How long a thread may take to come to its next wait; one that hangs must not hang the test."""
_BLOCKED_S = 1.0
"""How long the clock may stand before it counts the thread under test as blocked by a lock that a sleeper holds."""


class VirtualClock:
    """Implements `slrig.devices.Clock`. A wait for an instant moves the clock there.

    threads : names of threads that run next to the one under test: a driver's sign of life, a fake device's own
    program. They do not make time pass, unless the thread under test is blocked. They sleep until another thread's wait
    has made it pass, and that wait goes on when all of them sleep again or have ended. So what is due first is done
    first.
    """

    _clocks: ClassVar[WeakKeyDictionary[threading.Thread, VirtualClock]] = WeakKeyDictionary()
    """The clock by which a thread sleeps: a thread of an earlier test may still end."""

    def __init__(self, now_ns: int = 10**9, *, threads: Collection[str] = ()) -> None:
        self._now_ns, self._readings = now_ns, 0
        self._threads = frozenset(threads)
        self._changed = threading.Condition(threading.RLock())
        self._due_ns: dict[threading.Thread, int] = {}
        self._calls: list[tuple[int, int, Callable[[], object]]] = []
        self._order = itertools.count()

    def now_ns(self) -> int:
        """See `Clock`. Fails in code that reads the time over and over without a wait: it would never end."""
        readings = self._readings = self._readings + 1
        assert readings < _MOST_READINGS, "time stands still, and the code under test waits for it to pass by itself"
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `Clock`. No time passes once `stop` is set."""
        if threading.current_thread().name in self._threads:
            self._sleep(t_ns, stop)
        else:
            self._pass(t_ns, stop)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self._pass(self._now_ns + round(seconds * 1e9), threading.Event())

    def call_at(self, t_ns: int, act: Callable[[], object]) -> None:
        """Call a function when a wait reaches an instant."""
        with self._changed:
            heapq.heappush(self._calls, (t_ns, next(self._order), act))

    def _sleep(self, t_ns: int, stop: threading.Event) -> None:
        me = threading.current_thread()
        with self._changed:
            self._clocks[me], self._due_ns[me] = self, t_ns
            self._changed.notify_all()
            stands, since_s = self._now_ns, time.monotonic()
            while me in self._due_ns and not stop.is_set():
                # The owner of `stop` does not notify this clock.
                self._changed.wait(0.002)
                if self._now_ns != stands:
                    stands, since_s = self._now_ns, time.monotonic()
                elif time.monotonic() - since_s > _BLOCKED_S and min(self._due_ns.values()) == t_ns:
                    self._move(t_ns)
                    break
            self._due_ns.pop(me, None)

    def _pass(self, t_ns: int, stop: threading.Event) -> None:
        with self._changed:
            while True:
                self._await_threads()
                if stop.is_set():
                    return
                thread = min(self._due_ns, key=self._due_ns.__getitem__, default=None)
                thread_ns = t_ns + 1 if thread is None else self._due_ns[thread]
                if self._calls and self._calls[0][0] <= min(t_ns, thread_ns):
                    due_ns, _, act = heapq.heappop(self._calls)
                    self._move(due_ns)
                    act()
                elif thread is not None and thread_ns <= t_ns:
                    self._move(self._due_ns.pop(thread))
                    self._changed.notify_all()
                else:
                    self._move(t_ns)
                    return

    def _move(self, t_ns: int) -> None:
        if t_ns > self._now_ns:
            self._now_ns, self._readings = t_ns, 0

    def _await_threads(self) -> None:
        """Return when every named thread sleeps or has ended."""
        until_s, me = time.monotonic() + _PATIENCE_S, threading.current_thread()
        while any(
            each.name in self._threads and each is not me and each not in self._due_ns
            for each in threading.enumerate()
            if self._clocks.get(each, self) is self
        ):
            self._changed.wait(0.001)
            assert time.monotonic() < until_s, "a thread next to the test does not come to its next wait"
