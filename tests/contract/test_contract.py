"""The contract suite over every driver, and over itself: no method of a protocol may go unasked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

import pytest

from slrig.conformance import CHECKS, Check, Examination, Outcome
from slrig.devices import Camera, Head, Positioner, Projector, Turntable
from tests.contract.benches import BENCHES
from tests.contract.suite import Bench

QUICK = ("simulated", "replay", "v4l2 (fake kernel)", "picamera2 (a stand-in for the library)")
"""Benches on virtual time. The others take as long as their devices would, ten seconds and more."""

ABOUT = {
    "devices_implement_the_protocols": "Head.cameras Head.projector Camera.info",
    "info_is_readable_in_every_state": "Camera.info Projector.info",
    "declared_ranges_are_sound": "Camera.info Projector.info",
    "calibration_and_truth_fit_the_devices": "Head.calibration Head.truth",
    "triggers_that_are_not_declared_are_refused": "Camera.arm",
    "an_armed_camera_refuses_to_be_set_or_armed": "Camera.configure Camera.arm Camera.read",
    "trigger_and_read_need_an_armed_camera": "Camera.trigger Camera.read Camera.disarm",
    "show_needs_a_loaded_sequence": "Projector.load Projector.show",
    "show_tells_which_pattern_is_lit_since_when": "Projector.show",
    "a_sequence_of_another_size_is_refused": "Projector.load Projector.info",
    "a_projector_plays_only_if_it_says_so": "Projector.play Projector.stop Projector.info",
    "settings_are_read_back": "Camera.configure Camera.info",
    "settings_out_of_range_are_refused": "Camera.configure",
    "a_longer_exposure_is_brighter": "Camera.configure Camera.read",
    "frames_are_as_declared": "Camera.info Camera.read Projector.show",
    "frames_tell_their_exposure": "Camera.configure Camera.read",
    "frame_numbers_and_times_rise": "Camera.read",
    "frame_times_lie_on_the_projectors_clock": "Camera.read Projector.show",
    "a_frame_lies_wholly_in_its_pattern": "Camera.read Camera.trigger Projector.show",
    "a_frame_keeps_its_pixels": "Camera.read",
    "frames_come_in_colour_where_it_is_declared": "Camera.info Camera.read",
    "read_passes_over_stale_frames": "Camera.read Camera.trigger",
    "stale_frames_never_come_back": "Camera.read",
    "read_times_out_in_time": "Camera.read",
    "a_free_running_camera_needs_no_trigger": "Camera.arm Camera.trigger Camera.read",
    "a_wire_without_pulses_gives_no_frame": "Camera.arm Camera.trigger Camera.read",
    "arming_again_starts_afresh": "Camera.arm Camera.disarm Camera.read",
    "every_end_of_a_capture_is_dark_and_leaves_the_rig_usable": (
        "Projector.blank Camera.disarm Camera.arm Projector.load"
    ),
    "a_whole_sequence_is_proven": (
        "Camera.configure Camera.arm Camera.trigger Camera.read Camera.disarm Projector.load Projector.show "
        "Projector.blank"
    ),
    "a_played_sequence_gives_every_frame_in_order": "Projector.play Projector.stop Camera.arm Camera.read",
    "a_play_can_be_stopped": "Projector.play Projector.stop",
    "a_positioner_takes_its_poses_and_no_others": (
        "Positioner.poses Positioner.move Positioner.close Turntable.axis Turntable.angles_deg Turntable.turn "
        "Turntable.opened_at_deg"
    ),
    "the_projector_is_dark_unless_it_shows": "Projector.blank Projector.stop Projector.load Projector.show",
    "the_projector_is_dark_after_opening_and_close": "Projector.close",
    "close_may_be_called_twice": "Camera.disarm Camera.close Projector.stop Projector.blank Projector.close",
    "nothing_works_after_close": "Camera.close Projector.close",
    "a_closed_rig_opens_again": "Camera.close Projector.close",
}
"""By the name of each check, the members of the protocols that it is about."""


@pytest.fixture(
    scope="session", params=[pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in BENCHES]
)
def examination(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Examination]:
    bench = BENCHES[request.param](tmp_path_factory.mktemp("bench"))
    with bench.examination() as examination:
        yield examination
    bench.end()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract(examination: Examination, check: Check) -> None:
    result = examination.judge(check)
    if result.outcome is Outcome.NOT_APPLICABLE:
        pytest.skip(result.reason or "")
    assert result.outcome is Outcome.PASSED, str(result.failure)


def members(protocol: type) -> set[str]:
    return {f"{protocol.__name__}.{name}" for name in vars(protocol) if not name.startswith("_")}


def recording(target: object, protocol: type, asked: set[str]) -> Any:
    """RigBench in for `target`, noting which members of the protocol are asked for."""

    def property_of(name: str) -> property:
        def get(_: object) -> object:
            asked.add(f"{protocol.__name__}.{name}")
            return getattr(target, name)

        return property(get)

    names = [name for name in vars(protocol) if not name.startswith("_")]
    return type("Recording", (), {name: property_of(name) for name in names})()


class RecordingHead:
    """A head whose every use is noted."""

    def __init__(self, head: Head, asked: set[str]) -> None:
        self._noted = cast("Head", recording(head, Head, asked))
        self._asked = asked

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return {name: recording(camera, Camera, self._asked) for name, camera in self._noted.cameras.items()}

    @property
    def projector(self) -> Projector:
        return cast("Projector", recording(self._noted.projector, Projector, self._asked))

    @property
    def calibration(self) -> Any:
        return self._noted.calibration

    def truth(self) -> Any:
        return self._noted.truth()


def test_the_suite_asks_for_every_member_of_every_protocol(tmp_path_factory: pytest.TempPathFactory) -> None:
    plain = BENCHES["replay"](tmp_path_factory.mktemp("bench"))
    asked: set[str] = set()
    noted = Bench(lambda: RecordingHead(plain.open_head(), asked), plain.sequence)
    with noted.examination() as examination:
        for check in CHECKS:
            asked.clear()
            outcome = examination.judge(check).outcome
            assert outcome in {Outcome.PASSED, Outcome.NOT_APPLICABLE}, check.name
            if outcome is Outcome.PASSED:
                # A check asks for what it is about.
                assert asked >= set(ABOUT[check.name].split()), check.name
    assert set(ABOUT) == {check.name for check in CHECKS}
    asked_for = {member for about in ABOUT.values() for member in about.split()}
    protocols = (Camera, Projector, Head, Positioner, Turntable)
    assert asked_for == set().union(*map(members, protocols))
