"""Where frames come from, one class per kind of source: each is opened, read by one thread, and let go once."""

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
from drivers.v4l2.timing import ExposureInterval
from slrig.errors import DeviceError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError

_OTHER_CLOCK_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class GrabTimes:
    """When a frame was taken over from OpenCV, ns: asked for, returned, and of that time asleep (`slept_ns`)."""

    asked_ns: int
    returned_ns: int
    slept_ns: int


def exposure_from_stamp(stamp_ns: int, grabbed: GrabTimes, *, exposure_ns: int, period_ns: int) -> ExposureInterval:
    """Return when a frame with the kernel's stamp was exposed, whatever instant of the frame the stamp names."""
    latest_ns = min(stamp_ns + period_ns + exposure_ns, grabbed.returned_ns)
    return ExposureInterval(stamp_ns - period_ns - exposure_ns, latest_ns)


def is_monotonic_stamp(stamp_ns: int, grabbed: GrabTimes) -> bool:
    """Whether a stamp can be one of CLOCK_MONOTONIC: other clocks give themselves away."""
    return abs(grabbed.returned_ns - stamp_ns) < _OTHER_CLOCK_NS


class ArrivalTiming:
    """When the frames of a source without time stamps were exposed.

    A frame arrived after the queue was last seen empty, and the queue was empty when the reader slept in wait for a
    frame. Half a frame period counts as a wait: what a reader that never catches up sleeps now and then, for a lock or
    for its memory, does not.

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
        """Frames since the queue was last seen empty."""

    def exposed(self, grabbed: GrabTimes) -> ExposureInterval | None:
        """Return when a frame was exposed; None while nothing tells for how long it had been waiting."""
        if grabbed.slept_ns >= self._wait_ns:
            self._empty_ns = grabbed.asked_ns
            self.queued = 0
        self.queued += 1
        if self._empty_ns is None:
            return None
        return ExposureInterval(self._empty_ns - self._delay_ns - self.exposure_ns, grabbed.returned_ns)


class SleepMeter:
    """How long the calling thread has slept between two instants; to be made and used by that thread.

    Time on the processor is no sleep, nor, where the kernel tells it (Linux), is waiting for one.
    """

    def __init__(self) -> None:
        self._file: int | None = None
        with suppress(OSError):
            self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)

    def awake_ns(self) -> int:
        """Time so far that the thread was not asleep, ns."""
        queued_ns = 0
        if self._file is not None:
            with suppress(OSError, IndexError, ValueError):
                queued_ns = int(os.pread(self._file, 128, 0).split()[1])
        return time.thread_time_ns() + queued_ns

    def close(self) -> None:
        """Let the kernel's file go."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


OPEN_LIMIT_S = 10.0
_FEW_BUFFERS = 4
_RETRY_S = 0.01
_AT_ONCE_NS = 500_000_000
_DEAD_NS = 2_000_000_000  # of grabs that fail at once, one after the other


@dataclass(frozen=True, slots=True)
class GrabbedFrame:
    """One frame as OpenCV gave it. exposed : None where nothing tells when. number, lost : of the source, so far."""

    data: NDArray[Any]
    exposed: ExposureInterval | None
    number: int
    lost: int = 0


class FrameFeed(Protocol):
    """A source of frames. `begin`, `take` and `pause` belong to the thread that reads it."""

    def begin(self) -> None:
        """Get ready to be read by the calling thread."""
        ...

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """Return the next frame; None for one that is none, or when `stop` is set. Raises SlrigError at the end."""
        ...

    def pause(self) -> None:
        """Be read no more, for now."""
        ...

    def release(self) -> None:
        """Let the source go. Idempotent."""
        ...


class _CaptureFeed:
    """An open `cv2.VideoCapture`, read with a stop-watch."""

    def __init__(self, capture: cv2.VideoCapture, label: str) -> None:
        self.capture = capture
        self.label = label
        self.number = -1
        self._sleep: SleepMeter | None = None

    def begin(self) -> None:
        """See `FrameFeed`."""
        self._sleep = SleepMeter()

    def grabbed(self) -> tuple[NDArray[Any], GrabTimes]:
        """Return the next frame, and when it was taken over. Raises DeviceGoneError, DeviceError."""
        awake = self._sleep.awake_ns if self._sleep is not None else time.thread_time_ns
        asked_ns, awake_ns = time.monotonic_ns(), awake()
        try:
            came, data = self.capture.read()
        except cv2.error as error:
            message = f"{self.label}: OpenCV failed: {error.err}; open it again"
            raise DeviceError(message) from error
        awake_ns, returned_ns = awake() - awake_ns, time.monotonic_ns()
        if not came:
            # OpenCV says no more than this, and keeps saying that the source is open.
            message = f"{self.label} gives no more frames: it was unplugged, or its other end is gone; open it again"
            raise DeviceGoneError(message)
        self.number += 1
        return data, GrabTimes(asked_ns, returned_ns, returned_ns - asked_ns - awake_ns)

    def pause(self) -> None:
        """See `FrameFeed`."""
        if self._sleep is not None:
            self._sleep.close()
            self._sleep = None

    def release(self) -> None:
        """See `FrameFeed`."""
        self.capture.release()


