"""Checks of cameras: settings, frames, and frames of an earlier pattern."""

from __future__ import annotations

import math
import time

import numpy as np

from slrig.conformance.bench import (
    ABSENT_FRAME_WAIT_S,
    MAX_FRAMES,
    ArmedCamera,
    Need,
    NotApplicableError,
    RigBench,
    camera_check,
    check,
    expect,
    expect_error,
    is_close,
    on_device,
)
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Frame, Pixels

_READ_BACK = "set the device, read it back, and return that value; declare the range that the device really accepts"
_REFUSE = "compare with the declared range, and read back: a device may change a value silently"
_EXPOSURE_RATIO = 1.6  # of two exposures, so that their light differs
_MIN_BRIGHTNESS_RATIO = 1.1  # of exposures with this ratio
_SATURATED_SHARE = 0.98  # of full scale: some sensors saturate a little below it
_MIN_PIXELS = 16

_ALTERNATIONS = 12
_IDLE_BEFORE = (4, 9)
"""Frames before which the check waits: one white, one black."""

_ON_CLOCK = "convert the device's clock to CLOCK_MONOTONIC (time.monotonic_ns), and state the error in t_err_ns"

_FAR_NS = 10**12  # a thousand seconds: later than any frame of a check
_LATE_S = 2.0  # for a busy host
_DROP_STALE = "compare each frame's t_start_ns with after_ns, and drop those that began before"


@check()
def settings_are_read_back(bench: RigBench) -> None:
    """Both ends of the declared ranges can be set, and are read back."""
    # Nothing is exposed: the longest exposure may be a minute.
    for name, camera in bench.rig.cameras.items():
        with on_device(f"camera '{name}'"):
            default = bench.settings(name)
            settings = [CameraSettings(exposure_s, default.gain) for exposure_s in camera.info.exposure_range_s]
            settings += [CameraSettings(default.exposure_s, gain) for gain in camera.info.gain_range]
            for requested in (*settings, default):
                applied = camera.configure(requested)
                expect(
                    is_close(applied.exposure_s, requested.exposure_s) and is_close(applied.gain, requested.gain),
                    expected=f"exposure {requested.exposure_s:.6g} s and gain {requested.gain:.6g} are set, within 1 %",
                    found=f"{applied.exposure_s:.6g} s and {applied.gain:.6g}",
                    remedy=_READ_BACK,
                )


@check()
def settings_out_of_range_are_refused(bench: RigBench) -> None:
    """Settings out of range are refused, and change nothing."""
    for name, camera in bench.rig.cameras.items():
        with on_device(f"camera '{name}'"):
            default = bench.settings(name)
            camera.configure(default)
            for requested in _out_of_range_settings(camera, default):
                with expect_error(
                    UnsupportedByDeviceError,
                    expected=f"exposure {requested.exposure_s:.6g} s with gain {requested.gain:.6g}, where "
                    f"{camera.info.exposure_range_s} s and {camera.info.gain_range} are declared",
                    remedy=_REFUSE,
                ):
                    camera.configure(requested)
    for name, trigger in bench.stepped_cameras():
        with bench.arm_camera(name, trigger) as armed:
            armed.camera.disarm()
            for requested in _out_of_range_settings(armed.camera, bench.settings(name)):
                with expect_error(UnsupportedByDeviceError, expected="a setting out of range", remedy=_REFUSE):
                    armed.camera.configure(requested)
            armed.camera.arm(MAX_FRAMES, trigger)
            frame = armed.expose(0)
            expect(
                is_close(frame.exposure_s, armed.applied.exposure_s) and is_close(frame.gain, armed.applied.gain),
                expected=f"after a refusal, frames are exposed as before: {armed.applied.exposure_s:.6g} s, gain "
                f"{armed.applied.gain:.6g}",
                found=f"{frame.exposure_s:.6g} s, gain {frame.gain:.6g}",
                remedy="check a value before any access to the device",
            )


