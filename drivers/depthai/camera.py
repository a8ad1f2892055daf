"""An OAK camera: fixed settings that are verified in its frames, and frames that began after a given instant.

The sensor runs freely, so `read` waits for a frame whose exposure began late enough; with the option `external_trigger`
an edge on FSIN starts every exposure. Every frame carries the exposure, sensitivity and lens position it was taken
with. Settings take a few frames to reach the sensor; frames with other settings are skipped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.depthai.device import (
    MAX_WAITING_FRAMES,
    CameraLink,
    FrameQueue,
    OakDevice,
    OakFrame,
    colour_reader,
    open_device,
    read_luminance,
)
from drivers.depthai.library import OakOptions, OakSensor, OakStream, load_depthai
from slrig.bundle import validate
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import CalibrationError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame, Size

MIN_EXPOSURE_S = 100e-6
MAX_EXPOSURE_FRACTION = 0.95
"""Longest exposure as a fraction of the frame period."""

ISO_OF_GAIN_1 = 100
MAX_GAIN = 16.0
"""ISO 1600, the upper end of the range that the library recommends."""

DEFAULT_EXPOSURE_S = 1 / 60

_TOLERANCE = 0.01
_SETTLE_S = 2.0


class OakCamera:
    """Implements `slrig.devices.Camera` on one camera of an OAK device.

    Raises the errors of `open_device`, ConfigError if the settings differ from those of the device's other cameras, and
    UnsupportedByDeviceError if the device has no such camera, or the camera does not support an option.
    """

    def __init__(self, name: str, options: OakOptions) -> None:
        self._name = name
        self._vendor = load_depthai()
        self._device: OakDevice = open_device(options.device)
        try:
            self._sensor = self._choose_sensor(options)
            self._stream = self._plan_stream(options)
            self._info = self._build_info()
            low_s, high_s = self._info.exposure_range_s
            self._requested = (round(min(max(DEFAULT_EXPOSURE_S, low_s), high_s) * 1e6), ISO_OF_GAIN_1)
            self._frames: FrameQueue = self._device.join(CameraLink(self._stream, self._prepare, FrameQueue()))
        except BaseException:
            self._device.close_unless_used()
            raise
        self._state = CameraState(name)
        self._armed_ns = 0

    @property
    def info(self) -> CameraInfo:
        """See `Camera`. Gain 1 is ISO 100."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Waits for a frame with these settings; raises FrameTimeoutError if the camera delivers none.
        With an external trigger no frame arrives before the first edge, so each frame is checked later instead.
        """
        hint = f"exposures are that long at fps = {self._stream.fps:g}"
        self._state.check_settings(settings, self._info, hint=hint)
        self._device.start()
        self._requested = (round(settings.exposure_s * 1e6), round(settings.gain * ISO_OF_GAIN_1))
        control = self._vendor.CameraControl()
        control.setManualExposure(*self._requested)
        self._frames.begin()
        self._device.send(self._stream.socket, control)
        if self._stream.external_trigger:
            period_s = self._stream.trigger_burst[0] / self._stream.fps
            return AppliedSettings(self._requested[0] / 1e6, self._requested[1] / ISO_OF_GAIN_1, period_s)
        until_ns = time.monotonic_ns() + round((_SETTLE_S + 8 / self._stream.fps) * 1e9)
        last: OakFrame | None = None
        while (delivery := self._frames.take(until_ns)) is not None:
            if self._matches_settings(delivery):
                return AppliedSettings(delivery.exposure_us / 1e6, delivery.iso / ISO_OF_GAIN_1, 1 / self._stream.fps)
            last = delivery
            if delivery.received_ns > until_ns:
                break
        raise self._settling_error(last)

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. More than `count` frames are available."""
        self._state.check_arming(count, trigger, self._info, hint=self._trigger_hint(trigger))
        self._device.start()
        # Triggered frames must not be lost before they are read; a free-running camera has newer frames.
        self._frames.begin(max(MAX_WAITING_FRAMES, 2 * count) if trigger is Trigger.HARDWARE else MAX_WAITING_FRAMES)
        self._armed_ns = time.monotonic_ns()
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. An OAK has no software trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. Accounts for the error of the time stamps."""
        self._state.require_armed()
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        stale = other_settings = 0
        while (delivery := self._frames.take(until_ns)) is not None:
            if delivery.t_start_ns - self._device.err_ns < after_ns or delivery.t_start_ns < self._armed_ns:
                stale += 1
            elif not self._matches_settings(delivery):
                other_settings += 1
                self._frames.count_loss()
            else:
                return self._frame(delivery)
            # A continuous stream of unusable frames must not delay the time-out.
            if time.monotonic_ns() > until_ns:
                break
        lost, why = self._frames.losses
        damage = f", the last damaged one: {why}" if why else ""
        message = (
            f"camera '{self._name}': no frame that began after {after_ns} ns arrived in {timeout_s:g} s; skipped: "
            f"{stale} that began earlier, {other_settings} with other settings; lost since it was armed: {lost}"
            f"{damage}; check {'the trigger wire' if self._state.armed is Trigger.HARDWARE else 'cable and USB port'}"
        )
        raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        self._state.armed = None

    def close(self) -> None:
        """See `Camera`. The device is closed with the last of its cameras."""
        if self._state.close():
            self._device.leave(self._stream.socket)

    def _choose_sensor(self, options: OakOptions) -> OakSensor:
        """Return the sensor at the socket, if it supports the options."""
        device = self._device
        sensor = device.sensors.get(options.socket)
        if sensor is None:
            has = ", ".join(f"{s.socket} ({s.name}, {s.size})" for s in device.sensors.values()) or "none"
            message = (
                f"camera '{self._name}': requested {options.socket} of OAK device '{device.device_id}', which has: "
                f"{has}"
            )
            raise UnsupportedByDeviceError(message)
        if options.external_trigger and not sensor.snapshot:
            message = (
                f"camera '{self._name}': requested external_trigger, but its sensor {sensor.name} follows FSIN only at "
                "its own steady frame rate, not at any time; leave external_trigger out, or use a camera with OV9282, "
                "OV9782 or AR0234"
            )
            raise UnsupportedByDeviceError(message)
        if options.focus is not None and not sensor.autofocus:
            message = (
                f"camera '{self._name}': requested focus {options.focus}, but {options.socket} ({sensor.name}) has a "
                "fixed lens; leave focus out"
            )
            raise UnsupportedByDeviceError(message)
        return sensor

    def _plan_stream(self, options: OakOptions) -> OakStream:
        sensor = self._sensor
        size = sensor.size if options.size_px is None else Size(*options.size_px)
        if size.width_px > sensor.size.width_px or size.height_px > sensor.size.height_px:
            message = f"camera '{self._name}': requested {size}, its sensor {sensor.name} has {sensor.size}"
            raise UnsupportedByDeviceError(message)
        if options.external_trigger and size.height_px < sensor.size.height_px:
            message = (
                f"camera '{self._name}': requested {size} with external_trigger, which gives frames of all "
                f"{sensor.size.height_px} rows of its sensor only; leave size_px out"
            )
            raise UnsupportedByDeviceError(message)
        if options.trigger_burst[0] - options.trigger_burst[1] != 1:
            message = (
                f"camera '{self._name}': requested trigger_burst {list(options.trigger_burst)}, one frame of each edge "
                "must be left; write [1, 0], or [4, 3] as in Luxonis' examples"
            )
            raise UnsupportedByDeviceError(message)
        focus = options.focus
        if sensor.autofocus and focus is None:
            with suppress(CalibrationError):
                handler = self._device.factory_calibration()
                focus = handler.getLensPosition(getattr(self._vendor.CameraBoardSocket, sensor.socket))
            if not focus:
                message = (
                    f"camera '{self._name}': {options.socket} ({sensor.name}) has autofocus, which would move during a "
                    "scan, and stores no lens position; write focus = 0 … 255 into its table"
                )
                raise UnsupportedByDeviceError(message)
        return OakStream(
            socket=options.socket,
            size=size,
            fps=options.fps,
            colour=sensor.colour,
            focus=focus,
            colour_temperature_k=options.colour_temperature_k,
            external_trigger=options.external_trigger,
            trigger_burst=options.trigger_burst,
        )

    def _build_info(self) -> CameraInfo:
        trigger = Trigger.HARDWARE if self._stream.external_trigger else Trigger.FREE
        return CameraInfo(
            name=self._name,
            model=f"{self._device.model} {self._sensor.name}",
            serial=f"{self._device.device_id}-{self._stream.socket}",
            format=CameraFormat(self._stream.size, 8),
            triggers=frozenset({trigger}),
            exposure_range_s=(MIN_EXPOSURE_S, MAX_EXPOSURE_FRACTION / self._stream.fps),
            gain_range=(1.0, MAX_GAIN),
            colour=self._stream.colour,
        )

    def _prepare(self, control: Any) -> None:
        """Write the initial settings: manual, without processing of grey levels, without the camera's own light."""
        vendor, stream = self._vendor, self._stream
        control.setManualExposure(*self._requested)
        control.setSharpness(0)
        control.setLumaDenoise(0)
        control.setStrobeDisable()
        if stream.colour:
            control.setChromaDenoise(0)
            control.setManualWhiteBalance(stream.colour_temperature_k)
        if stream.focus is not None:
            control.setAutoFocusMode(vendor.CameraControl.AutoFocusMode.OFF)
            control.setManualFocus(stream.focus)
        if stream.external_trigger:
            control.setFrameSyncMode(vendor.CameraControl.FrameSyncMode.INPUT)
            control.setExternalTrigger(*stream.trigger_burst)

    def _matches_settings(self, delivery: OakFrame) -> bool:
        exposure_us, iso = self._requested
        return (
            abs(delivery.exposure_us - exposure_us) <= max(_TOLERANCE * exposure_us, 1)
            and abs(delivery.iso - iso) <= max(_TOLERANCE * iso, 1)
            and (self._stream.focus is None or abs(delivery.lens_position - self._stream.focus) <= 1)
        )

    def _frame(self, delivery: OakFrame) -> Frame:
        # The last row was read out before the frame arrived.
        skew_ns = min(self._sensor.longest_skew_ns(self._stream.fps), delivery.received_ns - delivery.t_end_ns)
        skew_ns = max(skew_ns, 0)
        image = read_luminance(delivery.message, self._stream)
        return Frame(
            camera=self._name,
            image=image,
            t_start_ns=delivery.t_start_ns,
            t_end_ns=delivery.t_end_ns + skew_ns,
            t_err_ns=self._device.err_ns,
            sequence_number=delivery.number,
            dropped_count=self._frames.losses[0],
            exposure_s=delivery.exposure_us / 1e6,
            gain=delivery.iso / ISO_OF_GAIN_1,
            shutter_skew_s=skew_ns / 1e9,
            colour=colour_reader(delivery.message, image) if self._stream.colour else None,
        )

    def _settling_error(self, last: OakFrame | None) -> Exception:
        exposure_us, iso = self._requested
        focus = "" if self._stream.focus is None else f", focus {self._stream.focus}"
        requested = f"exposure {exposure_us} µs, ISO {iso}{focus}"
        if last is None:
            lost, why = self._frames.losses
            message = (
                f"camera '{self._name}' delivers no frame after {requested} was requested ({lost} lost"
                f"{f', the last one: {why}' if why else ''}); check cable and USB port, or lower fps or size_px"
            )
            return FrameTimeoutError(message)
        got_focus = "" if self._stream.focus is None else f", focus {last.lens_position}"
        message = (
            f"camera '{self._name}': requested {requested}, the camera gives exposure {last.exposure_us} µs, "
            f"ISO {last.iso}{got_focus}; request that, or lower fps for a longer exposure"
        )
        return UnsupportedByDeviceError(message)

    def _trigger_hint(self, trigger: Trigger) -> str:
        if trigger is not Trigger.HARDWARE:
            return ""
        if self._sensor.snapshot:
            return "; write external_trigger = true into its table"
        return f"; its sensor {self._sensor.name} follows FSIN only at its own steady frame rate"


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:  # noqa: ARG001 - every driver's form
    """Open one camera of an OAK device, from its `[[camera]]` table (without `name`, `driver` and settings).

    Raises ConfigError with all faults of the options, and the errors of `OakCamera`.
    """
    return OakCamera(name, validate(OakOptions, options, f"the [[camera]] table '{name}'"))
