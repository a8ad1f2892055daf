"""The GenICam driver on a GigE Vision camera over loopback: settings, formats, triggers, and what goes wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.genicam import GenicamCamera, find_devices, open_camera
from drivers.genicam.aravis import AravisConnection
from slrig.devices import CameraSettings, Trigger
from slrig.errors import (
    DeviceBusyError,
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import Frame, Size
from tests.contract.genicam_bench import CAMERA, FakeGigE, Fate, require_aravis, scene, table
from tests.contract.genicam_relay import Relay
from tests.contract.stage import Stage

Opened = Callable[..., GenicamCamera]
LONG_S, SHORT_S = 5.0, 0.05
WHITE = np.full((1, 1), 255, np.uint8)


def expose(camera: GenicamCamera) -> Frame:
    camera.trigger()
    return camera.read(0, LONG_S)


def expose_surely(camera: GenicamCamera) -> Frame:
    """Trigger until a frame comes through."""
    while True:
        camera.trigger()
        try:
            return camera.read(0, 0.7)
        except FrameTimeoutError:
            continue


def within(frame: Frame, exposures: list[tuple[int, int]]) -> bool:
    """Whether one of the exposures that were made is where the frame says."""
    return any(abs(start_ns - frame.t_start_ns) <= frame.t_err_ns for start_ns, _ in exposures)


# ---- what is there


@pytest.mark.usefixtures("peer")
def test_it_is_found_and_opened_by_its_id() -> None:
    (found,) = find_devices()
    assert (found.driver, found.device) == ("genicam", "Aravis-Fake-SLRIG1")
    assert "GigEVision, 127.0.0.1" in found.label
    camera = open_camera("left", table(device=found.device), Path())
    assert (camera.info.name, camera.info.model, camera.info.serial) == ("left", "Aravis Fake", "SLRIG1")
    assert camera.info.triggers == set(Trigger)
    camera.close()


@pytest.mark.usefixtures("peer")
def test_a_camera_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(DeviceGoneError, match=r"no GenICam camera 'Acme-1' answers; found: .*Aravis-Fake-SLRIG1"):
        open_camera("left", table(device="Acme-1"), Path())


def test_the_stock_camera_goes_by_older_names() -> None:
    require_aravis()
    stock = FakeGigE(Stage(scene()))
    stock.start()
    camera = open_camera("left", table(), Path())
    assert camera.configure(CameraSettings(0.002, 2.0)).exposure_s == pytest.approx(0.002)
    with pytest.raises(UnsupportedByDeviceError, match=r"asked for gain 1.5, it gives [12]"):
        camera.configure(CameraSettings(0.002, 1.5))
    camera.close()
    stock.stop()


# ---- settings


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (CameraSettings(-5.0), r"exposure_s -5, it takes 1e-05 to 10"),
        (CameraSettings(11.0), r"exposure_s 11"),
        (CameraSettings(0.01, 10.5), r"gain 10.5, it takes 0 to 10"),
        (CameraSettings(0.01, -1.0), r"gain -1"),
    ],
)
def test_what_the_camera_would_take_in_silence_is_refused(opened: Opened, settings: CameraSettings, words: str) -> None:
    camera = opened()
    with pytest.raises(UnsupportedByDeviceError, match=words):
        camera.configure(settings)
    assert expose_armed(camera).exposure_s == pytest.approx(0.005)


def expose_armed(camera: GenicamCamera) -> Frame:
    camera.arm(1, Trigger.SOFTWARE)
    frame = expose(camera)
    camera.disarm()
    return frame


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"region": {"x_px": 2000, "width_px": 100, "height_px": 10}}, r"its image is 2048 x 2048"),
        ({"pixel_format": "Mono14"}, r"PixelFormat Mono14, it offers .*Mono12Packed"),
        ({"pixel_format": "YUV422_8"}, r"the driver reads Mono8.*the camera offers: Mono10"),
        ({"trigger_line": "Line7"}, r"trigger_line Line7, it offers Line1"),
        ({"features": {"Gamma": 1.0}}, r"no feature Gamma"),
        ({"features": {"BinningHorizontal": "two"}}, r"of the kind Integer"),
        ({"features": {"AcquisitionFrameRate": "fast"}}, r"of the kind Float"),
        ({"features": {"TestBoolean": 1}}, r"of the kind Boolean"),
        ({"features": {"TestStringReg": 3}}, r"of the kind String"),
        ({"features": {"BinningHorizontal": 99}}, r"BinningHorizontal 99, it takes 1 to 16"),
        ({"features": {"TriggerActivation": "FallingEdge"}}, r"it offers RisingEdge"),
    ],
)
def test_options_that_the_camera_does_not_take_are_refused(
    opened: Opened, options: dict[str, object], words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        opened(**options)
    # And the camera was let go.
    assert expose_armed(opened()).image.shape == CAMERA.shape


def test_features_are_set_in_order_and_read_back(opened: Opened) -> None:
    features = {"AcquisitionFrameRate": 50, "BinningHorizontal": 2, "TestBoolean": True}
    camera = opened(features=features)
    with camera._connection.asking("reading") as device:
        assert device.get_float("AcquisitionFrameRate") == pytest.approx(50)
        assert device.get_integer("BinningHorizontal") == 2
        assert device.get_boolean("TestBoolean")


@pytest.mark.usefixtures("peer")
def test_without_a_region_the_whole_sensor_is_used() -> None:
    camera = open_camera("left", {"device": "127.0.0.1"}, Path())
    assert camera.info.format.size == Size(2048, 2048)
    camera.close()


def test_a_region_lies_where_it_was_asked_for(opened: Opened) -> None:
    camera = opened(region={"x_px": 16, "y_px": 8, "width_px": 60, "height_px": 40})
    with camera._connection.asking("reading") as device:
        region = device.get_region()
    assert tuple(region) == (16, 8, 60, 40)
    assert expose_armed(camera).image.shape == (40, 60)


@pytest.mark.parametrize(
    ("pixel_format", "bit_depth"),
    [
        ("Mono8", 8),
        ("Mono10", 10),
        ("Mono12", 12),
        ("Mono16", 16),
        ("Mono10p", 10),
        ("Mono12p", 12),
        ("Mono10Packed", 10),
        ("Mono12Packed", 12),
    ],
)
def test_every_format_comes_through_the_wire(peer: FakeGigE, opened: Opened, pixel_format: str, bit_depth: int) -> None:
    peer.stage = Stage(scene(bit_depth=bit_depth))
    peer.stage.show(WHITE)
    camera = opened(pixel_format=pixel_format)
    frame = expose_armed(camera)
    assert camera.info.format.bit_depth == bit_depth
    np.testing.assert_array_equal(frame.image, peer.stage.expected(WHITE, exposure_s=0.005))


@pytest.mark.parametrize("pixel_format", ["BayerGR8", "BayerRG12"])
def test_a_mosaic_comes_as_grey(peer: FakeGigE, opened: Opened, pixel_format: str) -> None:
    peer.stage = Stage(scene(bit_depth=12 if "12" in pixel_format else 8))
    peer.stage.show(WHITE)
    frame = expose_armed(opened(pixel_format=pixel_format))
    truth = peer.stage.expected(WHITE, exposure_s=0.005)
    assert frame.image.dtype == truth.dtype
    assert np.abs(frame.image.astype(int) - truth.astype(int)).mean() < 0.02 * truth.max()


# ---- triggers


def test_a_software_trigger_makes_one_frame_each(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(4, Trigger.SOFTWARE)
    frames = [expose(camera) for _ in range(4)]
    with pytest.raises(FrameTimeoutError, match=r"software trigger; passed over: none.*trigger after the pattern"):
        camera.read(0, SHORT_S)
    assert [frame.sequence_number for frame in frames] == [0, 1, 2, 3]
    assert [frame.dropped_count for frame in frames] == [0] * 4
    assert len(peer.exposures) == 4
    assert all(within(frame, peer.exposures) for frame in frames)


def test_a_wire_trigger_makes_one_frame_each(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(5, Trigger.HARDWARE)
    with pytest.raises(DeviceStateError, match="arm it for software triggers"):
        camera.trigger()
    with pytest.raises(FrameTimeoutError, match=r"hardware trigger.*cable"):
        camera.read(0, SHORT_S)
    frames: list[Frame] = []
    for _ in range(5):
        peer.pulse()
        after_ns = frames[-1].t_end_ns if frames else 0
        frames.append(camera.read(after_ns, LONG_S))
        assert frames[-1].t_start_ns >= after_ns
    assert [frame.sequence_number for frame in frames] == [0, 1, 2, 3, 4]
    assert frames[-1].dropped_count == 0
    assert all(within(frame, peer.exposures) for frame in frames)
    with pytest.raises(FrameTimeoutError):
        camera.read(0, SHORT_S)


def test_frames_of_an_earlier_arming_never_come(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    for trigger in (Trigger.HARDWARE, Trigger.SOFTWARE, Trigger.FREE, Trigger.HARDWARE):
        camera.arm(3, trigger)
        if trigger is Trigger.HARDWARE:
            with pytest.raises(FrameTimeoutError):
                camera.read(0, SHORT_S)
            peer.pulse()
        elif trigger is Trigger.SOFTWARE:
            camera.trigger()
        assert camera.read(0, LONG_S).sequence_number == 0
        if trigger is Trigger.SOFTWARE:
            camera.trigger()
        camera.disarm()


def test_a_free_running_camera_passes_over_what_it_made_before(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(2, Trigger.FREE)
    camera.read(0, LONG_S)
    for _ in range(3):
        lit_ns = peer.stage.show(WHITE)
        frame = camera.read(lit_ns, LONG_S)
        np.testing.assert_array_equal(frame.image, peer.stage.expected(WHITE, exposure_s=0.005))
        dark_ns = peer.stage.show(None)
        frame = camera.read(dark_ns, LONG_S)
        np.testing.assert_array_equal(frame.image, peer.stage.expected(None, exposure_s=0.005))


# ---- the camera's clock


@pytest.fixture
def relay(peer: FakeGigE) -> Iterator[Relay]:
    """The camera with a clock that can be latched, at another address."""
    peer.start()
    with Relay() as found:
        yield found


@pytest.fixture
def looks_ns(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How long each look at the camera's clock takes from now on."""
    took_ns: list[int] = []
    latch = AravisConnection.latch

    def timed(connection: AravisConnection) -> tuple[int, int, int] | None:
        look = latch(connection)
        if look is not None:
            took_ns.append(look[2] - look[0])
        return look

    monkeypatch.setattr(AravisConnection, "latch", timed)
    return took_ns


