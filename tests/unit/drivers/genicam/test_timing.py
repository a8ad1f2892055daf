"""When an exposure began: arithmetic on intervals, against truths that the tests make up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from drivers.genicam.timing import (
    DRIFT,
    Arrival,
    FrameNumbers,
    Interval,
    StartClock,
    TriggeredStarts,
    UntriggeredStarts,
)

MS = 1_000_000
EXPOSURE, ANSWER, TRANSFER = 10 * MS, 50 * MS, 20 * MS
ANYWHERE = Interval(0, EXPOSURE)
AT_START = Interval(0, 0)


@pytest.mark.parametrize(
    ("ids", "numbers"),
    [
        ([1, 2, 3], [0, 1, 2]),
        ([65400, 65401, 65535, 1, 2], [0, 1, 135, 136, 137]),
        ([65534, 2], [0, 3]),
        ([65535, 0, 1], [0, 1, 2]),
        ([5, 5, 6], [0, None, 1]),
        ([5, 4, 6], [0, None, 1]),
        ([1, 65530, 2], [0, None, 1]),
        ([0, 1, 2], [0, 1, 2]),
        ([65534, 65535, 65536, 65537], [0, 1, 2, 3]),
        ([1 << 40, (1 << 40) + 3, (1 << 40) + 1], [0, 3, None]),
    ],
)
def test_frame_ids_are_unwrapped(ids: list[int], numbers: list[int | None]) -> None:
    counter = FrameNumbers()
    assert [counter.next(block_id) for block_id in ids] == numbers
    assert counter.frame_count == 1 + max(number for number in numbers if number is not None)
    counter = FrameNumbers()
    assert [counter.next(1 + index % 65535) for index in range(70_000)] == list(range(70_000))


class Host:
    """Looks at a camera's clock that is `ahead_ns` before the host's and runs faster by `drift`."""

    def __init__(self, ahead_ns: int = 7_000_000_000_123, drift: float = 0.0) -> None:
        self.ahead_ns = ahead_ns
        self.drift = drift

    def stamp(self, now_ns: int) -> int:
        return now_ns + self.ahead_ns + round(self.drift * now_ns)

    def look(self, begun_ns: int, *, out_ns: int, back_ns: int) -> tuple[int, int, int]:
        return begun_ns, self.stamp(begun_ns + out_ns), begun_ns + out_ns + back_ns


def tied(host: Host, lag_ns: Interval = AT_START) -> StartClock:
    clock = StartClock(lag_ns)
    assert clock.latch([host.look(index * MS, out_ns=50_000, back_ns=50_000) for index in range(5)])
    return clock


def test_a_latched_clock_is_as_good_as_its_quickest_look() -> None:
    host = Host()
    clock = StartClock(AT_START)
    looks = [
        host.look(0, out_ns=3 * MS, back_ns=9 * MS),
        host.look(20 * MS, out_ns=100_000, back_ns=200_000),
        host.look(40 * MS, out_ns=8 * MS, back_ns=1 * MS),
    ]
    assert clock.latch(looks)
    assert clock.is_tied
    start = clock.start(host.stamp(30 * MS))
    assert start.min_ns <= 30 * MS <= start.max_ns
    assert start.max_ns - start.min_ns <= 300_000 + 4 * round(DRIFT * 20 * MS)


@pytest.mark.parametrize(
    "looks",
    [
        [(0, 0, 10), (100, 0, 110)],
        [(0, 5, 10), (100, 5, 110), (200, 5, 210)],
        # A clock in other units, which runs a thousand times slower.
        [(0, 0, 1 * MS), (100 * MS, 100_000, 101 * MS)],
        [(0, 5, 10)],
    ],
)
def test_a_clock_that_stands_is_not_used(looks: list[tuple[int, int, int]]) -> None:
    clock = StartClock(ANYWHERE)
    assert not clock.latch(looks)
    assert not clock.is_tied


@pytest.mark.parametrize("latched", [True, False])
@pytest.mark.parametrize("lag_ns", [None, 0, EXPOSURE // 3, EXPOSURE])
def test_starts_without_triggers_hold_the_truth(latched: bool, lag_ns: int | None) -> None:
    rng = np.random.default_rng(5)
    host = Host(drift=4e-5)
    clock = StartClock(ANYWHERE)
    if latched:
        assert clock.latch([host.look(index * MS, out_ns=90_000, back_ns=40_000) for index in range(5)])
    starts = UntriggeredStarts(EXPOSURE, TRANSFER, clock)
    for number in range(500):
        truth_ns = (number + 1) * 33 * MS
        late_ns = int(rng.integers(MS, TRANSFER))
        stamp_ns = None if lag_ns is None else host.stamp(truth_ns + lag_ns)
        start = starts.start(Arrival(number, stamp_ns, truth_ns + EXPOSURE + late_ns))
        assert start is not None
        assert start.min_ns <= truth_ns <= start.max_ns
        # A latched clock needs no trust in the network.
        assert start.max_ns - start.min_ns <= (EXPOSURE + 5 * MS if latched and lag_ns is not None else TRANSFER)


def test_a_frame_that_lay_in_the_camera_is_dated_by_the_clock_and_no_stamp_is_later_than_its_arrival() -> None:
    host = Host()
    starts = UntriggeredStarts(EXPOSURE, TRANSFER, tied(host))
    start = starts.start(Arrival(0, host.stamp(100 * MS), 100 * MS + EXPOSURE + 900 * MS))
    assert start is not None
    assert start.min_ns <= 100 * MS <= start.max_ns < 101 * MS
    assert starts.start(Arrival(1, host.stamp(500 * MS), 400 * MS)) is None


@dataclass(frozen=True)
class Came:
    """A frame: its number, when it came (ms), and when its exposure can have begun (ms); None if it answers nothing."""

    number: int
    at: int
    began: tuple[int, int] | None


@pytest.mark.parametrize(
    "steps",
    [
        # A number is a trigger at that time, in ms; a frame that answers it comes later.
        pytest.param([100, Came(0, 115, (100, 105))], id="a frame answers its trigger"),
        pytest.param([Came(0, 115, None)], id="nothing asked for it"),
        pytest.param([100, Came(0, 115, (100, 105)), Came(1, 117, None)], id="a second frame of one trigger"),
        pytest.param([100, Came(0, 105, None)], id="its exposure would have begun before the trigger"),
        pytest.param([100, Came(0, 400, None)], id="much longer ago than an answer takes"),
        pytest.param([100, Came(0, 115, (100, 105)), 120, 130, Came(2, 145, (130, 135))], id="number 1 never came"),
        pytest.param([100, 110, Came(0, 125, (100, 115))], id="of several triggers the earliest"),
        pytest.param([100, 400, Came(0, 415, (400, 405))], id="a trigger that was ignored is given up"),
        # It may be the answer to the first, very late; then that to the second has to come, which it does not.
        pytest.param(
            [100, 200, Came(0, 215, (100, 205)), 300, Came(1, 315, (300, 305))],
            id="an ignored trigger makes the next frame doubtful and no other",
        ),
        # The first exposure began very late, after the second trigger; the second one followed at once.
        pytest.param(
            [100, 200, Came(0, 215, (100, 205)), Came(1, 226, (200, 216))],
            id="the answer to a trigger does not pass for that to the next",
        ),
    ],
)
def test_a_frame_answers_a_trigger_that_it_can_be_of(steps: list[int | Came]) -> None:
    starts = TriggeredStarts(EXPOSURE, ANSWER, StartClock(ANYWHERE))
    for step in steps:
        if isinstance(step, int):
            starts.note_trigger(step * MS, (step + 1) * MS)
        else:
            began = None if step.began is None else Interval(step.began[0] * MS, step.began[1] * MS)
            assert starts.start(Arrival(step.number, None, step.at * MS)) == began


def test_an_answer_is_owed_until_it_came_or_is_given_up() -> None:
    starts = TriggeredStarts(EXPOSURE, ANSWER, StartClock(ANYWHERE))
    for begun in (100, 200):
        starts.note_trigger(begun * MS, (begun + 1) * MS)
    assert starts.start(Arrival(0, None, 215 * MS)) is not None
    assert starts.answer_due_ns(216 * MS) > 0
    assert starts.start(Arrival(1, None, 226 * MS)) is not None
    assert starts.answer_due_ns(227 * MS) <= 0
    starts.note_trigger(400 * MS, 401 * MS)
    assert starts.answer_due_ns(430 * MS) > 0
    assert starts.answer_due_ns(600 * MS) <= 0


def test_a_trigger_that_may_have_been_sent_twice_is_two() -> None:
    starts = TriggeredStarts(EXPOSURE, ANSWER, StartClock(ANYWHERE))
    starts.note_trigger(100 * MS, 106 * MS, times=2)
    assert starts.start(Arrival(0, None, 117 * MS)) is not None
    starts.note_trigger(120 * MS, 121 * MS)
    # The second frame of the first trigger, or that of the second one: it may be as old as the first.
    start = starts.start(Arrival(1, None, 135 * MS))
    assert start is not None
    assert start.min_ns == 100 * MS


def test_the_clock_separates_a_very_late_frame_from_that_of_the_next_trigger() -> None:
    host = Host()
    starts = TriggeredStarts(EXPOSURE, ANSWER, StartClock(ANYWHERE))
    for number in range(3):
        begun_ns = 100 * number * MS
        starts.note_trigger(begun_ns, begun_ns + MS)
        arrival = Arrival(number, host.stamp(begun_ns + MS), begun_ns + 12 * MS)
        assert starts.start(arrival) is not None
    starts.note_trigger(300 * MS, 301 * MS)
    starts.note_trigger(400 * MS, 401 * MS)
    # The frame of the trigger at 300 ms, which lay somewhere for 120 ms.
    late = starts.start(Arrival(3, host.stamp(301 * MS), 431 * MS))
    assert late is not None
    assert late.min_ns <= 301 * MS <= late.max_ns < 400 * MS
    starts.note_trigger(500 * MS, 501 * MS)
    start = starts.start(Arrival(5, host.stamp(501 * MS), 512 * MS))
    assert start is not None
    assert start.min_ns >= 500 * MS


def test_triggered_starts_hold_the_truth_and_are_never_too_early() -> None:
    """A camera that ignores, loses and delays: whatever is said of a frame's start is so."""
    rng = np.random.default_rng(11)
    host = Host(drift=-3e-5)
    starts = TriggeredStarts(EXPOSURE, ANSWER, StartClock(ANYWHERE))
    now_ns, made, said = 0, 0, 0
    for _ in range(3000):
        now_ns += int(rng.integers(MS, 30 * MS))
        starts.note_trigger(now_ns, now_ns + MS)
        if rng.random() < 0.05:
            now_ns += EXPOSURE + ANSWER
            continue
        truth_ns = now_ns + int(rng.integers(0, 3 * MS))
        arrived_ns = truth_ns + EXPOSURE + int(rng.integers(0, 30 * MS))
        now_ns = arrived_ns
        number, made = made, made + 1
        if rng.random() < 0.1:
            now_ns += ANSWER
            continue
        start = starts.start(Arrival(number, host.stamp(truth_ns + EXPOSURE // 2), arrived_ns))
        if start is not None:
            said += 1
            assert start.min_ns <= truth_ns <= start.max_ns
    assert said > 0.95 * 0.85 * 3000
