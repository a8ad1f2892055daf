"""A camera's stream: negotiation of format, size and frame rate, buffers shared with the kernel, count of frames."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import select
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from fractions import Fraction
from functools import partial
from itertools import count
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.v4l2 import kernel
from drivers.v4l2.formats import LAYOUTS, PREFERRED, PixelLayout, SamplePacking
from drivers.v4l2.options import V4L2Options
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size

OTHER_CLOCK_NS = 1_000_000_000
"""A stamp that is off by more is of another clock. uvcvideo can be set to stamp by CLOCK_REALTIME, and still declares
CLOCK_MONOTONIC."""


class StampSource(StrEnum):
    """The instant of a frame that a buffer's time stamp marks."""

    EXPOSURE_START = "start of exposure"
    FRAME_END = "end of frame"
    NONE = "nothing"


@dataclass(frozen=True, slots=True)
class SensorDurations:
    """Durations of a sensor, ns. readout_ns : from the first row to the last. delay_ns : delay of its time stamps."""

    exposure_ns: int
    readout_ns: int
    delay_ns: int = 0


@dataclass(frozen=True, slots=True)
class BufferStamp:
    """A buffer's time stamp, and when it was queued and dequeued, ns, CLOCK_MONOTONIC."""

    source: StampSource
    stamp_ns: int
    queued_ns: int
    dequeued_ns: int


@dataclass(frozen=True, slots=True)
class ExposureInterval:
    """All rows were exposed between `earliest_ns` and `latest_ns`."""

    earliest_ns: int
    latest_ns: int

    def centred_exposure(self, exposure_ns: int) -> tuple[int, int, int]:
        """Return start, end and error of an exposure of this length in the middle of the interval.

        >>> ExposureInterval(100, 160).centred_exposure(20)
        (120, 140, 20)
        """
        spare_ns = max(self.latest_ns - self.earliest_ns - exposure_ns, 0)
        error_ns = (spare_ns + 1) // 2
        start_ns = self.earliest_ns + error_ns
        return start_ns, start_ns + exposure_ns, error_ns


def is_monotonic_stamp(stamp: BufferStamp, durations: SensorDurations) -> bool:
    """True if a stamp can be an instant of its frame by CLOCK_MONOTONIC."""
    min_ns = stamp.queued_ns - durations.readout_ns - durations.exposure_ns - OTHER_CLOCK_NS
    return min_ns <= stamp.stamp_ns <= stamp.dequeued_ns + OTHER_CLOCK_NS


def exposure_interval(stamp: BufferStamp, durations: SensorDurations) -> ExposureInterval:
    """Return the interval in which every row was exposed; see the module's docstring."""
    before_ns = durations.exposure_ns + durations.delay_ns
    source = stamp.source if is_monotonic_stamp(stamp, durations) else StampSource.NONE
    match source:
        case StampSource.EXPOSURE_START:
            latest_ns = stamp.stamp_ns + durations.readout_ns + durations.exposure_ns
            return ExposureInterval(stamp.stamp_ns - before_ns, latest_ns)
        case StampSource.FRAME_END:
            return ExposureInterval(stamp.stamp_ns - durations.readout_ns - before_ns, stamp.stamp_ns)
        case StampSource.NONE:
            return ExposureInterval(stamp.queued_ns - durations.readout_ns - before_ns, stamp.dequeued_ns)


Answer = TypeVar("Answer", bound=ctypes.Structure)

MIN_RATE_HZ = 15.0
"""Frames per second below which scanning is slow: every pattern waits for a frame or two."""

_RATE_TOLERANCE = 0.01

PERIOD_TOLERANCE = 0.02
"""Part of the frame period by which an exposure may exceed it."""

_BROKEN = select.POLLERR | select.POLLHUP | select.POLLNVAL
_SEQUENCE_MODULUS = 2**32
_MAX_STEP = 2**31