@pytest.mark.parametrize(
    ("time_stamp", "most_err_s"), [("exposure_start", 0.001), ("exposure", 0.0035), ("none", 0.051)]
)
@pytest.mark.parametrize("trigger", Trigger)
def test_the_exposure_is_where_the_frame_says(
    peer: FakeGigE,
    relay: Relay,
    opened: Opened,
    looks_ns: list[int],
    trigger: Trigger,
    time_stamp: str,
    most_err_s: float,
) -> None:
    camera = opened(device=relay.address, time_stamp=time_stamp)
    camera.arm(10, trigger)
    for _ in range(20):
        if min(looks_ns, default=0) < 1_000_000:
            break
        # The machine was held during every look at the clock, which an arming ties anew.
        camera.disarm()
        looks_ns.clear()
        camera.arm(10, trigger)
    assert bool(relay.latches) == (time_stamp != "none")
    frames = []
    for _ in range(10):
        if trigger is Trigger.SOFTWARE:
            camera.trigger()
        elif trigger is Trigger.HARDWARE:
            peer.pulse()
        frames.append(camera.read(0, LONG_S))
    assert all(within(frame, peer.exposures) for frame in frames)
    # Half of them at least: a busy machine may be slow with one.
    assert np.median([frame.t_err_ns for frame in frames]) <= most_err_s * 1e9


