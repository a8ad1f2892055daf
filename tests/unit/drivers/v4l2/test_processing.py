"""A camera's own image processing, controls that answer with faults, frame rates, exposures in lines."""

from __future__ import annotations

import errno
from collections.abc import Callable

import pytest

from slrig.devices import CameraSettings, Trigger
from slrig.errors import ConfigError, UnsupportedByDeviceError
from tests.contract.v4l2_bench import CONTROLS, Faked, FakeDevice, control

pytestmark = pytest.mark.slow

Plug = Callable[..., FakeDevice]
Control = dict[str, object]
FAST = {"frame_rate_hz": 200}


def changed(name: str, **more: object) -> tuple[Control, ...]:
    """The usual controls, one of them otherwise."""
    assert any(known["name"] == name for known in CONTROLS)
    return tuple({**known, **more} if known["name"] == name else known for known in CONTROLS)


def without(*names: str) -> tuple[Control, ...]:
    return tuple(known for known in CONTROLS if known["name"] not in names)


# ---- image processing


def test_what_bends_the_picture_is_off_when_it_is_open(plugged: Plug) -> None:
    more = (
        control(0x009A0915, "Wide Dynamic Range", 0, 1, 1, kind=2),
        control(0x009A0924, "HDR Sensor Mode", 0, 1, 1, kind=3),
        control(0x0A046D01, "3D Noise Reduction", 0, 10, 5),
        control(0x00980920, "Brightness, Automatic", 0, 1, 1, kind=2),
        control(0x009A0914, "White Balance, Auto & Preset", 0, 9, 1, kind=3),
        control(0x009A0916, "Image Stabilization", 0, 1, 1, kind=2),
        control(0x009A0918, "ISO Sensitivity, Auto", 0, 1, 1, kind=3),
        control(0x009A091A, "Scene Mode", 0, 13, 2, kind=3),
    )
    device = plugged(Faked(controls=(*CONTROLS, *more)))
    camera = device.open_camera(**FAST)
    assert camera.info.notes == ()
    known = device.controls_set()
    wanted = {
        **{"Sharpness": 0, "Gamma": 100, "Contrast": 32, "Backlight Compensation": 0, "Wide Dynamic Range": 0},
        **{"HDR Sensor Mode": 0, "3D Noise Reduction": 0, "Exposure, Dynamic Framerate": 0, "Auto Exposure": 1},
        **{"Brightness, Automatic": 0, "White Balance, Auto & Preset": 0, "Image Stabilization": 0},
        **{"ISO Sensitivity, Auto": 0, "Scene Mode": 0},
    }
    assert {name: known.get(name) for name in wanted} == wanted
    assert "Brightness" not in known
    camera.close()


def test_what_another_program_left_of_zoom_and_pan_is_undone(plugged: Plug) -> None:
    moved = (
        control(0x009A0908, "Pan, Absolute", -36000, 36000, 0),
        control(0x009A0909, "Tilt, Absolute", -36000, 36000, 0),
        control(0x009A090D, "Zoom, Absolute", 100, 500, 100),
    )
    device = plugged(Faked(controls=(*CONTROLS, *moved)))
    device.open_camera(**FAST, controls={"zoom_absolute": 200}).close()
    assert device.controls_set()["Zoom, Absolute"] == 200
    camera = device.open_camera(**FAST)
    known = device.controls_set()
    assert (known["Pan, Absolute"], known["Tilt, Absolute"], known["Zoom, Absolute"]) == (0, 0, 100)
    assert camera.info.notes == ()
    camera.close()


@pytest.mark.parametrize("closed", [True, False])
def test_a_closed_privacy_shutter_is_told(plugged: Plug, *, closed: bool) -> None:
    device = plugged(Faked(controls=(*CONTROLS, control(0x009A0910, "Privacy", 0, 1, int(closed), flags=4))))
    camera = device.open_camera(**FAST)
    assert ["privacy shutter is closed" in note for note in camera.info.notes] == [True] * closed
    camera.close()


