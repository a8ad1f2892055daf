"""Schedules and their runs: when they are due, and their records in the service's database.

Two processes may read one database: a due time has one row, which the first to see it makes, and a run is started by
the one that changes its row from waiting to running. A run that is under way keeps its row fresh (`beat`); the run of a
lost process does not, and is recorded as interrupted.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from itertools import islice, takewhile
from typing import Any
from uuid import UUID, uuid4
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from pydantic import TypeAdapter
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from slrig.errors import ScanStateError, ScheduleError, ScheduleNotFoundError
from slrig.jobs.database import Database, RunRow, ScheduleRow, or_none, readable
from slrig.jobs.records import stamp

MOST_GRACE_S = 7 * 24 * 3600.0
LEAST_RETRY_S = 1.0

_EXAMPLE = "'30 6 * * mon-fri' is 06:30 on working days"
_FIRST_REACH = timedelta(hours=2)


@dataclass(frozen=True, slots=True)
class Cron:
    """When a schedule is due.

    A time that the clocks skip in spring is due right after the gap; one that they repeat in autumn is due once. Times
    that come every hour or more often follow the hours that really pass.

    Raises
    ------
    ScheduleError
        The text is not a cron expression, it never comes, or there is no such time zone.
    """

    text: str
    time_zone: str

    def __post_init__(self) -> None:
        try:
            ZoneInfo(self.time_zone)
        except (KeyError, ValueError, OSError) as error:
            message = (
                f"time_zone: expected a name of the IANA database ('Europe/Berlin', 'UTC'), found {self.time_zone!r}"
            )
            raise ScheduleError(message) from error
        if len(self.text.split()) != 5:
            message = (
                f"cron: expected five fields (minute, hour, day of month, month, day of week), found {self.text!r}; "
                f"{_EXAMPLE}"
            )
            raise ScheduleError(message)
        try:
            never = next(self._moments(datetime(2024, 1, 1, tzinfo=UTC)), None) is None
        except CronSimError as error:
            message = f"cron: {error}, found {self.text!r}; {_EXAMPLE}"
            raise ScheduleError(message) from error
        if never:
            message = f"cron: {self.text!r} never comes; {_EXAMPLE}"
            raise ScheduleError(message)

    def after(self, moment: datetime) -> datetime:
        """The first due time later than `moment`, UTC."""
        return next(self._moments(moment))

    def upcoming(self, moment: datetime, count: int) -> tuple[datetime, ...]:
        """The next `count` due times later than `moment`, UTC."""
        return tuple(islice(self._moments(moment), count))

    def newest(self, first: datetime, last: datetime) -> datetime | None:
        """The last due time from `first` to `last`, both included, UTC; None if there is none."""
        reach = _FIRST_REACH
        # From the end backwards, in longer and longer stretches: after a long pause only the newest is wanted.
        while True:
            start = max(first, last - reach)
            found = deque(self._from(start, last), maxlen=1)
            if found or start == first:
                return found[0] if found else None
            reach *= 8

    def count(self, first: datetime, last: datetime, *, most: int) -> int:
        """Number of due times from `first` to `last`, both included; `most` means that many or more."""
        return sum(1 for _ in islice(self._from(first, last), most))

    def _from(self, first: datetime, last: datetime) -> Iterator[datetime]:
        return takewhile(lambda due: due <= last, self._moments(first - timedelta(seconds=1)))

    def local(self, moment: datetime) -> datetime:
        """A moment as clocks in the schedule's time zone show it."""
        return moment.astimezone(ZoneInfo(self.time_zone))

    def _moments(self, moment: datetime) -> Iterator[datetime]:
        for due in CronSim(self.text, moment.astimezone(ZoneInfo(self.time_zone))):
            yield due.astimezone(UTC)


class TaskKind(StrEnum):
    """The work of a schedule.

    VERIFICATION checks whether the calibration still holds; CALIBRATION shoots every pose of a positioner and solves;
    ACCEPTANCE measures the prescribed artefacts; SCAN scans once.
    """

    VERIFICATION = "verification"
    CALIBRATION = "calibration"
    ACCEPTANCE = "acceptance"
    SCAN = "scan"


