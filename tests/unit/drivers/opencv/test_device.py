"""A camera of the kernel's: OpenCV's part is a stand-in that behaves as measured, the kernel's is `v4l2_bench`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.opencv import open_camera
from drivers.opencv.camera import OpenCvCamera
from drivers.opencv.controls import CaptureControls, negotiate
from drivers.opencv.options import OpenCvOptions
from slrig.devices import CameraSettings, Trigger
from slrig.errors import DeviceBusyError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from tests.contract.v4l2_bench import CONTROLS, NODE, Faked, VirtualDevice, control, virtually


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


LONG_S = 10.0
PERIOD_S = 0.002


class Streaming(Obstinate):
    """Gives a frame per period, its number in each pixel. flows : unset while it is silent. ahead_ns : of its stamps.

    lost : frames that do not come.
    """

    def __init__(self) -> None:
        super().__init__()
        self.values |= {cv2.CAP_PROP_FPS: 1 / PERIOD_S, cv2.CAP_PROP_EXPOSURE: 3, cv2.CAP_PROP_BUFFERSIZE: 4}
        self.values[cv2.CAP_PROP_CONVERT_RGB] = 1
        self.flows, self.gone, self.ahead_ns, self.lost = threading.Event(), False, 0, 0
        self.flows.set()
        self.number, self._never = 0, threading.Event()

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's names
        return True

    def release(self) -> None:
        self.flows.set()

    def read(self) -> tuple[bool, Any]:
        assert self.flows.wait(LONG_S)
        lost, self.lost = self.lost, 0
        self._never.wait((1 + lost) * PERIOD_S)
        self.number += 1
        self.values[cv2.CAP_PROP_POS_MSEC] = (time.monotonic_ns() + self.ahead_ns) / 1e6
        picture = np.full((480, 640, 2), self.number % 200, np.uint8)
        if self.values[cv2.CAP_PROP_CONVERT_RGB]:
            picture = np.zeros((480, 640, 3), np.uint8)
        return (False, None) if self.gone else (True, picture)


Plug = Callable[..., tuple[Streaming, VirtualDevice]]


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Iterator[Plug]:
    """Plug a camera in: what OpenCV gives of it, and what the kernel says; `does` is what the kernel's side does."""
    with ExitStack() as leaving:

        def plug(**does: Any) -> tuple[Streaming, VirtualDevice]:
            capture = Streaming()
            monkeypatch.setattr(cv2, "VideoCapture", lambda *_: capture)
            return capture, leaving.enter_context(VirtualDevice(virtually(), Faked(**does)))

        yield plug


def opened(**options: object) -> OpenCvCamera:
    camera = open_camera("left", {"device": str(NODE), "focus": 0, **options}, NODE.parent)
    assert isinstance(camera, OpenCvCamera)
    return camera


def armed(**options: object) -> OpenCvCamera:
    camera = opened(**options)
    camera.configure(CameraSettings(0.001))
    camera.arm(1, Trigger.FREE)
    return camera


def test_a_camera_is_what_the_kernel_says_and_its_frames_are_those_of_its_stamps(plugged: Plug) -> None:
    capture, _ = plugged()
    camera = armed()
    info = camera.info
    assert (info.serial, set(info.triggers), str(info.format.size)) == (str(NODE), {Trigger.FREE}, "640 x 480")
    assert info.exposure_range_s == pytest.approx((0.0003, 0.2047))
    assert "V4L2" in info.model
    for _ in range(3):
        after_ns = time.monotonic_ns()
        frame = camera.read(after_ns, LONG_S)
        assert after_ns <= frame.t_start_ns - frame.t_err_ns
        assert frame.t_end_ns - frame.t_start_ns == 1_000_000
        assert 0 <= capture.number - int(frame.image[0, 0]) <= 10, "one of the newest"
    capture.lost = 50
    assert camera.read(time.monotonic_ns() + 60_000_000, LONG_S).dropped_count > 5
    camera.close()


def test_a_device_in_use_by_another_program_is_busy(plugged: Plug) -> None:
    _, device = plugged()
    device.fault("busy")
    with pytest.raises(DeviceBusyError, match=r"/dev/video0: .*it is held"):
        opened()
    device.fault("busy", on=False)
    opened().close()


def test_a_camera_that_falls_silent_times_out_and_one_that_is_unplugged_is_gone(plugged: Plug) -> None:
    capture, device = plugged()
    camera = armed()
    capture.flows.clear()
    with pytest.raises(FrameTimeoutError, match="no frame exposed entirely after"):
        camera.read(time.monotonic_ns() + 20_000_000, 0.05)
    capture.flows.set()
    assert camera.read(time.monotonic_ns(), LONG_S).image.size
    device.fault("unplugged")
    capture.gone = True
    with pytest.raises(DeviceGoneError, match="/dev/video0 gives no more frames: it was unplugged"):
        camera.read(time.monotonic_ns() + 10**12, LONG_S)
    camera.disarm()
    with pytest.raises(DeviceGoneError):
        camera.arm(1, Trigger.FREE)
    camera.close()
    with pytest.raises(DeviceGoneError, match="the camera is gone: plug it in again"):
        opened()


