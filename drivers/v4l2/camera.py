"""A V4L2 camera that never gives a stale, repeated or corrupt frame."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial

from drivers.v4l2 import controls as ctl
from drivers.v4l2 import kernel
from drivers.v4l2.controls import GainScale, exposure_scale, switch_off_processing
from drivers.v4l2.finding import CameraNode, NodeIdentity, query_identity, resolve_node
from drivers.v4l2.formats import CorruptFrameError, PixelLayout, colour_image, grey_image
from drivers.v4l2.options import V4L2Options
from drivers.v4l2.stream import FilledBuffer, FrameCounter, V4L2Stream, Waker, negotiate_format
from drivers.v4l2.timing import ExposureInterval, SensorDurations, exposure_interval
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame, Pixels

_SAME_PERIOD = 0.02
"""How much longer than the frame period an exposure may seem before it is impossible."""

_PATIENCE_S = 2.0
"""How long the first frames may take beyond what they should."""


@dataclass(slots=True)
class _SkippedFrames:
    """Frames that came and were not given, by cause."""

    stale: int = 0
    corrupt: int = 0
    repeated: int = 0
    last_fault: str = ""

    def __str__(self) -> str:
        told = f"{self.stale} stale, {self.corrupt} corrupt, {self.repeated} repeated"
        return f"{told}; the last corrupt one: {self.last_fault}" if self.last_fault else told


class V4L2Camera:
    """Implements `slrig.devices.Camera`. Opening sets format, size and rate, and switches every automatic off.

    The device is held by its buffers from opening to `close`; it streams from `arm` to `disarm`.

    Exposure is a multiple of the device's unit (`scales`), rounded to its step. A device without exposure control is
    taken to expose for a whole frame period. Gain: see `scales.GainScale`.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        See `drivers.v4l2.open_camera`.
    """

    def __init__(self, name: str, options: V4L2Options) -> None:
        node = resolve_node(options.device)
        self._name = name
        self._node = node.path
        self._options = options
        self._lock = threading.RLock()
        self._state = CameraState(name)
        self._tally = FrameCounter()
        try:
            self._handle = kernel.open_node(node.path)
        except OSError as error:
            raise kernel.device_error(node.path, "opening", error) from error
        self._held = ExitStack()
        self._held.callback(_close_quietly, self._handle)
        try:
            self._waker = Waker()
            self._held.callback(self._waker.close)
            identity = self._identity()
            self._agreed = negotiate_format(self._handle, node.path, options)
            self._stream = V4L2Stream(self._handle, node.path, options.buffers, self._waker)
            self._held.callback(self._stream.release)
            self._period_ns = self._agreed.period_ns
            try:
                self._controls = ctl.exclude_controls(ctl.list_controls(self._handle), options.skip_controls, node.path)
                width_px = self._agreed.size.width_px
                self._exposure = exposure_scale(self._controls, self._handle, node.path, width_px=width_px)
            except OSError as error:
                raise kernel.device_error(node.path, "listing its controls", error) from error
            self._scale = GainScale(ctl.gain_control(self._controls), options.gain_unity)
            processed = switch_off_processing(
                self._handle, node.path, self._controls, named=options.controls, is_uvc=identity.is_uvc
            )
            self._set(None, None)
            self._applied = self._read_back()
        except BaseException:
            self._held.close()
            raise
        self._info = self._described(identity, node, (*self._agreed.notes, *processed))

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    @property
    def layout(self) -> PixelLayout:
        """How the agreed pixel format is read."""
        return self._agreed.layout

    @property
    def period_ns(self) -> int:
        """From frame to frame: as agreed, and once armed, as measured where that is longer."""
        return self._period_ns

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Exposure and gain are rounded to the device's steps, and every control is read back."""
        with self._lock:
            self._state.check_settings(settings, self._info)
            units = None
            if self._exposure is not None:
                units = self._exposure.units(settings.exposure_s)
            self._set(units, self._scale.units(settings.gain))
            self._applied = self._read_back()
            return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Starts the stream, and returns when the settings have taken effect. More than `count` frames
        can be had.

        Raises
        ------
        UnsupportedByDeviceError
            Another trigger than FREE; USB bandwidth is lacking; the exposure does not fit into the frame period, or
            was changed by the device.
        FrameTimeoutError
            No frames come.
        """
        with self._lock:
            self._state.check_arming(count, trigger, self._info)
            self._tally.begin()
            try:
                self._stream.start()
                self._settle()
            except BaseException:
                self._stream.stop()
                raise
            self._tally.forget_losses()
            self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. A free-running camera has no software trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. The exposure began after `after_ns` at the earliest, whatever the device's stamps mean."""
        with self._lock:
            self._state.require_armed()
            until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
            passed = _SkippedFrames()
            while True:
                taken = self._stream.take(until_ns)
                if taken is not None:
                    frame = self._judged(taken, after_ns, passed)
                    if frame is not None:
                        return frame
                if time.monotonic_ns() >= until_ns:
                    message = (
                        f"camera '{self._name}': no frame that was exposed wholly after {after_ns} ns came in "
                        f"{timeout_s:g} s; passed over: {passed}. Frames come every {self._period_ns / 1e6:.3g} ms, "
                        f"exposed for {self._applied.exposure_s * 1e3:.3g} ms: wait longer, or check cable and "
                        "bandwidth (dmesg | tail)"
                    )
                    raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        with self._lock:
            self._state.armed = None
            self._stream.stop()

    def close(self) -> None:
        """See `Camera`. From another thread, it ends a `read` that waits."""
        if self._state.close():
            self._waker.wake()
            with self._lock:
                self._held.close()

    def _judged(self, taken: FilledBuffer, after_ns: int, passed: _SkippedFrames) -> Frame | None:
        """The frame if it may be given; None, and noted why, if not. The buffer goes back in any case."""
        is_new = self._tally.is_new(taken)
        exposure = self._exposure_of(taken)
        if not is_new:
            passed.repeated += 1
        elif not taken.corrupt and exposure.earliest_ns < after_ns:
            passed.stale += 1
        else:
            pictures = self._pictures(taken, passed)
            if pictures is not None:
                self._stream.requeue(taken)
                return self._frame(*pictures, exposure)
            self._tally.note_corrupt()
        self._stream.requeue(taken)
        return None

    def _pictures(
        self, taken: FilledBuffer, passed: _SkippedFrames
    ) -> tuple[Pixels, Callable[[], Pixels] | None] | None:
        if taken.corrupt:
            passed.corrupt += 1
            passed.last_fault = "the driver says that its data are damaged"
            return None
        agreed = self._agreed
        sent = self._stream.data(taken), agreed.layout, agreed.size
        grey, colour = (
            partial(made, *sent, stride_bytes=agreed.stride_bytes, limited_luma=self._options.limited_luma)
            for made in (grey_image, colour_image)
        )
        try:
            return grey(), colour if agreed.layout.has_colour else None
        except CorruptFrameError as fault:
            passed.corrupt += 1
            passed.last_fault = str(fault)
            return None

    def _frame(self, image: Pixels, colour: Callable[[], Pixels] | None, exposure: ExposureInterval) -> Frame:
        start_ns, end_ns, error_ns = exposure.centred_exposure(round(self._applied.exposure_s * 1e9))
        return Frame(
            camera=self._name,
            image=image,
            t_start_ns=start_ns,
            t_end_ns=end_ns,
            t_err_ns=error_ns,
            sequence_number=self._tally.number,
            dropped_count=self._tally.lost,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
            colour=colour,
        )

    def _exposure_of(self, taken: FilledBuffer) -> ExposureInterval:
        exposure_ns = round(self._applied.exposure_s * 1e9)
        if self._exposure is None:
            exposure_ns = max(exposure_ns, self._period_ns)
        readout_s = self._options.readout_s
        readout_ns = self._period_ns if readout_s is None else round(readout_s * 1e9)
        # A device that stamps frames with instants after their arrival stamps the others as late.
        delay_ns = max(round(self._options.stamp_delay_s * 1e9), self._tally.ahead_ns)
        return exposure_interval(taken.stamp, SensorDurations(exposure_ns, readout_ns, delay_ns))

    def _settle(self) -> None:
        """Pass over the first frames, which may still be exposed as before, and measure the frame period."""
        wanted = self._options.settle_frames
        slowest_ns = max(self._agreed.period_ns, round(self._applied.exposure_s * 1e9))
        until_ns = time.monotonic_ns() + 4 * wanted * slowest_ns + round(_PATIENCE_S * 1e9)
        passed = _SkippedFrames()
        seen = 0
        while seen < wanted + 1:
            taken = self._stream.take(until_ns)
            if taken is None:
                message = (
                    f"camera '{self._name}': its stream started, and {seen} of the first {wanted + 1} frames came in "
                    f"time; passed over: {passed}. Check cable and bandwidth (dmesg | tail)"
                )
                raise FrameTimeoutError(message)
            if self._tally.is_new(taken):
                seen += 1
            else:
                passed.repeated += 1
            self._stream.requeue(taken)
        self._period_ns = max(self._agreed.period_ns, self._tally.period_ns() or 0)
        self._require_unchanged()

    def _require_unchanged(self) -> None:
        """Refuse settings that the device did not keep, or cannot have meant."""
        now = self._read_back()
        if (now.exposure_s, now.gain) != (self._applied.exposure_s, self._applied.gain):
            message = (
                f"camera '{self._name}': set to exposure {self._applied.exposure_s:.6g} s and gain "
                f"{self._applied.gain:.6g}, and once the stream ran, it used {now.exposure_s:.6g} s and {now.gain:.6g}:"
                " something else sets it; close other programs, or use a camera that obeys"
            )
            raise UnsupportedByDeviceError(message)
        period_s = self._period_ns / 1e9
        if self._applied.exposure_s > period_s * (1 + _SAME_PERIOD) and self._exposure is not None:
            message = (
                f"camera '{self._name}': asked for an exposure of {self._applied.exposure_s:.6g} s, and its frames "
                f"come every {period_s:.6g} s: it cannot have exposed them so long; ask for a shorter exposure_s, or a "
                f"frame_rate_hz of {1 / self._applied.exposure_s:.4g} or less"
            )
            raise UnsupportedByDeviceError(message)

    def _set(self, exposure_units: int | None, gain_units: int | None) -> None:
        for control, value in ctl.ordered_settings(
            self._controls, self._options, exposure_units=exposure_units, gain_units=gain_units, node=self._node
        ):
            ctl.set_control(self._handle, self._node, control, value)

    def _read_back(self) -> AppliedSettings:
        exposure_s = self._agreed.period_ns / 1e9
        if self._exposure is not None:
            exposure_s = ctl.get_control(self._handle, self._node, self._exposure.control) * self._exposure.unit_s
        gain = 1.0
        if self._scale.control is not None:
            gain = self._scale.gain(ctl.get_control(self._handle, self._node, self._scale.control))
        return AppliedSettings(exposure_s, gain, max(self._period_ns / 1e9, exposure_s))

    def _identity(self) -> NodeIdentity:
        try:
            identity = query_identity(self._handle)
        except OSError as error:
            if error.errno in kernel.GONE:
                raise kernel.device_error(self._node, "asking what it is", error) from error
            message = f"{self._node} is no video device ({error.strerror}); slrig devices lists those that are"
            raise UnsupportedByDeviceError(message) from error
        if not identity.captures:
            why = "it gives frames in several planes only" if identity.several_planes else "it gives no frames"
            message = (
                f"{self._node} ({identity.card}) cannot be used: {why}; a camera has several nodes: slrig devices "
                "lists the one to use"
            )
            raise UnsupportedByDeviceError(message)
        return identity

    def _described(self, identity: NodeIdentity, node: CameraNode, notes: tuple[str, ...]) -> CameraInfo:
        period_s = self._agreed.period_ns / 1e9
        exposures = (period_s, period_s) if self._exposure is None else self._exposure.range_s
        return CameraInfo(
            name=self._name,
            model=identity.card,
            serial=node.serial or identity.bus,
            format=CameraFormat(self._agreed.size, self._agreed.layout.bit_depth),
            triggers=frozenset({Trigger.FREE}),
            exposure_range_s=exposures,
            gain_range=self._scale.range,
            notes=notes,
            colour=self._agreed.layout.has_colour,
        )


def _close_quietly(handle: int) -> None:
    with suppress(OSError):
        os.close(handle)
