"""Freshness: frames from before are passed over and never come back, and what is not there is not waited for long."""

from __future__ import annotations

import time

from slrig.conformance.bench import FRAMES, SHORT_S, Need, RigBench, View, at, check, expect, refused, view_check
from slrig.devices import Camera, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError

_FAR_NS = 10**12  # a thousand seconds: further than any frame of a check
_LATE_S = 2.0  # of a host with other work
_DROP_STALE = "compare each frame's t_start_ns with after_ns, and drop those that began before"


@view_check(Need.WHITE_AND_BLACK, every=True)
def read_passes_over_stale_frames(view: View) -> None:
    """A frame of an earlier pattern is passed over."""
    view.learn()
    for index in (1, 0):
        earlier = view.show(1 - index)
        if view.trigger is Trigger.SOFTWARE:
            view.start()
        else:
            view.read(view.stable_ns(earlier))
            view.let_frames_pile_up()
        after_ns = view.stable_ns(view.show(index))
        view.start()
        frame = view.read(after_ns)
        asked = "with a frame of another pattern waiting, read(after_ns) returns one that began after after_ns"
        expect(
            frame.t_start_ns >= after_ns,
            asked=asked,
            found=f"one that began {(after_ns - frame.t_start_ns) / 1e6:.3f} ms before",
            do=_DROP_STALE,
        )
        view.expect_level(frame, index, asked=asked, do=_DROP_STALE)


@view_check(every=True)
def stale_frames_never_come_back(view: View) -> None:
    """A frame that was passed over never comes back."""
    begun_ns = view.bench.rig.clock.now_ns()
    first = view.expose(0)
    took_s = (view.bench.rig.clock.now_ns() - begun_ns) / 1e9
    view.start()
    # Long enough for a triggered frame to be on the host's side, on a busy host as well: one that is still on its way
    # when the time runs out was not passed over.
    waited_s = min(max(10 * took_s, 0.2), took_s + _LATE_S)
    with refused(
        FrameTimeoutError,
        asked="a read of frames that begin a thousand seconds from now",
        do="wait until the time-out, then raise",
    ):
        view.camera.read(first.t_end_ns + _FAR_NS, waited_s)
    if view.trigger is Trigger.SOFTWARE:
        with refused(FrameTimeoutError, asked="a read of what was passed over before", do=_DROP_STALE):
            view.camera.read(0, SHORT_S)
    else:
        frame = view.read(0)
        # Those on their way to the host when the time ran out were not passed over.
        passed_ns = first.t_end_ns + round(waited_s / 2 * 1e9)
        expect(
            frame.t_end_ns >= passed_ns and frame.sequence_number > first.sequence_number,
            asked=f"after a read that timed out, the next frame ends after {passed_ns} ns",
            found=f"number {frame.sequence_number}, ended at {frame.t_end_ns} ns",
            do=_DROP_STALE,
        )
    view.expose(0)


@view_check(every=True)
def read_times_out_in_time(view: View) -> None:
    """A frame that does not come is given up in time."""
    shown = view.show(0)
    after_ns = 0 if view.trigger is Trigger.SOFTWARE else view.stable_ns(shown) + _FAR_NS
    _given_up(view.camera, after_ns, asked="a read of a frame that cannot come")


@check(Need.FREE)
def a_free_running_camera_needs_no_trigger(bench: RigBench) -> None:
    """A free-running camera gives frames without a trigger, and refuses one."""
    for name, camera in bench.rig.cameras.items():
        if Trigger.FREE not in camera.info.triggers:
            continue
        with bench.view(name, Trigger.FREE) as view:
            _trigger_refused(view.camera, "a software trigger of a camera that is armed to run freely")
            first, second = view.expose(0), view.expose(0)
            expect(
                second.sequence_number > first.sequence_number,
                asked="frames follow one another by themselves",
                found=f"numbers {first.sequence_number} and {second.sequence_number}",
                do="start the stream in arm",
            )


@check(Need.HARDWARE)
def a_wire_without_pulses_gives_no_frame(bench: RigBench) -> None:
    """A camera armed for wire triggers makes no frame without a pulse."""
    for name, camera in bench.rig.cameras.items():
        if Trigger.HARDWARE not in camera.info.triggers:
            continue
        with at(f"camera '{name}', {Trigger.HARDWARE} trigger"):
            camera.configure(bench.settings(name))
            camera.arm(4, Trigger.HARDWARE)
            _trigger_refused(camera, "a software trigger of a camera that is armed for wire triggers")
            _given_up(camera, 0, asked="a read while the projector does not play")
            camera.disarm()


@view_check(Need.WHITE_AND_BLACK, every=True)
def arming_again_starts_afresh(view: View) -> None:
    """Arming again forgets what was before."""
    view.learn()
    shown = view.show(0)
    view.start()
    if view.trigger is Trigger.FREE:
        view.read(view.stable_ns(shown))
        view.let_frames_pile_up()
    view.camera.disarm()
    view.show(1)
    view.camera.arm(FRAMES, view.trigger)
    _first_frame_is_new(view)


def _first_frame_is_new(view: View) -> None:
    do = "throw away what is waiting, in disarm or in arm"
    if view.trigger is Trigger.SOFTWARE:
        with refused(
            FrameTimeoutError, asked="a read of a frame that was triggered before the camera was armed", do=do
        ):
            view.camera.read(0, SHORT_S)
        frame = view.expose(1)
        expect(
            frame.dropped_count == 0,
            asked="dropped_count begins again with 0 when a camera is armed",
            found=frame.dropped_count,
            do="count from arm on",
        )
        return
    # Black was shown before it was armed again: a white frame comes from the time before.
    view.expect_level(view.read(0), 1, asked="the first frame after arming again was exposed after it", do=do)


def _trigger_refused(camera: Camera, asked: str) -> None:
    with refused(DeviceStateError, asked=asked, do="check in trigger what the camera was armed for"):
        camera.trigger()


def _given_up(camera: Camera, after_ns: int, *, asked: str) -> None:
    begun_s = time.monotonic()
    with refused(FrameTimeoutError, asked=asked, do="raise once timeout_s has passed, and return no frame instead"):
        camera.read(after_ns, SHORT_S)
    took_s = time.monotonic() - begun_s
    expect(
        took_s <= SHORT_S + _LATE_S,
        asked=f"a read with timeout_s {SHORT_S} returns after that",
        found=f"{took_s:.2f} s",
        do="bound every wait for the device by what is left of timeout_s",
    )