@camera_check(Need.WHITE_AND_BLACK)
def a_longer_exposure_is_brighter(armed: ArmedCamera) -> None:
    """A longer exposure makes a brighter frame."""
    lit = armed.measure_reference().lit
    default = armed.bench.settings(armed.name)
    other_s = _another_exposure(armed.camera, default.exposure_s)
    if other_s is None:
        raise NotApplicableError("has one exposure, or cannot set it")
    short_s, long_s = sorted((default.exposure_s, other_s))
    images: dict[float, tuple[Pixels, Pixels]] = {}
    for exposure_s in (short_s, long_s):
        armed.camera.disarm()
        try:
            armed.camera.configure(CameraSettings(exposure_s, default.gain))
        except UnsupportedByDeviceError:
            raise NotApplicableError(f"takes certain exposures only, and not {exposure_s:.6g} s") from None
        armed.camera.arm(MAX_FRAMES, armed.trigger)
        images[exposure_s] = (armed.expose(0).image, armed.expose(1).image)
    unsaturated = lit & (images[long_s][0] < _SATURATED_SHARE * armed.camera.info.format.full_scale)
    if np.count_nonzero(unsaturated) < _MIN_PIXELS:
        raise NotApplicableError(f"is saturated by white at {long_s:.6g} s")
    short, long = (
        float(np.mean(images[each][0][unsaturated], dtype=np.float64) - np.mean(images[each][1][unsaturated]))
        for each in (short_s, long_s)
    )
    expect(
        long >= _MIN_BRIGHTNESS_RATIO * short,
        expected=f"white is brighter at {long_s:.6g} s than at {short_s:.6g} s",
        found=f"{long:.1f} and {short:.1f} DN above black",
        remedy="switch automatic exposure and gain off before setting them, and pass over the frames that were exposed "
        "before the setting took effect",
    )


def _another_exposure(camera: Camera, default_s: float) -> float | None:
    """Return a short exposure that differs clearly from the default one; None if there is none."""
    min_s, max_s = camera.info.exposure_range_s
    if min_s * _EXPOSURE_RATIO <= default_s:
        return max(min_s, default_s / 2)
    if max_s >= default_s * _EXPOSURE_RATIO:
        return min(max_s, default_s * 2)
    return None


def _out_of_range_settings(camera: Camera, default: CameraSettings) -> list[CameraSettings]:
    min_s, max_s = camera.info.exposure_range_s
    exposures_s = [min_s / 2, 0.0, -1.0, *([max_s * 2] if math.isfinite(max_s * 2) else [])]
    gains = [camera.info.gain_range[1] * 2 + 1, -1.0]
    settings = [CameraSettings(exposure_s, default.gain) for exposure_s in exposures_s]
    return settings + [CameraSettings(default.exposure_s, gain) for gain in gains]


@camera_check()
def frames_are_as_declared(armed: ArmedCamera) -> None:
    """Frames have the name, extent, type and range that the camera declares."""
    for index in range(len(armed.bench.short_sequence)):
        expect_declared_format(armed.expose(index), armed.camera.info)


@camera_check()
def frames_tell_their_exposure(armed: ArmedCamera) -> None:
    """Frames state the exposure and gain that were set, and lasted as long."""
    for index in range(len(armed.bench.short_sequence)):
        expect_applied_settings(armed.expose(index), armed.applied)


@camera_check()
def frame_numbers_and_times_rise(armed: ArmedCamera) -> None:
    """Frame numbers and times only rise."""
    last = armed.expose(0)
    for index in range(6):
        frame = armed.expose(index % len(armed.bench.sequence))
        expect(
            frame.sequence_number > last.sequence_number,
            expected=f"a frame number is above {last.sequence_number}, that of the frame before",
            found=frame.sequence_number,
            remedy="count every frame of the sensor, unroll the device's counter, and return none twice",
        )
        expect(
            frame.t_start_ns + frame.t_err_ns >= last.t_end_ns - last.t_err_ns,
            expected=f"a frame begins after the end of the one before, {last.t_end_ns} ± {last.t_err_ns} ns",
            found=f"{frame.t_start_ns} ± {frame.t_err_ns} ns",
            remedy="take time stamps from the device, and return each frame once",
        )
        expect(
            frame.dropped_count >= last.dropped_count >= 0,
            expected=f"dropped_count goes on from {last.dropped_count} while the camera is armed",
            found=frame.dropped_count,
            remedy="count lost and corrupt frames since arm",
        )
        last = frame


