"""Sources of frames, one class per kind, their timing, and the thread that reads them.

The package's docstring explains the timing rules.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
from numpy.typing import NDArray

from drivers.opencv.controls import require_free, require_present
from drivers.opencv.options import CaptureSource
from drivers.v4l2.stream import ExposureInterval
from slrig.errors import DeviceError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError

_OTHER_CLOCK_NS = 10_000_000_000

OPEN_LIMIT_S = 10.0
_FEW_BUFFERS = 4
_RETRY_S = 0.01
_AT_ONCE_NS = 500_000_000
_DEAD_NS = 2_000_000_000  # of grabs that fail at once, one after the other
_MAX_FRAMES = 8
_JOIN_S = 1.0


@dataclass(frozen=True, slots=True)
class GrabTimes:
    """Times of a call to OpenCV's `read`, ns: when called, when returned, and the time asleep in between."""

    called_ns: int
    returned_ns: int
    slept_ns: int


def exposure_from_stamp(stamp_ns: int, grabbed: GrabTimes, *, exposure_ns: int, period_ns: int) -> ExposureInterval:
    """Return when a frame was exposed, for any meaning of the kernel's stamp."""
    latest_ns = min(stamp_ns + period_ns + exposure_ns, grabbed.returned_ns)
    return ExposureInterval(stamp_ns - period_ns - exposure_ns, latest_ns)


def is_monotonic_stamp(stamp_ns: int, grabbed: GrabTimes) -> bool:
    """True if a stamp can be of CLOCK_MONOTONIC."""
    return abs(grabbed.returned_ns - stamp_ns) < _OTHER_CLOCK_NS


class ArrivalTiming:
    """Exposure times of frames of a source without time stamps.

    A frame arrived after the queue was last empty, which it was when the reader slept in wait for a frame. Half a frame
    period counts as a wait: shorter sleeps, for a lock or memory, also occur in a reader that never catches up.

    Parameters
    ----------
    exposure_ns, delay_ns, period_ns
        The longest exposure, the longest delay, and the shortest time from frame to frame.
    """

    def __init__(self, *, exposure_ns: int, delay_ns: int, period_ns: int) -> None:
        self.exposure_ns = exposure_ns
        self._delay_ns = delay_ns
        self._wait_ns = period_ns // 2
        self._empty_ns: int | None = None
        self.queued = 0
        """Frames since the queue was last known to be empty."""

    def exposure(self, grabbed: GrabTimes) -> ExposureInterval | None:
        """Return when a frame was exposed; None while its time in the queue is unknown."""
        if grabbed.slept_ns >= self._wait_ns:
            self._empty_ns = grabbed.called_ns
            self.queued = 0
        self.queued += 1
        if self._empty_ns is None:
            return None
        return ExposureInterval(self._empty_ns - self._delay_ns - self.exposure_ns, grabbed.returned_ns)


