"""A camera of the kernel's, by its stamps: real OpenCV over a fake device (umockdev).

What every driver is asked, `tests/contract/test_contract.py` asks on the same device.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from slrig.devices import Camera, CameraSettings, Trigger
from slrig.errors import DeviceBusyError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from tests.contract.opencv_umockdev import UmockdevDevice
from tests.contract.v4l2_bench import CONTROLS, Faked, control

pytestmark = pytest.mark.slow

LONG_S = 10.0
WHITE = np.full((1, 1), 255, np.uint8)
Plug = Callable[..., UmockdevDevice]


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Plug]:
    """Plug a fake camera in: `plugged(pixel format, **what it does)`."""
    with ExitStack() as leaving:

        def plug(code: str = "GREY", **does: object) -> UmockdevDevice:
            faked = Faked(formats={code: [(80, 60)]}, **does)  # type: ignore[arg-type]
            return leaving.enter_context(UmockdevDevice(tmp_path, faked, code))

        yield plug


def shows_white(camera: Camera, device: UmockdevDevice, *, most_dn: float = 8) -> None:
    """Expect a frame of the light that is shown now."""
    camera.configure(CameraSettings(0.01))
    camera.arm(1, Trigger.FREE)
    frame = camera.read(device.stage.show(WHITE), LONG_S)
    assert np.abs(frame.image.astype(int) - device.stage.expected(WHITE)).mean() < most_dn
    camera.close()


@pytest.mark.parametrize(("code", "bit_depth"), [("Y10 ", 10), ("Y16 ", 16), ("MJPG", 8)])
def test_raw_formats_come_through_opencv(plugged: Plug, code: str, bit_depth: int) -> None:
    device = plugged(code)
    camera = device.open_camera(fourcc=code.strip())
    assert camera.info.format.bit_depth == bit_depth
    shows_white(camera, device, most_dn=0.05 * 2**bit_depth)


def test_a_camera_declares_what_it_can_do_and_refuses_the_rest(plugged: Plug) -> None:
    device = plugged()
    for options, words in (
        ({"fourcc": "MJPG"}, "asked for pixel format MJPG, the driver gives GREY"),
        ({"size_px": [640, 480]}, "asked for 640 x 480, the driver gives 80 x 60"),
        ({"focus": 251.0}, "focus 251, the driver"),
    ):
        with pytest.raises(UnsupportedByDeviceError, match=words):
            device.open_camera(**options)
    camera = device.open_camera()
    info = camera.info
    assert info.exposure_range_s == pytest.approx((0.0001, 0.04))
    assert info.gain_range[0] == 1.0
    assert "V4L2" in info.model
    assert (info.serial, set(info.triggers)) == ("/dev/video0", {Trigger.FREE})
    camera.close()


def test_a_device_that_another_program_holds_is_busy(plugged: Plug) -> None:
    device = plugged()
    device.fault("busy")
    with pytest.raises(DeviceBusyError, match=r"/dev/video0: .*it is held"):
        device.open_camera()
    device.fault("busy", on=False)
    first = device.open_camera()
    with pytest.raises(DeviceBusyError):
        device.open_camera()
    first.close()
    device.open_camera().close()


def test_a_camera_that_falls_silent_times_out_and_one_that_is_unplugged_is_gone(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera()
    camera.configure(CameraSettings(0.01))
    camera.arm(1, Trigger.FREE)
    camera.read(0, LONG_S)
    device.fault("silent")
    with pytest.raises(FrameTimeoutError, match="no frame that was exposed wholly after"):
        camera.read(time.monotonic_ns(), 0.2)
    device.fault("silent", on=False)
    assert camera.read(time.monotonic_ns(), LONG_S).dropped_count > 0
    device.fault("unplugged")
    with pytest.raises(DeviceGoneError, match="/dev/video0 gives no more frames: it was unplugged"):
        camera.read(time.monotonic_ns() + 10**12, LONG_S)
    camera.disarm()
    with pytest.raises(DeviceGoneError):
        camera.arm(1, Trigger.FREE)
    camera.close()
    with pytest.raises(DeviceGoneError, match="the camera is gone: plug it in again"):
        device.open_camera()
    device.fault("unplugged", on=False)
    device.open_camera().close()


def test_stamps_of_another_clock_are_refused_unless_a_delay_is_given(plugged: Plug) -> None:
    device = plugged(stamp="other clock")
    camera = device.open_camera()
    with pytest.raises(UnsupportedByDeviceError, match=r"not of CLOCK_MONOTONIC.*write delay_s"):
        camera.arm(1, Trigger.FREE)
    camera.close()
    shows_white(device.open_camera(delay_s=0.03), device)


def test_image_processing_is_off_and_a_control_that_fails_is_noted(plugged: Plug) -> None:
    stuck = tuple({**each, "stalls": ["set"], "errno": 5} if each["name"] == "Contrast" else each for each in CONTROLS)
    device = plugged(controls=(*stuck, control(0x00980912, "Gain, Automatic", 0, 1, 1)))
    camera = device.open_camera(skip_controls=["backlight_compensation", "gain"])
    [note] = camera.info.notes
    assert "asked contrast = 32, the driver refuses it" in note
    assert camera.info.gain_range == (1.0, 1.0)
    known = device.controls_set()
    assert (known["Sharpness"], known["Gamma"], known["Gain, Automatic"]) == (0, 100, 0)
    assert not known.keys() & {"Backlight Compensation", "Gain", "Contrast"}
    assert camera.configure(CameraSettings(0.01)).least_period_s == pytest.approx(1 / 50)
    camera.close()
    with pytest.raises(UnsupportedByDeviceError, match="control 'gian', the device has: auto_exposure"):
        device.open_camera(skip_controls=["gian"])
