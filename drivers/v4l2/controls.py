"""Controls of a device: setting and reading back, image processing to switch off, and units of exposure and gain.

What a device declares is a bound: some take only certain exposures between the ends of their range (see
`set_exposure`), and refuse controls that they list. Only exposure and gain are worth an error; other controls that
cannot be set, and that the user does not name, are noted.

Order matters: a device refuses or forgets an exposure while automatic exposure is on.

A device that answers one control with a fault is still connected. uvcvideo (`uvc_query_ctrl`) passes on a fault of the
bus (ETIMEDOUT, EPROTO) or, where the camera stalled the request, the cause that the camera gives: EBUSY, EACCES,
EREMOTEIO, ERANGE, EINVAL, EIO for a unit, control or request that its firmware does not serve, EPIPE without a cause.
Only ENODEV, ENXIO and ENOENT mean that it was unplugged.

Exposure: `V4L2_CID_EXPOSURE_ABSOLUTE` counts 100 µs. `V4L2_CID_EXPOSURE` has no unit of its own; drivers of raw sensors
(MIPI CSI-2) count the sensor's lines, each of which takes

    (width + horizontal blanking) / pixel rate,

with `V4L2_CID_HBLANK` in pixels and `V4L2_CID_PIXEL_RATE` in pixels per second (kernel documentation, "Writing camera
sensor drivers", raw camera sensors). Gain has no unit in V4L2: see `GainScale`.
"""

from __future__ import annotations

import ctypes
import errno
import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.options import V4L2Options
from slrig.errors import UnsupportedByDeviceError

_USER, _CAMERA, _SOURCE, _PROCESSING = 0x0098_0900, 0x009A_0900, 0x009E_0900, 0x009F_0900

BRIGHTNESS = _USER + 0
CONTRAST = _USER + 1
SATURATION = _USER + 2
AUTO_WHITE_BALANCE = _USER + 12
GAMMA = _USER + 16
EXPOSURE_LINES = _USER + 17
AUTOGAIN = _USER + 18
GAIN = _USER + 19
POWER_LINE_FREQUENCY = _USER + 24
SHARPNESS = _USER + 27
BACKLIGHT_COMPENSATION = _USER + 28
AUTOBRIGHTNESS = _USER + 32
EXPOSURE_AUTO = _CAMERA + 1
EXPOSURE_ABSOLUTE = _CAMERA + 2
EXPOSURE_AUTO_PRIORITY = _CAMERA + 3
PAN_ABSOLUTE = _CAMERA + 8
TILT_ABSOLUTE = _CAMERA + 9
FOCUS_ABSOLUTE = _CAMERA + 10
FOCUS_AUTO = _CAMERA + 12
ZOOM_ABSOLUTE = _CAMERA + 13
PRIVACY = _CAMERA + 16
PRESET_WHITE_BALANCE = _CAMERA + 20
WIDE_DYNAMIC_RANGE = _CAMERA + 21
IMAGE_STABILIZATION = _CAMERA + 22
ISO_SENSITIVITY_AUTO = _CAMERA + 24
SCENE_MODE = _CAMERA + 26
HDR_SENSOR_MODE = _CAMERA + 36
HBLANK = _SOURCE + 2
ANALOGUE_GAIN = _SOURCE + 3
PIXEL_RATE = _PROCESSING + 2

ABSOLUTE_UNIT_S = 1e-4
_MAX_CLASS_LENGTH = 64
"""More than the number of standard controls in a class."""
_MANUAL = 1
_OFF = 0
_LINEAR_GAMMA = 100
_KEEP_DEFAULT = (BRIGHTNESS, CONTRAST, SATURATION, ZOOM_ABSOLUTE, PAN_ABSOLUTE, TILT_ABSOLUTE)
_HALVES = (*(round(1e4 / 2**power) for power in range(11, -1, -1)), 20_000)
_SWITCHES = (
    *(AUTOBRIGHTNESS, EXPOSURE_AUTO_PRIORITY, HDR_SENSOR_MODE, IMAGE_STABILIZATION, ISO_SENSITIVITY_AUTO),
    *(PRESET_WHITE_BALANCE, SCENE_MODE, WIDE_DYNAMIC_RANGE),
)
_PROCESSING_NAMES = re.compile(r"denoise|noise_reduction|(^|_)w?hdr(_|$)|wide_dynamic")