@dataclass(frozen=True, slots=True)
class NegotiatedFormat:
    """The format in use. period_ns : time from frame to frame. slower_ns : longer ones that may take its place, where
    the user names no rate; in rising order. notes : remarks for the user.
    """

    layout: PixelLayout
    size: Size
    stride_bytes: int
    period_ns: int
    slower_ns: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def period_for(self, exposure_s: float) -> int:
        """The shortest period, ns, that an exposure fits into; the longest where it fits into none."""
        periods_ns = (self.period_ns, *self.slower_ns)
        fitting = (each for each in periods_ns if exposure_s * 1e9 <= each * (1 + PERIOD_TOLERANCE))
        return next(fitting, periods_ns[-1])


def negotiate_format(handle: int, node: Path, options: V4L2Options) -> NegotiatedFormat:
    """Set pixel format, size and frame rate as requested, and compare what the driver gives.

    Raises
    ------
    UnsupportedByDeviceError
        The driver gives something else.
    DeviceBusyError
        Another program streams from the device.
    DeviceError
        The device failed.
    """
    try:
        offered = _offered_formats(handle)
        code, size = _choose_format(handle, node, options, offered)
        answer = kernel.Format(type=kernel.CAPTURE)
        if size is None:
            kernel.ioctl(handle, kernel.G_FMT, answer)
            size = Size(answer.fmt.pix.width, answer.fmt.pix.height)
        pix = answer.fmt.pix
        pix.width, pix.height = size.width_px, size.height_px
        pix.pixelformat, pix.field = kernel.fourcc_code(code), kernel.FIELD_NONE
        # For the driver to fill in: the values are those of another format.
        pix.bytesperline = pix.sizeimage = 0
        try:
            kernel.ioctl(handle, kernel.S_FMT, answer)
        except OSError as error:
            raise kernel.device_error(node, f"requesting {code.strip()} {size}", error) from error
        _require_format(handle, node, code, size, pix)
        offered_hz = _rates_hz(handle, code, size)
        period_ns = _period_ns(handle, node, options, offered_hz)
        slower_ns = sorted(round(1e9 / each) for each in offered_hz if each * period_ns < 1e9 * (1 - _RATE_TOLERANCE))
    except OSError as error:
        raise kernel.device_error(node, "setting format and frame rate", error) from error
    layout = _layout(code, options, node)
    notes: tuple[str, ...] = ()
    if options.frame_rate_hz is None and not _reaches(1e9 / period_ns, MIN_RATE_HZ):
        notes = (
            f"gives {1e9 / period_ns:.3g} frames per second in {code.strip()} {size}, which makes scans slow: choose a "
            f"smaller size_px or another pixel_format (v4l2-ctl -d {node} --list-formats-ext lists faster ones)",
        )
    slower = tuple(slower_ns) if options.frame_rate_hz is None else ()
    return NegotiatedFormat(layout, size, int(pix.bytesperline), period_ns, slower, notes)


def _choose_format(handle: int, node: Path, options: V4L2Options, offered: tuple[str, ...]) -> tuple[str, Size | None]:
    """Return pixel format and size: as requested, else the most preferred format that is fast enough.

    A format that is fast enough only with less than half of its pixels yields to the next one.
    """
    codes = tuple(code for code in PREFERRED if code in offered)
    if options.pixel_format is not None:
        codes = (options.pixel_format.ljust(4),)
    if not codes:
        message = (
            f"{node}: offers the pixel formats {_join_codes(offered)}, none of which can be read; "
            f"those that can: {_join_codes(tuple(LAYOUTS))}"
        )
        raise UnsupportedByDeviceError(message)
    wanted_hz = options.frame_rate_hz or MIN_RATE_HZ
    found: list[tuple[str, Size]] = []
    for code in codes:
        sizes = (options.size,) if options.size is not None else _sizes(handle, code)
        if not sizes:
            break
        fast = [size for size in sizes if _is_fast(handle, code, size, wanted_hz)]
        if fast:
            found.append((code, max(fast, key=_pixels)))
            if 2 * _pixels(found[-1][1]) >= max(map(_pixels, sizes)):
                return found[-1]
    if found:
        return max(found, key=lambda each: _pixels(each[1]))
    return codes[0], options.size or max(_sizes(handle, codes[0]), key=_pixels, default=None)


