"""The thread that reads a source all the time, so that a frame's arrival is known, and no queue grows."""

from __future__ import annotations

import threading
import time
from collections import deque

from drivers.opencv.feeds import Feed, Taken

_KEPT = 8
_JOIN_S = 1.0


class Reader:
    """Reads a feed in a thread of its own, and keeps the newest frames. The other methods belong to the camera."""

    def __init__(self, feed: Feed, name: str) -> None:
        self._feed = feed
        self._name = name
        self._came = threading.Condition()
        self._frames: deque[Taken] = deque(maxlen=_KEPT)
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

    def next(self, until_ns: int) -> Taken | None:
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
