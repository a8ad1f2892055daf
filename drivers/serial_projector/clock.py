"""The box's clock on the host's: bounds that hold, not a fit.

The box stamps a command at u µs of its own clock, somewhere between the instant a ns at which the command's first byte
left the host and the instant b ns at which the answer was read. So each exchange says: host(u) lies in [a, b]. Both
clocks run steadily, one at r times the other's rate; two exchanges bound r,

    (a₂ - b₁)/(u₂ - u₁) ≤ r ≤ (b₂ - a₁)/(u₂ - u₁),

and so, with time, drift falls out as the exchanges come to lie further apart. An instant of the box lies in all the
intervals [a, b] at once, each moved there by the bounds of r: the middle of what is left is the estimate, half its
length the error. The shortest exchanges bound most; those that waited for a retry are wider, never wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_DRIFT = 1e-3
"""How fast or slow a box's clock may be; a ceramic resonator is within this, a crystal by far."""

_SLOT_NS = 4 * 10**9
_SLOTS = 16
_WANDER = 2e-6
"""By how much the rate of a clock may change within the time that is looked back on: its temperature does."""


@dataclass(frozen=True, slots=True)
class _Exchange:
    device_us: int
    before_ns: int
    after_ns: int

    @property
    def width_ns(self) -> int:
        return self.after_ns - self.before_ns


class BoxClock:
    """Turns instants of a box into instants of CLOCK_MONOTONIC. Not safe between threads."""

    def __init__(self) -> None:
        self._latest: _Exchange | None = None
        self._best: dict[int, _Exchange] = {}
        self._rate = (1 - MAX_DRIFT, 1 + MAX_DRIFT)

    @property
    def rate(self) -> tuple[float, float]:
        """Bounds of how many ns of the host pass in 1000 · (1 µs of the box)."""
        return self._rate

    def note(self, device_us: int, before_ns: int, after_ns: int) -> None:
        """The box stamped something with `device_us` between two instants of the host."""
        new = _Exchange(device_us, before_ns, after_ns)
        if self._latest is not None and not self._agree(new):
            # Its clock jumped, or drifts more than a clock may: what was known is of no use.
            self._best.clear()
            self._rate = (1 - MAX_DRIFT, 1 + MAX_DRIFT)
        self._latest = new
        slot = before_ns // _SLOT_NS
        kept = self._best.get(slot)
        if kept is None or new.width_ns <= kept.width_ns:
            self._best[slot] = new
        for old in sorted(self._best)[:-_SLOTS]:
            del self._best[old]
        self._learn_rate()

    def host_ns(self, device_us: int) -> tuple[int, int]:
        """(instant, error) in ns, of an instant of the box. Raises ValueError before anything was noted."""
        bounds = self._bounds(device_us)
        if bounds is None:
            message = "no exchange with the box was noted yet"
            raise ValueError(message)
        low_ns, high_ns = bounds
        return (low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2

    def _exchanges(self) -> list[_Exchange]:
        kept = list(self._best.values())
        return kept if self._latest is None or self._latest in kept else [*kept, self._latest]

    def _bounds(self, device_us: int) -> tuple[int, int] | None:
        """(earliest, latest) instant that all exchanges allow; earliest after latest where they contradict."""
        slow, fast = self._rate
        lows, highs = [], []
        for each in self._exchanges():
            since_ns = (device_us - each.device_us) * 1000
            least, most = sorted((since_ns * slow, since_ns * fast))
            lows.append(each.before_ns + round(least))
            highs.append(each.after_ns + round(most))
        return (max(lows), min(highs)) if lows else None

    def _agree(self, new: _Exchange) -> bool:
        bounds = self._bounds(new.device_us)
        return bounds is None or max(bounds[0], new.before_ns) <= min(bounds[1], new.after_ns)

    def _learn_rate(self) -> None:
        exchanges = sorted(self._exchanges(), key=lambda each: each.device_us)
        slow, fast = 1 - MAX_DRIFT, 1 + MAX_DRIFT
        for index, first in enumerate(exchanges):
            for second in exchanges[index + 1 :]:
                apart_ns = (second.device_us - first.device_us) * 1000
                if apart_ns > 0:
                    slow = max(slow, (second.before_ns - first.after_ns) / apart_ns - _WANDER)
                    fast = min(fast, (second.after_ns - first.before_ns) / apart_ns + _WANDER)
        self._rate = (slow, fast) if slow <= fast else (1 - MAX_DRIFT, 1 + MAX_DRIFT)