@dataclass(frozen=True, slots=True)
class Control:
    """A control as the device declares it; `name` as `v4l2-ctl --list-ctrls` writes it."""

    number: int
    name: str
    minimum: int
    maximum: int
    step: int
    default: int
    is_menu: bool = False

    def nearest(self, value: float) -> int:
        """Return the nearest value on the device's grid, within its range.

        >>> Control(0, "exposure_time_absolute", 3, 2047, 4, 3).nearest(9.2)
        11
        """
        step = max(self.step, 1)
        max_steps = (self.maximum - self.minimum) // step
        return self.minimum + step * min(max(round((value - self.minimum) / step), 0), max_steps)

    def accepts(self, value: int) -> bool:
        """True if the value is in the declared range."""
        return self.minimum <= value <= self.maximum


Controls = Mapping[int, Control]
"""A device's controls by their number."""


def list_controls(handle: int) -> dict[int, Control]:
    """List every control that can be written. Raises OSError if the device is gone."""
    found: dict[int, Control] = {}
    number = 0
    while True:
        try:
            description = _query_control(handle, number | kernel.CONTROL_NEXT)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return found
            if error.errno in kernel.GONE:
                raise
            break
        number = int(description.id)
        _add_control(description, found)
    # The next control cannot be described and hides those after it: query them one by one.
    for first in (_USER, _CAMERA, _SOURCE, _PROCESSING):
        for each in range(max(first, number + 1), first + _MAX_CLASS_LENGTH):
            try:
                _add_control(_query_control(handle, each), found)
            except OSError as error:
                if error.errno in kernel.GONE:
                    raise
    return found


def _query_control(handle: int, number: int) -> kernel.ControlDescription:
    description = kernel.ControlDescription(id=number)
    kernel.ioctl(handle, kernel.QUERYCTRL, description)
    return description


def _add_control(description: kernel.ControlDescription, found: dict[int, Control]) -> None:
    if description.flags & (kernel.CONTROL_DISABLED | kernel.CONTROL_READ_ONLY | kernel.CONTROL_WRITE_ONLY):
        return
    name = re.sub(r"[^a-z0-9]+", "_", description.name.decode("utf-8", "replace").lower()).strip("_")
    is_menu = description.type in kernel.CONTROL_MENUS
    found[int(description.id)] = Control(
        int(description.id),
        name,
        description.minimum,
        description.maximum,
        description.step,
        description.default_value,
        is_menu,
    )


def exclude_controls(controls: Controls, excluded: Sequence[str], node: Path) -> Controls:
    """Return the controls without those to leave alone. Raises UnsupportedByDeviceError for an unknown name."""
    names = {control.name for control in controls.values()}
    for name in excluded:
        if name not in names:
            raise _missing_control(name, controls, node)
    return {number: control for number, control in controls.items() if control.name not in excluded}


def get_control(handle: int, node: Path, control: Control) -> int:
    """Return the value of a control.

    Raises
    ------
    UnsupportedByDeviceError
        The device does not report it.
    DeviceGoneError
        The device was unplugged.
    """
    answer = kernel.ControlValue(id=control.number)
    try:
        kernel.ioctl(handle, kernel.G_CTRL, answer)
    except OSError as error:
        if error.errno in kernel.GONE:
            raise kernel.device_error(node, f"reading control {control.name}", error) from error
        message = f"{node}: requested the value of {control.name}, the driver {_refusal(error, control)}"
        raise UnsupportedByDeviceError(message) from error
    return int(answer.value)


