"""Opening OAK cameras: what is there, who holds it, what it can do, and what it starts with."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.depthai import find_devices, open_camera
from drivers.depthai.board import Board, require_one_clock
from slrig.devices import CameraSettings, FoundDevice, Trigger
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
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


@pytest.mark.parametrize(
    ("oak", "kind", "words"),
    [
        ({"plugged_in": False}, DeviceGoneError, "is not there; found: none"),
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
        ({"chips": [Chip("CAM_A", "IMX378")]}, UnsupportedByDeviceError, r"asked for CAM_B .* has: CAM_A \(IMX378, 64"),
        ({"options": {"size_px": [128, 96]}}, UnsupportedByDeviceError, "asked for 128 x 96, its sensor OV9282 has 64"),
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
        camera.configure(CameraSettings(0.005))
        camera.arm(1, Trigger.FREE)
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
        camera.configure(CameraSettings(0.005))
        camera.arm(1, Trigger.FREE)
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
    monkeypatch.setattr("drivers.depthai.board.time", SimpleNamespace(monotonic_ns=clock.now_ns))
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


def test_a_program_that_leaves_a_camera_open_ends() -> None:
    ended = subprocess.run(  # noqa: S603 - this interpreter, on a text of ours
        [sys.executable, "-c", LEAVES_IT_OPEN], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stdout.strip()) == (0, "0.005"), ended.stderr


def test_closing_waits_for_the_thread_that_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    # One that comes back from the library after the interpreter has ended aborts the program.
    ended = threading.Event()
    end = Board._end

    def slowly(board: Board, reason: str) -> None:
        threading.Event().wait(0.05)
        end(board, reason)
        ended.set()

    monkeypatch.setattr(Board, "_end", slowly)
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
        with pytest.raises(UnsupportedByDeviceError, match=r"asked for 64 x 48 from CAM_B.* no sensor mode fits"):
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
    with pytest.raises(UnsupportedByDeviceError, match=r"ISO 100, focus 20, the driver gives .* focus 77"):
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
