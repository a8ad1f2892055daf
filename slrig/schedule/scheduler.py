"""The scheduler, which starts what is due and records how it ended, and the work that schedules do with the rig."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from typing import Annotated, Any, Protocol, TypeVar
from uuid import UUID

import structlog
from pydantic import Field, ValidationError

from slrig.accept.evaluation import verdicts
from slrig.accept.job import AcceptanceTests
from slrig.accept.plan import AcceptanceRequest
from slrig.accept.store import AcceptanceState
from slrig.bundle import FreeText, PresetName, Strict, describe_errors, model_keys
from slrig.calibrate.job import Calibrations, PoseRequest
from slrig.calibrate.store import SessionState
from slrig.calibrate.verification import VerificationJob
from slrig.calibration import PRINT_SIGMA, Board, BoardKind
from slrig.errors import (
    CalibrationError,
    CalibrationNotFoundError,
    CalibrationStateError,
    DeviceError,
    PresetNotFoundError,
    RigBusyError,
    ScanCancelledError,
    ScanInterruptedError,
    ScanStateError,
    ScheduleError,
    ScheduleNotFoundError,
    SlrigError,
    UnsupportedByDeviceError,
    WorkerLostError,
)
from slrig.failure import LastingThread, error_of, job_failure
from slrig.jobs.job import Job
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Clock, Holder, JobRecord, JobState, acting_as, utc_now
from slrig.jobs.store import JobStore
from slrig.rig.session import RigFacts
from slrig.schedule.store import RunState, Schedule, ScheduledRun, ScheduleSpec, ScheduleStore, TaskKind

CHECK_S = 10.0
"""Longest interval between checks of the clock, so that a change of it is noticed."""

_LEAST_WAIT_S = 0.05
"""Between two checks, so that a run that cannot be started yet does not keep a core busy."""

_log = structlog.get_logger(__name__)


Work = Callable[[Schedule, ScheduledRun], Mapping[str, Any]]
"""Does the work of a schedule, on a thread of the scheduler's. Returns the result for its record.

Raises RigBusyError where the rig is held, before anything was done; SlrigError where it could not be done: after a
passing error, see `passes`, the run tries again within its grace.
"""


def passes(error: SlrigError) -> bool:
    """Whether a run with this error may succeed a little later: the rig was held, a device failed, the worker was lost.

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
        self._loop = LastingThread(self._run, "slrig-schedule")

    def start(self) -> None:
        """Close the runs of earlier processes, and check the clock from now on."""
        _log_runs(self._store.interrupt_lost(self._clock(), alone=self._alone))
        self._loop.start()

    def wake(self) -> None:
        """Check the clock now: a schedule was changed, or the rig became free."""
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
        """Check the clock once. Returns the time of the next check."""
        now, store = self._clock(), self._store
        if self._idle.is_set():
            _log_runs(store.interrupt_own(now))
        store.beat(now)
        _log_runs(store.interrupt_lost(now))
        _log_runs(run for run in store.record_due(now) if run.state.final)
        _log_runs(store.expire(now))
        for run in store.startable(now):
            if self._stop.is_set() or not self._idle.is_set():
                break
            if store.start(run, now):
                self._begin(run)
        check = now + timedelta(seconds=CHECK_S)
        return min(store.next_moment() or check, check)

    def _begin(self, run: ScheduledRun) -> None:
        schedule = self._store.get(run.schedule)
        self._idle.clear()

        def do() -> None:
            try:
                with acting_as(f"schedule {schedule.id}"):
                    self._end(schedule, run)
            except SlrigError:
                # A full disk: the next check records its end.
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
        except Exception as error:  # noqa: BLE001 - the schedule outlives any error of one run
            _log.exception("a scheduled run failed", schedule=str(schedule.id), due=run.due.isoformat())
            reason = f"an error of its own: {error!r}"
        if (self._stop.is_set() or cut_off) and state is not RunState.SUCCEEDED:
            state, reason = RunState.INTERRUPTED, "the service ended in the middle of it"
        self._store.finish(run, state, self._clock(), reason=reason, result=result)
        # It may have been removed meanwhile.
        with suppress(ScheduleNotFoundError):
            _log_runs(each for each in self._store.runs(schedule.id) if each.number == run.number)

    def _run(self) -> None:
        while not self._stop.is_set():
            # Before the check: a request during it causes another one.
            self._wanted.clear()
            try:
                wait_s = (self.tick() - self._clock()).total_seconds()
            except Exception:  # noqa: BLE001 - a full disk may be emptied; the schedule goes on
                _log.exception("the schedule could not be checked")
                wait_s = CHECK_S
            if not self._stop.is_set():
                self._wanted.wait(min(max(wait_s, _LEAST_WAIT_S), CHECK_S))


