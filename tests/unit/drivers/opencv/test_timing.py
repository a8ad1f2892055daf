"""Rules by which a frame's exposure is bounded: nothing that may be older counts as fresh."""

from __future__ import annotations

import threading
import time

from drivers.opencv.timing import Arrivals, Grabbed, Sleep, by_stamp, is_of_this_clock
from drivers.v4l2.timing import Exposure

MS = 1_000_000
PERIOD_NS, EXPOSURE_NS, DELAY_NS = 20 * MS, 10 * MS, 30 * MS


def arrivals() -> Arrivals:
    return Arrivals(exposure_ns=EXPOSURE_NS, delay_ns=DELAY_NS, period_ns=PERIOD_NS)


def waited(asked_ms: float, returned_ms: float, slept_ms: float | None = None) -> Grabbed:
    slept = returned_ms - asked_ms if slept_ms is None else slept_ms
    return Grabbed(round(asked_ms * MS), round(returned_ms * MS), round(slept * MS))


def test_a_stamp_may_name_either_end_of_the_exposure() -> None:
    exposed = by_stamp(1000 * MS, waited(900, 2000), exposure_ns=EXPOSURE_NS, period_ns=PERIOD_NS)
    # Of an end stamp: a read-out of one period before, and the exposure before that.
    assert exposed.earliest_ns == (1000 - 20 - 10) * MS
    # Of a start stamp: the last row ends a read-out later.
    assert exposed.latest_ns == (1000 + 20 + 10) * MS
    # What is in hand is over.
    soon = by_stamp(1000 * MS, waited(990, 1005), exposure_ns=EXPOSURE_NS, period_ns=PERIOD_NS)
    assert soon.latest_ns == 1005 * MS


def test_a_stamp_of_another_clock_gives_itself_away() -> None:
    grabbed = waited(50_000, 50_010)
    assert is_of_this_clock(50_001 * MS, grabbed)
    assert not is_of_this_clock(1_700_000_000_000 * MS, grabbed)
    assert not is_of_this_clock(0, grabbed)


def test_a_frame_that_was_waited_for_arrived_after_the_wait_began() -> None:
    exposed = arrivals().exposed(waited(100, 118))
    assert exposed == Exposure((100 - 30 - 10) * MS, 118 * MS)


def test_frames_that_came_without_a_wait_are_as_old_as_the_last_wait() -> None:
    rule = arrivals()
    assert rule.exposed(waited(100, 118)) is not None
    # The reader was held up for half a second; what comes then has been lying there.
    for step in range(25):
        exposed = rule.exposed(waited(620 + step, 621 + step))
        assert exposed is not None
        assert exposed.earliest_ns == (100 - 30 - 10) * MS
    assert rule.queued == 26
    # The queue is empty again once it waits again.
    fresh = rule.exposed(waited(650, 660))
    assert fresh is not None
    assert fresh.earliest_ns == (650 - 30 - 10) * MS


def test_nothing_is_known_of_a_frame_before_the_first_wait() -> None:
    rule = arrivals()
    assert rule.exposed(waited(100, 101)) is None
    # Decoding, and waiting for a processor, are no waits for a frame.
    assert rule.exposed(waited(101, 140, slept_ms=0.5)) is None
    assert rule.exposed(waited(140, 155)) is not None


def test_time_asleep_is_measured_without_time_at_work() -> None:
    sleep = Sleep()
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
