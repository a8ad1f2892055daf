"""Sequences that a projector plays by wire: they count as a whole, and a shift by one is told in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.bundle.refused import Refused
from slrig.capture.evidence import Evidence
from slrig.capture.hardware_trigger import frame_shift
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Synchronisation, Trigger
from slrig.errors import FrameTimeoutError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import Shot
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import PROJECTOR, CameraFaults, FakeRig, Scene, fake_rig, patterns_for

PATTERNS = patterns_for()
SEQUENCE = encode(PATTERNS, PROJECTOR)
COUNT = len(SEQUENCE)
HARDWARE = frozenset({Trigger.HARDWARE})


def wired(projector: dict[str, object] | None = None, **faults: object) -> FakeRig:
    return fake_rig(
        projector={"plays": True, **(projector or {})},
        triggers={"left": HARDWARE, "right": HARDWARE},
        faults={"right": CameraFaults(**faults)},  # type: ignore[arg-type]
    )


def taken(fake: FakeRig) -> tuple[dict[tuple[str, int], Shot], list[Refused], str]:
    """The frames that count in the end, what was refused, and the summary in words."""
    latest: dict[tuple[str, int], Shot] = {}
    refused: list[Refused] = []

    def refuse(each: Refused) -> None:
        refused.append(each)
        if each.delivered:
            del latest[each.camera, each.pattern]

    evidence = Evidence(PATTERNS, {name: camera.info.format for name, camera in fake.cameras.items()})
    try:
        for shot in capture(fake.rig, SEQUENCE, evidence=evidence, refused=refuse):
            latest[shot.camera, shot.pattern] = shot
    finally:
        assert fake.at_rest
    return latest, refused, str(evidence.summary())


def plays(fake: FakeRig) -> int:
    return fake.world.calls.count("play")


def test_a_sound_play_counts_at_once() -> None:
    fake = wired()
    frames, refused, words = taken(fake)
    assert (len(frames), refused, words) == (2 * COUNT, [], f"{COUNT}/{COUNT} patterns verified")
    assert plays(fake) == 1


@pytest.mark.parametrize(
    ("projector", "faults"),
    [
        ({"missing_pulses": frozenset({0}), "spoilt_plays": 1}, {}),
        ({"missing_pulses": frozenset({7}), "spoilt_plays": 2}, {}),
        ({"extra_pulses": frozenset({0}), "spoilt_plays": 1}, {}),
        ({"extra_pulses": frozenset({9}), "spoilt_plays": 2}, {}),
        ({}, {"drop": frozenset({6})}),
        ({}, {"stale": frozenset({9}), "garbled": frozenset({COUNT + 3})}),
        ({}, {"same_number": frozenset({9})}),
    ],
)
def test_a_play_that_failed_is_repeated_whole(projector: dict[str, object], faults: dict[str, object]) -> None:
    fake = wired(projector, **faults)
    frames, refused, words = taken(fake)
    assert len(frames) == 2 * COUNT
    assert {r.attempt for r in refused} == set(range(1, plays(fake)))
    assert words.startswith(f"{COUNT}/{COUNT} patterns verified, {len(refused)} frames shot again")
    for (name, index), shot in frames.items():
        truth = Scene(first_column_px=fake.cameras[name].scene.first_column_px).image(SEQUENCE.profiles[index])
        assert np.sqrt(np.mean((shot.image - truth.astype(float)) ** 2)) < 2


@pytest.mark.parametrize(
    ("projector", "words"),
    [
        (
            {"missing_pulses": frozenset({0})},
            r"played 3 times by wire: it failed 3 times, each time alike: the frames of camera 'left' are shifted by "
            r"one: its frame 0 shows pattern 1. It missed the first trigger pulse.*camera 'right' are shifted by one",
        ),
        (
            {"extra_pulses": frozenset({0})},
            r"camera 'left' are shifted by one: its frame 1 shows pattern 0. It was triggered once before",
        ),
        ({"extra_pulses": frozenset({COUNT - 1})}, r"gave more than the 22 frames of the sequence"),
        ({"missing_pulses": frozenset({COUNT - 1})}, r"camera 'left' gave 21 of 22 frames, that of pattern 21 \(black"),
        ({"missing_pulses": frozenset({4})}, r"pulse|Gray bit"),
    ],
)
def test_three_plays_that_fail_tell_why(projector: dict[str, object], words: str) -> None:
    fake = wired(projector)
    with pytest.raises((ScanEvidenceError, FrameTimeoutError), match=words):
        taken(fake)
    assert plays(fake) == 3


def test_frames_that_do_not_come_are_a_time_out() -> None:
    with pytest.raises(FrameTimeoutError, match="a trigger pulse was missed"):
        taken(wired({"missing_pulses": frozenset({COUNT - 1})}))


def test_a_gap_between_frames_is_told() -> None:
    # The same frame of each play.
    lost = frozenset({6, COUNT + 6, 2 * COUNT + 6})
    with pytest.raises(ScanEvidenceError, match=r"frame number \d+ follows \d+, 1 were lost"):
        taken(wired(drop=lost))


def test_a_scan_can_be_cancelled_between_plays() -> None:
    fake = wired({"missing_pulses": frozenset({0})})
    list_of = capture(fake.rig, SEQUENCE, cancelled=lambda: plays(fake) == 2)
    with pytest.raises(Exception, match="cancelled"):
        list(list_of)
    assert fake.at_rest
    assert plays(fake) == 2


def test_wired_cameras_must_have_an_exposure() -> None:
    fake = wired()
    unset = replace(fake, rig=replace(fake.rig, settings={"left": CameraSettings(0.01)}))
    with pytest.raises(UnsupportedByDeviceError, match=r"\['right'\] have no exposure set"):
        list(capture(unset.rig, SEQUENCE))


@pytest.mark.parametrize("first_column_px", [4.0, 60.0])
@pytest.mark.parametrize("line_shift", [True, False])
def test_a_shift_shows_in_the_brightness_of_the_frames(first_column_px: float, line_shift: bool) -> None:
    sequence = encode(patterns_for(line_shift=line_shift), PROJECTOR)
    scene = Scene(first_column_px=first_column_px, columns_per_px=0.3, noise_dn=1.0)
    levels = [float(scene.image(profile).mean()) for profile in sequence.profiles]
    dark = float(scene.image(None).mean())
    assert frame_shift(levels, sequence) == 0
    assert frame_shift(levels[1:], sequence) == 1
    assert frame_shift([dark, *levels], sequence) == -1


def test_frames_without_light_tell_no_shift() -> None:
    assert frame_shift([3.0] * COUNT, SEQUENCE) == 0
    assert frame_shift([], SEQUENCE) == 0


def test_a_pattern_is_lit_until_the_last_row_of_a_rolling_shutter_has_seen_it() -> None:
    fake = wired()
    timing = Synchronisation(0.0, 0.0, {"right": 40e-6})
    rows = fake.cameras["right"].info.format.size.height_px
    list(capture(replace(fake.rig, synchronisation=timing), SEQUENCE))
    ((lit_s, period_s),) = fake.world.periods_s
    exposure_s = max(settings.exposure_s for settings in fake.rig.settings.values())
    assert lit_s == pytest.approx(exposure_s + 40e-6 * (rows - 1), rel=1e-6)
    assert period_s == pytest.approx(lit_s + exposure_s)


# ---- the time from pulse to pulse


def times_s(fake: FakeRig, *, trigger_period_s: float | None = None, line_s: float = 0.0) -> tuple[float, float]:
    """What was played: how long each pattern was lit, and how often pulses came, s."""
    lines = {"right": line_s} if line_s else {}
    known = Synchronisation(0.0, 0.0, lines, trigger_period_s)
    list(capture(replace(fake.rig, synchronisation=known), SEQUENCE))
    return fake.world.periods_s[0]


def test_a_camera_that_tells_nothing_gets_as_long_again_for_its_read_out() -> None:
    assert times_s(wired()) == pytest.approx((0.01, 0.02))


def test_a_camera_that_tells_is_believed_and_the_slowest_wins() -> None:
    fake = wired(least_period_s=0.013)
    fake.cameras["left"].faults = CameraFaults(least_period_s=0.011)
    assert times_s(fake) == pytest.approx((0.01, 0.013))


def test_the_rig_file_knows_of_cameras_that_tell_nothing_and_may_ask_for_more_than_they_tell() -> None:
    assert times_s(wired(), trigger_period_s=0.012) == pytest.approx((0.01, 0.012))
    both = wired(least_period_s=0.013)
    both.cameras["left"].faults = CameraFaults(least_period_s=0.011)
    assert times_s(both, trigger_period_s=0.05) == pytest.approx((0.01, 0.05))


def test_the_projector_has_its_gap_and_its_share_of_light() -> None:
    fast = wired(least_period_s=0.01)
    fast.cameras["left"].faults = CameraFaults(least_period_s=0.01)
    assert times_s(fast) == pytest.approx((0.01, 0.0105))
    rolling = wired(least_period_s=0.01)
    rolling.cameras["left"].faults = CameraFaults(least_period_s=0.01)
    lit_s = 0.01 + 149 * 1e-5
    assert times_s(rolling, line_s=1e-5) == pytest.approx((lit_s, lit_s + 0.0005))