def test_a_clock_that_stands_is_not_believed(peer: FakeGigE, opened: Opened) -> None:
    with Relay(clock_ns=lambda: 42) as relay:
        camera = opened(device=relay.address)
        camera.arm(3, Trigger.FREE)
        frames = [camera.read(0, LONG_S) for _ in range(3)]
        camera.close()
    assert relay.latches
    assert all(within(frame, peer.exposures) for frame in frames)
    assert all(frame.t_err_ns <= 0.051e9 for frame in frames)


# ---- what goes wrong


def test_lost_and_broken_frames_are_passed_over_and_counted(peer: FakeGigE, opened: Opened) -> None:
    camera = opened(answer_s=0.3)
    camera.arm(20, Trigger.SOFTWARE)
    assert expose(camera).dropped_count == 0
    for lost, dropped in ((1.0, 1), (0.6, 2)):
        peer.fate = lambda lost=lost: Fate(lost=lost)  # type: ignore[misc]
        camera.trigger()
        with pytest.raises(FrameTimeoutError) as late:
            camera.read(0, 0.5)
        assert ("1 corrupt" in str(late.value)) == (lost < 1)
        peer.fate = Fate
        frame = expose(camera)
        assert frame.dropped_count == dropped
        assert within(frame, peer.exposures)
        assert frame.sequence_number == 2 * dropped


