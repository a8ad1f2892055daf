"""Checks of devices: their declarations, and the calls that each state allows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager

from slrig.conformance.bench import (
    ABSENT_FRAME_WAIT_S,
    STEPPED_TRIGGERS,
    ArmedCamera,
    RigBench,
    camera_check,
    check,
    expect,
    expect_error,
    on_device,
)
from slrig.devices import Camera, Projector, ScannerHead, Trigger
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size, White
from slrig.patterns import encode

_INFO = "read the device once, when it is opened, and keep info in the driver's memory"

_ANOTHER_CLOCK_NS = 60 * 10**9
"""Times that are further apart are from different clocks: a recording may have one that does not advance."""

_LATE_S = 0.05  # in addition to the declared latency, for a busy machine

_STATE = "keep the state in the driver, and check it before any access to the device"


@check()
def devices_implement_the_protocols(bench: RigBench) -> None:
    """The devices have every method of their protocol, and the cameras their names."""
    rig = bench.rig
    expect(
        rig.cameras,
        expected="a rig has a camera",
        found="none",
        remedy="add a [[camera]] table to the rig file, or return the head's cameras",
    )
    parts: list[tuple[str, object, type]] = [("projector", rig.projector, Projector)]
    parts += [(f"camera '{name}'", camera, Camera) for name, camera in rig.cameras.items()]
    if rig.head is not None:
        parts.append(("head", rig.head, ScannerHead))
        heads = sorted(rig.head.cameras)
        expect(
            heads == sorted(rig.cameras),
            expected="a head's cameras are those of the rig",
            found=f"{heads} and {sorted(rig.cameras)}",
            remedy="return the same cameras every time",
        )
        expect(
            rig.head.projector.info == rig.projector.info,
            expected="a head's projector is that of the rig",
            found=rig.head.projector.info,
            remedy="return the same projector every time",
        )
    for label, device, protocol in parts:
        missing = [name for name in vars(protocol) if not name.startswith("_") and not hasattr(device, name)]
        expect(
            isinstance(device, protocol),
            expected=f"{label} implements slrig.devices.{protocol.__name__}",
            found=f"{type(device).__name__} without {', '.join(missing) or 'its methods'}",
            remedy="write the missing methods",
        )
    for name, camera in rig.cameras.items():
        expect(
            camera.info.name == name,
            expected=f"camera '{name}' declares the name that it was opened under",
            found=f"'{camera.info.name}'",
            remedy="put the name that the factory is given into CameraInfo",
        )


@check(fresh=True)
def info_is_readable_in_every_state(bench: RigBench) -> None:
    """The info of a device can be read in every state, and does not change."""
    rig = bench.rig
    devices: dict[str, Camera | Projector] = {"projector": rig.projector}
    devices |= {f"camera '{name}'": camera for name, camera in rig.cameras.items()}
    before = {label: device.info for label, device in devices.items()}

    def expect_unchanged(state: str) -> None:
        for label, device in devices.items():
            with on_device(label):
                info = device.info
                expect(
                    info == before[label],
                    expected=f"info {state} is {before[label]}, as after opening",
                    found=info,
                    remedy=_INFO,
                )

    rig.projector.load(bench.short_sequence)
    for name, camera in rig.cameras.items():
        camera.configure(bench.settings(name))
        camera.arm(1, min(camera.info.triggers))
    rig.projector.show(0)
    expect_unchanged("of an armed camera and a projector that shows")
    bench.set_to_rest()
    expect_unchanged("after disarm and blank")
    bench.close()
    expect_unchanged("after close")


@check()
def declared_ranges_are_sound(bench: RigBench) -> None:
    """The declared ranges make sense."""
    for name, camera in bench.rig.cameras.items():
        with on_device(f"camera '{name}'"):
            info = camera.info
            min_s, max_s = info.exposure_range_s
            expect(
                0 < min_s <= max_s < math.inf,
                expected="exposure_range_s is (shortest, longest), both above 0 s and finite",
                found=info.exposure_range_s,
                remedy="ask the device for its limits",
            )
            min_gain, max_gain = info.gain_range
            expect(
                0 <= min_gain <= max_gain < math.inf,
                expected="gain_range is (least, most), a factor each, finite",
                found=info.gain_range,
                remedy="ask the device for its limits; (1, 1) if its gain is fixed",
            )
            expect(
                info.triggers and all(isinstance(trigger, Trigger) for trigger in info.triggers),
                expected="triggers names one way to start an exposure, or more",
                found=info.triggers,
                remedy="declare slrig.devices.Trigger members",
            )
    projector = bench.rig.projector.info
    expect(
        0 <= projector.latency_s < math.inf,
        expected="the projector's latency_s is 0 s or more, and finite",
        found=projector.latency_s,
        remedy="declare the typical time from show to light; 0.05 for a display that was not measured",
    )


@check()
def calibration_and_truth_fit_the_devices(bench: RigBench) -> None:
    """A calibration or truth of the rig fits its devices."""
    rig = bench.rig
    sizes = {name: camera.info.format.size for name, camera in rig.cameras.items()}
    calibrations = {"rig": rig.calibration, "head": None if rig.head is None else rig.head.calibration}
    for owner, calibration in calibrations.items():
        if calibration is None:
            continue
        sizes_of_calibration = {name: pinhole.size for name, pinhole in calibration.cameras.items()}
        expect(
            sizes_of_calibration == sizes,
            expected=f"the {owner}'s calibration is for {_list_sizes(sizes)}",
            found=_list_sizes(sizes_of_calibration),
            remedy="calibrate at the extent that the cameras deliver",
        )
        projector = calibration.projector
        expect(
            projector is None or projector.size == rig.projector.info.size,
            expected=f"the {owner}'s calibration is for a projector of {rig.projector.info.size}",
            found=None if projector is None else projector.size,
            remedy="calibrate with this projector",
        )
    truth = rig.truth()
    if truth is not None:
        shapes = {name: camera.depth_mm.shape for name, camera in truth.cameras.items()}
        expect(
            shapes == {name: size.shape for name, size in sizes.items()},
            expected=f"the truth is for {_list_sizes(sizes)}",
            found=shapes,
            remedy="render the truth at the extent of the cameras",
        )


@check()
def triggers_that_are_not_declared_are_refused(bench: RigBench) -> None:
    """Undeclared triggers are refused, and so are zero frames."""
    for name, camera in bench.rig.cameras.items():
        with on_device(f"camera '{name}'"):
            camera.configure(bench.settings(name))
            for trigger in sorted(set(Trigger) - camera.info.triggers):
                with _expect_arm_refused(camera, 1, trigger):
                    camera.arm(1, trigger)
            trigger = min(camera.info.triggers)
            for count in (0, -1):
                with _expect_arm_refused(camera, count, trigger):
                    camera.arm(count, trigger)


def _expect_arm_refused(camera: Camera, count: int, trigger: Trigger) -> AbstractContextManager[None]:
    offered = ", ".join(sorted(camera.info.triggers))
    return expect_error(
        UnsupportedByDeviceError,
        expected=f"arm({count}, {trigger}) of a camera that declares {offered}",
        remedy="check count ≥ 1 and the trigger in arm, before the device is touched",
    )


def _list_sizes(sizes: Mapping[str, Size]) -> str:
    return ", ".join(f"'{name}' {size}" for name, size in sorted(sizes.items())) or "no camera"


@camera_check()
def an_armed_camera_refuses_to_be_set_or_armed(armed: ArmedCamera) -> None:
    """An armed camera refuses to be set or armed, and goes on."""
    with expect_error(DeviceStateError, expected="configure of an armed camera", remedy=_STATE):
        armed.camera.configure(armed.bench.settings(armed.name))
    with expect_error(DeviceStateError, expected="arm of an armed camera", remedy=_STATE):
        armed.camera.arm(1, armed.trigger)
    armed.expose(0)


@check()
def trigger_and_read_need_an_armed_camera(bench: RigBench) -> None:
    """Trigger and read need an armed camera."""
    for name, camera in bench.rig.cameras.items():
        with on_device(f"camera '{name}'"):
            camera.configure(bench.settings(name))
            for state in ("that was not armed", "that was disarmed"):
                with expect_error(DeviceStateError, expected=f"trigger of a camera {state}", remedy=_STATE):
                    camera.trigger()
                with expect_error(DeviceStateError, expected=f"read of a camera {state}", remedy=_STATE):
                    camera.read(0, ABSENT_FRAME_WAIT_S)
                camera.arm(1, min(camera.info.triggers, key=(*STEPPED_TRIGGERS, Trigger.HARDWARE).index))
                if Trigger.SOFTWARE in camera.info.triggers:
                    camera.trigger()
                camera.disarm()


@check(fresh=True)
def show_needs_a_loaded_sequence(bench: RigBench) -> None:
    """Show needs a loaded sequence, and one of its patterns."""
    projector, sequence = bench.rig.projector, bench.sequence
    with on_device("projector"):
        with expect_error(DeviceStateError, expected="show before load", remedy=_STATE):
            projector.show(0)
        projector.load(sequence)
        for index in (-1, len(sequence)):
            with expect_error(
                UnsupportedByDeviceError,
                expected=f"show({index}) of a sequence with patterns 0 to {len(sequence) - 1}",
                remedy="compare the index with the length of the sequence",
            ):
                projector.show(index)
        projector.show(0)


@check()
def show_tells_which_pattern_is_lit_since_when(bench: RigBench) -> None:
    """Show returns which pattern is lit, and from when on."""
    projector = bench.rig.projector
    with on_device("projector"):
        projector.load(bench.sequence)
        last = None
        for index in (0, len(bench.sequence) - 1, 0):
            shown = projector.show(index)
            returned_ns = bench.rig.clock.now_ns()
            expect(
                shown.index == index and shown.t_err_ns >= 0,
                expected=f"show({index}) returns pattern {index}, with an error of 0 ns or more",
                found=shown,
                remedy="return the requested index",
            )
            expect(
                last is None or shown.t_visible_ns > last.t_visible_ns,
                expected=f"a pattern becomes visible after the one before it, at {last and last.t_visible_ns} ns",
                found=f"{shown.t_visible_ns} ns",
                remedy="return the instant of this pattern's light, on CLOCK_MONOTONIC",
            )
            allowed_ns = round((projector.info.latency_s + _LATE_S) * 1e9)
            expect(
                abs(shown.t_visible_ns - returned_ns) > _ANOTHER_CLOCK_NS
                or shown.t_visible_ns - returned_ns <= allowed_ns,
                expected=f"show returns at most latency_s, {projector.info.latency_s:.3f} s, before its light",
                found=f"light {(shown.t_visible_ns - returned_ns) / 1e6:.3f} ms after the return",
                remedy="wait in show until the instant of the light is known, and declare a latency_s of that length",
            )
            last = shown
    for name, trigger in bench.stepped_cameras():
        if trigger is not Trigger.SOFTWARE:
            continue
        with bench.arm_camera(name, trigger) as armed:
            shown = armed.show(0)
            frame = armed.capture_current()
            expect(
                frame.t_start_ns + frame.t_err_ns >= shown.t_visible_ns - shown.t_err_ns,
                expected=f"an exposure triggered after t_visible_ns + t_err_ns begins after {shown.t_visible_ns} ns",
                found=f"{frame.t_start_ns} ns",
                remedy="stamp frames and light with the same clock",
            )


@check(fresh=True)
def a_sequence_of_another_size_is_refused(bench: RigBench) -> None:
    """A sequence for a projector of another size is refused."""
    projector = bench.rig.projector
    size = projector.info.size
    with on_device("projector"):
        for other in (Size(size.width_px + 8, size.height_px), Size(size.width_px, size.height_px + 8)):
            with expect_error(
                UnsupportedByDeviceError,
                expected=f"a sequence for {other} on a projector of {size}",
                remedy="compare sequence.projector with the declared size in load: scaled patterns measure nothing",
            ):
                projector.load(encode((White(),), other))
        with expect_error(DeviceStateError, expected="show after a load that was refused", remedy=_STATE):
            projector.show(0)


@check(fresh=True)
def a_projector_plays_only_if_it_says_so(bench: RigBench) -> None:
    """A projector plays if it declares that, and otherwise refuses."""
    projector = bench.rig.projector
    exposure_s = max((bench.settings(name).exposure_s for name in bench.rig.cameras), default=0.01)
    with on_device("projector"):
        if projector.info.plays:
            with expect_error(DeviceStateError, expected="play before load", remedy=_STATE):
                projector.play(exposure_s, 2 * exposure_s)
            projector.load(bench.short_sequence)
            projector.play(exposure_s, 2 * exposure_s)
        else:
            projector.load(bench.short_sequence)
            with expect_error(
                UnsupportedByDeviceError,
                expected="play of a projector that declares plays=False",
                remedy="refuse in play, or declare that it plays",
            ):
                projector.play(exposure_s, 2 * exposure_s)
        projector.stop()
