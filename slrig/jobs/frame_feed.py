"""Frames on their way to the reconstruction process while they are taken.

The recorded bundle is what counts; this is only a head start. So whoever captures is never held up: frames wait in a
queue of bounded size, and when that is full, or the other process is gone, no more are sent and the reconstruction
reads the bundle instead.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import structlog

from slrig.capture import EvidenceSummary
from slrig.model import Calibration, CaptureHeader, Region, Shot

LEAST_WAITING_BYTES, MOST_WAITING_BYTES = 128 * 2**20, 512 * 2**20
"""How much of frames may wait for the reconstruction: a whole scan of a common camera where there is little memory, and
where there is more, 40 frames of 12 megapixels: a line frame of those takes the reconstruction longer than the camera.
"""
_SHARE_OF_MEMORY = 1 / 16

_log = structlog.get_logger(__name__)


def most_waiting_bytes() -> int:
    """The bytes of frames that may wait on this machine."""
    if "SC_PHYS_PAGES" not in getattr(os, "sysconf_names", {}):
        return LEAST_WAITING_BYTES
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min(max(int(memory * _SHARE_OF_MEMORY), LEAST_WAITING_BYTES), MOST_WAITING_BYTES)


@dataclass(frozen=True, slots=True)
class Begin:
    """Frames of this header will come, and then what they have proven. region : what of the scene is asked for."""

    header: CaptureHeader
    calibration: Calibration
    region: Region | None = None


@dataclass(frozen=True, slots=True)
class Abandon:
    """Forget the frames that came."""


class FrameSink(Protocol):
    """Is shown the frames of a capture as they are taken."""

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        """Take note of what will come."""
        ...

    def take(self, shot: Shot) -> None:
        """Take a frame that has passed its test. Returns at once. One that comes again takes the place of the first."""
        ...

    def end(self, evidence: EvidenceSummary) -> None:
        """Take note that all frames have come."""
        ...


class FrameFeed:
    """Sends the frames of one capture to the reconstruction process, on a thread of its own.

    send : sends one message, and returns False when nobody receives it any more; it may block. number : of the task
    that will use the frames. receiver : what they are sent to, by which the task's process is known. region : what of
    the scene is asked for. `evidence` is what the frames have proven once all have come, whether they were sent or not.
    """

    def __init__(
        self,
        send: Callable[[object], bool],
        *,
        number: int = 0,
        receiver: object = None,
        region: Region | None = None,
        most_bytes: int | None = None,
    ) -> None:
        self.number = number
        self.receiver = receiver
        self.evidence: EvidenceSummary | None = None
        self._send = send
        self._region = region
        self._most_bytes = most_waiting_bytes() if most_bytes is None else most_bytes
        self._waiting: queue.Queue[Begin | Shot | EvidenceSummary | Abandon] = queue.Queue()
        self._taken: set[tuple[int, str, float | None]] = set()
        self._given_up = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        """Start the thread. Without a calibration nothing can be reconstructed, and nothing is sent."""
        if calibration is None:
            self.abandon()
            return
        self._waiting.put(Begin(header, calibration, self._region))
        self._thread = threading.Thread(target=self._carry, name="slrig-feed", daemon=True)
        self._thread.start()

    def take(self, shot: Shot) -> None:
        """Queue a frame. With too many waiting, or when it takes another one's place, give up."""
        which = (shot.pattern, shot.camera, shot.exposure_s)
        again = which in self._taken
        self._taken.add(which)
        if self._given_up.is_set():
            return
        if again:
            # What was concluded from the first one cannot be taken back.
            _log.info("a frame was shot again; the reconstruction will read the bundle", pattern=shot.pattern)
            self.abandon()
        elif (self._waiting.qsize() + 1) * shot.image.nbytes > self._most_bytes:
            _log.info("the reconstruction falls behind the capture; it will read the bundle")
            self.abandon()
        else:
            self._waiting.put(shot)

    def end(self, evidence: EvidenceSummary) -> None:
        """Queue the end."""
        self.evidence = evidence
        self._waiting.put(evidence)

    def abandon(self) -> None:
        """Send no more, and have what was sent forgotten. After the end has been sent this does nothing."""
        self._given_up.set()
        self._waiting.put(Abandon())

    def settled(self, timeout_s: float) -> bool:
        """Wait at most so long; return whether nothing more will be sent."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return self._thread is None or not self._thread.is_alive()

    @property
    def whole(self) -> bool:
        """Whether every frame was sent, and the end."""
        return self._ended.is_set()

    def _carry(self) -> None:
        while True:
            message = self._waiting.get()
            if self._given_up.is_set():
                self._waiting = queue.Queue()  # lets the frames go
                self._send(Abandon())
                return
            if not self._send(message):
                self._given_up.set()
                return
            if isinstance(message, EvidenceSummary):
                self._ended.set()
                return


class FedFrames:
    """The other end: the frames of the capture under way, as far as they have come. begin : makes what takes them."""

    def __init__(self, begin: Callable[..., Any]) -> None:
        self._begin = begin
        self._live: Any = None

    def hear(self, message: object) -> None:
        """Take a message of a feed. Frames that cannot be used are forgotten: reading the bundle will tell why."""
        try:
            match message:
                case Begin(header, calibration, region):
                    self._live = self._begin(header, calibration, region)
                case Shot() if self._live is not None:
                    self._live.take(message)
                case EvidenceSummary() if self._live is not None:
                    self._live.end(message)
                case Abandon():
                    self.forget()
        except Exception as error:  # noqa: BLE001 - a head start that fails is no failure of the scan
            _log.warning("frames could not be used while they were taken", cause=repr(error))
            self.forget()

    def taken(self) -> Any:
        """What has taken the frames, None when nothing has."""
        return self._live

    def forget(self) -> None:
        """Let the frames go."""
        self._live = None


class FedCaptures:
    """The frames of the captures that no task has used yet, by the number of the task: of one that is computed next,
    and one that is under way. receiver : makes what takes the frames of a capture.
    """

    def __init__(self, receiver: Callable[[], FedFrames]) -> None:
        self._receiver = receiver
        self._captures: dict[int, FedFrames] = {}

    def hear(self, number: int, message: object) -> None:
        """Take a message of a capture's feed."""
        if number not in self._captures:
            if self._captures and number < max(self._captures):
                return
            self._captures = {each: self._captures[each] for each in sorted(self._captures)[-1:]}
            self._captures[number] = self._receiver()
        self._captures[number].hear(message)

    def taken(self, number: int) -> Any:
        """What has taken the frames of a capture, None when nothing has; they are let go here."""
        frames = self._captures.pop(number, None)
        return None if frames is None else frames.taken()