def _pixels(size: Size) -> int:
    return size.width_px * size.height_px


def _is_fast(handle: int, code: str, size: Size, wanted_hz: float) -> bool:
    """True if a size reaches this rate, or the driver does not report rates."""
    rates_hz = _rates_hz(handle, code, size)
    return not rates_hz or _reaches(max(rates_hz), wanted_hz)


def _reaches(rate_hz: float, wanted_hz: float) -> bool:
    return rate_hz >= wanted_hz * (1 - _RATE_TOLERANCE)


def _layout(code: str, options: V4L2Options, node: Path) -> PixelLayout:
    layout = LAYOUTS[code]
    if options.sample_shift:
        if layout.packing is not SamplePacking.WORDS or layout.bit_depth == 16:
            message = (
                f"{node}: requested sample_shift {options.sample_shift}, but {code.strip()} has no samples of 10 to 14 "
                "bits in 16-bit words; leave sample_shift out"
            )
            raise UnsupportedByDeviceError(message)
        layout = replace(layout, shift=options.sample_shift)
    if options.bit_depth is None or options.bit_depth == layout.bit_depth:
        return layout
    if layout.bit_depth != 16:
        message = (
            f"{node}: requested bit_depth {options.bit_depth}, but {code.strip()} has {layout.bit_depth} bits; leave "
            "bit_depth out, it is for 16-bit formats that the sensor does not fill"
        )
        raise UnsupportedByDeviceError(message)
    return replace(layout, bit_depth=options.bit_depth)


def _require_format(handle: int, node: Path, code: str, size: Size, pix: kernel.PixFormat) -> None:
    got = kernel.fourcc_text(pix.pixelformat)
    if (got, pix.width, pix.height) != (code, size.width_px, size.height_px):
        sizes = ", ".join(str(have) for have in _sizes(handle, code)) or "no size that it reports"
        message = (
            f"{node}: requested {code.strip()} {size}, driver gives {got.strip()} {pix.width} x {pix.height}; it "
            f"offers {_join_codes(_offered_formats(handle))}, and {code.strip()} in {sizes}: write one of these as "
            "pixel_format and size_px"
        )
        raise UnsupportedByDeviceError(message)
    if pix.field not in (kernel.FIELD_ANY, kernel.FIELD_NONE):
        message = (
            f"{node}: requested whole frames, driver gives interlaced ones (field {pix.field}): two instants in one "
            "image; choose a progressive size_px, or another camera"
        )
        raise UnsupportedByDeviceError(message)


def _offered_formats(handle: int) -> tuple[str, ...]:
    answers = _enumerate(handle, kernel.ENUM_FMT, partial(kernel.FormatDescription, type=kernel.CAPTURE))
    return tuple(kernel.fourcc_text(answer.pixelformat) for answer in answers)


def _sizes(handle: int, code: str) -> tuple[Size, ...]:
    """List the sizes of a format; of a range, its largest. Empty where the driver does not report them."""
    found: list[Size] = []
    request = partial(kernel.FrameSize, pixel_format=kernel.fourcc_code(code))
    for answer in _enumerate(handle, kernel.ENUM_FRAMESIZES, request):
        if answer.type != kernel.SIZES_DISCRETE:
            return (Size(answer.size.stepwise.max_width, answer.size.stepwise.max_height),)
        found.append(Size(answer.size.discrete.width, answer.size.discrete.height))
    return tuple(found)


def _rates_hz(handle: int, code: str, size: Size) -> tuple[float, ...]:
    """List the frame rates of a format and size; of a range, its fastest. Empty where the driver reports none."""
    found: list[float] = []
    extent = {"width": size.width_px, "height": size.height_px}
    request = partial(kernel.FrameInterval, pixel_format=kernel.fourcc_code(code), **extent)
    for answer in _enumerate(handle, kernel.ENUM_FRAMEINTERVALS, request):
        is_discrete = answer.type == kernel.SIZES_DISCRETE
        period = answer.interval.discrete if is_discrete else answer.interval.stepwise.min
        found.append(float("inf") if not period.numerator else period.denominator / period.numerator)
        if not is_discrete:
            break
    return tuple(found)


