"""Cameras that run by themselves: what is foretold of their next frame, and of a pattern's light, and their readers."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from slrig.bundle.sidecars import RefusedFrame
from slrig.capture.sequencer import capture
from slrig.capture.streaming import Cadence, FrameReader, _DisplayLead
from slrig.devices import Synchronisation, SystemClock, Trigger
from slrig.errors import DeviceGoneError, DeviceStateError, FrameTimeoutError
from slrig.model import Frame
from tests.contract.live_devices import Webcam
from tests.contract.test_streaming import SEQUENCE, live
from tests.unit.capture.fake_rig import CameraFaults, fake_rig

PERIOD_NS = 33_333_333


def frame(number: int, start_ns: int) -> Frame:
    return Frame("eye", np.zeros((1, 1), np.uint8), start_ns, start_ns + 10_000_000, 0, number, 0, 0.01, 1.0)


def after(numbers: list[int], t_ns: int, *, jitter_ns: float = 0.0) -> tuple[int, int] | None:
    rng = np.random.default_rng(4)
    cadence = Cadence()
    for number in numbers:
        cadence.add(frame(number, 10**12 + number * PERIOD_NS + round(jitter_ns * float(rng.standard_normal()))))
    return cadence.start_after(10**12 + t_ns)


@pytest.mark.parametrize(
    ("numbers", "after_periods", "foretold_period"),
    [
        (list(range(10)), 20, 20),
        # Lost frames do not mislead it.
        ([0, 1, 4, 5, 9, 10, 17], 20, 20),
        # Frames that are past are not foretold.
        (list(range(10)), 2, 10),
    ],
)
def test_the_first_frame_after_an_instant_is_predicted(
    numbers: list[int], after_periods: int, foretold_period: int
) -> None:
    foretold = after(numbers, after_periods * PERIOD_NS - 1_000)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + foretold_period * PERIOD_NS)) < 100
    assert foretold[1] < 100 or foretold_period < 20


def test_a_frame_that_may_begin_too_early_is_not_counted_on() -> None:
    numbers = list(range(24))
    foretold = after(numbers, 30 * PERIOD_NS, jitter_ns=1e6)
    assert foretold is not None
    start_ns, spare_ns = foretold
    assert 1_000_000 < spare_ns < 4_000_000
    assert abs(start_ns - (10**12 + 31 * PERIOD_NS)) < 2_000_000


def test_nothing_is_predicted_from_too_few_or_too_uneven_frames() -> None:
    assert after([0, 1], 0) is None
    assert after(list(range(24)), 0, jitter_ns=PERIOD_NS) is None


def test_a_restarted_count_restarts_the_prediction() -> None:
    cadence = Cadence()
    for number in range(5):
        cadence.add(frame(number, number * PERIOD_NS))
    cadence.add(frame(0, 10**12))
    assert cadence.start_after(0) is None


def test_one_frame_is_enough_where_a_camera_states_its_period() -> None:
    cadence = Cadence(PERIOD_NS / 1e9)
    assert cadence.start_after(0) is None
    cadence.add(frame(0, 10**12))
    foretold = cadence.start_after(10**12 + 2 * PERIOD_NS)
    assert foretold is not None
    start_ns, spare_ns = foretold
    assert abs(start_ns - (10**12 + 3 * PERIOD_NS)) < 100  # the second may begin too early
    assert abs(spare_ns - PERIOD_NS / 10) < 100


def test_a_period_that_is_stated_wrongly_is_corrected_by_the_frames() -> None:
    cadence = Cadence(PERIOD_NS / 2e9)
    for number in range(3):
        cadence.add(frame(number, 10**12 + number * PERIOD_NS))
    foretold = cadence.start_after(10**12 + 20 * PERIOD_NS - 1_000)
    assert foretold is not None
    assert abs(foretold[0] - (10**12 + 20 * PERIOD_NS)) < 100


FREE = frozenset({Trigger.FREE})
PATIENCE_S = 10.0


def reading(**faults: object) -> FrameReader:
    fake = fake_rig(
        cameras=["eye"],
        triggers={"eye": FREE},
        faults={"eye": CameraFaults(**faults)},  # type: ignore[arg-type]
    )
    reader = FrameReader({"top": fake.cameras["eye"]}, SystemClock())
    reader.start(10)
    return reader


def test_every_frame_comes_in_order_and_reading_ends() -> None:
    reader = reading()
    came = [reader.next(PATIENCE_S) for _ in range(6)]
    assert came[0] == ("top", None)
    numbers = []
    for arrival in came[1:]:
        assert arrival is not None
        name, frame = arrival
        assert name == "top"
        assert isinstance(frame, Frame)
        numbers.append(frame.sequence_number)
    assert numbers == [0, 1, 2, 3, 4]
    reader.stop()
    reader.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "slrig-frames of top"]


def test_an_exception_of_a_driver_is_passed_on() -> None:
    reader = reading(unplug_at=1)
    came = [arrival for arrival in (reader.next(PATIENCE_S) for _ in range(4)) if arrival is not None]
    reader.stop()
    assert isinstance(came[1][1], Frame)
    assert isinstance(came[-1][1], DeviceGoneError)


def test_no_camera_gives_no_frames() -> None:
    assert FrameReader({}, SystemClock()).next(0.0) is None


def test_nothing_is_lit_before_a_camera_that_does_not_start() -> None:
    one = live(Webcam())
    rig = replace(one.rig, synchronisation=Synchronisation(0.0, 0.0, earliest_s=0.0))
    rig.cameras["eye"].close()
    with pytest.raises(DeviceStateError, match="closed"):
        list(capture(rig, SEQUENCE))
    assert {profile.max() for _, profile in one.stage.changes} == {0}


def test_a_camera_that_goes_ends_the_capture_and_its_thread() -> None:
    one = live(Webcam())
    rig = replace(one.rig, synchronisation=Synchronisation(0.0, 0.0, earliest_s=0.0))
    frames = capture(rig, SEQUENCE)
    next(frames)
    rig.cameras["eye"].close()
    with pytest.raises(Exception, match="closed"):
        list(frames)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("slrig-frames")]


def test_a_frame_that_never_comes_is_waited_for_in_three_showings() -> None:
    rig = replace(live(Webcam(lost=1.0)).rig, synchronisation=Synchronisation(0.0, 0.0, earliest_s=0.0))
    refused: list[RefusedFrame] = []
    with pytest.raises(FrameTimeoutError, match="failed 3 times"):
        list(capture(rig, SEQUENCE, timeout_s=0.1, refused=refused.append))
    assert [each.attempt for each in refused] == [1, 2, 3]


REFRESH_NS = 16_666_667
DELAY_NS = 46_800_000
"""From the refresh that takes a picture to its light."""


def test_one_pattern_measures_the_lead_at_any_phase_of_the_refresh() -> None:
    for asked_ns in np.linspace(0, REFRESH_NS, 7).astype(int).tolist():
        lead = _DisplayLead(REFRESH_NS)
        assert lead.ns == 0
        lead.add(asked_ns, REFRESH_NS, REFRESH_NS + DELAY_NS)
        assert lead.ns == DELAY_NS


def test_a_thread_that_wakes_late_makes_the_lead_shorter_until_one_wakes_in_time() -> None:
    lead = _DisplayLead(REFRESH_NS)
    lead.add(10_000_000, REFRESH_NS + 4_000_000, REFRESH_NS + DELAY_NS)
    assert lead.ns == DELAY_NS - 4_000_000
    lead.add(12_000_000, REFRESH_NS + 100_000, REFRESH_NS + DELAY_NS)
    assert lead.ns == DELAY_NS - 100_000
    # As late as several refreshes: no more than one of them was waited for.
    late = _DisplayLead(REFRESH_NS)
    late.add(0, 5 * REFRESH_NS, REFRESH_NS + DELAY_NS)
    assert late.ns == DELAY_NS


def test_a_projector_without_refreshes_is_asked_by_the_shortest_lead_it_had() -> None:
    lead = _DisplayLead(0)
    for asked_ns, begins_ns in ((0, 9_000_000), (0, 5_000_000), (0, 7_000_000)):
        lead.add(asked_ns, begins_ns - 1, begins_ns)
    assert lead.ns == 5_000_000
    lead.add(3_000_000, 3_500_000, 2_000_000)  # its light may be there before it returns
    assert lead.ns == 0
