"""Every check finds the drivers that break what it asks for: a check that finds nothing proves nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from slrig.conformance import CHECKS, Check, Examination, Outcome, Result, run
from slrig.devices import Rig, Synchronisation, Trigger
from slrig.errors import DeviceBusyError
from slrig.model import Calibration, Frame, Pinhole, Size
from tests.unit.conformance import broken_cameras as cameras
from tests.unit.conformance import broken_projectors as projectors
from tests.unit.conformance.model_rig import (
    ALL,
    CAMERA,
    PROJECTOR,
    Exposure,
    Maker,
    ModelCamera,
    ModelProjector,
    sequence,
)

HOUR_NS = 3600 * 10**9


def pinhole(size: Size) -> Pinhole:
    matrix = np.array([[900.0, 0, size.width_px / 2], [0, 900.0, size.height_px / 2], [0, 0, 1]])
    return Pinhole(size, matrix, np.zeros(5), np.eye(3), np.zeros(3))


class Hoarder(Maker):
    """Opens a rig once: closing it does not let the devices go."""

    def __call__(self) -> Rig:
        if len(self.rigs) >= 3:
            message = "the camera is held by process 4711"
            raise DeviceBusyError(message)
        return super().__call__()


class WithoutStop:
    """A projector that lacks a method."""

    def __init__(self, model: ModelProjector) -> None:
        self.info, self.load, self.show, self.play = model.info, model.load, model.show, model.play
        self.blank, self.close = model.blank, model.close


class Incomplete(Maker):
    """Its projector cannot stop."""

    def __call__(self) -> Rig:
        rig = super().__call__()
        assert isinstance(rig.projector, ModelProjector)
        return replace(rig, projector=WithoutStop(rig.projector), head=None)  # type: ignore[arg-type]


class TakesEveryPose:
    """A positioner that has one pose and refuses no other."""

    poses = ("home",)

    def move(self, index: int) -> None:
        del index

    def close(self) -> None:
        return


class Moved(Maker):
    """Its positioner is such a one."""

    def __call__(self) -> Rig:
        return replace(super().__call__(), positioner=TakesEveryPose())


BROKEN: list[tuple[Maker, str, str]] = [
    (Incomplete(), "devices_implement_the_protocols", "without stop"),
    (Maker(cameras.HasAnotherName), "devices_implement_the_protocols", "'camera0'"),
    (Maker(cameras.ForgetsItself), "info_is_readable_in_every_state", "DeviceStateError"),
    (Maker(cameras.DeclaresNoLimit), "declared_ranges_are_sound", "inf"),
    (
        Maker(calibration=Calibration({"left": pinhole(Size(640, 480))}, None)),
        "calibration_and_truth_fit_the_devices",
        "640 x 480",
    ),
    (
        Maker(calibration=Calibration({"left": pinhole(CAMERA)}, pinhole(CAMERA))),
        "calibration_and_truth_fit_the_devices",
        "110 x 80",
    ),
    (Maker(cameras.ArmsAnyTrigger), "triggers_that_are_not_declared_are_refused", "no error"),
    (Maker(cameras.ArmsForNothing), "triggers_that_are_not_declared_are_refused", "no error"),
    (Maker(cameras.SetWhileArmed), "an_armed_camera_refuses_to_be_set_or_armed", "no error"),
    (Maker(cameras.TriggersUnarmed), "trigger_and_read_need_an_armed_camera", "no error"),
    (Maker(projector=projectors.ShowsWithoutSequence), "show_needs_a_loaded_sequence", "no error"),
    (Maker(projector=projectors.CountsFromTheEnd), "show_needs_a_loaded_sequence", "no error"),
    (Maker(projector=projectors.ReturnsEarly), "show_tells_which_pattern_is_lit_since_when", "ms after the return"),
    (Maker(projector=projectors.TellsTheNextPattern), "show_tells_which_pattern_is_lit_since_when", "index=1"),
    (Maker(projector=projectors.ScalesPatterns), "a_sequence_of_another_size_is_refused", "no error"),
    (Maker(projector=projectors.PlaysSilently), "a_projector_plays_only_if_it_says_so", "no error"),
    (Maker(projector=projectors.PlaysUnloaded), "a_projector_plays_only_if_it_says_so", "no error"),
    (Maker(cameras.StepsCoarsely), "settings_are_read_back", "0.02 s"),
    (Maker(cameras.TakesAnything), "settings_out_of_range_are_refused", "no error"),
    (Maker(cameras.RefusesTooLate), "settings_out_of_range_are_refused", "0.0001 s"),
    (Maker(cameras.ExposesAutomatically), "a_longer_exposure_is_brighter", "DN above black"),
    (Maker(cameras.DeclaresAnotherSize), "frames_are_as_declared", "(80, 110)"),
    (Maker(cameras.DeclaresTenBits), "frames_are_as_declared", "no sample is above 1023"),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, image=frame.image.T))),
        "frames_are_as_declared",
        "(110, 80)",
    ),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, image=frame.image.astype(np.uint16)))),
        "frames_are_as_declared",
        "uint16",
    ),
    (Maker(cameras.delivering(lambda frame: replace(frame, camera="right"))), "frames_are_as_declared", "'right'"),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, exposure_s=2 * frame.exposure_s))),
        "frames_tell_their_exposure",
        "0.0333333",
    ),
    (Maker(cameras.delivering(lambda frame: replace(frame, gain=4.0))), "frames_tell_their_exposure", "gain is 1"),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, t_end_ns=frame.t_start_ns))),
        "frames_tell_their_exposure",
        "spans",
    ),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, sequence_number=7))),
        "frame_numbers_and_times_rise",
        "above 7",
    ),
    (
        Maker(
            cameras.delivering(
                lambda frame: replace(frame, t_start_ns=frame.t_start_ns + HOUR_NS, t_end_ns=frame.t_end_ns + HOUR_NS)
            )
        ),
        "frame_times_lie_on_the_projectors_clock",
        "CLOCK_MONOTONIC",
    ),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, t_start_ns=0))),
        "frame_times_lie_on_the_projectors_clock",
        "0 ns",
    ),
    (Maker(projector=projectors.LightsLate), "a_frame_lies_wholly_in_its_pattern", "of white's light"),
    (Maker(cameras.FlushesOneFrame), "a_frame_lies_wholly_in_its_pattern", "of white's light"),
    (Maker(cameras.ReusesItsBuffer), "a_frame_keeps_its_pixels", "pixels changed"),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, colour=None))),
        "frames_come_in_colour_where_it_is_declared",
        "CameraInfo.colour is True",
    ),
    (
        Maker(cameras.delivering(lambda frame: replace(frame, colour=lambda: frame.image))),
        "frames_come_in_colour_where_it_is_declared",
        "(80, 110)",
    ),
    (Maker(cameras.ColoursItsBuffer), "frames_come_in_colour_where_it_is_declared", "by 0.0, 0.0, 0.0 DN"),
    (Maker(cameras.DeliversStale), "read_passes_over_stale_frames", "ms before"),
    (Maker(cameras.DeliversStaleFreely), "read_passes_over_stale_frames", "free trigger"),
    (Maker(cameras.BringsBack), "stale_frames_never_come_back", "no error"),
    (Maker(cameras.DeliversStale), "stale_frames_never_come_back", "no error"),
    (Maker(cameras.NeverGivesUp), "read_times_out_in_time", "no error"),
    (Maker(cameras.TriggersWhileFree), "a_free_running_camera_needs_no_trigger", "no error"),
    (Maker(cameras.FiresWithoutPulse), "a_wire_without_pulses_gives_no_frame", "no error"),
    (Maker(cameras.KeepsOldFrames), "arming_again_starts_afresh", "no error"),
    (Maker(cameras.KeepsOldFramesFreely), "arming_again_starts_afresh", "of white's light"),
    (Maker(projector=projectors.StaysLit), "every_end_of_a_capture_is_dark_and_leaves_the_rig_usable", "dark after"),
    (Maker(projector=projectors.SwapsPatterns), "a_whole_sequence_is_proven", "pattern"),
    (Maker(cameras.MissesAPulse), "a_played_sequence_gives_every_frame_in_order", "pulses make"),
    (Maker(projector=projectors.PulsesOnceMore), "a_played_sequence_gives_every_frame_in_order", "no error"),
    (Maker(projector=projectors.PlaysOn), "a_play_can_be_stopped", "frames"),
    (Moved(), "a_positioner_takes_its_poses_and_no_others", "pose -1 of 1 is refused"),
    (Maker(projector=projectors.StaysLit), "the_projector_is_dark_unless_it_shows", "after blank"),
    (Maker(projector=projectors.StaysLitWhileLoading), "the_projector_is_dark_unless_it_shows", "after load"),
    (Maker(projector=projectors.StaysLitAfterClose), "the_projector_is_dark_after_opening_and_close", "after close"),
    (Maker(projector=projectors.ShinesFromTheStart), "the_projector_is_dark_after_opening_and_close", "after opening"),
    (Maker(cameras.ClosesOnce), "close_may_be_called_twice", "DeviceStateError"),
    (Maker(cameras.IgnoresClose), "nothing_works_after_close", "no error"),
    (Hoarder(), "a_closed_rig_opens_again", "process 4711"),
]


def examined(maker: Maker, check: Check) -> Result:
    maker.rigs.clear()
    with Examination(maker, sequence(), limit_s=20) as examination:
        return examination.judge(check)


def named(name: str) -> Check:
    return next(check for check in CHECKS if check.name == name)


def identities() -> Iterator[str]:
    for maker, name, _ in BROKEN:
        kinds = [kind.__name__ for kind in (type(maker), maker.camera, maker.projector)]
        yield f"{'-'.join(kind for kind in kinds if not kind.startswith(('Model', 'Maker')))}-{name}"


@pytest.mark.parametrize(("maker", "name", "words"), BROKEN, ids=list(identities()))
def test_a_broken_driver_is_found(maker: Maker, name: str, words: str) -> None:
    result = examined(maker, named(name))
    assert result.outcome is Outcome.FAILED
    assert words in str(result.failure)
    assert result.failure is not None
    assert result.failure.do


def test_every_check_finds_a_broken_driver() -> None:
    assert {name for _, name, _ in BROKEN} == {check.name for check in CHECKS}


@pytest.mark.parametrize(
    ("triggers", "plays", "not_applicable"),
    [
        (ALL, True, 1),
        ({Trigger.SOFTWARE, Trigger.FREE}, False, 4),
        ({Trigger.FREE}, False, 4),
        ({Trigger.SOFTWARE}, False, 5),
        ({Trigger.HARDWARE}, True, 18),
    ],
    ids=lambda value: "-".join(sorted(value)) if isinstance(value, set | frozenset) else str(value),
)
def test_a_rig_that_keeps_the_contract_has_a_full_score(
    triggers: set[Trigger], plays: bool, not_applicable: int
) -> None:
    camera = type("Camera", (ModelCamera,), {"triggers": frozenset(triggers)})
    projector = type("Projector", (ModelProjector,), {"plays": plays})
    maker = Maker(camera, projector, Calibration({"left": pinhole(CAMERA)}, pinhole(PROJECTOR)))
    report = run(maker, sequence())
    assert [str(result.failure) for result in report.results if result.outcome is Outcome.FAILED] == []
    assert (report.percent, report.conforms) == (100, True)
    assert report.count(Outcome.NOT_APPLICABLE) == not_applicable
    assert all(rig.projector.closed for rig in maker.rigs)  # type: ignore[attr-defined]


def test_a_display_whose_latency_was_measured_is_waited_for() -> None:
    class Measured(Maker):
        """Its rig file has what a flash test found."""

        def __call__(self) -> Rig:
            return replace(super().__call__(), synchronisation=Synchronisation(0.04, 0.001))

    camera = type("Camera", (ModelCamera,), {"triggers": frozenset({Trigger.SOFTWARE, Trigger.FREE})})
    projector = type("Projector", (projectors.LightsLate,), {"plays": False})
    report = run(Measured(camera, projector), sequence())
    assert [str(result.failure) for result in report.results if result.outcome is Outcome.FAILED] == []


def test_a_frame_that_a_busy_host_gets_late_was_not_passed_over() -> None:
    class ArrivesLate(ModelCamera):
        """Its frames are 0.22 s on their way: more than ten exposures."""

        triggers = frozenset({Trigger.SOFTWARE})
        late_ns = 220_000_000

        def next_exposure(self, deadline_ns: int) -> Exposure | None:
            return super().next_exposure(deadline_ns - self.late_ns)

        def read(self, after_ns: int, timeout_s: float) -> Frame:
            frame = super().read(after_ns, timeout_s)
            self.world.at_ns = max(self.world.at_ns, frame.t_end_ns + self.late_ns)
            return frame

    result = examined(Maker(ArrivesLate), named("stale_frames_never_come_back"))
    assert (result.outcome, str(result.failure)) == (Outcome.PASSED, "None")


def test_a_frame_that_has_to_be_shot_again_is_told() -> None:
    class LosesOne(ModelCamera):
        """Loses one frame of twenty."""

        triggers = frozenset({Trigger.SOFTWARE})

        def start(self, at_ns: int) -> None:
            super().start(at_ns)
            if self.made % 20 == 0:
                self.pending.pop()

    result = examined(
        Maker(LosesOne, type("Projector", (ModelProjector,), {"plays": False})), named("a_whole_sequence_is_proven")
    )
    assert result.outcome is Outcome.FAILED
    assert "1 shot again: " in str(result.failure)
