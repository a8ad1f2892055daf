"""The gentl driver on a GenTL producer of our own: settings, formats, triggers, clocks, and what goes wrong."""

from __future__ import annotations

import importlib
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from drivers.genicam import GenicamCamera, find_gentl_devices, open_gentl_camera
from slrig.devices import CameraSettings, Trigger
from slrig.errors import (
    DeviceBusyError,
    DeviceGoneError,
    FrameTimeoutError,
    LibraryMissingError,
    UnsupportedByDeviceError,
)
from slrig.model import Frame, Size
from tests.contract.genicam_bench import CAMERA, Fate, scene
from tests.contract.gentl_bench import serving, table
from tests.contract.gentl_camera import OVERHEAD_S, MemoryCamera
from tests.contract.gentl_producer import FakeProducer
from tests.contract.stage import Stage
from tests.unit.drivers.genicam.test_pairing import EXPOSURE_S, GAIN, Disturbed, Pairing, numbers_rise

LONG_S = 5.0
WHITE = np.full((1, 1), 255, np.uint8)
NO_LATCH = ("TimestampLatch", "TimestampLatchValue")

Opened = Callable[..., GenicamCamera]


@pytest.fixture
def producer() -> Iterator[FakeProducer]:
    found = serving(MemoryCamera(Stage(scene())))
    found.opened = False
    yield found
    found.camera.stop()


@pytest.fixture
def opened(producer: FakeProducer) -> Iterator[Opened]:
    """Opens the driver's camera with options, set to 5 ms; closes it after the test."""
    with ExitStack() as closing:

        def call(**options: object) -> GenicamCamera:
            camera = open_gentl_camera("left", table(producer, **options), Path())
            assert isinstance(camera, GenicamCamera)
            closing.callback(camera.close)
            camera.configure(CameraSettings(0.005))
            return camera

        yield call


def expose(camera: GenicamCamera) -> Frame:
    camera.trigger()
    return camera.read(0, LONG_S)


def within(frame: Frame, camera: MemoryCamera) -> bool:
    """Whether one of the exposures that were made is where the frame says."""
    return any(abs(start_ns - frame.t_start_ns) <= frame.t_err_ns for start_ns, _ in camera.exposures)


# ---- what is there