def _log_runs(runs: Iterable[ScheduledRun]) -> None:
    for run in runs:
        log = _log.info if run.state in {RunState.SUCCEEDED, RunState.COALESCED} else _log.warning
        log("scheduled run", schedule=str(run.schedule), due=run.due.isoformat(), state=run.state, cause=run.reason)


ExposureSeconds = Annotated[float, Field(gt=0, le=60)]
Position = Annotated[int, Field(ge=0, le=10_000)]


class ScheduledBoard(Strict):
    """The board, as POST /calibration has it."""

    kind: Annotated[BoardKind, Field(strict=False)]
    corners: Annotated[list[int], Field(min_length=2, max_length=2)]
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None
    square_sigma: Annotated[float, Field(gt=0, le=0.05)] | None = None
    aspect: Annotated[float, Field(gt=0.9, lt=1.1)] = 1.0
    measured_mm: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None

    def board(self) -> Board:
        """The board that is meant. Raises CalibrationError."""
        columns, rows = self.corners
        sigma = PRINT_SIGMA if self.square_sigma is None else self.square_sigma
        board = Board(
            self.kind, columns, rows, self.square_mm, self.marker_mm, self.dictionary, sigma, self.aspect
        )  # fmt: skip
        return (
            board if self.measured_mm is None else board.as_measured(*self.measured_mm, square_sigma=self.square_sigma)
        )


class VerificationOptions(Strict):
    """Options of a verification. board None : that of the calibration in use. position None : the board stays there."""

    board: ScheduledBoard | None = None
    position: Position | None = None
    exposure_s: ExposureSeconds | None = None


class ScanOptions(Strict):
    """Options of a scan. preset None : as the rig is set."""

    preset: PresetName | None = None
    label: FreeText | None = None


class CalibrationOptions(Strict):
    """Options of a full set of poses with its solve. positions none : all of them. activate : use the result for scans,
    unless its verdict leaves that to a person.
    """

    board: ScheduledBoard
    positions: Annotated[list[Position | FreeText], Field(max_length=1000)] = Field(default_factory=list)
    exposure_s: ExposureSeconds | None = None
    activate: bool = False


Options = TypeVar("Options", bound=Strict)


def checked(model: type[Options], given: Mapping[str, Any], *, task: str) -> Options:
    """The options of a task.

    Raises
    ------
    ScheduleError
        One is unknown or wrong: all faults in one message, and the options that there are.
    """
    try:
        return model.model_validate(dict(given))
    except ValidationError as error:
        faults = "; ".join(line.strip() for line in describe_errors(error, dict(given), model_keys(model)).splitlines())
        message = f"options: {faults}. The options of {task} are: {', '.join(model.model_fields)}"
        raise ScheduleError(message) from error


def require_positions(facts: RigFacts | None, positions: Sequence[int | str]) -> None:
    """Refuse work that needs a positioner where the rig has none, or not those positions.

    facts None : the rig is not open, all is possible; a run is refused then. positions : by number from 0 or by name.

    Raises
    ------
    ScheduleError
        No run could be done with this rig.
    """
    if facts is None:
        return
    names = facts.positions
    if not names:
        message = (
            "this rig has no positioner, and a schedule cannot rely on a person to move anything: schedule a "
            "verification of a board that stays in view, and calibrate or test manually (slrig calibrate run, slrig "
            "accept)"
        )
        raise ScheduleError(message)
    missing = [each for each in positions if each not in names and each not in range(len(names))]
    if missing:
        message = (
            f"options: this rig's positioner has no {', '.join(map(repr, missing))}; it has 0 to {len(names) - 1}: "
            f"{', '.join(names)}"
        )
        raise ScheduleError(message)