@camera_check()
def frame_times_lie_on_the_projectors_clock(armed: ArmedCamera) -> None:
    """Times of frames are on the projector's clock."""
    before = armed.show(0)
    for index in (1, 0, 1):
        armed.start()
        frame = armed.read(armed.stable_ns(before))
        expect(frame.t_err_ns >= 0, expected="t_err_ns is 0 or more", found=frame.t_err_ns, remedy=_ON_CLOCK)
        after = armed.show(index % len(armed.bench.sequence))
        expect(
            frame.t_start_ns >= armed.stable_ns(before),
            expected=f"a frame read after {armed.stable_ns(before)} ns begins after that",
            found=f"{frame.t_start_ns} ns",
            remedy=_ON_CLOCK,
        )
        expect(
            frame.t_end_ns - frame.t_err_ns <= armed.stable_ns(after),
            expected=f"a frame that was in hand before a pattern lit at {after.t_visible_ns} ns ended before that",
            found=f"{frame.t_end_ns} ± {frame.t_err_ns} ns",
            remedy=_ON_CLOCK,
        )
        before = after


@camera_check(Need.WHITE_AND_BLACK, every=True)
def a_frame_lies_wholly_in_its_pattern(armed: ArmedCamera) -> None:
    """Every frame shows its pattern and no other's light, at once and after a pause."""
    armed.measure_reference()
    for number in range(_ALTERNATIONS):
        index = number % 2
        if number in _IDLE_BEFORE:
            armed.show(1 - index)
            armed.fill_buffers()
        armed.expect_level(
            armed.expose(index),
            index,
            expected="a frame that was read after a pattern became visible shows only that pattern",
            remedy="read returns frames whose whole exposure, all rows, lies after after_ns; show returns the instant "
            "from which its light is on the scene",
        )


@camera_check(Need.WHITE_AND_BLACK)
def a_frame_keeps_its_pixels(armed: ArmedCamera) -> None:
    """A frame keeps its pixels when the next ones arrive."""
    frame = armed.expose(0)
    copied = frame.image.copy()
    for _ in range(8):
        armed.expose(1)
    changed = int(np.count_nonzero(frame.image != copied))
    expect(
        changed == 0,
        expected="a frame's image is its own after eight more frames",
        found=f"{changed} of {copied.size} pixels changed",
        remedy="copy the image out of the driver's buffer before the buffer is used again",
    )


@camera_check(Need.WHITE_AND_BLACK)
def frames_come_in_colour_where_it_is_declared(armed: ArmedCamera) -> None:
    """A camera that declares colour gives the same picture in blue, green and red, and another gives none."""
    lit = armed.measure_reference().lit
    info, frames = armed.camera.info, [armed.expose(index) for index in (0, 1)]
    expect(
        all((frame.colour is not None) == info.colour for frame in frames),
        expected=f"CameraInfo.colour is {info.colour}, and frames have a function that makes their colour, or none",
        found=[frame.colour for frame in frames],
        remedy="declare what frames have",
    )
    if not info.colour:
        raise NotApplicableError("has no colour")
    for _ in range(8):
        armed.expose(1)
    white, black = (frame.colour() for frame in frames if frame.colour is not None)
    expected = ((*frames[0].image.shape, 3), frames[0].image.dtype)
    expect(
        (white.shape, white.dtype) == expected and white.max() <= info.format.full_scale,
        expected=f"colour is {expected[0]} {expected[1]}, up to {info.format.full_scale}",
        found=f"{white.shape} {white.dtype}, up to {white.max()}",
        remedy="return blue, green and red along the last axis, in the units of the image",
    )
    brighter = white[lit].mean(axis=0) - black[lit].mean(axis=0)
    expect(
        brighter.max() > 0 and brighter.min() >= -0.1 * brighter.max(),
        expected="eight frames later, white is still brighter than black in colour, too",
        found=f"by {', '.join(f'{each:.1f}' for each in brighter)} DN of blue, green and red",
        remedy="make colour of a copy of what the camera sent, not of the driver's buffer",
    )


