"""A camera through OpenCV that never returns a stale frame; the package's docstring explains its timing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.opencv.controls import CaptureControls, negotiate, read_fourcc, read_size, switch_off_automatics
from drivers.opencv.feeds import ArrivalTiming, DeviceFeed, FeedReader, FilmFeed, GrabbedFrame, LiveFeed, open_capture
from drivers.opencv.options import CaptureSource, SourceKind
from drivers.v4l2.formats import LAYOUTS, CorruptFrameError, colour_image, grey_image
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import DeviceError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame, Pixels, Size

_Feed = DeviceFeed | LiveFeed | FilmFeed
_TOLERANCE = 0.01
_START_TOLERANCE_S = 2.0
_MAX_SILENCE_S = 5.0
_FIRST_FRAMES = 10
_USUAL_PERIOD_S = 1 / 30


@dataclass(frozen=True, slots=True)
class FrameDecoder:
    """Reads frames from OpenCV. code : pixel format of raw data; None for decoded pictures."""

    code: str | None
    format: CameraFormat
    has_colour: bool = False

    def grey(self, data: NDArray[Any]) -> Pixels:
        """Return the grey image, (H, W), uint8 up to 8 bit and uint16 beyond.

        Raises
        ------
        CorruptFrameError
            Parts are missing, the size differs, or values exceed the format.
        """
        image = self._grey_of_decoded(data) if self.code is None else self._read(data, self.code)
        if image.shape != self.format.size.shape:
            message = f"it is {image.shape[1]} x {image.shape[0]}, the camera's frames are {self.format.size}"
            raise CorruptFrameError(message)
        wanted = np.uint8 if self.format.bit_depth <= 8 else np.uint16
        brightest = int(image.max(initial=0))
        if image.dtype != wanted or brightest > self.format.full_scale:
            message = f"it is {image.dtype} up to {brightest}, {self.format.bit_depth} bits end at " + str(
                self.format.full_scale
            )
            raise CorruptFrameError(message)
        return image

    def _grey_of_decoded(self, data: NDArray[Any]) -> Pixels:
        if data.ndim == 3 and data.shape[2] == 3:
            return np.asarray(cv2.cvtColor(data, cv2.COLOR_BGR2GRAY))
        return np.ascontiguousarray(data[..., 0] if data.ndim == 3 else data)

    def colour(self, data: NDArray[Any]) -> Pixels:
        """Return (H, W, 3), blue, green and red, of data that `grey` accepts and that has colour."""
        return data if self.code is None else self._read(data, self.code, colour_image)

    def _read(self, data: NDArray[Any], code: str, convert: Callable[..., Pixels] = grey_image) -> Pixels:
        layout, size = LAYOUTS[code], self.format.size
        plain = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        return convert(plain, layout, size, stride_bytes=len(plain) // size.height_px)


def raw_decoder(code: str | None, size: Size, bit_depth: int | None) -> FrameDecoder:
    """Return a decoder for a pixel format; for None, of decoded pictures with 8 bits.

    bit_depth : number of bits used in a 16-bit sample; None for all.
    """
    depth = 8 if code is None else LAYOUTS[code].bit_depth
    form = CameraFormat(size, bit_depth if depth == 16 and bit_depth is not None else depth)
    return FrameDecoder(code, form, code is None or LAYOUTS[code].has_colour)


def image_decoder(data: NDArray[Any], bit_depth: int | None) -> FrameDecoder:
    """Return a decoder for a source, from the first picture that OpenCV has decoded.

    Raises
    ------
    CorruptFrameError
        Its samples are neither of 8 nor of 16 bits.
    """
    if data.dtype not in (np.uint8, np.uint16):
        message = f"its samples are {data.dtype}, expected uint8 or uint16"
        raise CorruptFrameError(message)
    rows, columns = data.shape[:2]
    depth = 8 if data.dtype == np.uint8 else bit_depth or 16
    return FrameDecoder(None, CameraFormat(Size(columns, rows), depth), data.shape[2:] == (3,))


_Open = tuple[_Feed, FrameDecoder, CaptureControls | None]


@dataclass(slots=True)
class _RejectedFrames:
    """Numbers of frames that came and were not returned, by cause."""

    stale: int = 0
    untimed: int = 0
    corrupt: int = 0
    last_fault: str = ""

    def __str__(self) -> str:
        counts = f"{self.stale} stale, {self.corrupt} damaged"
        if self.untimed:
            counts += f", {self.untimed} with an unknown time in a queue"
        return f"{counts} (the last: {self.last_fault})" if self.last_fault else counts


class OpenCvCamera:
    """Implements `slrig.devices.Camera` on a `cv2.VideoCapture`.

    A live source is read from opening to `close`, a camera and a film from `arm` to `disarm`. Exposure and gain can be
    set where the kernel's interface is used (Linux); other sources have those of the rig file.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        See `drivers.opencv.open_camera`.
    """

    def __init__(self, name: str, source: CaptureSource) -> None:
        self._name = name
        self._source = source
        self._state = CameraState(name)
        self._armed_ns = 0
        self._lost_before = 0
        self._corrupt = 0
        self._exposure_s = source.options.source_exposure_s or 0.0
        self._notes: tuple[str, ...] = ()
        opening = {
            SourceKind.DEVICE: self._open_device,
            SourceKind.LIVE: self._open_live,
            SourceKind.FILM: self._open_film,
        }
        self._feed, self._decoder, self._controls = opening[source.kind]()
        self._reader = FeedReader(self._feed, f"slrig-opencv-{name}")
        exposures_s, gains = (self._exposure_s, self._exposure_s), (1.0, 1.0)
        self._applied = AppliedSettings(self._exposure_s, 1.0)
        if self._controls is not None:
            exposures_s, gains = self._controls.exposure_range_s, self._controls.gain_range
            self._applied = self._controls.read_back()
        self._info = CameraInfo(
            name=name,
            model=f"OpenCV {cv2.__version__}, {cv2.videoio_registry.getBackendName(source.backend)}",
            serial=source.label,
            format=self._decoder.format,
            triggers=frozenset({Trigger.FREE}),
            exposure_range_s=exposures_s,
            gain_range=gains,
            notes=self._notes,
            colour=self._decoder.has_colour,
        )
        if source.kind is SourceKind.LIVE:
            self._reader.start()

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. A source that OpenCV cannot control accepts the values of its table, within 1 %."""
        hint = "OpenCV has no control over such a source" if self._controls is None else "choose such a value"
        self._state.check_settings(settings, self._info, within=_TOLERANCE, hint=hint)
        if self._controls is not None:
            self._require_idle()
            self._applied = self._controls.apply(settings)
        return replace(self._applied, min_period_s=self._least_period_s())

    def _least_period_s(self) -> float | None:
        """Return the shortest frame period: from OpenCV for a camera, from options for a live source, else None."""
        if isinstance(self._feed, DeviceFeed):
            rate_hz = self._feed.capture.get(cv2.CAP_PROP_FPS)
            return max(1 / rate_hz, self._applied.exposure_s) if rate_hz > 0 else None
        rate_hz = self._source.options.frame_rate_hz or 0.0
        return 1 / rate_hz if isinstance(self._feed, LiveFeed) and rate_hz > 0 else None

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Returns when a camera's settings have taken effect.

        Raises
        ------
        UnsupportedByDeviceError
            The trigger is not FREE, or time stamps are of another clock.
        DeviceGoneError, FrameTimeoutError
            No frames come.
        """
        self._state.check_arming(count, trigger, self._info)
        self._armed_ns = time.monotonic_ns()
        self._lost_before = self._corrupt = 0
        if self._source.kind is SourceKind.LIVE:
            self._reader.discard()
            self._require_alive()
        else:
            self._require_idle()
            self._start()
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. A free-running camera has no software trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. The exposure began after `after_ns` at the earliest, and after `arm`."""
        self._state.require_armed()
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        after_ns = max(after_ns, self._armed_ns)
        rejected = _RejectedFrames()
        while True:
            grabbed = self._reader.next(until_ns)
            self._state.require_armed()
            if grabbed is None:
                raise FrameTimeoutError(self._timeout_message(after_ns, timeout_s, rejected))
            frame = self._accept(grabbed, after_ns, rejected)
            if frame is not None:
                return frame

    def disarm(self) -> None:
        """See `Camera`."""
        self._state.armed = None
        if self._source.kind is not SourceKind.LIVE and not self._state.closed.is_set():
            self._stop()

    def close(self) -> None:
        """See `Camera`. From another thread, it ends a waiting `read`."""
        if self._state.close():
            self._reader.close()

    def _accept(self, grabbed: GrabbedFrame, after_ns: int, rejected: _RejectedFrames) -> Frame | None:
        """Return the frame if it is acceptable; else None, and count the cause."""
        exposure = grabbed.exposure
        if exposure is None:
            rejected.untimed += 1
            return None
        if exposure.earliest_ns < after_ns:
            rejected.stale += 1
            return None
        try:
            image = self._decoder.grey(grabbed.data)
        except CorruptFrameError as fault:
            rejected.corrupt += 1
            rejected.last_fault = str(fault)
            self._corrupt += 1
            return None
        start_ns, end_ns, error_ns = exposure.centred_exposure(round(self._applied.exposure_s * 1e9))
        return Frame(
            camera=self._name,
            image=image,
            t_start_ns=start_ns,
            t_end_ns=end_ns,
            t_err_ns=error_ns,
            sequence_number=grabbed.number,
            dropped_count=grabbed.lost - self._lost_before + self._corrupt,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
            colour=partial(self._decoder.colour, grabbed.data) if self._decoder.has_colour else None,
        )

    def _timeout_message(self, after_ns: int, timeout_s: float, rejected: _RejectedFrames) -> str:
        advice = "wait longer, or check its cable or network"
        arrivals = None if isinstance(self._feed, FilmFeed) else self._feed.arrivals
        if arrivals is not None:
            rate_hz = self._source.options.frame_rate_hz
            advice = (
                f"a frame counts once the reader has waited for it, half a period of frame_rate_hz = {rate_hz:g} at "
                f"least ({arrivals.queued} came since it last did): if the source sends more frames than that, raise "
                "frame_rate_hz; if this machine is too slow for them, make the source send fewer or smaller ones"
            )
        return (
            f"camera '{self._name}': no frame exposed entirely after {after_ns} ns came in {timeout_s:g} s; "
            f"skipped: {rejected}; {advice}"
        )

    def _start(self) -> None:
        """Start a camera or a film; skip a camera's first frames, which may have earlier settings."""
        feed = self._feed
        if isinstance(feed, DeviceFeed):
            feed.exposure_ns = round(self._applied.exposure_s * 1e9)
        elif isinstance(feed, FilmFeed):
            feed.rewind()
        self._reader.start()
        if not isinstance(feed, DeviceFeed):
            return
        try:
            self._settle(feed)
        except BaseException:
            self._stop()
            raise

    def _stop(self) -> None:
        if self._reader.stop() and isinstance(self._feed, DeviceFeed):
            self._feed.end_stream()

    def _settle(self, feed: DeviceFeed) -> None:
        settling, came = self._source.options.settle_frames, 0
        slowest_ns = max(feed.period_ns, feed.exposure_ns)
        until_ns = self._armed_ns + 4 * settling * slowest_ns + round(_START_TOLERANCE_S * 1e9)
        while came <= settling:
            grabbed = self._reader.next(until_ns)
            if grabbed is None:
                message = (
                    f"camera '{self._name}': {came} of the first {settling + 1} frames came in time; check its cable "
                    "and bandwidth (dmesg | tail)"
                )
                raise FrameTimeoutError(message)
            if grabbed.exposure is not None and grabbed.exposure.earliest_ns >= self._armed_ns:
                came += 1
                self._lost_before = grabbed.lost
        # A camera may be slower than OpenCV reports.
        if feed.arrivals is None:
            feed.period_ns = max(feed.period_ns, round(float(np.median(np.diff(feed.stamps_ns)))))
        now = None if self._controls is None else self._controls.read_back()
        if now is not None and now != self._applied:
            message = (
                f"camera '{self._name}': set to exposure {self._applied.exposure_s:.6g} s and gain "
                f"{self._applied.gain:.6g}, and once it streamed, it used {now.exposure_s:.6g} s and {now.gain:.6g}: "
                "another program or the camera changes it; close other programs, or use another camera"
            )
            raise UnsupportedByDeviceError(message)

    def _open_device(self) -> _Open:
        source = self._source
        capture = open_capture(source)
        try:
            negotiate(capture, source.options, source.label)
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
            code: str | None = read_fourcc(capture)
            if code not in LAYOUTS:
                code = None
                capture.set(cv2.CAP_PROP_CONVERT_RGB, 1)
            rate_hz = capture.get(cv2.CAP_PROP_FPS)
            period_ns = round(1e9 / rate_hz if rate_hz > 0 else _USUAL_PERIOD_S * 1e9)
            arrivals = None if source.options.delay_s is None else self._arrivals()
            feed = DeviceFeed(capture, source.label, period_ns, arrivals)
            self._exposure_s = self._exposure_s or period_ns / 1e9
            skipped, self._notes = switch_off_automatics(source.label, source.options)
            fixed_s = self._exposure_s
            controls = CaptureControls(capture, source.options, source.label, fixed_s=fixed_s, skipped=skipped)
            decoder = raw_decoder(code, read_size(capture), source.options.bit_depth)
        except BaseException:
            capture.release()
            raise
        return feed, decoder, controls

    def _open_live(self) -> _Open:
        source, options = self._source, self._source.options
        streamed = source.backend == cv2.CAP_FFMPEG
        silence_s = _MAX_SILENCE_S + self._exposure_s + (options.delay_s or 0)
        parameters = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: round(_MAX_SILENCE_S * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: round(silence_s * 1e3),
            # Several threads would decode several frames at once, and return each of them later.
            cv2.CAP_PROP_N_THREADS: 1,
        }
        capture = open_capture(source, [each for pair in parameters.items() for each in pair] if streamed else ())
        try:
            code = None
            if streamed and read_fourcc(capture) == "MJPG" and capture.set(cv2.CAP_PROP_FORMAT, -1):
                code = "MJPG"
            elif not streamed:
                negotiate(capture, options, source.label)
            feed = LiveFeed(capture, source.label, self._arrivals())
            decoder = self._first_decoder(feed, code)
        except BaseException:
            capture.release()
            raise
        return feed, decoder, None

    def _open_film(self) -> _Open:
        source = self._source
        feed = LiveFeed(open_capture(source), source.label, ArrivalTiming(exposure_ns=0, delay_ns=0, period_ns=0))
        try:
            decoder = self._first_decoder(feed, None)
        finally:
            feed.release()
        return FilmFeed(lambda: open_capture(source), source), decoder, None

    def _arrivals(self) -> ArrivalTiming:
        options = self._source.options
        return ArrivalTiming(
            exposure_ns=round(self._exposure_s * 1e9),
            delay_ns=round((options.delay_s or 0) * 1e9),
            period_ns=round(1e9 / (options.frame_rate_hz or 1 / _USUAL_PERIOD_S)),
        )

    def _first_decoder(self, feed: LiveFeed, code: str | None) -> FrameDecoder:
        """Return a decoder for the first frame that is whole."""
        fault: CorruptFrameError | None = None
        for _ in range(_FIRST_FRAMES):
            data, _times = feed.grab()
            try:
                bit_depth = self._source.options.bit_depth
                if code is None:
                    decoder = image_decoder(data, bit_depth)
                else:
                    decoder = raw_decoder(code, read_size(feed.capture), bit_depth)
                decoder.grey(data)
            except CorruptFrameError as error:
                fault = error
                continue
            wanted = self._source.options.size
            if wanted is not None and decoder.format.size != wanted:
                message = f"{feed.label}: requested {wanted}, the source gives {decoder.format.size}; leave size_px out"
                raise UnsupportedByDeviceError(message)
            return decoder
        message = f"{feed.label}: none of the first {_FIRST_FRAMES} frames was whole: {fault}; check what it sends"
        raise DeviceError(message)

    def _require_idle(self) -> None:
        if not self._reader.stop():
            message = f"camera '{self._name}': OpenCV has not returned from waiting for a frame; open it again"
            raise DeviceGoneError(message)

    def _require_alive(self) -> None:
        fault = self._reader.fault
        if fault is not None:
            raise fault
