"""Streaming capture: free-running cameras are read while patterns change as fast as the cameras allow.

A pattern stays until every camera must have exposed a frame within its light, as predicted from its time stamps. The
next pattern is requested in advance by the known delay of its light. Each frame is assigned to the pattern whose light
contains its whole exposure, by its time stamp alone, between two measured bounds:

    the pattern's own light is whole  ≤  start of the first row,    end of the last row  ≤  the next light begins.

`slrig latency` measures both bounds with the same time stamps. A pattern without such a frame of a camera (it was lost,
damaged, or later than predicted) is shown again and stays until its frame has come.
"""

from __future__ import annotations

import math
import queue
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from slrig.capture.latency import shutter_skew_s, stable_from_ns
from slrig.capture.retries import RetryPolicy
from slrig.capture.triggering import CaptureSession, with_camera_name
from slrig.devices import Camera, Clock, DisplayedPattern, Rig, Trigger
from slrig.errors import FrameTimeoutError, of_camera
from slrig.model import Frame, Shot

MAX_UNPAIRED = 12
"""Maximum number of patterns without frames before the display waits. Cameras and links buffer some frames, but a
camera may also have stopped."""

_MAX_REMEMBERED = 24  # frames to estimate the period from, just under a second at 30 frames per second
_MIN_FRAMES = 3  # to estimate the period; with fewer, the stated period is used

_STATED_PERIOD_ERROR = 0.1
"""Relative error of a stated period. Time stamps of webcams scatter by about a millisecond; if the period is wrong, one
pattern is shown again."""

_SPARE_SIGMAS = 2.0
"""Tolerance of predictions in standard deviations of the time stamps. One frame in twenty is outside and its pattern is
shown again, which costs less than a larger tolerance for every pattern."""

_MAX_JITTER = 0.25  # standard deviation of the time stamps, in periods, for a prediction
_READ_TIMEOUT_S = 0.25  # of one read, after which a reader checks if it was stopped
_CHECK_TIME_S = 0.012  # to leave before a pattern is due; checking a frame of 1280 x 1024 takes about 8 ms
_POLL_S = 0.05  # between checks for a cancellation or overdue frames
_MAX_PAIRED = 8  # frames that may wait to be checked before the next pattern

Arrival = tuple[str, Frame | Exception | None]
"""A camera's name in its rig, and its next frame or the exception of its driver; None once it is armed."""


class Cadence:
    """Predicts the frames of one camera from its previous ones. stated_s : period stated by the camera, or None."""

    def __init__(self, stated_s: float | None = None) -> None:
        self._starts: deque[tuple[int, int]] = deque(maxlen=_MAX_REMEMBERED)
        self._stated_ns = None if stated_s is None else stated_s * 1e9

    def add(self, frame: Frame) -> None:
        """Add a frame."""
        if self._starts and frame.sequence_number <= self._starts[-1][0]:
            self._starts.clear()
        self._starts.append((frame.sequence_number, frame.t_start_ns))

    def start_after(self, t_ns: int) -> tuple[int, int] | None:
        """Return the start of the first frame that certainly begins at `t_ns` or later, and how much later it may be,
        ns.

        None if too few frames are known, or their period varies too much. The prediction is a least-squares line
        through the frames' sequence numbers and starts; numbers allow for lost frames.
        """
        if not self._starts:
            return None
        numbers, starts_ns = np.array(self._starts, np.int64).T
        last, latest_ns = int(numbers[-1]), int(starts_ns[-1])
        if len(self._starts) >= _MIN_FRAMES:
            x, y = (numbers - last).astype(np.float64), (starts_ns - latest_ns).astype(np.float64)
            slope, offset = np.polyfit(x, y, 1)
            jitter_ns = float(np.std(y - slope * x - offset))
            if slope <= 0 or jitter_ns > _MAX_JITTER * slope:
                return None
            begun_ns, spare_ns = latest_ns + offset, _SPARE_SIGMAS * jitter_ns
        elif self._stated_ns is not None:
            slope, begun_ns, spare_ns = self._stated_ns, latest_ns, _STATED_PERIOD_ERROR * self._stated_ns
        else:
            return None
        ahead = max(math.ceil((t_ns + spare_ns - begun_ns) / slope), 1)
        return round(begun_ns + ahead * slope), round(spare_ns)


