"""The drivers genicam and gentl on their fake cameras: features, formats, triggers, clocks, and what goes wrong."""

from __future__ import annotations

import importlib
import re
import signal
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.genicam import (
    GenicamCamera,
    GenicamOptions,
    find_devices,
    find_gentl_devices,
    link,
    open_camera,
    open_gentl_camera,
)
from drivers.genicam.aravis import install_command
from slrig.devices import CameraSettings, Trigger
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    FrameTimeoutError,
    LibraryMissingError,
    UnsupportedByDeviceError,
)
from slrig.model import Frame, Pixels, Size
from tests.contract import genicam_bench, gentl_bench
from tests.contract.genicam_bench import CAMERA, FakeGigE, Fate, Relay, require_aravis, scene
from tests.contract.genicam_peer import PIXEL_FORMATS
from tests.contract.gentl_producer import OVERHEAD_S, REGISTERS, MemoryCamera
from tests.contract.stage import Stage
from tests.unit.drivers.genicam.test_pixels import encoded

LONG_S, SHORT_S = 5.0, 0.05
WHITE = np.full((1, 1), 255, np.uint8)
PATIENT: dict[str, object] = {"answer_s": 2.0, "transfer_s": 2.0}
"""How late a frame may come, on a machine that does much else."""

EXPOSURE_S = 0.005
NO_LATCH = ("TimestampLatch", "TimestampLatchValue")


@dataclass
class Device:
    """A camera before a dark stage, and the driver that opens it."""

    camera: FakeGigE | MemoryCamera
    opened: Callable[..., GenicamCamera]
    unplug: Callable[[], object]
    plug: Callable[[], object]
    closing: ExitStack = field(default_factory=ExitStack)

    def open(self, **options: object) -> GenicamCamera:
        """The driver's camera, set to 5 ms; closed after the test."""
        camera = self.opened(**options)
        self.closing.callback(camera.close)
        camera.configure(CameraSettings(EXPOSURE_S))
        return camera


@pytest.fixture(scope="module")
def gige() -> Iterator[FakeGigE]:
    """One for a whole file. Skips where Aravis is not installed."""
    require_aravis()
    packed = {name: partial(encoded, name=name) for name in PIXEL_FORMATS}
    with FakeGigE(Stage(scene()), kind="sfnc", packed=packed) as peer:
        yield peer


@pytest.fixture(params=["genicam", "gentl"])
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """A camera of each kind; "gentl, no latch" has a clock that cannot be looked at."""
    with ExitStack() as leaving:
        if request.param == "genicam":
            peer: FakeGigE = request.getfixturevalue("gige")
            peer.stage, peer.fate = Stage(scene()), Fate
            peer.exposures.clear()
            peer.start()
            found = Device(peer, genicam_bench.opened, peer.stop, peer.start)
        else:
            memory = MemoryCamera(Stage(scene()), without=NO_LATCH if "no latch" in request.param else ())
            producer = leaving.enter_context(gentl_bench.serving(memory))
            plugged = partial(setattr, memory, "plugged")
            found = Device(
                memory, partial(gentl_bench.opened, producer), partial(plugged, False), partial(plugged, True)
            )
        leaving.enter_context(found.closing)
        yield found


GENICAM = pytest.mark.parametrize("device", ["genicam"], indirect=True)


def exposed(device: Device, camera: GenicamCamera, trigger: Trigger = Trigger.SOFTWARE) -> Frame:
    if trigger is Trigger.SOFTWARE:
        camera.trigger()
    elif trigger is Trigger.HARDWARE:
        device.camera.pulse()
    return camera.read(0, LONG_S)


def one_frame(device: Device, camera: GenicamCamera) -> Frame:
    camera.arm(1, Trigger.SOFTWARE)
    frame = exposed(device, camera)
    camera.disarm()
    return frame


