"""Where frames come from, one class per kind of source: each is opened, read by one thread, and let go once."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
from numpy.typing import NDArray

from drivers.opencv import kernel
from drivers.opencv.options import Source
from drivers.opencv.timing import Arrivals, Grabbed, Sleep, by_stamp, is_of_this_clock
from drivers.v4l2.timing import Exposure
from slrig.errors import DeviceError, DeviceGoneError, FrameTimeoutError, UnsupportedByDeviceError

OPEN_LIMIT_S = 10.0
_FEW_BUFFERS = 4
_RETRY_S = 0.01
_AT_ONCE_NS = 500_000_000
_DEAD_NS = 2_000_000_000  # of grabs that fail at once, one after the other


@dataclass(frozen=True, slots=True)
class Taken:
    """One frame as OpenCV gave it. exposed : None where nothing tells when. number, lost : of the source, so far."""

    data: NDArray[Any]
    exposed: Exposure | None
    number: int
    lost: int = 0


class Feed(Protocol):
    """A source of frames. `begin`, `take` and `pause` belong to the thread that reads it."""

    def begin(self) -> None:
        """Get ready to be read by the calling thread."""
        ...

    def take(self, stop: threading.Event) -> Taken | None:
        """Return the next frame; None for one that is none, or when `stop` is set. Raises SlrigError at the end."""
        ...

    def pause(self) -> None:
        """Be read no more, for now."""
        ...

    def release(self) -> None:
        """Let the source go. Idempotent."""
        ...


class _Opened:
    """An open `cv2.VideoCapture`, read with a stop-watch."""

    def __init__(self, capture: cv2.VideoCapture, label: str) -> None:
        self.capture = capture
        self.label = label
        self.number = -1
        self._sleep: Sleep | None = None

    def begin(self) -> None:
        """See `Feed`."""
        self._sleep = Sleep()

    def grabbed(self) -> tuple[NDArray[Any], Grabbed]:
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
        return data, Grabbed(asked_ns, returned_ns, returned_ns - asked_ns - awake_ns)

    def pause(self) -> None:
        """See `Feed`."""
        if self._sleep is not None:
            self._sleep.close()
            self._sleep = None

    def release(self) -> None:
        """See `Feed`."""
        self.capture.release()


class DeviceFeed(_Opened):
    """A camera of the kernel's. `exposure_ns` is set before it is read.

    arrivals : the rule in place of the kernel's stamps, where these are not trusted.
    """

    def __init__(self, capture: cv2.VideoCapture, label: str, period_ns: int, arrivals: Arrivals | None) -> None:
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
        """See `Feed`."""
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

    def take(self, stop: threading.Event) -> Taken | None:
        """See `Feed`. None for a frame whose stamp has not advanced: a repeated one."""
        asked_ns = time.monotonic_ns()
        try:
            data, grabbed = self.grabbed()
        except DeviceGoneError as error:
            # OpenCV gives up on a camera that is silent for long in the same words as on one that is not there, or on
            # one whose stream has died; but on that at once.
            kernel.require_present(self.label, error)
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
            return Taken(data, self.arrivals.exposed(grabbed), self.number)
        stamp_ns = round(self.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if not is_of_this_clock(stamp_ns, grabbed):
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
        exposed = by_stamp(stamp_ns, grabbed, exposure_ns=self.exposure_ns, period_ns=self.period_ns)
        return Taken(data, exposed, self.number + self._lost, self._lost)


class LiveFeed(_Opened):
    """A source whose frames tell their arrival only."""

    def __init__(self, capture: cv2.VideoCapture, label: str, arrivals: Arrivals) -> None:
        super().__init__(capture, label)
        self.arrivals = arrivals

    def take(self, stop: threading.Event) -> Taken | None:
        """See `Feed`."""
        del stop
        data, grabbed = self.grabbed()
        return Taken(data, self.arrivals.exposed(grabbed), self.number)


class FilmFeed:
    """A film: its frames are given when their exposure has ended, counted from `begun_ns`."""

    def __init__(self, open_film: Callable[[], cv2.VideoCapture], source: Source) -> None:
        self._open_film = open_film
        self._label = source.label
        self._exposure_ns = round((source.options.source_exposure_s or 0) * 1e9)
        self._rate_hz = source.options.frame_rate_hz
        self._film: _Opened | None = None
        self.begun_ns = 0

    def rewind(self) -> None:
        """Begin the film anew, now. Before `begin`, and by the camera's own thread. Raises as `opened` does."""
        self.release()
        self._film = _Opened(self._open_film(), self._label)
        self.begun_ns = time.monotonic_ns()

    def begin(self) -> None:
        """See `Feed`."""

    def take(self, stop: threading.Event) -> Taken | None:
        """See `Feed`. Raises FrameTimeoutError at the film's end."""
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
        return Taken(data, Exposure(start_ns, start_ns + self._exposure_ns), film.number)

    def pause(self) -> None:
        """See `Feed`."""

    def release(self) -> None:
        """See `Feed`."""
        if self._film is not None:
            self._film.release()
            self._film = None

    def _position_ns(self, film: _Opened) -> int:
        if self._rate_hz is not None:
            return round(film.number / self._rate_hz * 1e9)
        return round(film.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)


def opened(source: Source, parameters: Sequence[int] = ()) -> cv2.VideoCapture:
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
        kernel.require_free(source.label)
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
