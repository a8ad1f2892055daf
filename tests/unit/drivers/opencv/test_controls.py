"""A camera that says yes and does something else: every property is read back."""

from __future__ import annotations

from typing import Any

import cv2
import pytest

from drivers.opencv.controls import Controls, negotiate
from drivers.opencv.options import OpenCvOptions
from slrig.devices import CameraSettings
from slrig.errors import UnsupportedByDeviceError


def number(code: str) -> float:
    return float(cv2.VideoWriter.fourcc(*code))


class Obstinate:
    """Properties that are clamped, rounded, fixed or absent, and never refused."""

    def __init__(self, **more: Any) -> None:
        self.values: dict[int, float] = {
            cv2.CAP_PROP_FOURCC: number("YUYV"),
            cv2.CAP_PROP_FRAME_WIDTH: 640,
            cv2.CAP_PROP_FRAME_HEIGHT: 480,
            cv2.CAP_PROP_FPS: 30,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3,
            cv2.CAP_PROP_EXPOSURE: 156,
            cv2.CAP_PROP_GAIN: 40,
            cv2.CAP_PROP_AUTOFOCUS: 1,
            cv2.CAP_PROP_FOCUS: 0,
            cv2.CAP_PROP_AUTO_WB: 1,
        }
        self.ranges: dict[int, tuple[float, float]] = {
            cv2.CAP_PROP_EXPOSURE: (3, 2047),
            cv2.CAP_PROP_GAIN: (16, 255),
            cv2.CAP_PROP_FOCUS: (0, 250),
        }
        self.formats = {number("YUYV"), number("MJPG")}
        self.fixed: set[int] = more.get("fixed", set())
        self.sizes = {640, 480, 1280, 720}
        self.order: list[int] = []
        for absent in more.get("absent", ()):
            del self.values[absent]

    def get(self, which: int) -> float:
        return self.values.get(which, -1.0)

    def set(self, which: int, value: float) -> bool:
        self.order.append(which)
        if which in self.fixed or which not in self.values:
            return True
        if which == cv2.CAP_PROP_EXPOSURE and self.values.get(cv2.CAP_PROP_AUTO_EXPOSURE, 1) != 1:
            return True
        if which == cv2.CAP_PROP_FOURCC and value not in self.formats:
            return True
        if which in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT) and value not in self.sizes:
            return True
        least, most = self.ranges.get(which, (value, value))
        self.values[which] = min(max(value, least), most)
        return True


def options(**given: Any) -> OpenCvOptions:
    return OpenCvOptions(device=0, **given)


def obstinate(**more: Any) -> Any:
    return Obstinate(**more)


def controls(capture: Any, **given: Any) -> Controls:
    return Controls(capture, options(**given), "/dev/video0", fixed_s=0.033)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"fourcc": "GREY"}, "asked for pixel format GREY, the driver gives YUYV; choose"),
        ({"size_px": (1920, 1080)}, "asked for 1920 x 1080, the driver gives 640 x 480"),
        ({"frame_rate_hz": 60.0}, "asked for 60 frames per second, the driver gives 30"),
    ],
)
def test_what_the_driver_takes_otherwise_is_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        negotiate(obstinate(fixed={cv2.CAP_PROP_FPS}), options(**asked), "/dev/video0")


def test_what_the_driver_takes_is_agreed() -> None:
    capture = obstinate()
    negotiate(capture, options(fourcc="MJPG", size_px=(1280, 720), frame_rate_hz=29.97), "/dev/video0")
    # A pixel format first: it decides which extents and rates there are.
    assert capture.order == [
        *(cv2.CAP_PROP_MODE, cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT),
        cv2.CAP_PROP_FPS,
    ]


def test_every_automatic_is_switched_off_before_what_it_governs() -> None:
    capture = obstinate()
    controls(capture, focus=30.0)
    for off, value in ((cv2.CAP_PROP_AUTO_EXPOSURE, 1), (cv2.CAP_PROP_AUTOFOCUS, 0), (cv2.CAP_PROP_AUTO_WB, 0)):
        assert capture.get(off) == value
    assert capture.order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < capture.order.index(cv2.CAP_PROP_EXPOSURE)
    assert capture.order.index(cv2.CAP_PROP_AUTOFOCUS) < capture.order.index(cv2.CAP_PROP_FOCUS)
    assert capture.get(cv2.CAP_PROP_FOCUS) == 30


@pytest.mark.parametrize(
    ("which", "words"),
    [
        (cv2.CAP_PROP_AUTO_EXPOSURE, "automatic exposure cannot be switched off: asked for 1, the driver gives 3"),
        (cv2.CAP_PROP_AUTOFOCUS, "autofocus cannot be switched off"),
        (cv2.CAP_PROP_AUTO_WB, "automatic white balance cannot"),
    ],
)
def test_an_automatic_that_stays_on_is_refused(which: int, words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        controls(obstinate(fixed={which}))


def test_ranges_are_found_out_and_left_as_they_were() -> None:
    capture = obstinate()
    found = controls(capture)
    assert found.exposure_range_s == pytest.approx((0.0003, 0.2047))
    assert found.gain_range == (1.0, 240.0)
    assert (capture.get(cv2.CAP_PROP_EXPOSURE), capture.get(cv2.CAP_PROP_GAIN)) == (156, 40)


def test_settings_are_rounded_to_the_devices_steps_and_read_back() -> None:
    capture = obstinate()
    applied = controls(capture).apply(CameraSettings(1 / 60, 5.0))
    assert [applied.exposure_s, applied.gain] == pytest.approx([0.0167, 5.0])
    assert (capture.get(cv2.CAP_PROP_EXPOSURE), capture.get(cv2.CAP_PROP_GAIN)) == (167, 20)


def test_a_setting_that_is_taken_otherwise_is_refused() -> None:
    capture = obstinate()
    set_up = controls(capture)
    capture.ranges[cv2.CAP_PROP_EXPOSURE] = (3, 100)
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure in units of 100 µs 167, the driver gives 100; write"):
        set_up.apply(CameraSettings(1 / 60))
    with pytest.raises(UnsupportedByDeviceError, match=r"focus 300, the driver gives 250"):
        controls(obstinate(), focus=300.0)
    with pytest.raises(UnsupportedByDeviceError, match=r"focus 30, the driver has no such control"):
        controls(obstinate(absent=[cv2.CAP_PROP_FOCUS]), focus=30.0)


def test_a_camera_without_controls_has_what_it_has() -> None:
    capture = obstinate(absent=[cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_GAIN])
    found = controls(capture)
    assert (found.exposure_range_s, found.gain_range) == ((0.033, 0.033), (1.0, 1.0))
    assert found.read_back().exposure_s == 0.033