def _enumerate(handle: int, request: int, structure: Callable[..., Answer]) -> Iterator[Answer]:
    """Send a request with rising index until the driver refuses it, and yield the answers."""
    for index in count():
        answer = structure(index=index)
        try:
            kernel.ioctl(handle, request, answer)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return
            raise
        yield answer


def _period_ns(handle: int, node: Path, options: V4L2Options, offered_hz: tuple[float, ...]) -> int:
    wanted_hz = options.frame_rate_hz
    rate_hz = _rate_hz(handle) if wanted_hz is None else _set_rate_hz(handle, wanted_hz)
    if wanted_hz is None and rate_hz is not None and not _reaches(rate_hz, MIN_RATE_HZ):
        # The slowest rate that is fast enough: it allows the longest exposures.
        fast_hz = [each for each in offered_hz if _reaches(each, MIN_RATE_HZ) and each != float("inf")]
        rate_hz = _set_rate_hz(handle, min(fast_hz)) if fast_hz else rate_hz
    if rate_hz is None:
        if wanted_hz is None:
            message = (
                f"{node}: the driver does not report its frame rate, which is needed for exposure times; write "
                "frame_rate_hz into the camera's table"
            )
            raise UnsupportedByDeviceError(message)
        return round(1e9 / wanted_hz)
    if wanted_hz is not None and abs(rate_hz - wanted_hz) > _RATE_TOLERANCE * wanted_hz:
        message = (
            f"{node}: requested {wanted_hz:g} frames per second, driver gives {rate_hz:.6g}; write frame_rate_hz = "
            f"{rate_hz:.6g}, or choose another size_px or pixel_format (v4l2-ctl -d {node} --list-formats-ext)"
        )
        raise UnsupportedByDeviceError(message)
    return round(1e9 / rate_hz)


def _set_rate_hz(handle: int, wanted_hz: float) -> float | None:
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    period = Fraction(1 / wanted_hz).limit_denominator(1_000_000)
    answer.parm.capture.timeperframe = kernel.Fraction(period.numerator, period.denominator)
    _request_if_supported(handle, kernel.S_PARM, answer)
    return _rate_hz(handle)


def set_period(handle: int, node: Path, period_ns: int) -> int:
    """Set the time from frame to frame while the stream is off; return what the driver gives. Raises DeviceError."""
    try:
        rate_hz = _set_rate_hz(handle, 1e9 / period_ns)
    except OSError as error:
        raise kernel.device_error(node, "setting its frame rate", error) from error
    return period_ns if rate_hz is None else round(1e9 / rate_hz)


def _rate_hz(handle: int) -> float | None:
    """Return the frame rate in use; None where the driver does not report it."""
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    _request_if_supported(handle, kernel.G_PARM, answer)
    period = answer.parm.capture.timeperframe
    return float(period.denominator / period.numerator) if period.numerator and period.denominator else None


def _request_if_supported(handle: int, request: int, answer: kernel.StreamParameters) -> None:
    try:
        kernel.ioctl(handle, request, answer)
    except OSError as error:
        if error.errno not in kernel.REFUSED:
            raise


def _join_codes(codes: tuple[str, ...]) -> str:
    return ", ".join(code.strip() for code in codes) or "none"


@dataclass(frozen=True, slots=True)
class FilledBuffer:
    """A filled buffer, to be queued again after use. corrupt : the driver reports damaged data."""

    index: int
    bytes_used: int
    corrupt: bool
    sequence: int
    stamp: BufferStamp


