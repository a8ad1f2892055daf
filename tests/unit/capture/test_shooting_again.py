"""Frames that are not what they claim are shot again, until they are, or have failed three times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
import pytest

from slrig.bundle.refused import Refused
from slrig.capture.evidence import Evidence, EvidenceSummary
from slrig.capture.retry_policy import MOST_FAILURES
from slrig.capture.sequencer import capture
from slrig.errors import FrameTimeoutError, ScanEvidenceError
from slrig.model import Black, Gray, LineShift, Shot, White
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import PROJECTOR, CameraFaults, FakeRig, Scene, fake_rig, patterns_for

PATTERNS = patterns_for()
SEQUENCE = encode(PATTERNS, PROJECTOR)
COUNT = len(SEQUENCE)
FIRST_LINE = next(i for i, pattern in enumerate(PATTERNS) if isinstance(pattern, LineShift))


class Taken:
    """A capture's frames as a consumer has them at its end, and what was refused on the way."""

    def __init__(self, fake: FakeRig) -> None:
        self.fake = fake
        self.yielded: list[Shot] = []
        self.latest: dict[tuple[str, int], Shot] = {}
        self.refused: list[Refused] = []
        self.summary: EvidenceSummary | None = None

    def run(self) -> Taken:
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

    def _refuse(self, refused: Refused) -> None:
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


def faulty(**faults: object) -> FakeRig:
    return fake_rig(faults={"right": CameraFaults(**faults)})  # type: ignore[arg-type]


def after_shots(count: int) -> frozenset[int]:
    return frozenset(range(count, 1000))


