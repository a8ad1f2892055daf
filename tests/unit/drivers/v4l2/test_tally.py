"""Frames lost, repeated, and made while nobody read."""

from __future__ import annotations

from drivers.v4l2.stream import Taken
from drivers.v4l2.tally import Tally
from drivers.v4l2.timing import Stamp, StampSource

PERIOD_NS = 10_000_000


def frame(sequence: int, *, at: float | None = None, queued: float = -100, source: StampSource | None = None) -> Taken:
    """A frame stamped `at` periods, in a buffer queued at `queued` periods."""
    stamp_ns = round((sequence if at is None else at) * PERIOD_NS)
    stamp = Stamp(source or StampSource.EXPOSURE_START, stamp_ns, round(queued * PERIOD_NS), stamp_ns + PERIOD_NS)
    return Taken(0, 100, corrupt=False, sequence=sequence, stamp=stamp)


def test_frames_that_did_not_come_are_lost() -> None:
    tally = Tally()
    assert all(tally.is_new(frame(number)) for number in (5, 6, 9, 10))
    assert tally.lost == 2
    assert tally.number == 5
    assert tally.period_ns() == PERIOD_NS


def test_frames_that_were_made_while_no_buffer_was_free_are_not_lost() -> None:
    tally = Tally()
    assert tally.is_new(frame(5))
    assert tally.is_new(frame(90, queued=88.5))
    assert tally.lost == 0
    assert tally.number == 85


def test_a_repeated_frame_is_refused_and_counted() -> None:
    tally = Tally()
    assert tally.is_new(frame(5))
    assert not tally.is_new(frame(5))
    assert not tally.is_new(frame(6, at=4.5))
    assert tally.is_new(frame(6))
    assert tally.lost == 2
    bare = Tally()
    assert bare.is_new(frame(5, source=StampSource.NONE))
    assert not bare.is_new(frame(5, source=StampSource.NONE))
    assert bare.is_new(frame(6, source=StampSource.NONE))
    assert bare.period_ns() is None


def test_a_counter_that_wraps_stands_still_or_starts_anew_is_no_loss() -> None:
    tally = Tally()
    assert tally.is_new(frame(2**32 - 1, at=1))
    assert tally.is_new(frame(1, at=3))
    assert (tally.number, tally.lost) == (2, 1)
    still = Tally()
    assert all(still.is_new(frame(0, at=at)) for at in (1, 2, 3))
    assert still.is_new(frame(2**31 + 5, at=4))
    assert (still.number, still.lost) == (3, 0)


def test_numbers_go_on_from_stream_to_stream() -> None:
    tally = Tally()
    assert tally.is_new(frame(0, at=1))
    assert tally.is_new(frame(3, at=4))
    tally.begin()
    tally.forget_losses()
    assert tally.is_new(frame(0, at=0.5))
    assert (tally.number, tally.lost) == (4, 0)
    tally.note_corrupt()
    assert tally.lost == 1


def test_stamps_from_the_future_tell_how_late_they_are() -> None:
    tally = Tally()
    early = Stamp(StampSource.FRAME_END, 50 * PERIOD_NS, 0, 49 * PERIOD_NS)
    wall = Stamp(StampSource.FRAME_END, 10**18, 0, 52 * PERIOD_NS)
    assert tally.is_new(Taken(0, 100, corrupt=False, sequence=1, stamp=early))
    assert tally.is_new(Taken(0, 100, corrupt=False, sequence=2, stamp=wall))
    assert tally.ahead_ns == PERIOD_NS