def test_stamps_of_another_clock_are_refused_unless_a_delay_is_given(plugged: Plug) -> None:
    capture, _ = plugged()
    capture.ahead_ns = 1_700_000_000 * 10**9
    with pytest.raises(UnsupportedByDeviceError, match=r"not of CLOCK_MONOTONIC.*write delay_s"):
        armed()
    camera = armed(delay_s=0.03, frame_rate_hz=1 / PERIOD_S)
    assert camera.read(0, LONG_S).image.size
    camera.close()


def test_image_processing_is_off_and_a_control_that_fails_is_noted(plugged: Plug) -> None:
    stuck = tuple({**each, "stalls": ["set"], "errno": 5} if each["name"] == "Contrast" else each for each in CONTROLS)
    _, device = plugged(controls=(*stuck, control(0x00980912, "Gain, Automatic", 0, 1, 1)))
    camera = opened(skip_controls=["backlight_compensation", "gain"])
    [note] = camera.info.notes
    assert "requested contrast = 32, the driver refuses it" in note
    assert camera.info.gain_range == (1.0, 1.0)
    known = device.kernel.controls_set
    assert (known["Sharpness"], known["Gamma"], known["Gain, Automatic"]) == (0, 100, 0)
    assert not known.keys() & {"Backlight Compensation", "Gain", "Contrast"}
    camera.close()
    with pytest.raises(UnsupportedByDeviceError, match="control 'gian', the device has: auto_exposure"):
        opened(skip_controls=["gian"])


def test_a_lens_with_a_motor_needs_its_place(plugged: Plug) -> None:
    plugged()
    with pytest.raises(UnsupportedByDeviceError, match=r"a motor moves its lens.*focus = 0 is the present one"):
        opened(focus=None)
    opened(focus=None, skip_controls=["focus_absolute"]).close()


def options(**given: Any) -> OpenCvOptions:
    return OpenCvOptions(device=0, **given)


def obstinate(**more: Any) -> Any:
    return Obstinate(**more)


def controls(capture: Any, **given: Any) -> CaptureControls:
    return CaptureControls(capture, options(**given), "/dev/video0", fixed_s=0.033)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"fourcc": "GREY"}, "requested pixel format GREY, the driver gives YUYV; choose"),
        ({"size_px": (1920, 1080)}, "requested 1920 x 1080, the driver gives 640 x 480"),
        ({"frame_rate_hz": 60.0}, "requested 60 frames per second, the driver gives 30"),
    ],
)
def test_settings_that_the_driver_changes_are_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        negotiate(obstinate(fixed={cv2.CAP_PROP_FPS}), options(**asked), "/dev/video0")


def test_settings_that_the_driver_accepts_are_used() -> None:
    capture = obstinate()
    negotiate(capture, options(fourcc="MJPG", size_px=(1280, 720), frame_rate_hz=29.97), "/dev/video0")
    # A pixel format first: it decides which extents and rates there are.
    assert capture.order == [
        *(cv2.CAP_PROP_MODE, cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT),
        cv2.CAP_PROP_FPS,
    ]


def test_automatic_controls_are_switched_off_first() -> None:
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
        (cv2.CAP_PROP_AUTO_EXPOSURE, "automatic exposure cannot be switched off: requested 1, the driver gives 3"),
        (cv2.CAP_PROP_AUTOFOCUS, "autofocus cannot be switched off"),
        (cv2.CAP_PROP_AUTO_WB, "automatic white balance cannot"),
    ],
)
def test_an_automatic_that_stays_on_is_refused(which: int, words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        controls(obstinate(fixed={which}))


def test_ranges_are_probed_and_values_restored() -> None:
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


def test_a_setting_that_the_device_changes_is_refused() -> None:
    capture = obstinate()
    set_up = controls(capture)
    capture.ranges[cv2.CAP_PROP_EXPOSURE] = (3, 100)
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure in units of 100 µs 167, the driver gives 100; write"):
        set_up.apply(CameraSettings(1 / 60))
    with pytest.raises(UnsupportedByDeviceError, match=r"focus 300, the driver gives 250"):
        controls(obstinate(), focus=300.0)
    with pytest.raises(UnsupportedByDeviceError, match=r"focus 30, the driver has no such control"):
        controls(obstinate(absent=[cv2.CAP_PROP_FOCUS]), focus=30.0)


def test_a_camera_without_controls_has_fixed_settings() -> None:
    capture = obstinate(absent=[cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_GAIN])
    found = controls(capture)
    assert (found.exposure_range_s, found.gain_range) == ((0.033, 0.033), (1.0, 1.0))
    assert found.read_back().exposure_s == 0.033