EACH_KIND: Mapping[str, dict[str, object]] = {
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


@pytest.mark.parametrize("faults", EACH_KIND.values(), ids=EACH_KIND.keys())
def test_a_frame_that_fails_is_shot_again_and_all_frames_are_right(faults: dict[str, object]) -> None:
    taken = Taken(faulty(**faults)).run()
    taken.assert_right()
    assert {refused.camera for refused in taken.refused} == {"right"}
    assert taken.summary is not None
    assert taken.summary.shot_again == len(taken.refused) > 0
    assert str(taken.summary).startswith(f"{COUNT}/{COUNT} patterns verified, {len(taken.refused)} frame")


def test_nothing_is_shot_again_on_a_sound_rig() -> None:
    taken = Taken(fake_rig()).run()
    taken.assert_right()
    assert taken.refused == []
    assert str(taken.summary) == f"{COUNT}/{COUNT} patterns verified"
    assert sum(call.startswith("show") for call in taken.fake.world.calls) == COUNT


def test_only_the_camera_that_failed_is_exposed_again() -> None:
    taken = Taken(faulty(stale=frozenset({15}))).run()
    assert taken.fake.world.calls.count("show 15") == 2
    assert taken.fake.cameras["left"].made == COUNT
    assert taken.fake.cameras["right"].made == COUNT + 1


def test_a_pair_that_contradicts_itself_is_shot_again_whole() -> None:
    taken = Taken(faulty(stale=frozenset({5}))).run()
    assert [(r.pattern, r.attempt, r.delivered, r.shot is None) for r in taken.refused] == [
        (4, 1, True, True),
        (5, 1, False, False),
    ]
    assert all("show the same" in r.cause for r in taken.refused)
    # The first of the pair had been given out; it comes again.
    assert Counter((s.camera, s.pattern) for s in taken.yielded)["right", 4] == 2


def test_what_the_first_pair_rests_on_is_shot_again_when_the_pair_is_not_to_blame() -> None:
    taken = Taken(faulty(garbled=frozenset({0}))).run()
    # Pattern 4 was there meanwhile, judged at pixels that the damaged white frame had chosen.
    assert [r.pattern for r in taken.refused] == [2, 3, 0, 1, 2, 3, 4]


def test_white_and_black_are_not_blamed_once_a_pair_has_vouched_for_them() -> None:
    # Both frames of the second pair, and then one of them again.
    taken = Taken(faulty(garbled=frozenset({4, COUNT - 10}), stale=frozenset({8}))).run()
    taken.assert_right()
    assert not {0, 1} & {r.pattern for r in taken.refused}


def test_a_refused_frame_is_handed_over_with_its_image_and_time() -> None:
    taken = Taken(faulty(garbled=frozenset({17}))).run()
    (refused,) = taken.refused
    assert refused.shot is not None
    assert (refused.pattern, refused.camera, refused.attempt) == (17, "right", 1)
    assert refused.shot.image.shape == (150, 200)
    right = [s.time_s for s in taken.yielded if s.camera == "right" and s.pattern in {16, 17}]
    assert right[0] is not None
    assert right[1] is not None
    assert refused.shot.time_s is not None
    assert right[0] < refused.shot.time_s < right[1]


def test_a_frame_that_was_refused_is_not_delivered() -> None:
    taken = Taken(faulty(early=after_shots(7)))
    with pytest.raises(ScanEvidenceError):
        taken.run()
    assert ("right", 7) not in taken.latest


# ---- the third failure


@pytest.mark.parametrize(
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
)
def test_three_failures_end_the_scan_and_tell_why(faults: dict[str, object], words: str) -> None:
    taken = Taken(faulty(**faults))
    with pytest.raises(ScanEvidenceError, match=words):
        taken.run()
    worst = max(r.attempt for r in taken.refused)
    assert worst == MOST_FAILURES
    # Every frame that was made counts or was refused.
    delivered = [r for r in taken.refused if r.delivered]
    assert len(taken.yielded) == len(taken.latest) + len(delivered)


def test_a_frame_that_does_not_come_three_times_ends_the_scan() -> None:
    taken = Taken(faulty(drop=frozenset({5, 7, 9})))
    with pytest.raises(
        FrameTimeoutError,
        match=r"camera 'right', pattern 5 \(column Gray bit 1 of 5, inverse\): it failed 3 times, each time alike: no "
        r"frame came within 2.010 s of its light, visible since \d+ ns ± 1000 ns",
    ):
        taken.run()
    assert taken.fake.world.calls.count("show 5") == 3


def test_frames_that_are_lost_now_and_then_say_nothing_against_those_that_come() -> None:
    # Pattern 15: lost, damaged, lost, damaged, and then well.
    taken = Taken(faulty(drop=frozenset({15, 19}), garbled=frozenset({17, 21}))).run()
    taken.assert_right()
    assert [(r.pattern, r.attempt) for r in taken.refused] == [(15, 1), (15, 2), (15, 3), (15, 4)]


@pytest.mark.parametrize("fault", ["lamp_off", "inverted"])
def test_what_shooting_again_cannot_mend_ends_quickly(fault: str) -> None:
    fake = fake_rig(projector={fault: True})
    with pytest.raises(ScanEvidenceError, match=r"failed 3 times, each time alike"):
        Taken(fake).run()
    # White and black three times, and each time the pattern that was shown while they were judged.
    assert sum(call.startswith("show") for call in fake.world.calls) == 3 * MOST_FAILURES


@pytest.mark.parametrize("swaps", [{4: 5, 5: 4}, {13: 16, 16: 13}, {0: 1, 1: 0}, {5: 4}, {14: 13}])
def test_a_projector_that_shows_the_wrong_pattern_every_time_ends_the_scan(swaps: dict[int, int]) -> None:
    with pytest.raises(ScanEvidenceError, match=r"failed 3 times|exposures gave no"):
        Taken(fake_rig(projector={"swaps": swaps})).run()


def test_a_projector_that_swapped_two_patterns_once_is_overcome() -> None:
    fake = fake_rig()
    shown = fake.projector.show
    swapped = {4: 5, 5: 4}

    def show(index: int) -> object:
        fake.projector.swaps = {index: swapped.pop(index)} if index in swapped else {}
        return shown(index)

    fake.projector.show = show  # type: ignore[method-assign, assignment]
    taken = Taken(fake).run()
    taken.assert_right()
    assert {r.pattern for r in taken.refused} >= {4, 5}


def test_an_object_that_moved_is_not_hidden_by_shooting_again() -> None:
    fake = fake_rig(cameras=["left"])
    shown = fake.projector.show

    def show(index: int) -> object:
        if index == COUNT - 2:
            fake.cameras["left"].scene.albedo = np.roll(fake.cameras["left"].scene.albedo, 60, axis=1)
            fake.cameras["left"].scene.first_column_px = 30
        return shown(index)

    fake.projector.show = show  # type: ignore[method-assign, assignment]
    taken = Taken(fake)
    with pytest.raises(ScanEvidenceError, match=r"pattern 20 \(white\): it failed 3 times.*moved"):
        taken.run()
    assert {r.pattern for r in taken.refused} == {COUNT - 2}


def test_the_patterns_are_the_ones_these_tests_count_on() -> None:
    assert (COUNT, FIRST_LINE) == (22, 12)
    assert PATTERNS[:2] == (White(), Black())
    assert PATTERNS[-2:] == (White(), Black())
    assert isinstance(PATTERNS[4], Gray)