class FrameReader:
    """Arms several cameras to run freely, and reads every frame of them, each on its own thread, until it is stopped.

    All are started at the same moment: that takes as long as the slowest, and cameras of one model run nearly in phase,
    so that a pattern need not wait for one after the other. Meanwhile no other thread may call these cameras. An
    exception of a driver ends the thread of its camera; missing frames are ignored.
    """

    def __init__(self, cameras: Mapping[str, Camera], clock: Clock) -> None:
        self._cameras, self._clock = cameras, clock
        self._arrived: queue.SimpleQueue[Arrival] = queue.SimpleQueue()
        self._came, self._stopped = threading.Event(), threading.Event()
        self._threads: list[tuple[threading.Thread, threading.Event]] = []

    def start(self, count: int) -> None:
        """Arm the cameras for `count` frames, and read."""
        for name, camera in self._cameras.items():
            ended = threading.Event()
            thread = threading.Thread(
                target=self._read, args=(name, camera, count, ended), name=f"slrig-frames of {name}", daemon=True
            )
            self._threads.append((thread, ended))
            thread.start()

    def next(self, timeout_s: float) -> Arrival | None:
        """Return what came next of any camera, in the order of arrival; None after the time-out, by the rig's clock."""
        self._came.clear()
        if self._arrived.empty():
            self._clock.wait_until(self._clock.now_ns() + round(timeout_s * 1e9), self._came)
        try:
            return self._arrived.get_nowait()
        except queue.Empty:
            return None

    def stop(self) -> None:
        """Stop reading, and return when no thread uses a camera. Idempotent."""
        self._stopped.set()
        for thread, ended in self._threads:
            while not ended.is_set():
                self._clock.wait_until(self._clock.now_ns() + round(_READ_TIMEOUT_S * 1e9), ended)
            thread.join()
        self._threads.clear()

    def _read(self, name: str, camera: Camera, count: int, ended: threading.Event) -> None:
        try:
            camera.arm(count, Trigger.FREE)
            self._put(name, None)
            while not self._stopped.is_set():
                with suppress(FrameTimeoutError):
                    self._put(name, camera.read(0, _READ_TIMEOUT_S))
        except Exception as error:  # noqa: BLE001 - raised again on the capturing thread
            self._put(name, error)
        finally:
            ended.set()

    def _put(self, name: str, came: Frame | Exception | None) -> None:
        self._arrived.put((name, came))
        self._came.set()


def earliest_change_s(rig: Rig, triggers: dict[str, Trigger]) -> float | None:
    """Return the earliest change of light after the instant stated by the projector, s, if frames can be assigned by
    it: all cameras are real and run freely, and latency was measured. None otherwise.
    """
    free = all(trigger is Trigger.FREE for trigger in triggers.values())
    computed = any(camera.info.limits.computed for camera in rig.cameras.values())
    return rig.synchronisation.earliest_s if rig.synchronisation is not None and free and not computed else None


@dataclass(slots=True)
class _Display:
    """One display of a pattern, and the cameras without a frame of it.

    stable_ns : start of its complete light. end_ns : earliest start of the next light; None while it is displayed. held
    : True if it stays until all frames have come.
    """

    displayed: DisplayedPattern
    stable_ns: int
    missing: list[str]
    held: bool
    end_ns: int | None = None


@dataclass(slots=True)
class _DisplayLead:
    """How much earlier than its light a pattern may be requested, without the light beginning too early.

    A display takes an image at its next refresh and then returns, so the wait for the refresh, up to `refresh_ns`, is
    not included. Over several patterns: the longest certain value, limited by the shortest possible one.
    """

    refresh_ns: int
    certain_ns: int = 0
    possible_ns: int | None = None

    def add(self, requested_ns: int, returned_ns: int, begins_ns: int) -> None:
        """Add a pattern that was displayed. begins_ns : earliest start of its light."""
        possible_ns = max(begins_ns - requested_ns, 0)
        self.possible_ns = possible_ns if self.possible_ns is None else min(possible_ns, self.possible_ns)
        self.certain_ns = max(self.certain_ns, possible_ns - min(returned_ns - requested_ns, self.refresh_ns))

    @property
    def ns(self) -> int:
        """Lead in ns; 0 before the first pattern."""
        return min(self.certain_ns, self.possible_ns or 0)


