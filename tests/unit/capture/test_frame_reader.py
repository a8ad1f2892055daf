"""Reading cameras on threads of their own: every frame, what a driver raises, and an end that waits for nobody."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest

from slrig.capture.frame_reader import FrameReader
from slrig.capture.sequencer import capture
from slrig.devices import Camera, Synchronisation, Trigger
from slrig.errors import DeviceGoneError
from slrig.model import Frame
from tests.contract.live_devices import Webcam
from tests.contract.test_streaming import SEQUENCE, live
from tests.unit.capture.fake_rig import CameraFaults, fake_rig

FREE = frozenset({Trigger.FREE})
PATIENCE_S = 10.0


def armed(**faults: object) -> Camera:
    camera = fake_rig(
        cameras=["eye"],
        triggers={"eye": FREE},
        faults={"eye": CameraFaults(**faults)},  # type: ignore[arg-type]
    ).cameras["eye"]
    camera.arm(10, Trigger.FREE)
    return camera


def test_every_frame_comes_in_order_and_reading_ends() -> None:
    reader = FrameReader({"top": armed()})
    reader.start()
    numbers = []
    for _ in range(5):
        arrival = reader.next(PATIENCE_S)
        assert arrival is not None
        name, came = arrival
        assert name == "top"
        assert isinstance(came, Frame)
        numbers.append(came.sequence_number)
    assert numbers == [0, 1, 2, 3, 4]
    reader.stop()
    reader.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "slrig-frames of top"]


def test_what_a_driver_raises_comes_as_it_is() -> None:
    reader = FrameReader({"eye": armed(unplug_at=1)})
    reader.start()
    came = [arrival for arrival in (reader.next(PATIENCE_S) for _ in range(3)) if arrival is not None]
    reader.stop()
    assert isinstance(came[0][1], Frame)
    assert isinstance(came[-1][1], DeviceGoneError)


def test_nothing_comes_from_nobody() -> None:
    assert FrameReader({}).next(0.0) is None


def test_a_camera_that_goes_ends_the_capture_and_its_thread() -> None:
    one = live(Webcam())
    rig = replace(one.rig, synchronisation=Synchronisation(0.0, 0.0, earliest_s=0.0))
    frames = capture(rig, SEQUENCE)
    next(frames)
    rig.cameras["eye"].close()
    with pytest.raises(Exception, match="closed"):
        list(frames)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("slrig-frames")]