def test_it_is_found_while_it_is_open_and_opened_by_id_or_serial_number(
    producer: FakeProducer, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{producer.file.parent}")
    before = signal.getsignal(signal.SIGINT)
    camera = opened(device="M1", producer=None)
    # harvesters would have Ctrl-C for itself.
    assert signal.getsignal(signal.SIGINT) is before
    assert (camera.info.model, camera.info.serial, camera.info.triggers) == ("Slrig Memory", "M1", frozenset(Trigger))
    assert camera.info.exposure_range_s == pytest.approx((2e-5, 1.0))
    (found,) = find_gentl_devices()
    assert (found.driver, found.device, found.label) == (
        "gentl",
        "slrig-memory-M1",
        "Slrig Memory M1 (Custom, producer.cti)",
    )
    camera.arm(1, Trigger.SOFTWARE)
    assert expose(camera).image.shape == CAMERA.shape


def test_what_is_not_there_is_told_with_what_to_do(
    producer: FakeProducer, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DeviceGoneError, match=r"no GenTL camera 'Acme'.*found: slrig-memory-M1 \(by producer.cti\)"):
        opened(device="Acme")
    with pytest.raises(LibraryMissingError, match=r"no GenTL producer .*acme\.cti"):
        opened(producer="acme.cti")
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(LibraryMissingError, match=r"no GenTL producer is known.*GENICAM_GENTL64_PATH"):
        opened(producer=None)
    assert find_gentl_devices() == ()
    producer.opened = True
    with pytest.raises(DeviceBusyError, match="another program controls"):
        opened()


def test_the_producer_that_comes_with_the_wheel_is_listed_and_its_games_are_refused() -> None:
    serving(MemoryCamera(Stage(scene())))
    file = Path(str(importlib.import_module("genicam").__file__)).parent / "viky.cti"
    options = {"device": "VikyTL_DEV_red", "producer": str(file), "pixel_format": "Mono8"}
    with pytest.raises(UnsupportedByDeviceError, match="no feature ExposureTime"):
        open_gentl_camera("left", options, Path())
    with pytest.raises(DeviceGoneError, match="VikyTL_DEV_red, VikyTL_DEV_green, VikyTL_DEV_blue"):
        open_gentl_camera("left", {**options, "device": "Acme"}, Path())


# ---- settings


def test_what_the_camera_takes_otherwise_is_noticed_behind_the_cache(opened: Opened) -> None:
    camera = opened()
    applied = camera.configure(CameraSettings(0.01, 2.5))
    assert applied.gain == 2.5
    assert applied.least_period_s == pytest.approx(0.01 + OVERHEAD_S)
    with pytest.raises(UnsupportedByDeviceError, match=r"asked for gain 2\.7, it gives 2\.5"):
        camera.configure(CameraSettings(0.01, 2.7))
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s 11, it takes 2e-05 to 1"):
        camera.configure(CameraSettings(11.0))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"features": {"Gamma": 1.0}}, "no feature Gamma"),
        ({"features": {"ReverseX": 1}}, "of the kind Boolean"),
        ({"features": {"DeviceUserID": 1}}, "of the kind String"),
        ({"features": {"TimestampLatch": 1}}, "of the kind Command"),
        ({"pixel_format": "Mono16"}, "PixelFormat Mono16, it offers Mono8, Mono12"),
        ({"region": {"width_px": 642, "height_px": 90}}, "its image is 640 x 480"),
        ({"region": {"width_px": 121, "height_px": 90}}, "Width 121, it takes 8 to 640 in steps of 4"),
    ],
)
def test_options_that_the_camera_does_not_take_are_refused(
    opened: Opened, options: dict[str, object], words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        opened(**options)
    # And the camera was let go.
    opened().arm(1, Trigger.SOFTWARE)


def test_features_of_every_kind_are_set(producer: FakeProducer, opened: Opened) -> None:
    camera = opened(features={"ReverseX": True, "DeviceUserID": "bench"}, region=None)
    assert camera.info.format.size == Size(640, 480)
    assert producer.camera.read(0x160, 4) == b"\1\0\0\0"
    assert producer.camera.read(0x180, 16).startswith(b"bench\0")
    # What is automatic is off.
    assert producer.camera.read(0x130, 4) == bytes(4)


@pytest.mark.parametrize(("pixel_format", "bit_depth"), [("Mono8", 8), ("Mono12", 12)])
def test_pixels_are_those_of_the_sensor(
    producer: FakeProducer, opened: Opened, pixel_format: str, bit_depth: int
) -> None:
    stage = producer.camera.stage = Stage(scene(bit_depth=bit_depth))
    stage.show(WHITE)
    camera = opened(pixel_format=pixel_format)
    camera.arm(1, Trigger.SOFTWARE)
    np.testing.assert_allclose(expose(camera).image, stage.expected(WHITE, exposure_s=0.005), atol=2**bit_depth / 100)


# ---- when


@pytest.mark.parametrize("without", [(), NO_LATCH])
@pytest.mark.parametrize("trigger", Trigger)
def test_the_exposure_is_where_the_frame_says(opened: Opened, trigger: Trigger, without: tuple[str, ...]) -> None:
    producer = serving(MemoryCamera(Stage(scene()), without=without))
    camera = opened()
    camera.arm(10, trigger)
    frames = []
    for _ in range(10):
        if trigger is Trigger.SOFTWARE:
            camera.trigger()
        elif trigger is Trigger.HARDWARE:
            producer.camera.pulse()
        frames.append(camera.read(0, LONG_S))
    assert all(within(frame, producer.camera) for frame in frames)
    assert [frame.sequence_number for frame in frames] == list(range(10))
    # A wait of the library's would keep every other thread of the process waiting.
    assert producer.longest_wait_ms == 0


@pytest.mark.slow
@pytest.mark.parametrize(("trigger", "timeout_s"), [(Trigger.SOFTWARE, 0.026), (Trigger.FREE, 1.0)])
def test_frames_show_what_they_are_paired_with(opened: Opened, trigger: Trigger, timeout_s: float) -> None:
    fate = Disturbed(7)
    stage = Stage(scene(noise_dn=1.0), latency_s=0.0005, jitter_s=0.002, seed=3)
    serving(MemoryCamera(stage, fate=fate))
    camera = opened(answer_s=0.02)
    camera.configure(CameraSettings(EXPOSURE_S, GAIN))
    camera.arm(100, trigger)
    pairing = Pairing(stage, camera, 1)
    pairing.run(500, trigger=trigger, timeout_s=timeout_s)
    assert pairing.wrong == []
    assert numbers_rise(pairing.frames)
    assert fate.counts["lost"] > 37
    assert fate.counts["broken"] > 15
    # The last frames may be lost without another one that would tell.
    assert pairing.frames[-1].dropped_count >= fate.counts["lost"] + fate.counts["broken"] - 10


# ---- what goes wrong


def test_lost_and_broken_frames_are_counted(producer: FakeProducer, opened: Opened) -> None:
    camera = opened(answer_s=0.1)
    camera.arm(20, Trigger.SOFTWARE)
    assert expose(camera).dropped_count == 0
    for lost, dropped in ((1.0, 1), (0.5, 2)):
        producer.camera.fate = lambda lost=lost: Fate(lost=lost)  # type: ignore[misc]
        camera.trigger()
        with pytest.raises(FrameTimeoutError):
            camera.read(0, 0.15)
        producer.camera.fate = Fate
        frame = expose(camera)
        assert (frame.dropped_count, frame.sequence_number) == (dropped, 2 * dropped)
        assert within(frame, producer.camera)


def test_an_unplugged_camera_is_gone_and_opens_again(producer: FakeProducer, opened: Opened) -> None:
    camera = opened()
    camera.arm(2, Trigger.SOFTWARE)
    expose(camera)
    producer.camera.plugged = False
    with pytest.raises(DeviceGoneError, match="'left'"):
        camera.trigger()
    with pytest.raises(DeviceGoneError, match=r"is gone.*cable"):
        camera.read(0, LONG_S)
    camera.close()
    camera.close()
    producer.camera.plugged = True
    again = opened()
    again.arm(1, Trigger.SOFTWARE)
    assert expose(again).image.shape == CAMERA.shape


def test_a_reader_is_told_of_an_unplugged_camera(producer: FakeProducer, opened: Opened) -> None:
    camera = opened()
    camera.arm(1, Trigger.HARDWARE)
    producer.camera.plugged = False
    with pytest.raises(DeviceGoneError, match="waiting for a frame"):
        camera.read(0, 30.0)
