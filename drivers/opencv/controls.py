"""Set a V4L2 camera through OpenCV and read its settings back: OpenCV's `set` returns True even if it failed.

From OpenCV's cap_v4l.cpp (4.x, 5.0) and tests on a kernel's camera: a pixel format that the device
does not have leaves the one before; a value out of range is clamped; CAP_PROP_MODE 0 makes the numbers of controls the
kernel's own (1 is manual exposure, exposure counts 100 µs), in every environment; a control that the device
does not have reads as -1. On other systems the numbers have other meanings, which cannot be verified.
"""

from __future__ import annotations

import os
from ctypes import Structure
from dataclasses import dataclass
from pathlib import Path

import cv2

from drivers.opencv.options import OpenCvOptions
from drivers.v4l2 import controls as v4l2
from drivers.v4l2 import kernel
from drivers.v4l2.controls import (
    AUTOGAIN,
    exclude_controls,
    list_controls,
    require_focus,
    set_control,
    switch_off_processing,
)
from drivers.v4l2.finding import query_identity
from slrig.devices import AppliedSettings, CameraSettings
from slrig.errors import DeviceGoneError, SlrigError, UnsupportedByDeviceError
from slrig.model import Size

EXPOSURE_UNIT_S = 1e-4
_ABSENT = -1.0
_MANUAL = 1
_MIN_UNITS, _MAX_UNITS = 1, 600_000
_TOLERANCE = 0.01
_KERNEL_CONTROLS = {
    cv2.CAP_PROP_AUTO_EXPOSURE: v4l2.EXPOSURE_AUTO,
    cv2.CAP_PROP_EXPOSURE: v4l2.EXPOSURE_ABSOLUTE,
    cv2.CAP_PROP_GAIN: v4l2.GAIN,
    cv2.CAP_PROP_AUTOFOCUS: v4l2.FOCUS_AUTO,
    cv2.CAP_PROP_FOCUS: v4l2.FOCUS_ABSOLUTE,
    cv2.CAP_PROP_AUTO_WB: v4l2.AUTO_WHITE_BALANCE,
}
"""The kernel's control of each of OpenCV's properties."""


def require_free(path: str) -> None:
    """Raise unless a camera is connected and no program streams from it: only a program that does may free its buffers.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        It is not connected, is in use, has no frames, or may not be opened.
    """
    none = kernel.BufferRequest(count=0, type=kernel.CAPTURE, memory=kernel.MMAP)
    _request_once(path, "requesting frames", kernel.REQBUFS, none)


def require_present(path: str, otherwise: DeviceGoneError) -> None:
    """Raise `otherwise` unless the camera answers."""
    try:
        _request_once(path, "reading its identity", kernel.QUERYCAP, kernel.Capability())
    except SlrigError as error:
        raise otherwise from error


def switch_off_automatics(path: str, options: OpenCvOptions) -> tuple[frozenset[int], tuple[str, ...]]:
    """Switch a camera's automatic gain and image processing off, for which OpenCV has no properties.

    Return the numbers of the controls that the options leave alone, and notes for the user.

    Raises
    ------
    DeviceGoneError, DeviceError
        The camera is not connected, or fails.
    UnsupportedByDeviceError
        It has no control of such a name, its automatic gain cannot be switched off, or a motor moves its lens and the
        options name no focus.
    """
    node = Path(path)
    try:
        handle = kernel.open_node(node)
        try:
            every = list_controls(handle)
            used = exclude_controls(every, options.skip_controls, node)
            if options.focus is None:
                require_focus(handle, node, used, named=())
            if AUTOGAIN in used:
                set_control(handle, node, used[AUTOGAIN], 0)
            notes = switch_off_processing(handle, node, used, named=(), is_uvc=query_identity(handle).is_uvc)
        finally:
            os.close(handle)
    except OSError as error:
        raise kernel.device_error(node, "setting its controls", error) from error
    return frozenset(every.keys() - used.keys()), notes


def _request_once(path: str, action: str, request: int, argument: Structure) -> None:
    try:
        handle = kernel.open_node(Path(path))
        try:
            kernel.ioctl(handle, request, argument)
        finally:
            os.close(handle)
    except OSError as error:
        raise kernel.device_error(Path(path), action, error) from error


def read_fourcc(capture: cv2.VideoCapture) -> str:
    """Return the four characters of the pixel format in use."""
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=False).decode("latin-1")


def read_size(capture: cv2.VideoCapture) -> Size:
    """Return the size in use. Raises UnsupportedByDeviceError where OpenCV reports none."""
    width, height = (int(capture.get(number)) for number in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width < 1 or height < 1:
        message = f"OpenCV reports a size of {width} x {height}; write size_px and fourcc into the rig file"
        raise UnsupportedByDeviceError(message)
    return Size(width, height)


def negotiate(capture: cv2.VideoCapture, options: OpenCvOptions, label: str) -> None:
    """Set pixel format, size and rate, as far as they are requested.

    Raises
    ------
    UnsupportedByDeviceError
        The device uses another one.
    """
    capture.set(cv2.CAP_PROP_MODE, 0)
    if options.fourcc is not None:
        wanted = options.fourcc.ljust(4)
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*wanted))
        got = read_fourcc(capture)
        if got != wanted:
            message = (
                f"{label}: requested pixel format {wanted.strip()}, the driver gives {got.strip()}; choose one of "
                "`v4l2-ctl --list-formats-ext`"
            )
            raise UnsupportedByDeviceError(message)
    if options.size is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, options.size.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, options.size.height_px)
        found = read_size(capture)
        if found != options.size:
            message = (
                f"{label}: requested {options.size}, the driver gives {found}; choose one of "
                "`v4l2-ctl --list-formats-ext`, or leave size_px out"
            )
            raise UnsupportedByDeviceError(message)
    if options.frame_rate_hz is not None:
        capture.set(cv2.CAP_PROP_FPS, options.frame_rate_hz)
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        # OpenCV rounds to whole frames per second.
        if abs(rate_hz - options.frame_rate_hz) > max(_TOLERANCE * options.frame_rate_hz, 0.5):
            message = (
                f"{label}: requested {options.frame_rate_hz:g} frames per second, the driver gives {rate_hz:g}; choose "
                "one of `v4l2-ctl --list-formats-ext`, or leave frame_rate_hz out"
            )
            raise UnsupportedByDeviceError(message)