def asked(camera: GenicamCamera, call: str, *arguments: object) -> Any:
    """What Aravis answers. Nothing keeps its camera, which it lets go with the last reference."""
    with camera._connection.access("reading") as device:
        return getattr(device, call)(*arguments)


def within(frame: Frame, device: Device) -> bool:
    """Whether one of the exposures that were made is where the frame says."""
    return any(abs(start_ns - frame.t_start_ns) <= frame.t_err_ns for start_ns, _ in list(device.camera.exposures))


# ---- finding and opening


@GENICAM
def test_a_genicam_camera_is_found_and_opened_by_its_id(device: Device) -> None:
    (found,) = find_devices()
    assert (found.driver, found.device) == ("genicam", "Aravis-Fake-SLRIG1")
    assert "GigEVision, 127.0.0.1" in found.label
    camera = device.open(device=found.device)
    assert (camera.info.name, camera.info.model, camera.info.serial) == ("left", "Aravis Fake", "SLRIG1")
    assert camera.info.triggers == set(Trigger)
    with pytest.raises(DeviceGoneError, match=r"no GenICam camera 'Acme-1' answers; found: .*Aravis-Fake-SLRIG1"):
        device.open(device="Acme-1")


def test_a_gentl_camera_is_found_while_it_is_open_and_opened_by_its_serial_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with gentl_bench.serving(MemoryCamera(Stage(scene()))) as producer:
        monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{producer.file.parent}")
        before = signal.getsignal(signal.SIGINT)
        camera = gentl_bench.opened(producer, device="M1", producer=None)
        # harvesters would have Ctrl-C for itself.
        assert signal.getsignal(signal.SIGINT) is before
        info = camera.info
        assert (info.model, info.serial, info.triggers) == ("Slrig Memory", "M1", frozenset(Trigger))
        (found,) = find_gentl_devices()
        camera.close()
        label = "Slrig Memory M1 (Custom, producer.cti)"
        assert (found.driver, found.device, found.label) == ("gentl", "slrig-memory-M1", label)
        with pytest.raises(DeviceGoneError, match=r"no GenTL camera 'Acme'.*found: slrig-memory-M1 \(by producer.cti"):
            gentl_bench.opened(producer, device="Acme")
        with pytest.raises(LibraryMissingError, match=r"GenTL producer .*acme\.cti"):
            gentl_bench.opened(producer, producer="acme.cti")
        monkeypatch.delenv("GENICAM_GENTL64_PATH")
        with pytest.raises(LibraryMissingError, match=r"no GenTL producer found.*GENICAM_GENTL64_PATH"):
            gentl_bench.opened(producer, producer=None)
        assert find_gentl_devices() == ()
        producer.opened = True
        with pytest.raises(DeviceBusyError, match="another program controls"):
            gentl_bench.opened(producer)
        # The producer that comes with the wheel is listed, and its games are refused.
        file = Path(str(importlib.import_module("genicam").__file__)).parent / "viky.cti"
        options = {"device": "VikyTL_DEV_red", "producer": str(file), "pixel_format": "Mono8"}
        with pytest.raises(UnsupportedByDeviceError, match="no feature ExposureTime"):
            open_gentl_camera("left", options, Path())
        with pytest.raises(DeviceGoneError, match="VikyTL_DEV_red, VikyTL_DEV_green, VikyTL_DEV_blue"):
            open_gentl_camera("left", {**options, "device": "Acme"}, Path())


@GENICAM
def test_a_camera_that_another_program_controls_is_busy(device: Device) -> None:
    with Relay() as relay:
        relay.denied.add(0x0A00)
        with pytest.raises(DeviceBusyError, match=r"another program controls 127\.0\.0\.2"):
            device.open(device=relay.address)
        relay.denied.clear()
        camera = device.open(device=relay.address)
        assert one_frame(device, camera).image.shape == CAMERA.shape
        camera.close()


# ---- features and settings


