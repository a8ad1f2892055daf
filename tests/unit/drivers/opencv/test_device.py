"""A camera of the kernel's, by its stamps: real OpenCV over a fake device (umockdev)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.devices import Camera, CameraSettings, Rig, Trigger
from slrig.errors import DeviceBusyError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Pixels
from tests.contract.bench_head import BenchHead
from tests.contract.opencv_bench import DeviceHost
from tests.contract.pairing import FRAMES, wrong_pairings
from tests.contract.stage import StagedProjector
from tests.contract.suite import rig_of
from tests.contract.v4l2_bench import CONTROLS, Faked, FakeDevice, control, sequence, staged, why_not

pytestmark = pytest.mark.slow

SIZE = [80, 60]
LONG_S = 10.0
GREY: dict[str, object] = {"fourcc": "GREY", "size_px": SIZE, "frame_rate_hz": 50}
Plug = Callable[..., FakeDevice]


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Plug]:
    """Plug a fake camera in: `plugged(pixel format, **what it does)`. Skips where umockdev is not installed."""
    if why_not():
        pytest.skip(why_not())
    with ExitStack() as leaving:

        def plug(code: str = "GREY", **does: object) -> FakeDevice:
            faked = Faked(formats={code: [(80, 60)]}, **does)  # type: ignore[arg-type]
            return leaving.enter_context(DeviceHost(tmp_path, staged(code, noise_dn=1.0), faked))

        yield plug


def follows(camera: Camera, device: FakeDevice, *, exposure_s: float, most_dn: float = 8, turns: int = 6) -> None:
    """Expect that each pattern that is shown is the one that is seen."""
    shown, light = sequence(), device.stage
    projector, rng, idle = StagedProjector(light), np.random.default_rng(2), threading.Event()
    projector.load(shown)
    camera.arm(1, Trigger.FREE)
    last = -1
    for _ in range(turns):
        # Long enough for every buffer to be full of another pattern.
        idle.wait(rng.choice([0.0, 0.15]))
        index = int(rng.integers(len(shown)))
        seen = projector.show(index)
        after_ns = seen.t_visible_ns + seen.t_err_ns
        frame = camera.read(after_ns, LONG_S)
        assert frame.t_start_ns - frame.t_err_ns >= after_ns
        assert frame.t_end_ns - frame.t_err_ns <= time.monotonic_ns()
        assert frame.sequence_number > last
        last = frame.sequence_number
        wanted = light.expected(shown.profiles[index], exposure_s=exposure_s)
        assert np.abs(frame.image.astype(int) - wanted).mean() < most_dn, index
    camera.disarm()


def read_on(camera: Camera) -> None:
    """Read until it fails."""
    while True:
        camera.read(time.monotonic_ns(), LONG_S)


@pytest.mark.parametrize("stamp", ["start", "first packet", "end"])
def test_whatever_the_stamp_names_no_frame_is_stale(plugged: Plug, stamp: str) -> None:
    device = plugged(stamp=stamp, jitter_s=0.003, lost=0.1)
    camera = device.open_camera(**GREY)
    assert camera.configure(CameraSettings(0.01)).exposure_s == pytest.approx(0.01)
    follows(camera, device, exposure_s=0.01, turns=10)
    # Set while it was not streaming, and in effect when it streams again.
    camera.configure(CameraSettings(0.005))
    follows(camera, device, exposure_s=0.005)
    camera.close()


@pytest.mark.parametrize(("code", "bit_depth"), [("Y10 ", 10), ("Y16 ", 16), ("MJPG", 8)])
def test_raw_formats_come_through_opencv(plugged: Plug, code: str, bit_depth: int) -> None:
    device = plugged(code)
    camera = device.open_camera(**{**GREY, "fourcc": code.strip()})
    assert camera.info.format.bit_depth == bit_depth
    camera.configure(CameraSettings(0.01))
    follows(camera, device, exposure_s=0.01, most_dn=0.05 * 2**bit_depth)
    camera.close()


def test_a_camera_declares_what_was_found_out(plugged: Plug) -> None:
    camera = plugged().open_camera(**GREY)
    info = camera.info
    assert info.exposure_range_s == pytest.approx((0.0001, 0.04))
    assert info.gain_range[0] == 1.0
    assert "V4L2" in info.model
    assert (info.serial, set(info.triggers)) == ("/dev/video0", {Trigger.FREE})
    camera.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fourcc": "MJPG"}, "asked for pixel format MJPG, the driver gives GREY"),
        ({"size_px": [640, 480]}, "asked for 640 x 480, the driver gives 80 x 60"),
        ({"focus": 251.0}, "focus 251, the driver"),
    ],
)
def test_what_the_device_does_not_have_is_refused(plugged: Plug, options: dict[str, object], words: str) -> None:
    device = plugged()
    with pytest.raises(UnsupportedByDeviceError, match=words):
        device.open_camera(**{**GREY, **options})
    device.open_camera(**GREY).close()


def test_a_device_that_another_program_holds_is_busy(plugged: Plug) -> None:
    device = plugged()
    device.fault("busy")
    begun_s = time.monotonic()
    with pytest.raises(DeviceBusyError, match=r"/dev/video0: .*it is held"):
        device.open_camera(**GREY)
    # OpenCV would have waited for ten seconds.
    assert time.monotonic() - begun_s < 5
    device.fault("busy", on=False)
    first = device.open_camera(**GREY)
    with pytest.raises(DeviceBusyError):
        device.open_camera(**GREY)
    first.close()
    device.open_camera(**GREY).close()


def test_an_unplugged_camera_is_gone_and_can_be_closed(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera(**GREY)
    camera.configure(CameraSettings(0.01))
    camera.arm(1, Trigger.FREE)
    camera.read(0, LONG_S)
    device.fault("unplugged")
    with pytest.raises(DeviceGoneError, match="/dev/video0 gives no more frames: it was unplugged"):
        read_on(camera)
    camera.disarm()
    with pytest.raises(DeviceGoneError):
        camera.arm(1, Trigger.FREE)
    camera.close()
    with pytest.raises(DeviceGoneError, match="the camera is gone: plug it in again"):
        device.open_camera(**GREY)
    device.fault("unplugged", on=False)
    device.open_camera(**GREY).close()


def test_a_silent_camera_times_out_in_arm_and_in_read(plugged: Plug) -> None:
    device = plugged()
    camera = device.open_camera(**GREY)
    camera.configure(CameraSettings(0.01))
    camera.arm(1, Trigger.FREE)
    camera.read(0, LONG_S)
    device.fault("silent")
    with pytest.raises(FrameTimeoutError, match="no frame that was exposed wholly after"):
        camera.read(time.monotonic_ns(), 0.2)
    device.fault("silent", on=False)
    assert camera.read(time.monotonic_ns(), LONG_S).dropped_count > 0
    camera.close()


def test_stamps_of_another_clock_are_refused_with_what_to_do(plugged: Plug) -> None:
    device = plugged(stamp="other clock")
    camera = device.open_camera(**GREY)
    with pytest.raises(UnsupportedByDeviceError, match=r"not of CLOCK_MONOTONIC.*write delay_s"):
        camera.arm(1, Trigger.FREE)
    camera.close()
    # By arrival, it works.
    camera = device.open_camera(**GREY, delay_s=0.03)
    camera.configure(CameraSettings(0.01))
    follows(camera, device, exposure_s=0.01)
    camera.close()


@pytest.mark.slow
@pytest.mark.parametrize("stamp", ["start", "first packet", "end"])
def test_no_wrong_pairing_in_many_frames_by_stamps(plugged: Plug, stamp: str) -> None:
    # Damaged buffers are not among the disturbances: OpenCV does not say which they are.
    exposure_s, shown = 0.002, sequence()
    device = plugged(stamp=stamp, jitter_s=0.001, readout_s=0.001, bands=4, lost=0.1)
    light = device.stage

    def open_head() -> BenchHead:
        camera = device.open_camera(**{**GREY, "frame_rate_hz": 200})
        return BenchHead({"left": camera}, StagedProjector(light))

    def open_rig() -> Rig:
        return replace(rig_of(open_head()), settings={"left": CameraSettings(exposure_s)})

    def expected(_: str, index: int) -> Pixels:
        return light.expected(shown.profiles[index], exposure_s=exposure_s)

    result = wrong_pairings(open_rig, shown, expected, frames=FRAMES, seed=4, longest_idle_s=0.05, proven=False)
    assert result.frames >= FRAMES
    assert (result.wrong, result.examples) == (0, ())


def test_its_own_image_processing_is_off_and_what_refuses_is_told(plugged: Plug) -> None:
    stuck = tuple({**each, "stalls": ["set"], "errno": 5} if each["name"] == "Contrast" else each for each in CONTROLS)
    device = plugged(controls=(*stuck, control(0x00980912, "Gain, Automatic", 0, 1, 1)))
    camera = device.open_camera(**GREY, skip_controls=["backlight_compensation", "gain"])
    [note] = camera.info.notes
    assert "asked contrast = 32, the driver refuses it" in note
    assert camera.info.gain_range == (1.0, 1.0)
    known = device.controls_set()
    assert (known["Sharpness"], known["Gamma"], known["Gain, Automatic"]) == (0, 100, 0)
    assert not known.keys() & {"Backlight Compensation", "Gain", "Contrast"}
    assert camera.configure(CameraSettings(0.01)).least_period_s == pytest.approx(1 / 50)
    camera.close()
    with pytest.raises(UnsupportedByDeviceError, match="control 'gian', the device has: auto_exposure"):
        device.open_camera(**GREY, skip_controls=["gian"])
