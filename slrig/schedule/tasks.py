"""What schedules do with the rig: each task's options checked, and its work done in line with the scans."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol
from uuid import UUID, uuid4

from slrig.accept.desk import AcceptanceDesk
from slrig.bundle import Strict
from slrig.calibrate.calibrating import CalibrationSessions
from slrig.errors import CalibrationError, ScanStateError, ScheduleError
from slrig.jobs.job import Holder, Job
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import utc_now
from slrig.schedule.records import Schedule, ScheduledRun, ScheduleSpec, TaskKind
from slrig.schedule.rig_tasks import AcceptanceTask, CalibrationTask, VerificationTask, until
from slrig.schedule.task_options import checked
from slrig.verify.job import VerificationDesk


class ScheduledTask(Protocol):
    """One kind of work. options : what may be said of it; both methods are given one of these."""

    @property
    def options(self) -> type[Strict]: ...  # noqa: D102 - see above

    def check(self, asked: Any, /) -> None:
        """Raise ScheduleError or CalibrationError for options that no run could be done with, as far as is known."""
        ...

    def do(self, holder: Holder, asked: Any, /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """Do it, the rig held by `holder`, and return what there is to tell, as JSON values.

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
        queue: JobQueue,
        calibrations: CalibrationSessions,
        verifications: VerificationDesk,
        acceptance: AcceptanceDesk,
        *,
        tidy: Callable[[], object] = lambda: None,
    ) -> None:
        self._queue = queue
        self._of: Mapping[TaskKind, ScheduledTask] = {
            TaskKind.VERIFICATION: VerificationTask(queue, calibrations, verifications),
            TaskKind.CALIBRATION: CalibrationTask(queue, calibrations, tidy),
            TaskKind.ACCEPTANCE: AcceptanceTask(queue, acceptance),
        }
        self._lock = threading.Lock()
        self._stops: dict[UUID, threading.Event] = {}

    def check(self, order: ScheduleSpec) -> None:
        """Raise ScheduleError, with every fault, for options that no run could be done with."""
        task = self._of[order.task]
        try:
            task.check(checked(task.options, order.options, task=order.task))
        except CalibrationError as error:
            message = f"options: {error}"
            raise ScheduleError(message) from error

    def __call__(self, schedule: Schedule, run: ScheduledRun, cancelled: Callable[[], bool], /) -> Mapping[str, Any]:
        """See `slrig.schedule.scheduler.Work`."""
        order, stop = schedule.order, threading.Event()
        task, holder = self._of[order.task], holder_of(schedule, run)

        def ends() -> bool:
            return cancelled() or stop.is_set()

        with self._lock:
            self._stops[schedule.id] = stop
        try:
            self._open_rig(holder, ends)
            return task.do(holder, checked(task.options, order.options, task=order.task), cancelled=ends)
        finally:
            with self._lock:
                self._stops.pop(schedule.id, None)

    def cancel(self, schedule: Schedule) -> None:
        """Ask the run of a schedule that is under way to end early. Returns at once. Raises ScanStateError."""
        with self._lock:
            stop = self._stops.get(schedule.id)
        if stop is None:
            message = f"Schedule {schedule.id} has no run under way. GET /schedule/{schedule.id}/runs lists its runs."
            raise ScanStateError(message)
        stop.set()

    def _open_rig(self, holder: Holder, cancelled: Callable[[], bool]) -> None:
        """Have a rig opened that was not open yet: what it can do is known only then. Raises as a scan does."""
        if self._queue.rig.facts is not None:
            return
        errors: list[Exception | None] = []
        job = Job(uuid4(), holder, utc_now(), lambda rig, _: rig.open(), errors.append)
        self._queue.submit(lambda: [job], wait=False)
        until(lambda: bool(errors), cancelled, cancel=lambda: self._queue.cancel(job.id))
        if errors[0] is not None:
            raise errors[0]


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
