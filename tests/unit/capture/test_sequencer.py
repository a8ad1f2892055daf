"""The sequencer on a rig in memory: what it delivers, what it refuses, what it shoots again, by software and by wire,
and that it always leaves the rig dark.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from slrig.bundle.sidecars import RefusedFrame
from slrig.capture.retries import MAX_FAILURES, RetryPolicy
from slrig.capture.sequencer import capture
from slrig.capture.triggering import frame_shift
from slrig.capture.verifier import Evidence, EvidenceSummary
from slrig.devices import CameraSettings, Synchronisation, Trigger
from slrig.errors import (
    DeviceGoneError,
    FrameTimeoutError,
    ScanCancelledError,
    ScanEvidenceError,
    UnsupportedByDeviceError,
)
from slrig.model import PatternSequence, Shot, Size
from slrig.patterns.sequence import encode
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import PROJECTOR, CameraFaults, FakeRig, Scene, fake_rig, patterns_for

PATTERNS = patterns_for()
SEQUENCE = encode(PATTERNS, PROJECTOR)
COUNT = len(SEQUENCE)
SHORT = encode(patterns_for(line_shift=False, cell_px=32), PROJECTOR)
"""Few patterns, for what no pattern matters for."""

FREE = frozenset({Trigger.FREE})
HARDWARE = frozenset({Trigger.HARDWARE})
EVERY = frozenset(Trigger)


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """How frames are judged is checked by test_evidence.py, with as many pixels as in a real capture."""
    monkeypatch.setattr("slrig.capture.verifier._SAMPLES", 3000)


def run(
    fake: FakeRig, sequence: PatternSequence = SEQUENCE, *, cancelled: Callable[[], bool] = lambda: False
) -> list[Shot]:
    return list(capture(fake.rig, sequence, cancelled=cancelled))


def faulty(*others: str, **faults: object) -> FakeRig:
    """A rig whose camera "right" has these faults, beside `others`."""
    return fake_rig(cameras=[*others, "right"], faults={"right": CameraFaults(**faults)})  # type: ignore[arg-type]


def assert_refused(fake: FakeRig, kind: type[BaseException], words: str) -> None:
    with pytest.raises(kind, match=words):
        run(fake)
    assert fake.at_rest


# ---- a sound rig


def test_every_camera_gives_every_pattern_in_order_with_a_summary() -> None:
    fake = fake_rig()
    evidence = Evidence(PATTERNS, {name: camera.info.format for name, camera in fake.cameras.items()})
    shots = list(capture(fake.rig, SEQUENCE, evidence=evidence))
    assert [(shot.pattern, shot.camera) for shot in shots] == [(i, c) for i in range(COUNT) for c in ("left", "right")]
    assert fake.at_rest
    summary = evidence.summary()
    assert (summary.verified, summary.patterns, summary.faults, summary.shot_again) == (COUNT, COUNT, (), 0)
    assert sum(call.startswith("show") for call in fake.world.calls) == COUNT
    times = [shot.time_s for shot in shots if shot.camera == "left"]
    assert times[0] == 0.0
    assert all(b > a for a, b in pairwise(times) if a is not None and b is not None)
    assert {shot.exposure_s for shot in shots} == {0.01}


def test_nothing_starts_before_the_first_frame_is_requested() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SEQUENCE)
    assert fake.world.calls == []
    next(iter(frames))
    assert "show 0" in fake.world.calls
    # The second pattern is exposed while the first one's frames are judged.
    assert "show 2" not in fake.world.calls


def test_frames_carry_the_name_that_the_rig_gives_the_camera() -> None:
    fake = fake_rig(cameras=["left"])
    renamed = replace(fake.rig, cameras={"top": fake.cameras["left"]}, settings={"top": CameraSettings(0.01)})
    assert {shot.camera for shot in capture(renamed, SHORT)} == {"top"}


# ---- triggers


@parametrize_core(
    ("plays", "left", "right", "armed"),
    [
        (False, EVERY, EVERY, ["software", "software"]),
        (True, EVERY, EVERY, ["hardware", "hardware"]),
        (True, EVERY, frozenset({Trigger.SOFTWARE, Trigger.FREE}), ["software", "software"]),
        (False, FREE, EVERY, ["free", "software"]),
        (True, FREE, EVERY, ["free", "software"]),
    ],
    core=[0, 2, 4],
)
def test_the_best_trigger_that_all_can_do_is_used(
    plays: bool, left: frozenset[Trigger], right: frozenset[Trigger], armed: list[str]
) -> None:
    fake = fake_rig(projector={"plays": plays}, triggers={"left": left, "right": right})
    shots = run(fake, SHORT)
    assert len(shots) == 2 * len(SHORT)
    calls = [call for call in fake.world.calls if call.startswith("arm")]
    assert calls == [f"arm left {armed[0]}", f"arm right {armed[1]}"]
    assert ("play" in fake.world.calls) == (armed[0] == "hardware")
    assert fake.at_rest


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (
            lambda: fake_rig(triggers={"right": HARDWARE}),
            UnsupportedByDeviceError,
            "camera 'right' can be trig.*wire",
        ),
        (lambda: fake_rig(cameras=[]), UnsupportedByDeviceError, "has no camera"),
        (lambda: faulty("left", unplug_at=9), DeviceGoneError, "camera 'right' is gone"),
        (lambda: fake_rig(projector={"gone_at_show": 6}), DeviceGoneError, "the projector is gone"),
    ],
    ids=["wires only", "no camera", "camera unplugged", "projector unplugged"],
)
def test_a_rig_that_cannot_capture_is_rejected(
    make: Callable[[], FakeRig], kind: type[BaseException], words: str
) -> None:
    assert_refused(make(), kind, words)


# ---- settings


def test_a_read_back_that_differs_by_more_than_one_percent_is_refused_with_both_numbers() -> None:
    words = r"'right': asked for exposure 0.01 s, it uses 0.0102"
    assert_refused(faulty(readback=1.02), UnsupportedByDeviceError, words)
    assert len(run(faulty(readback=1.008), SHORT)) == len(SHORT)


def test_a_sequence_for_another_projector_is_refused() -> None:
    fake = fake_rig()
    with pytest.raises(UnsupportedByDeviceError, match="64 x 48"):
        list(capture(fake.rig, encode(patterns_for(Size(64, 48)), Size(64, 48))))
    assert fake.at_rest


# ---- faults


@parametrize_core(
    ("projector", "words"),
    [
        ({"lamp_off": True}, r"failed 3 times, each time alike.*lamp"),
        ({"inverted": True}, r"failed 3 times, each time alike.*white is darker than black.*inverted"),
        ({"swaps": {4: 5, 5: 4}}, "failed 3 times.*exchanged with its inverse"),
        ({"swaps": {5: 4}}, "failed 3 times.*the frame and its inverse show the same"),
        ({"swaps": {13: 16, 16: 13}}, "failed 3 times.*(lines are not where|out of order)"),
        ({"swaps": {0: 1, 1: 0}}, "failed 3 times.*white is darker than black"),
        ({"swaps": {14: 13}}, "failed 3 times"),
    ],
    core=[0, 3],
)
def test_a_projector_that_shows_something_else_is_refused(projector: dict[str, object], words: str) -> None:
    fake = fake_rig(cameras=["left"], projector=projector)
    assert_refused(fake, ScanEvidenceError, words)
    if "swaps" not in projector:
        # White and black three times, and each time the pattern that was shown while they were judged.
        assert sum(call.startswith("show") for call in fake.world.calls) == 3 * MAX_FAILURES


def test_a_projector_that_cannot_go_dark_is_an_error() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SHORT)
    for _ in range(2 * len(SHORT)):
        next(frames)
    fake.projector.gone = True
    with pytest.raises(DeviceGoneError):
        next(frames)
    assert all(camera.armed is None for camera in fake.cameras.values())


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), ZeroDivisionError()])
def test_an_error_of_a_driver_does_not_prevent_releasing_other_devices(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    fake = faulty("left", unplug_at=9)

    def broken() -> None:
        raise error

    monkeypatch.setattr(fake.projector, "blank", broken)
    monkeypatch.setattr(fake.cameras["right"], "disarm", broken)
    with pytest.raises(DeviceGoneError, match="camera 'right' is gone"):
        run(fake)
    assert fake.cameras["left"].armed is None


# ---- other ways out


def test_cancel_stops_within_one_frame_and_before_the_first_pattern_shows_nothing() -> None:
    fake = fake_rig()
    asked = iter([*[False] * 20, True])
    with pytest.raises(ScanCancelledError, match=r"cancelled at pattern \d+ .* of 22"):
        run(fake, cancelled=lambda: next(asked))
    assert fake.at_rest
    fake = fake_rig()
    with pytest.raises(ScanCancelledError):
        run(fake, cancelled=lambda: True)
    assert not any(call.startswith("show") for call in fake.world.calls)
    assert fake.at_rest


def test_a_consumer_that_stops_forgets_or_fails_leaves_the_rig_dark() -> None:
    fake = fake_rig()
    frames = capture(fake.rig, SHORT)
    next(frames)
    assert fake.projector.lit
    assert isinstance(frames, Iterator)
    frames.close()  # type: ignore[attr-defined]
    assert fake.at_rest
    for shot in capture(fake.rig, SHORT):
        if shot.pattern == 4:
            break
    del shot
    assert fake.at_rest

    def consume() -> None:
        for _ in capture(fake.rig, SHORT):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        consume()
    assert fake.at_rest
    # It works again after each way out.
    assert len(run(fake, SHORT)) == 2 * len(SHORT)


def test_an_interrupt_leaves_the_rig_dark() -> None:
    fake = fake_rig(projector={"interrupt_at_show": 3})
    with pytest.raises(KeyboardInterrupt):
        run(fake)
    assert fake.at_rest


# ---- wrong frames are captured again, until they are right or have failed three times


class CaptureRun:
    """Frames of a capture as its consumer has them at the end, and the rejected exposures."""

    def __init__(self, fake: FakeRig) -> None:
        self.fake = fake
        self.yielded: list[Shot] = []
        self.latest: dict[tuple[str, int], Shot] = {}
        self.refused: list[RefusedFrame] = []
        self.summary: EvidenceSummary | None = None

    def run(self) -> CaptureRun:
        formats = {name: camera.info.format for name, camera in self.fake.cameras.items()}
        evidence = Evidence(PATTERNS, formats)
        try:
            for shot in capture(self.fake.rig, SEQUENCE, evidence=evidence, refused=self._refuse):
                self.yielded.append(shot)
                self.latest[shot.camera, shot.pattern] = shot
        finally:
            self.summary = evidence.summary()
            assert self.fake.at_rest
        return self

    def _refuse(self, refused: RefusedFrame) -> None:
        self.refused.append(refused)
        assert ((refused.camera, refused.pattern) in self.latest) == refused.delivered
        if refused.delivered:
            del self.latest[refused.camera, refused.pattern]

    def assert_right(self) -> None:
        """Every frame is there and shows its own pattern, and no other."""
        assert sorted(self.latest) == sorted((name, i) for name in self.fake.cameras for i in range(COUNT))
        for (name, index), shot in self.latest.items():
            scene = Scene(first_column_px=self.fake.cameras[name].scene.first_column_px)
            truth = scene.image(SEQUENCE.profiles[index]).astype(float)
            assert np.sqrt(np.mean((shot.image - truth) ** 2)) < 2
        assert self.summary is not None
        assert (self.summary.verified, self.summary.patterns, self.summary.faults) == (COUNT, COUNT, ())


def after_shots(count: int) -> frozenset[int]:
    return frozenset(range(count, 1000))


EACH_KIND: dict[str, dict[str, object]] = {
    "stale": {"stale": frozenset({5})},
    "stale line frame": {"stale": frozenset({15})},
    "stale black": {"stale": frozenset({1})},
    "stale closing white": {"stale": frozenset({COUNT - 2})},
    "too early": {"early": frozenset({7})},
    "delivered twice": {"same_number": frozenset({7})},
    "garbled": {"garbled": frozenset({8})},
    "garbled line frame": {"garbled": frozenset({17})},
    "garbled white": {"garbled": frozenset({0})},
    "garbled black": {"garbled": frozenset({1})},
    "garbled closing black": {"garbled": frozenset({COUNT - 1})},
    "exposed otherwise": {"over_exposed": frozenset({3})},
    "lost": {"drop": frozenset({5})},
    "several": {"garbled": frozenset({9, 20}), "stale": frozenset({4, 16}), "drop": frozenset({2, 26})},
}


@parametrize_core("name", EACH_KIND, core=[*map(list(EACH_KIND).index, ("stale", "garbled white", "several"))])
def test_a_failed_frame_is_repeated_and_all_frames_are_correct(name: str) -> None:
    run_result = CaptureRun(faulty(**EACH_KIND[name])).run()
    run_result.assert_right()
    assert {refused.camera for refused in run_result.refused} == {"right"}
    assert run_result.summary is not None
    assert run_result.summary.shot_again == len(run_result.refused) > 0
    assert str(run_result.summary).startswith(f"{COUNT}/{COUNT} patterns verified, {len(run_result.refused)} frame")


def test_only_the_camera_that_failed_is_exposed_again() -> None:
    run_result = CaptureRun(faulty("left", stale=frozenset({15}))).run()
    assert run_result.fake.world.calls.count("show 15") == 2
    assert run_result.fake.cameras["left"].made == COUNT
    assert run_result.fake.cameras["right"].made == COUNT + 1


def test_both_frames_of_a_contradicting_pair_are_repeated() -> None:
    run_result = CaptureRun(faulty(stale=frozenset({5}))).run()
    assert [(r.pattern, r.attempt, r.delivered, r.shot is None) for r in run_result.refused] == [
        (4, 1, True, True),
        (5, 1, False, False),
    ]
    assert all("show the same" in r.cause for r in run_result.refused)
    # The first of the pair had been given out; it comes again.
    assert Counter((s.camera, s.pattern) for s in run_result.yielded)["right", 4] == 2


def test_reference_frames_are_repeated_when_the_first_pair_is_not_at_fault() -> None:
    run_result = CaptureRun(faulty(garbled=frozenset({0}))).run()
    # Pattern 4 was there meanwhile, judged at pixels that the damaged white frame had chosen.
    assert [r.pattern for r in run_result.refused] == [2, 3, 0, 1, 2, 3, 4]


def test_white_and_black_are_not_suspect_after_a_pair_confirmed_them() -> None:
    # Both frames of the second pair, and then one of them again.
    run_result = CaptureRun(faulty(garbled=frozenset({4, COUNT - 10}), stale=frozenset({8}))).run()
    run_result.assert_right()
    assert not {0, 1} & {r.pattern for r in run_result.refused}


def test_a_rejected_frame_is_reported_with_its_image_and_time() -> None:
    run_result = CaptureRun(faulty(garbled=frozenset({17}))).run()
    (refused,) = run_result.refused
    assert refused.shot is not None
    assert (refused.pattern, refused.camera, refused.attempt) == (17, "right", 1)
    assert refused.shot.image.shape == (150, 200)
    right = [s.time_s for s in run_result.yielded if s.camera == "right" and s.pattern in {16, 17}]
    assert right[0] is not None
    assert right[1] is not None
    assert refused.shot.time_s is not None
    assert right[0] < refused.shot.time_s < right[1]


# ---- the third failure


@parametrize_core(
    ("faults", "words"),
    [
        ({"stale": after_shots(15)}, r"'right', pattern 15 .*failed 3 times.*equals that of pattern 14"),
        ({"early": after_shots(7)}, r"'right', pattern 7 .*failed 3 times.*stable from \d+ ns only.*stale"),
        ({"garbled": after_shots(17)}, r"'right', pattern 17 .*failed 3 times"),
        ({"over_exposed": after_shots(3)}, r"exposed for 0.015 s, set to 0.01 s"),
        # A pattern may fail for one reason after the other.
        (
            {"early": frozenset({17}), "over_exposed": frozenset({19}), "garbled": frozenset({21})},
            r"pattern 17 .*failed 3 times. The first time: .*stale frame.* The second time: exposed for.* The third",
        ),
    ],
    core=[0, 2],
)
def test_three_failures_end_the_scan_with_all_causes(faults: dict[str, object], words: str) -> None:
    run_result = CaptureRun(faulty(**faults))
    with pytest.raises(ScanEvidenceError, match=words):
        run_result.run()
    worst = max(r.attempt for r in run_result.refused)
    assert worst == MAX_FAILURES
    # Every frame that was made counts or was refused.
    delivered = [r for r in run_result.refused if r.delivered]
    assert len(run_result.yielded) == len(run_result.latest) + len(delivered)


def test_a_frame_that_does_not_come_three_times_ends_the_scan() -> None:
    run_result = CaptureRun(faulty(drop=frozenset({5, 7, 9})))
    with pytest.raises(
        FrameTimeoutError,
        match=r"camera 'right', pattern 5 \(column Gray bit 1 of 5, inverse\): it failed 3 times, each time alike: no "
        r"frame came within 2.010 s of its light, visible since \d+ ns ± 1000 ns",
    ):
        run_result.run()
    assert run_result.fake.world.calls.count("show 5") == 3


def test_only_consecutive_lost_frames_count() -> None:
    # Pattern 15: lost, damaged, lost, damaged, and then well.
    run_result = CaptureRun(faulty(drop=frozenset({15, 19}), garbled=frozenset({17, 21}))).run()
    run_result.assert_right()
    assert [(r.pattern, r.attempt) for r in run_result.refused] == [(15, 1), (15, 2), (15, 3), (15, 4)]


def test_the_number_of_exposures_is_limited() -> None:
    policy = RetryPolicy(SHORT, Evidence(SHORT.patterns, {"left": Scene().format}), lambda _: None)
    assert policy.max_exposures == MAX_FAILURES * len(SHORT)
    for number in range(policy.max_exposures):
        policy.start_exposure("left", number % len(SHORT))
    policy.start_exposure("right", 0)
    with pytest.raises(ScanEvidenceError, match=f"{policy.max_exposures} exposures gave no {len(SHORT)} frames"):
        policy.start_exposure("left", 0)


def test_a_projector_that_swapped_two_patterns_once_is_overcome() -> None:
    fake = fake_rig(cameras=["left"])
    shown = fake.projector.show
    swapped = {4: 5, 5: 4}

    def show(index: int) -> object:
        fake.projector.swaps = {index: swapped.pop(index)} if index in swapped else {}
        return shown(index)

    fake.projector.show = show  # type: ignore[method-assign, assignment]
    run_result = CaptureRun(fake).run()
    run_result.assert_right()
    assert {r.pattern for r in run_result.refused} >= {4, 5}


def test_repeating_frames_does_not_hide_movement() -> None:
    fake = fake_rig(cameras=["left"])
    shown = fake.projector.show

    def show(index: int) -> object:
        if index == COUNT - 2:
            fake.cameras["left"].scene.albedo = np.roll(fake.cameras["left"].scene.albedo, 60, axis=1)
            fake.cameras["left"].scene.first_column_px = 30
        return shown(index)

    fake.projector.show = show  # type: ignore[method-assign, assignment]
    run_result = CaptureRun(fake)
    with pytest.raises(ScanEvidenceError, match=r"pattern 20 \(white\): it failed 3 times.*moved"):
        run_result.run()
    assert {r.pattern for r in run_result.refused} == {COUNT - 2}


# ---- sequences that a projector plays by wire: they count as a whole, and a shift by one is reported


def wired(*others: str, projector: dict[str, object] | None = None, **faults: object) -> FakeRig:
    """A rig whose camera "right" has these faults, beside `others`."""
    return fake_rig(
        cameras=[*others, "right"],
        projector={"plays": True, **(projector or {})},
        triggers={"left": HARDWARE, "right": HARDWARE},
        faults={"right": CameraFaults(**faults)},  # type: ignore[arg-type]
    )


def plays(fake: FakeRig) -> int:
    return fake.world.calls.count("play")


def test_a_correct_play_counts_at_once() -> None:
    run_result = CaptureRun(wired("left")).run()
    assert (len(run_result.latest), run_result.refused) == (2 * COUNT, [])
    assert str(run_result.summary) == f"{COUNT}/{COUNT} patterns verified"
    assert plays(run_result.fake) == 1


@parametrize_core(
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
    core=[0, 2],
)
def test_a_play_that_failed_is_repeated_whole(projector: dict[str, object], faults: dict[str, object]) -> None:
    run_result = CaptureRun(wired(projector=projector, **faults)).run()
    run_result.assert_right()
    assert {r.attempt for r in run_result.refused} == set(range(1, plays(run_result.fake)))
    words = f"{COUNT}/{COUNT} patterns verified, {len(run_result.refused)} frames shot again"
    assert str(run_result.summary).startswith(words)


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
        pytest.param(
            {"extra_pulses": frozenset({COUNT - 1})},
            r"gave more than the 22 frames of the sequence",
            marks=pytest.mark.slow,
        ),
        (
            {"missing_pulses": frozenset({COUNT - 1})},
            r"camera 'left' gave 21 of 22 frames, that of pattern 21 \(black.*a trigger pulse was missed",
        ),
    ],
)
def test_three_failed_plays_report_all_causes(projector: dict[str, object], words: str) -> None:
    fake = wired("left", projector=projector)
    with pytest.raises((ScanEvidenceError, FrameTimeoutError), match=words):
        CaptureRun(fake).run()
    assert plays(fake) == 3


def test_a_gap_between_frames_is_reported() -> None:
    # The same frame of each play.
    lost = frozenset({6, COUNT + 6, 2 * COUNT + 6})
    with pytest.raises(ScanEvidenceError, match=r"frame number \d+ follows \d+, 1 were lost"):
        CaptureRun(wired(drop=lost)).run()


def test_a_scan_can_be_cancelled_between_plays() -> None:
    fake = wired(projector={"missing_pulses": frozenset({0})})
    list_of = capture(fake.rig, SEQUENCE, cancelled=lambda: plays(fake) == 2)
    with pytest.raises(Exception, match="cancelled"):
        list(list_of)
    assert fake.at_rest
    assert plays(fake) == 2


def test_wired_cameras_must_have_an_exposure() -> None:
    fake = wired("left")
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
    assert frame_shift([dark] * COUNT, SEQUENCE) == frame_shift([], SEQUENCE) == 0


@pytest.mark.parametrize(
    ("told_s", "readout_s", "times", "words"),
    [
        # An industrial camera that tells the rate of overlapped exposures, and takes no trigger while it reads out.
        (0.0115, 0.0044, 2, "every second pulse"),
        # A rolling shutter that is three times slower by wire.
        pytest.param(0.0115, 0.021, 3, "every third pulse", marks=pytest.mark.slow),
    ],
)
def test_a_camera_that_misses_pulses_is_played_to_more_slowly_and_the_next_time_at_once(
    told_s: float, readout_s: float, times: int, words: str
) -> None:
    run_result = CaptureRun(wired(min_period_s=told_s, readout_s=readout_s)).run()
    run_result.assert_right()
    period_s = f"trigger_period_s = {times * told_s:.6g}"
    assert run_result.refused
    assert all(words in refused.cause and period_s in refused.cause for refused in run_result.refused)
    fake = run_result.fake
    assert [period_s for _, period_s in fake.world.periods_s] == pytest.approx([told_s, times * told_s])
    # Exposed for another time, it is tried anew.
    longer = {name: CameraSettings(0.011) for name in fake.cameras}
    for rig in (fake.rig, replace(fake.rig, settings=longer)):
        list(capture(rig, SEQUENCE))
    played_s = [period_s for _, period_s in fake.world.periods_s[2:]]
    assert played_s == pytest.approx([times * told_s, *(step * told_s for step in (1, times))])


@pytest.mark.parametrize(("drop", "times"), [(range(3, COUNT, 4), 2), (range(3, 4), 1)])
def test_a_camera_that_misses_some_pulses_is_played_to_more_slowly_but_not_for_one(drop: range, times: int) -> None:
    fake = CaptureRun(wired(drop=frozenset(drop))).run().fake
    (_, first_s), (_, second_s) = fake.world.periods_s
    assert second_s == pytest.approx(times * first_s)


# ---- the time from pulse to pulse


def times_s(fake: FakeRig, *, trigger_period_s: float | None = None, line_s: float = 0.0) -> tuple[float, float]:
    """What was played: how long each pattern was lit, and how often pulses came, s."""
    lines = {"right": line_s} if line_s else {}
    known = Synchronisation(0.0, 0.0, lines, trigger_period_s)
    list(capture(replace(fake.rig, synchronisation=known), SHORT))
    return fake.world.periods_s[0]


@pytest.mark.parametrize(
    ("told_s", "trigger_period_s", "period_s"),
    [
        # A camera that tells nothing gets as long again for its read-out, unless the rig file knows better.
        ((None, None), None, 0.02),
        ((None, None), 0.012, 0.012),
        # Cameras that tell are believed, the slowest wins, and the rig file may ask for more.
        ((0.011, 0.013), None, 0.013),
        ((0.011, 0.013), 0.05, 0.05),
        # The projector has its gap.
        ((0.01, 0.01), None, 0.0105),
    ],
)
def test_pulses_come_as_often_as_cameras_projector_and_rig_file_let(
    told_s: tuple[float | None, float | None], trigger_period_s: float | None, period_s: float
) -> None:
    fake = wired("left")
    for camera, least_s in zip(fake.cameras.values(), told_s, strict=True):
        camera.faults = CameraFaults(min_period_s=least_s)
    assert times_s(fake, trigger_period_s=trigger_period_s) == pytest.approx((0.01, period_s))


def test_a_pattern_is_lit_until_the_last_row_of_a_rolling_shutter_has_seen_it() -> None:
    rows = wired().cameras["right"].info.format.size.height_px
    lit_s = 0.01 + (rows - 1) * 1e-5
    assert times_s(wired(), line_s=1e-5) == pytest.approx((lit_s, lit_s + 0.01))
    # The projector has its gap after that.
    assert times_s(wired(min_period_s=0.01), line_s=1e-5) == pytest.approx((lit_s, lit_s + 0.0005))
