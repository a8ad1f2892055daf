"""A GenICam camera: settings that are read back, and frames whose exposure began after a given instant.

`drivers.genicam.timing` bounds the start of each exposure. `Frame.t_start_ns` is the middle of that interval and
`t_err_ns` half of it; `read` returns a frame only if the whole interval is after `after_ns`:

- software trigger: the exposure began after the call of `trigger`, so a pattern shown before is complete;
- free-running: by the camera's clock, related to the host's by latching it; a camera without a latch is assumed to send
  a frame within the option `transfer_s` after its exposure;
- hardware trigger: the same, and a frame that follows a delivered one began after that one's reported end.

With a rolling shutter these are the times of the first row.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from drivers.genicam.aravis import AravisConnection
from drivers.genicam.connection import (
    GenICamCameraOptions,
    GenICamConnection,
    GenicamOptions,
    GenICamStream,
    GentlOptions,
    RawFrame,
    differs,
)
from drivers.genicam.gentl import GentlConnection
from drivers.genicam.link import link_notes
from drivers.genicam.pixels import FORMATS, PfncFormat, decode_pixels
from drivers.genicam.setup import set_trigger, set_up_camera
from drivers.genicam.timing import Arrival, FrameNumbers, Interval, StartClock, TriggeredStarts, UntriggeredStarts
from slrig.bundle import validate
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame, Pixels, Size

_SLICE_S = 0.05
_LATCHES = 5
_TIE_AGAIN_NS = 5_000_000_000
_RESEND_AFTER_NS = 400_000_000
_DRAIN_MARGIN_S = 0.2
_MAX_BUFFER_BYTES = 1 << 30
_MIN_BUFFERS = 8
_FRAME_RATE_FEATURES = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
"""Features that give the fastest rate that exposure, read-out and link allow: SFNC has no name for it, makers have
their own."""


@dataclass(frozen=True, slots=True)
class _TimedFrame:
    """A complete frame, also in colour if available, and the bounds of the start of its exposure."""

    image: Pixels
    colour: Callable[[], Pixels] | None
    number: int
    start: Interval


class Acquisition:
    """Acquisition of an armed camera: its stream, and its frames in order. Used by one thread. form, size : current
    settings.
    """

    def __init__(
        self, connection: GenICamConnection, options: GenICamCameraOptions, form: PfncFormat, size: Size
    ) -> None:
        self._connection = connection
        self._options = options
        self._form = form
        self._size = size
        self._stream: GenICamStream | None = None
        self._numbers = FrameNumbers()
        self._good = 0
        self._last_end_ns = 0
        self._waiting: deque[_TimedFrame] = deque()
        self._skipped = dict.fromkeys(("stale", "corrupt", "repeated", "untriggered"), 0)
        self.trigger = Trigger.FREE
        self._applied = AppliedSettings(0.0, 0.0)
        self._exposure_ns = 0

    def begin(self, trigger: Trigger, applied: AppliedSettings, buffers: int) -> None:
        """Open the stream with `buffers` buffers, relate the camera's clock to the host's, and start."""
        self.trigger = trigger
        self._applied = applied
        self._exposure_ns = round(applied.exposure_s * 1e9)
        self._clock = StartClock(self._lag_ns())
        self._reset_counting()
        self._stamped = self._options.time_stamp != "none" and self._connection.has_stamps
        self._tied_ns = 0
        self._tie_clock(_LATCHES)
        self._stream = self._connection.start(buffers)

    def end(self) -> None:
        """Stop, in any state of the camera."""
        if self._stream is not None:
            stream, self._stream = self._stream, None
            stream.end()

    def note_trigger(self, begun_ns: int, ended_ns: int, *, times: int) -> None:
        """Note a software trigger, and how many times it may have been sent."""
        self._triggered.note_trigger(begun_ns, ended_ns, times=times)

    def is_answer_due(self) -> bool:
        """True if the answer to a software trigger may still arrive."""
        return self._triggered.answer_due_ns(time.monotonic_ns()) > 0

    def settle(self) -> None:
        """Wait until no answer to a software trigger is due: a camera ignores a trigger during an exposure."""
        while (left_ns := self._triggered.answer_due_ns(time.monotonic_ns())) > 0 and not self._connection.is_lost:
            self._take_frame(left_ns / 1e9)

    def drain(self, seconds: float) -> None:
        """Discard frames that arrive without a trigger, for this time."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not self._connection.is_lost:
            self._take_frame(left_s)
        self._reset_counting()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `slrig.devices.Camera`."""
        if self.trigger is not Trigger.SOFTWARE and time.monotonic_ns() - self._tied_ns > _TIE_AGAIN_NS:
            self._tie_clock(2)
        deadline_s = time.monotonic() + timeout_s
        self._skipped = dict.fromkeys(self._skipped, 0)
        while True:
            while self._waiting:
                frame = self._waiting.popleft()
                # Wire-triggered frames are identified by their order.
                follows = self.trigger is Trigger.HARDWARE and after_ns <= self._last_end_ns
                if frame.start.min_ns >= after_ns or follows:
                    return self._frame(frame)
                self._skipped["stale"] += 1
            left_s = deadline_s - time.monotonic()
            if self._take_frame(left_s):
                continue
            if self._connection.is_lost:
                raise self._connection.gone_error("waiting for a frame")
            if left_s <= 0:
                raise self._timeout_error(after_ns, timeout_s)

    def _reset_counting(self) -> None:
        """Restart counting: the next frame is number 0, and no trigger is pending."""
        answer_ns, transfer_ns = round(self._options.answer_s * 1e9), round(self._options.transfer_s * 1e9)
        self._triggered = TriggeredStarts(self._exposure_ns, answer_ns, self._clock)
        self._untriggered = UntriggeredStarts(self._exposure_ns, transfer_ns, self._clock)
        self._numbers = FrameNumbers()
        self._good = 0
        self._waiting.clear()

    def _take_frame(self, max_s: float) -> bool:
        """Take and process one frame from the stream, waiting at most a slice; return False if none arrived."""
        delivery = None if self._stream is None else self._stream.take(min(max_s, _SLICE_S))
        if delivery is not None:
            self._process(delivery)
        return delivery is not None

    def _process(self, delivery: RawFrame) -> None:
        number = self._numbers.next(delivery.block_id)
        images = self._decode(delivery)
        if images is None:
            self._skipped["corrupt"] += 1
            return
        if number is None:
            self._skipped["repeated"] += 1
            return
        self._good += 1
        stamp_ns = delivery.stamp_ns if self._stamped else 0
        arrival = Arrival(number, stamp_ns or None, delivery.arrived_ns)
        start = self._triggered.start(arrival) if self.trigger is Trigger.SOFTWARE else self._untriggered.start(arrival)
        if start is None:
            self._skipped["untriggered"] += 1
            return
        self._waiting.append(_TimedFrame(*images, number, start))

    def _frame(self, frame: _TimedFrame) -> Frame:
        start = frame.start
        t_start_ns = (start.min_ns + start.max_ns) // 2
        # Exposures of a camera do not overlap.
        t_start_ns = min(max(t_start_ns, self._last_end_ns), start.max_ns)
        self._last_end_ns = t_start_ns + self._exposure_ns
        return Frame(
            camera=self._connection.name,
            image=frame.image,
            t_start_ns=t_start_ns,
            t_end_ns=self._last_end_ns,
            t_err_ns=max(start.max_ns - t_start_ns, t_start_ns - start.min_ns),
            sequence_number=frame.number,
            dropped_count=self._numbers.frame_count - self._good,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
            colour=frame.colour,
        )

    def _decode(self, delivery: RawFrame) -> tuple[Pixels, Callable[[], Pixels] | None] | None:
        """Return the image and a function that makes it in colour; None if packets are missing or the size is wrong."""
        image = delivery.image
        if image is None or image.size != self._size:
            return None
        decode = partial(decode_pixels, image.data, self._form, self._size, padding_bytes=image.padding_bytes)
        try:
            return decode(), partial(decode, in_colour=True) if self._form.mosaic else None
        except ValueError:
            return None

    def _timeout_error(self, after_ns: int, timeout_s: float) -> FrameTimeoutError:
        # If the camera is gone, this raises DeviceGoneError instead.
        with self._connection.access("checking the connection") as camera:
            camera.get_exposure_time()
        skipped = ", ".join(f"{count} {kind}" for kind, count in self._skipped.items() if count) or "none"
        remedy = {
            Trigger.FREE: "check the frame rate and the network's load",
            Trigger.SOFTWARE: "trigger after the pattern is shown, and wait for the exposure",
            Trigger.HARDWARE: "check the trigger's cable, level and edge",
        }[self.trigger]
        message = (
            f"camera '{self._connection.name}': no frame that began after {after_ns} ns arrived in {timeout_s} s "
            f"({self.trigger} trigger; skipped: {skipped}); {'; '.join([remedy, *link_notes(self._connection)])}"
        )
        return FrameTimeoutError(message)

    def _lag_ns(self) -> Interval:
        """Bounds of the delay of a time stamp after the start of its exposure."""
        min_ns = self._exposure_ns if self._options.time_stamp == "exposure_end" else 0
        return Interval(min_ns, 0 if self._options.time_stamp == "exposure_start" else self._exposure_ns)

    def _tie_clock(self, count: int) -> None:
        """Latch the camera's clock, if it supports that."""
        self._tied_ns = time.monotonic_ns()
        if not self._stamped:
            return
        latches = [latch for latch in (self._connection.latch() for _ in range(count)) if latch is not None]
        if len(latches) == count:
            self._clock.latch(latches)


