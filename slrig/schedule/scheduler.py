"""Keeps the schedule: looks at the clock, starts what is due, and records what became of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import datetime, timedelta
from typing import Any

import structlog

from slrig.errors import (
    DeviceError,
    RigBusyError,
    ScanInterruptedError,
    ScheduleNotFoundError,
    SlrigError,
    UnsupportedByDeviceError,
    WorkerLostError,
)
from slrig.jobs.records import Clock, acting_as, utc_now
from slrig.schedule.records import RunState, Schedule, ScheduledRun
from slrig.schedule.store import ScheduleStore

LOOK_S = 10.0
"""The clock is looked at this often at the least, so that one that is set anew is noticed."""

_LEAST_WAIT_S = 0.05
"""Between two looks, so that a run that cannot be started yet does not keep a core busy."""

_log = structlog.get_logger(__name__)


Work = Callable[[Schedule, ScheduledRun], Mapping[str, Any]]
"""Does what a schedule asks for, on a thread of the scheduler's. Returns what is on record of it.

Raises RigBusyError where somebody holds the rig, before anything was done; SlrigError where it could not be done: what
may pass, see `passes`, has the run try again within its grace.
"""


def passes(error: SlrigError) -> bool:
    """Whether a run that met this may go well a little later: the rig was held, a device failed, the worker was lost.

    >>> passes(DeviceError("no answer")), passes(UnsupportedByDeviceError("no such trigger"))
    (True, False)
    """
    return isinstance(error, RigBusyError | DeviceError | WorkerLostError) and not isinstance(
        error, UnsupportedByDeviceError
    )


def in_a_thread(work: Callable[[], None]) -> None:
    """Do something on a thread of its own, and return at once."""
    threading.Thread(target=work, name="slrig-scheduled", daemon=True).start()


class Scheduler:
    """One loop over the schedules of one database. Public methods may be called from any thread.

    alone : no other process uses the database. execute : has a call made, at once or later.
    """

    def __init__(
        self,
        store: ScheduleStore,
        work: Work,
        *,
        clock: Clock = utc_now,
        alone: bool = True,
        execute: Callable[[Callable[[], None]], None] = in_a_thread,
    ) -> None:
        self._store = store
        self._work = work
        self._clock = clock
        self._alone = alone
        self._execute = execute
        self._wanted = threading.Event()
        self._stop = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self._loop = threading.Thread(target=self._look_again, name="slrig-schedule", daemon=True)

    def start(self) -> None:
        """Record what a process before this one left behind, and look at the clock from now on."""
        _log_runs(self._store.interrupt_dead(self._clock(), alone=self._alone))
        self._loop.start()

    def wake(self) -> None:
        """Look at the clock now: a schedule was changed, or the rig became free."""
        self._wanted.set()

    def stop(self) -> None:
        """Begin no further run, and take one that ends from now on for interrupted. Idempotent."""
        self._stop.set()
        self.wake()

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Stop. A run under way is recorded as interrupted if it does not end in time. Idempotent."""
        self.stop()
        if self._loop.is_alive():
            self._loop.join(timeout_s)
        self._idle.wait(timeout_s)

    def tick(self) -> datetime:
        """Look at the clock once. Returns when to look again."""
        now, store = self._clock(), self._store
        if self._idle.is_set():
            _log_runs(store.interrupt_own(now))
        store.beat(now)
        _log_runs(store.interrupt_dead(now))
        _log_runs(run for run in store.record_due(now) if run.state.final)
        _log_runs(store.expire(now))
        for run in store.startable(now):
            if self._stop.is_set() or not self._idle.is_set():
                break
            if store.start(run, now):
                self._begin(run)
        look = now + timedelta(seconds=LOOK_S)
        return min(store.next_moment() or look, look)

    def _begin(self, run: ScheduledRun) -> None:
        schedule = self._store.get(run.schedule)
        self._idle.clear()

        def do() -> None:
            try:
                with acting_as(f"schedule {schedule.id}"):
                    self._end(schedule, run)
            except SlrigError:
                # A full disk: the next look takes down that it is over.
                _log.exception("the end of a scheduled run could not be put on record", schedule=str(schedule.id))
            finally:
                self._idle.set()
                self.wake()

        self._execute(do)

    def _end(self, schedule: Schedule, run: ScheduledRun) -> None:
        state, reason, result = RunState.FAILED, None, None
        cut_off = False
        try:
            result = self._work(schedule, run)
            state = RunState.SUCCEEDED
            reason = f"at try {run.attempts + 1}" if run.attempts else run.reason
        except SlrigError as error:
            busy, cut_off = isinstance(error, RigBusyError), isinstance(error, ScanInterruptedError)
            reason = f"rig busy: {error}" if busy else str(error)
            again = self._clock() + timedelta(seconds=schedule.order.retry_s)
            if passes(error) and again <= run.deadline and not self._stop.is_set():
                self._store.postpone(run, reason, again)
                return
            state = RunState.SKIPPED if busy else RunState.FAILED
        except Exception as error:  # noqa: BLE001 - the schedule outlives whatever happens in one run
            _log.exception("a scheduled run failed", schedule=str(schedule.id), due=run.due.isoformat())
            reason = f"an error of its own: {error!r}"
        if (self._stop.is_set() or cut_off) and state is not RunState.SUCCEEDED:
            state, reason = RunState.INTERRUPTED, "the service ended in the middle of it"
        self._store.finish(run, state, self._clock(), reason=reason, result=result)
        # It may have been removed meanwhile.
        with suppress(ScheduleNotFoundError):
            _log_runs(each for each in self._store.runs(schedule.id) if each.number == run.number)

    def _look_again(self) -> None:
        while not self._stop.is_set():
            # Before the look: what is wanted while it lasts is looked at once more.
            self._wanted.clear()
            try:
                wait_s = (self.tick() - self._clock()).total_seconds()
            except Exception:  # noqa: BLE001 - a full disk may be emptied; the schedule goes on
                _log.exception("the schedule could not be looked at")
                wait_s = LOOK_S
            if not self._stop.is_set():
                self._wanted.wait(min(max(wait_s, _LEAST_WAIT_S), LOOK_S))


def _log_runs(runs: Iterable[ScheduledRun]) -> None:
    for run in runs:
        log = _log.info if run.state in {RunState.SUCCEEDED, RunState.COALESCED} else _log.warning
        log("scheduled run", schedule=str(run.schedule), due=run.due.isoformat(), state=run.state, cause=run.reason)
