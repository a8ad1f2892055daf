"""What is foretold of a free-running camera's next frame."""

from __future__ import annotations

import numpy as np

from slrig.capture.cadence import Cadence
from slrig.model import Frame

PERIOD_NS = 33_333_333


def frame(number: int, start_ns: int) -> Frame:
    return Frame("eye", np.zeros((1, 1), np.uint8), start_ns, start_ns + 10_000_000, 0, number, 0, 0.01, 1.0)


def after(numbers: list[int], t_ns: int, *, jitter_ns: float = 0.0) -> tuple[int, int] | None:
    rng = np.random.default_rng(4)
    cadence = Cadence()
    for number in numbers:
        cadence.note(frame(number, 10**12 + number * PERIOD_NS + round(jitter_ns * float(rng.standard_normal()))))
    return cadence.start_after(10**12 + t_ns)


def test_the_first_frame_after_an_instant_is_foretold() -> None:
    foretold = after(list(range(10)), 20 * PERIOD_NS - 1_000)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + 20 * PERIOD_NS)) < 100
    assert foretold[1] < 100


def test_lost_frames_do_not_mislead_it() -> None:
    foretold = after([0, 1, 4, 5, 9, 10, 17], 20 * PERIOD_NS - 1_000)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + 20 * PERIOD_NS)) < 100


def test_a_frame_that_may_begin_too_early_is_not_counted_on() -> None:
    numbers = list(range(24))
    foretold = after(numbers, 30 * PERIOD_NS, jitter_ns=1e6)
    assert foretold is not None
    start_ns, spare_ns = foretold
    assert 1_000_000 < spare_ns < 4_000_000
    assert abs(start_ns - (10**12 + 31 * PERIOD_NS)) < 2_000_000


def test_frames_that_are_past_are_not_foretold() -> None:
    foretold = after(list(range(10)), 2 * PERIOD_NS)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + 10 * PERIOD_NS)) < 100


def test_nothing_is_foretold_of_too_few_or_too_uneven_frames() -> None:
    assert after([0, 1], 0) is None
    assert after(list(range(24)), 0, jitter_ns=PERIOD_NS) is None


def test_a_camera_that_counts_anew_is_learnt_anew() -> None:
    cadence = Cadence()
    for number in range(5):
        cadence.note(frame(number, number * PERIOD_NS))
    cadence.note(frame(0, 10**12))
    assert cadence.start_after(0) is None


def test_one_frame_is_enough_where_a_camera_states_its_period() -> None:
    cadence = Cadence(PERIOD_NS / 1e9)
    assert cadence.start_after(0) is None
    cadence.note(frame(0, 10**12))
    foretold = cadence.start_after(10**12 + 2 * PERIOD_NS)
    assert foretold is not None
    start_ns, spare_ns = foretold
    assert abs(start_ns - (10**12 + 3 * PERIOD_NS)) < 100  # the second may begin too early
    assert abs(spare_ns - PERIOD_NS / 10) < 100


def test_a_period_that_is_stated_wrongly_is_corrected_by_the_frames() -> None:
    cadence = Cadence(PERIOD_NS / 2e9)
    for number in range(3):
        cadence.note(frame(number, 10**12 + number * PERIOD_NS))
    foretold = cadence.start_after(10**12 + 20 * PERIOD_NS - 1_000)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + 20 * PERIOD_NS)) < 100
