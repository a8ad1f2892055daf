"""The thread that reads all the time, and the rules by which a frame's exposure is bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.opencv.feeds import (
    ArrivalTiming,
    FeedReader,
    GrabbedFrame,
    GrabTimes,
    SleepMeter,
    exposure_from_stamp,
    is_monotonic_stamp,
)
from drivers.v4l2.stream import ExposureInterval
from slrig.errors import DeviceGoneError

LONG_S = 20.0


class ScriptedFeed:
    """Gives so many frames, then waits to be let go on, then is gone."""

    def __init__(self, count: int) -> None:
        self.numbers: Iterator[int] = iter(range(count))
        self.go_on = threading.Event()
        self.waiting = threading.Event()
        self.released = threading.Event()
        self.pauses = 0

    def begin(self) -> None:
        """Do nothing."""

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        # As OpenCV does, it takes no notice of who wants it to stop.
        del stop
        number = next(self.numbers, None)
        if number is not None:
            return GrabbedFrame(np.zeros((1, 1), np.uint8), None, number)
        self.waiting.set()
        assert self.go_on.wait(LONG_S)
        message = "unplugged"
        raise DeviceGoneError(message)

    def pause(self) -> None:
        self.pauses += 1

    def release(self) -> None:
        self.released.set()


def soon() -> int:
    return time.monotonic_ns() + round(LONG_S * 1e9)


def test_the_newest_frames_are_kept_in_order() -> None:
    feed = ScriptedFeed(20)
    reader = FeedReader(feed, "reader")
    reader.start()
    assert feed.waiting.wait(LONG_S)
    kept = [taken.number for taken in (reader.next(soon()) for _ in range(8)) if taken is not None]
    assert kept == list(range(12, 20))
    assert reader.next(time.monotonic_ns()) is None
    feed.go_on.set()
    for _ in range(2):
        with pytest.raises(DeviceGoneError, match="unplugged"):
            reader.next(soon())
    reader.close()
    assert feed.released.is_set()
    assert feed.pauses == 1


def test_a_source_that_does_not_return_is_released_by_its_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.opencv.feeds._JOIN_S", 0.01)
    feed = ScriptedFeed(1)
    reader = FeedReader(feed, "reader")
    reader.start()
    assert feed.waiting.wait(LONG_S)
    assert not reader.stop()
    reader.close()
    # Not let go while OpenCV is at work in it.
    assert not feed.released.is_set()
    feed.go_on.set()
    assert feed.released.wait(LONG_S)


def test_starting_again_discards_earlier_frames() -> None:
    feed = ScriptedFeed(3)
    feed.go_on.set()
    reader = FeedReader(feed, "reader")
    reader.start()
    assert feed.waiting.wait(LONG_S)
    assert reader.stop()
    assert reader.fault is not None
    feed.numbers = iter([7])
    feed.go_on.clear()
    reader.start()
    taken = reader.next(soon())
    assert taken is not None
    assert taken.number == 7
    feed.go_on.set()
    reader.close()


MS = 1_000_000
PERIOD_NS, EXPOSURE_NS, DELAY_NS = 20 * MS, 10 * MS, 30 * MS


def arrivals() -> ArrivalTiming:
    return ArrivalTiming(exposure_ns=EXPOSURE_NS, delay_ns=DELAY_NS, period_ns=PERIOD_NS)


def waited(asked_ms: float, returned_ms: float, slept_ms: float | None = None) -> GrabTimes:
    slept = returned_ms - asked_ms if slept_ms is None else slept_ms
    return GrabTimes(round(asked_ms * MS), round(returned_ms * MS), round(slept * MS))


def test_a_stamp_may_mark_either_end_of_the_exposure() -> None:
    exposed = exposure_from_stamp(1000 * MS, waited(900, 2000), exposure_ns=EXPOSURE_NS, period_ns=PERIOD_NS)
    # Of an end stamp: a read-out of one period before, and the exposure before that.
    assert exposed.earliest_ns == (1000 - 20 - 10) * MS
    # Of a start stamp: the last row ends a read-out later.
    assert exposed.latest_ns == (1000 + 20 + 10) * MS
    # What is in hand is over.
    soon = exposure_from_stamp(1000 * MS, waited(990, 1005), exposure_ns=EXPOSURE_NS, period_ns=PERIOD_NS)
    assert soon.latest_ns == 1005 * MS


def test_a_stamp_of_another_clock_is_detected() -> None:
    grabbed = waited(50_000, 50_010)
    assert is_monotonic_stamp(50_001 * MS, grabbed)
    assert not is_monotonic_stamp(1_700_000_000_000 * MS, grabbed)
    assert not is_monotonic_stamp(0, grabbed)


def test_queued_frames_may_be_as_old_as_the_last_wait() -> None:
    rule = arrivals()
    assert rule.exposure(waited(100, 118)) is not None
    # The reader was held up for half a second; what comes then has been lying there.
    for step in range(25):
        exposed = rule.exposure(waited(620 + step, 621 + step))
        assert exposed == ExposureInterval((100 - 30 - 10) * MS, (621 + step) * MS)
    assert rule.queued == 26
    # The queue is empty again once it waits again.
    fresh = rule.exposure(waited(650, 660))
    assert fresh is not None
    assert fresh.earliest_ns == (650 - 30 - 10) * MS


def test_the_exposure_is_unknown_before_the_first_wait() -> None:
    rule = arrivals()
    assert rule.exposure(waited(100, 101)) is None
    # Decoding, and waiting for a processor, are no waits for a frame.
    assert rule.exposure(waited(101, 140, slept_ms=0.5)) is None
    assert rule.exposure(waited(140, 155)) is not None


def test_time_asleep_excludes_time_on_the_processor() -> None:
    sleep = SleepMeter()
    before_ns, awake_ns = time.monotonic_ns(), sleep.awake_ns()
    threading.Event().wait(0.05)
    slept_ns = time.monotonic_ns() - before_ns - (sleep.awake_ns() - awake_ns)
    assert slept_ns > 40 * MS
    before_ns, awake_ns, worked = time.monotonic_ns(), sleep.awake_ns(), 0
    while time.monotonic_ns() - before_ns < 50 * MS:
        worked += 1
    slept_ns = time.monotonic_ns() - before_ns - (sleep.awake_ns() - awake_ns)
    assert slept_ns < 20 * MS
    sleep.close()
    sleep.close()
