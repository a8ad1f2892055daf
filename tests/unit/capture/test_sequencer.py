"""The sequencer on a rig in memory: what it delivers, what it refuses, and that it always leaves the rig dark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from slrig.capture.evidence import Evidence
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Trigger
from slrig.errors import (
    DeviceGoneError,
    ScanCancelledError,
    ScanEvidenceError,
    UnsupportedByDeviceError,
)
from slrig.model import Shot, Size
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import PROJECTOR, CameraFaults, FakeRig, fake_rig, patterns_for

PATTERNS = patterns_for()
SEQUENCE = encode(PATTERNS, PROJECTOR)
COUNT = len(SEQUENCE)
FREE = frozenset({Trigger.FREE})
HARDWARE = frozenset({Trigger.HARDWARE})
EVERY = frozenset(Trigger)


def run(fake: FakeRig, *, cancelled: Callable[[], bool] = lambda: False) -> list[Shot]:
    return list(capture(fake.rig, SEQUENCE, cancelled=cancelled))


def faulty(**faults: object) -> FakeRig:
    return fake_rig(faults={"right": CameraFaults(**faults)})  # type: ignore[arg-type]


def assert_refused(fake: FakeRig, kind: type[BaseException], words: str) -> None:
    with pytest.raises(kind, match=words):
        run(fake)
    assert fake.at_rest


# ---- a sound rig


def test_every_camera_gives_every_pattern_in_order() -> None:
    fake = fake_rig()
    shots = run(fake)
    assert [(shot.pattern, shot.camera) for shot in shots] == [(i, c) for i in range(COUNT) for c in ("left", "right")]
    assert fake.at_rest


def test_times_count_from_the_first_frame_and_rise() -> None:
    times = [shot.time_s for shot in run(fake_rig(cameras=["left"]))]
    assert times[0] == 0.0
    assert all(b > a for a, b in pairwise(times) if a is not None and b is not None)
    assert all(shot.exposure_s == 0.01 for shot in run(fake_rig(cameras=["left"])))


def test_nothing_moves_before_the_first_frame_is_asked_for() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SEQUENCE)
    assert fake.world.calls == []
    next(iter(frames))
    assert "show 0" in fake.world.calls
    # The second pattern is exposed while the first one's frames are judged.
    assert "show 2" not in fake.world.calls


def test_the_evidence_given_tells_afterwards_what_was_proven() -> None:
    fake = fake_rig()
    evidence = Evidence(PATTERNS, {name: camera.info.format for name, camera in fake.cameras.items()})
    list(capture(fake.rig, SEQUENCE, evidence=evidence))
    summary = evidence.summary()
    assert (summary.verified, summary.patterns, summary.faults) == (COUNT, COUNT, ())


def test_frames_carry_the_name_that_the_rig_gives_the_camera() -> None:
    fake = fake_rig(cameras=["left"])
    renamed = replace(fake.rig, cameras={"top": fake.cameras["left"]}, settings={"top": CameraSettings(0.01)})
    assert {shot.camera for shot in capture(renamed, SEQUENCE)} == {"top"}


# ---- triggers


@pytest.mark.parametrize(
    ("plays", "left", "right", "armed"),
    [
        (False, EVERY, EVERY, ["software", "software"]),
        (True, EVERY, EVERY, ["hardware", "hardware"]),
        (True, EVERY, frozenset({Trigger.SOFTWARE, Trigger.FREE}), ["software", "software"]),
        (False, FREE, EVERY, ["free", "software"]),
        (True, FREE, EVERY, ["free", "software"]),
    ],
)
def test_the_best_trigger_that_all_can_do_is_used(
    plays: bool, left: frozenset[Trigger], right: frozenset[Trigger], armed: list[str]
) -> None:
    fake = fake_rig(projector={"plays": plays}, triggers={"left": left, "right": right})
    shots = run(fake)
    assert len(shots) == 2 * COUNT
    calls = [call for call in fake.world.calls if call.startswith("arm")]
    assert calls == [f"arm left {armed[0]}", f"arm right {armed[1]}"]
    assert ("play" in fake.world.calls) == (armed[0] == "hardware")
    assert fake.at_rest


def test_a_camera_for_wires_only_needs_a_projector_that_plays() -> None:
    assert_refused(fake_rig(triggers={"right": HARDWARE}), UnsupportedByDeviceError, "camera 'right' can be trig.*wire")


def test_a_rig_without_cameras_is_refused() -> None:
    assert_refused(fake_rig(cameras=[]), UnsupportedByDeviceError, "has no camera")


# ---- settings


def test_a_read_back_that_differs_is_refused_with_both_numbers() -> None:
    assert_refused(
        faulty(readback=1.02), UnsupportedByDeviceError, r"'right': asked for exposure 0.01 s, it uses 0.0102"
    )


def test_a_read_back_within_one_percent_passes() -> None:
    assert len(run(faulty(readback=1.008))) == 2 * COUNT


def test_a_sequence_for_another_projector_is_refused() -> None:
    fake = fake_rig()
    with pytest.raises(UnsupportedByDeviceError, match="64 x 48"):
        list(capture(fake.rig, encode(patterns_for(Size(64, 48)), Size(64, 48))))
    assert fake.at_rest


# ---- faults


@pytest.mark.parametrize(
    ("projector", "words"),
    [
        ({"lamp_off": True}, "lamp"),
        ({"inverted": True}, "white is darker than black.*inverted"),
        ({"swaps": {4: 5, 5: 4}}, "exchanged with its inverse"),
        ({"swaps": {5: 4}}, "the frame and its inverse show the same"),
        ({"swaps": {13: 16, 16: 13}}, "lines are not where|out of order"),
        ({"swaps": {0: 1, 1: 0}}, "white is darker than black"),
    ],
)
def test_a_projector_that_shows_something_else_is_refused(projector: dict[str, object], words: str) -> None:
    assert_refused(fake_rig(projector=projector), ScanEvidenceError, words)


def test_a_camera_unplugged_mid_sequence() -> None:
    fake = faulty(unplug_at=9)
    assert_refused(fake, DeviceGoneError, "camera 'right' is gone")
    assert "disarm left" in fake.world.calls


def test_a_projector_unplugged_mid_sequence() -> None:
    assert_refused(fake_rig(projector={"gone_at_show": 6}), DeviceGoneError, "the projector is gone")


def test_a_projector_that_is_gone_when_it_should_go_dark_is_no_success() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SEQUENCE)
    for _ in range(2 * COUNT):
        next(frames)
    fake.projector.gone = True
    with pytest.raises(DeviceGoneError):
        next(frames)
    assert all(camera.armed is None for camera in fake.cameras.values())


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), ZeroDivisionError()])
def test_a_driver_that_raises_anything_keeps_no_other_device_from_its_turn(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    fake = faulty(unplug_at=9)

    def broken() -> None:
        raise error

    monkeypatch.setattr(fake.projector, "blank", broken)
    monkeypatch.setattr(fake.cameras["right"], "disarm", broken)
    with pytest.raises(DeviceGoneError, match="camera 'right' is gone"):
        run(fake)
    assert fake.cameras["left"].armed is None


# ---- other ways out


def test_cancel_stops_within_one_frame() -> None:
    fake = fake_rig()
    asked = iter([*[False] * 20, True])
    with pytest.raises(ScanCancelledError, match=r"cancelled at pattern \d+ .* of 22"):
        run(fake, cancelled=lambda: next(asked))
    assert fake.at_rest


def test_cancel_before_the_first_pattern_shows_nothing() -> None:
    fake = fake_rig()
    with pytest.raises(ScanCancelledError):
        run(fake, cancelled=lambda: True)
    assert not any(call.startswith("show") for call in fake.world.calls)
    assert fake.at_rest


def test_a_consumer_that_stops_leaves_the_rig_dark() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SEQUENCE)
    next(frames)
    assert fake.projector.lit
    assert isinstance(frames, Iterator)
    frames.close()  # type: ignore[attr-defined]
    assert fake.at_rest


def test_a_consumer_that_forgets_the_frames_leaves_the_rig_dark() -> None:
    fake = fake_rig()
    for shot in capture(fake.rig, SEQUENCE):
        if shot.pattern == 4:
            break
    del shot
    assert fake.at_rest


def test_a_consumer_that_fails_leaves_the_rig_dark() -> None:
    fake = fake_rig()

    def consume() -> None:
        for _ in capture(fake.rig, SEQUENCE):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        consume()
    assert fake.at_rest


def test_an_interrupt_leaves_the_rig_dark() -> None:
    fake = fake_rig(projector={"interrupt_at_show": 3})
    with pytest.raises(KeyboardInterrupt):
        run(fake)
    assert fake.at_rest


def test_the_rig_works_again_after_each_way_out() -> None:
    fake = fake_rig()
    next(capture(fake.rig, SEQUENCE))
    with pytest.raises(ScanCancelledError):
        run(fake, cancelled=lambda: True)
    assert len(run(fake)) == 2 * COUNT
