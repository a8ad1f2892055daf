"""The order of frames: which are new, how many never came, and how fast they come."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field

from drivers.v4l2.stream import Taken
from drivers.v4l2.timing import OTHER_CLOCK_NS, StampSource

_ROUND = 2**32
_LARGEST_STEP = 2**31


@dataclass(slots=True)
class Tally:
    """Counts the frames of one stream. `number` goes on from stream to stream, as long as the camera is open.

    `lost` are frames that the camera made while a buffer was free and that did not come, repeated ones and corrupt
    ones. Those made while nobody read, when all buffers were full, are not: they would have been stale.
    `ahead_ns` is how far a stamp was seen to lie after the instant at which its frame was here already.
    """

    number: int = -1
    lost: int = 0
    ahead_ns: int = 0
    _last: Taken | None = None
    _intervals_ns: list[float] = field(default_factory=list)

    def begin(self) -> None:
        """A stream starts: its sequence numbers start anew."""
        self._last = None
        self.ahead_ns = 0
        self._intervals_ns.clear()

    def forget_losses(self) -> None:
        """From here on, losses count."""
        self.lost = 0

    def is_new(self, taken: Taken) -> bool:
        """Note a frame. False if it came before: its stamp is not later than the last one's."""
        last, self._last = self._last, taken
        ahead_ns = taken.stamp.stamp_ns - taken.stamp.taken_ns
        if taken.stamp.source is not StampSource.NONE and ahead_ns <= OTHER_CLOCK_NS:
            self.ahead_ns = max(self.ahead_ns, ahead_ns)
        if last is None:
            self.number += 1
            return True
        step = (taken.sequence - last.sequence) % _ROUND
        stamped = StampSource.NONE not in (taken.stamp.source, last.stamp.source)
        if (taken.stamp.stamp_ns <= last.stamp.stamp_ns) if stamped else (step == 0):
            self._last = last
            self.lost += 1
            return False
        # A driver that does not count, or starts anew, tells nothing about losses.
        step = step if 1 <= step < _LARGEST_STEP else 1
        self.number += step
        if stamped:
            self._intervals_ns.append((taken.stamp.stamp_ns - last.stamp.stamp_ns) / step)
        # Buffers are filled in the order in which they were queued. Had this one been free when the last frame was
        # finished, the frames between would have come: they are lost. Otherwise there was no room for them.
        finished_ns = last.stamp.stamp_ns if stamped else last.stamp.taken_ns
        if taken.stamp.queued_ns <= finished_ns:
            self.lost += step - 1
        return True

    def note_corrupt(self) -> None:
        """A frame came and its data are damaged."""
        self.lost += 1

    def period_ns(self) -> int | None:
        """The measured time from frame to frame (median); None with fewer than two stamped frames."""
        return round(statistics.median(self._intervals_ns)) if self._intervals_ns else None
