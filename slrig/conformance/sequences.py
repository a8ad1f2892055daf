"""Whole sequences: captured and proven, stopped half way, and played by the projector itself."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from slrig.capture import Evidence, capture, choose_triggers
from slrig.conformance.bench import (
    LONG_S,
    SHORT_S,
    STEPPED,
    ExpectationError,
    Failure,
    Need,
    RigBench,
    at,
    check,
    expect,
    refused,
)
from slrig.conformance.frames import expect_declared, expect_exposed
from slrig.devices import Camera, Projector, Rig, Trigger
from slrig.errors import FrameTimeoutError, ScanCancelledError
from slrig.model import Frame, PatternSequence

_ROUND = "make one pulse per pattern, and one frame per pulse; check the trigger cable and that read-out fits"


@check(Need.STEPPED, Need.WHITE_AND_BLACK)
def every_end_of_a_capture_is_dark_and_leaves_the_rig_usable(bench: RigBench) -> None:
    """However a capture ends, the projector is dark and the rig can be used again."""
    rig = _set(bench)
    with at("rig"):
        with bench.view(*next(bench.ways())) as view:
            view.learn()
        frames = capture(rig, bench.opening)
        next(frames)
        del frames
        _expect_left_dark(bench, "a capture that nobody reads on")
        taken: list[object] = []
        with suppress(ScanCancelledError):
            for shot in capture(rig, bench.opening, cancelled=lambda: bool(taken)):
                taken.append(shot)  # noqa: PERF402 - `cancelled` looks at what was taken so far
        _expect_left_dark(bench, "a capture that is cancelled after its first frame")
        expect(
            list(capture(rig, bench.opening)),
            asked="a capture after a cancelled one gives its frames",
            found="none",
            do="let disarm and blank leave the devices as they were after opening",
        )
        _expect_left_dark(bench, "a capture that is complete")


@check(Need.WHITE_AND_BLACK)
def a_whole_sequence_is_proven(bench: RigBench) -> None:
    """A whole sequence is captured, and every frame proven to show its pattern."""
    rig = _set(bench)
    with at("rig"):
        _expect_proven(bench, rig)
    steps = all(camera.info.triggers.intersection(STEPPED) for camera in rig.cameras.values())
    if Trigger.HARDWARE in choose_triggers(rig).values() and steps:
        with at("rig, without its trigger wire"):
            _expect_proven(bench, replace(rig, projector=_Stepping(rig.projector)))


@check(Need.PLAYS)
def a_played_sequence_gives_every_frame_in_order(bench: RigBench) -> None:
    """A sequence that the projector plays gives one frame per pattern, in order, and no more."""
    rig = _set(bench)
    cameras = _wired(rig)
    with at("projector and cameras by wire"):
        applied = {name: camera.configure(bench.settings(name)) for name, camera in cameras.items()}
        frames = _played(bench, rig, cameras, bench.sequence)
        for name, taken in frames.items():
            for frame in taken:
                expect_declared(frame, cameras[name].info)
                expect_exposed(frame, applied[name])
            numbers = [frame.sequence_number for frame in taken]
            expect(
                bool(np.all(np.diff(numbers) == 1)) and taken[-1].dropped_count == 0,
                asked=f"camera '{name}': {len(bench.sequence)} frames with numbers in one run, none lost",
                found=f"{numbers}, {taken[-1].dropped_count} lost",
                do=_ROUND,
            )
            expect(
                all(later.t_start_ns >= earlier.t_end_ns for earlier, later in pairwise(taken)),
                asked=f"camera '{name}': each frame begins after the one before it ended",
                found=[(frame.t_start_ns, frame.t_end_ns) for frame in taken],
                do="take time stamps from the device",
            )
            if Need.WHITE_AND_BLACK.unmet(rig, bench.sequence) is None and len(taken) > 1:
                white, black = (float(taken[index].image.mean()) for index in (0, 1))
                expect(
                    white > black,
                    asked=f"camera '{name}': the first frame shows white, the second black",
                    found=f"means of {white:.1f} and {black:.1f} DN",
                    do="start with the first pattern, and let its pulse start the first exposure",
                )
        for name, camera in cameras.items():
            with refused(
                FrameTimeoutError, asked=f"camera '{name}': a frame beyond the last pattern", do="make no more pulses"
            ):
                camera.read(frames[name][-1].t_end_ns, SHORT_S)


@check(Need.PLAYS)
def a_play_can_be_stopped(bench: RigBench) -> None:
    """A play that is stopped ends at once, dark, and another one begins with the first pattern."""
    rig = _set(bench)
    cameras = _wired(rig)
    with at("projector and cameras by wire"):
        exposure_s = max(bench.settings(name).exposure_s for name in cameras)
        rig.projector.load(bench.sequence)
        for camera in cameras.values():
            camera.arm(len(bench.sequence), Trigger.HARDWARE)
        # Slow enough that most of it is still to come.
        rig.projector.play(exposure_s, 20 * exposure_s)
        for camera in cameras.values():
            camera.read(0, LONG_S + 40 * exposure_s)
        rig.projector.stop()
        for name, camera in cameras.items():
            most = 3
            count = 1
            with suppress(FrameTimeoutError):
                while count <= most:
                    camera.read(0, 25 * exposure_s)
                    count += 1
            expect(
                count <= most or len(bench.sequence) <= most,
                asked=f"camera '{name}': frames end with stop, after the first of {len(bench.sequence)} patterns",
                found=f"{count} frames",
                do="end the sequence in stop, and make no more pulses",
            )
            camera.disarm()
        for name, taken in _played(bench, rig, cameras, bench.opening).items():
            expect(
                len(taken) == len(bench.opening),
                asked=f"camera '{name}': the next play gives its frames",
                found=f"{len(taken)}",
                do="begin with the first pattern at every play",
            )


class _Stepping:
    """A projector that plays, as one that does not: a capture steps it."""

    def __init__(self, projector: Projector) -> None:
        self.info = replace(projector.info, plays=False)
        self.load, self.show, self.play = projector.load, projector.show, projector.play
        self.stop, self.blank, self.close = projector.stop, projector.blank, projector.close


def _expect_proven(bench: RigBench, rig: Rig) -> None:
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    evidence = Evidence(bench.sequence.patterns, formats)
    shots = list(capture(rig, bench.sequence, evidence=evidence))
    got = {(shot.pattern, shot.camera) for shot in shots}
    lacking = [
        f"pattern {index} of '{name}'"
        for index in range(len(bench.sequence))
        for name in rig.cameras
        if (index, name) not in got
    ]
    expect(
        not lacking,
        asked="a capture gives a frame of every pattern from every camera",
        found=f"none of {', '.join(lacking)}",
        do="return one frame per pattern",
    )
    summary = evidence.summary()
    expect(
        summary.shot_again == 0,
        asked="every frame is right the first time",
        found=f"{summary.shot_again} shot again: {'; '.join(summary.causes)}",
        do="a scan overcomes that, and a driver ought not to need it: see which pattern and which camera",
    )
    for name in rig.cameras:
        times_s = [shot.time_s or 0.0 for shot in shots if shot.camera == name]
        expect(
            bool(np.all(np.diff(times_s) > 0)),
            asked=f"the frames of camera '{name}' come in the order of their times",
            found=times_s,
            do="take time stamps from the device",
        )
    expect(
        summary.verified == len(bench.sequence),
        asked=f"{len(bench.sequence)} of {len(bench.sequence)} patterns are proven by what the frames show",
        found=f"{summary.verified}",
        do="put a light, matt surface before the rig that fills the view of every camera, in focus, not saturated",
    )


def _played(bench: RigBench, rig: Rig, cameras: dict[str, Camera], sequence: PatternSequence) -> dict[str, list[Frame]]:
    """Play a sequence once; return each camera's frames. The cameras stay armed."""
    exposure_s = max(bench.settings(name).exposure_s for name in cameras)
    # As long again for the sensors to be read out.
    period_s = 2 * exposure_s
    rig.projector.load(sequence)
    for camera in cameras.values():
        camera.arm(len(sequence), Trigger.HARDWARE)
    rig.projector.play(exposure_s, period_s)
    frames: dict[str, list[Frame]] = {name: [] for name in cameras}
    for index in range(len(sequence)):
        for name, camera in cameras.items():
            try:
                frames[name].append(camera.read(0, LONG_S + period_s))
            except FrameTimeoutError as error:
                failure = Failure(
                    f"camera '{name}': {len(sequence)} pulses make {len(sequence)} frames", f"{index} ({error})", _ROUND
                )
                raise ExpectationError(failure) from error
    rig.projector.stop()
    return frames


def _wired(rig: Rig) -> dict[str, Camera]:
    return {name: camera for name, camera in rig.cameras.items() if Trigger.HARDWARE in camera.info.triggers}


def _set(bench: RigBench) -> Rig:
    """The rig at rest, with every camera set, and settings for a capture."""
    rig = bench.rig
    settings = {name: bench.settings(name) for name in rig.cameras}
    for name, camera in rig.cameras.items():
        camera.disarm()
        camera.configure(settings[name])
    return replace(rig, settings=settings)


def _expect_left_dark(bench: RigBench, after: str) -> None:
    with bench.view(*next(bench.ways()), load=False) as view:
        view.expect_dark(f"after {after}")
