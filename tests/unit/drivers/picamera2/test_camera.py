"""The picamera2 driver on a stand-in for the library, on virtual time: settings, pixels, times, and what goes wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from drivers.picamera2 import PiCamera, find_devices, open_camera
from drivers.picamera2 import camera as camera_module
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Rig, Trigger
from slrig.errors import DeviceBusyError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Frame, Size
from tests.contract.picamera2_bench import connect, global_shutter
from tests.contract.stage import Stage
from tests.unit.capture.fake_rig import Scene
from tests.unit.drivers.picamera2.fake_picamera2 import BLANK_US, Pi
from tests.unit.drivers.serial_projector.conftest import SEQUENCE, Bench
from tests.virtual_clock import VirtualClock

WHITE = np.full((1, 1), 255, np.uint8)
EXPOSURE_S = 0.005
SIZE = Size(60, 40)


def pi(*, bit_depth: int = 10, **fields: object) -> Pi:
    return Pi(Stage(Scene(camera=SIZE, bit_depth=bit_depth), clock=VirtualClock()), **fields)  # type: ignore[arg-type]


@contextmanager
def opened(where: Pi, **options: object) -> Iterator[PiCamera]:
    camera = where.opened(**options)
    try:
        yield camera
    finally:
        camera.close()
        assert where.held == 0, "every request was released"


def frames(camera: PiCamera, count: int) -> list[Frame]:
    camera.configure(CameraSettings(EXPOSURE_S))
    camera.arm(count, Trigger.FREE)
    return [camera.read(0, 5.0) for _ in range(count)]


def test_a_camera_is_found_by_the_id_of_libcamera() -> None:
    with pi().connected():
        (found,) = find_devices()
        assert found.driver == "picamera2"
        assert found.device.endswith("ov9281@60")
        with pytest.raises(DeviceGoneError, match=r"camera 'Acme' is not connected; found: .*ov9281@60"):
            open_camera("left", {"device": "Acme"}, Path())
    with pytest.raises(DeviceBusyError, match="another program uses"):
        pi(held_elsewhere=True).opened()


def test_settings_become_controls_and_give_the_shortest_period() -> None:
    where = pi()
    with opened(where) as camera:
        fast = camera.configure(CameraSettings(0.005, 2.0))
        assert camera.info.exposure_range_s == pytest.approx((80e-6, 0.066666))
        assert camera.info.gain_range == (1.0, 16.0)
        with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s 0\.00015 and gain 1, it gives 0\.00016 and 1"):
            camera.configure(CameraSettings(0.00015))
        slow = camera.configure(CameraSettings(0.02))
    assert (fast.exposure_s, fast.gain, fast.min_period_s) == pytest.approx((0.005, 2.0, 0.008333))
    assert slow.min_period_s == pytest.approx(0.02 + BLANK_US / 1e6)
    # Nothing automatic, and no sharpening: what its controls are, and not those that it lacks.
    off = {"AeEnable": False, "AwbEnable": False, "NoiseReductionMode": 0, "Sharpness": 0.0, "Contrast": 1.0}
    assert where.asked == {**off, "ExposureTime": 20_000, "AnalogueGain": 1.0, "FrameDurationLimits": (8_333, 25_000)}


def test_a_motorised_lens_is_set() -> None:
    where = pi()
    with pytest.raises(UnsupportedByDeviceError, match="its lens is fixed"):
        where.opened(focus_dioptres=2)
    where.controls |= {"LensPosition": (0.0, 32.0, 1.0), "AfMode": (0, 2, 0)}
    with pytest.raises(UnsupportedByDeviceError, match="write focus_dioptres"):
        where.opened()
    with opened(where, focus_dioptres=2.0) as camera:
        camera.configure(CameraSettings(EXPOSURE_S))
    assert (where.asked["AfMode"], where.asked["LensPosition"]) == (0, 2.0)


@pytest.mark.parametrize(
    ("pixels", "raw_format", "bit_depth"),
    [("raw", "R10", 10), ("raw", "R8", 8), ("luma", "R10", 8), ("raw", "R16", 16), ("raw", "SRGGB10", 10)],
)
def test_pixels_are_those_of_the_sensor(pixels: str, raw_format: str, bit_depth: int) -> None:
    where = pi(bit_depth=bit_depth, raw_format=raw_format)
    where.stage.show(WHITE)
    with opened(where, pixels=pixels) as camera:
        assert camera.info.format.bit_depth == bit_depth
        (frame,) = frames(camera, 1)
    expected = where.stage.expected(WHITE, exposure_s=EXPOSURE_S)
    assert frame.image.dtype == expected.dtype
    # A mosaic is interpolated.
    off = np.abs(frame.image.astype(float) - expected)
    assert np.median(off) < 0.02 * expected.mean() if raw_format == "SRGGB10" else off.max() == 0


def test_missing_modes_and_formats_are_refused() -> None:
    half = (SIZE.width_px // 2, SIZE.height_px // 2)
    with opened(pi(), size_px=half) as camera:
        assert camera.info.format.size.shape == half[::-1]
    with pytest.raises(UnsupportedByDeviceError, match=f"has the modes {half[0]} x {half[1]}"):
        pi().opened(size_px=(17, 17))
    with pytest.raises(UnsupportedByDeviceError, match="libcamera gives MONO_PISP_COMP1"):
        pi(gives={"format": "MONO_PISP_COMP1"}).opened()


@pytest.mark.parametrize("suspended_s", [0.0, 3600.0])
@pytest.mark.parametrize("stamps_start", [False, True])
def test_stamps_of_either_kind_and_clock_give_the_exposure(
    stamps_start: bool, suspended_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    offset_ns = round(suspended_s * 1e9)
    monkeypatch.setattr(time, "clock_gettime_ns", lambda _: time.monotonic_ns() + offset_ns)
    where = pi(stamps_start=stamps_start, stamp_offset_ns=offset_ns)
    with opened(where, time_stamp="exposure" if stamps_start else "readout") as camera:
        taken = frames(camera, 5)
    for frame in taken:
        assert any(abs(start_ns - frame.t_start_ns) <= frame.t_err_ns for start_ns, _ in where.exposures)
        assert frame.t_end_ns - frame.t_start_ns == pytest.approx((EXPOSURE_S + frame.shutter_skew_s) * 1e9, abs=2)
        assert 0 <= frame.shutter_skew_s <= 0.008333
    with opened(pi(), global_shutter=True) as camera:
        assert frames(camera, 1)[0].shutter_skew_s == 0


def test_lost_and_damaged_frames_are_counted_by_the_elapsed_time() -> None:
    with opened(pi(lost=0.2, damaged=0.1)) as camera:
        taken = frames(camera, 40)
    numbers = [frame.sequence_number for frame in taken]
    assert numbers == sorted(set(numbers))
    assert taken[-1].dropped_count == numbers[-1] - len(taken) + 1
    assert taken[-1].dropped_count >= 5


def test_a_camera_that_falls_silent_times_out_and_can_be_closed() -> None:
    where = pi()
    with opened(where) as camera:
        frames(camera, 1)
        where.frozen = True
        with pytest.raises(FrameTimeoutError, match="check its cable"):
            camera.read(where.stage.clock.now_ns(), 0.2)


@pytest.fixture
def trigger_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The kernel's switch, set to pulses."""
    file = tmp_path / "trigger_mode"
    file.write_text("1\n")
    monkeypatch.setattr(camera_module, "TRIGGER_MODE", file)
    return file