class DeviceFeed(_CaptureFeed):
    """A camera of the kernel's. `exposure_ns` is set before it is read.

    arrivals : the rule in place of the kernel's stamps, where these are not trusted.
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
        """See `FrameFeed`."""
        super().begin()
        self._streams = True
        # What came while nobody read is not lost.
        self.stamps_ns = []
        if self.arrivals is not None:
            self.arrivals.exposure_ns = self.exposure_ns

    def rest(self) -> None:
        """End the stream, which OpenCV starts with the next frame. It does so only to exchange its buffers.

        Settings then take effect with the next stream, no old frames come with it, and another camera has the bus.
        """
        if not self._streams:
            return
        self._streams = False
        count = self.capture.get(cv2.CAP_PROP_BUFFERSIZE)
        self.capture.set(cv2.CAP_PROP_BUFFERSIZE, count - 1 if count > _FEW_BUFFERS else count + 1)

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `FrameFeed`. None for a frame whose stamp has not advanced: a repeated one."""
        asked_ns = time.monotonic_ns()
        try:
            data, grabbed = self.grabbed()
        except DeviceGoneError as error:
            # OpenCV gives up on a camera that is silent for long in the same words as on one that is not there, or on
            # one whose stream has died; but on that at once.
            require_present(self.label, error)
            now_ns = time.monotonic_ns()
            if now_ns - asked_ns > _AT_ONCE_NS:
                self._dead_since_ns = None
            elif self._dead_since_ns is None:
                self._dead_since_ns = asked_ns
            elif now_ns - self._dead_since_ns > _DEAD_NS:
                raise
            stop.wait(_RETRY_S)
            return None
        self._dead_since_ns = None
        if self.arrivals is not None:
            return GrabbedFrame(data, self.arrivals.exposed(grabbed), self.number)
        stamp_ns = round(self.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if not is_monotonic_stamp(stamp_ns, grabbed):
            message = (
                f"{self.label}: its time stamps are not of CLOCK_MONOTONIC: one said {stamp_ns} ns at "
                f"{grabbed.returned_ns} ns; write delay_s and frame_rate_hz into its table, and they are not used"
            )
            raise UnsupportedByDeviceError(message)
        if stamp_ns <= self._last_ns:
            return None
        if self.stamps_ns and self.period_ns:
            self._lost += max(round((stamp_ns - self._last_ns) / self.period_ns) - 1, 0)
        self._last_ns = stamp_ns
        self.stamps_ns = [*self.stamps_ns[-15:], stamp_ns]
        exposed = exposure_from_stamp(stamp_ns, grabbed, exposure_ns=self.exposure_ns, period_ns=self.period_ns)
        return GrabbedFrame(data, exposed, self.number + self._lost, self._lost)


class LiveFeed(_CaptureFeed):
    """A source whose frames tell their arrival only."""

    def __init__(self, capture: cv2.VideoCapture, label: str, arrivals: ArrivalTiming) -> None:
        super().__init__(capture, label)
        self.arrivals = arrivals

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `FrameFeed`."""
        del stop
        data, grabbed = self.grabbed()
        return GrabbedFrame(data, self.arrivals.exposed(grabbed), self.number)


class FilmFeed:
    """A film: its frames are given when their exposure has ended, counted from `begun_ns`."""

    def __init__(self, open_film: Callable[[], cv2.VideoCapture], source: CaptureSource) -> None:
        self._open_film = open_film
        self._label = source.label
        self._exposure_ns = round((source.options.source_exposure_s or 0) * 1e9)
        self._rate_hz = source.options.frame_rate_hz
        self._film: _CaptureFeed | None = None
        self.begun_ns = 0

    def rewind(self) -> None:
        """Begin the film anew, now. Before `begin`, and by the camera's own thread. Raises as `open_capture` does."""
        self.release()
        self._film = _CaptureFeed(self._open_film(), self._label)
        self.begun_ns = time.monotonic_ns()

    def begin(self) -> None:
        """See `FrameFeed`."""

    def take(self, stop: threading.Event) -> GrabbedFrame | None:
        """See `FrameFeed`. Raises FrameTimeoutError at the film's end."""
        film = self._film
        if film is None:
            return None
        try:
            data, _ = film.grabbed()
        except DeviceGoneError as error:
            message = f"{self._label}: the film is over after {film.number + 1} frames; arm the camera to begin it anew"
            raise FrameTimeoutError(message) from error
        start_ns = self.begun_ns + self._position_ns(film)
        while (left_ns := start_ns + self._exposure_ns - time.monotonic_ns()) > 0:
            if stop.wait(left_ns / 1e9):
                return None
        return GrabbedFrame(data, ExposureInterval(start_ns, start_ns + self._exposure_ns), film.number)

    def pause(self) -> None:
        """See `FrameFeed`."""

    def release(self) -> None:
        """See `FrameFeed`."""
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
        It is not there, or does not answer.
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

    # A pipe that nobody writes to cannot be opened, nor can the attempt be broken off.
    threading.Thread(target=attempt, name="slrig-opencv-open", daemon=True).start()
    if not done.wait(OPEN_LIMIT_S):
        given_up.set()
        message = f"{source.label} did not open within {OPEN_LIMIT_S:g} s; check that its other end is there"
        raise DeviceGoneError(message)
    capture = found[0]
    if isinstance(capture, cv2.error):
        message = f"{source.label}: OpenCV cannot open it: {capture.err}; check backend and device in the rig file"
        raise DeviceError(message) from capture
    if not capture.isOpened():
        capture.release()
        if "://" in str(source.target):
            message = f"nobody answers at {source.label}, or what is sent there is no video; check address and network"
            raise DeviceGoneError(message)
        message = (
            f"{source.label}: OpenCV cannot open it: it is no camera or film, or none of its formats is known to OpenCV"
            "; name another, or use the driver made for it"
        )
        raise DeviceError(message)
    return capture


_KEPT = 8
_JOIN_S = 1.0


class FrameReader:
    """Reads a feed in a thread of its own, and keeps the newest frames. The other methods belong to the camera."""

    def __init__(self, feed: FrameFeed, name: str) -> None:
        self._feed = feed
        self._name = name
        self._came = threading.Condition()
        self._frames: deque[GrabbedFrame] = deque(maxlen=_KEPT)
        self._fault: Exception | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._let_go = False
        self._released = threading.Lock()

    def start(self) -> None:
        """Begin to read. Frames from before are forgotten."""
        self.forget()
        self._fault = None
        # Its own: a thread that was left behind must not come to life again.
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> bool:
        """Read no more. False if OpenCV does not return: the thread ends when it does."""
        self._stop.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN_S)
            if thread.is_alive():
                return False
        self._thread = None
        self.forget()
        return True

    def close(self) -> None:
        """Stop, and let the source go, by the thread itself if it does not return in time. Wakes who waits."""
        with self._came:
            self._let_go = True
            self._came.notify_all()
        if self.stop():
            self._release()

    def forget(self) -> None:
        """Throw away what was read so far."""
        with self._came:
            self._frames.clear()

    @property
    def fault(self) -> Exception | None:
        """Why reading ended."""
        return self._fault

    def next(self, until_ns: int) -> GrabbedFrame | None:
        """Return the oldest frame that is kept, waiting for it; None at `until_ns`, or when the source is let go.

        Raises whatever ended the reading.
        """
        with self._came:
            while not self._frames:
                if self._fault is not None:
                    raise self._fault
                left_s = (until_ns - time.monotonic_ns()) / 1e9
                if self._let_go or left_s <= 0:
                    return None
                self._came.wait(left_s)
            return self._frames.popleft()

    def _run(self, stop: threading.Event) -> None:
        try:
            self._feed.begin()
            while not stop.is_set():
                taken = self._feed.take(stop)
                if taken is not None and not stop.is_set():
                    with self._came:
                        self._frames.append(taken)
                        self._came.notify_all()
        except Exception as error:  # noqa: BLE001 - OpenCV raises errors of its own, too; who reads is told
            with self._came:
                self._fault = error
                self._came.notify_all()
        finally:
            self._feed.pause()
            if self._let_go:
                self._release()

    def _release(self) -> None:
        with self._released:
            self._feed.release()
