"""States: what may be asked of a device when, and that a call in the wrong state is refused."""

from __future__ import annotations

from slrig.conformance.bench import SHORT_S, STEPPED, RigBench, View, at, check, expect, refused, view_check
from slrig.devices import Trigger
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size, White
from slrig.patterns import encode

_ANOTHER_CLOCK_NS = 60 * 10**9
"""Times that lie further apart count in different clocks: a recording need not have one that runs."""

_LATE_S = 0.05  # beyond what is declared: a busy machine

_STATE = "keep the state in the driver, and check it before the device is touched"


@view_check()
def an_armed_camera_refuses_to_be_set_or_armed(view: View) -> None:
    """An armed camera refuses to be set or armed, and goes on."""
    with refused(DeviceStateError, asked="configure of an armed camera", do=_STATE):
        view.camera.configure(view.bench.settings(view.name))
    with refused(DeviceStateError, asked="arm of an armed camera", do=_STATE):
        view.camera.arm(1, view.trigger)
    view.expose(0)


@check()
def trigger_and_read_need_an_armed_camera(bench: RigBench) -> None:
    """Trigger and read need an armed camera."""
    for name, camera in bench.rig.cameras.items():
        with at(f"camera '{name}'"):
            camera.configure(bench.settings(name))
            for state in ("that was not armed", "that was disarmed"):
                with refused(DeviceStateError, asked=f"trigger of a camera {state}", do=_STATE):
                    camera.trigger()
                with refused(DeviceStateError, asked=f"read of a camera {state}", do=_STATE):
                    camera.read(0, SHORT_S)
                camera.arm(1, min(camera.info.triggers, key=(*STEPPED, Trigger.HARDWARE).index))
                if Trigger.SOFTWARE in camera.info.triggers:
                    camera.trigger()
                camera.disarm()


@check(fresh=True)
def show_needs_a_loaded_sequence(bench: RigBench) -> None:
    """Show needs a loaded sequence, and one of its patterns."""
    projector, sequence = bench.rig.projector, bench.sequence
    with at("projector"):
        with refused(DeviceStateError, asked="show before load", do=_STATE):
            projector.show(0)
        projector.load(sequence)
        for index in (-1, len(sequence)):
            with refused(
                UnsupportedByDeviceError,
                asked=f"show({index}) of a sequence with patterns 0 to {len(sequence) - 1}",
                do="compare the index with the length of the sequence",
            ):
                projector.show(index)
        projector.show(0)


@check()
def show_tells_which_pattern_is_lit_since_when(bench: RigBench) -> None:
    """Show tells which pattern is lit from when on."""
    projector = bench.rig.projector
    with at("projector"):
        projector.load(bench.sequence)
        last = None
        for index in (0, len(bench.sequence) - 1, 0):
            shown = projector.show(index)
            returned_ns = bench.rig.clock.now_ns()
            expect(
                shown.index == index and shown.t_err_ns >= 0,
                asked=f"show({index}) tells of pattern {index}, with an error of 0 ns or more",
                found=shown,
                do="return the index that was asked for",
            )
            expect(
                last is None or shown.t_visible_ns > last.t_visible_ns,
                asked=f"a pattern becomes visible after the one before it, at {last and last.t_visible_ns} ns",
                found=f"{shown.t_visible_ns} ns",
                do="return the instant of this pattern's light, on CLOCK_MONOTONIC",
            )
            allowed_ns = round((projector.info.latency_s + _LATE_S) * 1e9)
            expect(
                abs(shown.t_visible_ns - returned_ns) > _ANOTHER_CLOCK_NS
                or shown.t_visible_ns - returned_ns <= allowed_ns,
                asked=f"show returns when its light is to come within latency_s, {projector.info.latency_s:.3f} s",
                found=f"light {(shown.t_visible_ns - returned_ns) / 1e6:.3f} ms after the return",
                do="wait in show until it is known when the light comes, and declare latency_s as long as that takes",
            )
            last = shown
    for name, trigger in bench.ways():
        if trigger is not Trigger.SOFTWARE:
            continue
        with bench.view(name, trigger) as view:
            shown = view.show(0)
            frame = view.look()
            expect(
                frame.t_start_ns + frame.t_err_ns >= shown.t_visible_ns - shown.t_err_ns,
                asked=f"an exposure triggered after t_visible_ns + t_err_ns begins after {shown.t_visible_ns} ns",
                found=f"{frame.t_start_ns} ns",
                do="stamp frames and light by the same clock",
            )


@check(fresh=True)
def a_sequence_of_another_size_is_refused(bench: RigBench) -> None:
    """A sequence for a projector of another size is refused."""
    projector = bench.rig.projector
    size = projector.info.size
    with at("projector"):
        for other in (Size(size.width_px + 8, size.height_px), Size(size.width_px, size.height_px + 8)):
            with refused(
                UnsupportedByDeviceError,
                asked=f"a sequence for {other} on a projector of {size}",
                do="compare sequence.projector with the declared size in load: scaled patterns measure nothing",
            ):
                projector.load(encode((White(),), other))
        with refused(DeviceStateError, asked="show after a load that was refused", do=_STATE):
            projector.show(0)


@check(fresh=True)
def a_projector_plays_only_if_it_says_so(bench: RigBench) -> None:
    """A projector plays if it says so, and else refuses."""
    projector = bench.rig.projector
    exposure_s = max((bench.settings(name).exposure_s for name in bench.rig.cameras), default=0.01)
    with at("projector"):
        if projector.info.plays:
            with refused(DeviceStateError, asked="play before load", do=_STATE):
                projector.play(exposure_s, 2 * exposure_s)
            projector.load(bench.opening)
            projector.play(exposure_s, 2 * exposure_s)
        else:
            projector.load(bench.opening)
            with refused(
                UnsupportedByDeviceError,
                asked="play of a projector that declares plays=False",
                do="refuse in play, or declare that it plays",
            ):
                projector.play(exposure_s, 2 * exposure_s)
        projector.stop()