def set_control(handle: int, node: Path, control: Control, value: int) -> None:
    """Set a control and compare the value that it reads back.

    Raises
    ------
    UnsupportedByDeviceError
        The device refuses the value, or silently uses another one.
    DeviceGoneError
        The device was unplugged.
    """
    try:
        kernel.ioctl(handle, kernel.S_CTRL, kernel.ControlValue(id=control.number, value=value))
    except OSError as error:
        if error.errno in kernel.GONE:
            raise kernel.device_error(node, f"setting control {control.name} to {value}", error) from error
        message = (
            f"{node}: requested {control.name} = {value}, the driver {_refusal(error, control)}. It declares "
            f"{control.minimum} to {control.maximum} in steps of {control.step}: see v4l2-ctl -d {node} "
            "--list-ctrls-menus for what locks it"
        )
        raise UnsupportedByDeviceError(message) from error
    got = get_control(handle, node, control)
    if got != value:
        message = (
            f"{node}: requested {control.name} = {value}, driver gives {got}; write a value that the device can use "
            "into the rig file, and close programs that set this control"
        )
        raise UnsupportedByDeviceError(message)


def set_exposure(handle: int, node: Path, control: Control, units: int) -> None:
    """Set an exposure, or the one next to it that the device takes. Raises as `set_control`.

    Some webcams declare a range in steps of 1 and take only fractions of a second by powers of two, in 100 µs: 5, 10,
    20, 39, 78, 156, 312, 625, 1250, 2500, 5000, 10000, 20000 (Microsoft LifeCam HD-3000; so in wpilibsuite/allwpilib,
    cscore, `quirkLifeCamHd3000`).
    """
    try:
        set_control(handle, node, control, units)
    except UnsupportedByDeviceError as refusal:
        if not isinstance(refusal.__cause__, OSError):
            raise
        halves = [each for each in _HALVES if control.accepts(each)]
        for nearest in sorted(halves, key=lambda each: abs(math.log(each / units)))[:2]:
            with suppress(UnsupportedByDeviceError):
                set_control(handle, node, control, nearest)
                return
        raise


def _refusal(error: OSError, control: Control) -> str:
    refusal = f"refuses it ({os.strerror(error.errno or 0)})"
    leave = f'skip_controls = ["{control.name}"] in its table leaves it alone'
    if error.errno in (*kernel.REFUSED, errno.EACCES, errno.EBUSY):
        return f"{refusal}; {leave}"
    return f"{refusal}: the camera answers this control with a fault and is still connected; {leave}"


def gain_control(controls: Controls) -> Control | None:
    """Return the gain control, if the device has one."""
    return controls.get(GAIN) or controls.get(ANALOGUE_GAIN)


def exposure_control(controls: Controls) -> Control | None:
    """Return the exposure control, if the device has one."""
    return controls.get(EXPOSURE_ABSOLUTE) or controls.get(EXPOSURE_LINES)


@dataclass(frozen=True, slots=True)
class ControlSetting:
    """A control to set. needed : frames cannot be used without it, or the user names it."""

    control: Control
    value: int
    needed: bool


def ordered_settings(
    controls: Controls, options: V4L2Options, *, exposure_units: int | None, gain_units: int | None, node: Path
) -> tuple[ControlSetting, ...]:
    """Return every control to set and its value, in the order in which devices accept them.

    An automatic comes before the control that it governs. A control that the rig file names must exist; others are set
    if they exist.

    Raises
    ------
    UnsupportedByDeviceError
        An option names a control that the device lacks or a value that it cannot use.
    """
    if options.focus is not None and FOCUS_ABSOLUTE not in controls:
        raise _missing_control("focus", controls, node)
    steps: list[ControlSetting] = []
    for control, value, needed in (
        (controls.get(EXPOSURE_AUTO), _MANUAL, True),
        (exposure_control(controls), exposure_units, True),
        (controls.get(AUTOGAIN), _OFF, False),
        (gain_control(controls), gain_units, True),
        (controls.get(FOCUS_AUTO), _OFF, False),
        (controls.get(FOCUS_ABSOLUTE), options.focus, True),
        (controls.get(AUTO_WHITE_BALANCE), _OFF, False),
        (controls.get(POWER_LINE_FREQUENCY), _OFF, False),
    ):
        if control is None or value is None:
            continue
        # Some devices have mains filters that cannot be switched off; with manual exposure they do nothing.
        if control.number == POWER_LINE_FREQUENCY and not control.accepts(value):
            continue
        steps.append(ControlSetting(control, value, needed))
    named = {control.name: control for control in controls.values()}
    for name, value in options.controls.items():
        if name not in named:
            raise _missing_control(name, controls, node)
        steps.append(ControlSetting(named[name], value, needed=True))
    for step in steps:
        if step.needed and not step.control.accepts(step.value):
            message = (
                f"{node}: requested {step.control.name} = {step.value}, the device accepts {step.control.minimum} to "
                f"{step.control.maximum}; write a value in that range"
            )
            raise UnsupportedByDeviceError(message)
    return tuple(steps)