def wired(clock: VirtualClock, **scene: Any) -> Pi:
    return global_shutter(Scene(camera=SIZE, bit_depth=10, **scene), clock)


@pytest.mark.usefixtures("trigger_mode")
def test_a_pulse_on_the_wire_is_an_exposure_and_every_frame_is_kept() -> None:
    clock = VirtualClock()
    where = wired(clock)
    assert where.pulses is not None
    where.stage.show(WHITE)
    with opened(where, external_trigger=True) as camera:
        assert camera.info.triggers == {Trigger.HARDWARE}
        assert camera.info.exposed_by_pulse
        assert camera.info.exposure_range_s == (50e-6, 1.0)
        applied = camera.configure(CameraSettings(EXPOSURE_S, 2.0))
        assert applied.min_period_s == pytest.approx(EXPOSURE_S + 0.016562)
        for count in (8, 3):
            camera.arm(count + 1, Trigger.HARDWARE)
            with pytest.raises(FrameTimeoutError, match="the wire to XTR"):
                camera.read(0, 0.1)
            begin_ns = clock.now_ns()
            where.pulses.extend((begin_ns + 25_000_000 * at, begin_ns + 25_000_000 * at + 5_000_000) for at in range(8))
            # Nobody reads meanwhile.
            clock.advance(0.5)
            for at in range(count):
                frame = camera.read(0, 1.0)
                assert abs(frame.t_start_ns - begin_ns - 25_000_000 * at) <= frame.t_err_ns
                assert (frame.sequence_number, frame.dropped_count) == (at + 1, 0)
                assert (frame.exposure_s, frame.gain, frame.shutter_skew_s) == (EXPOSURE_S, 2.0, 0.0)
                np.testing.assert_array_equal(frame.image, where.stage.expected(WHITE, exposure_s=2 * EXPOSURE_S))
            camera.disarm()