def test_a_person_has_the_last_word(plugged: Plug) -> None:
    device = plugged()
    left = ["backlight_compensation", "gain"]
    camera = device.open_camera(**FAST, controls={"sharpness": 2}, skip_controls=left)
    known = device.controls_set()
    assert known["Sharpness"] == 2
    assert not known.keys() & {"Backlight Compensation", "Gain"}
    assert camera.info.gain_range == (1.0, 1.0)
    camera.close()
    with pytest.raises(
        UnsupportedByDeviceError, match=r"control 'sharpnes', the device has: auto_exposure, .*sharpness"
    ):
        device.open_camera(skip_controls=["sharpnes"])
    with pytest.raises(ConfigError, match="sharpness: named in controls, to be set, and in skip_controls"):
        device.open_camera(controls={"sharpness": 2}, skip_controls=["sharpness"])


def test_no_value_of_an_unknown_unit_is_guessed(plugged: Plug) -> None:
    noise = control(0x0A046D01, "Noise Reduction", 0, 2, 0, kind=3)
    device = plugged(Faked(controls=(*changed("Gamma", minimum=1, maximum=10, default=5), noise)))
    camera = device.open_camera(**FAST)
    gamma, menu = camera.info.notes
    assert "control gamma (1 to 10)" in gamma
    assert "controls = { gamma = … }" in gamma
    assert "noise_reduction changes its pictures" in menu
    assert not device.controls_set().keys() & {"Gamma", "Noise Reduction"}
    camera.close()
    # V4L2 itself gives gamma no unit; the class of USB cameras does.
    other = plugged(Faked(driver="sensor"))
    camera = other.open_camera(**FAST)
    [note] = camera.info.notes
    assert "control gamma (72 to 500)" in note
    camera.close()


# ---- a control that answers with a fault


@pytest.mark.parametrize("number", [errno.EIO, errno.EPIPE, errno.ETIMEDOUT])
def test_a_fault_of_a_control_that_can_be_done_without_is_told(plugged: Plug, number: int) -> None:
    device = plugged(Faked(controls=changed("Sharpness", stalls=["set"], errno=number)))
    camera = device.open_camera(**FAST)
    [note] = camera.info.notes
    assert "asked sharpness = 0, the driver refuses it" in note
    assert 'skip_controls = ["sharpness"]' in note
    camera.close()
    camera = device.open_camera(**FAST, skip_controls=["sharpness"])
    assert camera.info.notes == ()
    camera.configure(CameraSettings(0.002))
    camera.arm(1, Trigger.FREE)
    assert camera.read(0, 2).image.size
    camera.close()


@pytest.mark.parametrize("request_", ["set", "get"])
def test_a_fault_of_a_control_that_is_needed_is_a_refusal_and_no_unplug(plugged: Plug, request_: str) -> None:
    device = plugged(Faked(controls=changed("Auto Exposure", stalls=[request_], errno=errno.EIO)))
    with pytest.raises(UnsupportedByDeviceError, match=r'still there; skip_controls = \["auto_exposure"\]'):
        device.open_camera(**FAST)


def test_a_control_that_cannot_be_described_hides_no_other(plugged: Plug) -> None:
    device = plugged(Faked(controls=changed("Contrast", stalls=["describe"], errno=errno.EIO)))
    camera = device.open_camera(**FAST)
    assert camera.configure(CameraSettings(0.003)).exposure_s == pytest.approx(0.003)
    known = device.controls_set()
    assert known["Sharpness"] == 0
    assert "Contrast" not in known
    camera.close()


# ---- frame rate

SLOW, FULL, SMALL = ((1, 5),), (160, 120), (80, 60)


