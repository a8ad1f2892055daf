"""When a frame was exposed, whatever its stamp means, and which frames were lost or repeated."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.v4l2.stream import (
    BufferStamp,
    ExposureInterval,
    FilledBuffer,
    FrameCounter,
    SensorDurations,
    StampSource,
    exposure_interval,
    is_monotonic_stamp,
)

MS = 1_000_000


@pytest.mark.parametrize("meant", ["start", "first packet", "end", "none"])
def test_the_interval_contains_the_exposure_for_any_meaning_of_the_stamp(meant: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(2000):
        period, exposure_ns = sorted(rng.integers(1, 40 * MS, 2), reverse=True)
        # From first to last row; the last row's bytes arrive when it has been exposed, or later.
        skew_ns = int(rng.integers(0, period))
        start_ns = 10**12 + int(rng.integers(0, 10**9))
        end_ns = start_ns + int(exposure_ns) + skew_ns
        arrived_ns = end_ns + int(rng.integers(0, period - skew_ns + 1))
        late_ns = int(rng.integers(0, 5 * MS))
        stamp_ns, source = {
            "start": (start_ns, StampSource.EXPOSURE_START),
            "first packet": (start_ns + int(exposure_ns), StampSource.EXPOSURE_START),
            "end": (arrived_ns, StampSource.FRAME_END),
            "none": (0, StampSource.NONE),
        }[meant]
        queued_ns = start_ns + int(exposure_ns) - int(rng.integers(0, 100 * MS))
        dequeued_ns = arrived_ns + late_ns
        durations = SensorDurations(int(exposure_ns), int(period))
        claim = exposure_interval(BufferStamp(source, stamp_ns, queued_ns, dequeued_ns), durations)
        assert claim.earliest_ns <= start_ns
        assert claim.latest_ns >= end_ns
        begin_ns, finish_ns, error_ns = claim.centred_exposure(int(exposure_ns))
        assert finish_ns - begin_ns == exposure_ns
        assert begin_ns - error_ns >= claim.earliest_ns - 1
        assert begin_ns - error_ns <= claim.earliest_ns
        assert finish_ns + error_ns >= claim.latest_ns


def test_a_late_stamp_widens_the_interval() -> None:
    stamp = BufferStamp(StampSource.EXPOSURE_START, 10**12, 10**12 - 80 * MS, 10**12 + 30 * MS)
    prompt = exposure_interval(stamp, SensorDurations(10 * MS, 20 * MS))
    late = exposure_interval(stamp, SensorDurations(10 * MS, 20 * MS, 7 * MS))
    assert prompt == ExposureInterval(10**12 - 10 * MS, 10**12 + 30 * MS)
    assert late.earliest_ns == prompt.earliest_ns - 7 * MS


@pytest.mark.parametrize("offset_ns", [1_700_000_000 * 10**9, -(10**12), 2 * 10**9])
def test_a_stamp_of_another_clock_is_ignored(offset_ns: int) -> None:
    now_ns = 2 * 10**12
    stamp = BufferStamp(StampSource.EXPOSURE_START, now_ns + offset_ns, now_ns - 100 * MS, now_ns)
    durations = SensorDurations(10 * MS, 20 * MS)
    assert not is_monotonic_stamp(stamp, durations)
    assert exposure_interval(stamp, durations) == ExposureInterval(now_ns - 130 * MS, now_ns)


# ---- frames lost, repeated, and made while nobody read

PERIOD_NS = 10_000_000


def frame(
    sequence: int, *, at: float | None = None, queued: float = -100, source: StampSource | None = None
) -> FilledBuffer:
    """A frame stamped `at` periods, in a buffer queued at `queued` periods."""
    stamp_ns = round((sequence if at is None else at) * PERIOD_NS)
    stamp = BufferStamp(source or StampSource.EXPOSURE_START, stamp_ns, round(queued * PERIOD_NS), stamp_ns + PERIOD_NS)
    return FilledBuffer(0, 100, corrupt=False, sequence=sequence, stamp=stamp)


def test_a_repeated_frame_is_refused_and_counted() -> None:
    tally = FrameCounter()
    assert tally.is_new(frame(5))
    assert not tally.is_new(frame(5))
    assert not tally.is_new(frame(6, at=4.5))
    assert tally.is_new(frame(6))
    assert tally.lost == 2
    bare = FrameCounter()
    assert bare.is_new(frame(5, source=StampSource.NONE))
    assert not bare.is_new(frame(5, source=StampSource.NONE))
    assert bare.is_new(frame(6, source=StampSource.NONE))
    assert bare.period_ns() is None


def test_a_counter_that_wraps_stands_still_or_starts_again_is_no_loss() -> None:
    tally = FrameCounter()
    assert tally.is_new(frame(2**32 - 1, at=1))
    assert tally.is_new(frame(1, at=3))
    assert (tally.number, tally.lost) == (2, 1)
    still = FrameCounter()
    assert all(still.is_new(frame(0, at=at)) for at in (1, 2, 3))
    assert still.is_new(frame(2**31 + 5, at=4))
    assert (still.number, still.lost) == (3, 0)


def test_numbers_go_on_from_stream_to_stream() -> None:
    tally = FrameCounter()
    assert tally.is_new(frame(0, at=1))
    assert tally.is_new(frame(3, at=4))
    tally.begin()
    tally.forget_losses()
    assert tally.is_new(frame(0, at=0.5))
    assert (tally.number, tally.lost) == (4, 0)
    tally.note_corrupt()
    assert tally.lost == 1


def test_stamps_after_arrival_give_the_delay_of_stamps() -> None:
    tally = FrameCounter()
    early = BufferStamp(StampSource.FRAME_END, 50 * PERIOD_NS, 0, 49 * PERIOD_NS)
    wall = BufferStamp(StampSource.FRAME_END, 10**18, 0, 52 * PERIOD_NS)
    assert tally.is_new(FilledBuffer(0, 100, corrupt=False, sequence=1, stamp=early))
    assert tally.is_new(FilledBuffer(0, 100, corrupt=False, sequence=2, stamp=wall))
    assert tally.ahead_ns == PERIOD_NS
