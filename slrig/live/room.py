"""Live depth of one rig: who watches, and the newest messages for them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import structlog

from slrig.devices import CameraInfo, ProjectorInfo, Rig
from slrig.errors import CalibrationError, LiveStateError, SlrigError, WorkerLostError
from slrig.failure import UNEXPECTED, error_of
from slrig.live.plan import live_plan
from slrig.live.player import play
from slrig.live.process import DepthCame, GeometryCame, LiveFailed, LiveProcess, LiveTask, NoDepth
from slrig.model import Calibration, Region, Shot, triangulated_axis

UNWATCHED_S = 10.0
"""Live depth without a viewer ends after this time."""

_MOST_POINTS = 1_500_000  # decoded by default
_RATE_OF = 20  # depth images
_COMPUTED_PER_S, _GLANCE_S = 21.0, 0.004
_LOST = "The live depth ended, because its process did. Start it again (POST /live); the service's log says more."

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What somebody asks for. step : at least, pixels from one decoded ray to the next; None for all, of large cameras
    fewer. exposure_s : None for that of the rig file. region : what of the scene; None for all.
    """

    camera: str
    step: int | None = None
    exposure_s: float | None = None
    region: Region | None = None


@dataclass(frozen=True, slots=True)
class LiveStatus:
    """Live depth as it is. patterns : of one cycle. playing : False while a job holds the rig. depth_per_s : of late;
    None before. facts : of the newest depth image, as `slrig.live.server.depth_facts` has them.
    """

    options: LiveOptions
    step: int
    patterns: int
    viewers: int
    playing: bool
    depth_per_s: float | None
    facts: dict[str, Any] | None


class Viewer:
    """A viewer of live depth. Leave the `with` block to stop. step : pixels of the camera from point to point. notify :
    called, from any thread, when there may be a message.
    """

    def __init__(self, room: LiveRoom, session: _Session, step: int, notify: Callable[[], None]) -> None:
        self.session, self.step, self.notify = session, step, notify
        self._room = room

    def message(self, after: int) -> tuple[int, bytes] | None:
        """Return the newest message with a number above `after`, geometry being number 0, and that number; None when
        there is none. `after` : −1 for the first. Waits for nobody. Raises SlrigError: live depth is over.
        """
        session = self.session
        error, newest, geometry = session.error, session.newest, session.geometry.get(self.step)
        if error is not None:
            raise error
        if after < 0:
            return None if geometry is None else (0, geometry)
        if newest is not None and newest.number > after and self.step in newest.messages:
            return newest.number, newest.messages[self.step]
        return None

    @property
    def waits_for(self) -> str:
        """Why there is no message, in words."""
        session = self.session
        if not session.playing:
            return "The picture comes when the rig is free."
        if session.cause is not None:
            return f"No depth comes: {session.cause}."
        if session.newest is None:
            return "The first depth image is on its way."
        return "No depth image comes at the moment."

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._room.leave(self)


class _Session:
    """One live depth, from its start to its end."""

    def __init__(self, options: LiveOptions, task: LiveTask) -> None:
        self.options, self.task = options, task
        self.process = LiveProcess(task)
        # Replaced, never changed: the rig's thread looks at it without the lock.
        self.viewers: list[Viewer] = []
        self.geometry: dict[int, bytes] = {}
        self.newest: DepthCame | None = None
        self.came_s: deque[float] = deque(maxlen=_RATE_OF)
        self.error: SlrigError | None = None
        self.playing = False
        self.cause: str | None = None
        self.ending: threading.Timer | None = None

    @property
    def steps(self) -> tuple[int, ...]:
        return tuple(sorted({viewer.step for viewer in self.viewers}))

    def tell(self) -> None:
        """Notify all viewers that there may be a message."""
        for viewer in self.viewers:
            viewer.notify()


