"""Checks of a whole rig: sequences that are captured, stopped or played, the positioner, and closing."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from slrig.capture import Evidence
from slrig.capture.sequencer import capture, choose_triggers
from slrig.conformance.bench import (
    ABSENT_FRAME_WAIT_S,
    FRAME_WAIT_S,
    STEPPED_TRIGGERS,
    ExpectationError,
    Failure,
    Need,
    RigBench,
    check,
    expect,
    expect_error,
    expect_no_error,
    on_device,
)
from slrig.conformance.camera_checks import expect_applied_settings, expect_declared_format
from slrig.devices import Camera, CameraSettings, Positioner, Projector, Rig, Trigger, Turntable
from slrig.errors import DeviceError, DeviceStateError, FrameTimeoutError, ScanCancelledError, UnsupportedByDeviceError
from slrig.model import Frame, PatternSequence

_ROUND = "make one pulse per pattern, and one frame per pulse; check the trigger cable and that read-out fits"


@check(Need.STEPPED, Need.WHITE_AND_BLACK)
def every_end_of_a_capture_is_dark_and_leaves_the_rig_usable(bench: RigBench) -> None:
    """After every end of a capture the projector is dark and the rig can be used again."""
    rig = _configured_rig(bench)
    with on_device("rig"):
        with bench.arm_camera(*next(bench.stepped_cameras())) as armed:
            armed.measure_reference()
        frames = capture(rig, bench.short_sequence)
        next(frames)
        del frames
        _expect_left_dark(bench, "a capture that is abandoned")
        taken: list[object] = []
        with suppress(ScanCancelledError):
            for shot in capture(rig, bench.short_sequence, cancelled=lambda: bool(taken)):
                taken.append(shot)  # noqa: PERF402 - `cancelled` reads what was taken so far
        _expect_left_dark(bench, "a capture that is cancelled after its first frame")
        expect(
            list(capture(rig, bench.short_sequence)),
            expected="a capture after a cancelled one gives its frames",
            found="none",
            remedy="restore the state after opening in disarm and blank",
        )
        _expect_left_dark(bench, "a capture that is complete")


@check(Need.WHITE_AND_BLACK)
def a_whole_sequence_is_proven(bench: RigBench) -> None:
    """A whole sequence is captured, and every frame is verified to show its pattern."""
    rig = _configured_rig(bench)
    with on_device("rig"):
        _expect_verified(bench, rig)
    steps = all(camera.info.triggers.intersection(STEPPED_TRIGGERS) for camera in rig.cameras.values())
    if Trigger.HARDWARE in choose_triggers(rig).values() and steps:
        with on_device("rig, without its trigger wire"):
            _expect_verified(bench, replace(rig, projector=_SteppingProjector(rig.projector)))


@check(Need.PLAYS)
def a_played_sequence_gives_every_frame_in_order(bench: RigBench) -> None:
    """A sequence that the projector plays gives one frame per pattern, in order, and no more."""
    rig = _configured_rig(bench)
    cameras = _wired_cameras(rig)
    with on_device("projector and cameras by wire"):
        applied = {name: camera.configure(bench.settings(name)) for name, camera in cameras.items()}
        frames = _play(bench, rig, cameras, bench.sequence)
        for name, recorded in frames.items():
            for frame in recorded:
                expect_declared_format(frame, cameras[name].info)
                expect_applied_settings(frame, applied[name])
            numbers = [frame.sequence_number for frame in recorded]
            expect(
                bool(np.all(np.diff(numbers) == 1)) and recorded[-1].dropped_count == 0,
                expected=f"camera '{name}': {len(bench.sequence)} frames with numbers in one run, none lost",
                found=f"{numbers}, {recorded[-1].dropped_count} lost",
                remedy=_ROUND,
            )
            expect(
                all(later.t_start_ns >= earlier.t_end_ns for earlier, later in pairwise(recorded)),
                expected=f"camera '{name}': each frame begins after the one before it ended",
                found=[(frame.t_start_ns, frame.t_end_ns) for frame in recorded],
                remedy="take time stamps from the device",
            )
            if Need.WHITE_AND_BLACK.unmet_reason(rig, bench.sequence) is None and len(recorded) > 1:
                white, black = (float(recorded[index].image.mean()) for index in (0, 1))
                expect(
                    white > black,
                    expected=f"camera '{name}': the first frame shows white, the second black",
                    found=f"means of {white:.1f} and {black:.1f} DN",
                    remedy="start with the first pattern, and let its pulse start the first exposure",
                )
        for name, camera in cameras.items():
            with expect_error(
                FrameTimeoutError,
                expected=f"camera '{name}': a frame beyond the last pattern",
                remedy="make no more pulses",
            ):
                camera.read(frames[name][-1].t_end_ns, ABSENT_FRAME_WAIT_S)


@check(Need.PLAYS)
def a_play_can_be_stopped(bench: RigBench) -> None:
    """A play that is stopped ends at once, dark, and another one begins with the first pattern."""
    rig = _configured_rig(bench)
    cameras = _wired_cameras(rig)
    with on_device("projector and cameras by wire"):
        exposure_s = max(bench.settings(name).exposure_s for name in cameras)
        rig.projector.load(bench.sequence)
        for camera in cameras.values():
            camera.arm(len(bench.sequence), Trigger.HARDWARE)
        # Slow enough that stop interrupts it.
        rig.projector.play(exposure_s, 20 * exposure_s)
        for camera in cameras.values():
            camera.read(0, FRAME_WAIT_S + 40 * exposure_s)
        rig.projector.stop()
        for name, camera in cameras.items():
            max_count = 3
            count = 1
            with suppress(FrameTimeoutError):
                while count <= max_count:
                    camera.read(0, 25 * exposure_s)
                    count += 1
            expect(
                count <= max_count or len(bench.sequence) <= max_count,
                expected=f"camera '{name}': frames end with stop, after the first of {len(bench.sequence)} patterns",
                found=f"{count} frames",
                remedy="end the sequence in stop, and make no more pulses",
            )
            camera.disarm()
        for name, recorded in _play(bench, rig, cameras, bench.short_sequence).items():
            expect(
                len(recorded) == len(bench.short_sequence),
                expected=f"camera '{name}': the next play gives its frames",
                found=f"{len(recorded)}",
                remedy="begin with the first pattern at every play",
            )


class _SteppingProjector:
    """A projector that plays, presented as one that does not, so that a capture steps it."""

    def __init__(self, projector: Projector) -> None:
        self.info = replace(projector.info, plays=False)
        self.load, self.show, self.play = projector.load, projector.show, projector.play
        self.stop, self.blank, self.close = projector.stop, projector.blank, projector.close


def _expect_verified(bench: RigBench, rig: Rig) -> None:
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    evidence = Evidence(bench.sequence.patterns, formats, projector=bench.sequence.projector)
    shots = list(capture(rig, bench.sequence, evidence=evidence))
    captured = {(shot.pattern, shot.camera) for shot in shots}
    missing = [
        f"pattern {index} of '{name}'"
        for index in range(len(bench.sequence))
        for name in rig.cameras
        if (index, name) not in captured
    ]
    expect(
        not missing,
        expected="a capture gives a frame of every pattern from every camera",
        found=f"none of {', '.join(missing)}",
        remedy="return one frame per pattern",
    )
    summary = evidence.summary()
    expect(
        summary.shot_again == 0,
        expected="every frame is right the first time",
        found=f"{summary.shot_again} shot again: {'; '.join(summary.causes)}",
        remedy="a scan compensates that, but a driver should not rely on it: find the cause",
    )
    for name in rig.cameras:
        times_s = [shot.time_s or 0.0 for shot in shots if shot.camera == name]
        expect(
            bool(np.all(np.diff(times_s) > 0)),
            expected=f"the frames of camera '{name}' come in the order of their times",
            found=times_s,
            remedy="take time stamps from the device",
        )
    expect(
        summary.verified == len(bench.sequence),
        expected=f"{len(bench.sequence)} of {len(bench.sequence)} patterns are verified by the frames",
        found=f"{summary.verified}",
        remedy="put a light, matt surface before the rig that fills the view of every camera, in focus, not saturated",
    )


def _play(bench: RigBench, rig: Rig, cameras: dict[str, Camera], sequence: PatternSequence) -> dict[str, list[Frame]]:
    """Play a sequence once, and return each camera's frames. The cameras stay armed."""
    exposure_s = max(bench.settings(name).exposure_s for name in cameras)
    # The same time again for reading the sensors.
    period_s = 2 * exposure_s
    rig.projector.load(sequence)
    for camera in cameras.values():
        camera.arm(len(sequence), Trigger.HARDWARE)
    rig.projector.play(exposure_s, period_s)
    frames: dict[str, list[Frame]] = {name: [] for name in cameras}
    for index in range(len(sequence)):
        for name, camera in cameras.items():
            try:
                frames[name].append(camera.read(0, FRAME_WAIT_S + period_s))
            except FrameTimeoutError as error:
                failure = Failure(
                    f"camera '{name}': {len(sequence)} pulses make {len(sequence)} frames", f"{index} ({error})", _ROUND
                )
                raise ExpectationError(failure) from error
    rig.projector.stop()
    return frames