@pytest.mark.parametrize(
    ("device", "options", "words"),
    [
        ("genicam", {"region": {"x_px": 2000, "width_px": 100, "height_px": 10}}, r"its image is 2048 x 2048"),
        ("genicam", {"pixel_format": "Mono14"}, r"PixelFormat Mono14, it offers .*Mono12Packed"),
        ("genicam", {"pixel_format": "YUV422_8"}, r"the driver reads Mono8.*the camera offers: Mono10"),
        ("genicam", {"trigger_line": "Line7"}, r"trigger_line Line7, it offers Line1"),
        ("genicam", {"features": {"Gamma": 1.0}}, r"no feature Gamma"),
        ("genicam", {"features": {"BinningHorizontal": "two"}}, r"of type Integer"),
        ("genicam", {"features": {"AcquisitionFrameRate": "fast"}}, r"of type Float"),
        ("genicam", {"features": {"TestBoolean": 1}}, r"of type Boolean"),
        ("genicam", {"features": {"TestStringReg": 3}}, r"of type String"),
        ("genicam", {"features": {"BinningHorizontal": 99}}, r"BinningHorizontal 99, it takes 1 to 16"),
        ("genicam", {"features": {"TriggerActivation": "FallingEdge"}}, r"it offers RisingEdge"),
        ("gentl", {"features": {"Gamma": 1.0}}, "no feature Gamma"),
        ("gentl", {"features": {"ReverseX": 1}}, "of type Boolean"),
        ("gentl", {"features": {"DeviceUserID": 1}}, "of type String"),
        ("gentl", {"features": {"TimestampLatch": 1}}, "of type Command"),
        ("gentl", {"pixel_format": "Mono16"}, "PixelFormat Mono16, it offers Mono8, Mono12"),
        ("gentl", {"region": {"width_px": 642, "height_px": 90}}, "its image is 640 x 480"),
        ("gentl", {"region": {"width_px": 121, "height_px": 90}}, "Width 121, it takes 8 to 640 in steps of 4"),
    ],
    indirect=["device"],
)
def test_an_option_that_the_camera_does_not_take_is_refused(
    device: Device, options: dict[str, object], words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        device.open(**options)
    # And the camera was let go.
    device.open()


@pytest.mark.parametrize(
    ("device", "settings", "words"),
    [
        ("genicam", CameraSettings(-5.0), r"exposure_s -5, it takes 1e-05 to 10"),
        ("genicam", CameraSettings(0.01, 10.5), r"gain 10.5, it takes 0 to 10"),
        ("gentl", CameraSettings(11.0), r"exposure_s 11, it takes 2e-05 to 1"),
        # The camera rounds, which its cache would hide.
        ("gentl", CameraSettings(0.01, 2.7), r"requested gain 2\.7, it gives 2\.5"),
    ],
    indirect=["device"],
)
def test_settings_that_the_camera_changes_silently_are_refused(
    device: Device, settings: CameraSettings, words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        device.open().configure(settings)


@pytest.mark.parametrize(("device", "overhead_s"), [("genicam", 0.002), ("gentl", OVERHEAD_S)], indirect=["device"])
def test_the_least_period_is_what_the_camera_says(device: Device, overhead_s: float) -> None:
    camera = device.open()
    for exposure_s in (0.004, 0.013):
        assert camera.configure(CameraSettings(exposure_s, 1.0)).min_period_s == pytest.approx(exposure_s + overhead_s)


@GENICAM
def test_features_and_a_region_are_set_through_aravis(device: Device) -> None:
    features = {"AcquisitionFrameRate": 50, "BinningHorizontal": 2, "TestBoolean": True}
    camera = device.open(features=features)
    set_to = (
        asked(camera, "get_float", "AcquisitionFrameRate"),
        asked(camera, "get_integer", "BinningHorizontal"),
        asked(camera, "get_boolean", "TestBoolean"),
    )
    assert set_to == pytest.approx((50, 2, True))
    camera.close()
    camera = device.open(**PATIENT, region={"x_px": 16, "y_px": 8, "width_px": 60, "height_px": 40})
    assert tuple(asked(camera, "get_region")) == (16, 8, 60, 40)
    assert one_frame(device, camera).image.shape == (40, 60)
    camera.close()
    assert device.open(region=None).info.format.size == Size(2048, 2048)


@pytest.mark.parametrize("device", ["gentl"], indirect=True)
def test_features_of_every_kind_are_set_through_gentl(device: Device) -> None:
    camera = device.open(features={"ReverseX": True, "DeviceUserID": "bench"}, region=None)
    assert camera.info.format.size == Size(640, 480)
    assert isinstance(device.camera, MemoryCamera)
    # What is automatic is off.
    assert held(device.camera, "ReverseX", "DeviceUserID", "ExposureAuto") == [1, b"bench".ljust(16, b"\0"), 0]


@pytest.mark.parametrize(
    ("device", "pixel_format", "bit_depth"),
    [
        ("genicam", "Mono8", 8),
        ("genicam", "Mono16", 16),
        ("genicam", "Mono12p", 12),
        ("genicam", "Mono10Packed", 10),
        ("genicam", "BayerGR8", 8),
        ("genicam", "BayerRG12", 12),
        ("gentl", "Mono8", 8),
        ("gentl", "Mono12", 12),
    ],
    indirect=["device"],
)
def test_a_frame_has_the_pixels_of_the_sensor(device: Device, pixel_format: str, bit_depth: int) -> None:
    # Every format is decoded in test_pixels.py.
    device.camera.stage = stage = Stage(scene(bit_depth=bit_depth))
    stage.show(WHITE)
    camera = device.open(pixel_format=pixel_format)
    frame = one_frame(device, camera)
    truth = stage.expected(WHITE, exposure_s=EXPOSURE_S)
    assert camera.info.format.bit_depth == bit_depth
    assert frame.image.dtype == truth.dtype
    off = np.abs(frame.image.astype(int) - truth.astype(int))
    assert off.mean() < 0.02 * truth.max() if "Bayer" in pixel_format else off.max() == 0


@pytest.mark.parametrize("kind", ["stock", "exposure start"])
def test_a_camera_with_other_names_of_features_is_read_and_triggered(kind: str) -> None:
    require_aravis()
    with FakeGigE(Stage(scene()), kind=kind) as peer:
        camera = genicam_bench.opened()
        applied = camera.configure(CameraSettings(0.002, 2.0))
        assert applied.exposure_s == pytest.approx(0.002)
        if kind == "stock":
            # It has no name for the rate that its settings result in, and whole gains.
            assert applied.min_period_s is None
            with pytest.raises(UnsupportedByDeviceError, match=r"requested gain 1.5, it gives [12]"):
                camera.configure(CameraSettings(0.002, 1.5))
        else:
            for trigger in Trigger:
                camera.arm(1, trigger)
                assert exposed(Device(peer, genicam_bench.opened, peer.stop, peer.start), camera, trigger).image.size
                camera.disarm()
        camera.close()


LEFT: dict[str, float] = {
    **{"TriggerMode": 1, "GammaEnable": 1, "LUTEnable": 1, "SharpnessEnhancement": 3.0, "BinningHorizontal": 2},
    **{"ReverseX": 1, "TriggerDelay": 5000.0},
}


def held(camera: MemoryCamera, *names: str) -> list[float | bytes]:
    """What registers of the camera hold."""
    found: list[float | bytes] = []
    for name in names:
        address, code = REGISTERS[name]
        found += struct.unpack(f"<{code}", camera.read(address, struct.calcsize(code)))
    return found


def test_what_another_program_left_on_is_switched_off() -> None:
    memory = MemoryCamera(Stage(scene()), left=LEFT)
    with gentl_bench.serving(memory) as producer:
        camera = gentl_bench.opened(producer)
        camera.close()
        assert held(memory, *LEFT) == [0, 0, 0, 1.0, 1, 0, 29.0]
        assert camera.info.notes == ()
        # Of a user set, too, unless the rig file says otherwise.
        memory.stored = LEFT
        camera = gentl_bench.opened(producer, user_set="UserSet1", features={"ReverseX": True, "TriggerDelay": 400.0})
        camera.close()
        assert held(memory, *LEFT) == [0, 0, 0, 1.0, 1, 1, 400.0]
        with pytest.raises(UnsupportedByDeviceError, match=r"UserSetSelector UserSet7, it offers Default, UserSet1"):
            gentl_bench.opened(producer, user_set="UserSet7")


@pytest.mark.parametrize(
    ("left", "words"),
    [
        ({"NoiseReduction": 2.0}, "stays on: .*NoiseReduction"),
        ({"BlackLevel": 3.5}, "black level is 3.5"),
        ({"LineDebouncerTime": 50.0}, r"input Line1 takes a pulse after 50 µs only \(LineDebouncerTime\)"),
        ({"GevSCPSPacketSize": 1500}, "packets have 1500 bytes, 8 a frame.*mtu 9000"),
        ({"DeviceLinkThroughputLimit": 10**6}, r"at most 1 MB/s .*a frame every 10\.8 ms.* = 125000000 \} lifts"),
    ],
)
def test_what_an_industrial_camera_keeps_is_noted(left: dict[str, float], words: str) -> None:
    with gentl_bench.serving(MemoryCamera(Stage(scene()), left=left)) as producer:
        camera = gentl_bench.opened(producer)
        camera.close()
        (note,) = camera.info.notes
        assert re.search(words, note)


# ---- triggers and times


@pytest.mark.parametrize(("features", "overlap"), [({}, 1), ({"TriggerOverlap": "PreviousFrame"}, 2)])
def test_a_wire_trigger_is_set_while_it_is_off_and_overlaps_the_readout(
    features: dict[str, object], overlap: int
) -> None:
    # Source and overlap are read-only while the trigger is on, and it was left on, for software.
    memory = MemoryCamera(Stage(scene()), left={"TriggerMode": 1})
    with gentl_bench.serving(memory) as producer:
        camera = gentl_bench.opened(producer, features=features)
        for trigger, mode in ((Trigger.SOFTWARE, [1, 0]), (Trigger.HARDWARE, [1, 1]), (Trigger.FREE, [0, 1])):
            camera.arm(1, trigger)
            assert held(memory, "TriggerMode", "TriggerSource") == mode
            camera.disarm()
        camera.close()
        assert held(memory, "TriggerOverlap") == [overlap]


@pytest.mark.parametrize(("features", "taken"), [({}, 2), ({"TriggerOverlap": "Off"}, 1)])
def test_pulses_during_the_readout_are_taken_though_the_camera_takes_none_by_default(
    features: dict[str, object], taken: int
) -> None:
    class Pulsing(Stage):
        """Sends the next pulse while the sensor is read out."""

        def exposed(
            self, t_start_ns: int, t_end_ns: int, *, gain: float = 1.0, readout_ns: int = 0, defocus_px: float = 0.0
        ) -> Pixels:
            if len(memory.exposures) == 1:
                memory.pulse()
            return super().exposed(t_start_ns, t_end_ns, gain=gain, readout_ns=readout_ns, defocus_px=defocus_px)

    memory = MemoryCamera(Pulsing(scene()))
    with gentl_bench.serving(memory) as producer:
        camera = gentl_bench.opened(producer, features=features)
        camera.arm(2, Trigger.HARDWARE)
        memory.pulse()
        for _ in range(taken):
            camera.read(0, LONG_S)
        with pytest.raises(FrameTimeoutError):
            camera.read(0, SHORT_S)
        camera.close()


@pytest.mark.parametrize(
    ("device", "options"),
    [
        ("genicam", {"time_stamp": "exposure_start"}),
        ("genicam", {"time_stamp": "exposure"}),
        ("genicam", {"time_stamp": "none"}),
        ("gentl", {}),
        ("gentl, no latch", {}),
    ],
    indirect=["device"],
)
@pytest.mark.parametrize("trigger", Trigger)
def test_a_trigger_gives_one_frame_whose_exposure_is_where_it_says(
    device: Device, trigger: Trigger, options: dict[str, object]
) -> None:
    with Relay() as relay:
        if isinstance(device.camera, FakeGigE):
            options = {"device": relay.address, **options}
        camera = device.open(**PATIENT, **options)
        camera.arm(10, trigger)
        frames = [exposed(device, camera, trigger) for _ in range(10)]
        assert all(within(frame, device) for frame in frames)
        if isinstance(device.camera, FakeGigE):
            assert bool(relay.latches) == (options["time_stamp"] != "none")
        if trigger is not Trigger.FREE:
            words = {Trigger.SOFTWARE: "trigger after the pattern", Trigger.HARDWARE: "cable"}[trigger]
            with pytest.raises(FrameTimeoutError, match=rf"{trigger} trigger; skipped: none.*{words}"):
                camera.read(0, SHORT_S)
            assert [frame.sequence_number for frame in frames] == list(range(10))
            assert frames[-1].dropped_count == 0
            assert len(device.camera.exposures) == 10
        camera.close()


def test_no_wait_of_gentl_keeps_other_threads_waiting() -> None:
    with gentl_bench.serving(MemoryCamera(Stage(scene()))) as producer:
        camera = gentl_bench.opened(producer)
        camera.arm(1, Trigger.FREE)
        camera.read(0, LONG_S)
        camera.close()
        assert producer.longest_wait_ms == 0


# ---- what limits frames on their way


@pytest.mark.parametrize(("memory_mb", "notes"), [("0", 0), ("10", 0), ("9", 1)])
def test_little_memory_for_usb_is_noted_with_the_command_that_gives_more(
    memory_mb: str, notes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usbfs = tmp_path / "usbfs_memory_mb"
    usbfs.write_text(f"{memory_mb}\n")
    monkeypatch.setattr(link, "USBFS", usbfs)
    # 32 frames of 640 x 480 bytes.
    with gentl_bench.serving(MemoryCamera(Stage(scene()), link="U3V")) as producer:
        camera = gentl_bench.opened(producer, region=None)
        camera.arm(1, Trigger.HARDWARE)
        with pytest.raises(FrameTimeoutError, match="check the trigger's cable") as late:
            camera.read(0, 0.0)
        camera.close()
    told = camera.info.notes
    assert len(told) == notes
    assert all("9 MB of the system" in note and f"sudo sh -c 'echo 1000 > {usbfs}'" in note for note in told)
    assert all(note in str(late.value) for note in told)


@pytest.mark.parametrize(("subclass", "permitted", "found"), [("05", False, 1), ("05", True, 0), ("02", False, 0)])
def test_a_usb3_vision_camera_that_the_user_may_not_open_is_listed_with_its_udev_rule(
    subclass: str, permitted: bool, found: int, tmp_path: Path
) -> None:
    told = {"idVendor": "2676", "manufacturer": "Basler", "product": "acA1300", "serial": "23A", "busnum": "2"}
    facts = {"1-2": {**told, "devnum": "7"}, "1-2:1.0": {"bInterfaceClass": "ef", "bInterfaceSubClass": subclass}}
    for device, each in facts.items():
        (tmp_path / "sys" / device).mkdir(parents=True)
        for name, text in each.items():
            (tmp_path / "sys" / device / name).write_text(f"{text}\n")
    if permitted:
        (tmp_path / "dev/002").mkdir(parents=True)
        (tmp_path / "dev/002/007").touch()
    devices = link.find_forbidden(tmp_path / "sys", tmp_path / "dev")
    assert [(each.driver, each.device) for each in devices] == [("genicam", "23A")] * found
    assert all('ATTR{idVendor}=="2676"' in each.label and "Basler acA1300 23A" in each.label for each in devices)


# ---- what goes wrong


@pytest.mark.parametrize(("device", "lost"), [("genicam", 1.0), ("gentl", 1.0), ("gentl", 0.5)], indirect=["device"])
def test_lost_and_broken_frames_are_passed_over_and_counted(device: Device, lost: float) -> None:
    camera = device.open(answer_s=0.1)
    camera.arm(20, Trigger.SOFTWARE)
    assert exposed(device, camera).dropped_count == 0
    for dropped in (1, 2):
        device.camera.fate = lambda: Fate(lost=lost)
        camera.trigger()
        with pytest.raises(FrameTimeoutError):
            camera.read(0, 0.15)
        device.camera.fate = Fate
        frame = exposed(device, camera)
        assert (frame.dropped_count, frame.sequence_number) == (dropped, 2 * dropped)
        assert within(frame, device)


def test_a_frame_that_comes_late_is_waited_for_also_by_the_next_trigger(device: Device) -> None:
    camera = device.open(answer_s=1.0)
    camera.arm(3, Trigger.SOFTWARE)
    device.camera.fate = lambda: Fate(delay_s=0.15)
    # A camera that exposes ignores a trigger.
    camera.trigger()
    camera.trigger()
    frames = [camera.read(0, LONG_S) for _ in range(2)]
    assert all(within(frame, device) for frame in frames)
    assert [frame.sequence_number for frame in frames] == [0, 1]


def test_an_unplugged_camera_is_gone_and_opens_again(device: Device) -> None:
    camera = device.open()
    info = camera.info
    camera.arm(2, Trigger.SOFTWARE)
    exposed(device, camera)
    device.unplug()
    with pytest.raises(DeviceGoneError, match="'left'"):
        camera.trigger()
    for call in (camera.trigger, lambda: camera.read(0, LONG_S), lambda: camera.configure(CameraSettings(0.01))):
        with pytest.raises(DeviceGoneError, match=r"is gone.*cable"):
            call()
    camera.close()
    assert camera.info == info
    device.plug()
    assert one_frame(device, device.open()).image.shape == CAMERA.shape


@pytest.mark.parametrize("device", [pytest.param("genicam", marks=pytest.mark.slow), "gentl"], indirect=True)
@pytest.mark.parametrize(("trigger", "timeout_s"), [(Trigger.HARDWARE, 30.0), (Trigger.SOFTWARE, SHORT_S)])
def test_a_read_ends_when_the_camera_is_unplugged(device: Device, trigger: Trigger, timeout_s: float) -> None:
    # Aravis takes seconds; who asks for less learns it when the frame is late.
    camera = device.open()
    camera.arm(1, trigger)
    device.unplug()
    with pytest.raises(DeviceError) as gone:
        camera.read(0, timeout_s)
    assert isinstance(gone.value, DeviceGoneError)


def test_features_that_the_driver_sets_itself_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"features names ExposureTime, TriggerMode.*use exposure_s"):
        open_camera(
            "left", {"device": "x", "features": {"TriggerMode": "On", "Gamma": 1.0, "ExposureTime": 5.0}}, Path()
        )


def test_a_device_is_enough() -> None:
    assert GenicamOptions(device="Aravis-Fake-GV01").pixel_format == "Mono8"


def test_the_command_fits_the_python_in_use() -> None:
    assert "libgirepository1.0-dev" in install_command((3, 12))
    assert "libgirepository-2.0-dev" in install_command((3, 14))
    for python in ((3, 11), (3, 13)):
        assert "pip install 'slrig[genicam]'" in install_command(python)
