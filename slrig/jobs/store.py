"""The record of jobs of one kind, their events and idempotency keys, in the service's database."""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any
from uuid import UUID, uuid4

import structlog
from sqlalchemy import delete, select, text
from sqlalchemy.orm import Session

from slrig.errors import JobNotFoundError, KeyInFlightError, StorageError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, JobEvent, JobKind, JobProgress, JobRecord, JobState, require_same_body, utc_now
from slrig.jobs.tables import EventRow, JobRow, KeyRow

_log = structlog.get_logger(__name__)

KEY_LIFE_S = 24 * 3600.0
"""How long an idempotency key is remembered unless told otherwise."""

_LISTED = {
    JobKind.SCAN: "GET /scan lists those that are.",
    JobKind.VERIFICATION: "GET /rig/health/history lists past ones.",
}

_LEAST_STEP = 0.01
_PROGRESS_PATIENCE_S = 0.2  # the work waits meanwhile
_DETAIL_S = 2.0  # a person who looks on wants a sign every few seconds


class JobStore:
    """Jobs of one kind, their events and idempotency keys. Any thread of the one process that owns it may call."""

    def __init__(
        self, database: Database, kind: JobKind, *, clock: Clock = utc_now, key_life_s: float = KEY_LIFE_S
    ) -> None:
        self.kind = kind
        self._clock = clock
        self._key_life = timedelta(seconds=key_life_s)
        self._watching = threading.Lock()
        self._watchers: dict[UUID, list[Callable[[], None]]] = defaultdict(list)
        self.database = database

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
    ) -> JobRecord:
        """Record a new job as queued and, in the same transaction, tie its idempotency key to it."""
        row = JobRow(
            id=str(job_id or uuid4()),
            kind=self.kind,
            state=JobState.QUEUED,
            label=label,
            rig=rig,
            plan=dict(plan),
            created_at=self._now(),
            stage="waiting",
            fraction=0.0,
            detail="",
            last_event=0,
            pinned=False,
        )
        with self.database.changing() as session:
            session.add(row)
            session.flush()
            if key is not None and (held := session.get(KeyRow, key)) is not None:
                held.job_id = row.id
            _append(session, row, "state", {"state": row.state, "time": row.created_at})
            return _record(row)

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
    ) -> None:
        """Put a job that succeeded on record again. How it went is not known any more; its end is taken for now.
        Whether it was pinned is not known either: it is pinned.
        """
        row = JobRow(
            id=str(job_id),
            kind=self.kind,
            state=JobState.SUCCEEDED,
            label=label,
            rig=rig,
            plan=dict(plan),
            created_at=_stamp(created_at),
            started_at=_stamp(started_at),
            stage="",
            fraction=0.0,
            detail="",
            last_event=0,
            pinned=True,
        )
        with self.database.changing() as session:
            session.add(row)
            session.flush()
            self._close_row(session, row, JobState.SUCCEEDED, None, summary)

    def get(self, job_id: UUID) -> JobRecord:
        """Return a job. Raises JobNotFoundError."""
        with self.database.reading() as session:
            return _record(self._find(session, job_id))

    def page(self, *, before: int | None, limit: int) -> Sequence[JobRecord]:
        """Return up to `limit` jobs, newest first, whose number is below `before`."""
        query = select(JobRow).where(JobRow.kind == self.kind).order_by(JobRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(JobRow.number < before)
        with self.database.reading() as session:
            return [_record(row) for row in session.scalars(query)]

    def unfinished(self) -> Sequence[JobRecord]:
        """Return the jobs that are in no final state, oldest first."""
        running = [state for state in JobState if not state.final]
        query = select(JobRow).where(JobRow.kind == self.kind, JobRow.state.in_(running)).order_by(JobRow.number)
        with self.database.reading() as session:
            return [_record(row) for row in session.scalars(query)]

    def finished(self) -> Sequence[JobRecord]:
        """Return the jobs that are in a final state, newest first."""
        running = [state for state in JobState if not state.final]
        query = select(JobRow).where(JobRow.kind == self.kind, JobRow.state.not_in(running))
        with self.database.reading() as session:
            return [_record(row) for row in session.scalars(query.order_by(JobRow.number.desc()))]

    def pin(self, job_id: UUID, *, pinned: bool) -> JobRecord:
        """Have a job kept by every retention, or not any more. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.pinned = pinned
            return _record(row)

    def states(self) -> dict[UUID, JobState]:
        """Return the state of every job on record."""
        with self.database.reading() as session:
            query = select(JobRow.id, JobRow.state).where(JobRow.kind == self.kind)
            return {UUID(found): JobState(state) for found, state in session.execute(query)}

    def advance(self, job_id: UUID, state: JobState) -> datetime:
        """Record that a running job entered another running state, and return when."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.state = state
            now = self._now()
            row.started_at = row.started_at or now
            _append(session, row, "state", {"state": state, "time": now})
        self._wake(job_id)
        return datetime.fromisoformat(now)

    def progress(self, job_id: UUID, progress: JobProgress) -> None:
        """Record how far a running job is. Where that cannot be had at once it is refused: the next will be told."""
        with self.database.changing(patience_s=_PROGRESS_PATIENCE_S) as session:
            row = self._find(session, job_id)
            row.stage, row.fraction, row.detail = progress.stage, progress.fraction, progress.detail
            _append(session, row, "progress", {**progress.as_json(), "state": row.state})
        self._wake(job_id)

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
        self._wake(job_id)
        return True

    def lose_files(self, job_id: UUID, fault: JobFailure) -> None:
        """Record that a finished job's files are gone."""
        with self.database.changing() as session:
            self._close_row(session, self._find(session, job_id), JobState.FAILED, fault, None)

    def delete(self, job_id: UUID) -> None:
        """Forget a job and its events. Raises JobNotFoundError."""
        with self.database.changing() as session:
            session.delete(self._find(session, job_id))
        # Whoever waits for its next event would wait for ever.
        self._wake(job_id)

    def prune(self, keep: int) -> None:
        """Forget the oldest finished jobs, so that `keep` are left."""
        query = select(JobRow).where(JobRow.kind == self.kind).order_by(JobRow.number.desc()).offset(keep)
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
            return [JobEvent(row.number, row.kind, row.data) for row in session.scalars(query)]

    def last_event(self, job_id: UUID) -> int:
        """Return the number of a job's newest event. Raises JobNotFoundError."""
        with self.database.reading() as session:
            return self._find(session, job_id).last_event

    def watch(self, job_id: UUID, wake: Callable[[], None]) -> Callable[[], None]:
        """Have `wake` called, from any thread, after each new event of a job and after its deletion. Returns the
        call that ends it.
        """
        with self._watching:
            self._watchers[job_id].append(wake)

        def unwatch() -> None:
            with self._watching:
                self._watchers[job_id].remove(wake)
                if not self._watchers[job_id]:
                    del self._watchers[job_id]

        return unwatch

    def reserve_key(self, key: str, fingerprint: str) -> UUID | None:
        """Hold an idempotency key for a request, or return the job that the first request with it made.

        Raises
        ------
        KeyInFlightError
            The first request is still being answered.
        IdempotencyError
            The first request had another body.
        """
        with self.database.changing() as session:
            expired = _stamp(self._clock() - self._key_life)
            session.execute(delete(KeyRow).where(KeyRow.created_at < expired))
            held = session.get(KeyRow, key)
            if held is None:
                session.add(KeyRow(key=key, fingerprint=fingerprint, job_id=None, created_at=self._now()))
                return None
            require_same_body(held.fingerprint, fingerprint, made=self.kind)
            if held.job_id is None:
                message = "The first request with this Idempotency-Key is still being answered. Ask again in a second."
                raise KeyInFlightError(message)
            return UUID(held.job_id)

    def release_key(self, key: str) -> None:
        """Free a key whose request made no job, so that it may be tried again."""
        with self.database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.key == key, KeyRow.job_id.is_(None)))

    def release_keys(self) -> None:
        """Free every key whose request was cut off. For the start of the service, when none can be in flight."""
        with self.database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.job_id.is_(None)))

    def _find(self, session: Session, job_id: UUID) -> JobRow:
        row = session.scalar(select(JobRow).where(JobRow.id == str(job_id), JobRow.kind == self.kind))
        if row is None:
            message = f"No {self.kind} {job_id} is on record here. {_LISTED[self.kind]}"
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

    def _now(self) -> str:
        return _stamp(self._clock())

    def _wake(self, job_id: UUID) -> None:
        with self._watching:
            watchers = list(self._watchers.get(job_id, ()))
        for wake in watchers:
            wake()


