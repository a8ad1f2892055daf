"""A V4L2 camera that never returns a stale, repeated or corrupt frame."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial

from drivers.v4l2 import kernel
from drivers.v4l2.controls import (
    GainScale,
    exclude_controls,
    exposure_scale,
    gain_control,
    get_control,
    list_controls,
    ordered_settings,
    require_focus,
    set_control,
    set_exposure,
    switch_off_processing,
)
from drivers.v4l2.finding import CameraNode, NodeIdentity, query_identity, resolve_node
from drivers.v4l2.formats import CorruptFrameError, PaddedFrameError, PixelLayout, colour_image, grey_image
from drivers.v4l2.options import V4L2Options
from drivers.v4l2.stream import (
    PERIOD_TOLERANCE,
    ExposureInterval,
    FilledBuffer,
    FrameCounter,
    SensorDurations,
    V4L2Stream,
    Waker,
    exposure_interval,
    negotiate_format,
    set_period,
)
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame, Pixels

_START_TOLERANCE_S = 10.0
"""Time allowed for the first frame beyond its usual one: some webcams take 2 to 4 s (OpenCV waits 10 s)."""

_SETTLE_TOLERANCE_S = 2.0
"""Time allowed for the frames after it beyond their usual one."""


@dataclass(slots=True)
class _SkippedFrames:
    """Numbers of frames that came and were not returned, by cause."""

    stale: int = 0
    corrupt: int = 0
    padded: int = 0
    repeated: int = 0
    last_fault: str = ""

    def __str__(self) -> str:
        counts = f"{self.stale} stale, {self.corrupt} corrupt, {self.repeated} repeated"
        return f"{counts}; the last corrupt one: {self.last_fault}" if self.last_fault else counts

    @property
    def cause(self) -> str:
        """The likeliest cause, and what to do."""
        if self.padded > 1 and self.padded == self.corrupt:
            return (
                f"This camera pads its frames: all {self.padded} that could be used end alike. Write another "
                "pixel_format (YUYV, NV12) into the camera's table"
            )
        return "Wait longer, or check cable and bandwidth (dmesg | tail)"


class V4L2Camera:
    """Implements `slrig.devices.Camera`. Opening sets format, size and rate, and switches every automatic
    control off.

    Its buffers reserve the device from opening to `close`; it streams from `arm` to `disarm`.

    Exposure is a multiple of the device's unit (`ExposureScale`), rounded to its step. A device without exposure
    control is assumed to expose for a whole frame period. Gain: see `GainScale`.

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
        self._counter = FrameCounter()
        try:
            self._handle = kernel.open_node(node.path)
        except OSError as error:
            raise kernel.device_error(node.path, "opening", error) from error
        self._resources = ExitStack()
        self._resources.callback(_close_quietly, self._handle)
        try:
            self._waker = Waker()
            self._resources.callback(self._waker.close)
            identity = self._identity()
            self._format = negotiate_format(self._handle, node.path, options)
            self._stream = V4L2Stream(self._handle, node.path, options.buffers, self._waker)
            self._resources.callback(self._stream.release)
            self._frame_ns = self._period_ns = self._format.period_ns
            try:
                self._controls = exclude_controls(list_controls(self._handle), options.skip_controls, node.path)
                width_px = self._format.size.width_px
                self._exposure = exposure_scale(self._controls, self._handle, node.path, width_px=width_px)
            except OSError as error:
                raise kernel.device_error(node.path, "listing its controls", error) from error
            self._scale = GainScale(gain_control(self._controls), options.gain_unity)
            if options.focus is None:
                require_focus(self._handle, node.path, self._controls, options.controls)
            processed = switch_off_processing(
                self._handle, node.path, self._controls, named=options.controls, is_uvc=identity.is_uvc
            )
            self._units: tuple[int | None, int | None] = (None, None)
            refused = self._set_controls()
            self._applied = self._read_back()
        except BaseException:
            self._resources.close()
            raise
        self._info = self._describe(identity, node, (*self._format.notes, *processed, *refused))

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    @property
    def layout(self) -> PixelLayout:
        """Layout of the pixel format in use."""
        return self._format.layout

    @property
    def period_ns(self) -> int:
        """Frame period: as set for the exposure, and once armed, as measured where that is longer."""
        return self._period_ns

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Rounds exposure and gain to what the device takes, and reads every control back. Where the user
        names no frame rate, that is lowered for an exposure that is longer than a frame.
        """
        with self._lock:
            self._state.check_settings(settings, self._info)
            units = None
            if self._exposure is not None:
                units = self._exposure.units(settings.exposure_s)
                wanted_ns = self._format.period_for(settings.exposure_s)
                if wanted_ns != self._frame_ns:
                    self._frame_ns = self._period_ns = set_period(self._handle, self._node, wanted_ns)
            self._units = units, self._scale.units(settings.gain)
            self._set_controls()
            self._applied = self._read_back()
            return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Starts the stream, and returns when the settings have taken effect.

        Raises
        ------
        UnsupportedByDeviceError
            The trigger is not FREE, USB bandwidth is insufficient, or the exposure does not fit into the frame period
            or was changed by the device.
        FrameTimeoutError
            No frames come.
        """
        with self._lock:
            self._state.check_arming(count, trigger, self._info)
            self._counter.begin()
            try:
                self._stream.start()
                self._settle()
            except BaseException:
                self._stream.stop()
                raise
            self._counter.forget_losses()
            self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. A free-running camera has no software trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. The exposure began after `after_ns`, for any meaning of the device's stamps."""
        with self._lock:
            self._state.require_armed()
            until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
            skipped = _SkippedFrames()
            while True:
                buffer = self._stream.take(until_ns)
                if buffer is not None:
                    frame = self._accept(buffer, after_ns, skipped)
                    if frame is not None:
                        return frame
                if time.monotonic_ns() >= until_ns:
                    message = (
                        f"camera '{self._name}': no frame exposed entirely after {after_ns} ns came in "
                        f"{timeout_s:g} s; skipped: {skipped}. Frames come every {self._period_ns / 1e6:.3g} ms, "
                        f"exposed for {self._applied.exposure_s * 1e3:.3g} ms. {skipped.cause}"
                    )
                    raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        with self._lock:
            self._state.armed = None
            self._stream.stop()

    def close(self) -> None:
        """See `Camera`. From another thread, it ends a waiting `read`."""
        if self._state.close():
            self._waker.wake()
            with self._lock:
                self._resources.close()

    def _accept(self, buffer: FilledBuffer, after_ns: int, skipped: _SkippedFrames) -> Frame | None:
        """Return the frame if it is acceptable; else None, and count the cause. Queues the buffer again."""
        is_new = self._counter.is_new(buffer)
        exposure = self._exposure_interval(buffer)
        if not is_new:
            skipped.repeated += 1
        elif not buffer.corrupt and exposure.earliest_ns < after_ns:
            skipped.stale += 1
        else:
            images = self._convert(buffer, skipped)
            if images is not None:
                self._stream.requeue(buffer)
                return self._frame(*images, exposure)
            self._counter.note_corrupt()
        self._stream.requeue(buffer)
        return None

    def _convert(
        self, buffer: FilledBuffer, skipped: _SkippedFrames
    ) -> tuple[Pixels, Callable[[], Pixels] | None] | None:
        if buffer.corrupt:
            skipped.corrupt += 1
            skipped.last_fault = "the driver reports damaged data"
            return None
        negotiated = self._format
        source = self._stream.data(buffer), negotiated.layout, negotiated.size
        grey, colour = (
            partial(convert, *source, stride_bytes=negotiated.stride_bytes, limited_luma=self._options.limited_luma)
            for convert in (grey_image, colour_image)
        )
        try:
            return grey(), colour if negotiated.layout.has_colour else None
        except CorruptFrameError as fault:
            skipped.corrupt += 1
            skipped.padded += isinstance(fault, PaddedFrameError)
            skipped.last_fault = str(fault)
            return None

    def _frame(self, image: Pixels, colour: Callable[[], Pixels] | None, exposure: ExposureInterval) -> Frame:
        start_ns, end_ns, error_ns = exposure.centred_exposure(round(self._applied.exposure_s * 1e9))
        return Frame(
            camera=self._name,
            image=image,
            t_start_ns=start_ns,
            t_end_ns=end_ns,
            t_err_ns=error_ns,
            sequence_number=self._counter.number,
            dropped_count=self._counter.lost,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
            colour=colour,
        )

    def _exposure_interval(self, buffer: FilledBuffer) -> ExposureInterval:
        exposure_ns = round(self._applied.exposure_s * 1e9)
        if self._exposure is None:
            exposure_ns = max(exposure_ns, self._period_ns)
        readout_s = self._options.readout_s
        readout_ns = self._period_ns if readout_s is None else round(readout_s * 1e9)
        # A device that stamps some frames after their arrival stamps the others as late.
        delay_ns = max(round(self._options.stamp_delay_s * 1e9), self._counter.ahead_ns)
        return exposure_interval(buffer.stamp, SensorDurations(exposure_ns, readout_ns, delay_ns))

    def _settle(self) -> None:
        """Skip the first frames, which may be exposed with earlier settings, and measure the frame period."""
        settling = self._options.settle_frames
        slowest_ns = max(self._frame_ns, round(self._applied.exposure_s * 1e9))
        until_ns = time.monotonic_ns() + 4 * slowest_ns + round(_START_TOLERANCE_S * 1e9)
        skipped = _SkippedFrames()
        came = 0
        while came < settling + 1:
            buffer = self._stream.take(until_ns)
            if buffer is None:
                message = (
                    f"camera '{self._name}': its stream started, and {came} of the first {settling + 1} frames came "
                    f"in time; skipped: {skipped}. Check cable and bandwidth (dmesg | tail)"
                )
                raise FrameTimeoutError(message)
            if not self._counter.is_new(buffer):
                skipped.repeated += 1
            elif (came := came + 1) == 1:
                # Some cameras forget exposure, gain and focus when the stream starts, and the driver answers for them
                # from its memory. Some drivers lock controls meanwhile.
                with suppress(UnsupportedByDeviceError):
                    self._set_controls()
                until_ns = time.monotonic_ns() + 4 * settling * slowest_ns + round(_SETTLE_TOLERANCE_S * 1e9)
            self._stream.requeue(buffer)
        self._period_ns = max(self._frame_ns, self._counter.period_ns() or 0)
        self._require_unchanged()

    def _require_unchanged(self) -> None:
        """Raise if the device changed its settings, or the exposure does not fit into the frame period."""
        now = self._read_back()
        if (now.exposure_s, now.gain) != (self._applied.exposure_s, self._applied.gain):
            message = (
                f"camera '{self._name}': set to exposure {self._applied.exposure_s:.6g} s and gain "
                f"{self._applied.gain:.6g}, and once the stream ran, it used {now.exposure_s:.6g} s and {now.gain:.6g}:"
                " another program or the camera changes it; close other programs, or use another camera"
            )
            raise UnsupportedByDeviceError(message)
        period_s = self._period_ns / 1e9
        if self._applied.exposure_s > period_s * (1 + PERIOD_TOLERANCE) and self._exposure is not None:
            message = (
                f"camera '{self._name}': requested an exposure of {self._applied.exposure_s:.6g} s, and its frames "
                f"come every {period_s:.6g} s, which is shorter; request a shorter exposure_s, or a "
                f"frame_rate_hz of {1 / self._applied.exposure_s:.4g} or less"
            )
            raise UnsupportedByDeviceError(message)

    def _set_controls(self) -> list[str]:
        """Set every control; return notes on optional ones that the device refuses."""
        exposure, gain = self._units
        notes = []
        for step in ordered_settings(
            self._controls, self._options, exposure_units=exposure, gain_units=gain, node=self._node
        ):
            is_exposure = self._exposure is not None and step.control is self._exposure.control
            try:
                (set_exposure if is_exposure else set_control)(self._handle, self._node, step.control, step.value)
            except UnsupportedByDeviceError as refusal:
                if step.needed:
                    raise
                notes.append(f"an automatic of its own stays as it is: {refusal}")
        return notes

    def _read_back(self) -> AppliedSettings:
        exposure_s = self._frame_ns / 1e9
        if self._exposure is not None:
            exposure_s = get_control(self._handle, self._node, self._exposure.control) * self._exposure.unit_s
        gain = 1.0
        if self._scale.control is not None:
            gain = self._scale.gain(get_control(self._handle, self._node, self._scale.control))
        return AppliedSettings(exposure_s, gain, max(self._period_ns / 1e9, exposure_s))

    def _identity(self) -> NodeIdentity:
        try:
            identity = query_identity(self._handle)
        except OSError as error:
            if error.errno in kernel.GONE:
                raise kernel.device_error(self._node, "reading its identity", error) from error
            message = f"{self._node} is not a video device ({error.strerror}); slrig devices lists video devices"
            raise UnsupportedByDeviceError(message) from error
        if not identity.captures:
            cause = "it has frames in several planes only" if identity.several_planes else "it has no frames"
            message = (
                f"{self._node} ({identity.card}) cannot be used: {cause}; a camera has several nodes: slrig devices "
                "lists the one to use"
            )
            raise UnsupportedByDeviceError(message)
        return identity

    def _describe(self, identity: NodeIdentity, node: CameraNode, notes: tuple[str, ...]) -> CameraInfo:
        period_s = self._format.period_ns / 1e9
        exposures = (period_s, period_s)
        if self._exposure is not None:
            # Longer ones do not fit into a frame, even if the control accepts them.
            shortest_s, longest_s = self._exposure.range_s
            exposures = (
                shortest_s,
                max(min(longest_s, max(self._format.slower_ns, default=0) / 1e9 or period_s), shortest_s),
            )
        return CameraInfo(
            name=self._name,
            model=identity.card,
            serial=node.serial or identity.bus,
            format=CameraFormat(self._format.size, self._format.layout.bit_depth),
            triggers=frozenset({Trigger.FREE}),
            exposure_range_s=exposures,
            gain_range=self._scale.range,
            notes=notes,
            colour=self._format.layout.has_colour,
        )


def _close_quietly(handle: int) -> None:
    with suppress(OSError):
        os.close(handle)