_SUMMARY = ("state", "reasons", "remedy", "expected_mm", "drift_mm", "scale_percent", "scale_mm")


class Stop:
    """Ends a run of a schedule early. Any thread may call."""

    def __init__(self) -> None:
        self._news = threading.Event()
        self._requested = False

    def request(self) -> None:
        """Request the end of the run."""
        self._requested = True
        self._news.set()

    def wait(
        self, jobs: JobStore, followed: UUID, reached: Callable[[], bool], *, cancel: Callable[[], object]
    ) -> None:
        """Return once `reached()`, which may turn true with each event of a job or of those of a group. Once the run is
        to end, `cancel` is called, and ScanCancelledError is raised.
        """
        unwatch = jobs.watch(followed, self._news.set)
        try:
            while not reached():
                if self._requested:
                    cancel()
                    message = "the run was cancelled"
                    raise ScanCancelledError(message)
                self._news.wait()
                self._news.clear()
        finally:
            unwatch()


def done(manager: JobManager, job: Job, holder: Holder, stop: Stop, *, label: str | None = None) -> JobRecord:
    """The record of a job once it has succeeded. Raises what it failed with; RigBusyError before it began."""
    jobs, job_id = manager.store, manager.submit(job, label=label, holder=holder)[0].id
    stop.wait(jobs, job_id, lambda: jobs.get(job_id).state.final, cancel=lambda: manager.cancel(job_id))
    over = jobs.get(job_id)
    if over.fault is not None:
        raise error_of(over.fault)
    return over


