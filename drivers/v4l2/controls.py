"""Controls: what a device lets be set, in which order, and what it reads back.

Order matters: a device refuses or forgets an exposure while its automatic is on. Exposure is in units of 100 µs
(`V4L2_CID_EXPOSURE_ABSOLUTE`). Gain has no unit in V4L2: see `GainScale`.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.options import V4L2Options
from slrig.errors import UnsupportedByDeviceError

_USER, _CAMERA, _SOURCE = 0x0098_0900, 0x009A_0900, 0x009E_0900

AUTO_WHITE_BALANCE = _USER + 12
AUTOGAIN = _USER + 18
GAIN = _USER + 19
POWER_LINE_FREQUENCY = _USER + 24
EXPOSURE_AUTO = _CAMERA + 1
EXPOSURE_ABSOLUTE = _CAMERA + 2
EXPOSURE_AUTO_PRIORITY = _CAMERA + 3
FOCUS_ABSOLUTE = _CAMERA + 10
FOCUS_AUTO = _CAMERA + 12
ANALOGUE_GAIN = _SOURCE + 3

EXPOSURE_UNIT_S = 1e-4
_MANUAL = 1
_OFF = 0


@dataclass(frozen=True, slots=True)
class Control:
    """A control as the device declares it; `name` as `v4l2-ctl --list-ctrls` writes it."""

    number: int
    name: str
    minimum: int
    maximum: int
    step: int
    flags: int

    def nearest(self, value: float) -> int:
        """The value on the device's grid that is nearest, within its range.

        >>> Control(0, "exposure_time_absolute", 3, 2047, 4, 0).nearest(9.2)
        11
        """
        step = max(self.step, 1)
        most = (self.maximum - self.minimum) // step
        return self.minimum + step * min(max(round((value - self.minimum) / step), 0), most)

    def takes(self, value: int) -> bool:
        """Whether the value lies in the declared range."""
        return self.minimum <= value <= self.maximum


Controls = Mapping[int, Control]
"""A device's controls by their number."""


def controls_of(handle: int) -> dict[int, Control]:
    """Every control that the device has and lets be written."""
    found: dict[int, Control] = {}
    asked = kernel.ControlDescription(id=kernel.CONTROL_NEXT)
    while True:
        try:
            kernel.ask(handle, kernel.QUERYCTRL, asked)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return found
            raise
        number = int(asked.id)
        if not asked.flags & (kernel.CONTROL_DISABLED | kernel.CONTROL_READ_ONLY | kernel.CONTROL_WRITE_ONLY):
            name = re.sub(r"[^a-z0-9]+", "_", asked.name.decode("utf-8", "replace").lower()).strip("_")
            found[number] = Control(number, name, asked.minimum, asked.maximum, asked.step, asked.flags)
        asked = kernel.ControlDescription(id=number | kernel.CONTROL_NEXT)


def value_of(handle: int, node: Path, control: Control) -> int:
    """What a control is set to. Raises DeviceError."""
    answer = kernel.ControlValue(id=control.number)
    try:
        kernel.ask(handle, kernel.G_CTRL, answer)
    except OSError as error:
        raise kernel.fault(node, f"reading control {control.name}", error) from error
    return int(answer.value)


def put(handle: int, node: Path, control: Control, value: int) -> None:
    """Set a control and compare what it reads back.

    Raises
    ------
    UnsupportedByDeviceError
        The device refuses the value, or takes another one in silence.
    DeviceError
        The device failed.
    """
    try:
        kernel.ask(handle, kernel.S_CTRL, kernel.ControlValue(id=control.number, value=value))
    except OSError as error:
        refused = (*kernel.REFUSED, errno.EACCES, errno.EBUSY)
        if error.errno in refused:
            message = (
                f"{node}: asked {control.name} = {value}, the driver refuses it ({error.strerror}); it declares "
                f"{control.minimum} to {control.maximum} in steps of {control.step}: look at v4l2-ctl -d {node} "
                "--list-ctrls-menus for what holds it"
            )
            raise UnsupportedByDeviceError(message) from error
        raise kernel.fault(node, f"setting control {control.name} to {value}", error) from error
    got = value_of(handle, node, control)
    if got != value:
        message = (
            f"{node}: asked {control.name} = {value}, driver gives {got}; write a value that the device can use into "
            "the rig file, and switch off whatever else sets this control"
        )
        raise UnsupportedByDeviceError(message)