def expect_declared_format(frame: Frame, info: CameraInfo) -> None:
    """Expect that a frame has the format that its camera declares. Raises ExpectationError."""
    declared = info.format
    dtype = np.dtype(np.uint8 if declared.bit_depth <= 8 else np.uint16)
    expect(
        frame.camera == info.name,
        expected=f"a frame names its camera '{info.name}'",
        found=f"'{frame.camera}'",
        remedy="use the name that the factory is given",
    )
    expect(
        frame.image.shape == declared.size.shape,
        expected=f"a frame of a camera of {declared.size} has {declared.size.shape} rows and columns",
        found=frame.image.shape,
        remedy="declare the extent that the device delivers, as Size(width_px, height_px)",
    )
    expect(
        frame.image.dtype == dtype,
        expected=f"{declared.bit_depth} bits come as {dtype}",
        found=frame.image.dtype,
        remedy="unpack the samples, or declare their bit depth",
    )
    expect(
        frame.image.max() <= declared.full_scale,
        expected=f"no sample is above {declared.full_scale}, the full scale of {declared.bit_depth} bits",
        found=int(frame.image.max()),
        remedy="align samples to the right, or declare their bit depth",
    )


def expect_applied_settings(frame: Frame, applied: AppliedSettings) -> None:
    """Expect that a frame was exposed with the applied settings. Raises ExpectationError."""
    for name, actual, requested in (
        ("exposure_s", frame.exposure_s, applied.exposure_s),
        ("gain", frame.gain, applied.gain),
    ):
        expect(
            is_close(actual, requested),
            expected=f"a frame's {name} is {requested:.6g}, which configure returned",
            found=f"{actual:.6g}",
            remedy="switch automatic control off, read settings back, and skip earlier frames",
        )
    duration_s = (frame.t_end_ns - frame.t_start_ns + 2 * frame.t_err_ns) / 1e9
    exposed_s = frame.exposure_s + frame.shutter_skew_s
    expect(
        np.isnan(exposed_s) or duration_s >= 0.99 * exposed_s,
        expected=f"t_start_ns to t_end_ns spans exposure and shutter skew, {exposed_s:.6g} s",
        found=f"{duration_s:.6g} s, with what t_err_ns allows",
        remedy="t_start_ns is when the first row begins, t_end_ns when the last row ends",
    )


@camera_check(Need.WHITE_AND_BLACK, every=True)
def read_passes_over_stale_frames(armed: ArmedCamera) -> None:
    """A frame of an earlier pattern is skipped."""
    armed.measure_reference()
    for index in (1, 0):
        earlier = armed.show(1 - index)
        if armed.trigger is Trigger.SOFTWARE:
            armed.start()
        else:
            armed.read(armed.stable_ns(earlier))
            armed.fill_buffers()
        after_ns = armed.stable_ns(armed.show(index))
        armed.start()
        frame = armed.read(after_ns)
        expected = "while a frame of another pattern waits, read(after_ns) returns one that began after after_ns"
        expect(
            frame.t_start_ns >= after_ns,
            expected=expected,
            found=f"one that began {(after_ns - frame.t_start_ns) / 1e6:.3f} ms before",
            remedy=_DROP_STALE,
        )
        armed.expect_level(frame, index, expected=expected, remedy=_DROP_STALE)


@camera_check(every=True)
def stale_frames_never_come_back(armed: ArmedCamera) -> None:
    """A skipped frame never comes back."""
    start_ns = armed.bench.rig.clock.now_ns()
    first = armed.expose(0)
    duration_s = (armed.bench.rig.clock.now_ns() - start_ns) / 1e9
    armed.start()
    # Long enough for a triggered frame to reach a busy host: a frame that arrives after the time-out was not skipped.
    waiting_s = min(max(10 * duration_s, 0.2), duration_s + _LATE_S)
    with expect_error(
        FrameTimeoutError,
        expected="a read of frames that begin a thousand seconds from now",
        remedy="wait until the time-out, then raise",
    ):
        armed.camera.read(first.t_end_ns + _FAR_NS, waiting_s)
    if armed.trigger is Trigger.SOFTWARE:
        with expect_error(FrameTimeoutError, expected="a read of a frame that was skipped before", remedy=_DROP_STALE):
            armed.camera.read(0, ABSENT_FRAME_WAIT_S)
    else:
        frame = armed.read(0)
        # Frames that arrived after the time-out were not skipped.
        skipped_ns = first.t_end_ns + round(waiting_s / 2 * 1e9)
        expect(
            frame.t_end_ns >= skipped_ns and frame.sequence_number > first.sequence_number,
            expected=f"after a read that timed out, the next frame ends after {skipped_ns} ns",
            found=f"number {frame.sequence_number}, ended at {frame.t_end_ns} ns",
            remedy=_DROP_STALE,
        )
    armed.expose(0)