def _wired_cameras(rig: Rig) -> dict[str, Camera]:
    return {name: camera for name, camera in rig.cameras.items() if Trigger.HARDWARE in camera.info.triggers}


def _configured_rig(bench: RigBench) -> Rig:
    """Return the rig with every camera disarmed and configured, and with settings for a capture."""
    rig = bench.rig
    settings = {name: bench.settings(name) for name in rig.cameras}
    for name, camera in rig.cameras.items():
        camera.disarm()
        camera.configure(settings[name])
    return replace(rig, settings=settings)


def _expect_left_dark(bench: RigBench, after: str) -> None:
    with bench.arm_camera(*next(bench.stepped_cameras()), load=False) as armed:
        armed.expect_dark(f"after {after}")


@check(Need.POSITIONER, fresh=True)
def a_positioner_takes_its_poses_and_no_others(bench: RigBench) -> None:
    """A positioner accepts its poses and no others, and a turntable any angle."""
    positioner = bench.rig.positioner
    if positioner is None:  # excluded by `Need.POSITIONER`
        return
    with on_device("positioner"):
        poses = tuple(positioner.poses)
        expect(
            poses and len(set(poses)) == len(poses),
            expected="it has one or more poses with different names",
            found=poses,
            remedy="declare the poses; a turntable that turns to any angle declares a selection",
        )
        for index in (-1, len(poses)):
            remedy = "check the number before any motion, and name the available poses"
            with expect_error(UnsupportedByDeviceError, expected=f"pose {index} of {len(poses)}", remedy=remedy):
                positioner.move(index)
        with expect_no_error(
            expected=f"it takes its pose {min(1, len(poses) - 1)}", remedy="return when the object has stopped"
        ):
            positioner.move(min(1, len(poses) - 1))
        if isinstance(positioner, Turntable):
            _check_turntable(positioner)
        _check_closing(positioner)


