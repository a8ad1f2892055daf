"""The record of jobs and their events, in the service's database."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import Select, delete, func, select, text
from sqlalchemy.orm import Session

from slrig.errors import JobNotFoundError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import (
    Clock,
    JobEvent,
    JobKind,
    JobProgress,
    JobRecord,
    JobState,
    actor,
    reference,
    stamp,
    utc_now,
)
from slrig.jobs.tables import EventRow, JobRow, KeyRow, record_of

_LISTED: dict[str, str] = {
    JobKind.SCAN: "GET /scan lists those that are.",
    JobKind.VERIFICATION: "GET /rig/health/history lists past ones.",
    JobKind.MODEL: "GET /model lists those that are.",
    **dict.fromkeys((JobKind.DOCTOR, JobKind.CONFORMANCE), "GET /rig/examinations has the last one."),
}


EVERY_JOB = UUID(int=0)
"""Stands for all jobs of a store where they are followed."""


class JobStore:
    """The jobs of all kinds. Any thread of the one process that owns it may call.

    outbox : where notices of their ends are put; without one no notice is sent. kinds, of any method : which are meant;
    all where none is named.
    """

    def __init__(self, database: Database, *, clock: Clock = utc_now, outbox: Outbox | None = None) -> None:
        self.ended = False
        """Whether nothing more will happen in this run of the service."""
        self._clock = clock
        self._watching = threading.Lock()
        self._watchers: dict[UUID, list[Callable[[], None]]] = defaultdict(list)
        self.database = database
        self.outbox = outbox or Outbox(database)
        self.after_end: Callable[[JobRecord], None] = lambda _: None
        """Called with each job that comes to its end, once that is on record. It must not raise."""

    def check(self) -> None:
        """Raise StorageError unless the database answers."""
        with self.database.reading() as session:
            session.execute(text("SELECT 1"))

    def create(self, plan: Mapping[str, Any], **options: Any) -> JobRecord:
        """Record one new job, with the options of `create_all`."""
        return self.create_all([plan], **options)[0]

    def create_all(
        self,
        plans: Sequence[Mapping[str, Any]],
        *,
        kind: JobKind,
        rig: str,
        label: str | None = None,
        parent: UUID | None = None,
        key: str | None = None,
        job_id: UUID | None = None,
    ) -> list[JobRecord]:
        """Record new jobs as waiting, all of them or none, and in the same transaction tie an idempotency key to the
        first. job_id : of a single one; a new id by default.
        """
        rows = [_new_row(job_id or uuid4(), kind, plan, rig=rig, label=label, parent=parent) for plan in plans]
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

    def restore(self, kept: JobRecord) -> None:
        """Put a job that ended on record again, as its files say. Its end is taken for now. Whether it was pinned is
        not known: it is pinned.
        """
        row = _new_row(kept.id, kept.kind, kept.plan, rig=kept.rig, label=kept.label, parent=kept.parent)
        row.state, row.created_at, row.stage, row.pinned = JobState.SUCCEEDED, stamp(kept.created_at), "", True
        row.started_at = stamp(kept.started_at or kept.created_at)
        state = JobState.SUCCEEDED if kept.fault is None else JobState.FAILED
        with self.database.changing() as session:
            session.add(row)
            session.flush()
            self._close_row(session, row, state, kept.fault, kept.summary)

    def get(self, job_id: UUID, *kinds: JobKind) -> JobRecord:
        """Return a job. Raises JobNotFoundError, also where it is of another kind."""
        with self.database.reading() as session:
            return record_of(self._find(session, job_id, *kinds))

    def page(self, *kinds: JobKind, before: int | None, limit: int) -> Sequence[JobRecord]:
        """Return up to `limit` jobs, newest first, whose number is below `before`."""
        query = _jobs(*kinds).order_by(JobRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(JobRow.number < before)
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query)]

    def unfinished(self, *kinds: JobKind) -> Sequence[JobRecord]:
        """Return the jobs that are in no final state, oldest first."""
        running = [state for state in JobState if not state.final]
        query = _jobs(*kinds).where(JobRow.state.in_(running)).order_by(JobRow.number)
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query)]

    def finished(self, *kinds: JobKind) -> Sequence[JobRecord]:
        """Return the jobs that are in a final state, newest first."""
        running = [state for state in JobState if not state.final]
        query = _jobs(*kinds).where(JobRow.state.not_in(running))
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query.order_by(JobRow.number.desc()))]

    def of(self, parent: UUID) -> list[JobRecord]:
        """Return the jobs of a parent, oldest first."""
        query = select(JobRow).where(JobRow.parent == str(parent)).order_by(JobRow.number)
        with self.database.reading() as session:
            return [record_of(row) for row in session.scalars(query)]

    def by_parent(self, *kinds: JobKind) -> dict[UUID, list[JobRecord]]:
        """Return the jobs of every parent, oldest first."""
        query = _jobs(*kinds).where(JobRow.parent.is_not(None)).order_by(JobRow.number)
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

    def pin(self, job_id: UUID, *kinds: JobKind, pinned: bool) -> JobRecord:
        """Have a job kept by every retention, or not any more. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id, *kinds)
            row.pinned = pinned
            return record_of(row)

    def states(self, *kinds: JobKind) -> dict[UUID, JobState]:
        """Return the state of every job on record."""
        with self.database.reading() as session:
            query = select(JobRow.id, JobRow.state).where(JobRow.kind.in_(kinds or JobKind))
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
            session.execute(delete(JobRow).where(JobRow.parent == str(parent)))
        self.wake(parent)

    def prune(self, kind: JobKind, keep: int) -> None:
        """Forget the oldest finished jobs of a kind, so that `keep` are left."""
        query = _jobs(kind).order_by(JobRow.number.desc()).offset(keep)
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
            .where(JobRow.parent == str(parent), EventRow.id > after)
            .order_by(EventRow.id)
        )
        with self.database.reading() as session:
            return [JobEvent(row.id, row.kind, row.data, UUID(row.job_id)) for row in session.scalars(query)]

    def last_event_of(self, parent: UUID) -> int:
        """Return the number of the newest event of all jobs of a parent, 0 before the first."""
        events = select(func.max(EventRow.id)).join(JobRow, JobRow.id == EventRow.job_id)
        with self.database.reading() as session:
            found = session.scalar(events.where(JobRow.parent == str(parent)))
        return found or 0

    def events_of_all(self, *, after: int, limit: int) -> Sequence[JobEvent]:
        """Return the first events of all jobs whose number is above `after`, at most `limit`, in order; their data name
        the job: see `reference`. Numbers rise over all jobs, with gaps: those of a job go with it.
        """
        query = select(EventRow, JobRow).join(JobRow, JobRow.id == EventRow.job_id).where(EventRow.id > after)
        with self.database.reading() as session:
            return [
                JobEvent(event.id, event.kind, {**event.data, "job": reference(record_of(job))}, UUID(job.id))
                for event, job in session.execute(query.order_by(EventRow.id).limit(limit))
            ]

    def last_event_of_all(self) -> int:
        """Return the number of the newest event, 0 before the first."""
        with self.database.reading() as session:
            return session.scalar(select(func.max(EventRow.id))) or 0

    def end(self) -> None:
        """Nothing more will happen in this run of the service."""
        self.ended = True
        self.wake(EVERY_JOB)

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

    def _find(self, session: Session, job_id: UUID, *kinds: JobKind) -> JobRow:
        row = session.scalar(_jobs(*kinds).where(JobRow.id == str(job_id)))
        if row is None:
            kind = kinds[0] if kinds else "job"
            message = f"No {kind} {job_id} is on record here. {_LISTED.get(kind, '')}".rstrip()
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


def _jobs(*kinds: JobKind) -> Select[JobRow]:
    return select(JobRow).where(JobRow.kind.in_(kinds or JobKind))


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
