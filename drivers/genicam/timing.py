"""Start of exposures on CLOCK_MONOTONIC, from the camera's time stamps and the frames' arrivals; arithmetic only.

Three facts are known, each as an interval that certainly contains the true instant:

- the frame's first packet arrived after the exposure ended: start ≤ arrival - exposure;
- a software trigger cannot be answered before it is sent: start ≥ the beginning of the call;
- the camera's own time stamp, once its clock is related to the host's: by latching it between two readings of the
  host's clock, by the triggers and arrivals of earlier frames, or both. A crystal may be off by `DRIFT`.

The time that a frame stays in the camera before it is sent is unknown; `transfer_ns` bounds it for exposures without a
trigger of the host, `answer_ns` for those of a software trigger.
"""

from __future__ import annotations

from dataclasses import dataclass

DRIFT = 1e-4
"""Largest relative rate difference of the camera's clock from the host's: crystals are good to 50 parts per million
each."""

_FOREVER_NS = 1 << 62
_EXPIRY_FACTOR = 4
_HALF = 1 << 15
_GIGE_IDS = (1 << 16) - 1


@dataclass(frozen=True, slots=True)
class Interval:
    """From `min_ns` to `max_ns`; empty if min_ns is larger."""

    min_ns: int
    max_ns: int

    def __and__(self, other: Interval) -> Interval:
        return Interval(max(self.min_ns, other.min_ns), min(self.max_ns, other.max_ns))

    @property
    def is_empty(self) -> bool:
        """True if the interval contains no instant."""
        return self.min_ns > self.max_ns


