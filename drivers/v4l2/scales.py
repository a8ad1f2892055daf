"""What a device's numbers for exposure and gain mean.

Exposure: `V4L2_CID_EXPOSURE_ABSOLUTE` counts 100 µs. `V4L2_CID_EXPOSURE` has no unit of its own; drivers of raw sensors
(MIPI CSI-2) count the sensor's lines, each of which takes

    (width + horizontal blanking) / pixel rate,

with `V4L2_CID_HBLANK` in pixels and `V4L2_CID_PIXEL_RATE` in pixels per second (kernel documentation, "Writing camera
sensor drivers", raw camera sensors). Gain has no unit in V4L2: see `GainScale`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.controls import (
    EXPOSURE_ABSOLUTE,
    EXPOSURE_LINES,
    HBLANK,
    PIXEL_RATE,
    Control,
    Controls,
)
from slrig.errors import UnsupportedByDeviceError

ABSOLUTE_UNIT_S = 1e-4


@dataclass(frozen=True, slots=True)
class ExposureScale:
    """An exposure control, and how long one of its units is, s."""

    control: Control
    unit_s: float

    @property
    def range_s(self) -> tuple[float, float]:
        """Least and most exposure that the device declares."""
        control = self.control
        least = control.minimum if control.minimum > 0 else control.minimum + max(control.step, 1)
        return (max(least, 1) * self.unit_s, control.maximum * self.unit_s)

    def units(self, exposure_s: float) -> int:
        """The number that is nearest to an exposure, 1 or more."""
        return max(self.control.nearest(exposure_s / self.unit_s), 1)


def exposure_scale(controls: Controls, handle: int, node: Path, *, width_px: int) -> ExposureScale | None:
    """Return the exposure control that a device has, None without one. width_px : of a frame.

    Raises
    ------
    UnsupportedByDeviceError
        It has one whose unit nothing tells.
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
            f"{node}: its control {lines.name} counts in a unit that it does not tell: to be lines of a sensor, its "
            f'{missing} is missing. Write skip_controls = ["{lines.name}"] into the camera\'s table: the camera is '
            "then taken to expose for a whole frame period; set the exposure with the maker's program before"
        )
        raise UnsupportedByDeviceError(message)
    return ExposureScale(lines, (width_px + blank_px) / rate_hz)


def _blank_px(handle: int) -> int | None:
    answer = kernel.ControlValue(id=HBLANK)
    try:
        kernel.ask(handle, kernel.G_CTRL, answer)
    except OSError as error:
        if error.errno in kernel.GONE:
            raise
        return None
    return int(answer.value)


def _pixel_rate_hz(handle: int) -> int | None:
    asked = kernel.LongControlValue(id=PIXEL_RATE)
    answer = kernel.LongControlValues(count=1, controls=ctypes.pointer(asked))
    try:
        kernel.ask(handle, kernel.G_EXT_CTRLS, answer)
    except OSError as error:
        if error.errno in kernel.GONE:
            raise
        return None
    low, high = asked.halves
    return int(high << 32 | low) or None


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
