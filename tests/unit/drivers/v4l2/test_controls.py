"""Controls: their order, what gain and exposure mean in their numbers; and what the kernel's refusals mean."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.v4l2 import controls as ctl
from drivers.v4l2 import kernel
from drivers.v4l2.controls import Control, ExposureScale, GainScale
from drivers.v4l2.options import V4L2Options
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

NODE = Path("/dev/video7")
GAIN = Control(ctl.GAIN, "gain", 16, 255, 1, 0)


def webcam() -> dict[int, Control]:
    known = (
        Control(ctl.AUTO_WHITE_BALANCE, "white_balance_automatic", 0, 1, 1, 0),
        Control(ctl.AUTOGAIN, "gain_automatic", 0, 1, 1, 0),
        GAIN,
        Control(ctl.POWER_LINE_FREQUENCY, "power_line_frequency", 0, 2, 1, 0),
        Control(ctl.EXPOSURE_AUTO, "auto_exposure", 0, 3, 1, 0),
        Control(ctl.EXPOSURE_ABSOLUTE, "exposure_time_absolute", 3, 2047, 1, 0),
        Control(ctl.EXPOSURE_AUTO_PRIORITY, "exposure_dynamic_framerate", 0, 1, 1, 0),
        Control(ctl.FOCUS_ABSOLUTE, "focus_absolute", 0, 250, 5, 0),
        Control(ctl.FOCUS_AUTO, "focus_automatic_continuous", 0, 1, 1, 0),
        Control(0x00980910, "gamma", 72, 500, 1, 0),
    )
    return {control.number: control for control in known}


def options(**more: object) -> V4L2Options:
    return V4L2Options.model_validate({"device": "/dev/video7", **more})


def names(steps: tuple[ctl.ControlSetting, ...]) -> list[tuple[str, int]]:
    return [(step.control.name, step.value) for step in steps]


def test_automatic_controls_are_off_before_manual_values_are_set() -> None:
    asked = options(focus=30, controls={"gamma": 100})
    assert names(ctl.ordered_settings(webcam(), asked, exposure_units=167, gain_units=16, node=NODE)) == [
        ("auto_exposure", 1),
        ("exposure_time_absolute", 167),
        ("gain_automatic", 0),
        ("gain", 16),
        ("focus_automatic_continuous", 0),
        ("focus_absolute", 30),
        ("white_balance_automatic", 0),
        ("power_line_frequency", 0),
        ("gamma", 100),
    ]


def test_a_device_without_controls_needs_none() -> None:
    assert ctl.ordered_settings({}, options(), exposure_units=None, gain_units=None, node=NODE) == ()
    filtering = {ctl.POWER_LINE_FREQUENCY: Control(ctl.POWER_LINE_FREQUENCY, "power_line_frequency", 1, 2, 1, 0)}
    assert ctl.ordered_settings(filtering, options(), exposure_units=None, gain_units=None, node=NODE) == ()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"focus": 900}, "requested focus_absolute = 900, the device accepts 0 to 250"),
        ({"controls": {"gamma": 3}}, "requested gamma = 3, the device accepts 72 to 500"),
    ],
)
def test_values_out_of_range_are_refused(more: dict[str, object], words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        ctl.ordered_settings(webcam(), options(**more), exposure_units=None, gain_units=None, node=NODE)
    with pytest.raises(UnsupportedByDeviceError, match="'focus'"):
        ctl.ordered_settings({}, options(focus=3), exposure_units=None, gain_units=None, node=NODE)


@pytest.mark.parametrize(("asked", "units"), [(16.7, 17), (0, 3), (9999, 2047), (3.4, 3)])
def test_values_are_rounded_to_the_devices_grid(asked: float, units: int) -> None:
    assert webcam()[ctl.EXPOSURE_ABSOLUTE].nearest(asked) == units
    assert webcam()[ctl.FOCUS_ABSOLUTE].nearest(13) == 15


def test_exposure_is_in_units_of_100_microseconds() -> None:
    absolute = ExposureScale(webcam()[ctl.EXPOSURE_ABSOLUTE], 1e-4)
    assert absolute.range_s == pytest.approx((0.0003, 0.2047))
    assert [absolute.units(each) for each in (0.01, 1e-9)] == [100, 3]
    assert ExposureScale(Control(0, "exposure", 0, 100, 5, 0), 1e-4).range_s == pytest.approx((0.0005, 0.01))


@pytest.mark.parametrize(
    ("control", "unity", "least", "most", "units"),
    [
        # It counts from the least, or is a ratio, or there is none.
        (GAIN, None, 1.0, 240.0, {1.0: 16, 3.0: 18, 240.0: 255}),
        (GAIN, 16, 1.0, 255 / 16, {1.0: 16, 2.0: 32, 2.03: 32}),
        (Control(ctl.GAIN, "gain", 0, 255, 1, 0), 32, 1 / 32, 255 / 32, {}),
        (None, 16, 1.0, 1.0, {1.0: None}),
    ],
)
def test_gain_in_the_devices_numbers(
    control: Control | None, unity: int | None, least: float, most: float, units: dict[float, int | None]
) -> None:
    scale = GainScale(control, unity)
    assert scale.range == pytest.approx((least, most))
    assert {gain: scale.units(gain) for gain in units} == units
    assert scale.gain(18) == (1.0 if control is None else 3.0 if unity is None else 18 / unity)


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENODEV, DeviceGoneError, "plug it in again"),
        (errno.EIO, DeviceError, "dmesg"),
        (errno.EBUSY, DeviceBusyError, "fuser -v /dev/video7"),
        (errno.EACCES, DeviceError, "usermod -aG video"),
        (errno.ENOSPC, UnsupportedByDeviceError, "different USB controllers"),
        (errno.EINVAL, UnsupportedByDeviceError, "cannot do that"),
        (errno.ENOMEM, DeviceError, "dmesg"),
    ],
)
def test_error_messages_say_what_to_do(number: int, kind: type[DeviceError], words: str) -> None:
    found = kernel.device_error(NODE, "starting the stream", OSError(number, os.strerror(number)))
    assert type(found) is kind
    assert words in str(found)
    assert str(found).startswith("/dev/video7: starting the stream: ")


def test_only_faults_of_streams_report_a_dead_stream() -> None:
    broken = OSError(errno.EIO, os.strerror(errno.EIO))
    assert type(kernel.stream_error(NODE, "taking a frame", broken)) is DeviceGoneError
    assert type(kernel.stream_error(NODE, "taking a frame", OSError(errno.ENOMEM, "memory"))) is DeviceError


def test_a_program_that_holds_a_device_is_named(tmp_path: Path) -> None:
    node = tmp_path / "video0"
    node.touch()
    program = "import sys; held = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", program, str(node)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "open\n"
        message = str(kernel.device_error(node, "opening", OSError(errno.EBUSY, "busy")))
        holder.communicate()
    assert f"({holder.pid})" in message
    assert kernel.list_holders(node) == ()
