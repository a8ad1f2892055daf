"""The driver on a fake kernel: formats and rates that are taken otherwise, frames that are not given, and faults."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from drivers.v4l2.camera import V4L2Camera
from slrig.devices import CameraSettings, Trigger
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import Pixels
from tests.contract import v4l2_sensor
from tests.contract.stage import Stage
from tests.contract.v4l2_bench import CAMERA, CONTROLS, Faked, VirtualDevice, control, virtually
from tests.contract.v4l2_sensor import GAIN_UNITS, encoded
from tests.unit.capture.fake_rig import Scene
from tests.virtual_clock import VirtualClock

WHITE: Pixels = np.full((1, 1), 255, np.uint8)
SIZES = [(CAMERA.width_px, CAMERA.height_px)]
FAST: dict[str, Any] = {"frame_rate_hz": 200, "gain_unity": GAIN_UNITS}
# While nobody reads, all buffers fill up, and what is made then is no loss.
UNHURRIED: dict[str, Any] = {"frame_rate_hz": 50}
Control = dict[str, Any]
Plug = Callable[..., VirtualDevice]


@pytest.fixture
def plugged() -> Iterator[Plug]:
    """Plug a fake camera in: `plugged(Faked(…), stage)`; the one before is gone."""
    with ExitStack() as leaving:

        def plug(faked: Faked | None = None, stage: Stage | None = None) -> VirtualDevice:
            leaving.close()
            return leaving.enter_context(VirtualDevice(stage or virtually(), faked or Faked()))

        yield plug


def changed(name: str, **more: object) -> tuple[Control, ...]:
    """The usual controls, one of them otherwise."""
    assert any(known["name"] == name for known in CONTROLS)
    return tuple({**known, **more} if known["name"] == name else known for known in CONTROLS)


def virtual(device: VirtualDevice) -> VirtualClock:
    assert isinstance(device.clock, VirtualClock)
    return device.clock


def armed(device: VirtualDevice, settings: CameraSettings | None = None, **options: object) -> V4L2Camera:
    camera = device.open_camera(**{**FAST, **options})
    camera.configure(settings or CameraSettings(0.002, 1.0))
    camera.arm(10, Trigger.FREE)
    return camera


# ---- format, frame rate and settings


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pixel_format": "MJPG"}, "requested MJPG 80 x 60, driver gives YUYV 80 x 60; it offers YUYV, Y10"),
        ({"pixel_format": "Y10", "size_px": [1280, 720]}, "requested Y10 1280 x 720, driver gives Y10 80 x 60"),
        ({"frame_rate_hz": 60.0}, "requested 60 frames per second, driver gives 50"),
        ({"bit_depth": 9}, "Y10 has 10 bits"),
        ({"sample_shift": 6, "pixel_format": "YUYV"}, "YUYV has no samples of 10 to 14 bits"),
        ({"controls": {"brightness": 3, "gama": 1}}, "control 'gama', the device has: auto_exposure, backlight"),
        ({"skip_controls": ["sharpnes"]}, r"control 'sharpnes', the device has: auto_exposure, .*sharpness"),
        ({"device": "/dev/null"}, "is not a video device"),
    ],
)
def test_options_that_the_device_does_not_support_are_refused(
    plugged: Plug, options: dict[str, object], words: str
) -> None:
    device = plugged(Faked(formats={"YUYV": SIZES, "Y10 ": SIZES}))
    with pytest.raises(UnsupportedByDeviceError, match=words):
        device.open_camera(**options)
    # What was refused holds nothing.
    device.open_camera()


def test_a_control_that_keeps_another_value_is_refused(plugged: Plug) -> None:
    camera = plugged(Faked(controls=changed("Exposure Time, Absolute", insists_on=100))).open_camera(**UNHURRIED)
    assert camera.configure(CameraSettings(0.01)).exposure_s == pytest.approx(0.01)
    with pytest.raises(UnsupportedByDeviceError, match="requested exposure_time_absolute = 20, driver gives 100"):
        camera.configure(CameraSettings(0.002))


SLOW, FULL, SMALL = ((1, 5),), (160, 120), (80, 60)


@pytest.mark.parametrize(
    ("formats", "slow", "code", "taken"),
    [
        # The most bits, and of these the largest size.
        ({"MJPG": [FULL], "YUYV": [FULL], "Y10 ": [(40, 30), SMALL, (20, 15)]}, [], "Y10 ", SMALL),
        # Half of its pixels come at 15 frames per second: linear before encoded.
        ({"YUYV": [FULL, (120, 90)], "MJPG": [FULL]}, ["YUYV 160 x 120"], "YUYV", (120, 90)),
        # A quarter does: encoded, and whole.
        ({"YUYV": [FULL, SMALL], "MJPG": [FULL]}, ["YUYV 160 x 120"], "MJPG", FULL),
        ({"YUYV": [FULL, SMALL]}, ["YUYV 160 x 120"], "YUYV", SMALL),
    ],
)
def test_without_options_the_best_fast_format_is_used(
    plugged: Plug, formats: dict[str, list[tuple[int, int]]], slow: list[str], code: str, taken: tuple[int, int]
) -> None:
    device = plugged(Faked(formats=formats, rates=((1, 30),), rates_of=dict.fromkeys(slow, SLOW)))
    camera = device.open_camera()
    assert (device.kernel.code, tuple(device.kernel.size), camera.info.notes) == (code, taken, ())
    camera.close()
    if slow:
        # Who asks for the slow format gets it; only who asks for its rate, too, is not warned.
        for more, notes in (({"frame_rate_hz": 5}, 0), ({}, 1)):
            camera = device.open_camera(pixel_format="YUYV", size_px=list(FULL), **more)
            assert len(camera.info.notes) == notes
            assert all("gives 5 frames per second in YUYV 160 x 120" in note for note in camera.info.notes)
            camera.close()


def test_the_least_period_is_that_of_the_frames_or_of_the_exposure(plugged: Plug) -> None:
    camera = plugged().open_camera(**FAST)
    assert camera.configure(CameraSettings(0.002)).min_period_s == pytest.approx(0.005)
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s 0\.04, it takes 0\.0001 to 0\.005"):
        camera.configure(CameraSettings(0.04))
    camera.close()
    # The usual rate is slow: the next fast one takes its place.
    camera = plugged(Faked(rates=((1, 5), (1, 60), (1, 20), (1, 10)))).open_camera()
    assert camera.configure(CameraSettings(0.01)).min_period_s == pytest.approx(1 / 20)
    assert camera.info.notes == ()


def test_a_device_without_controls_exposes_for_a_frame_period(plugged: Plug) -> None:
    device = plugged(Faked(controls=(), stamp="first packet"))
    camera = device.open_camera(frame_rate_hz=50)
    assert camera.info.exposure_range_s == pytest.approx((0.02, 0.02))
    assert camera.info.gain_range == pytest.approx((1.0, 1.0))
    applied = camera.configure(CameraSettings(0.02))
    camera.arm(1, Trigger.FREE)
    now_ns = device.clock.now_ns()
    frame = camera.read(now_ns, 2)
    assert frame.exposure_s == applied.exposure_s == pytest.approx(0.02)
    assert frame.t_start_ns - frame.t_err_ns >= now_ns


@pytest.mark.parametrize(
    ("faked", "options", "exposure_s", "period_ns"),
    [
        # It runs at 50 frames per second, whatever was written.
        (Faked(tells_rate=False), {"frame_rate_hz": 150}, 0.002, 20e6),
        (Faked(rates=((1, 100),), stretches=True), {"frame_rate_hz": 100}, 0.01, 10e6),
    ],
)
def test_the_frame_period_is_measured(
    plugged: Plug, faked: Faked, options: dict[str, object], exposure_s: float, period_ns: float
) -> None:
    camera = armed(plugged(faked), CameraSettings(exposure_s), **options)
    assert camera.period_ns == pytest.approx(period_ns, rel=0.02)


def test_a_device_without_a_frame_rate_needs_it_as_an_option(plugged: Plug) -> None:
    with pytest.raises(UnsupportedByDeviceError, match="write frame_rate_hz"):
        plugged(Faked(tells_rate=False)).open_camera()


def test_a_long_exposure_lowers_a_rate_that_nobody_named(plugged: Plug) -> None:
    device = plugged(Faked(rates=((1, 30), (1, 60), (1, 10), (1, 20)), stretches=False))
    camera = device.open_camera(gain_unity=GAIN_UNITS)
    assert camera.info.exposure_range_s == pytest.approx((1e-4, 0.04))
    periods_s = []
    for exposure_s in (0.01, 0.04, 0.0333, 0.002):
        assert camera.configure(CameraSettings(exposure_s)).exposure_s == pytest.approx(exposure_s)
        camera.arm(1, Trigger.FREE)
        assert camera.read(0, 2).exposure_s == pytest.approx(exposure_s)
        assert device.sensor.asked[-1]["exposure_ns"] == pytest.approx(exposure_s * 1e9)
        periods_s.append(camera.period_ns / 1e9)
        camera.disarm()
    assert periods_s == pytest.approx([1 / 30, 1 / 20, 1 / 30, 1 / 30], rel=0.01)


HALVES = [5, 10, 20, 39, 78, 156, 312]


@pytest.mark.parametrize(("wanted_s", "taken_s"), [(1 / 60, 0.0156), (0.03, 0.0312), (0.0078, 0.0078), (0.001, 0.001)])
def test_of_exposures_that_the_camera_takes_the_nearest_is_used(plugged: Plug, wanted_s: float, taken_s: float) -> None:
    device = plugged(Faked(controls=changed("Exposure Time, Absolute", takes=HALVES)))
    camera = device.open_camera(frame_rate_hz=25)
    assert camera.configure(CameraSettings(wanted_s)).exposure_s == pytest.approx(taken_s)
    camera.arm(1, Trigger.FREE)
    assert camera.read(0, 2).exposure_s == pytest.approx(taken_s)
    camera.disarm()
    device = plugged(Faked(controls=changed("Exposure Time, Absolute", takes=[77])))
    with pytest.raises(UnsupportedByDeviceError, match="requested exposure_time_absolute = "):
        device.open_camera(frame_rate_hz=25).configure(CameraSettings(wanted_s))


def test_settings_that_a_camera_forgets_at_its_start_are_sent_again(plugged: Plug) -> None:
    device = plugged(Faked(controls=changed("Exposure Time, Absolute", forgets_at_start=True)))
    for exposure_s in (0.002, 0.004):
        camera = armed(device, CameraSettings(exposure_s))
        camera.read(0, 2)
        assert device.sensor.asked[-1]["exposure_ns"] == pytest.approx(exposure_s * 1e9)
        camera.close()


@pytest.mark.parametrize(("first_frame_s", "comes"), [(3.5, True), (11.0, False)])
def test_a_first_frame_may_be_late(plugged: Plug, first_frame_s: float, *, comes: bool) -> None:
    device = plugged(Faked(first_frame_s=first_frame_s))
    if comes:
        assert armed(device).read(0, 2).image.size
    else:
        with pytest.raises(FrameTimeoutError, match="0 of the first 6 frames"):
            armed(device)


@pytest.mark.parametrize("name", ["Power Line Frequency", "White Balance, Automatic", "Focus, Automatic Continuous"])
@pytest.mark.parametrize("number", [errno.EIO, errno.EINVAL])
def test_an_automatic_that_is_refused_and_harmless_is_noted(plugged: Plug, name: str, number: int) -> None:
    camera = armed(plugged(Faked(controls=changed(name, stalls=["set"], errno=number))))
    [note] = camera.info.notes
    assert "an automatic of its own stays as it is" in note
    assert "skip_controls = [" in note
    assert camera.read(0, 2).image.size


def test_a_lens_with_a_motor_needs_its_place(plugged: Plug) -> None:
    device = plugged(Faked(controls=changed("Focus, Absolute", default=37)))
    with pytest.raises(UnsupportedByDeviceError, match=r"a motor moves its lens.*focus = 37 is the present one"):
        device.open_camera(**FAST, focus=None)
    for options in ({"focus": 40}, {"focus": None, "controls": {"focus_absolute": 40}}):
        device.open_camera(**FAST, **options).close()
        assert device.kernel.controls_set["Focus, Absolute"] == 40
    device.open_camera(**FAST, focus=None, skip_controls=["focus_absolute"]).close()


LINES = control(0x00980911, "Exposure", 4, 1000, 100)
BLANK = control(0x009E0902, "Horizontal Blanking", 20, 20, 20, flags=4)
RATE = control(0x009F0902, "Pixel Rate", 0, 0, 0, flags=4, long=8_000_000_000, kind=5)
BARE = tuple(known for known in CONTROLS if known["name"] not in {"Exposure Time, Absolute", "Auto Exposure"})


def test_an_exposure_in_lines_becomes_seconds(plugged: Plug) -> None:
    # 80 pixels and 20 of blanking; a pixel rate beyond 32 bits is read whole.
    device = plugged(Faked(controls=(*BARE, LINES, BLANK, {**RATE, "long": 10_000_000}), line_s=1e-5))
    camera = device.open_camera(**FAST)
    assert camera.info.exposure_range_s == pytest.approx((4e-5, 0.005))
    assert camera.configure(CameraSettings(0.002004)).exposure_s == pytest.approx(0.002)
    assert device.kernel.controls_set["Exposure"] == 200
    camera.arm(1, Trigger.FREE)
    camera.read(0, 2)
    assert device.sensor.asked[-1]["exposure_ns"] == pytest.approx(2e6)
    camera = plugged(Faked(controls=(*BARE, LINES, BLANK, RATE))).open_camera(**FAST)
    assert camera.info.exposure_range_s[1] == pytest.approx(1000 * 100 / 8e9)


@pytest.mark.parametrize(("known", "words"), [(RATE, "horizontal blanking"), (BLANK, "pixel rate")])
def test_an_exposure_of_unknown_unit_is_refused(plugged: Plug, known: Control, words: str) -> None:
    device = plugged(Faked(controls=(*BARE, LINES, known)))
    with pytest.raises(UnsupportedByDeviceError, match=rf'its {words} is missing.*skip_controls = \["exposure"\]'):
        device.open_camera(**FAST)
    camera = device.open_camera(frame_rate_hz=50, skip_controls=["exposure"])
    assert camera.info.exposure_range_s == pytest.approx((0.02, 0.02))


# ---- image processing


def test_processing_is_off_and_zoom_and_pan_are_back(plugged: Plug) -> None:
    more = (
        control(0x009A0915, "Wide Dynamic Range", 0, 1, 1, kind=2),
        control(0x009A0924, "HDR Sensor Mode", 0, 1, 1, kind=3),
        control(0x0A046D01, "3D Noise Reduction", 0, 10, 5),
        control(0x00980920, "Brightness, Automatic", 0, 1, 1, kind=2),
        control(0x009A0914, "White Balance, Auto & Preset", 0, 9, 1, kind=3),
        control(0x009A0916, "Image Stabilization", 0, 1, 1, kind=2),
        control(0x009A0918, "ISO Sensitivity, Auto", 0, 1, 1, kind=3),
        control(0x009A091A, "Scene Mode", 0, 13, 2, kind=3),
        control(0x009A0908, "Pan, Absolute", -36000, 36000, 0),
        control(0x009A0909, "Tilt, Absolute", -36000, 36000, 0),
        control(0x009A090D, "Zoom, Absolute", 100, 500, 100),
    )
    device = plugged(Faked(controls=(*CONTROLS, *more)))
    device.open_camera(**FAST, controls={"zoom_absolute": 200}).close()
    known = device.kernel.controls_set
    assert known["Zoom, Absolute"] == 200
    camera = device.open_camera(**FAST)
    assert camera.info.notes == ()
    wanted = {
        **{"Sharpness": 0, "Gamma": 100, "Contrast": 32, "Backlight Compensation": 0, "Wide Dynamic Range": 0},
        **{"HDR Sensor Mode": 0, "3D Noise Reduction": 0, "Exposure, Dynamic Framerate": 0, "Auto Exposure": 1},
        **{"Brightness, Automatic": 0, "White Balance, Auto & Preset": 0, "Image Stabilization": 0},
        **{"ISO Sensitivity, Auto": 0, "Scene Mode": 0},
        **{"Pan, Absolute": 0, "Tilt, Absolute": 0, "Zoom, Absolute": 100, "Brightness": 0},
    }
    assert {name: known.get(name) for name in wanted} == wanted


@pytest.mark.parametrize("closed", [True, False])
def test_a_closed_privacy_shutter_is_noted(plugged: Plug, *, closed: bool) -> None:
    device = plugged(Faked(controls=(*CONTROLS, control(0x009A0910, "Privacy", 0, 1, int(closed), flags=4))))
    camera = device.open_camera(**FAST)
    assert ["privacy shutter is closed" in note for note in camera.info.notes] == [True] * closed


def test_options_overrule_what_the_driver_sets(plugged: Plug) -> None:
    device = plugged()
    left = ["backlight_compensation", "gain"]
    camera = device.open_camera(**FAST, controls={"sharpness": 2}, skip_controls=left)
    known = device.kernel.controls_set
    assert known["Sharpness"] == 2
    assert not known.keys() & {"Backlight Compensation", "Gain"}
    assert camera.info.gain_range == (1.0, 1.0)
    with pytest.raises(ConfigError, match="sharpness: named in controls, to set, and in skip_controls"):
        device.open_camera(controls={"sharpness": 2}, skip_controls=["sharpness"])


def test_values_of_unknown_unit_are_not_guessed(plugged: Plug) -> None:
    noise = control(0x0A046D01, "Noise Reduction", 0, 2, 0, kind=3)
    device = plugged(Faked(controls=(*changed("Gamma", minimum=1, maximum=10, default=5), noise)))
    gamma, menu = device.open_camera(**FAST).info.notes
    assert "control gamma (1 to 10)" in gamma
    assert "controls = { gamma = … }" in gamma
    assert "noise_reduction changes its pictures" in menu
    assert not device.kernel.controls_set.keys() & {"Gamma", "Noise Reduction"}
    # V4L2 itself gives gamma no unit; the class of USB cameras does.
    [note] = plugged(Faked(driver="sensor")).open_camera(**FAST).info.notes
    assert "control gamma (72 to 500)" in note


@pytest.mark.parametrize("number", [errno.EIO, errno.EPIPE, errno.ETIMEDOUT])
def test_a_control_that_fails_and_is_not_needed_is_noted(plugged: Plug, number: int) -> None:
    device = plugged(Faked(controls=changed("Sharpness", stalls=["set"], errno=number)))
    camera = device.open_camera(**FAST)
    [note] = camera.info.notes
    assert "requested sharpness = 0, the driver refuses it" in note
    assert 'skip_controls = ["sharpness"]' in note
    camera.close()
    assert device.open_camera(**FAST, skip_controls=["sharpness"]).info.notes == ()


@pytest.mark.parametrize("request_", ["set", "get"])
def test_a_control_that_fails_and_is_needed_is_refused(plugged: Plug, request_: str) -> None:
    device = plugged(Faked(controls=changed("Auto Exposure", stalls=[request_], errno=errno.EIO)))
    with pytest.raises(UnsupportedByDeviceError, match=r'still connected; skip_controls = \["auto_exposure"\]'):
        device.open_camera(**FAST)


def test_a_control_that_cannot_be_described_hides_no_other(plugged: Plug) -> None:
    device = plugged(Faked(controls=changed("Contrast", stalls=["describe"], errno=errno.EIO)))
    camera = device.open_camera(**FAST)
    assert camera.configure(CameraSettings(0.003)).exposure_s == pytest.approx(0.003)
    assert device.kernel.controls_set["Sharpness"] == 0
    assert "Contrast" not in device.kernel.controls_set


# ---- frames


@pytest.mark.parametrize("code", ["GREY", "Y10 ", "Y12 ", "Y16 ", "Y10P", "YUYV", "UYVY", "MJPG", "RG10"])
def test_every_pixel_format_gives_the_scene(plugged: Plug, code: str) -> None:
    stage = virtually(code=code)
    device = plugged(Faked(formats={code: SIZES}, padding_bytes=0 if code == "MJPG" else 24), stage)
    stage.show(WHITE)
    camera = armed(device)
    frame = camera.read(stage.clock.now_ns() + 5_000_000, 2)
    expected = stage.expected(WHITE, exposure_s=0.002)
    assert frame.image.dtype == expected.dtype
    # The interpolation of a mosaic, and JPEG, smooth.
    tolerance = {"MJPG": 6.0, "RG10": 12.0}.get(code, 0.0)
    assert np.abs(frame.image[2:-2, 2:-2].astype(float) - expected[2:-2, 2:-2]).max() <= tolerance
    assert camera.info.format == stage.format
    assert (frame.colour is not None) == camera.info.colour == (code in {"YUYV", "UYVY", "MJPG", "RG10"})
    if frame.colour is not None:
        assert frame.colour().dtype == frame.image.dtype


def test_a_16_bit_format_may_have_fewer_bits(plugged: Plug) -> None:
    stage = Stage(Scene(camera=CAMERA, bit_depth=12), clock=VirtualClock())
    camera = armed(plugged(Faked(formats={"Y16 ": SIZES}), stage), bit_depth=12)
    assert camera.info.format == stage.format
    assert camera.read(0, 2).image.max() <= stage.format.full_scale


def test_a_known_read_out_narrows_the_interval(plugged: Plug) -> None:
    device = plugged(Faked(stamp="end", readout_s=0.001))
    errors_ns = []
    options: dict[str, Any]
    for options in ({}, {"readout_s": 0.001}):
        camera = armed(device, None, **options)
        errors_ns.append(camera.read(device.clock.now_ns(), 2).t_err_ns)
        camera.close()
    assert errors_ns[1] < errors_ns[0] / 4


def test_corrupt_frames_are_skipped_and_counted(plugged: Plug) -> None:
    stage = virtually()
    stage.show(WHITE)
    camera = armed(plugged(Faked(corrupt=0.5), stage), **UNHURRIED)
    frames = [camera.read(0, 2) for _ in range(20)]
    for frame in frames:
        np.testing.assert_array_equal(frame.image, stage.expected(WHITE, exposure_s=0.002))
    numbers = [frame.sequence_number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert frames[-1].dropped_count - frames[0].dropped_count == numbers[-1] - numbers[0] - (len(frames) - 1) > 0


@pytest.mark.parametrize("code", ["MJPG", "YUYV"])
def test_a_cut_frame_is_corrupt_without_a_flag(plugged: Plug, code: str) -> None:
    faked = Faked(formats={code: SIZES}, corrupt=0.4, flags_corrupt=False, noise_when_corrupt=False)
    camera = armed(plugged(faked, virtually(code=code)))
    frames = [camera.read(0, 2) for _ in range(10)]
    assert frames[-1].dropped_count > 0
    assert all(np.abs(frame.image.astype(float) - frames[0].image).max() < 9 for frame in frames)


def test_a_camera_that_pads_every_frame_is_called_so(plugged: Plug, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(v4l2_sensor, "encoded", lambda *sent: (data := encoded(*sent))[:-2] + b"U" * 400 + data[-2:])
    camera = armed(plugged(Faked(formats={"MJPG": SIZES}), virtually(code="MJPG")))
    with pytest.raises(FrameTimeoutError, match=r"39. bytes are between .*\. This camera pads its frames: all [1-9]"):
        camera.read(0, 1)


def test_samples_that_the_receiver_shifts_up_are_read(plugged: Plug, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(v4l2_sensor, "encoded", lambda image, *sent: encoded(image << 6, *sent))
    stage = virtually(code="Y10 ")
    stage.show(WHITE)
    camera = armed(plugged(Faked(formats={"Y10 ": SIZES}), stage), sample_shift=6)
    assert camera.info.format.bit_depth == 10
    np.testing.assert_array_equal(camera.read(0, 2).image, stage.expected(WHITE, exposure_s=0.002))


def test_lost_frames_are_counted_and_idle_ones_are_not(plugged: Plug) -> None:
    camera = armed(plugged(Faked(lost=0.3)), **UNHURRIED)
    first = camera.read(0, 2)
    frames = [camera.read(0, 2) for _ in range(20)]
    gaps = frames[-1].sequence_number - first.sequence_number - len(frames)
    assert frames[-1].dropped_count - first.dropped_count == gaps > 0
    whole = plugged()
    camera = armed(whole)
    first = camera.read(0, 2)
    virtual(whole).advance(0.2)
    later = camera.read(whole.clock.now_ns(), 2)
    assert later.sequence_number - first.sequence_number > 20
    assert later.dropped_count == 0


def test_a_timeout_reports_the_skipped_frames(plugged: Plug) -> None:
    device = plugged()
    camera = armed(device)
    with pytest.raises(FrameTimeoutError, match=r"skipped: [1-9]\d* stale, 0 corrupt, 0 repeated"):
        camera.read(device.clock.now_ns() + 10**12, 0.1)
    device.fault("silent")
    with pytest.raises(FrameTimeoutError, match="0 corrupt"):
        camera.read(device.clock.now_ns() + 20_000_000, 0.1)
    device.fault("silent", on=False)
    assert camera.read(device.clock.now_ns(), 2).image.size


# ---- faults


def test_a_camera_in_use_by_another_program_is_busy(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera()
    with pytest.raises(DeviceBusyError, match=r"/dev/video0: .*fuser"):
        device.open_camera()
    camera.close()
    device.fault("busy")
    with pytest.raises(DeviceBusyError):
        device.open_camera()
    device.fault("busy", on=False)
    device.open_camera()


@pytest.mark.parametrize(
    ("fault", "kind", "words"),
    [
        ("no bandwidth", UnsupportedByDeviceError, r"USB bus has not enough bandwidth.*MJPG"),
        ("silent", FrameTimeoutError, "0 of the first 2 frames"),
    ],
)
def test_a_stream_that_does_not_start_is_refused_and_may_start_later(
    plugged: Plug, fault: str, kind: type[DeviceError], words: str
) -> None:
    device = plugged()
    camera = device.open_camera(**FAST, settle_frames=1)
    device.fault(fault)
    with pytest.raises(kind, match=words):
        camera.arm(1, Trigger.FREE)
    device.fault(fault, on=False)
    camera.arm(1, Trigger.FREE)
    assert camera.read(0, 2).image.size


@pytest.mark.parametrize("fault", ["unplugged", "dead"])
@pytest.mark.parametrize("waits", [False, True])
def test_an_unplugged_camera_is_reported_at_every_step(plugged: Plug, fault: str, waits: bool) -> None:
    device = plugged()
    camera = armed(device)
    now_ns = device.clock.now_ns()
    virtual(device).call_at(now_ns + 100_000_000 * waits, lambda: device.fault(fault))
    with pytest.raises(DeviceGoneError, match="plug it in again"):
        camera.read(now_ns + 10**12, 30)
    assert device.clock.now_ns() - now_ns <= 200_000_000
    camera.disarm()
    with pytest.raises(DeviceGoneError):
        camera.arm(1, Trigger.FREE)
    if fault == "unplugged":
        with pytest.raises(DeviceGoneError):
            camera.configure(CameraSettings(0.002))
    camera.close()
    device.fault(fault, on=False)
    assert armed(device).read(0, 2).image.size


def test_closing_from_another_thread_ends_a_read(plugged: Plug) -> None:
    device = plugged()
    camera = armed(device)
    closing = threading.Thread(target=camera.close)

    def close() -> None:
        closing.start()
        assert camera._state.closed.wait(10)

    virtual(device).call_at(device.clock.now_ns() + 100_000_000, close)
    with pytest.raises(DeviceStateError, match="closed"):
        camera.read(device.clock.now_ns() + 10**15, 10**5)
    closing.join()
    device.open_camera()


def test_a_node_without_frames_is_refused(plugged: Plug) -> None:
    device = plugged(Faked(nodes={"video0": {"capabilities": 0x04A00000}}))
    with pytest.raises(UnsupportedByDeviceError, match="has no frames"):
        device.open_camera()
