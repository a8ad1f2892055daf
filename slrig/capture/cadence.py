"""When a free-running camera will have exposed its next frame, foretold from the time stamps of those before."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from slrig.model import Frame

_REMEMBERED = 24
"""Frames that the period is taken from: at 30 a second, a little less than a second's."""

_FEWEST = 3
"""Frames that tell a period, and whether it can be relied on. With fewer, the camera's own word counts."""

_UNPROVEN = 0.1
"""How much of the period that a camera states its next frame may come otherwise than foretold by that. Stamps of
webcams scatter by about a millisecond; where the period is wrong, one pattern is shown again."""

_SPARE = 2.0
"""Standard deviations of the stamps that a frame may come otherwise than foretold. One in twenty comes otherwise still,
and is shown again: to allow for it would cost every pattern more."""

_WORST_JITTER = 0.25
"""Standard deviation of the stamps, in periods, from which on nothing is foretold."""


class Cadence:
    """Follows the frames of one camera, in order. stated_s : its period as it says itself; None where it does not."""

    def __init__(self, stated_s: float | None = None) -> None:
        self._starts: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        self._stated_ns = None if stated_s is None else stated_s * 1e9

    def note(self, frame: Frame) -> None:
        """Take note of a frame's number and its start."""
        if self._starts and frame.sequence_number <= self._starts[-1][0]:
            self._starts.clear()
        self._starts.append((frame.sequence_number, frame.t_start_ns))

    def start_after(self, t_ns: int) -> tuple[int, int] | None:
        """Return when the first frame begins that surely begins at `t_ns` or later, and by how much later it may, ns.

        None where too few frames are known, or they come too unevenly. The line through the frames' numbers and starts
        is one of least squares: numbers, because frames may be lost in between.
        """
        if not self._starts:
            return None
        numbers, starts_ns = np.array(self._starts, np.int64).T
        last, latest_ns = int(numbers[-1]), int(starts_ns[-1])
        if len(self._starts) >= _FEWEST:
            x, y = (numbers - last).astype(np.float64), (starts_ns - latest_ns).astype(np.float64)
            slope, offset = np.polyfit(x, y, 1)
            jitter_ns = float(np.std(y - slope * x - offset))
            if slope <= 0 or jitter_ns > _WORST_JITTER * slope:
                return None
            begun_ns, spare_ns = latest_ns + offset, _SPARE * jitter_ns
        elif self._stated_ns is not None:
            slope, begun_ns, spare_ns = self._stated_ns, latest_ns, _UNPROVEN * self._stated_ns
        else:
            return None
        ahead = max(math.ceil((t_ns + spare_ns - begun_ns) / slope), 1)
        return round(begun_ns + ahead * slope), round(spare_ns)
