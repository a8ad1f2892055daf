"""Every check finds the drivers that break what it asks for: a check that finds nothing proves nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slrig.conformance import CHECKS, Check, CheckOutcome, CheckResult, ConformanceRun, run_checks
from slrig.devices import CameraInfo, Rig, Synchronisation, Trigger
from slrig.errors import DeviceBusyError
from slrig.model import Calibration, CameraFormat, Frame, Pinhole, Size
from tests.core import parametrize_core
from tests.unit.conformance import model_rig as drivers
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
CALIBRATED = "calibration_and_truth_fit_the_devices"


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


def without_stop(rig: Rig) -> Rig:
    """Its projector lacks a method."""
    names = ("info", "load", "show", "play", "blank", "close")
    projector = SimpleNamespace(**{name: getattr(rig.projector, name) for name in names})
    return replace(rig, projector=projector, head=None)


def with_every_pose(rig: Rig) -> Rig:
    """It has a positioner with one pose, which refuses no other."""
    positioner = SimpleNamespace(poses=("home",), move=lambda _: None, close=lambda: None)
    return replace(rig, positioner=positioner)


def camera_with(**how: Callable[[Frame], object]) -> type[ModelCamera]:
    """A camera with something else in each of its frames."""

    class Delivers(ModelCamera):
        """Delivers frames that are not as they should be."""

        def frame(self, exposure: Exposure) -> Frame:
            frame = super().frame(exposure)
            return replace(frame, **{name: of(frame) for name, of in how.items()})  # type: ignore[arg-type]

    return Delivers


def declaring(**how: Any) -> type[ModelCamera]:
    """A camera that declares something else."""

    class Declares(ModelCamera):
        """Declares what its data sheet says, not what it does."""

        @property
        def info(self) -> CameraInfo:
            return replace(super().info, **how)

    return Declares


BROKEN: list[tuple[Maker, str, str]] = [
    (Maker(declaring(exposure_range_s=(0.0, float("inf")))), "declared_ranges_are_sound", "inf"),
    (Maker(declaring(name="camera0")), "devices_implement_the_protocols", "'camera0'"),
    (Maker(declaring(format=CameraFormat(Size(1920, 1080), 8))), "frames_are_as_declared", "(80, 110)"),
    *(
        (Maker(device) if issubclass(device, ModelCamera) else Maker(projector=device), check, text)
        for device, check, text in drivers.BROKEN
    ),
    *(
        (Maker(camera_with(**how)), check, text)
        for how, check, text in (
            ({"image": lambda frame: frame.image.T}, "frames_are_as_declared", "(110, 80)"),
            ({"image": lambda frame: frame.image.astype(np.uint16)}, "frames_are_as_declared", "uint16"),
            ({"camera": lambda _: "right"}, "frames_are_as_declared", "'right'"),
            ({"exposure_s": lambda frame: 2 * frame.exposure_s}, "frames_tell_their_exposure", "0.0333333"),
            ({"gain": lambda _: 4.0}, "frames_tell_their_exposure", "gain is 1"),
            ({"t_end_ns": lambda frame: frame.t_start_ns}, "frames_tell_their_exposure", "spans"),
            ({"sequence_number": lambda _: 7}, "frame_numbers_and_times_rise", "above 7"),
            (
                {
                    "t_start_ns": lambda frame: frame.t_start_ns + HOUR_NS,
                    "t_end_ns": lambda frame: frame.t_end_ns + HOUR_NS,
                },
                "frame_times_lie_on_the_projectors_clock",
                "CLOCK_MONOTONIC",
            ),
            ({"t_start_ns": lambda _: 0}, "frame_times_lie_on_the_projectors_clock", "0 ns"),
            ({"colour": lambda _: None}, "frames_come_in_colour_where_it_is_declared", "CameraInfo.colour is True"),
            (
                {"colour": lambda frame: lambda: np.dstack([255 - frame.image, frame.image, frame.image])},
                "frames_come_in_colour_where_it_is_declared",
                "DN of blue, green and red",
            ),
            (
                {"colour": lambda frame: lambda: frame.image},
                "frames_come_in_colour_where_it_is_declared",
                "(80, 110)",
            ),
        )
    ),
    *(
        (Maker(calibration=Calibration({"left": pinhole(camera)}, projector)), CALIBRATED, text)
        for camera, projector, text in ((Size(640, 480), None, "640 x 480"), (CAMERA, pinhole(CAMERA), "110 x 80"))
    ),
    (Maker(change=without_stop), "devices_implement_the_protocols", "without stop"),
    (Maker(change=with_every_pose), "a_positioner_takes_its_poses_and_no_others", "pose -1 of 1 is refused"),
    (Hoarder(), "a_closed_rig_opens_again", "process 4711"),
]


def run_check(maker: Maker, check: Check) -> CheckResult:
    maker.rigs.clear()
    with ConformanceRun(maker, sequence(), limit_s=20) as examination:
        return examination.run_check(check)


def find_check(name: str) -> Check:
    return next(check for check in CHECKS if check.name == name)


def identity(value: object) -> str | None:
    if not isinstance(value, Maker):
        return None
    kinds = [kind.__name__ for kind in (type(value), value.camera, value.projector)]
    return "-".join(kind for kind in kinds if not kind.startswith(("Model", "Maker"))) or None


@pytest.mark.parametrize(("maker", "name", "text"), BROKEN, ids=identity)
def test_a_broken_driver_is_found(maker: Maker, name: str, text: str) -> None:
    result = run_check(maker, find_check(name))
    assert result.outcome is CheckOutcome.FAILED
    assert text in str(result.failure)
    assert result.failure is not None
    assert result.failure.remedy


def test_every_check_finds_a_broken_driver() -> None:
    assert {name for _, name, _ in BROKEN} == {check.name for check in CHECKS}


@parametrize_core(
    ("triggers", "plays", "not_applicable"),
    [
        (ALL, True, 1),
        ({Trigger.SOFTWARE, Trigger.FREE}, False, 4),
        ({Trigger.FREE}, False, 4),
        ({Trigger.SOFTWARE}, False, 5),
        ({Trigger.HARDWARE}, True, 18),
    ],
    ids=lambda value: "-".join(sorted(value)) if isinstance(value, set | frozenset) else str(value),
    core=[0, 2],
)
def test_a_rig_that_keeps_the_contract_has_a_full_score(
    triggers: set[Trigger], plays: bool, not_applicable: int
) -> None:
    camera = type("Camera", (ModelCamera,), {"triggers": frozenset(triggers)})
    projector = type("Projector", (ModelProjector,), {"plays": plays})
    maker = Maker(camera, projector, Calibration({"left": pinhole(CAMERA)}, pinhole(PROJECTOR)))
    report = run_checks(maker, sequence())
    assert [str(result.failure) for result in report.results if result.outcome is CheckOutcome.FAILED] == []
    assert (report.percent, report.conforms) == (100, True)
    assert report.count(CheckOutcome.NOT_APPLICABLE) == not_applicable
    assert all(rig.projector.closed.is_set() for rig in maker.rigs)  # type: ignore[attr-defined]


def test_a_display_whose_latency_was_measured_is_waited_for() -> None:
    def with_latency(rig: Rig) -> Rig:
        return replace(rig, synchronisation=Synchronisation(0.04, 0.001))

    camera = type("Camera", (ModelCamera,), {"triggers": frozenset({Trigger.SOFTWARE, Trigger.FREE})})
    projector = type("Projector", (drivers.LightsLate,), {"plays": False})
    report = run_checks(Maker(camera, projector, change=with_latency), sequence())
    assert [str(result.failure) for result in report.results if result.outcome is CheckOutcome.FAILED] == []


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

    result = run_check(Maker(ArrivesLate), find_check("stale_frames_never_come_back"))
    assert (result.outcome, str(result.failure)) == (CheckOutcome.PASSED, "None")


def test_a_frame_that_has_to_be_shot_again_is_reported() -> None:
    class LosesOne(ModelCamera):
        """Loses one frame of twenty."""

        triggers = frozenset({Trigger.SOFTWARE})

        def start(self, at_ns: int) -> None:
            super().start(at_ns)
            if self.made % 20 == 0:
                self.pending.pop()

    result = run_check(
        Maker(LosesOne, type("Projector", (ModelProjector,), {"plays": False})),
        find_check("a_whole_sequence_is_proven"),
    )
    assert result.outcome is CheckOutcome.FAILED
    assert "1 shot again: " in str(result.failure)
