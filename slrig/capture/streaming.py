"""Streaming capture: free-running cameras are read while patterns change, at the projector's cadence.

A pattern is held until every camera must have exposed a frame within its light: their time stamps foretell when. The
next one is asked for as early before that as its light is known to take. Frames come whenever they come. Each is paired
with the pattern in whose light its whole exposure lies, by its time stamp alone, between two measured bounds:

    the pattern's own light is whole  ≤  start of the first row,    end of the last row  ≤  the next light begins.

Both are `slrig latency`'s, measured by the same time stamps. A pattern for which no frame of a camera lies between them
(the frame was lost, damaged, or came otherwise than foretold) is shown again, and then held until its frame is there.
"""

from __future__ import annotations

import math
import queue
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from slrig.capture.latency import shutter_skew_s, stable_from_ns
from slrig.capture.triggering import CaptureSession, with_camera_name
from slrig.capture.verifier import RetryPolicy
from slrig.devices import Camera, DisplayedPattern, Rig, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame, Shot

_MAX_REMEMBERED = 24
"""Frames that the period is taken from: at 30 a second, a little less than a second's."""

_MIN_FRAMES = 3
"""Frames that tell a period, and whether it can be relied on. With fewer, the camera's own word counts."""

_STATED_PERIOD_ERROR = 0.1
"""How much of the period that a camera states its next frame may come otherwise than foretold by that. Stamps of
webcams scatter by about a millisecond; where the period is wrong, one pattern is shown again."""

_SPARE_SIGMAS = 2.0
"""Standard deviations of the stamps that a frame may come otherwise than foretold. One in twenty comes otherwise still,
and is shown again: to allow for it would cost every pattern more."""

_MAX_JITTER = 0.25
"""Standard deviation of the stamps, in periods, from which on nothing is foretold."""


class Cadence:
    """Follows the frames of one camera, in order. stated_s : its period as it says itself; None where it does not."""

    def __init__(self, stated_s: float | None = None) -> None:
        self._starts: deque[tuple[int, int]] = deque(maxlen=_MAX_REMEMBERED)
        self._stated_ns = None if stated_s is None else stated_s * 1e9

    def note(self, frame: Frame) -> None:
        """Take note of a frame's number and its start."""
        if self._starts and frame.sequence_number <= self._starts[-1][0]:
            self._starts.clear()
        self._starts.append((frame.sequence_number, frame.t_start_ns))

    def start_after(self, t_ns: int) -> tuple[int, int] | None:
        """Return when the first frame begins that surely begins at `t_ns` or later, and by how much later it may, ns.

        None where too few frames are known, or they come too unevenly. The line through the frames' numbers and starts
        is one of least squares: numbers, because frames may be lost in between.
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


_READ_TIMEOUT_S = 0.25
"""How long one read may take: so soon a reader notices that it shall end, where its camera gives no frames."""

Arrival = tuple[str, Frame | Exception]
"""A camera's name in its rig, and its next frame or what its driver raised."""


class FrameReader:
    """Reads every frame of several armed cameras until it is stopped.

    Meanwhile nobody else calls these cameras: each has one thread at a time. What a driver raises ends its camera's
    thread; a frame that does not come raises nothing here.
    """

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._arrived: queue.SimpleQueue[Arrival] = queue.SimpleQueue()
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Begin to read. The cameras are armed."""
        for name, camera in self._cameras.items():
            thread = threading.Thread(
                target=self._read, args=(name, camera), name=f"slrig-frames of {name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def next(self, timeout_s: float) -> Arrival | None:
        """Return what came first of what waits, in the order of its arrival; None if nothing comes in that time."""
        try:
            return self._arrived.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def stop(self) -> None:
        """Read no more, and return when every camera is let go. Idempotent."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _read(self, name: str, camera: Camera) -> None:
        while not self._stopped.is_set():
            try:
                frame = camera.read(0, _READ_TIMEOUT_S)
            except FrameTimeoutError:
                continue
            except Exception as error:  # noqa: BLE001 - it is raised on the thread that captures
                self._arrived.put((name, error))
                return
            self._arrived.put((name, frame))


MAX_UNPAIRED = 12
"""Patterns that may have been shown without any frame of theirs: cameras and links hold back some frames, and one that
gives none must not be played to for long."""

_CHECK_TIME_S = 0.012
"""Time to leave before a pattern is due: judging takes about 8 ms for a frame of 1280 x 1024."""

_POLL_S = 0.05
"""How often to look whether the scan was cancelled, or a frame has been waited for in vain."""

_MAX_PAIRED = 8
"""Frames that may wait to be judged; beyond that they come before the next pattern."""


def earliest_change_s(rig: Rig, triggers: dict[str, Trigger]) -> float | None:
    """Return when light changes at the earliest after the instant that the projector states, s, where frames can be
    told apart by that: all cameras run freely on metal, and latency was measured. None where they cannot.
    """
    free = all(trigger is Trigger.FREE for trigger in triggers.values())
    computed = any(camera.info.limits.computed for camera in rig.cameras.values())
    return rig.synchronisation.earliest_s if rig.synchronisation is not None and free and not computed else None