class Waker:
    """Ends waits from another thread, permanently."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()

    @property
    def handle(self) -> int:
        """Readable once woken."""
        return self._read

    def wake(self) -> None:
        """End every present and future wait."""
        with suppress(OSError):
            os.write(self._write, b"\0")

    def close(self) -> None:
        """Close the pipe. No thread may wait any more."""
        os.close(self._read)
        os.close(self._write)


class V4L2Stream:
    """The buffers of an open device. Other programs cannot stream until `release` frees them.

    Raises
    ------
    DeviceBusyError
        Another program streams from the device.
    DeviceError
        The device failed, or does not map buffers.
    """

    def __init__(self, handle: int, node: Path, count: int, waker: Waker) -> None:
        self._handle = handle
        self._node = node
        self._waker = waker
        self._maps: list[mmap.mmap] = []
        self._queued_ns: list[int] = []
        self._on = False
        request = kernel.BufferRequest(count=count, type=kernel.CAPTURE, memory=kernel.MMAP)
        self._request("requesting buffers", kernel.REQBUFS, request)
        if request.count < 1:
            message = f"{node}: requested {count} buffers, driver gives none; close other programs, or request fewer"
            raise UnsupportedByDeviceError(message)
        try:
            for index in range(request.count):
                buffer = self._buffer(index)
                self._request("querying a buffer", kernel.QUERYBUF, buffer)
                self._maps.append(
                    mmap.mmap(handle, buffer.length, mmap.MAP_SHARED, mmap.PROT_READ, offset=buffer.m.offset)
                )
                self._queued_ns.append(0)
        except OSError as error:
            self.release()
            raise kernel.device_error(node, "mapping a buffer", error) from error
        except DeviceError:
            self.release()
            raise

    def start(self) -> None:
        """Queue every buffer and start the stream."""
        for index in range(len(self._maps)):
            self._queue(index)
        self._request("starting the stream", kernel.STREAMON, ctypes.c_int(kernel.CAPTURE))
        self._on = True

    def take(self, until_ns: int) -> FilledBuffer | None:
        """Dequeue the oldest filled buffer, waiting until `until_ns` (CLOCK_MONOTONIC); None if no frame came.

        Raises
        ------
        DeviceGoneError
            The device was unplugged, or its stream has failed.
        DeviceStateError
            The waker has been used.
        """
        poll = select.poll()
        poll.register(self._handle, select.POLLIN)
        poll.register(self._waker.handle, select.POLLIN)
        left_ms = 0.0
        while True:
            events = dict(poll.poll(left_ms))
            if self._waker.handle in events:
                message = f"{self._node}: the camera was closed during the wait for a frame; open it again"
                raise DeviceStateError(message)
            if self._handle in events:
                filled = self._dequeue()
                if filled is not None:
                    return filled
                if events[self._handle] & _BROKEN:
                    message = (
                        f"{self._node}: the stream has ended; the camera is gone or has failed: plug it in again, and "
                        "reopen it"
                    )
                    raise DeviceGoneError(message)
            left_ms = (until_ns - time.monotonic_ns()) / 1e6
            if left_ms <= 0:
                return None

    def data(self, filled: FilledBuffer) -> NDArray[np.uint8]:
        """Return a copy of the used bytes of a buffer, (n,) uint8."""
        return np.frombuffer(self._maps[filled.index][: filled.bytes_used], dtype=np.uint8)

    def requeue(self, filled: FilledBuffer) -> None:
        """Queue the buffer for the camera to fill again."""
        self._queue(filled.index)

    def stop(self) -> None:
        """End the stream, in any state of the device. Idempotent."""
        if self._on:
            self._on = False
            with suppress(DeviceError):
                self._request("stopping the stream", kernel.STREAMOFF, ctypes.c_int(kernel.CAPTURE))

    def release(self) -> None:
        """Stop the stream and free the buffers. Idempotent; works on an unplugged device."""
        self.stop()
        while self._maps:
            self._maps.pop().close()
        with suppress(DeviceError):
            none = kernel.BufferRequest(count=0, type=kernel.CAPTURE, memory=kernel.MMAP)
            self._request("freeing the buffers", kernel.REQBUFS, none)

    def _buffer(self, index: int = 0) -> kernel.Buffer:
        return kernel.Buffer(index=index, type=kernel.CAPTURE, memory=kernel.MMAP)

    def _queue(self, index: int) -> None:
        # Stored before the request: the camera may fill the buffer before the request returns.
        self._queued_ns[index] = time.monotonic_ns()
        self._request("queuing a buffer", kernel.QBUF, self._buffer(index))

    def _dequeue(self) -> FilledBuffer | None:
        buffer = self._buffer()
        try:
            kernel.ioctl(self._handle, kernel.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise kernel.stream_error(self._node, "dequeuing a frame", error) from error
        index = int(buffer.index)
        stamp_ns = buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1000
        stamp = BufferStamp(_stamp_source(buffer.flags), stamp_ns, self._queued_ns[index], time.monotonic_ns())
        corrupt = bool(buffer.flags & kernel.BUFFER_ERROR)
        return FilledBuffer(index, int(buffer.bytesused), corrupt, int(buffer.sequence), stamp)

    def _request(self, action: str, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        try:
            kernel.ioctl(self._handle, request, argument)
        except OSError as error:
            raise kernel.stream_error(self._node, action, error) from error


def _stamp_source(flags: int) -> StampSource:
    if flags & kernel.STAMP_MASK != kernel.STAMP_MONOTONIC:
        return StampSource.NONE
    if flags & kernel.STAMP_SOURCE_MASK == kernel.STAMP_SOURCE_START:
        return StampSource.EXPOSURE_START
    return StampSource.FRAME_END


@dataclass(slots=True)
class FrameCounter:
    """Counts the frames of a stream: new, lost, and their period.

    number : of the last new frame; continues from stream to stream while the camera is open. lost : frames that did not
    come although a buffer was free, repeated ones and corrupt ones; frames made while all buffers were full are not
    counted, they would have been stale. ahead_ns : the most by which a stamp was later than its frame's arrival.
    """

    number: int = -1
    lost: int = 0
    ahead_ns: int = 0
    _last: FilledBuffer | None = None
    _intervals_ns: list[float] = field(default_factory=list)

    def begin(self) -> None:
        """Start a new stream, with sequence numbers from its start."""
        self._last = None
        self.ahead_ns = 0
        self._intervals_ns.clear()

    def forget_losses(self) -> None:
        """Set the count of lost frames to 0."""
        self.lost = 0

    def is_new(self, filled: FilledBuffer) -> bool:
        """Count a frame. False if it is a repetition: its stamp is not later than the last one's."""
        last, self._last = self._last, filled
        ahead_ns = filled.stamp.stamp_ns - filled.stamp.dequeued_ns
        if filled.stamp.source is not StampSource.NONE and ahead_ns <= OTHER_CLOCK_NS:
            self.ahead_ns = max(self.ahead_ns, ahead_ns)
        if last is None:
            self.number += 1
            return True
        step = (filled.sequence - last.sequence) % _SEQUENCE_MODULUS
        stamped = StampSource.NONE not in (filled.stamp.source, last.stamp.source)
        if (filled.stamp.stamp_ns <= last.stamp.stamp_ns) if stamped else (step == 0):
            self._last = last
            self.lost += 1
            return False
        # Without a usable count of the driver, losses are unknown.
        step = step if 1 <= step < _MAX_STEP else 1
        self.number += step
        if stamped:
            self._intervals_ns.append((filled.stamp.stamp_ns - last.stamp.stamp_ns) / step)
        # Buffers are filled in the order in which they were queued. If this one was free when the last frame was
        # finished, the frames between are lost. Otherwise no buffer was free for them.
        finished_ns = last.stamp.stamp_ns if stamped else last.stamp.dequeued_ns
        if filled.stamp.queued_ns <= finished_ns:
            self.lost += step - 1
        return True

    def note_corrupt(self) -> None:
        """Count a frame with damaged data as lost."""
        self.lost += 1

    def period_ns(self) -> int | None:
        """Return the median time from frame to frame; None with fewer than two stamped frames."""
        return round(statistics.median(self._intervals_ns)) if self._intervals_ns else None
