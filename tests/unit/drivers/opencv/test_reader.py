"""The thread that reads all the time: what it keeps, how it ends, and what becomes of one that does not."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.opencv.feeds import Taken
from drivers.opencv.reader import Reader
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

    def take(self, stop: threading.Event) -> Taken | None:
        # As OpenCV does, it takes no notice of who wants it to stop.
        del stop
        number = next(self.numbers, None)
        if number is not None:
            return Taken(np.zeros((1, 1), np.uint8), None, number)
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
    reader = Reader(feed, "reader")
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


def test_a_source_that_does_not_return_is_left_to_its_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.opencv.reader._JOIN_S", 0.01)
    feed = ScriptedFeed(1)
    reader = Reader(feed, "reader")
    reader.start()
    assert feed.waiting.wait(LONG_S)
    assert not reader.stop()
    reader.close()
    # Not let go while OpenCV is at work in it.
    assert not feed.released.is_set()
    feed.go_on.set()
    assert feed.released.wait(LONG_S)


def test_starting_again_forgets_what_was_before() -> None:
    feed = ScriptedFeed(3)
    feed.go_on.set()
    reader = Reader(feed, "reader")
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
