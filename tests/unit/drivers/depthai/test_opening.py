"""Opening OAK cameras, and their frames: fresh, whole, taken as asked, paired; and what is said when none comes."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.depthai import find_devices, open_camera
from drivers.depthai.device import OakDevice, require_one_clock
from slrig.devices import Camera, CameraSettings, FoundDevice, Trigger
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    FrameTimeoutError,
    SlrigError,
    UnsupportedByDeviceError,
)
from tests.contract.depthai_bench import OakHead
from tests.unit.drivers.depthai.conftest import small_stage
from tests.unit.drivers.depthai.fake_oak import ADDRESS, DEVICE, Chip, FakeOak, Fault, dai
from tests.virtual_clock import VirtualClock

Opens = Callable[..., OakHead]

ROOT = Path(__file__).resolve().parents[4]
LENSES = [Chip("CAM_B", autofocus=True), Chip("CAM_C", autofocus=True)]


def armed(camera: Camera) -> Camera:
    camera.configure(CameraSettings(0.005))
    camera.arm(1, Trigger.FREE)
    return camera


@pytest.mark.parametrize(
    ("oak", "kind", "words"),
    [
        ({"plugged_in": False}, DeviceGoneError, "not found; found: none"),
        ({"held_elsewhere": True}, DeviceBusyError, "held by another program"),
        ({"forbidden": True}, DeviceError, "80-movidius.rules"),
        (
            {"refuses": "Failed to connect to device, error message: X_LINK_DEVICE_ALREADY_IN_USE"},
            DeviceBusyError,
            "held by another program",
        ),
        (
            {"refuses": "Failed to find device after booting, error message: X_LINK_DEVICE_NOT_FOUND"},
            DeviceGoneError,
            "g",
        ),
        ({"refuses": "firmware is broken"}, DeviceError, "fails: firmware is broken"),
        ({"chips": [Chip("CAM_A", "IMX378")]}, UnsupportedByDeviceError, r"requested CAM_B .* has: CAM_A \(IMX378, 64"),
        ({"options": {"size_px": [128, 96]}}, UnsupportedByDeviceError, "requested 128 x 96, its sensor OV9282 has 64"),
        (
            {"options": {"size_px": [64, 32], "external_trigger": True}},
            UnsupportedByDeviceError,
            r"requested 64 x 32 with external_trigger.* all \d+ rows",
        ),
        (
            {"options": {"external_trigger": True, "trigger_burst": [4, 2]}},
            UnsupportedByDeviceError,
            r"trigger_burst \[4, 2\], one frame",
        ),
        ({"chips": LENSES}, UnsupportedByDeviceError, r"has autofocus.* write focus = 0"),
    ],
)
def test_a_device_that_cannot_be_opened_says_why(
    head: Opens, oak: dict[str, Any], kind: type[SlrigError], words: str
) -> None:
    with pytest.raises(kind, match=words):
        head(**oak)


def test_a_device_can_be_opened_after_a_failure_and_after_it_was_unplugged() -> None:
    oak = FakeOak(small_stage(), plugged_in=False)
    options = {"device": DEVICE, "socket": "CAM_B"}
    with oak.connected():
        with pytest.raises(DeviceGoneError):
            open_camera("left", options, Path())
        oak.plugged_in = True
        with pytest.raises(UnsupportedByDeviceError, match="fixed lens"):
            open_camera("left", {**options, "focus": 3}, Path())
        camera = open_camera("left", options, Path())
        armed(camera)
        oak.unplug()
        with pytest.raises(DeviceGoneError):
            camera.read(10**18, 5.0)
        # While a camera still holds what is gone, another one cannot use it.
        with pytest.raises(DeviceGoneError):
            open_camera("right", {**options, "socket": "CAM_C"}, Path())
        camera.close()
        oak.plugged_in = True
        oak.unplugged.clear()
        camera = open_camera("left", options, Path())
        armed(camera)
        assert camera.read(0, 2.0).image.size
        camera.close()


class SlowClock:
    """The library's clock, with an offset; on a busy machine the thread rests before and after it is read."""

    __version__ = "3.12.0"

    def __init__(self, clock: VirtualClock, offset_s: float) -> None:
        self.Clock = self
        self._clock, self._offset = clock, timedelta(seconds=offset_s)

    def now(self) -> timedelta:
        self._clock.advance(0.02)
        found = timedelta(microseconds=self._clock.now_ns() // 1000) + self._offset
        self._clock.advance(0.02)
        return found


def test_a_clock_of_another_kind_is_refused_however_slow_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualClock()
    monkeypatch.setattr("drivers.depthai.device.time", SimpleNamespace(monotonic_ns=clock.now_ns))
    require_one_clock(SlowClock(clock, 0.0))
    for offset_s in (-1.0, 1.0):
        with pytest.raises(DeviceError, match=r"is -?980 ms off CLOCK_MONOTONIC"):
            require_one_clock(SlowClock(clock, offset_s))


LEAVES_IT_OPEN = f"""
from pathlib import Path
from drivers.depthai import open_camera
from slrig.devices import CameraSettings
from tests.unit.drivers.depthai.conftest import small_stage
from tests.unit.drivers.depthai.fake_oak import FakeOak
oak = FakeOak(small_stage())
with oak.connected():
    camera = open_camera("left", {{"device": "{DEVICE}", "socket": "CAM_B"}}, Path())
print(camera.configure(CameraSettings(0.005)).exposure_s)
"""


@pytest.mark.slow
def test_a_program_that_leaves_a_camera_open_ends() -> None:
    ended = subprocess.run(  # noqa: S603 - this interpreter, on a text of ours
        [sys.executable, "-c", LEAVES_IT_OPEN], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stdout.strip()) == (0, "0.005"), ended.stderr


def test_closing_waits_for_the_thread_that_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    # One that comes back from the library after the interpreter has ended aborts the program.
    ended = threading.Event()
    end = OakDevice._end

    def slowly(board: OakDevice, reason: str) -> None:
        threading.Event().wait(0.05)
        end(board, reason)
        ended.set()

    monkeypatch.setattr(OakDevice, "_end", slowly)
    oak = FakeOak(small_stage())
    with oak.connected():
        camera = open_camera("left", {"device": DEVICE, "socket": "CAM_B"}, Path())
        camera.configure(CameraSettings(0.005))
        camera.close()
    assert ended.is_set()


@pytest.mark.parametrize(
    ("options", "kind", "words"),
    [
        ({"socket": "CAM_B"}, DeviceBusyError, "CAM_B .* is open already"),
        ({"socket": "CAM_D", "fps": 30.0}, ConfigError, r"fps is 30.0, that of its camera CAM_B is 100.0"),
        ({"socket": "CAM_D", "external_trigger": True, "fps": 100.0}, ConfigError, "external_trigger is True"),
    ],
)
def test_cameras_of_a_device_go_together(
    head: Opens, options: dict[str, object], kind: type[SlrigError], words: str
) -> None:
    head(chips=[Chip("CAM_B"), Chip("CAM_C"), Chip("CAM_D")])
    with pytest.raises(kind, match=words):
        open_camera("more", {"device": DEVICE, **options}, Path())


def test_a_camera_cannot_be_added_to_a_device_that_streams(head: Opens) -> None:
    pair = head(chips=[Chip("CAM_B"), Chip("CAM_C"), Chip("CAM_D")])
    left = pair.cameras["left"]
    left.configure(CameraSettings(0.005))
    with pytest.raises(DeviceBusyError, match="open all its cameras before the first is used"):
        open_camera("more", {"device": DEVICE, "socket": "CAM_D", "fps": 100.0}, Path())
    # One that was there from the start may come back, as it was.
    pair.cameras["right"].close()
    with pytest.raises(DeviceBusyError, match="cannot be added or changed"):
        open_camera("right", {"device": DEVICE, "socket": "CAM_C", "fps": 100.0, "size_px": [32, 32]}, Path())
    right = open_camera("right", {"device": DEVICE, "socket": "CAM_C", "fps": 100.0}, Path())
    right.configure(CameraSettings(0.004))
    right.arm(1, Trigger.FREE)
    assert right.read(0, 2.0).exposure_s == 0.004
    right.close()


def test_a_pipeline_that_the_device_refuses_is_refused_for_good(head: Opens, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = head()

    def refuse(_: object) -> None:
        message = "Camera: no sensor mode fits"
        raise RuntimeError(message)

    with monkeypatch.context() as patch:
        patch.setattr("tests.unit.drivers.depthai.fake_oak.HostOnlyPipeline.start", refuse)
        with pytest.raises(UnsupportedByDeviceError, match=r"requested 64 x 48 from CAM_B.* no sensor mode fits"):
            pair.cameras["left"].configure(CameraSettings(0.005))
    with pytest.raises(UnsupportedByDeviceError, match="no sensor mode fits"):
        pair.cameras["right"].configure(CameraSettings(0.005))


@pytest.mark.parametrize(("infrared", "asked"), [(True, ["dots 0.0", "flood 0.0"]), (False, [])])
def test_the_devices_own_light_is_switched_off(head: Opens, infrared: bool, asked: list[str]) -> None:
    pair = head(infrared=infrared)
    pair.cameras["left"].configure(CameraSettings(0.005))
    assert pair.oak.asked == ["reconnect 0", *asked]
    if infrared:
        pair.close()
        left = head(infrared_obeys=False).cameras["left"]
        with pytest.raises(DeviceError, match="does not switch its infrared light off"):
            left.configure(CameraSettings(0.005))


def test_nothing_is_automatic_and_nothing_bends_grey_levels(head: Opens) -> None:
    pair = head(
        chips=[Chip("CAM_B"), Chip("CAM_C", "IMX378", colour=True, autofocus=True)], options=None, calibration=focused()
    )
    pair.cameras["left"].configure(CameraSettings(0.005))
    command, modes = dai.CameraControl.Command, dai.CameraControl.AutoFocusMode
    mono, colour = (pair.oak.sensors[socket].initialControl for socket in ("CAM_B", "CAM_C"))
    for control in (mono, colour):
        for needed in (command.AE_MANUAL, command.SHARPNESS, command.LUMA_DENOISE, command.STROBE_CONFIG):
            assert control.getCommand(needed)
        assert (control.sharpness, control.lumaDenoise) == (0, 0)
        assert not control.getCommand(command.EXTERNAL_TRIGGER)
    assert (colour.chromaDenoise, colour.wbColorTemp, colour.autoFocusMode) == (0, 5000, modes.OFF)
    assert colour.getLensPosition() == 130
    assert not mono.getCommand(command.MOVE_LENS)


def focused() -> Any:
    handler = dai.CalibrationHandler()
    handler.setCameraIntrinsics(dai.CameraBoardSocket.CAM_C, [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], 64, 48)
    handler.setLensPosition(dai.CameraBoardSocket.CAM_C, 130)
    return handler


def test_a_lens_that_does_not_go_where_it_is_sent_is_refused(head: Opens) -> None:
    left = head(chips=LENSES, options={"focus": 20}, fault=Fault(stuck_lens=True)).cameras["left"]
    with pytest.raises(UnsupportedByDeviceError, match=r"ISO 100, focus 20, the camera gives .* focus 77"):
        left.configure(CameraSettings(0.005))


@pytest.mark.parametrize(
    ("oak", "label"),
    [
        ({}, f"OAK device at {ADDRESS}"),
        ({"held_elsewhere": True}, f"OAK device at {ADDRESS}, in use by another program"),
        ({"forbidden": True}, f"OAK device at {ADDRESS}, not permitted: it needs the udev rule "),
    ],
)
def test_devices_are_found_without_being_opened(oak: dict[str, Any], label: str) -> None:
    fake = FakeOak(small_stage(), **oak)
    with fake.connected():
        (found,) = find_devices()
    assert (found.driver, found.device) == ("depthai", DEVICE)
    assert found.label.startswith(label)
    assert fake.opened == 0


def test_a_device_that_this_process_holds_is_found_and_known_by_its_address_too(head: Opens) -> None:
    pair = head(chips=[Chip("CAM_B"), Chip("CAM_C"), Chip("CAM_D")])
    with pair.oak.connected():
        assert find_devices() == (FoundDevice("depthai", DEVICE, "OAK device, in use by this process"),)
    more = open_camera("more", {"device": ADDRESS, "socket": "CAM_D", "fps": 100.0}, Path())
    assert pair.oak.opened == 1
    assert (pair.cameras["left"].info.serial, more.info.serial) == (f"{DEVICE}-CAM_B", f"{DEVICE}-CAM_D")
    more.close()


def test_nothing_plugged_in_is_nothing_found() -> None:
    # Asks the library itself, with whatever is plugged in here: no OAK in a test machine.
    assert all(found.driver == "depthai" for found in find_devices())


LIT = np.full((1, 1), 255, np.uint8)
PATIENCE_S = 20.0
"""For a frame that comes, on a machine that does much else."""


def test_the_pair_is_one_device_and_one_pipeline(head: Opens) -> None:
    pair = head()
    assert pair.oak.opened == 1
    for camera in pair.cameras.values():
        camera.configure(CameraSettings(0.005))
    pair.cameras["left"].close()
    assert pair.oak.closed == 0
    right = pair.cameras["right"]
    right.arm(1, Trigger.FREE)
    assert right.read(0, PATIENCE_S).image.shape == (48, 64)
    right.close()
    assert pair.oak.closed == 1


def test_reading_one_camera_keeps_the_others_partner(head: Opens) -> None:
    # A queue that both took from would give the right camera a later frame than the left one.
    pair = head(fault=Fault(dropped=0.2))
    for camera in pair.cameras.values():
        camera.configure(CameraSettings(0.005))
    for camera in pair.cameras.values():
        camera.arm(20, Trigger.FREE)
    for _ in range(20):
        after_ns = time.monotonic_ns()
        left, right = (camera.read(after_ns, PATIENCE_S) for camera in pair.cameras.values())
        assert left.sequence_number == right.sequence_number
        assert left.t_start_ns == right.t_start_ns
        assert after_ns < left.t_start_ns


def test_settings_that_come_late_are_waited_for(head: Opens) -> None:
    pair = head(fault=Fault(settling_frames=9))
    left = pair.cameras["left"]
    for exposure_s, gain in ((0.002, 1.0), (0.008, 2.0)):
        applied = left.configure(CameraSettings(exposure_s, gain))
        assert (applied.exposure_s, applied.gain, applied.min_period_s) == (exposure_s, gain, 0.01)
    left.arm(1, Trigger.FREE)
    frame = left.read(0, PATIENCE_S)
    assert (frame.exposure_s, frame.gain) == (0.008, 2.0)
    left.disarm()
    pair.oak.fault.stuck_exposure_us = 3000
    with pytest.raises(UnsupportedByDeviceError, match=r"requested exposure 5000 µs, ISO 100.* gives exposure 3000 µs"):
        left.configure(CameraSettings(0.005))


def test_a_frame_that_was_taken_otherwise_is_passed_over(head: Opens) -> None:
    pair = head()
    left = armed(pair.cameras["left"])
    first = left.read(0, PATIENCE_S)
    pair.oak.fault.stuck_exposure_us = 9000
    with pytest.raises(FrameTimeoutError, match=r"[1-9]\d* with other settings"):
        left.read(time.monotonic_ns() + 20_000_000, 0.3)
    pair.oak.fault.stuck_exposure_us = None
    later = left.read(time.monotonic_ns(), PATIENCE_S)
    assert later.exposure_s == 0.005
    assert later.dropped_count > 0
    assert later.sequence_number > first.sequence_number + later.dropped_count


def test_damaged_and_lost_frames_are_passed_over_and_counted(head: Opens) -> None:
    pair = head(fault=Fault(damaged=0.3, dropped=0.1, repeated=0.2))
    pair.stage.show(LIT)
    expected = pair.stage.expected(LIT, exposure_s=0.005)
    left = pair.cameras["left"]
    left.configure(CameraSettings(0.005))
    left.arm(40, Trigger.FREE)
    frames = [left.read(0, PATIENCE_S) for _ in range(40)]
    numbers = [frame.sequence_number for frame in frames]
    assert all(np.diff(numbers) > 0)
    assert max(float(np.abs(frame.image.astype(int) - expected).mean()) for frame in frames) < 1
    lost = numbers[-1] - numbers[0] + 1 - len(frames)
    assert lost > 0
    assert frames[-1].dropped_count >= lost


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault(damaged=1.0), r"the last damaged one: (\d+ bytes where|64 x 24)"),
        (Fault(dropped=1.0), "0 with other settings"),
        (Fault(stamped_ahead_s=0.5), "the last damaged one: time stamp later than its arrival"),
    ],
)
def test_a_camera_that_gives_nothing_usable_says_what_it_saw(head: Opens, fault: Fault, words: str) -> None:
    pair = head()
    left = armed(pair.cameras["left"])
    pair.oak.fault = fault
    with pytest.raises(FrameTimeoutError, match=words):
        left.read(time.monotonic_ns() + 30_000_000, 0.3)