@dataclass(slots=True)
class _Display:
    """A pattern that was shown, and the cameras that gave no frame of it yet.

    stable_ns : its light is whole from then on. end_ns : the light of the next one may begin then; None while it is
    shown. held : shown until its frames are there.
    """

    shown: DisplayedPattern
    stable_ns: int
    missing: list[str]
    held: bool
    end_ns: int | None = None


@dataclass(slots=True)
class _DisplayLead:
    """How much earlier than its light a pattern may be asked for, so that the light does not begin before it is due.

    A display takes a picture at its next refresh and returns then; so the wait for that, of up to `refresh_ns`, is no
    part of it. Of several patterns the longest that is sure for one and possible for all.
    """

    refresh_ns: int
    sure_ns: int = 0
    possible_ns: int | None = None

    def note(self, asked_ns: int, returned_ns: int, begins_ns: int) -> None:
        """Take note of a pattern that was shown. begins_ns : when its light begins at the earliest."""
        possible_ns = max(begins_ns - asked_ns, 0)
        self.possible_ns = possible_ns if self.possible_ns is None else min(possible_ns, self.possible_ns)
        self.sure_ns = max(self.sure_ns, possible_ns - min(returned_ns - asked_ns, self.refresh_ns))

    @property
    def ns(self) -> int:
        """Nothing before the first pattern."""
        return min(self.sure_ns, self.possible_ns or 0)


@dataclass(slots=True)
class _CameraStreamState:
    """What is known of one camera. waiting : frames whose pattern is still shown, and what each says against itself."""

    shutter_skew_ns: int
    cadence: Cadence
    last: Frame | None = None
    waiting: list[tuple[Frame, str | None]] = field(default_factory=list)

    def end_ns(self, frame: Frame) -> int:
        """When the last row's exposure has ended; a driver may not know that its shutter rolls."""
        return frame.t_end_ns + max(self.shutter_skew_ns - round(frame.shutter_skew_s * 1e9), 0)


def capture_streaming(
    session: CaptureSession, retries: RetryPolicy, reader: FrameReader, earliest_s: float
) -> Iterator[Shot]:
    """Show each pattern, and again where frames failed, until every frame counts. The reader is stopped by the caller.

    earliest_s : see `earliest_change_s`.

    Raises as `RetryPolicy` does, and what the cameras' drivers raise.
    """
    rig = session.rig
    rig.projector.load(session.sequence)
    for camera in rig.cameras.values():
        camera.arm(retries.max_exposures, Trigger.FREE)
    reader.start()
    yield from _StreamingCapture(session, retries, reader, round(earliest_s * 1e9)).shots()