def require_focus(handle: int, node: Path, controls: Controls, named: Collection[str]) -> None:
    """Raise UnsupportedByDeviceError where the lens can be moved, and the user does not set its position.

    Another program, a new plug or the camera itself moves it, and a calibration holds for one position. named :
    controls that the user sets.
    """
    lens = controls.get(FOCUS_ABSOLUTE)
    if lens is None or lens.name in named:
        return
    message = (
        f"{node}: a motor moves its lens, and a calibration holds for one position of it. Make the picture sharp, and "
        f"write the lens's position into the camera's table: focus = {get_control(handle, node, lens)} is the present "
        f'one. Where no motor moves it: skip_controls = ["{lens.name}"]'
    )
    raise UnsupportedByDeviceError(message)


def _missing_control(name: str, controls: Controls, node: Path) -> UnsupportedByDeviceError:
    known = ", ".join(sorted(control.name for control in controls.values())) or "none"
    return UnsupportedByDeviceError(f"{node}: requested control '{name}', the device has: {known}; correct the name")


def switch_off_processing(
    handle: int, node: Path, controls: Controls, *, named: Collection[str], is_uvc: bool
) -> tuple[str, ...]:
    """Switch a camera's own image processing off, read it back, and return notes on what stays on.

    Sharpening makes halos at edges, which move stripes near a printed edge; a tone curve, or one that follows the
    picture (backlight compensation, high dynamic range), makes equal light give unequal greys; noise reduction mixes
    neighbours and frames. A frame rate that follows the light makes exposure times unknown. Stabilisation moves the
    picture. Zoom, pan and tilt keep the values of the last program, and a calibration holds for one value of each; a
    brightness that it left clips black: they are set to their defaults.

    Gamma: the USB Video Class counts it in hundredths, 1 to 500, so 100 is a gamma of 1 (USB Device Class Definition
    for Video Devices 1.5, Processing Unit, "Gamma Control"; the same in Windows' KSPROPERTY_VIDEOPROCAMP_GAMMA). Many
    cameras apply it on top of a fixed curve, so only a measurement, by `slrig doctor`, shows that values grow with
    light. For other drivers no value is known to be linear: V4L2 gives the control no unit. Noise reduction has no
    standard control; makers' controls are found by their names.

    named : controls that the rig file sets; left alone. is_uvc : the camera is of the USB Video Class.

    Raises
    ------
    DeviceGoneError
        The device is gone. Refusals are returned as notes.
    """
    notes: list[str] = []
    if _is_covered(handle):
        notes.append("its privacy shutter is closed, and its pictures are black: open it")
    for control in controls.values():
        wanted = _neutral_value(control, is_uvc=is_uvc)
        if wanted is None or control.name in named:
            continue
        if isinstance(wanted, str):
            notes.append(f"{wanted}; write the right value as controls = {{ {control.name} = … }} into its table")
            continue
        try:
            set_control(handle, node, control, wanted)
        except UnsupportedByDeviceError as refusal:
            notes.append(f"its own image processing cannot be switched off: {refusal}")
    return tuple(notes)


def _is_covered(handle: int) -> bool:
    """True if a camera with a privacy control reports that it is covered, mostly by a manual shutter."""
    answer = kernel.ControlValue(id=PRIVACY)
    with suppress(OSError):
        kernel.ioctl(handle, kernel.G_CTRL, answer)
    return bool(answer.value)


def _neutral_value(control: Control, *, is_uvc: bool) -> int | str | None:
    """Return the value to set; a note if the right one is unknown; None for a control to leave alone."""
    number = control.number
    if number == SHARPNESS:
        return control.minimum
    if number in _KEEP_DEFAULT:
        return control.default
    if number == BACKLIGHT_COMPENSATION:
        return 0 if control.accepts(0) else control.minimum
    if number == GAMMA:
        if is_uvc and control.nearest(_LINEAR_GAMMA) == _LINEAR_GAMMA:
            return _LINEAR_GAMMA
        return (
            f"the value of its control {control.name} ({control.minimum} to {control.maximum}) for linear images is "
            "unknown; slrig doctor measures whether they are linear"
        )
    if number in _SWITCHES:
        return 0
    if not _PROCESSING_NAMES.search(control.name):
        return None
    if control.is_menu or not control.accepts(0):
        return f"its control {control.name} changes its pictures, and the value for off is unknown"
    return 0


