"""The queue of jobs on a rig: one at a time on one owner thread, a few that wait, pictures in between.

A job whose light is over leaves the rig to the next one, and computes beside it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

import structlog

from slrig.errors import (
    CameraNotFoundError,
    DeviceBusyError,
    DeviceError,
    InvalidInputError,
    QueueFullError,
    ScanCancelledError,
    SlrigError,
)
from slrig.failure import interruption_error, job_failure
from slrig.jobs.job import Holder, Job, busy
from slrig.rig.preview import Light, Previews, Watch
from slrig.rig.session import RigSession, driver_errors
from slrig.rig.watchdog import Call, Watchdog

_LOOK_S = 0.1
"""How often a drain looks whether it is over, or to be cut short."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """Who holds the rig, since when, how many wait, who computes without it, and whether the service is ending."""

    holder: Holder | None
    since: datetime | None
    waiting: int
    computing: tuple[Holder, ...]
    ending: bool


class JobQueue:
    """Runs jobs with the rig in the order in which they came.

    Every public method may be called from any thread. While `backlog_length` jobs compute, none begins that will. Of an
    earlier run of the service there may be more. `give_up` is told, on the owner thread, when the first opening shows
    that the rig file is wrong.
    """

    def __init__(
        self,
        rig: RigSession,
        *,
        queue_length: int,
        backlog_length: int,
        give_up: Callable[[InvalidInputError], None],
    ) -> None:
        self.queue_length = queue_length
        self.backlog_length = backlog_length
        self.rig = rig
        self._give_up = give_up
        self._changed = threading.Condition()
        # Replaced, never changed: previews look at it without the lock.
        self._waiting: tuple[Job, ...] = ()
        self._active: Job | None = None
        self._computing: list[Job] = []
        self._previews = Previews(self._wake)
        self._ending = False
        self._owner = threading.Thread(target=self._own_rig, name="slrig-rig", daemon=True)
        self._watchdog = Watchdog(rig.calls, self._give_up_on)

    def start(self) -> None:
        """Start the owner thread, which opens the rig."""
        # With the lock held, so that the owner has what it captures computed itself, and nobody twice.
        with self._changed:
            self._owner.start()
            for job in self._computing:
                self._begin_computing(job)
        self._watchdog.start()

    def submit(self, make: Callable[[], Sequence[Job]], *, wait: bool) -> None:
        """Put the jobs that `make` returns in line; `wait` lets the first stand behind others.

        Raises
        ------
        RigBusyError
            The rig is held, and `wait` is False. `make` was not called.
        QueueFullError
            As many wait as may.
        ScanInterruptedError
            The service ends.
        DeviceError
            A driver hangs.
        """
        self._refuse_while_stuck()
        with self._changed:
            if self._ending:
                raise interruption_error()
            waiting = self._due()
            ahead = self._active or (waiting[0] if waiting else None)
            if ahead is not None and not wait:
                raise busy(ahead)
            if len(waiting) >= self.queue_length and ahead is not None:
                message = f"The rig is held and {len(waiting)} are waiting, as many as may. Try again later."
                raise QueueFullError(message)
            self._waiting += tuple(make())
            self._changed.notify_all()
        self._previews.interrupt()

    def add(self, jobs: Sequence[Job]) -> None:
        """Put jobs in line, however many wait, and have those computed that do not need the rig."""
        computing = [job for job in jobs if job.work is None]
        with self._changed:
            self._waiting += tuple(job for job in jobs if job.work is not None)
            self._computing.extend(computing)
            self._changed.notify_all()
            if self._owner.is_alive():
                for job in computing:
                    self._begin_computing(job)

    def cancel(self, job_id: UUID) -> bool:
        """Have a job end early. Returns whether it is under way and was told; one that waited has ended."""
        with self._changed:
            queued = next((job for job in self._waiting if job.id == job_id), None)
            if queued is not None:
                self._waiting = _without(self._waiting, queued)
                message = f"{_begun(queued.holder.words)} was cancelled while it waited for the rig."
                queued.conclude(ScanCancelledError(message))
            for job in self._under_way():
                if job.id == job_id:
                    job.stop.set()
                    return True
        if queued is not None:
            queued.settle()
        return False

    def watch(self, camera: str, light: Light) -> Watch:
        """Look through a camera; pictures come while the rig is idle.

        Raises
        ------
        CameraNotFoundError
            The rig has no camera of that name.
        RigBusyError
            The rig is held.
        DeviceError
            The rig is not open, or not yet.
        """
        self._refuse_while_stuck()
        facts = self.rig.facts
        if self.rig.fault is not None:
            message = f"The rig cannot be opened: {self.rig.fault.message}"
            raise DeviceError(message)
        if facts is None:
            message = "The rig is being opened. Ask again in a moment."
            raise DeviceBusyError(message)
        if camera not in facts.cameras:
            message = f"The rig has no camera '{camera}'; it has {', '.join(facts.cameras)}."
            raise CameraNotFoundError(message)
        with self._changed:
            if self._ending:
                raise interruption_error()
            if self._active is not None:
                raise busy(self._active)
        return self._previews.watch(camera, light)

    def status(self) -> QueueStatus:
        """Return who holds the rig. Touches no device."""
        with self._changed:
            active = self._active
            holder, since = (None, None) if active is None else (active.holder, active.since)
            computing = tuple(job.holder for job in self._computing)
            return QueueStatus(holder, since, len(self._due()), computing, self._ending)

    @property
    def ending(self) -> bool:
        """Whether the service is ending."""
        return self._ending

    def drain(self, timeout_s: float, hurry: threading.Event) -> None:
        """Begin no further job, and wait until those under way are over, for so long, or until `hurry`.

        What waits stays on record as it is: the next start of the service goes on with it. `end` has to follow.
        """
        give_up = time.monotonic() + timeout_s
        with self._changed:
            self._ending = True
            while self._under_way() and not hurry.is_set() and time.monotonic() < give_up:
                self._changed.wait(_LOOK_S)

    def end(self) -> None:
        """Take nothing in any more, and have what is under way end early. `join` has to follow."""
        with self._changed:
            self._ending = True
            cut_off, self._waiting = self._waiting, ()
            for job in self._under_way():
                job.stop.set()
            for job in cut_off:
                job.conclude(interruption_error())
            self._changed.notify_all()
        self._watchdog.stop()
        self._previews.fail(interruption_error())
        for job in cut_off:
            job.settle()

    def join(self, timeout_s: float) -> None:
        """Wait for the owner thread, which darkens and closes the rig, and for what computes; an owner that hangs is
        left behind, and darkened past, as far as its driver lets.
        """
        give_up = time.monotonic() + timeout_s
        if self._owner.is_alive():
            self._owner.join(timeout_s)
        if self._owner.is_alive():
            _log.error("the rig's driver does not return; the service ends without it", rig=self.rig.name)
            self.rig.darken_from_outside()
        with self._changed:
            self._changed.wait_for(lambda: not self._computing, max(give_up - time.monotonic(), 0.0))
        self._cut_off(interruption_error(), self._under_way)

    def _refuse_while_stuck(self) -> None:
        call = self.rig.calls.stuck
        if call is not None:
            raise DeviceError(call.hangs())

    def _give_up_on(self, call: Call) -> None:
        """End, on the watchdog's thread, what waits for a call that hangs."""
        _log.error("a driver hangs", rig=self.rig.name, device=call.device, step=call.step)
        error = DeviceError(self.rig.give_up(call).message)
        self.rig.darken_from_outside()
        self._cut_off(error, lambda: [job for job in (self._active,) if job is not None])
        self._previews.fail(error)

    def _cut_off(self, error: SlrigError, jobs: Callable[[], list[Job]]) -> None:
        with self._changed:
            cut_off = jobs()
            for job in cut_off:
                job.conclude(error)
        for job in cut_off:
            job.settle()

    def _under_way(self) -> list[Job]:
        """The jobs that have the rig or compute; with the lock held."""
        return [*([] if self._active is None else [self._active]), *self._computing]

    def _own_rig(self) -> None:
        error = self.rig.try_open()
        if isinstance(error, InvalidInputError):
            self._give_up(error)
        else:
            self._log_unopened(error)
        while (job := self._next()) is not None:
            try:
                self._run(job)
            except Exception:  # noqa: BLE001 - the owner thread outlives whatever happens to one job
                _log.exception("the end of work with the rig went wrong", work=job.holder.words)
        self.rig.darken()
        self.rig.let_go()

    def _next(self) -> Job | None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted() or self._previews.wanted, self._until_due_s())
                if self._ending:
                    return None
                if self._wanted():
                    self._active = self._due()[0]
                    self._waiting = _without(self._waiting, self._active)
                    return self._active
                looks = self._previews.wanted
            if looks:
                self._show()

    def _wanted(self) -> bool:
        """Whether the service ends, or a job waits that may begin: in their order, while few enough compute."""
        full, waiting = len(self._computing) >= self.backlog_length, self._due()
        return self._ending or bool(waiting and not (full and waiting[0].compute is not None))

    def _due(self) -> list[Job]:
        """The jobs that wait for nothing but the rig, in their order."""
        now_s = time.monotonic()
        return [job for job in self._waiting if job.due_s <= now_s]

    def _until_due_s(self) -> float | None:
        """How long no further job becomes due; None where none waits for its time."""
        now_s = time.monotonic()
        return min((job.due_s - now_s for job in self._waiting if job.due_s > now_s), default=None)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _run(self, job: Job) -> None:
        # What is no Exception, and ends the thread, is no success either.
        error: Exception | None = RuntimeError("the thread that owns the rig was ended")
        goes_on = False
        try:
            try:
                with structlog.contextvars.bound_contextvars(job=str(job.id)):
                    if job.work is not None:
                        job.work(self.rig, job)
                error = None
            except Exception as raised:  # noqa: BLE001 - the owner thread outlives whatever happens to one job
                error = interruption_error() if self._ending else raised
            finally:
                self.rig.darken()
            goes_on = error is None and self._begun_computing(job)
            if not goes_on:
                job.clear_up(error or job.ended_by)
        finally:
            if not goes_on:
                # The rig is free before anyone can read that the work is over: a client may start its next one at once.
                with self._changed:
                    self._active = None
                    job.conclude(error)
                    self._changed.notify_all()
                job.settle()
        if not self._ending:
            self._log_unopened(self.rig.recover())

    def _begun_computing(self, job: Job) -> bool:
        """Free the rig of a job whose second part is begun. One that was given up while its driver hung is over,
        although the driver has returned.
        """
        with self._changed:
            if job.compute is None or job.ended_by is not None:
                return False
            self._active = None
            self._computing.append(job)
            self._changed.notify_all()
        self._begin_computing(job)
        return True

    def _begin_computing(self, job: Job) -> None:
        # A daemon, so that it never holds up the end of the service.
        threading.Thread(target=self._compute, args=(job,), name="slrig-compute", daemon=True).start()

    def _compute(self, job: Job) -> None:
        error: Exception | None = RuntimeError("the thread that computes was ended")
        try:
            try:
                with structlog.contextvars.bound_contextvars(job=str(job.id)):
                    if job.compute is not None:
                        job.compute(job)
                error = None
            except Exception as raised:  # noqa: BLE001 - it is told as the end of the job
                error = interruption_error() if self._ending else raised
            job.clear_up(error)
        except Exception:  # noqa: BLE001 - as on the owner thread
            _log.exception("the end of work that computes went wrong", work=job.holder.words)
        finally:
            with self._changed:
                self._computing.remove(job)
                job.conclude(error)
                self._changed.notify_all()
            job.settle()

    def _show(self) -> None:
        """Take pictures for those who look, until a job wants the rig."""
        try:
            rig = self.rig.open()
            with driver_errors(self.rig.name):
                self._previews.run(rig, stop=self._wanted)
        except Exception as error:  # noqa: BLE001 - the owner thread outlives whatever happens to a picture
            self.rig.let_go(error)
            self._log_unopened(error)
            fault = job_failure(error)
            self._previews.fail(error if isinstance(error, SlrigError) else DeviceError(fault.message))
            self._log_unopened(self.rig.recover())

    def _log_unopened(self, error: Exception | None) -> None:
        if isinstance(error, SlrigError):
            _log.warning("the rig cannot be opened; the next scan tries again", rig=self.rig.name, cause=str(error))
        elif error is not None:
            _log.error("the rig's driver failed with an error of its own", rig=self.rig.name, exc_info=error)


def _without(jobs: tuple[Job, ...], job: Job) -> tuple[Job, ...]:
    return tuple(each for each in jobs if each is not job)


def _begun(words: str) -> str:
    """The words as the beginning of a sentence."""
    return words[:1].upper() + words[1:]