class ScanTask:
    """One scan, as the rig or a preset has it. job : makes it, of a preset's name."""

    options = ScanOptions

    def __init__(
        self, manager: JobManager, job: Callable[[str | None], Job], require_healthy: Callable[[], None]
    ) -> None:
        self._manager = manager
        self._job = job
        self._require_healthy = require_healthy

    def check(self, options: ScanOptions, /) -> None:
        """See `Task`."""
        try:
            self._job(options.preset)
        except PresetNotFoundError as error:
            message = f"options: {error}"
            raise ScheduleError(message) from error

    def do(self, holder: Holder, options: ScanOptions, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`."""
        self._require_healthy()
        scan = done(self._manager, self._job(options.preset), holder, stop, label=options.label)
        return {"scan": str(scan.id), "points": ((scan.summary or {}).get("mesh") or {}).get("points")}


class VerificationTask:
    """The board shot where it is, or where the positioner takes it, and judged."""

    options = VerificationOptions

    def __init__(self, manager: JobManager, calibrations: Calibrations) -> None:
        self._manager = manager
        self._calibrations = calibrations

    def check(self, options: VerificationOptions, /) -> None:
        """See `Task`. A calibration may be made before the first run; a board to verify with is named now or never."""
        self._board(options)
        if options.position is not None:
            require_positions(self._manager.rig.facts, [options.position])

    def do(self, holder: Holder, options: VerificationOptions, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. A rig that is found stale is a verification that succeeded."""
        job = VerificationJob(self._board(options), options.position, options.exposure_s)
        found = done(self._manager, job, holder, stop).summary or {}
        return {"verification": found["id"], **{name: found.get(name) for name in _SUMMARY}}

    def _board(self, options: VerificationOptions) -> Board:
        """The requested board, or that of the calibration in use."""
        if options.board is not None:
            return options.board.board()
        active = self._calibrations.active
        board = None if active is None else self._calibrations.register.get(active).board
        if board is None:
            used = "no calibration that was made here is in use" if active is None else "the one in use was imported"
            message = (
                f"which board is in view is not known: {used}. Give the schedule the option "
                '"board", as {"kind": "charuco", "corners": [11, 8], "square_mm": 12}, or activate a calibration that '
                "was made here"
            )
            raise CalibrationError(message)
        return board


class CalibrationTask:
    """Every pose of the positioner shot, the solve, and, if requested, its use. Scans may come between two poses; a
    pose waits in line behind them.

    tidy : called after each, however it ended, so that they do not pile up.
    """

    options = CalibrationOptions

    def __init__(self, manager: JobManager, calibrations: Calibrations, tidy: Callable[[], object]) -> None:
        self._manager = manager
        self._calibrations = calibrations
        self._tidy = tidy

    def check(self, options: CalibrationOptions, /) -> None:
        """See `Task`."""
        options.board.board()
        require_positions(self._manager.rig.facts, options.positions)

    def do(self, holder: Holder, options: CalibrationOptions, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. Poses that are refused are left out; one that fails ends the run."""
        facts = self._manager.rig.facts
        require_positions(facts, options.positions)
        first, *others = options.positions or range(0 if facts is None else len(facts.positions))
        session = self._calibrations.open(options.board.board(), label=holder.label).id
        try:
            try:
                # The first may not wait: a busy rig is reported before anything was done.
                self._shoot(session, holder, PoseRequest(first, options.exposure_s), wait=False)
            except BaseException:
                self._calibrations.delete(session)
                raise
            for position in others:
                # Until the last pose was shot: it may still be read while the next one is.
                self._await_poses(session, {JobState.QUEUED, JobState.CAPTURING}, stop)
                self._shoot(session, holder, PoseRequest(position, options.exposure_s), wait=True)
            self._await_poses(session, {JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING}, stop)
            return self._solved(session, options, stop)
        except (DeviceError, WorkerLostError):
            # It is tried again from the first pose on. A pose that is being read yet leaves it to `tidy`.
            with suppress(CalibrationStateError, CalibrationNotFoundError):
                self._calibrations.delete(session)
            raise
        finally:
            self._tidy()

    def _shoot(self, session: UUID, holder: Holder, request: PoseRequest, *, wait: bool) -> None:
        self._calibrations.shoot(session, request, wait=wait, holder=holder)

    def _await_poses(self, session: UUID, pending: set[JobState], stop: Stop) -> None:
        register = self._calibrations.register

        def cancel() -> None:
            for pose in register.get(session).poses:
                self._calibrations.cancel(session, pose.number)

        def shot() -> bool:
            return not any(pose.state in pending for pose in register.get(session).poses)

        stop.wait(self._manager.store, session, shot, cancel=cancel)
        for pose in register.get(session).poses:
            if pose.fault is not None and not pose.refused:
                raise error_of(pose.fault)

    def _solved(self, session: UUID, options: CalibrationOptions, stop: Stop) -> Mapping[str, Any]:
        register = self._calibrations.register
        self._calibrations.solve(session)

        def solved() -> bool:
            return register.get(session).state is not SessionState.SOLVING

        stop.wait(self._manager.store, session, solved, cancel=lambda: None)
        record = register.get(session)
        if record.fault is not None:
            raise error_of(record.fault)
        result = record.result or {}
        verdict = result.get("verdict") or {}
        # No person checks the report before scans use it.
        unattended = verdict.get("unattended") or []
        activated = options.activate and not unattended
        if activated:
            self._calibrations.activate(session)
        return {
            "calibration": str(session),
            "poses": len(record.poses),
            "accepted": len(record.accepted),
            "refused": {
                pose.position_name or pose.name: pose.fault.message
                for pose in record.poses
                if pose.refused and pose.fault is not None
            },
            "verdict": verdict.get("summary"),
            "expected_error_mm": (result.get("expected") or {}).get("point_mm"),
            "activated": activated,
            "left_to_a_person": unattended if options.activate else [],
        }


class AcceptanceTask:
    """Every prescribed position measured by the rig's positioner, and the decision."""

    options = AcceptanceRequest

    def __init__(self, manager: JobManager, tests: AcceptanceTests) -> None:
        self._manager = manager
        self._tests = tests

    def check(self, _options: AcceptanceRequest, /) -> None:
        """See `Task`."""
        require_positions(self._manager.rig.facts, ())

    def do(self, holder: Holder, options: AcceptanceRequest, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. A rig that fails the test is a run that succeeded."""
        tests = self._tests
        test = tests.open(options.plan).id
        try:
            tests.measure(test, wait=False, scripted=True, holder=holder)
        except BaseException:
            tests.cancel(test)
            raise

        def measured() -> bool:
            return tests.get(test).state is not AcceptanceState.MEASURING

        stop.wait(self._manager.store, test, measured, cancel=lambda: tests.cancel(test))
        record = tests.get(test)
        if record.decision is None:
            tests.cancel(test)
            raise error_of(record.fault or job_failure(RuntimeError("the test ended without a result")))
        return {
            "acceptance": str(test),
            "decision": str(record.decision),
            "quantities": {
                str(each.quantity): {
                    "error_mm": each.error_mm,
                    "limit_mm": each.limit_mm,
                    "uncertainty_mm": each.uncertainty.expanded_mm,
                    "position": each.step,
                    "decision": str(each.decision),
                }
                for each in verdicts(record.readings, record.plan)
            },
        }


class ScheduledTask(Protocol):
    """One kind of work. options : what may be said of it; both methods are given one of these."""

    @property
    def options(self) -> type[Strict]: ...  # noqa: D102 - see above

    def check(self, options: Any, /) -> None:
        """Raise ScheduleError or CalibrationError for options that no run could be done with, as far as is known."""
        ...

    def do(self, holder: Holder, options: Any, /, *, stop: Stop) -> Mapping[str, Any]:
        """Do it, the rig held by `holder`, and return what is on record of it, as JSON values.

        Raises
        ------
        RigBusyError
            The rig is held: before anything was done.
        SlrigError
            It could not be done.
        """
        ...


class Tasks:
    """Every kind of work: a `slrig.schedule.scheduler.Work`. Any thread may call.

    tidy : called after each calibration, see `slrig.calibrate.job`.
    """

    def __init__(
        self,
        manager: JobManager,
        calibrations: Calibrations,
        acceptance: AcceptanceTests,
        scan: ScanTask,
        *,
        tidy: Callable[[], object] = lambda: None,
    ) -> None:
        self._manager = manager
        self._of: Mapping[TaskKind, ScheduledTask] = {
            TaskKind.VERIFICATION: VerificationTask(manager, calibrations),
            TaskKind.CALIBRATION: CalibrationTask(manager, calibrations, tidy),
            TaskKind.ACCEPTANCE: AcceptanceTask(manager, acceptance),
            TaskKind.SCAN: scan,
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
                stop.request()
        try:
            if self._manager.rig.facts is None:
                # What it can do is known only when it is open.
                self._manager.lend(holder, lambda rig, _listener: rig.open())
            return task.do(holder, checked(task.options, order.options, task=order.task), stop=stop)
        finally:
            with self._lock:
                self._stops.pop(schedule.id, None)

    def end(self) -> None:
        """Request the end of every run: the service ends."""
        with self._lock:
            self._ended = True
            stops = list(self._stops.values())
        for stop in stops:
            stop.request()

    def cancel(self, schedule: Schedule) -> None:
        """Request the early end of a schedule's run under way. Returns at once. Raises ScanStateError."""
        with self._lock:
            stop = self._stops.get(schedule.id)
        if stop is None:
            message = f"Schedule {schedule.id} has no run under way. GET /schedule/{schedule.id}/runs lists its runs."
            raise ScanStateError(message)
        stop.request()


def holder_of(schedule: Schedule, run: ScheduledRun) -> Holder:
    """The holder of the rig for a run.

    >>> from datetime import UTC, datetime
    >>> from slrig.schedule.store import Cron, RunState, ScheduleSpec
    >>> due = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
    >>> order = ScheduleSpec(Cron("30 6 * * *", "Europe/Berlin"), TaskKind.VERIFICATION)
    >>> schedule = Schedule(UUID(int=7), order, due, due)
    >>> run = ScheduledRun(1, schedule.id, due, RunState.RUNNING, None, 1, 1, due, None, None, None, None)
    >>> holder_of(schedule, run).name
    'schedule 00000000, verification due 06:30'
    """
    due = schedule.order.cron.local(run.due)
    label = f"schedule {str(schedule.id)[:8]}, {schedule.order.task} due {due:%H:%M}"
    return Holder(label, label, f"/schedule/{schedule.id}")