class ProgressRecorder:
    """Takes progress from the work and records the steps worth telling: a new stage, a hundredth of the way, or another
    detail of a stage that goes on.
    """

    def __init__(
        self, store: JobStore, job_id: UUID, *, hidden: str, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`hidden` is left out of what is recorded."""
        self._now_s = now_s
        self._told_s = -math.inf
        self._hidden = hidden
        self._store = store
        self._job_id = job_id
        self._start, self._end = 0.0, 1.0
        self._told = JobProgress("", -1.0, "")

    def span(self, start: float, end: float) -> None:
        """Map the fractions that follow into start..end of the whole job."""
        self._start, self._end = start, end

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Take note, as `slrig.scan.plan.Progress` asks. A record that is refused fails no work: see the log."""
        overall = self._start + (self._end - self._start) * min(max(fraction, 0.0), 1.0)
        goes_on = detail != self._told.detail and self._now_s() - self._told_s >= _DETAIL_S
        if goes_on or stage != self._told.stage or overall - self._told.fraction >= _LEAST_STEP:
            self._told = JobProgress(stage, overall, detail.replace(self._hidden, ""))
            self._told_s = self._now_s()
            try:
                self._store.progress(self._job_id, self._told)
            except StorageError as error:
                _log.warning("how far a job is could not be recorded", job=str(self._job_id), cause=str(error))


def _append(session: Session, row: JobRow, kind: str, data: dict[str, Any]) -> None:
    row.last_event += 1
    session.add(EventRow(job_id=row.id, number=row.last_event, kind=kind, data=data))


def _record(row: JobRow) -> JobRecord:
    return JobRecord(
        number=row.number,
        id=UUID(row.id),
        state=JobState(row.state),
        label=row.label,
        rig=row.rig,
        plan=row.plan,
        created_at=datetime.fromisoformat(row.created_at),
        started_at=_moment(row.started_at),
        finished_at=_moment(row.finished_at),
        progress=JobProgress(row.stage, row.fraction, row.detail),
        fault=None if row.failure_code is None else JobFailure(row.failure_code, row.failure_message or ""),
        summary=row.summary,
        pinned=row.pinned,
    )


def _stamp(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds")


def _moment(stamp: str | None) -> datetime | None:
    return None if stamp is None else datetime.fromisoformat(stamp)
