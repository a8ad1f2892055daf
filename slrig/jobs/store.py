"""The record of jobs and their events, in the service's database."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import delete, func, select, text
from sqlalchemy.orm import Session

from slrig.errors import JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import Clock, JobEvent, JobKind, JobProgress, JobRecord, JobState, actor, stamp, utc_now
from slrig.jobs.tables import EventRow, JobRow, KeyRow, record_of

_LISTED = {
    JobKind.SCAN: "GET /scan lists those that are.",
    JobKind.VERIFICATION: "GET /rig/health/history lists past ones.",
    JobKind.MODEL: "GET /model lists those that are.",
}


EVERY_JOB = UUID(int=0)
"""Stands for all jobs of a store where they are followed."""


class JobStore:
    """Jobs of one kind, or of a few that belong together. Any thread of the one process that owns it may call.

    outbox : where notices of their ends are put; without one nobody is told.
    """

    def __init__(
        self, database: Database, *kinds: JobKind, clock: Clock = utc_now, outbox: Outbox | None = None
    ) -> None:
        self.kinds = kinds
        self._clock = clock
        self._watching = threading.Lock()
        self._watchers: dict[UUID, list[Callable[[], None]]] = defaultdict(list)
        self.database = database
        self.outbox = outbox or Outbox(database)
        self.after_end: Callable[[JobRecord], None] = lambda _: None
        """Told of each job of this store that comes to its end, once that is on record. It must not raise."""

    def check(self) -> None:
        """Raise StorageError unless the database answers."""
        with self.database.reading() as session:
            session.execute(text("SELECT 1"))

    def create(
        self,
        plan: Mapping[str, Any],
        *,
        rig: str,
        label: str | None,
        key: str | None = None,
        job_id: UUID | None = None,
        kind: JobKind | None = None,
        parent: UUID | None = None,
    ) -> JobRecord:
        """Record a new job as queued and, in the same transaction, tie its idempotency key to it. kind : one of the
        store's, its first by default.
        """
        row = _new_row(job_id or uuid4(), kind or self.kinds[0], plan, rig=rig, label=label, parent=parent)
        return self._queued([row], key)[0]

    def create_series(
        self, plans: Sequence[Mapping[str, Any]], *, rig: str, label: str | None, parent: UUID, key: str | None = None
    ) -> list[JobRecord]:
        """Record jobs of one parent as queued, all of them or none; the key is that of the first."""
        kind = self.kinds[0]
        rows = [_new_row(uuid4(), kind, plan, rig=rig, label=label, parent=parent) for plan in plans]
        return self._queued(rows, key)

    def _queued(self, rows: Sequence[JobRow], key: str | None) -> list[JobRecord]:
        with self.database.changing() as session:
            for row in rows:
                row.state, row.created_at, row.stage, row.pinned = JobState.QUEUED, self._now(), "waiting", False
                session.add(row)
                session.flush()
                _append(session, row, "state", {"state": row.state, "time": row.created_at})
            if key is not None and (held := session.get(KeyRow, key)) is not None:
                held.job_id = rows[0].id
            made = [record_of(row) for row in rows]
        self.wake(EVERY_JOB, *{record.parent for record in made})
        return made

    def restore(
        self,
        job_id: UUID,
        plan: Mapping[str, Any],
        summary: Mapping[str, Any],
        *,
        rig: str,
        label: str | None,
        created_at: datetime,
        started_at: datetime,
        fault: JobFailure | None = None,
        parent: UUID | None = None,
    ) -> None:
        """Put a job that ended on record again. How it went is not known any more; its end is taken for now. Whether it
        was pinned is not known either: it is pinned. fault : why it failed, None where it succeeded.
        """
        row = _new_row(job_id, self.kinds[0], plan, rig=rig, label=label, parent=parent)
        row.state, row.created_at, row.stage, row.pinned = JobState.SUCCEEDED, stamp(created_at), "", True
        row.started_at = stamp(started_at)
        with self.database.changing() as session:
            session.add(row)
            session.flush()
            self._close_row(session, row, JobState.SUCCEEDED if fault is None else JobState.FAILED, fault, summary)

    def get(self, job_id: UUID) -> JobRecord:
        """Return a job. Raises JobNotFoundError."""
        with self.database.reading() as session:
            return record_of(self._find(session, job_id))

    def page(self, *, before: int | None, limit: int) -> Sequence[JobRecord]:
        """Return up to `limit` jobs, newest first, whose number is below `before`."""
        query = select(JobRow).where(JobRow.kind.in_(self.kinds)).order_by(JobRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(JobRow.number < before)
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query)]

    def unfinished(self) -> Sequence[JobRecord]:
        """Return the jobs that are in no final state, oldest first."""
        running = [state for state in JobState if not state.final]
        query = select(JobRow).where(JobRow.kind.in_(self.kinds), JobRow.state.in_(running)).order_by(JobRow.number)
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query)]

    def finished(self) -> Sequence[JobRecord]:
        """Return the jobs that are in a final state, newest first."""
        running = [state for state in JobState if not state.final]
        query = select(JobRow).where(JobRow.kind.in_(self.kinds), JobRow.state.not_in(running))
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query.order_by(JobRow.number.desc()))]

    def of(self, *parents: UUID) -> dict[UUID, list[JobRecord]]:
        """Return the jobs of each parent, oldest first; without a parent named, those of all that have one."""
        query = select(JobRow).where(JobRow.kind.in_(self.kinds), JobRow.parent.is_not(None)).order_by(JobRow.number)
        if parents:
            query = query.where(JobRow.parent.in_(map(str, parents)))
        found: dict[UUID, list[JobRecord]] = defaultdict(list)
        with self.database.reading() as session:
            for row in session.scalars(query):
                found[UUID(row.parent)].append(record_of(row))
        return found

    def replan(self, job_id: UUID, plan: Mapping[str, Any]) -> JobRecord:
        """Record that a job is asked for something else, now that more is known. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.plan = dict(plan)
            return record_of(row)

    def attempts(self, job_id: UUID) -> int:
        """How often the computing part of a job was begun."""
        states = [event.data["state"] for event in self.events(job_id, after=0) if event.kind == "state"]
        return states.count(JobState.COMPUTING)

    def pin(self, job_id: UUID, *, pinned: bool) -> JobRecord:
        """Have a job kept by every retention, or not any more. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.pinned = pinned
            return record_of(row)

    def states(self) -> dict[UUID, JobState]:
        """Return the state of every job on record."""
        with self.database.reading() as session:
            query = select(JobRow.id, JobRow.state).where(JobRow.kind.in_(self.kinds))
            return {UUID(found): JobState(state) for found, state in session.execute(query)}

    def advance(self, job_id: UUID, state: JobState) -> datetime:
        """Record that a running job entered another running state, and return when."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.state = state
            now = self._now()
            row.started_at = row.started_at or now
            _append(session, row, "state", {"state": state, "time": now})
        self._wake(job_id, row.parent)
        return datetime.fromisoformat(now)

    def progress(self, job_id: UUID, progress: JobProgress) -> None:
        """Record how far a running job is. Where that cannot be had at once it is refused: the next will be told."""
        self._tell(job_id, "progress", progress.as_json(), progress)

    def file_made(self, job_id: UUID, name: str) -> None:
        """Record that a file of a running job can be fetched. Refused as `progress` is."""
        self._tell(job_id, "file", {"name": name})

    def captured(self, job_id: UUID) -> None:
        """Record that a running job needs the rig no longer. Refused as `progress` is."""
        self._tell(job_id, "captured", {"time": self._now()})

    def _tell(self, job_id: UUID, kind: str, data: dict[str, Any], at: JobProgress | None = None) -> None:
        with self.database.changing(passing=True) as session:
            row = self._find(session, job_id)
            if at is not None:
                row.stage, row.fraction, row.detail = at.stage, at.fraction, at.detail
            _append(session, row, kind, {**data, "state": row.state})
        self._wake(job_id, row.parent)

    def finish(
        self,
        job_id: UUID,
        state: JobState,
        *,
        fault: JobFailure | None = None,
        summary: Mapping[str, Any] | None = None,
    ) -> bool:
        """Record a final state. The first one stands: returns False, and changes nothing, for a finished job."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            if JobState(row.state).final:
                return False
            self._close_row(session, row, state, fault, summary)
            ended = record_of(row)
            self.outbox.ended(session, ended)
        self._wake(job_id, row.parent)
        self.after_end(ended)
        return True

    def lose_files(self, job_id: UUID, fault: JobFailure) -> None:
        """Record that a finished job's files are gone."""
        with self.database.changing() as session:
            self._close_row(session, self._find(session, job_id), JobState.FAILED, fault, None)

    def delete(self, job_id: UUID) -> None:
        """Forget a job and its events. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            session.delete(row)
        # Whoever waits for its next event would wait for ever.
        self._wake(job_id, row.parent)

    def delete_of(self, parent: UUID) -> None:
        """Forget the jobs of a parent that is gone."""
        with self.database.changing() as session:
            session.execute(delete(JobRow).where(JobRow.kind.in_(self.kinds), JobRow.parent == str(parent)))
        self.wake(parent)

    def prune(self, keep: int) -> None:
        """Forget the oldest finished jobs, so that `keep` are left."""
        query = select(JobRow).where(JobRow.kind.in_(self.kinds)).order_by(JobRow.number.desc()).offset(keep)
        with self.database.changing() as session:
            for row in session.scalars(query):
                if JobState(row.state).final:
                    session.delete(row)

    def events(self, job_id: UUID, *, after: int) -> Sequence[JobEvent]:
        """Return a job's events whose number is above `after`, in order."""
        query = (
            select(EventRow).where(EventRow.job_id == str(job_id), EventRow.number > after).order_by(EventRow.number)
        )
        with self.database.reading() as session:
            return [JobEvent(row.number, row.kind, row.data, job_id) for row in session.scalars(query)]

    def events_of(self, parent: UUID, *, after: int) -> Sequence[JobEvent]:
        """Return the events of all jobs of a parent whose number is above `after`, in order."""
        query = (
            select(EventRow)
            .join(JobRow, JobRow.id == EventRow.job_id)
            .where(JobRow.kind.in_(self.kinds), JobRow.parent == str(parent), EventRow.id > after)
            .order_by(EventRow.id)
        )
        with self.database.reading() as session:
            return [JobEvent(row.id, row.kind, row.data, UUID(row.job_id)) for row in session.scalars(query)]

    def last_event_of(self, parent: UUID) -> int:
        """Return the number of the newest event of all jobs of a parent, 0 before the first."""
        events = select(func.max(EventRow.id)).join(JobRow, JobRow.id == EventRow.job_id)
        with self.database.reading() as session:
            found = session.scalar(events.where(JobRow.kind.in_(self.kinds), JobRow.parent == str(parent)))
        return found or 0

    def last_event(self, job_id: UUID) -> int:
        """Return the number of a job's newest event. Raises JobNotFoundError."""
        with self.database.reading() as session:
            return self._find(session, job_id).last_event

    def watch(self, job_id: UUID, wake: Callable[[], None]) -> Callable[[], None]:
        """Have `wake` called, from any thread, after each new event of a job, of any job of a parent, or of all jobs,
        and after a deletion. Returns the call that ends it.
        """
        with self._watching:
            self._watchers[job_id].append(wake)

        def unwatch() -> None:
            with self._watching:
                self._watchers[job_id].remove(wake)
                if not self._watchers[job_id]:
                    del self._watchers[job_id]

        return unwatch

    def _find(self, session: Session, job_id: UUID) -> JobRow:
        row = session.scalar(select(JobRow).where(JobRow.id == str(job_id), JobRow.kind.in_(self.kinds)))
        if row is None:
            message = f"No {self.kinds[0]} {job_id} is on record here. {_LISTED.get(self.kinds[0], '')}".rstrip()
            raise JobNotFoundError(message)
        return row

    def _close_row(
        self,
        session: Session,
        row: JobRow,
        state: JobState,
        fault: JobFailure | None,
        summary: Mapping[str, Any] | None,
    ) -> None:
        row.state = state
        row.finished_at = row.finished_at or self._now()
        row.summary = None if summary is None else dict(summary)
        if state is JobState.SUCCEEDED:
            row.stage, row.fraction, row.detail = "done", 1.0, ""
        if fault is not None:
            row.failure_code, row.failure_message = fault.code, fault.message
        error = None if fault is None else {"code": fault.code, "message": fault.message}
        _append(session, row, "state", {"state": state, "time": row.finished_at, "error": error})
        self.outbox.closed(session, record_of(row))

    def _now(self) -> str:
        return stamp(self._clock())

    def wake(self, *followed: UUID | None) -> None:
        """Have those look again who `watch` one of these."""
        with self._watching:
            watchers = [wake for each in followed if each is not None for wake in self._watchers.get(each, ())]
        for wake in watchers:
            wake()

    def _wake(self, job_id: UUID, parent: str | None) -> None:
        self.wake(EVERY_JOB, job_id, None if parent is None else UUID(parent))


def _new_row(
    job_id: UUID, kind: JobKind, plan: Mapping[str, Any], *, rig: str, label: str | None, parent: UUID | None
) -> JobRow:
    """A job that nothing has happened to; where it stands is for the caller to say."""
    return JobRow(
        id=str(job_id),
        kind=kind,
        parent=None if parent is None else str(parent),
        label=label,
        rig=rig,
        plan=dict(plan),
        fraction=0.0,
        detail="",
        last_event=0,
        requested_by=actor(),
    )


def _append(session: Session, row: JobRow, kind: str, data: dict[str, Any]) -> None:
    row.last_event += 1
    session.add(EventRow(job_id=row.id, number=row.last_event, kind=kind, data=data))


def unfinished_ids(database: Database) -> set[str]:
    """The jobs of every kind that are in no final state."""
    running = [state for state in JobState if not state.final]
    with database.reading() as session:
        return set(session.scalars(select(JobRow.id).where(JobRow.state.in_(running))))