def test_a_colour_camera_gives_its_luminance(head: Opens) -> None:
    pair = head(chips=[Chip("CAM_B", "OV9782", colour=True), Chip("CAM_C")])
    pair.stage.show(LIT)
    expected = pair.stage.expected(LIT, exposure_s=0.005)
    for camera in pair.cameras.values():
        camera.configure(CameraSettings(0.005))
    for camera in pair.cameras.values():
        camera.arm(1, Trigger.FREE)
        frame = camera.read(time.monotonic_ns(), PATIENCE_S)
        assert np.abs(frame.image.astype(int) - expected).mean() < 1
        # The stand-in's colour is grey, with a little red in its lower half.
        assert (frame.colour is not None) == camera.info.colour == (camera is pair.cameras["left"])
        if frame.colour is not None:
            blue, green, red = (frame.colour()[..., each].astype(int) - frame.image for each in range(3))
            assert max(np.abs(each[:24]).max() for each in (blue, green, red)) <= 1
            assert np.median(red[24:]) == pytest.approx(1.402 * 20, abs=1)
            assert np.median(green[24:]) == pytest.approx(-0.714 * 20, abs=1)
            assert np.median(blue[24:]) == pytest.approx(0, abs=1)


def test_the_rows_of_a_rolling_shutter_have_all_ended_at_the_frames_end(head: Opens) -> None:
    pair = head(chips=[Chip("CAM_B", "IMX378", colour=True), Chip("CAM_C")])
    for name, longest_skew_s in (("left", 1 / 240), ("right", 0.0)):
        camera = pair.cameras[name]
        armed(camera)
        frame = camera.read(0, PATIENCE_S)
        camera.disarm()
        assert 0 <= frame.shutter_skew_s <= longest_skew_s + 1e-9  # clocks count whole nanoseconds
        assert (frame.t_end_ns - frame.t_start_ns) / 1e9 == pytest.approx(0.005 + frame.shutter_skew_s)
        assert frame.t_end_ns <= time.monotonic_ns()


