"""One arming of a camera: its stream, its frames in order, and which of them are passed over."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from drivers.genicam.connection import GenICamConnection, GenICamStream, RawFrame
from drivers.genicam.options import GenICamCameraOptions
from drivers.genicam.pixels import PfncFormat, decode_pixels
from drivers.genicam.timing import (
    Arrival,
    FrameNumbers,
    Interval,
    StartClock,
    TriggeredStarts,
    UntriggeredStarts,
)
from slrig.devices import AppliedSettings, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame, Pixels, Size

_SLICE_S = 0.05
_LATCHES = 5
_TIE_AGAIN_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class _TimedFrame:
    """A sound frame, in colour too where there is any, and when its exposure began."""

    image: Pixels
    colour: Callable[[], Pixels] | None
    number: int
    start: Interval


class Acquisition:
    """An armed camera. One thread uses it.

    Parameters
    ----------
    connection
        The open device, set up.
    options, form, size
        What was set.
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
        self._passed = dict.fromkeys(("stale", "corrupt", "repeated", "unasked"), 0)
        self.trigger = Trigger.FREE
        self._applied = AppliedSettings(0.0, 0.0)
        self._exposure_ns = 0

    def begin(self, trigger: Trigger, applied: AppliedSettings, buffers: int) -> None:
        """Open the stream, give it `buffers` buffers, tie the camera's clock, and start."""
        self.trigger = trigger
        self._applied = applied
        self._exposure_ns = round(applied.exposure_s * 1e9)
        self._clock = StartClock(self._lag_ns())
        self._count_from_here()
        self._stamped = self._options.time_stamp != "none" and self._connection.has_stamps
        self._tied_ns = 0
        self._tie(_LATCHES)
        self._stream = self._connection.start(buffers)

    def end(self) -> None:
        """Stop, whatever state the camera is in."""
        if self._stream is not None:
            stream, self._stream = self._stream, None
            stream.end()

    def triggered(self, begun_ns: int, ended_ns: int, *, times: int) -> None:
        """Note a software trigger, and how often it may have been sent."""
        self._asked.triggered(begun_ns, ended_ns, times=times)

    def owed(self) -> bool:
        """Whether the answer to a software trigger may still come."""
        return self._asked.owed_ns(time.monotonic_ns()) > 0

    def settle(self) -> None:
        """Wait until no answer to a software trigger is due: a camera that exposes ignores the next trigger."""
        while (left_ns := self._asked.owed_ns(time.monotonic_ns())) > 0 and not self._connection.is_lost:
            self._take(left_ns / 1e9)

    def drain(self, seconds: float) -> None:
        """Pass over what comes without being asked for, for so long."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not self._connection.is_lost:
            self._take(left_s)
        self._count_from_here()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `slrig.devices.Camera`."""
        if self.trigger is not Trigger.SOFTWARE and time.monotonic_ns() - self._tied_ns > _TIE_AGAIN_NS:
            self._tie(2)
        deadline_s = time.monotonic() + timeout_s
        self._passed = dict.fromkeys(self._passed, 0)
        while True:
            while self._waiting:
                exposed = self._waiting.popleft()
                # Wire-triggered frames are told apart by their order.
                follows = self.trigger is Trigger.HARDWARE and after_ns <= self._last_end_ns
                if exposed.start.least_ns >= after_ns or follows:
                    return self._frame(exposed)
                self._passed["stale"] += 1
            left_s = deadline_s - time.monotonic()
            if self._take(left_s):
                continue
            if self._connection.is_lost:
                raise self._connection.gone("waiting for a frame")
            if left_s <= 0:
                raise self._late(after_ns, timeout_s)

    def _count_from_here(self) -> None:
        """The next frame is number 0, and nothing has been asked for."""
        answer_ns, transfer_ns = round(self._options.answer_s * 1e9), round(self._options.transfer_s * 1e9)
        self._asked = TriggeredStarts(self._exposure_ns, answer_ns, self._clock)
        self._unasked = UntriggeredStarts(self._exposure_ns, transfer_ns, self._clock)
        self._numbers = FrameNumbers()
        self._good = 0
        self._waiting.clear()

    def _take(self, most_s: float) -> bool:
        """Take one frame from the stream and judge it, waiting for it no longer than a slice; False: none came."""
        delivery = None if self._stream is None else self._stream.take(min(most_s, _SLICE_S))
        if delivery is not None:
            self._judge(delivery)
        return delivery is not None

    def _judge(self, delivery: RawFrame) -> None:
        number = self._numbers.next(delivery.block_id)
        pictures = self._pictures(delivery)
        if pictures is None:
            self._passed["corrupt"] += 1
            return
        if number is None:
            self._passed["repeated"] += 1
            return
        self._good += 1
        stamp_ns = delivery.stamp_ns if self._stamped else 0
        arrival = Arrival(number, stamp_ns or None, delivery.arrived_ns)
        start = self._asked.start(arrival) if self.trigger is Trigger.SOFTWARE else self._unasked.start(arrival)
        if start is None:
            self._passed["unasked"] += 1
            return
        self._waiting.append(_TimedFrame(*pictures, number, start))

    def _frame(self, exposed: _TimedFrame) -> Frame:
        start = exposed.start
        t_start_ns = (start.least_ns + start.most_ns) // 2
        # What a camera began it ended before it began anew.
        t_start_ns = min(max(t_start_ns, self._last_end_ns), start.most_ns)
        self._last_end_ns = t_start_ns + self._exposure_ns
        return Frame(
            camera=self._connection.name,
            image=exposed.image,
            t_start_ns=t_start_ns,
            t_end_ns=self._last_end_ns,
            t_err_ns=max(start.most_ns - t_start_ns, t_start_ns - start.least_ns),
            sequence_number=exposed.number,
            dropped_count=self._numbers.made - self._good,
            exposure_s=self._applied.exposure_s,
            gain=self._applied.gain,
            colour=exposed.colour,
        )

    def _pictures(self, delivery: RawFrame) -> tuple[Pixels, Callable[[], Pixels] | None] | None:
        """The image, and what makes it in colour, or None if packets are missing or it is not what was set."""
        image = delivery.image
        if image is None or image.size != self._size:
            return None
        made = partial(decode_pixels, image.data, self._form, self._size, padding_bytes=image.padding_bytes)
        try:
            return made(), partial(made, in_colour=True) if self._form.mosaic else None
        except ValueError:
            return None

    def _late(self, after_ns: int, timeout_s: float) -> FrameTimeoutError:
        # A camera that is gone and has not been missed yet does not answer: that is another error.
        with self._connection.asking("asking whether it is there") as camera:
            camera.get_exposure_time()
        passed = ", ".join(f"{count} {kind}" for kind, count in self._passed.items() if count) or "none"
        remedy = {
            Trigger.FREE: "check the frame rate and the network's load",
            Trigger.SOFTWARE: "trigger after the pattern is shown, and wait for the exposure",
            Trigger.HARDWARE: "check the trigger's cable, level and edge",
        }[self.trigger]
        message = (
            f"camera '{self._connection.name}': no frame that began after {after_ns} ns came in {timeout_s} s "
            f"({self.trigger} trigger; passed over: {passed}); {remedy}"
        )
        return FrameTimeoutError(message)

    def _lag_ns(self) -> Interval:
        """By how much a time stamp is later than the start of its exposure."""
        least_ns = self._exposure_ns if self._options.time_stamp == "exposure_end" else 0
        return Interval(least_ns, 0 if self._options.time_stamp == "exposure_start" else self._exposure_ns)

    def _tie(self, looks: int) -> None:
        """Latch the camera's clock, if it has one that can be."""
        self._tied_ns = time.monotonic_ns()
        if not self._stamped:
            return
        latches = [latch for latch in (self._connection.latch() for _ in range(looks)) if latch is not None]
        if len(latches) == looks:
            self._clock.latch(latches)