@dataclass(frozen=True, slots=True)
class ControlRange:
    """Smallest and largest value of a control."""

    minimum: float
    maximum: float


class CaptureControls:
    """The controls of an open camera, to be made once it streams. Switches every automatic control off.

    fixed_s : exposure of a device whose exposure cannot be set. skipped : the kernel's controls that are left alone.
    Gain 1 is the smallest value of the device, and each number above it counts as 1 more: V4L2 defines no unit.

    Raises
    ------
    UnsupportedByDeviceError
        An automatic cannot be switched off, or a focus is requested and the focus control is missing.
    """

    def __init__(
        self,
        capture: cv2.VideoCapture,
        options: OpenCvOptions,
        label: str,
        *,
        fixed_s: float,
        skipped: frozenset[int] = frozenset(),
    ) -> None:
        self._capture = capture
        self._skipped = skipped
        self._label = label
        self._fixed_s = fixed_s
        self._switch_off(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL, "automatic exposure")
        self._exposure = self._range(cv2.CAP_PROP_EXPOSURE, _MIN_UNITS, _MAX_UNITS)
        self._gain = self._range(cv2.CAP_PROP_GAIN, -(2.0**30), 2.0**30)
        self._switch_off(cv2.CAP_PROP_AUTOFOCUS, 0, "autofocus")
        if options.focus is not None:
            self._set(cv2.CAP_PROP_FOCUS, options.focus, "focus", within=0.5)
        self._switch_off(cv2.CAP_PROP_AUTO_WB, 0, "automatic white balance")

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure."""
        if self._exposure is None:
            return (self._fixed_s, self._fixed_s)
        return (self._exposure.minimum * EXPOSURE_UNIT_S, self._exposure.maximum * EXPOSURE_UNIT_S)

    @property
    def gain_range(self) -> tuple[float, float]:
        """Smallest and largest gain."""
        return (1.0, 1.0) if self._gain is None else (1.0, 1.0 + self._gain.maximum - self._gain.minimum)

    def apply(self, settings: CameraSettings) -> AppliedSettings:
        """Set exposure and gain, and read them back. Raises UnsupportedByDeviceError where they differ."""
        if self._exposure is not None:
            units = max(round(settings.exposure_s / EXPOSURE_UNIT_S), 1)
            self._set(cv2.CAP_PROP_EXPOSURE, units, "exposure in units of 100 µs", within=_TOLERANCE * units)
        if self._gain is not None:
            units = round(self._gain.minimum + settings.gain - 1)
            self._set(cv2.CAP_PROP_GAIN, units, "gain in its own units", within=_TOLERANCE * settings.gain)
        return self.read_back()

    def read_back(self) -> AppliedSettings:
        """Return the settings that the device reports."""
        exposure_s, gain = self._fixed_s, 1.0
        if self._exposure is not None:
            exposure_s = self._capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_S
        if self._gain is not None:
            gain = 1.0 + self._capture.get(cv2.CAP_PROP_GAIN) - self._gain.minimum
        return AppliedSettings(exposure_s, gain)

    def _range(self, number: int, below: float, above: float) -> ControlRange | None:
        """Find a control's range, which OpenCV does not report, by clamped values. Restores the value."""
        if not self._has(number):
            return None
        before = self._capture.get(number)
        ends = []
        for outside in (below, above):
            self._capture.set(number, outside)
            ends.append(self._capture.get(number))
        self._capture.set(number, before)
        return ControlRange(min(ends), max(ends))

    def _has(self, number: int) -> bool:
        return _KERNEL_CONTROLS[number] not in self._skipped and self._capture.get(number) != _ABSENT

    def _switch_off(self, number: int, manual: int, name: str) -> None:
        if not self._has(number):
            return
        self._capture.set(number, manual)
        got = self._capture.get(number)
        if got != manual:
            message = (
                f"{self._label}: {name} cannot be switched off: requested {manual}, the driver gives {got:g}; use the "
                "driver v4l2, or another camera"
            )
            raise UnsupportedByDeviceError(message)

    def _set(self, number: int, value: float, name: str, *, within: float) -> None:
        self._capture.set(number, value)
        got = self._capture.get(number)
        if abs(got - value) > within:
            found = "has no such control" if got == _ABSENT else f"gives {got:g}"
            message = f"{self._label}: requested {name} {value:g}, the driver {found}; write another value"
            raise UnsupportedByDeviceError(message)