class SleepMeter:
    """Measures the time that the calling thread is awake; to be made and used by that thread.

    Awake is time on the processor and, where the kernel reports it (Linux), waiting for a processor.
    """

    def __init__(self) -> None:
        self._file: int | None = None
        with suppress(OSError):
            self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)

    def awake_ns(self) -> int:
        """Return the time so far that the thread was not asleep, ns."""
        queued_ns = 0
        if self._file is not None:
            with suppress(OSError, IndexError, ValueError):
                queued_ns = int(os.pread(self._file, 128, 0).split()[1])
        return time.thread_time_ns() + queued_ns

    def close(self) -> None:
        """Close the kernel's file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


@dataclass(frozen=True, slots=True)
class GrabbedFrame:
    """A frame from OpenCV. exposure : None if unknown. number, lost : counts of the source so far."""

    data: NDArray[Any]
    exposure: ExposureInterval | None
    number: int
    lost: int = 0


class SourceFeed(Protocol):
    """A source of frames. Only the reading thread calls `begin`, `take` and `pause`."""

    def begin(self) -> None:
        """Prepare for reading by the calling thread."""
        ...

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """Return the next frame; None to skip one, or when `stop` is set. Raises SlrigError at the end."""
        ...

    def pause(self) -> None:
        """End reading, for now."""
        ...

    def release(self) -> None:
        """Release the source. Idempotent."""
        ...


class _CaptureFeed:
    """An open `cv2.VideoCapture` whose reads are timed."""

    def __init__(self, capture: cv2.VideoCapture, label: str) -> None:
        self.capture = capture
        self.label = label
        self.number = -1
        self._sleep: SleepMeter | None = None

    def begin(self) -> None:
        """See `SourceFeed`."""
        self._sleep = SleepMeter()

    def grab(self) -> tuple[NDArray[Any], GrabTimes]:
        """Return the next frame and the times of the call. Raises DeviceGoneError, DeviceError."""
        awake = self._sleep.awake_ns if self._sleep is not None else time.thread_time_ns
        called_ns, awake_ns = time.monotonic_ns(), awake()
        try:
            came, data = self.capture.read()
        except cv2.error as error:
            message = f"{self.label}: OpenCV failed: {error.err}; open it again"
            raise DeviceError(message) from error
        awake_ns, returned_ns = awake() - awake_ns, time.monotonic_ns()
        if not came:
            # OpenCV reports no cause, and continues to report the source as open.
            message = f"{self.label} gives no more frames: it was unplugged, or its sender has ended; open it again"
            raise DeviceGoneError(message)
        self.number += 1
        return data, GrabTimes(called_ns, returned_ns, returned_ns - called_ns - awake_ns)

    def pause(self) -> None:
        """See `SourceFeed`."""
        if self._sleep is not None:
            self._sleep.close()
            self._sleep = None

    def release(self) -> None:
        """See `SourceFeed`."""
        self.capture.release()


class DeviceFeed(_CaptureFeed):
    """A camera of the kernel. `exposure_ns` is set before it is read.

    arrivals : timing by arrival, where the kernel's stamps are not trusted.
    """

    def __init__(self, capture: cv2.VideoCapture, label: str, period_ns: int, arrivals: ArrivalTiming | None) -> None:
        super().__init__(capture, label)
        self.period_ns = period_ns
        self.exposure_ns = 0
        self.stamps_ns: list[int] = []
        self.arrivals = arrivals
        self._last_ns = 0
        self._lost = 0
        self._dead_since_ns: int | None = None
        self._streams = False

    def begin(self) -> None:
        """See `SourceFeed`."""
        super().begin()
        self._streams = True
        # Frames that came before are not lost.
        self.stamps_ns = []
        if self.arrivals is not None:
            self.arrivals.exposure_ns = self.exposure_ns

    def end_stream(self) -> None:
        """End the stream, which OpenCV does only to change its buffers; it starts again with the next frame.

        Settings then take effect with the next stream, no old frames come with it, and the bus is free for others.
        """
        if not self._streams:
            return
        self._streams = False
        count = self.capture.get(cv2.CAP_PROP_BUFFERSIZE)
        self.capture.set(cv2.CAP_PROP_BUFFERSIZE, count - 1 if count > _FEW_BUFFERS else count + 1)

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `SourceFeed`. None for a repeated frame, whose stamp has not advanced."""
        called_ns = time.monotonic_ns()
        try:
            data, grabbed = self.grab()
        except DeviceGoneError as error:
            # OpenCV reports a camera that is silent for long as it does one that is gone or whose stream has ended;
            # but the latter at once.
            require_present(self.label, error)
            now_ns = time.monotonic_ns()
            if now_ns - called_ns > _AT_ONCE_NS:
                self._dead_since_ns = None
            elif self._dead_since_ns is None:
                self._dead_since_ns = called_ns
            elif now_ns - self._dead_since_ns > _DEAD_NS:
                raise
            stop.wait(_RETRY_S)
            return None
        self._dead_since_ns = None
        if self.arrivals is not None:
            return GrabbedFrame(data, self.arrivals.exposure(grabbed), self.number)
        stamp_ns = round(self.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if not is_monotonic_stamp(stamp_ns, grabbed):
            message = (
                f"{self.label}: its time stamps are not of CLOCK_MONOTONIC: one was {stamp_ns} ns at "
                f"{grabbed.returned_ns} ns; write delay_s and frame_rate_hz into its table to replace them"
            )
            raise UnsupportedByDeviceError(message)
        if stamp_ns <= self._last_ns:
            return None
        if self.stamps_ns and self.period_ns:
            self._lost += max(round((stamp_ns - self._last_ns) / self.period_ns) - 1, 0)
        self._last_ns = stamp_ns
        self.stamps_ns = [*self.stamps_ns[-15:], stamp_ns]
        exposure = exposure_from_stamp(stamp_ns, grabbed, exposure_ns=self.exposure_ns, period_ns=self.period_ns)
        return GrabbedFrame(data, exposure, self.number + self._lost, self._lost)


class LiveFeed(_CaptureFeed):
    """A source without time stamps, timed by arrival."""

    def __init__(self, capture: cv2.VideoCapture, label: str, arrivals: ArrivalTiming) -> None:
        super().__init__(capture, label)
        self.arrivals = arrivals

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `SourceFeed`."""
        del stop
        data, grabbed = self.grab()
        return GrabbedFrame(data, self.arrivals.exposure(grabbed), self.number)


class FilmFeed:
    """A film: its frames are returned when their exposure has ended, counted from `begun_ns`."""

    def __init__(self, open_film: Callable[[], cv2.VideoCapture], source: CaptureSource) -> None:
        self._open_film = open_film
        self._label = source.label
        self._exposure_ns = round((source.options.source_exposure_s or 0) * 1e9)
        self._rate_hz = source.options.frame_rate_hz
        self._film: _CaptureFeed | None = None
        self.begun_ns = 0

    def rewind(self) -> None:
        """Start the film again, now. The camera's thread calls it before `begin`. Raises as `open_capture`."""
        self.release()
        self._film = _CaptureFeed(self._open_film(), self._label)
        self.begun_ns = time.monotonic_ns()

    def begin(self) -> None:
        """See `SourceFeed`."""

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `SourceFeed`. Raises FrameTimeoutError at the film's end."""
        film = self._film
        if film is None:
            return None
        try:
            data, _ = film.grab()
        except DeviceGoneError as error:
            message = f"{self._label}: the film has ended after {film.number + 1} frames; arm the camera to restart it"
            raise FrameTimeoutError(message) from error
        start_ns = self.begun_ns + self._position_ns(film)
        while (left_ns := start_ns + self._exposure_ns - time.monotonic_ns()) > 0:
            if stop.wait(left_ns / 1e9):
                return None
        return GrabbedFrame(data, ExposureInterval(start_ns, start_ns + self._exposure_ns), film.number)

    def pause(self) -> None:
        """See `SourceFeed`."""

    def release(self) -> None:
        """See `SourceFeed`."""
        if self._film is not None:
            self._film.release()
            self._film = None

    def _position_ns(self, film: _CaptureFeed) -> int:
        if self._rate_hz is not None:
            return round(film.number / self._rate_hz * 1e9)
        return round(film.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)


def open_capture(source: CaptureSource, parameters: Sequence[int] = ()) -> cv2.VideoCapture:
    """Open a source through OpenCV, within `OPEN_LIMIT_S`.

    Raises
    ------
    DeviceGoneError
        It is not connected, or does not answer.
    DeviceBusyError
        Another program streams from it.
    DeviceError
        OpenCV cannot open it.
    """
    if sys.platform == "linux" and source.backend == cv2.CAP_V4L2:
        require_free(source.label)
    done = threading.Event()
    found: list[cv2.VideoCapture | cv2.error] = []
    given_up = threading.Event()

    def attempt() -> None:
        try:
            capture = cv2.VideoCapture(source.target, source.backend, list(parameters))
        except cv2.error as error:
            found.append(error)
        else:
            found.append(capture)
            if given_up.is_set():
                capture.release()
        done.set()

    # Opening a pipe without a writer blocks and cannot be interrupted.
    threading.Thread(target=attempt, name="slrig-opencv-open", daemon=True).start()
    if not done.wait(OPEN_LIMIT_S):
        given_up.set()
        message = f"{source.label} did not open within {OPEN_LIMIT_S:g} s; check that its sender is running"
        raise DeviceGoneError(message)
    capture = found[0]
    if isinstance(capture, cv2.error):
        message = f"{source.label}: OpenCV cannot open it: {capture.err}; check backend and device in the rig file"
        raise DeviceError(message) from capture
    if not capture.isOpened():
        capture.release()
        if "://" in str(source.target):
            message = f"no answer from {source.label}, or it sends no video; check address and network"
            raise DeviceGoneError(message)
        message = (
            f"{source.label}: OpenCV cannot open it: it is not a camera or film, or OpenCV reads none of its formats; "
            "name another, or use the driver made for it"
        )
        raise DeviceError(message)
    return capture


class FeedReader:
    """Reads a feed in a thread of its own and keeps the newest frames. The camera calls its methods."""

    def __init__(self, feed: SourceFeed, name: str) -> None:
        self._feed = feed
        self._name = name
        self._came = threading.Condition()
        self._frames: deque[GrabbedFrame] = deque(maxlen=_MAX_FRAMES)
        self._fault: Exception | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._is_closed = False
        self._released = threading.Lock()

    def start(self) -> None:
        """Start reading. Discards earlier frames."""
        self.discard()
        self._fault = None
        # A new event: a thread that did not end must not continue.
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> bool:
        """Stop reading. False if OpenCV does not return: the thread ends when it does."""
        self._stop.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN_S)
            if thread.is_alive():
                return False
        self._thread = None
        self.discard()
        return True

    def close(self) -> None:
        """Stop and release the source, in the thread itself if it does not return in time. Ends a waiting `next`."""
        with self._came:
            self._is_closed = True
            self._came.notify_all()
        if self.stop():
            self._release()

    def discard(self) -> None:
        """Discard the frames read so far."""
        with self._came:
            self._frames.clear()

    @property
    def fault(self) -> Exception | None:
        """The error that ended reading, if any."""
        return self._fault

    def next(self, until_ns: int) -> GrabbedFrame | None:
        """Return the oldest frame, waiting for it; None at `until_ns`, or when the reader is closed.

        Raises the error that ended reading.
        """
        with self._came:
            while not self._frames:
                if self._fault is not None:
                    raise self._fault
                left_s = (until_ns - time.monotonic_ns()) / 1e9
                if self._is_closed or left_s <= 0:
                    return None
                self._came.wait(left_s)
            return self._frames.popleft()

    def _run(self, stop: threading.Event) -> None:
        try:
            self._feed.begin()
            while not stop.is_set():
                frame = self._feed.take(stop)
                if frame is not None and not stop.is_set():
                    with self._came:
                        self._frames.append(frame)
                        self._came.notify_all()
        except Exception as error:  # noqa: BLE001 - any error of OpenCV; `next` raises it
            with self._came:
                self._fault = error
                self._came.notify_all()
        finally:
            self._feed.pause()
            if self._is_closed:
                self._release()

    def _release(self) -> None:
        with self._released:
            self._feed.release()