def _check_turntable(table: Turntable) -> None:
    axis, angles = table.axis, tuple(table.angles_deg)
    expect(
        axis is None or math.isclose(float(np.linalg.norm(axis.direction)), 1.0, rel_tol=1e-6),
        expected="its axis has a direction of length 1",
        found=axis,
        remedy="divide it by its length; None if the axis is unknown",
    )
    expect(
        len(angles) == len(table.poses) and all(map(math.isfinite, angles)),
        expected=f"each of its {len(table.poses)} poses has an angle",
        found=angles,
        remedy="give angles_deg in the order of poses",
    )
    with expect_error(DeviceError, expected="turn(nan)", remedy="check the angle before any motion"):
        table.turn(math.nan)
    with expect_no_error(
        expected="it turns back to 0°, its angle when it was opened", remedy="count angles from there"
    ):
        table.turn(0.0)


def _check_closing(positioner: Positioner) -> None:
    for _ in range(2):
        with expect_no_error(
            expected="close works any number of times", remedy="return at once if there is nothing to do"
        ):
            positioner.close()
    with expect_error(DeviceStateError, expected="move after close", remedy="refuse every use of a closed device"):
        positioner.move(0)


@check(Need.STEPPED, Need.WHITE_AND_BLACK)
def the_projector_is_dark_unless_it_shows(bench: RigBench) -> None:
    """The projector is dark unless it shows: after blank, stop and load."""
    name, trigger = next(bench.stepped_cameras())
    with bench.arm_camera(name, trigger) as armed:
        armed.measure_reference()
        dark: dict[str, Callable[[], None]] = {
            "blank": armed.projector.blank,
            "stop": armed.projector.stop,
            "load": lambda: armed.projector.load(bench.sequence),
        }
        for call, darken in dark.items():
            armed.expect_level(
                armed.expose(0),
                0,
                expected="a shown white pattern appears white",
                remedy="light the pattern that is shown",
            )
            darken()
            armed.expect_dark(f"after {call}")


