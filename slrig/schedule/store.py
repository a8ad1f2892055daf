"""The record of schedules and their runs, in the service's database.

Two processes may look at one database: a due time has one row, which the first to see it makes, and a run is started by
the one that changes its row from waiting to running. A run that is under way keeps saying so (`beat`); one whose
process died stops saying so, and is recorded as interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any
from uuid import UUID, uuid4

from pydantic import TypeAdapter
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from slrig.errors import ScanStateError, ScheduleNotFoundError
from slrig.jobs.database import Database
from slrig.jobs.records import stamp
from slrig.jobs.tables import RunRow, ScheduleRow
from slrig.schedule.records import Cron, RunState, Schedule, ScheduledRun, ScheduleSpec, TaskKind
from slrig.schedule.recurrence import DueRun, due_runs

LIFE_S = 60.0
"""How long a run counts as alive after its process last said so."""

_KEPT_RUNS = 5000
_PENDING = tuple(str(state) for state in RunState if not state.final)

_AS_ORDERED = ("task", "options", "label", "grace_s", "retry_s", "catch_up", "enabled")
"""The columns that are as an order's attributes of the same name."""

_run_adapter = TypeAdapter(ScheduledRun)


Notice = Callable[[Session, Schedule, ScheduledRun], None]
"""Told of every run that came to an end, or never began, in the transaction that records it."""


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
            return [_schedule(row) for row in session.scalars(query)]

    def enable(self, schedule_id: UUID, *, enabled: bool) -> Schedule:
        """Pause a schedule, or let it go on. What was due during the pause is then judged as after any other.

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
        """Up to `limit` runs of a schedule, newest first, whose number is below `before`."""
        with self.database.reading() as session:
            _found(session, schedule_id)
            query = select(RunRow).where(RunRow.schedule_id == str(schedule_id))
            if before is not None:
                query = query.where(RunRow.number < before)
            return [_run(row) for row in session.scalars(query.order_by(RunRow.number.desc()).limit(limit))]

    def counts(self) -> dict[tuple[TaskKind, RunState], int]:
        """How many runs of each task are on record in each state. A row that stands for several counts as those."""
        query = (
            select(ScheduleRow.task, RunRow.state, func.sum(RunRow.count))
            .join(RunRow, RunRow.schedule_id == ScheduleRow.id)
            .group_by(ScheduleRow.task, RunRow.state)
        )
        with self.database.reading() as session:
            return {(TaskKind(task), RunState(state)): int(count) for task, state, count in session.execute(query)}

    def record_due(self, now: datetime) -> Sequence[ScheduledRun]:
        """Record what has become due. Returns the rows made."""
        made: list[RunRow] = []
        with self.database.changing() as session:
            for row in session.scalars(select(ScheduleRow).where(ScheduleRow.enabled)):
                order = _order(row)
                found = due_runs(order, datetime.fromisoformat(row.next_due), now)
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
        """Record a run that is due at this moment, whatever the order's times are, and though it may be paused.

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
            due = DueRun(now, RunState.WAITING, "asked for by a person, not by the clock", 1, deadline)
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
            return [_run(row) for row in session.scalars(query)]

    def next_moment(self) -> datetime | None:
        """When something is due or wants to try again next; None if nothing ever is."""
        due = select(func.min(ScheduleRow.next_due)).where(ScheduleRow.enabled)
        attempt = select(func.min(RunRow.next_attempt)).where(RunRow.state == RunState.WAITING)
        with self.database.reading() as session:
            found = [first for query in (due, attempt) if (first := session.scalar(query)) is not None]
            return datetime.fromisoformat(min(found)) if found else None

    def start(self, run: ScheduledRun, now: datetime) -> bool:
        """Take a waiting run; False if somebody else has it, or another run is under way."""
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
        """Record what became of a run. The first final state stands."""
        with self.database.changing() as session:
            row = session.get(RunRow, run.number)
            if row is not None and not RunState(row.state).final:
                _close(row, state, now, reason)
                row.result = None if result is None else dict(result)
                self._tell(session, row)

    def beat(self, now: datetime) -> None:
        """Say that this process is alive, and with it the run that it has under way."""
        with self.database.changing() as session:
            query = select(RunRow).where(RunRow.state == RunState.RUNNING, RunRow.owner == self._owner)
            for row in session.scalars(query):
                row.alive_until = stamp(now + timedelta(seconds=LIFE_S))

    def interrupt_dead(self, now: datetime, *, alone: bool = False) -> Sequence[ScheduledRun]:
        """Record runs whose process died as interrupted: those that did not say for long that they are alive.

        alone : no other process uses the database, so that every run of another one is dead.
        """
        query = select(RunRow).where(RunRow.state == RunState.RUNNING, RunRow.owner != self._owner)
        if not alone:
            # The second test is for a clock that was set back: nobody says that far ahead that he is alive.
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
        """Record runs that waited for the whole of their grace as skipped, each with what it waited for."""
        query = select(RunRow).where(RunRow.state == RunState.WAITING, RunRow.deadline < stamp(now))

        def reason(row: RunRow) -> str:
            waited = f"for the whole of its grace: {row.reason}" if row.attempts else "before it could be started"
            return f"its time passed {waited}"

        return self._closed(query, RunState.SKIPPED, now, reason)

    def _closed(
        self, query: Select[RunRow], state: RunState, now: datetime, reason: Callable[[RunRow], str]
    ) -> Sequence[ScheduledRun]:
        with self.database.changing() as session:
            rows = list(session.scalars(query))
            for row in rows:
                _close(row, state, now, reason(row))
                self._tell(session, row)
            return [_run(row) for row in rows]

    def _tell(self, session: Session, row: RunRow) -> None:
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
            self._tell(session, row)
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