@pytest.mark.parametrize(
    ("model", "mode", "external", "words"),
    [
        ("imx296", "0", True, "runs freely; echo 1 | sudo tee"),
        ("imx296", "1", False, "waits for pulses on XTR; echo 0 | sudo tee"),
        ("ov9281", "1", True, "which sensor imx296 has, and this is ov9281"),
    ],
)
def test_a_sensor_that_is_switched_otherwise_is_refused(
    trigger_mode: Path, model: str, mode: str, external: bool, words: str
) -> None:
    trigger_mode.write_text(f"{mode}\n")
    with pytest.raises(UnsupportedByDeviceError, match=words):
        pi(model=model).opened(external_trigger=external)


@pytest.mark.usefixtures("trigger_mode")
def test_a_trigger_box_and_a_global_shutter_camera_scan_by_wire(make_bench: Callable[..., Bench]) -> None:
    box = make_bench()
    where = wired(box.clock, projector=SEQUENCE.projector, columns_per_px=SEQUENCE.projector.width_px / SIZE.width_px)
    connect(where, box)
    projector = box.open()
    assert projector.info.pulses_expose
    with opened(where, external_trigger=True) as camera:
        for exposure_s in (0.0025, 0.01):
            settings = {"left": CameraSettings(exposure_s)}
            rig = Rig("bench", {"left": camera}, projector, settings, clock=box.clock)
            shots = list(capture(rig, SEQUENCE))
            assert [shot.pattern for shot in shots] == list(range(len(SEQUENCE)))
            begun, ended = where.exposures[-1]
            assert ended - begun == round(exposure_s * 1e9)
        # Another camera on the wire would make the pulses longer.
        with opened(wired(box.clock), external_trigger=True) as other:
            cameras = {"left": camera, "right": other}
            rig = Rig("bench", cameras, projector, {**settings, "right": CameraSettings(0.02)}, clock=box.clock)
            with pytest.raises(UnsupportedByDeviceError, match=r"which is 0\.02 s .* and its exposure_s is 0\.01 s"):
                list(capture(rig, SEQUENCE))
        own_pulses = replace(projector.info, pulses_expose=False)
        with mock.patch.object(type(projector), "info", own_pulses):
            rig = Rig("bench", {"left": camera}, projector, settings, clock=box.clock)
            with pytest.raises(UnsupportedByDeviceError, match="have a length of their own; use a trigger box"):
                list(capture(rig, SEQUENCE))