class LiveRoom:
    """The live depth of a rig, if there is one. All but `run` may be called from any thread.

    It is played while somebody watches: the projector is dark as soon as the last one leaves. woken : called when
    somebody begins to.
    """

    def __init__(self, woken: Callable[[], None]) -> None:
        self._woken = woken
        self._lock = threading.RLock()
        self._session: _Session | None = None

    @property
    def wanted(self) -> bool:
        """Whether somebody watches, so that it is to be played."""
        session = self._session
        return session is not None and bool(session.viewers)

    def start(
        self, options: LiveOptions, camera: CameraInfo, projector: ProjectorInfo, calibration: Calibration | None
    ) -> LiveStatus:
        """Begin, or go on with one by the same options; another one without viewers is replaced.

        Raises LiveStateError: another one has viewers. CalibrationError, PatternError: there can be none. ConfigError:
        the region names another camera, or a mask of another extent.
        """
        if calibration is None or calibration.projector is None or options.camera not in calibration.cameras:
            message = (
                f"Live depth needs a calibration of projector and camera '{options.camera}', and the rig has none. "
                "Calibrate it (POST /calibration), or look through the camera meanwhile (GET /preview/CAMERA)."
            )
            raise CalibrationError(message)
        if options.region is not None:
            options.region.require_fits({name: each.size for name, each in calibration.cameras.items()})
        plan = live_plan(projector, triangulated_axis([calibration.cameras[options.camera]], calibration.projector))
        step = options.step or _default_step(camera)
        task = LiveTask(plan, calibration, options.camera, camera.format, step, options.region)
        with self._lock:
            other = self._session
            if other is not None and other.options == options and other.task.calibration.digest == calibration.digest:
                if not other.viewers:
                    self._end_unless_watched(other)
                return self.status()
            if other is not None and other.viewers:
                message = (
                    f"Another viewer watches live depth of camera '{other.options.camera}' with other options: watch "
                    "that (GET /live/depth), or end it first (DELETE /live)."
                )
                raise LiveStateError(message)
            session = self._session = _Session(options, task)
        if other is not None:
            self._finish(other, LiveStateError("Live depth was started with other options."))
        threading.Thread(target=self._listen, args=(session,), name="slrig-live", daemon=True).start()
        self._end_unless_watched(session)
        return self.status()

    def end(self) -> None:
        """End live depth. Returns at once; the projector is dark when the exposure under way is over. Idempotent."""
        with self._lock:
            session = self._session
        if session is not None:
            self._finish(session, LiveStateError("The live depth was ended."))

    def fail(self, error: SlrigError) -> None:
        """End live depth by a fault of the rig, or of the service."""
        with self._lock:
            session = self._session
        if session is not None:
            self._finish(session, error)

    def status(self) -> LiveStatus:
        """Return what there is. Raises LiveStateError: nothing."""
        with self._lock:
            session = self._require()
            times = session.came_s
            rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None
            if times and time.monotonic() - times[-1] > 2.0:
                rate = 0.0
            return LiveStatus(
                session.options, session.task.step, len(session.task.plan.patterns), len(session.viewers),
                session.playing, rate, None if session.newest is None else session.newest.facts,
            )  # fmt: skip

    def watch(self, step: int, notify: Callable[[], None]) -> Viewer:
        """Begin to watch every `step`-th pixel, or the next multiple that is decoded. notify : as of `Viewer`. Raises
        LiveStateError.
        """
        with self._lock:
            session = self._require()
            own = session.task.step
            viewer = Viewer(self, session, own * max(1, -(-step // own)), notify)
            session.viewers = [*session.viewers, viewer]
            if session.ending is not None:
                session.ending.cancel()
            # Not later, when another one's may have come first.
            session.process.want(session.steps)
        self._woken()
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Stop watching. Idempotent."""
        session = viewer.session
        with self._lock:
            session.viewers = [each for each in session.viewers if each is not viewer]
            session.process.want(session.steps)
            if not session.viewers:
                self._end_unless_watched(session)

    def run(self, rig: Rig, calibration: Calibration | None, stop: Callable[[], bool]) -> None:
        """Play until live depth ends or `stop` says so. For the thread that owns the rig. Raises what devices raise.

        calibration : in use now. Live depth by another one ends.
        """
        session = self._session
        if session is None:
            return
        if calibration is None or calibration.digest != session.task.calibration.digest:
            message = "Another calibration came into use. Start live depth again (POST /live)."
            self._finish(session, LiveStateError(message))
            return
        process, options = session.process, session.options
        camera = rig.cameras.get(options.camera)
        if camera is None or camera.info.format != session.task.format:
            found = "is gone" if camera is None else f"gives {camera.info.format.size} px now"
            message = f"The rig changed: camera '{options.camera}' {found}. Start live depth again (POST /live)."
            self._finish(session, LiveStateError(message))
            return
        session.playing = True
        process.begin()
        computed = camera.info.limits.computed
        next_s = 0.0

        def take(pattern: int, shot: Shot, begin_s: float, end_s: float) -> None:
            nonlocal next_s
            process.put(pattern, shot.image, begin_s, end_s)
            # Time of rendered and replayed devices passes as fast as they compute.
            while computed and not over() and (process.behind > 1 or time.monotonic() < next_s):
                time.sleep(_GLANCE_S)
            next_s = max(next_s + 1 / _COMPUTED_PER_S, time.monotonic())

        def over() -> bool:
            return stop() or session.error is not None or not self.wanted

        try:
            play(rig, session.task.plan, options.camera, take, over, exposure_s=options.exposure_s)
        finally:
            session.playing = False

    def _end_unless_watched(self, session: _Session) -> None:
        def look() -> None:
            with self._lock:
                if session.viewers or session.ending is not timer:
                    return
                message = (
                    f"The live depth had no viewer for {UNWATCHED_S:g} s, so it ended. Start it again (POST /live)."
                )
                self._finish(session, LiveStateError(message))

        if session.ending is not None:
            session.ending.cancel()
        session.ending = timer = threading.Timer(UNWATCHED_S, look)
        timer.daemon = True
        timer.start()

    def _require(self) -> _Session:
        if self._session is None:
            message = "There is no live depth. Begin one with POST /live."
            raise LiveStateError(message)
        return self._session

    def _listen(self, session: _Session) -> None:
        """Take what the process says, on a thread of its own, so that it never waits."""
        error: SlrigError = WorkerLostError(_LOST)
        while True:
            try:
                came = session.process.messages.recv()
            except (EOFError, OSError):
                break
            with self._lock:
                if isinstance(came, GeometryCame):
                    session.geometry.update(came.messages)
                elif isinstance(came, DepthCame):
                    session.newest = came
                    session.came_s.append(time.monotonic())
                    session.cause = None
                elif isinstance(came, NoDepth):
                    session.cause = came.cause
                elif isinstance(came, LiveFailed):
                    if came.fault.code == UNEXPECTED:
                        _log.error("live depth failed", trace=came.trace)
                    else:
                        error = error_of(came.fault)
            session.tell()
        self._finish(session, error)

    def _finish(self, session: _Session, error: SlrigError) -> None:
        with self._lock:
            if session.error is None:
                session.error = error
            if self._session is session:
                self._session = None
        session.tell()
        session.process.close()


def _default_step(camera: CameraInfo) -> int:
    size, step = camera.format.size, 1
    while size.width_px * size.height_px / step**2 > _MOST_POINTS:
        step += 1
    return step