@check(Need.STEPPED, Need.WHITE_AND_BLACK, fresh=True)
def the_projector_is_dark_after_opening_and_close(bench: RigBench) -> None:
    """The projector is dark when it was opened, and when it is closed."""
    name, trigger = next(bench.stepped_cameras())
    with bench.arm_camera(name, trigger) as armed:
        armed.measure_reference()
    # Close while it shows: after an error, a rig is closed in this state.
    bench.rig.projector.show(0)
    bench.close()
    with bench.arm_camera(name, trigger, load=False) as armed:
        armed.expect_dark("after opening")
        armed.projector.load(bench.sequence)
        armed.show(0)
        armed.projector.close()
        armed.expect_dark("after close")


@check(fresh=True)
def close_may_be_called_twice(bench: RigBench) -> None:
    """Closing, and the calls before it, may be repeated."""
    rig = _put_into_use(bench)
    for calls in (_resting_calls(rig), _resting_calls(rig), _closing_calls(rig), _closing_calls(rig)):
        _expect_all_work(calls)
    _expect_all_work(_resting_calls(rig), " after close")


@check(fresh=True)
def nothing_works_after_close(bench: RigBench) -> None:
    """Every use is refused after close."""
    rig = _put_into_use(bench)
    _expect_all_work(_closing_calls(rig))
    uses = {f"camera '{name}'": _camera_calls(camera, bench.settings(name)) for name, camera in rig.cameras.items()}
    uses["projector"] = {
        "load": lambda: rig.projector.load(bench.short_sequence),
        "show": lambda: rig.projector.show(0),
        "play": lambda: rig.projector.play(0.01, 0.02),
    }
    for device, calls in uses.items():
        with on_device(device):
            for name, call in calls.items():
                with expect_error(
                    DeviceStateError, expected=f"{name} after close", remedy="refuse every use of a closed device"
                ):
                    call()


@check(fresh=True)
def a_closed_rig_opens_again(bench: RigBench) -> None:
    """A rig that was closed can be opened again at once, and gives frames."""
    for _ in range(2):
        _put_into_use(bench)
        bench.close()
        with on_device("rig"):
            rig = bench.reopen()
            expect(
                rig.cameras, expected="the rig has its cameras again", found="none", remedy="open every device again"
            )
    for name, trigger in bench.stepped_cameras():
        with bench.arm_camera(name, trigger) as armed:
            armed.expose(0)


def _put_into_use(bench: RigBench) -> Rig:
    """Return the rig with every camera armed, an exposure started where possible, and the projector showing."""
    rig = bench.rig
    rig.projector.load(bench.sequence)
    triggers = dict(bench.stepped_cameras())
    for name, camera in rig.cameras.items():
        camera.configure(bench.settings(name))
        camera.arm(2, triggers.get(name, Trigger.HARDWARE))
    rig.projector.show(0)
    for name, trigger in triggers.items():
        if trigger is Trigger.SOFTWARE:
            rig.cameras[name].trigger()
    return rig


def _resting_calls(rig: Rig) -> dict[str, Callable[[], None]]:
    calls = {f"camera '{name}': disarm": camera.disarm for name, camera in rig.cameras.items()}
    return calls | {"projector: stop": rig.projector.stop, "projector: blank": rig.projector.blank}


def _closing_calls(rig: Rig) -> dict[str, Callable[[], None]]:
    calls = {"projector: close": rig.projector.close}
    return calls | {f"camera '{name}': close": camera.close for name, camera in rig.cameras.items()}


def _expect_all_work(calls: Mapping[str, Callable[[], None]], when: str = "") -> None:
    remedy = "return at once if there is nothing to do"
    for name, call in calls.items():
        with expect_no_error(expected=f"{name}{when} works in every state and any number of times", remedy=remedy):
            call()


def _camera_calls(camera: Camera, settings: CameraSettings) -> dict[str, Callable[[], object]]:
    return {
        "configure": lambda: camera.configure(settings),
        "arm": lambda: camera.arm(1, min(camera.info.triggers)),
        "trigger": camera.trigger,
        "read": lambda: camera.read(0, ABSENT_FRAME_WAIT_S),
    }