class GenicamCamera:
    """Implements `slrig.devices.Camera`. connection : the open device; this camera closes it.

    Raises UnsupportedByDeviceError if the device does not accept an option, or changes it.
    """

    def __init__(self, connection: GenICamConnection, options: GenICamCameraOptions) -> None:
        self._name = connection.name
        self._options = options
        self._connection = connection
        self._state = self._connection.state
        self._session: Acquisition
        self._answer_pending = False
        try:
            self._setup = set_up_camera(self._connection, options)
            self._info = self._read_info()
            self._rate_feature = next(
                (each for each in _FRAME_RATE_FEATURES if self._connection.features.has(each)), None
            )
            self._applied = self._read_settings()
        except BaseException:
            self._connection.close()
            raise

    @property
    def info(self) -> CameraInfo:
        """See `Camera`. `gain` is in the camera's own unit, usually dB."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Refuses a value that the camera rounds by more than 1 %; the message has the rounded value."""
        self._require_connected()
        self._state.check_settings(settings, self._info)
        with self._connection.access("setting exposure and gain") as camera:
            camera.set_exposure_time(settings.exposure_s * 1e6)
            if camera.is_gain_available():
                camera.set_gain(settings.gain)
        self._applied = self._read_settings()
        for what, requested, got in (
            ("exposure_s", settings.exposure_s, self._applied.exposure_s),
            ("gain", settings.gain, self._applied.gain),
        ):
            if differs(got, requested):
                message = (
                    f"camera '{self._name}': requested {what} {requested:g}, it gives {got:g}; request that, or a "
                    "value that its other settings allow (frame rate, pixel format)"
                )
                raise UnsupportedByDeviceError(message)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Opens a new stream, so no frame of an earlier arming can arrive."""
        self._require_connected()
        self._state.check_arming(count, trigger, self._info)
        source = {Trigger.FREE: None, Trigger.SOFTWARE: "Software", Trigger.HARDWARE: self._setup.line}[trigger]
        set_trigger(self._connection, source, self._options)
        self._applied = self._read_settings()
        session = Acquisition(self._connection, self._options, FORMATS[self._options.pixel_format], self._setup.size)
        session.begin(trigger, self._applied, _MIN_BUFFERS if trigger is Trigger.FREE else self._buffers(count))
        self._session = session
        self._state.armed = trigger
        if self._answer_pending and trigger is not Trigger.FREE:
            # A camera may have stored a trigger while it was stopped, and expose now.
            session.drain(self._applied.exposure_s + _DRAIN_MARGIN_S)
            self._answer_pending = False

    def trigger(self) -> None:
        """See `Camera`. Waits first for the frame of an earlier trigger, if it is due."""
        self._require_connected()
        self._state.require_armed(Trigger.SOFTWARE)
        self._session.settle()
        with self._connection.access("triggering") as camera:
            begun_ns = time.monotonic_ns()
            camera.software_trigger()
            ended_ns = time.monotonic_ns()
        # Aravis repeats a command whose answer was lost: the camera may have exposed twice.
        self._session.note_trigger(begun_ns, ended_ns, times=2 if ended_ns - begun_ns > _RESEND_AFTER_NS else 1)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera` and the docstring of this module. Exposure and gain are those read back when it was armed."""
        self._require_connected()
        self._state.require_armed()
        return self._session.read(after_ns, timeout_s)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._state.armed is not None:
            # A free-running camera may send the frame of its current exposure after it was stopped.
            self._answer_pending = (
                self._answer_pending or self._state.armed is Trigger.FREE or self._session.is_answer_due()
            )
            self._state.armed = None
            self._session.end()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._connection.close()

    def _read_info(self) -> CameraInfo:
        with self._connection.access("reading its identity") as camera:
            model = f"{camera.get_vendor_name()} {camera.get_model_name()}"
            serial = str(camera.get_device_serial_number() or camera.get_device_id())
            least_us, most_us = camera.get_exposure_time_bounds()
            gains = camera.get_gain_bounds() if camera.is_gain_available() else (1.0, 1.0)
            software = bool(camera.is_software_trigger_supported())
        triggers = {Trigger.FREE}
        if software:
            triggers.add(Trigger.SOFTWARE)
        if self._setup.line is not None:
            triggers.add(Trigger.HARDWARE)
        return CameraInfo(
            name=self._name,
            model=model,
            serial=serial,
            format=CameraFormat(self._setup.size, FORMATS[self._options.pixel_format].bit_depth),
            triggers=frozenset(triggers),
            exposure_range_s=(max(least_us, 1.0) / 1e6, most_us / 1e6),
            gain_range=(float(gains[0]), float(gains[1])),
            colour=bool(FORMATS[self._options.pixel_format].mosaic),
            notes=self._setup.notes,
        )

    def _read_settings(self) -> AppliedSettings:
        with self._connection.access("reading exposure and gain") as camera:
            gain = float(camera.get_gain()) if camera.is_gain_available() else 1.0
            exposure_s = camera.get_exposure_time() / 1e6
        rate_hz = self._connection.features.number(self._rate_feature) if self._rate_feature is not None else 0.0
        return AppliedSettings(exposure_s, gain, 1 / rate_hz if rate_hz > 0 else None)

    def _buffers(self, count: int) -> int:
        """Return the number of buffers: as many as requested frames, so that none is lost, limited by memory."""
        with self._connection.access("reading the size of a frame") as camera:
            payload = int(camera.get_payload())
        return max(_MIN_BUFFERS, min(count + 2, _MAX_BUFFER_BYTES // max(payload, 1)))

    def _require_connected(self) -> None:
        self._state.require_open()
        if self._connection.is_lost:
            raise self._connection.gone_error("noticed earlier")


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a GenICam camera from a rig file's `[[camera]]` table.

    Parameters
    ----------
    name
        Name in the rig file.
    options
        `GenicamOptions`.
    folder
        Not used: a GenICam camera has no files.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        Aravis or PyGObject is not installed.
    DeviceGoneError
        No such camera answers.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        The camera does not accept an option, or changes it.
    """
    del folder
    table = validate(GenicamOptions, options, f"the [[camera]] table of '{name}' (driver genicam)")
    return GenicamCamera(AravisConnection(name, table), table)


def open_gentl_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a camera behind a GenTL producer from a rig file's `[[camera]]` table.

    `options` are `GentlOptions`; the path of a producer is relative to `folder`. Raises the errors of `open_camera`;
    LibraryMissingError also if no producer is found.
    """
    table = validate(GentlOptions, options, f"the [[camera]] table of '{name}' (driver gentl)")
    return GenicamCamera(GentlConnection(name, table, folder), table)