class FrameNumbers:
    """Unwraps frame ids into numbers that count from 0 with the first frame of an acquisition.

    GigE Vision counts blocks from 1 to 65535 and then from 1 again; its extended ids and USB3 Vision have 64 bits.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._number = 0
        self.frame_count = 0

    def next(self, block_id: int) -> int | None:
        """Return the number of a frame; None for one that repeats or precedes the last."""
        last, self._last = self._last, block_id
        if last is None:
            step = 0
        elif last > _GIGE_IDS or block_id > _GIGE_IDS:
            step = block_id - last
        else:
            step = (block_id - last) % (_GIGE_IDS if block_id else _GIGE_IDS + 1)
            step = step if step < _HALF else step - _GIGE_IDS
        if last is not None and step <= 0:
            self._last = last
            return None
        self._number += step
        self.frame_count = self._number + 1
        return self._number


class StartClock:
    """Relates a camera's clock to the host's: start of exposure for a time stamp.

    Parameters
    ----------
    lag_ns
        Bounds of the delay of a time stamp after the start of its exposure.
    """

    def __init__(self, lag_ns: Interval) -> None:
        self._lag_ns = lag_ns
        self._latched: tuple[int, Interval] | None = None
        self._offset: tuple[int, Interval] | None = None

    @property
    def is_tied(self) -> bool:
        """True if the clock was latched; it is then more reliable than the network's timing."""
        return self._latched is not None

    def latch(self, latches: list[tuple[int, int, int]]) -> bool:
        """Relate the clocks by latches: host time before, camera time, host time after, all ns; at least two.

        Return True if they agree; otherwise (a stopped clock, a stamp in other units) they are not used.
        """
        offset, at_ns = Interval(-_FOREVER_NS, _FOREVER_NS), 0
        for before_ns, stamp_ns, after_ns in latches:
            at_ns = max(at_ns, stamp_ns)
            observed = Interval(before_ns - stamp_ns, after_ns - stamp_ns)
            offset &= Interval(observed.min_ns - self._lag_ns.max_ns, observed.max_ns - self._lag_ns.min_ns)
        # Without the lag's uncertainty: latches of a stopped clock contradict each other.
        bare = Interval(
            max(before_ns - stamp_ns for before_ns, stamp_ns, _ in latches),
            min(after_ns - stamp_ns for _, stamp_ns, after_ns in latches),
        )
        moved = len({stamp_ns for _, stamp_ns, _ in latches}) == len(latches) > 1
        if bare.is_empty or not moved:
            return False
        self._latched = self._offset = (at_ns, offset)
        return True

    def learn(self, stamp_ns: int, start: Interval) -> None:
        """Narrow the relation by a frame whose start is known otherwise; ignore a contradiction."""
        offset = Interval(start.min_ns - stamp_ns, start.max_ns - stamp_ns)
        if self._offset is not None:
            offset &= self._with_drift(stamp_ns, self._offset)
        if not offset.is_empty:
            self._offset = (stamp_ns, offset)

    def forget(self) -> None:
        """Return to the relation known from the latches."""
        self._offset = self._latched

    def start(self, stamp_ns: int) -> Interval:
        """Return the start of the exposure with this stamp, as known from the clock."""
        if self._offset is None:
            return Interval(-_FOREVER_NS, _FOREVER_NS)
        offset = self._with_drift(stamp_ns, self._offset)
        return Interval(offset.min_ns + stamp_ns, offset.max_ns + stamp_ns)

    def _with_drift(self, stamp_ns: int, offset: tuple[int, Interval]) -> Interval:
        at_ns, known = offset
        play_ns = round(DRIFT * abs(stamp_ns - at_ns))
        return Interval(known.min_ns - play_ns, known.max_ns + play_ns)


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame's number, the camera's time stamp (None: do not use), and the arrival of its first packet."""

    number: int
    stamp_ns: int | None
    arrived_ns: int


class UntriggeredStarts:
    """Starts of exposures that the host did not trigger: free-running, or triggered by wire."""

    def __init__(self, exposure_ns: int, transfer_ns: int, clock: StartClock) -> None:
        self._exposure_ns = exposure_ns
        self._transfer_ns = transfer_ns
        self._clock = clock

    def start(self, frame: Arrival) -> Interval | None:
        """Return the start of the exposure; None if the camera's clock contradicts the frame's arrival."""
        latest_ns = frame.arrived_ns - self._exposure_ns
        if frame.stamp_ns is None:
            return Interval(latest_ns - self._transfer_ns, latest_ns)
        # A frame may arrive late and never early, so the fastest frames bound the clock from above.
        self._clock.learn(frame.stamp_ns, Interval(-_FOREVER_NS, latest_ns))
        start = self._clock.start(frame.stamp_ns) & Interval(-_FOREVER_NS, latest_ns)
        if not self._clock.is_tied:
            start &= Interval(start.max_ns - self._transfer_ns, _FOREVER_NS)
        return None if start.is_empty else start


class TriggeredStarts:
    """Starts of exposures that software triggers began.

    Frames answer triggers in order; a lost frame answered one as well, and its number is missing. A camera may ignore a
    trigger, so frame n may answer the nth or a later one. The earliest possible trigger is assumed: at worst a frame is
    taken for older than it is. A trigger expires when it is four times as old as an answer may be, or when the camera
    answered after it and was then silent for as long as an answer may take.
    """

    def __init__(self, exposure_ns: int, answer_ns: int, clock: StartClock) -> None:
        self._exposure_ns = exposure_ns
        self._answer_ns = answer_ns
        self._clock = clock
        self._triggers: list[Interval] = []
        self._answered = -1
        self._last_known = -1
        self._closed = -1
        self._number = -1

    def note_trigger(self, begun_ns: int, ended_ns: int, *, times: int = 1) -> None:
        """Note a trigger, and how many times it may have been sent."""
        if self.answer_due_ns(begun_ns) <= 0:
            self._closed = self._last_known
        self._triggers += [Interval(begun_ns, ended_ns)] * times

    def answer_due_ns(self, now_ns: int) -> int:
        """Remaining time in which the answer to a trigger may arrive; 0 or less if none is due."""
        unanswered = self._triggers[max(self._answered, self._closed) + 1 :]
        last_ns = max((trigger.max_ns for trigger in unanswered), default=-_FOREVER_NS)
        return last_ns + self._exposure_ns + self._answer_ns - now_ns

    def start(self, frame: Arrival) -> Interval | None:
        """Return the start of the exposure; None if the frame answers no trigger."""
        first = max(self._answered + frame.number - self._number, self._closed + 1)
        self._number = frame.number
        self._last_known = len(self._triggers) - 1
        latest_ns = frame.arrived_ns - self._exposure_ns
        for index in range(first, len(self._triggers)):
            trigger = self._triggers[index]
            if trigger.max_ns < latest_ns - _EXPIRY_FACTOR * self._answer_ns:
                continue
            start = Interval(trigger.min_ns, latest_ns)
            if frame.stamp_ns is not None:
                start &= self._clock.start(frame.stamp_ns)
            if not start.is_empty:
                if frame.stamp_ns is not None:
                    self._clock.learn(frame.stamp_ns, start)
                self._answered = index
                return start
        self._clock.forget()
        return None