@dataclass(frozen=True, slots=True)
class GainScale:
    """Gain as a factor, from the device's own numbers.

    V4L2 does not say what a gain control's numbers mean. Without `unity` (option `gain_unity`), gain 1 is the least
    that the device can do, and each number above it counts as 1 more: an order, not a ratio. With it, gain is the
    control's value over the value at which the sensor's gain is 1.
    """

    control: Control | None
    unity: int | None

    @property
    def range(self) -> tuple[float, float]:
        """Least and most gain; (1, 1) for a device without gain control."""
        if self.control is None:
            return (1.0, 1.0)
        least = self.gain(self.control.minimum)
        if least <= 0:
            least = self.gain(self.control.minimum + max(self.control.step, 1))
        return (least, self.gain(self.control.maximum))

    def gain(self, units: int) -> float:
        """The factor that a number of the device means."""
        if self.control is None:
            return 1.0
        return units / self.unity if self.unity is not None else 1.0 + (units - self.control.minimum)

    def units(self, gain: float) -> int | None:
        """The number nearest to a factor; None for a device without gain control."""
        if self.control is None:
            return None
        wanted = gain * self.unity if self.unity is not None else self.control.minimum + gain - 1
        return self.control.nearest(wanted)


def gain_control(controls: Controls) -> Control | None:
    """The control that amplifies, if the device has one."""
    return controls.get(GAIN) or controls.get(ANALOGUE_GAIN)


def exposure_range_s(control: Control) -> tuple[float, float]:
    """Least and most exposure that a device declares."""
    least = control.minimum if control.minimum > 0 else control.minimum + max(control.step, 1)
    return (max(least, 1) * EXPOSURE_UNIT_S, control.maximum * EXPOSURE_UNIT_S)


def in_order(
    controls: Controls, options: V4L2Options, *, exposure_units: int | None, gain_units: int | None, node: Path
) -> tuple[tuple[Control, int], ...]:
    """Every control to set and its value, in the order in which devices take them.

    Automatics come before what they would govern. A device without a control needs no setting; one that the person
    asked for by name must be there.

    Raises
    ------
    UnsupportedByDeviceError
        An option names a control that the device does not have or a value that it cannot take.
    """
    steps: list[tuple[Control, int]] = []
    for number, value in (
        (EXPOSURE_AUTO, _MANUAL),
        (EXPOSURE_AUTO_PRIORITY, _OFF),
        (EXPOSURE_ABSOLUTE, exposure_units),
        (AUTOGAIN, _OFF),
        (None, gain_units),
        (FOCUS_AUTO, _OFF),
        (FOCUS_ABSOLUTE, options.focus),
        (AUTO_WHITE_BALANCE, _OFF),
        (POWER_LINE_FREQUENCY, _OFF),
    ):
        control = gain_control(controls) if number is None else controls.get(number)
        if control is None and number == FOCUS_ABSOLUTE and value is not None:
            raise _lacks("focus", controls, node)
        if control is None or value is None:
            continue
        # Some devices have mains filters that cannot be switched off; with manual exposure they do nothing.
        if number == POWER_LINE_FREQUENCY and not control.takes(value):
            continue
        steps.append((control, value))
    named = {control.name: control for control in controls.values()}
    for name, value in options.controls.items():
        if name not in named:
            raise _lacks(name, controls, node)
        steps.append((named[name], value))
    for control, value in steps:
        if not control.takes(value):
            message = (
                f"{node}: asked {control.name} = {value}, the device takes {control.minimum} to {control.maximum}; "
                "write a value in that range"
            )
            raise UnsupportedByDeviceError(message)
    return tuple(steps)


def _lacks(name: str, controls: Controls, node: Path) -> UnsupportedByDeviceError:
    known = ", ".join(sorted(control.name for control in controls.values())) or "none"
    return UnsupportedByDeviceError(f"{node}: asked for control '{name}', the device has: {known}; correct the name")