@dataclass(frozen=True, slots=True)
class ScheduleSpec:
    """The request of a person: when, what, and how late it may be.

    grace_s : how long after its time a run may still start, a busy rig's included. retry_s : a run that finds the rig
    busy, or a device that fails, tries again so often. catch_up : after a pause longer than the grace (the service was
    off, the schedule was paused) the newest of the runs that were missed is made up for, once; otherwise it is recorded
    as missed. options : of the task, which checks them.

    Raises
    ------
    ScheduleError
        A number is out of its range: all faults in one message.
    """

    cron: Cron
    task: TaskKind
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str | None = None
    grace_s: float = 3600.0
    retry_s: float = 60.0
    catch_up: bool = True
    enabled: bool = True

    def __post_init__(self) -> None:
        faults = []
        if not 0 <= self.grace_s <= MOST_GRACE_S:
            faults.append(f"grace_s: expected 0 to {MOST_GRACE_S:g} s, found {self.grace_s:g}")
        if not LEAST_RETRY_S <= self.retry_s < math.inf:
            faults.append(f"retry_s: expected {LEAST_RETRY_S:g} s or more, found {self.retry_s:g}")
        if faults:
            message = "; ".join(faults) + "; an hour of grace and a minute between tries are usual"
            raise ScheduleError(message)


@dataclass(frozen=True, slots=True)
class Schedule:
    """An order on record. `next_due` is the first time without a recorded run."""

    id: UUID
    order: ScheduleSpec
    created_at: datetime
    next_due: datetime


class RunState(StrEnum):
    """The state of a due time.

    WAITING for the rig, and RUNNING, are under way. SUCCEEDED and FAILED ran. SKIPPED found the rig busy, or the
    schedule's earlier run under way, for the whole of its grace. MISSED was due while the service was off or the
    schedule paused, and is not made up for; COALESCED represents older ones, replaced by the newest. INTERRUPTED was
    cut off in the middle.
    """

    WAITING = "waiting"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    SKIPPED = "skipped"
    MISSED = "missed"
    COALESCED = "coalesced"
    INTERRUPTED = "interrupted"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the run."""
        return self not in {RunState.WAITING, RunState.RUNNING}


@dataclass(frozen=True, slots=True)
class ScheduledRun:
    """One due time of one schedule, and its outcome.

    count : number of due times of the row, 1 except for missed and coalesced ones. deadline : the latest start.
    attempts : number of starts. reason : for people, where the run did not simply succeed. result : of the task.
    """

    number: int
    schedule: UUID
    due: datetime
    state: RunState
    reason: str | None
    count: int
    attempts: int
    deadline: datetime
    next_attempt: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    result: Mapping[str, Any] | None


MOST_COUNTED = 10_000
"""Due times that a pause may leave behind are counted up to here."""


@dataclass(frozen=True, slots=True)
class DueRun:
    """A row to be made: one due time that runs, or one for `count` that do not."""

    due: datetime
    state: RunState
    reason: str | None
    count: int
    deadline: datetime


@dataclass(frozen=True, slots=True)
class Due:
    """Result of one check of the clock: rows, old to new, and the next due time."""

    runs: tuple[DueRun, ...]
    next_due: datetime


def due_runs(order: ScheduleSpec, next_due: datetime, now: datetime) -> Due:
    """The due times since, and their rows.

    One due time within its grace runs. After a pause the newest is the one that counts: it runs if it is still within
    its grace, or once, late, if the order makes up for missed runs; the older ones are recorded in one row. A clock
    that was set back brings the next due time back with it: what has run has its row, and does not run again.
    """
    following = order.cron.after(now)
    if next_due > now:
        return Due((), min(next_due, following))
    newest = order.cron.newest(next_due, now)
    if newest is None:
        return Due((), following)
    grace = timedelta(seconds=order.grace_s)
    late = now - newest
    in_time = late <= grace
    runs = in_time or order.catch_up
    rows = []
    older = order.cron.count(next_due, newest, most=MOST_COUNTED) - 1
    if older > 0:
        rows.append(_older(next_due, newest, older, coalesced=runs))
    if not runs:
        reason = f"the schedule was off from {_clock(order, newest)} to {_clock(order, now)}, longer than the grace"
        rows.append(DueRun(newest, RunState.MISSED, reason, 1, newest + grace))
    elif in_time:
        rows.append(DueRun(newest, RunState.WAITING, None, 1, newest + grace))
    else:
        reason = f"made up for: due at {_clock(order, newest)}, the schedule was off until {_clock(order, now)}"
        rows.append(DueRun(newest, RunState.WAITING, reason, 1, now + grace))
    return Due(tuple(rows), following)


def _older(first: datetime, newest: datetime, count: int, *, coalesced: bool) -> DueRun:
    times = f"{count} due times" if count > 1 else "one due time"
    if count >= MOST_COUNTED - 1:
        times = f"{count} due times or more"
    if coalesced:
        return DueRun(first, RunState.COALESCED, f"{times} passed unattended; only the newest runs", count, newest)
    return DueRun(first, RunState.MISSED, f"{times} passed unattended", count, newest)


def _clock(order: ScheduleSpec, moment: datetime) -> str:
    return order.cron.local(moment).isoformat(timespec="minutes")


LIFE_S = 60.0
"""Validity of the heartbeat of a run's process."""