def test_an_edge_on_the_wire_is_one_frame(head: Opens) -> None:
    pair = head(options={"external_trigger": True})
    cameras = pair.cameras.values()
    for camera in cameras:
        assert camera.info.triggers == {Trigger.HARDWARE}
        assert camera.configure(CameraSettings(0.004)).exposure_s == 0.004
        with pytest.raises(UnsupportedByDeviceError, match="free trigger"):
            camera.arm(1, Trigger.FREE)
    assert all(sensor.told.wait(PATIENCE_S) for sensor in pair.oak.sensors.values())
    # The first frames after a setting are still taken otherwise; those edges belong to nobody.
    for camera in cameras:
        camera.arm(8, Trigger.HARDWARE)
    with pytest.raises(FrameTimeoutError, match="check the trigger wire"):
        pair.cameras["left"].read(0, 0.05)
    last = None
    for turn in range(8):
        pair.stage.show(LIT if turn % 2 else None)
        pair.oak.pulse()
        if turn < 2:
            continue
        # Not its end: beside other work the clocks' offset is known to a few milliseconds only.
        after_ns = 0 if last is None else last.t_start_ns + 1
        left, right = (camera.read(after_ns, PATIENCE_S) for camera in cameras)
        assert left.sequence_number == right.sequence_number == turn
        assert left.dropped_count == (2 if turn == 2 else left.dropped_count)
        assert (left.image.mean() > 20) == bool(turn % 2)
        last = left


