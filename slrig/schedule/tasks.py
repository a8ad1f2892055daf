"""What schedules do with the rig: each task's options checked, and its work done in line with the scans."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol
from uuid import UUID

from slrig.accept.job import AcceptanceTests
from slrig.bundle import Strict
from slrig.calibrate.calibrating import Calibrations
from slrig.errors import CalibrationError, ScanStateError, ScheduleError
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder
from slrig.schedule.records import Schedule, ScheduledRun, ScheduleSpec, TaskKind
from slrig.schedule.rig_tasks import AcceptanceTask, CalibrationTask, Stop, VerificationTask
from slrig.schedule.task_options import checked


class ScheduledTask(Protocol):
    """One kind of work. options : what may be said of it; both methods are given one of these."""

    @property
    def options(self) -> type[Strict]: ...  # noqa: D102 - see above

    def check(self, asked: Any, /) -> None:
        """Raise ScheduleError or CalibrationError for options that no run could be done with, as far as is known."""
        ...

    def do(self, holder: Holder, asked: Any, /, *, stop: Stop) -> Mapping[str, Any]:
        """Do it, the rig held by `holder`, and return what is on record of it, as JSON values.

        Raises
        ------
        RigBusyError
            Somebody holds the rig: before anything was done.
        SlrigError
            It could not be done.
        """
        ...


class Tasks:
    """Every kind of work: a `slrig.schedule.scheduler.Work`. Any thread may call.

    tidy : called after each calibration, see `slrig.calibrate.retention`.
    """

    def __init__(
        self,
        manager: JobManager,
        calibrations: Calibrations,
        acceptance: AcceptanceTests,
        *,
        tidy: Callable[[], object] = lambda: None,
    ) -> None:
        self._manager = manager
        self._of: Mapping[TaskKind, ScheduledTask] = {
            TaskKind.VERIFICATION: VerificationTask(manager, calibrations),
            TaskKind.CALIBRATION: CalibrationTask(manager, calibrations, tidy),
            TaskKind.ACCEPTANCE: AcceptanceTask(manager, acceptance),
        }
        self._lock = threading.Lock()
        self._ended = False
        self._stops: dict[UUID, Stop] = {}

    def check(self, order: ScheduleSpec) -> None:
        """Raise ScheduleError, with every fault, for options that no run could be done with."""
        task = self._of[order.task]
        try:
            task.check(checked(task.options, order.options, task=order.task))
        except CalibrationError as error:
            message = f"options: {error}"
            raise ScheduleError(message) from error

    def __call__(self, schedule: Schedule, run: ScheduledRun, /) -> Mapping[str, Any]:
        """See `slrig.schedule.scheduler.Work`."""
        order, stop = schedule.order, Stop()
        task, holder = self._of[order.task], holder_of(schedule, run)
        with self._lock:
            self._stops[schedule.id] = stop
            if self._ended:
                stop.ask()
        try:
            if self._manager.rig.facts is None:
                # What it can do is known only when it is open.
                self._manager.lend(holder, lambda _rig, _cancelled: None)
            return task.do(holder, checked(task.options, order.options, task=order.task), stop=stop)
        finally:
            with self._lock:
                self._stops.pop(schedule.id, None)

    def end(self) -> None:
        """Have every run end: the service ends."""
        with self._lock:
            self._ended = True
            stops = list(self._stops.values())
        for stop in stops:
            stop.ask()

    def cancel(self, schedule: Schedule) -> None:
        """Ask the run of a schedule that is under way to end early. Returns at once. Raises ScanStateError."""
        with self._lock:
            stop = self._stops.get(schedule.id)
        if stop is None:
            message = f"Schedule {schedule.id} has no run under way. GET /schedule/{schedule.id}/runs lists its runs."
            raise ScanStateError(message)
        stop.ask()


def holder_of(schedule: Schedule, run: ScheduledRun) -> Holder:
    """Who holds the rig for a run.

    >>> from datetime import UTC, datetime
    >>> from slrig.schedule.records import Cron, RunState, ScheduleSpec
    >>> due = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
    >>> order = ScheduleSpec(Cron("30 6 * * *", "Europe/Berlin"), TaskKind.VERIFICATION)
    >>> schedule = Schedule(UUID(int=7), order, due, due)
    >>> run = ScheduledRun(1, schedule.id, due, RunState.RUNNING, None, 1, 1, due, None, None, None, None)
    >>> holder_of(schedule, run).name
    'schedule 00000000, verification due 06:30'
    """
    due = schedule.order.cron.local(run.due)
    words = f"schedule {str(schedule.id)[:8]}, {schedule.order.task} due {due:%H:%M}"
    return Holder(words, words, f"/schedule/{schedule.id}")