class _StreamingCapture:
    """One streamed capture under way."""

    def __init__(self, session: CaptureSession, retries: RetryPolicy, reader: FrameReader, earliest_ns: int) -> None:
        self._session = session
        self._earliest_ns = earliest_ns
        self._retries = retries
        self._reader = reader
        self._clock = session.rig.clock
        self._eyes = {
            name: _CameraStreamState(
                round(shutter_skew_s(camera, name, session.rig.synchronisation) * 1e9),
                Cadence(applied.min_period_s if (applied := session.applied.get(name)) else None),
            )
            for name, camera in session.rig.cameras.items()
        }
        self._showings: deque[_Display] = deque()
        self._paired: deque[tuple[int, Frame, str | None]] = deque()
        self._lead = _DisplayLead(round((session.rig.projector.info.refresh_s or 0.0) * 1e9))
        self._index = 0
        self._shown: _Display | None = None

    def shots(self) -> Iterator[Shot]:
        """See `capture_streaming`."""
        retries = self._retries
        ahead = iter(range(len(self._session.sequence)))
        while True:
            again = bool(retries.again)
            if again:
                # First what failed, in order.
                index = min(retries.again)
                names = retries.again.pop(index)
            elif (index := next(ahead, -1)) >= 0:
                names = list(self._eyes)
            elif self._showings or self._paired:
                yield from self._until_due(last=True)
                continue
            else:
                return
            self._show(index, names, held=again)
            yield from self._until_due(last=False)

    def _show(self, index: int, names: list[str], *, held: bool) -> None:
        self._index = index
        self._session.stop_if_cancelled(index)
        asked_ns = self._clock.now_ns()
        shown = self._session.rig.projector.show(index)
        returned_ns = self._clock.now_ns()
        stable_ns = stable_from_ns(shown, self._session.rig.synchronisation)
        begins_ns = shown.t_visible_ns + self._earliest_ns
        if self._shown is not None:
            self._shown.end_ns = begins_ns
        self._lead.note(asked_ns, returned_ns, begins_ns)
        for name in names:
            self._retries.begin(name, index)
        self._shown = _Display(shown, stable_ns, list(names), held)
        self._showings.append(self._shown)

    def _until_due(self, *, last: bool) -> Iterator[Shot]:
        """Take frames, pair and judge them, until the next pattern is due. last : there is none, unless a frame failed.

        Frames that are to be judged do not grow old where they wait; a pattern that is late is late for good.
        """
        while True:
            self._session.stop_if_cancelled(self._index)
            self._settle()
            due_ns = self._due_ns(last=last)
            left_s = _POLL_S if due_ns is None else (due_ns - self._clock.now_ns()) / 1e9
            if self._paired and (left_s > _CHECK_TIME_S or len(self._paired) > _MAX_PAIRED):
                yield from self._judged()
            elif left_s <= 0:
                return
            else:
                arrival = self._reader.next(min(left_s, _POLL_S))
                if arrival is not None:
                    self._take(*arrival)

    def _due_ns(self, *, last: bool) -> int | None:
        """When to ask for the next pattern; None: that depends on frames that are still to come or to be judged."""
        if last:
            ended = not self._showings and not self._paired
            return 0 if ended or self._failed_at_rest() else None
        if len(self._showings) > MAX_UNPAIRED:
            return None
        showing = self._shown
        if showing is None:
            return 0
        if showing.held:
            # What failed before is judged before anything else is shown.
            return None if showing.missing or self._paired else 0
        return self._foretold_ns(showing)

    def _failed_at_rest(self) -> bool:
        """Whether a frame failed, and the pattern that is shown is waited for no more."""
        return bool(self._retries.again) and (self._shown is None or not self._shown.missing) and not self._paired

    def _foretold_ns(self, showing: _Display) -> int | None:
        """When to ask for the next pattern so that its light begins after a frame of each camera that has none."""
        due_ns = 0
        for name in showing.missing:
            eye = self._eyes[name]
            foretold = eye.cadence.start_after(showing.stable_ns)
            if foretold is None or eye.last is None:
                return None
            start_ns, spare_ns = foretold
            span_ns = eye.end_ns(eye.last) - eye.last.t_start_ns
            due_ns = max(due_ns, start_ns + spare_ns + span_ns - self._lead.ns)
        return due_ns

    def _judged(self) -> Iterator[Shot]:
        index, frame, fault = self._paired.popleft()
        shot = self._retries.submit(index, frame, fault)
        if shot is not None:
            yield shot

    def _take(self, name: str, came: Frame | Exception) -> None:
        if isinstance(came, Exception):
            raise came
        frame = with_camera_name(name, came)
        eye = self._eyes[name]
        eye.waiting.append((frame, self._session.frame_fault(frame, frame.t_start_ns, eye.last)))
        eye.cadence.note(frame)
        eye.last = frame

    def _settle(self) -> None:
        """Pair the frames that wait, and find out which patterns have been waited for in vain."""
        now_ns = self._clock.now_ns()
        for name, eye in self._eyes.items():
            still: list[tuple[Frame, str | None]] = []
            for frame, fault in eye.waiting:
                showing = self._showing_of(frame)
                if showing is None:
                    continue
                end_ns = showing.end_ns
                if end_ns is None:
                    # What is shown next is asked for later than now; so its light begins later than this.
                    end_ns = now_ns + min(self._earliest_ns, 0)
                    if eye.end_ns(frame) > end_ns:
                        still.append((frame, fault))
                        continue
                if name in showing.missing and eye.end_ns(frame) <= end_ns:
                    showing.missing.remove(name)
                    self._paired.append((showing.shown.index, frame, fault))
            eye.waiting = still
        for showing in list(self._showings):
            self._give_up(showing, now_ns)
            if not showing.missing:
                self._showings.remove(showing)

    def _showing_of(self, frame: Frame) -> _Display | None:
        """The last pattern whose light was whole when a frame began."""
        for showing in reversed(self._showings):
            if frame.t_start_ns >= showing.stable_ns:
                return showing
        return None

    def _give_up(self, showing: _Display, now_ns: int) -> None:
        """Have a pattern shown again to the cameras that are past it, or gave nothing for too long."""
        for name in list(showing.missing):
            last = self._eyes[name].last
            if showing.end_ns is not None and last is not None and last.t_start_ns >= showing.end_ns:
                cause = (
                    "no frame was exposed within its light: one was lost or damaged, or came otherwise than the frames "
                    "before it; it is shown until a frame is there"
                )
            elif now_ns - showing.stable_ns > self._session.patience_s(name) * 1e9:
                cause = (
                    f"no frame came within {self._session.patience_s(name):.3f} s of its light, visible since "
                    f"{showing.shown.t_visible_ns} ns ± {showing.shown.t_err_ns} ns; check the camera's cable, "
                    "bandwidth and trigger"
                )
            else:
                continue
            showing.missing.remove(name)
            self._retries.missed(name, showing.shown.index, cause)