def test_a_burst_that_each_edge_takes_is_asked_for_and_waited_for(head: Opens) -> None:
    pair = head(options={"external_trigger": True, "trigger_burst": [4, 3]})
    for camera in pair.cameras.values():
        assert camera.configure(CameraSettings(0.004)).min_period_s == pytest.approx(4 / 100)
    for sensor in pair.oak.sensors.values():
        assert re.search(r"FramesBurst: 4\s+lowPowerNumFramesDiscard: 3", str(sensor.initialControl))


def test_a_wire_trigger_needs_a_sensor_that_waits_and_its_option(head: Opens) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=r"sensor IMX378 follows FSIN only at its own steady frame rate"):
        head(chips=[Chip("CAM_B", "IMX378", colour=True)], options={"external_trigger": True})
    with pytest.raises(UnsupportedByDeviceError, match="external_trigger = true"):
        head().cameras["left"].arm(1, Trigger.HARDWARE)


@pytest.mark.parametrize(("unplugged", "words"), [(True, "is gone"), (False, "was closed")])
def test_a_read_ends_when_the_device_is_unplugged_or_closed(head: Opens, unplugged: bool, words: str) -> None:
    pair = head()
    left = armed(pair.cameras["left"])
    ending = threading.Timer(0.1, pair.oak.unplug if unplugged else pair.close)
    ending.start()
    with pytest.raises(DeviceGoneError, match=words):
        left.read(time.monotonic_ns() + 10**12, 30.0)
    ending.join()
    for camera in pair.cameras.values() if unplugged else ():
        camera.disarm()
        with pytest.raises(DeviceGoneError):
            camera.configure(CameraSettings(0.004))