@camera_check(every=True)
def read_times_out_in_time(armed: ArmedCamera) -> None:
    """A read of a frame that does not come ends in time."""
    shown = armed.show(0)
    after_ns = 0 if armed.trigger is Trigger.SOFTWARE else armed.stable_ns(shown) + _FAR_NS
    _expect_timeout(armed.camera, after_ns, expected="a read of a frame that cannot come")


@check(Need.FREE)
def a_free_running_camera_needs_no_trigger(bench: RigBench) -> None:
    """A free-running camera gives frames without a trigger, and refuses one."""
    for name, camera in bench.rig.cameras.items():
        if Trigger.FREE not in camera.info.triggers:
            continue
        with bench.arm_camera(name, Trigger.FREE) as armed:
            _expect_trigger_refused(armed.camera, "a software trigger of a camera that is armed to run freely")
            first, second = armed.expose(0), armed.expose(0)
            expect(
                second.sequence_number > first.sequence_number,
                expected="frames follow one another by themselves",
                found=f"numbers {first.sequence_number} and {second.sequence_number}",
                remedy="start the stream in arm",
            )


@check(Need.HARDWARE)
def a_wire_without_pulses_gives_no_frame(bench: RigBench) -> None:
    """A camera armed for wire triggers makes no frame without a pulse."""
    for name, camera in bench.rig.cameras.items():
        if Trigger.HARDWARE not in camera.info.triggers:
            continue
        with on_device(f"camera '{name}', {Trigger.HARDWARE} trigger"):
            camera.configure(bench.settings(name))
            camera.arm(4, Trigger.HARDWARE)
            _expect_trigger_refused(camera, "a software trigger of a camera that is armed for wire triggers")
            _expect_timeout(camera, 0, expected="a read while the projector does not play")
            camera.disarm()


@camera_check(Need.WHITE_AND_BLACK, every=True)
def arming_again_starts_afresh(armed: ArmedCamera) -> None:
    """Arming again discards earlier frames."""
    armed.measure_reference()
    shown = armed.show(0)
    armed.start()
    if armed.trigger is Trigger.FREE:
        armed.read(armed.stable_ns(shown))
        armed.fill_buffers()
    armed.camera.disarm()
    armed.show(1)
    armed.camera.arm(MAX_FRAMES, armed.trigger)
    _expect_new_frame(armed)


def _expect_new_frame(armed: ArmedCamera) -> None:
    remedy = "discard waiting frames, in disarm or in arm"
    if armed.trigger is Trigger.SOFTWARE:
        with expect_error(
            FrameTimeoutError,
            expected="a read of a frame that was triggered before the camera was armed",
            remedy=remedy,
        ):
            armed.camera.read(0, ABSENT_FRAME_WAIT_S)
        frame = armed.expose(1)
        expect(
            frame.dropped_count == 0,
            expected="dropped_count begins again with 0 when a camera is armed",
            found=frame.dropped_count,
            remedy="count from arm on",
        )
        return
    # Black was shown before it was armed again: a white frame is an old one.
    armed.expect_level(
        armed.read(0), 1, expected="the first frame after arming again was exposed after it", remedy=remedy
    )


def _expect_trigger_refused(camera: Camera, expected: str) -> None:
    with expect_error(DeviceStateError, expected=expected, remedy="check in trigger what the camera was armed for"):
        camera.trigger()


def _expect_timeout(camera: Camera, after_ns: int, *, expected: str) -> None:
    start_s = time.monotonic()
    with expect_error(
        FrameTimeoutError, expected=expected, remedy="raise once timeout_s has passed, and return no frame instead"
    ):
        camera.read(after_ns, ABSENT_FRAME_WAIT_S)
    duration_s = time.monotonic() - start_s
    expect(
        duration_s <= ABSENT_FRAME_WAIT_S + _LATE_S,
        expected=f"a read with timeout_s {ABSENT_FRAME_WAIT_S} returns after that",
        found=f"{duration_s:.2f} s",
        remedy="bound every wait for the device by what is left of timeout_s",
    )