_KEPT_RUNS = 5000
_PENDING = tuple(str(state) for state in RunState if not state.final)

_AS_ORDERED = ("task", "options", "label", "grace_s", "retry_s", "catch_up", "enabled")
"""The columns that are as an order's attributes of the same name."""

_run_adapter = TypeAdapter(ScheduledRun)


Notice = Callable[[Session, Schedule, ScheduledRun], None]
"""Called with every run that came to an end, or never began, in the transaction that records it."""


class ScheduleStore:
    """Schedules and runs. Safe to call from any thread and from several processes. `now` is in UTC."""

    def __init__(self, database: Database, *, notice: Notice = lambda *_: None) -> None:
        self.database = database
        self._notice = notice
        self._owner = str(uuid4())

    def create(self, order: ScheduleSpec, now: datetime) -> Schedule:
        """Put a new schedule on record. It is due from now on."""
        row = ScheduleRow(
            id=str(uuid4()),
            cron=order.cron.text,
            time_zone=order.cron.time_zone,
            **{name: getattr(order, name) for name in _AS_ORDERED},
            created_at=stamp(now),
            next_due=stamp(order.cron.after(now)),
        )
        with self.database.changing() as session:
            session.add(row)
            return _schedule(row)

    def get(self, schedule_id: UUID) -> Schedule:
        """Return a schedule. Raises ScheduleNotFoundError."""
        with self.database.reading() as session:
            return _schedule(_found(session, schedule_id))

    def all(self) -> Sequence[Schedule]:
        """Every schedule, oldest first."""
        with self.database.reading() as session:
            query = select(ScheduleRow).order_by(ScheduleRow.created_at, ScheduleRow.id)
            return list(readable(session.scalars(query), _schedule))

    def enable(self, schedule_id: UUID, *, enabled: bool) -> Schedule:
        """Pause or resume a schedule. Due times of the pause are then treated as after any other.

        Raises ScheduleNotFoundError.
        """
        with self.database.changing() as session:
            row = _found(session, schedule_id)
            row.enabled = enabled
            return _schedule(row)

    def remove(self, schedule_id: UUID) -> None:
        """Forget a schedule and its runs. Raises ScheduleNotFoundError."""
        with self.database.changing() as session:
            session.delete(_found(session, schedule_id))

    def runs(self, schedule_id: UUID, *, before: int | None = None, limit: int = 50) -> Sequence[ScheduledRun]:
        """Up to `limit` runs of a schedule, newest first, with numbers below `before`."""
        with self.database.reading() as session:
            _found(session, schedule_id)
            query = select(RunRow).where(RunRow.schedule_id == str(schedule_id))
            if before is not None:
                query = query.where(RunRow.number < before)
            rows = session.scalars(query.order_by(RunRow.number.desc()).execution_options(yield_per=limit))
            return list(islice(readable(rows, _run), limit))

    def counts(self) -> dict[tuple[TaskKind, RunState], int]:
        """Number of recorded runs of each task in each state. A row of several counts as those."""
        query = (
            select(ScheduleRow.task, RunRow.state, func.sum(RunRow.count))
            .join(RunRow, RunRow.schedule_id == ScheduleRow.id)
            .group_by(ScheduleRow.task, RunRow.state)
        )
        with self.database.reading() as session:
            found = list(session.execute(query))
        known = [(or_none(TaskKind, task), or_none(RunState, state), int(count)) for task, state, count in found]
        return {(task, state): count for task, state, count in known if task and state}

    def record_due(self, now: datetime) -> Sequence[ScheduledRun]:
        """Record what has become due. Returns the rows made."""
        made: list[RunRow] = []
        with self.database.changing() as session:
            rows = session.scalars(select(ScheduleRow).where(ScheduleRow.enabled))
            for row, schedule in readable(rows, lambda each: (each, _schedule(each))):
                order = schedule.order
                found = due_runs(order, schedule.next_due, now)
                for due in found.runs:
                    made += self._recorded(session, row, due, now)
                following = found.next_due
                while self._row(session, row.id, following) is not None:
                    following = order.cron.after(following)
                row.next_due = stamp(following)
                if made:
                    _prune(session, row.id)
            session.flush()
            return [_run(each) for each in made]

    def run_now(self, schedule_id: UUID, now: datetime) -> ScheduledRun:
        """Record a run that is due at this moment, outside of the order's times, also while it is paused.

        Raises ScheduleNotFoundError; ScanStateError: one of its runs is under way, or waits for the rig.
        """
        with self.database.changing() as session:
            schedule = _found(session, schedule_id)
            pending = select(RunRow).where(RunRow.schedule_id == schedule.id, RunRow.state.in_(_PENDING)).limit(1)
            if (other := session.scalar(pending)) is not None:
                message = (
                    f"Schedule {schedule_id} has a run that is {other.state} already. Wait until it is over, or end it "
                    f"(POST /schedule/{schedule_id}/cancel)."
                )
                raise ScanStateError(message)
            deadline = now + timedelta(seconds=schedule.grace_s)
            due = DueRun(now, RunState.WAITING, "requested by a person, not by the clock", 1, deadline)
            made = self._recorded(session, schedule, due, now)
            _prune(session, schedule.id)
            return _run(made[0])

    def startable(self, now: datetime) -> Sequence[ScheduledRun]:
        """The runs that wait for the rig and may try it now, the one due first first."""
        query = (
            select(RunRow)
            .where(RunRow.state == RunState.WAITING, RunRow.next_attempt <= stamp(now))
            .order_by(RunRow.due, RunRow.number)
        )
        with self.database.reading() as session:
            return list(readable(session.scalars(query), _run))

    def next_moment(self) -> datetime | None:
        """When something is due or wants to try again next; None if nothing ever is."""
        due = [schedule.next_due for schedule in self.all() if schedule.order.enabled]
        attempt = select(func.min(RunRow.next_attempt)).where(RunRow.state == RunState.WAITING)
        with self.database.reading() as session:
            again = or_none(datetime.fromisoformat, session.scalar(attempt))
        return min([*due, *([] if again is None else [again])], default=None)

    def start(self, run: ScheduledRun, now: datetime) -> bool:
        """Take a waiting run; False if another process has it, or another run is under way."""
        with self.database.changing() as session:
            row = session.get(RunRow, run.number)
            under_way = session.scalar(select(RunRow.number).where(RunRow.state == RunState.RUNNING).limit(1))
            if row is None or row.state != RunState.WAITING or under_way is not None:
                return False
            row.state, row.owner, row.attempts = RunState.RUNNING, self._owner, row.attempts + 1
            row.started_at, row.alive_until = stamp(now), stamp(now + timedelta(seconds=LIFE_S))
            return True

    def postpone(self, run: ScheduledRun, reason: str, next_attempt: datetime) -> None:
        """Put a run that could not have the rig back among those that wait."""
        with self.database.changing() as session:
            row = session.get(RunRow, run.number)
            if row is not None and not RunState(row.state).final:
                row.state, row.reason, row.next_attempt = RunState.WAITING, reason, stamp(next_attempt)
                row.owner = row.alive_until = row.started_at = None

    def finish(
        self,
        run: ScheduledRun,
        state: RunState,
        now: datetime,
        *,
        reason: str | None,
        result: Mapping[str, Any] | None = None,
    ) -> None:
        """Record the end of a run. Only the first final state counts."""
        with self.database.changing() as session:
            row = session.get(RunRow, run.number)
            if row is not None and not RunState(row.state).final:
                _close(row, state, now, reason)
                row.result = None if result is None else dict(result)
                self._report(session, row)

    def beat(self, now: datetime) -> None:
        """Record a heartbeat of this process, and of its run under way."""
        with self.database.changing() as session:
            query = select(RunRow).where(RunRow.state == RunState.RUNNING, RunRow.owner == self._owner)
            for row in session.scalars(query):
                row.alive_until = stamp(now + timedelta(seconds=LIFE_S))

    def interrupt_lost(self, now: datetime, *, alone: bool = False) -> Sequence[ScheduledRun]:
        """Record the runs of lost processes as interrupted: those without a recent heartbeat.

        alone : no other process uses the database, so that every run of another one is lost.
        """
        query = select(RunRow).where(RunRow.state == RunState.RUNNING, RunRow.owner != self._owner)
        if not alone:
            # The second test is for a clock that was set back: no heartbeat is that far ahead.
            query = query.where(
                (RunRow.alive_until < stamp(now)) | (RunRow.alive_until > stamp(now + timedelta(seconds=2 * LIFE_S)))
            )
        return self._closed(query, RunState.INTERRUPTED, now, lambda _: "the service ended in the middle of it")

    def interrupt_own(self, now: datetime) -> Sequence[ScheduledRun]:
        """Record the runs that this process began as interrupted. Only while it has none under way: what it still has
        on record as running ended while the disk refused to take that down.
        """
        query = select(RunRow).where(RunRow.state == RunState.RUNNING, RunRow.owner == self._owner)
        return self._closed(query, RunState.INTERRUPTED, now, lambda _: "it ended, and how could not be put on record")

    def expire(self, now: datetime) -> Sequence[ScheduledRun]:
        """Record runs that waited for the whole of their grace as skipped, each with the reason of its wait."""
        query = select(RunRow).where(RunRow.state == RunState.WAITING, RunRow.deadline < stamp(now))

        def reason(row: RunRow) -> str:
            waited = f"for the whole of its grace: {row.reason}" if row.attempts else "before it could be started"
            return f"its time passed {waited}"

        return self._closed(query, RunState.SKIPPED, now, reason)

    def _closed(
        self, query: Select[RunRow], state: RunState, now: datetime, reason: Callable[[RunRow], str]
    ) -> Sequence[ScheduledRun]:
        with self.database.changing() as session:

            def close(row: RunRow) -> ScheduledRun:
                _close(row, state, now, reason(row))
                self._report(session, row)
                return _run(row)

            return list(readable(list(session.scalars(query)), close))

    def _report(self, session: Session, row: RunRow) -> None:
        self._notice(session, _schedule(_found(session, UUID(row.schedule_id))), _run(row))

    def _recorded(self, session: Session, schedule: ScheduleRow, due: DueRun, now: datetime) -> list[RunRow]:
        if self._row(session, schedule.id, due.due) is not None:
            return []
        if due.state is RunState.WAITING:
            waiting = select(RunRow).where(RunRow.schedule_id == schedule.id, RunRow.state == RunState.WAITING)
            for older in session.scalars(waiting):
                _close(older, RunState.COALESCED, now, f"overtaken by the next due time; it had waited: {older.reason}")
        row = RunRow(
            schedule_id=schedule.id,
            due=stamp(due.due),
            state=due.state,
            reason=due.reason,
            count=due.count,
            attempts=0,
            deadline=stamp(due.deadline),
            next_attempt=stamp(now) if due.state is RunState.WAITING else None,
            finished_at=stamp(now) if due.state.final else None,
        )
        session.add(row)
        session.flush()
        if due.state.final:
            self._report(session, row)
        return [row]

    def _row(self, session: Session, schedule_id: str, due: datetime) -> RunRow | None:
        return session.scalar(select(RunRow).where(RunRow.schedule_id == schedule_id, RunRow.due == stamp(due)))