@dataclass(frozen=True, slots=True)
class ExposureScale:
    """An exposure control, and the duration of one of its units, s."""

    control: Control
    unit_s: float

    @property
    def range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure that the device declares."""
        control = self.control
        minimum = control.minimum if control.minimum > 0 else control.minimum + max(control.step, 1)
        return (max(minimum, 1) * self.unit_s, control.maximum * self.unit_s)

    def units(self, exposure_s: float) -> int:
        """Return the number of units nearest to an exposure, 1 or more."""
        return max(self.control.nearest(exposure_s / self.unit_s), 1)


def exposure_scale(controls: Controls, handle: int, node: Path, *, width_px: int) -> ExposureScale | None:
    """Return a device's exposure control and its unit, None without one. width_px : of a frame.

    Raises
    ------
    UnsupportedByDeviceError
        The unit of its control is unknown.
    """
    absolute = controls.get(EXPOSURE_ABSOLUTE)
    if absolute is not None:
        return ExposureScale(absolute, ABSOLUTE_UNIT_S)
    lines = controls.get(EXPOSURE_LINES)
    if lines is None:
        return None
    blank_px, rate_hz = _blank_px(handle), _pixel_rate_hz(handle)
    if blank_px is None or rate_hz is None:
        missing = "horizontal blanking" if blank_px is None else "pixel rate"
        message = (
            f"{node}: the unit of its control {lines.name} is unknown: if it counts lines of a sensor, its "
            f'{missing} is missing. Write skip_controls = ["{lines.name}"] into the camera\'s table: the camera is '
            "then assumed to expose for a whole frame period; set the exposure with the maker's program before"
        )
        raise UnsupportedByDeviceError(message)
    return ExposureScale(lines, (width_px + blank_px) / rate_hz)


def _blank_px(handle: int) -> int | None:
    answer = kernel.ControlValue(id=HBLANK)
    try:
        kernel.ioctl(handle, kernel.G_CTRL, answer)
    except OSError as error:
        if error.errno in kernel.GONE:
            raise
        return None
    return int(answer.value)


def _pixel_rate_hz(handle: int) -> int | None:
    rate = kernel.LongControlValue(id=PIXEL_RATE)
    answer = kernel.LongControlValues(count=1, controls=ctypes.pointer(rate))
    try:
        kernel.ioctl(handle, kernel.G_EXT_CTRLS, answer)
    except OSError as error:
        if error.errno in kernel.GONE:
            raise
        return None
    low, high = rate.halves
    return int(high << 32 | low) or None


@dataclass(frozen=True, slots=True)
class GainScale:
    """Gain as a factor, from the device's own numbers.

    V4L2 does not define the unit of a gain control. Without `unity` (option `gain_unity`), gain 1 is the smallest value
    of the device, and each number above it counts as 1 more: an order, not a ratio. With it, gain is the control's
    value over the value at which the sensor's gain is 1.
    """

    control: Control | None
    unity: int | None

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest gain; (1, 1) for a device without gain control."""
        if self.control is None:
            return (1.0, 1.0)
        smallest = self.gain(self.control.minimum)
        if smallest <= 0:
            smallest = self.gain(self.control.minimum + max(self.control.step, 1))
        return (smallest, self.gain(self.control.maximum))

    def gain(self, units: int) -> float:
        """Return the gain factor of a value of the control."""
        if self.control is None:
            return 1.0
        return units / self.unity if self.unity is not None else 1.0 + (units - self.control.minimum)

    def units(self, gain: float) -> int | None:
        """Return the value nearest to a gain factor; None for a device without gain control."""
        if self.control is None:
            return None
        wanted = gain * self.unity if self.unity is not None else self.control.minimum + gain - 1
        return self.control.nearest(wanted)