@pytest.mark.parametrize(
    ("formats", "slow", "taken"),
    [
        # Half of its pixels come at 15 frames per second: linear before encoded.
        ({"YUYV": [FULL, (120, 90)], "MJPG": [FULL]}, ["YUYV 160 x 120"], (120, 90)),
        # A quarter does: encoded, and whole.
        ({"YUYV": [FULL, SMALL], "MJPG": [FULL]}, ["YUYV 160 x 120"], FULL),
        ({"YUYV": [FULL, SMALL]}, ["YUYV 160 x 120"], SMALL),
    ],
)
def test_the_format_that_is_taken_unasked_is_fast(
    plugged: Plug, formats: dict[str, list[tuple[int, int]]], slow: list[str], taken: tuple[int, int]
) -> None:
    device = plugged(Faked(formats=formats, rates=((1, 30),), rates_of=dict.fromkeys(slow, SLOW)))
    camera = device.open_camera()
    size = camera.info.format.size
    assert (size.width_px, size.height_px) == taken
    assert camera.info.notes == ()
    # Whoever asks for the slow one gets it, and is not told what they know.
    camera.close()
    camera = device.open_camera(pixel_format="YUYV", size_px=list(FULL), frame_rate_hz=5)
    assert camera.info.notes == ()
    camera.close()
    camera = device.open_camera(pixel_format="YUYV", size_px=list(FULL))
    [note] = camera.info.notes
    assert "gives 5 frames per second in YUYV 160 x 120" in note
    camera.close()


def test_a_rate_that_is_slow_as_it_is_set_becomes_the_next_fast_one(plugged: Plug) -> None:
    device = plugged(Faked(rates=((1, 5), (1, 60), (1, 20), (1, 10))))
    camera = device.open_camera()
    assert camera.configure(CameraSettings(0.01)).least_period_s == pytest.approx(1 / 20)
    assert camera.info.notes == ()
    camera.close()


def test_the_least_period_is_the_frames_or_the_exposures(plugged: Plug) -> None:
    camera = plugged(Faked(stretches=True)).open_camera(**FAST)
    assert camera.configure(CameraSettings(0.002)).least_period_s == pytest.approx(0.005)
    assert camera.configure(CameraSettings(0.04)).least_period_s == pytest.approx(0.04)
    camera.close()


# ---- a raw sensor's exposure


LINES = control(0x00980911, "Exposure", 4, 1000, 100)
BLANK = control(0x009E0902, "Horizontal Blanking", 20, 20, 20, flags=4)
RATE = control(0x009F0902, "Pixel Rate", 0, 0, 0, flags=4, long=8_000_000_000, kind=5)
BARE = without("Exposure Time, Absolute", "Auto Exposure")


def test_lines_of_a_sensor_become_seconds(plugged: Plug) -> None:
    # 80 pixels and 20 of blanking; a pixel rate beyond 32 bits is read whole.
    slow = {**RATE, "long": 10_000_000}
    device = plugged(Faked(controls=(*BARE, LINES, BLANK, slow), line_s=1e-5))
    camera = device.open_camera(**FAST)
    assert camera.info.exposure_range_s == pytest.approx((4e-5, 0.01))
    assert camera.configure(CameraSettings(0.002004)).exposure_s == pytest.approx(0.002)
    assert device.controls_set()["Exposure"] == 200
    camera.arm(1, Trigger.FREE)
    camera.read(0, 2)
    assert device.sensor.asked[-1]["exposure_ns"] == pytest.approx(2e6)
    camera.close()
    camera = plugged(Faked(controls=(*BARE, LINES, BLANK, RATE))).open_camera(**FAST)
    assert camera.info.exposure_range_s[1] == pytest.approx(1000 * 100 / 8e9)
    camera.close()


@pytest.mark.parametrize(("missing", "words"), [(BLANK, "horizontal blanking"), (RATE, "pixel rate")])
def test_an_exposure_of_unknown_unit_is_refused(plugged: Plug, missing: Control, words: str) -> None:
    rest = tuple(each for each in (BLANK, RATE) if each is not missing)
    device = plugged(Faked(controls=(*BARE, LINES, *rest)))
    with pytest.raises(UnsupportedByDeviceError, match=rf'its {words} is missing.*skip_controls = \["exposure"\]'):
        device.open_camera(**FAST)
    camera = device.open_camera(frame_rate_hz=50, skip_controls=["exposure"])
    assert camera.info.exposure_range_s == pytest.approx((0.02, 0.02))
    camera.close()