@dataclass(slots=True)
class _CameraStreamState:
    """State of one camera. waiting : frames whose pattern is still displayed, each with its fault or None."""

    shutter_skew_ns: int
    cadence: Cadence
    last: Frame | None = None
    waiting: list[tuple[Frame, str | None]] = field(default_factory=list)

    def end_ns(self, frame: Frame) -> int:
        """Return the end of the last row's exposure, with the measured skew if the driver does not know it."""
        return frame.t_end_ns + max(self.shutter_skew_ns - round(frame.shutter_skew_s * 1e9), 0)


def capture_streaming(
    session: CaptureSession, retries: RetryPolicy, reader: FrameReader, earliest_s: float
) -> Iterator[Shot]:
    """Show each pattern, and again if frames fail, until every frame counts. The caller stops the reader.

    earliest_s : see `earliest_change_s`. Raises as `RetryPolicy` does, and the exceptions of the cameras' drivers.
    """
    reader.start(retries.max_exposures)
    # While the cameras start.
    session.rig.projector.load(session.sequence)
    yield from _StreamingCapture(session, retries, reader, round(earliest_s * 1e9)).shots()


class _StreamingCapture:
    """State of one streaming capture."""

    def __init__(self, session: CaptureSession, retries: RetryPolicy, reader: FrameReader, earliest_ns: int) -> None:
        self._session = session
        self._earliest_ns = earliest_ns
        self._retries = retries
        self._reader = reader
        self._clock = session.rig.clock
        self._camera_states = {
            name: _CameraStreamState(
                round(shutter_skew_s(camera, name, session.rig.synchronisation) * 1e9),
                Cadence(applied.min_period_s if (applied := session.applied.get(name)) else None),
            )
            for name, camera in session.rig.cameras.items()
        }
        self._starting = set(self._camera_states)
        self._displays: deque[_Display] = deque()
        self._paired: deque[tuple[int, Frame, str | None]] = deque()
        self._lead = _DisplayLead(round((session.rig.projector.info.refresh_s or 0.0) * 1e9))
        self._index = 0
        self._current: _Display | None = None

    def shots(self) -> Iterator[Shot]:
        """See `capture_streaming`."""
        while self._starting:
            self._session.stop_if_cancelled(0)
            self._receive_next(_POLL_S)
        retries = self._retries
        remaining_indices = iter(range(len(self._session.sequence)))
        while True:
            held = False
            if retries.pending:
                # Failed patterns come first, in order.
                index = min(retries.pending)
                names = retries.pending.pop(index)
                held = any(retries.holds(name, index) for name in names)
            elif (index := next(remaining_indices, -1)) >= 0:
                names = list(self._camera_states)
            elif self._displays or self._paired:
                yield from self._process_until_due(last=True)
                continue
            else:
                return
            self._show(index, names, held=held)
            yield from self._process_until_due(last=False)

    def _show(self, index: int, names: list[str], *, held: bool) -> None:
        self._index = index
        self._session.stop_if_cancelled(index)
        requested_ns = self._clock.now_ns()
        displayed = self._session.rig.projector.show(index)
        returned_ns = self._clock.now_ns()
        stable_ns = stable_from_ns(displayed, self._session.rig.synchronisation)
        begins_ns = displayed.t_visible_ns + self._earliest_ns
        if self._current is not None:
            self._current.end_ns = begins_ns
        self._lead.add(requested_ns, returned_ns, begins_ns)
        for name in names:
            self._retries.start_exposure(name, index)
        self._current = _Display(displayed, stable_ns, list(names), held)
        self._displays.append(self._current)

    def _process_until_due(self, *, last: bool) -> Iterator[Shot]:
        """Assign and check frames until the next pattern is due. last : there is none, unless a frame fails.

        A late pattern delays the whole capture, while frames can wait to be checked.
        """
        while True:
            self._session.stop_if_cancelled(self._index)
            self._assign_frames()
            due_ns = self._due_ns(last=last)
            left_s = _POLL_S if due_ns is None else (due_ns - self._clock.now_ns()) / 1e9
            if self._paired and (left_s > _CHECK_TIME_S or len(self._paired) > _MAX_PAIRED):
                shot = self._retries.submit(*self._paired.popleft())
                if shot is not None:
                    yield shot
            elif left_s <= 0:
                return
            else:
                self._receive_next(min(left_s, _POLL_S))

    def _due_ns(self, *, last: bool) -> int | None:
        """Return when to request the next pattern; None if that depends on frames that are not yet received or
        checked.
        """
        if last:
            is_idle = self._current is None or not self._current.missing
            return 0 if not self._paired and (not self._displays or (self._retries.pending and is_idle)) else None
        if len(self._displays) > MAX_UNPAIRED:
            return None
        display = self._current
        if display is None:
            return 0
        if display.held:
            # Check the repeated frames before anything else is displayed.
            return None if display.missing or self._paired else 0
        return self._predict_due_ns(display)

    def _predict_due_ns(self, display: _Display) -> int | None:
        """Return when to request the next pattern so that its light begins after a frame of each camera that lacks
        one.
        """
        due_ns = 0
        for name in display.missing:
            state = self._camera_states[name]
            shift_ns = 0 if state.last is None else self._session.stamp_shift_ns(state.last)
            predicted = state.cadence.start_after(display.stable_ns + shift_ns)
            if predicted is None or state.last is None:
                return None
            start_ns, spare_ns = predicted
            span_ns = state.end_ns(state.last) + shift_ns - state.last.t_start_ns
            due_ns = max(due_ns, start_ns + spare_ns + span_ns - self._lead.ns)
        return due_ns

    def _receive_next(self, timeout_s: float) -> None:
        arrival = self._reader.next(timeout_s)
        if arrival is None:
            return
        name, came = arrival
        if isinstance(came, Exception):
            with of_camera(name):
                raise came
        if came is None:
            self._starting.remove(name)
            return
        frame = with_camera_name(name, came)
        state = self._camera_states[name]
        state.waiting.append((frame, self._session.frame_fault(frame, frame.t_start_ns, state.last)))
        state.cadence.add(frame)
        state.last = frame

    def _assign_frames(self) -> None:
        """Assign the frames that wait, and find the patterns whose frames are lost."""
        now_ns = self._clock.now_ns()
        for name, state in self._camera_states.items():
            remaining: list[tuple[Frame, str | None]] = []
            for frame, fault in state.waiting:
                # The last pattern whose light was complete when the frame began.
                shift_ns = self._session.stamp_shift_ns(frame)
                begin_ns = frame.t_start_ns - shift_ns
                display = next((each for each in reversed(self._displays) if begin_ns >= each.stable_ns), None)
                if display is None:
                    continue
                end_ns = display.end_ns
                if end_ns is None:
                    # The next pattern is requested after now, so its light begins later than this.
                    end_ns = now_ns + min(self._earliest_ns, 0)
                    if state.end_ns(frame) + shift_ns > end_ns:
                        remaining.append((frame, fault))
                        continue
                if name in display.missing and state.end_ns(frame) + shift_ns <= end_ns:
                    display.missing.remove(name)
                    self._paired.append((display.displayed.index, frame, fault))
            state.waiting = remaining
        for display in list(self._displays):
            self._report_missing(display, now_ns)
            if not display.missing:
                self._displays.remove(display)

    def _report_missing(self, display: _Display, now_ns: int) -> None:
        """Request a pattern again for the cameras whose frame was lost or is overdue."""
        for name in list(display.missing):
            last = self._camera_states[name].last
            if display.end_ns is not None and last is not None and last.t_start_ns >= display.end_ns:
                cause = (
                    "no frame was exposed within its light: one was lost or damaged, or came later than predicted; the "
                    "pattern is shown until a frame has come"
                )
            elif now_ns - display.stable_ns > self._session.frame_timeout_s(name) * 1e9:
                cause = (
                    f"no frame came within {self._session.frame_timeout_s(name):.3f} s of its light, visible since "
                    f"{display.displayed.t_visible_ns} ns ± {display.displayed.t_err_ns} ns; check the camera's cable, "
                    "bandwidth and trigger"
                )
            else:
                continue
            display.missing.remove(name)
            self._retries.report_missing(name, display.displayed.index, cause)
