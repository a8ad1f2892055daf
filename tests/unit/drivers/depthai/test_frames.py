"""Frames of an OAK pair: fresh, whole, taken as asked, paired; and what is said when none comes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from slrig.devices import CameraSettings, Trigger
from slrig.errors import DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from tests.contract.depthai_bench import OakHead
from tests.unit.drivers.depthai.fake_oak import Chip, Fault

Opens = Callable[..., OakHead]

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
        assert (applied.exposure_s, applied.gain, applied.least_period_s) == (exposure_s, gain, 0.01)
    left.arm(1, Trigger.FREE)
    frame = left.read(0, PATIENCE_S)
    assert (frame.exposure_s, frame.gain) == (0.008, 2.0)
    left.disarm()
    pair.oak.fault.stuck_exposure_us = 3000
    with pytest.raises(UnsupportedByDeviceError, match=r"asked for exposure 5000 µs, ISO 100.* gives exposure 3000 µs"):
        left.configure(CameraSettings(0.005))


def test_a_frame_that_was_taken_otherwise_is_passed_over(head: Opens) -> None:
    pair = head()
    left = pair.cameras["left"]
    left.configure(CameraSettings(0.005))
    left.arm(1, Trigger.FREE)
    first = left.read(0, PATIENCE_S)
    pair.oak.fault.stuck_exposure_us = 9000
    with pytest.raises(FrameTimeoutError, match=r"[1-9]\d* taken otherwise than asked"):
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
        (Fault(dropped=1.0), "0 taken otherwise than asked"),
        (Fault(stamped_ahead_s=0.5), "the last damaged one: stamped later than it came"),
    ],
)
def test_a_camera_that_gives_nothing_usable_says_what_it_saw(head: Opens, fault: Fault, words: str) -> None:
    pair = head()
    left = pair.cameras["left"]
    left.configure(CameraSettings(0.005))
    left.arm(1, Trigger.FREE)
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
        camera.configure(CameraSettings(0.005))
        camera.arm(1, Trigger.FREE)
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


def test_a_wire_trigger_needs_a_sensor_that_waits_and_its_option(head: Opens) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=r"sensor IMX378 follows FSIN only at its own steady frame rate"):
        head(chips=[Chip("CAM_B", "IMX378", colour=True)], options={"external_trigger": True})
    with pytest.raises(UnsupportedByDeviceError, match="external_trigger = true"):
        head().cameras["left"].arm(1, Trigger.HARDWARE)


@pytest.mark.parametrize(("unplugged", "words"), [(True, "is gone"), (False, "was closed")])
def test_a_read_ends_when_the_device_is_unplugged_or_closed(head: Opens, unplugged: bool, words: str) -> None:
    pair = head()
    left = pair.cameras["left"]
    left.configure(CameraSettings(0.005))
    left.arm(1, Trigger.FREE)
    ending = threading.Timer(0.1, pair.oak.unplug if unplugged else pair.close)
    ending.start()
    with pytest.raises(DeviceGoneError, match=words):
        left.read(time.monotonic_ns() + 10**12, 30.0)
    ending.join()
    for camera in pair.cameras.values() if unplugged else ():
        camera.disarm()
        with pytest.raises(DeviceGoneError):
            camera.configure(CameraSettings(0.004))