def test_frame_ids_wrap_without_a_loss(peer: FakeGigE, opened: Opened) -> None:
    # The fake camera counts from 65400 when it starts.
    peer.stop()
    camera = opened()
    camera.configure(CameraSettings(0.0001))
    camera.arm(200, Trigger.SOFTWARE)
    frames = [expose(camera) for _ in range(150)]
    assert [frame.sequence_number for frame in frames] == list(range(150))
    assert frames[-1].dropped_count == 0


def test_a_camera_that_answers_late_is_waited_for(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(3, Trigger.SOFTWARE)
    peer.fate = lambda: Fate(delay_s=0.15)
    frame = expose(camera)
    assert within(frame, peer.exposures)
    assert frame.sequence_number == 0


def test_a_camera_that_another_program_controls_is_busy(relay: Relay, opened: Opened) -> None:
    relay.denied.add(0x0A00)
    with pytest.raises(DeviceBusyError, match=r"another program controls 127\.0\.0\.2"):
        opened(device=relay.address)
    relay.denied.clear()
    assert expose_armed(opened(device=relay.address)).image.shape == CAMERA.shape


def test_an_unplugged_camera_is_gone_and_can_be_closed(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    info = camera.info
    camera.arm(2, Trigger.SOFTWARE)
    expose(camera)
    peer.stop()
    with pytest.raises(DeviceGoneError, match="'left'"):
        camera.trigger()
    for call in (camera.trigger, lambda: camera.read(0, LONG_S), lambda: camera.configure(CameraSettings(0.01))):
        with pytest.raises(DeviceGoneError, match=r"is gone.*cable"):
            call()
    camera.disarm()
    camera.close()
    camera.close()
    assert camera.info == info
    with pytest.raises(DeviceStateError, match="closed"):
        camera.arm(1, Trigger.SOFTWARE)
    # Plugged in again, it opens again.
    assert expose_armed(opened()).image.shape == CAMERA.shape


@pytest.mark.slow
def test_aravis_itself_tells_a_waiting_reader_of_an_unplugged_camera(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(1, Trigger.HARDWARE)
    peer.stop()
    with pytest.raises(DeviceGoneError, match="waiting for a frame"):
        camera.read(0, 30.0)


@pytest.mark.slow
def test_a_camera_that_does_not_answer_is_gone_when_a_frame_is_late(peer: FakeGigE, opened: Opened) -> None:
    camera = opened()
    camera.arm(1, Trigger.SOFTWARE)
    peer.stop()
    with pytest.raises(DeviceGoneError):
        camera.read(0, SHORT_S)
