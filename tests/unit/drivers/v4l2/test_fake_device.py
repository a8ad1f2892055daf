"""The driver on a fake video device of the kernel: what is asked, what is given, and every way in which it can fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slrig.devices import Camera, CameraSettings, Trigger
from slrig.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import Pixels
from tests.contract.stage import Stage
from tests.contract.v4l2_bench import CAMERA, CONTROLS, Faked, FakeDevice, staged, usb_camera
from tests.contract.v4l2_sensor import GAIN_UNITS
from tests.unit.capture.fake_rig import Scene

pytestmark = pytest.mark.slow

Plug = Callable[..., FakeDevice]
WHITE: Pixels = np.full((1, 1), 255, np.uint8)
SIZES = [(CAMERA.width_px, CAMERA.height_px)]
FAST = {"frame_rate_hz": 200, "gain_unity": GAIN_UNITS}
# While nobody reads, all buffers fill up, and what is made then is no loss: on a busy machine a reader needs more time.
UNHURRIED: dict[str, Any] = {"frame_rate_hz": 50}


def without(*names: str) -> tuple[dict[str, object], ...]:
    return tuple(control for control in CONTROLS if control["name"] not in names)


def armed(device: FakeDevice, settings: CameraSettings | None = None, **options: object) -> Camera:
    camera = device.open_camera(**{**FAST, **options})
    camera.configure(settings or CameraSettings(0.002, 1.0))
    camera.arm(10, Trigger.FREE)
    return camera


# ---- what is asked, and what is given


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pixel_format": "MJPG"}, "asked MJPG 80 x 60, driver gives YUYV 80 x 60; it offers YUYV, Y10"),
        ({"pixel_format": "Y10", "size_px": [1280, 720]}, "asked Y10 1280 x 720, driver gives Y10 80 x 60"),
        ({"frame_rate_hz": 60.0}, "asked 60 frames per second, driver gives 50"),
        ({"bit_depth": 9}, "Y10 has 10 bits"),
        ({"controls": {"brightness": 3, "gama": 1}}, "control 'gama', the device has: auto_exposure, backlight"),
        ({"device": "/dev/null"}, "no video device"),
    ],
)
def test_what_the_driver_gives_otherwise_is_refused(plugged: Plug, options: dict[str, object], words: str) -> None:
    device = plugged(Faked(formats={"YUYV": SIZES, "Y10 ": SIZES}))
    with pytest.raises(UnsupportedByDeviceError, match=words):
        device.open_camera(**options)
    # What was refused holds nothing.
    device.open_camera().close()


def test_a_control_that_takes_another_value_is_refused(plugged: Plug) -> None:
    stubborn = [
        {**known, "insists_on": 100} if known["name"] == "Exposure Time, Absolute" else known for known in CONTROLS
    ]
    camera = plugged(Faked(controls=tuple(stubborn))).open_camera(**FAST)
    assert camera.configure(CameraSettings(0.01)).exposure_s == pytest.approx(0.01)
    with pytest.raises(UnsupportedByDeviceError, match="asked exposure_time_absolute = 20, driver gives 100"):
        camera.configure(CameraSettings(0.002))
    camera.close()


def test_settings_are_rounded_to_the_devices_steps_and_told(plugged: Plug) -> None:
    camera = plugged().open_camera(**FAST)
    assert camera.info.exposure_range_s == pytest.approx((1e-4, 0.04))
    assert camera.info.gain_range == (1.0, 8.0)
    applied = camera.configure(CameraSettings(1 / 300, 1.52))
    assert applied.exposure_s == pytest.approx(0.0033)
    assert applied.gain == 1.5
    for refused in (CameraSettings(0.05), CameraSettings(5e-5), CameraSettings(0.01, 9.0), CameraSettings(0.01, 0.5)):
        with pytest.raises(UnsupportedByDeviceError, match=", it takes"):
            camera.configure(refused)
    camera.close()


def test_the_best_format_and_the_largest_size_are_taken_unasked(plugged: Plug) -> None:
    device = plugged(
        Faked(formats={"MJPG": [(160, 120)], "YUYV": [(160, 120)], "Y10 ": [(40, 30), (80, 60), (20, 15)]})
    )
    camera = device.open_camera()
    assert (camera.info.format.bit_depth, camera.info.format.size) == (10, CAMERA)
    camera.close()


def test_a_device_without_controls_exposes_for_a_frame_period(plugged: Plug) -> None:
    device = plugged(Faked(controls=(), stamp="first packet"))
    camera = device.open_camera(frame_rate_hz=50)
    assert camera.info.exposure_range_s == pytest.approx((0.02, 0.02))
    assert camera.info.gain_range == pytest.approx((1.0, 1.0))
    applied = camera.configure(CameraSettings(0.02))
    camera.arm(1, Trigger.FREE)
    now_ns = time.monotonic_ns()
    frame = camera.read(now_ns, 2)
    assert frame.exposure_s == applied.exposure_s == pytest.approx(0.02)
    assert frame.t_start_ns - frame.t_err_ns >= now_ns
    camera.close()


def test_a_device_that_does_not_tell_its_frame_rate_is_asked_of_the_person(plugged: Plug) -> None:
    device = plugged(Faked(tells_rate=False))
    with pytest.raises(UnsupportedByDeviceError, match="write frame_rate_hz"):
        device.open_camera()
    camera = armed(device, frame_rate_hz=150)
    # It runs at 50, whatever was said: the period is measured.
    assert camera.period_ns == pytest.approx(20e6, rel=0.02)  # type: ignore[attr-defined]
    camera.close()


def test_a_frame_period_that_follows_a_long_exposure_is_measured(plugged: Plug) -> None:
    camera = armed(plugged(), CameraSettings(0.04))
    assert camera.period_ns == pytest.approx(40e6, rel=0.02)  # type: ignore[attr-defined]
    camera.close()


def test_an_exposure_that_does_not_fit_into_the_frame_period_is_found_out(plugged: Plug) -> None:
    device = plugged(Faked(stretches=False))
    with pytest.raises(UnsupportedByDeviceError, match=r"frames come every 0\.005 s.*frame_rate_hz of 25 or less"):
        armed(device, CameraSettings(0.04))


# ---- what is in a frame


@pytest.mark.parametrize("code", ["GREY", "Y10 ", "Y12 ", "Y16 ", "Y10P", "YUYV", "UYVY", "MJPG", "RG10"])
def test_every_pixel_format_gives_the_scene(plugged: Plug, code: str) -> None:
    stage = staged(code)
    device = plugged(Faked(formats={code: SIZES}, padding_bytes=0 if code == "MJPG" else 24), stage)
    stage.show(WHITE)
    camera = armed(device)
    frame = camera.read(time.monotonic_ns() + 5_000_000, 2)
    expected = stage.expected(WHITE, exposure_s=0.002)
    assert frame.image.dtype == expected.dtype
    # The interpolation of a mosaic, and JPEG, smooth.
    tolerance = {"MJPG": 6.0, "RG10": 12.0}.get(code, 0.0)
    assert np.abs(frame.image[2:-2, 2:-2].astype(float) - expected[2:-2, 2:-2]).max() <= tolerance
    assert camera.info.format == stage.format
    assert (frame.colour is not None) == camera.info.colour == (code in {"YUYV", "UYVY", "MJPG", "RG10"})
    if frame.colour is not None:
        # The scene is grey, and later frames change nothing.
        stage.show(np.zeros((1, 1), np.uint8))
        for _ in range(8):
            camera.read(time.monotonic_ns(), 2)
        colour = frame.colour()
        assert colour.dtype == frame.image.dtype
        assert np.abs(colour[2:-2, 2:-2].astype(float) - expected[2:-2, 2:-2, None]).max() <= 2 * tolerance + 1
    camera.close()


def test_a_16_bit_format_that_the_sensor_does_not_fill_may_say_so(plugged: Plug) -> None:
    stage = Stage(Scene(camera=CAMERA, bit_depth=12))
    camera = armed(plugged(Faked(formats={"Y16 ": SIZES}), stage), bit_depth=12)
    assert camera.info.format == stage.format
    assert camera.read(0, 2).image.max() <= stage.format.full_scale
    camera.close()


def test_settings_have_taken_effect_when_the_camera_is_armed(plugged: Plug) -> None:
    stage = staged()
    stage.show(WHITE)
    device = plugged(Faked(lag_frames=5), stage)
    camera = device.open_camera(**FAST)
    for exposure_s, gain in ((0.001, 4.0), (0.004, 1.0), (0.001, 2.0)):
        camera.configure(CameraSettings(exposure_s, gain))
        camera.arm(1, Trigger.FREE)
        frame = camera.read(0, 2)
        assert (frame.exposure_s, frame.gain) == pytest.approx((exposure_s, gain))
        np.testing.assert_array_equal(frame.image, stage.expected(WHITE, exposure_s=exposure_s * gain))
        camera.disarm()
    camera.close()


# ---- when a frame was exposed


@pytest.mark.parametrize("stamp", ["start", "first packet", "end", "none", "other clock"])
def test_the_claimed_interval_holds_the_exposure_of_every_row(plugged: Plug, stamp: str) -> None:
    readout_s = 0.002
    device = plugged(Faked(stamp=stamp, readout_s=readout_s, jitter_s=0.001, lost=0.1))
    camera = armed(device)
    truth: dict[int, tuple[int, int]] = {}
    for _ in range(40):
        after_ns = time.monotonic_ns()
        frame = camera.read(after_ns, 2)
        truth.update({shot["number"]: (shot["start_ns"], shot["exposure_ns"]) for shot in device.sensor.asked})
        start_ns, exposure_ns = truth[frame.sequence_number]
        end_ns = start_ns + exposure_ns + round(readout_s * 1e9)
        assert after_ns <= frame.t_start_ns - frame.t_err_ns <= start_ns
        assert end_ns <= frame.t_end_ns + frame.t_err_ns
        assert frame.t_end_ns - frame.t_start_ns == round(frame.exposure_s * 1e9)
    camera.close()


def test_a_known_read_out_narrows_the_claim(plugged: Plug) -> None:
    device = plugged(Faked(stamp="end", readout_s=0.001))
    camera = armed(device)
    wide = camera.read(time.monotonic_ns(), 2)
    camera.close()
    camera = armed(device, readout_s=0.001)
    narrow = camera.read(time.monotonic_ns(), 2)
    assert narrow.t_err_ns < wide.t_err_ns / 4
    camera.close()


# ---- frames that are not given


def test_corrupt_frames_are_passed_over_and_counted(plugged: Plug) -> None:
    stage = staged()
    stage.show(WHITE)
    camera = armed(plugged(Faked(corrupt=0.5), stage), **UNHURRIED)
    frames = [camera.read(0, 2) for _ in range(20)]
    for frame in frames:
        np.testing.assert_array_equal(frame.image, stage.expected(WHITE, exposure_s=0.002))
    numbers = [frame.sequence_number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert frames[-1].dropped_count - frames[0].dropped_count == numbers[-1] - numbers[0] - (len(frames) - 1) > 0
    camera.close()


@pytest.mark.parametrize("code", ["MJPG", "YUYV"])
def test_a_frame_that_was_cut_is_corrupt_without_a_flag(plugged: Plug, code: str) -> None:
    stage = staged(code)
    device = plugged(Faked(formats={code: SIZES}, corrupt=0.4, flags_corrupt=False, noise_when_corrupt=False), stage)
    camera = armed(device)
    frames = [camera.read(0, 2) for _ in range(10)]
    assert frames[-1].dropped_count > 0
    assert all(np.abs(frame.image.astype(float) - frames[0].image).max() < 9 for frame in frames)
    camera.close()


def test_lost_frames_are_counted_and_idle_ones_are_not(plugged: Plug) -> None:
    device = plugged(Faked(lost=0.3))
    camera = armed(device, **UNHURRIED)
    first = camera.read(0, 2)
    frames = [camera.read(0, 2) for _ in range(20)]
    gaps = frames[-1].sequence_number - first.sequence_number - len(frames)
    assert frames[-1].dropped_count - first.dropped_count == gaps > 0
    camera.close()
    whole = plugged(Faked())
    camera = armed(whole)
    first = camera.read(0, 2)
    assert not threading.Event().wait(0.2)
    later = camera.read(time.monotonic_ns(), 2)
    assert later.sequence_number - first.sequence_number > 20
    assert later.dropped_count == 0
    camera.close()


def test_a_read_that_finds_nothing_tells_what_it_found(plugged: Plug) -> None:
    device = plugged()
    camera = armed(device)
    with pytest.raises(FrameTimeoutError, match=r"passed over: \d+ stale, 0 corrupt, 0 repeated") as caught:
        camera.read(time.monotonic_ns() + 10**12, 0.1)
    assert "passed over: 0 stale" not in str(caught.value)
    device.fault("silent")
    with pytest.raises(FrameTimeoutError, match="0 corrupt"):
        camera.read(time.monotonic_ns() + 20_000_000, 0.1)
    device.fault("silent", on=False)
    assert camera.read(time.monotonic_ns(), 2).image.size
    camera.close()


# ---- ways to fail


def test_a_camera_that_another_one_holds_is_busy(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera()
    with pytest.raises(DeviceBusyError, match=r"/dev/video0: .*fuser"):
        device.open_camera()
    camera.close()
    device.fault("busy")
    with pytest.raises(DeviceBusyError):
        device.open_camera()
    device.fault("busy", on=False)
    device.open_camera().close()


def test_a_full_usb_bus_is_explained(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera(**FAST)
    device.fault("no bandwidth")
    with pytest.raises(UnsupportedByDeviceError, match=r"USB bus has not enough bandwidth.*MJPG"):
        camera.arm(1, Trigger.FREE)
    device.fault("no bandwidth", on=False)
    camera.arm(1, Trigger.FREE)
    assert camera.read(0, 2).image.size
    camera.close()


@pytest.mark.parametrize("fault", ["unplugged", "dead"])
def test_a_camera_that_is_gone_says_so_at_every_step(plugged: Plug, fault: str) -> None:
    device = plugged()
    camera = armed(device)
    device.fault(fault)
    with pytest.raises(DeviceGoneError, match="plug it in again"):
        camera.read(0, 2)
    camera.disarm()
    with pytest.raises(DeviceGoneError):
        camera.arm(1, Trigger.FREE)
    if fault == "unplugged":
        with pytest.raises(DeviceGoneError):
            camera.configure(CameraSettings(0.002))
    camera.close()
    camera.close()
    assert len(device.found()) == (fault == "dead")
    device.fault(fault, on=False)
    assert len(device.found()) == 1
    again = armed(device)
    assert again.read(0, 2).image.size
    again.close()


def test_an_unplug_ends_a_read_that_waits(plugged: Plug) -> None:
    device = plugged()
    camera = armed(device)
    with ThreadPoolExecutor(1) as pool:
        taken = len(device.sensor.asked)
        reading = pool.submit(camera.read, time.monotonic_ns() + 10**12, 30)
        device.sensor.wait_for_more(taken)
        device.fault("unplugged")
        with pytest.raises(DeviceGoneError):
            reading.result(timeout=10)
    camera.close()


def test_a_close_ends_a_read_that_waits(plugged: Plug) -> None:
    device = plugged()
    camera = armed(device)
    with ThreadPoolExecutor(1) as pool:
        taken = len(device.sensor.asked)
        reading = pool.submit(camera.read, time.monotonic_ns() + 10**12, 30)
        device.sensor.wait_for_more(taken)
        camera.close()
        with pytest.raises(DeviceStateError, match="closed"):
            reading.result(timeout=10)
    device.open_camera().close()


def test_a_stream_that_gives_nothing_is_told_when_it_is_armed(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera(**FAST, settle_frames=1)
    device.fault("silent")
    with pytest.raises(FrameTimeoutError, match="0 of the first 2 frames"):
        camera.arm(1, Trigger.FREE)
    device.fault("silent", on=False)
    camera.arm(1, Trigger.FREE)
    camera.close()


def test_a_camera_that_is_not_there_is_gone(plugged: Plug) -> None:
    device = plugged()
    with pytest.raises(DeviceGoneError, match=r"found .*Bench camera"):
        device.open_camera(device="/dev/video9")


# ---- what is plugged in


def test_nodes_without_frames_are_not_cameras(plugged: Plug) -> None:
    tree = usb_camera("2", "S123", "video0", "video1")
    by_id = "usb-1234_Bench_camera_S123-video-index0"
    nodes = {"video0": {}, "video1": {"capabilities": 0x04A00000}}
    device = plugged(replace(Faked(), tree=tree, nodes=nodes, links={f"v4l/by-id/{by_id}": "../../video0"}))
    (found,) = device.found()
    assert (found.driver, found.device, found.label) == ("v4l2", by_id, "Bench camera (/dev/video0)")
    camera = device.open_camera(device=by_id)
    assert camera.info.serial == "S123"
    camera.close()
    with pytest.raises(DeviceError, match="gives no frames"):
        device.open_camera(device="/dev/video1")