def _found(session: Session, schedule_id: UUID) -> ScheduleRow:
    row = session.get(ScheduleRow, str(schedule_id))
    if row is None:
        message = f"No schedule {schedule_id} is on record here. GET /schedule lists those that are."
        raise ScheduleNotFoundError(message)
    return row


def _prune(session: Session, schedule_id: str) -> None:
    """Forget the oldest runs of a schedule that has very many."""
    query = select(RunRow).where(RunRow.schedule_id == schedule_id).order_by(RunRow.number.desc()).offset(_KEPT_RUNS)
    for row in session.scalars(query):
        if RunState(row.state).final:
            session.delete(row)


def _close(row: RunRow, state: RunState, now: datetime, reason: str | None) -> None:
    row.state, row.reason, row.finished_at = state, reason, stamp(now)
    row.next_attempt = row.alive_until = None


def _order(row: ScheduleRow) -> ScheduleSpec:
    given = {name: getattr(row, name) for name in _AS_ORDERED}
    return ScheduleSpec(Cron(row.cron, row.time_zone), **{**given, "task": TaskKind(row.task)})


def _schedule(row: ScheduleRow) -> Schedule:
    created_at, next_due = map(datetime.fromisoformat, (row.created_at, row.next_due))
    return Schedule(UUID(row.id), _order(row), created_at, next_due)


def _run(row: RunRow) -> ScheduledRun:
    found = {column.name: getattr(row, column.name) for column in RunRow.__table__.columns}
    return _run_adapter.validate_python({**found, "schedule": row.schedule_id})
