"""Records of jobs, their events, idempotency keys, audit and notices in the service's database."""

from __future__ import annotations

import json
import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Any, Literal
from uuid import UUID, uuid4

import structlog
from sqlalchemy import ColumnElement, Select, case, delete, event, func, or_, select, text
from sqlalchemy.orm import Session

from slrig.config import NoticeKind
from slrig.errors import DamagedError, IdempotencyError, JobNotFoundError, KeyInFlightError
from slrig.failure import JobFailure
from slrig.jobs.database import (
    AuditRow,
    CopyRow,
    Database,
    EventRow,
    JobRow,
    KeyRow,
    NoticeRow,
    or_none,
    readable,
    record_of,
)
from slrig.jobs.records import (
    RIG_JOBS,
    UNREADABLE,
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


@dataclass(frozen=True, slots=True)
class CatalogueCopy:
    """A catalogue's entry of a job that ended. number : the order in which jobs ended. job : JSON values."""

    number: int
    job: Mapping[str, Any]


class Copies:
    """Jobs that wait to be copied, from old to new. Any thread may call. `news` is set when one more waits."""

    def __init__(self, database: Database, *, clock: Clock = utc_now) -> None:
        self._database = database
        self._clock = clock
        self.news = threading.Event()

    def put(self, session: Session, job: JobRecord) -> None:
        """Queue a copy of a job once the session's changes are committed."""
        session.add(CopyRow(at=stamp(self._clock()), job_id=str(job.id), body=catalogue_entry(job)))
        event.listen(session, "after_commit", lambda _: self.news.set(), once=True)

    def oldest(self, limit: int) -> Sequence[CatalogueCopy]:
        """Those to copy next."""
        with self._database.reading() as session:
            rows = session.scalars(select(CopyRow).order_by(CopyRow.number).limit(limit))
            return [CatalogueCopy(row.number, row.body) for row in rows]

    def taken(self, copies: Sequence[CatalogueCopy]) -> None:
        """Forget what the catalogue has."""
        with self._database.changing() as session:
            session.execute(delete(CopyRow).where(CopyRow.number.in_([each.number for each in copies])))

    def waiting(self) -> tuple[int, float]:
        """Number of waiting entries, and age of the oldest, s."""
        with self._database.reading() as session:
            count = session.scalar(select(func.count()).select_from(CopyRow)) or 0
            oldest = session.scalar(select(CopyRow.at).order_by(CopyRow.number).limit(1))
        age_s = 0.0 if oldest is None else (self._clock() - datetime.fromisoformat(oldest)).total_seconds()
        return count, max(age_s, 0.0)

    def ended(self) -> list[str]:
        """The ids of the jobs on record that ended and do not wait here, in the order in which they ended."""
        final, waiting = [state for state in JobState if state.final], select(CopyRow.job_id)
        ended = select(JobRow.id).where(JobRow.state.in_(final), JobRow.id.not_in(waiting))
        query = ended.order_by(JobRow.finished_at, JobRow.number)
        with self._database.reading() as session:
            return list(session.scalars(query))

    def of(self, ids: Collection[str]) -> Sequence[Mapping[str, Any]]:
        """Catalogue entries of these jobs, as far as they are on record, in the order in which they ended."""
        query = select(JobRow).where(JobRow.id.in_(ids)).order_by(JobRow.finished_at, JobRow.number)
        with self._database.reading() as session:
            return [catalogue_entry(record_of(row)) for row in session.scalars(query)]


def catalogue_entry(job: JobRecord) -> dict[str, Any]:
    """A catalogue's entry of a job, by the names of its columns.

    points, triangles : of a scan's mesh. sigma_mm : the median of its points' standard deviations.
    """
    summary = job.summary or {}
    mesh, computed = summary.get("mesh") or {}, summary.get("computed") or {}
    moments = {"created_at": job.created_at, "started_at": job.started_at, "finished_at": job.finished_at}
    return {
        "job": str(job.id),
        "rig": job.rig,
        "kind": str(job.kind),
        "label": job.label,
        "parent": None if job.parent is None else str(job.parent),
        "state": str(job.state),
        "requested_by": job.requested_by,
        **{name: None if moment is None else stamp(moment) for name, moment in moments.items()},
        "fault_code": None if job.fault is None else job.fault.code,
        "fault_message": None if job.fault is None else job.fault.message,
        "points": mesh.get("points"),
        "triangles": (mesh.get("figures") or {}).get("triangles"),
        "sigma_mm": (mesh.get("sigma_mm") or {}).get("p50"),
        "computed_where": computed.get("where"),
        "computed_host": computed.get("host"),
    }


MOST_WAITING = 10_000
KEPT_FOR = timedelta(hours=72)

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Notice:
    """One notice. number : their order; id : the same at each try, to each receiver; body : JSON values."""

    number: int
    id: str
    body: Mapping[str, Any]

    @property
    def content(self) -> bytes:
        """The body as it is sent: JSON in UTF-8."""
        return json.dumps(self.body, separators=(",", ":"), ensure_ascii=False).encode()


class Outbox:
    """Notices that wait for each receiver, from old to new. Any thread may call.

    rig : the name that notices bear. wanted : the kinds that each receiver wants, by its name; all others are dropped.
    most : may wait for one; the oldest make room. `news` is set when one more waits, `dropped` counts those that were
    never sent. clock : for their ages, which a jump of the system's clock must not change. copies : takes every job
    that ends, for a catalogue; None where there is none.
    """

    def __init__(
        self,
        database: Database,
        *,
        rig: str = "",
        wanted: Mapping[str, Collection[NoticeKind]] | None = None,
        clock: Clock = utc_now,
        most: int = MOST_WAITING,
        copies: Copies | None = None,
    ) -> None:
        self.database = database
        self._rig = rig
        self._wanted = dict(wanted or {})
        self.clock = clock
        self._most = most
        self.news = {receiver: threading.Event() for receiver in self._wanted}
        self.dropped = 0
        self.copies = copies

    @property
    def wanted(self) -> Mapping[str, Collection[NoticeKind]]:
        """The kinds that each receiver wants now."""
        return self._wanted

    def want(self, receiver: str, kinds: Collection[NoticeKind]) -> None:
        """From now on put what a receiver wants; with no kinds, put nothing for it, and forget what waits."""
        self.news.setdefault(receiver, threading.Event())
        # Another mapping: threads may be reading the one that there was.
        others = {name: wanted for name, wanted in self._wanted.items() if name != receiver}
        self._wanted = {**others, receiver: kinds} if kinds else others
        if not kinds:
            with self.database.changing() as session:
                session.execute(delete(NoticeRow).where(NoticeRow.receiver == receiver))

    def body(self, kind: NoticeKind | Literal["test"], text: str) -> dict[str, Any]:
        """Members of every notice. text : its message to people, without the rig."""
        words = f"rig '{self._rig}': {text}"
        return {"id": f"msg_{uuid4().hex}", "kind": kind, "at": stamp(self.clock()), "rig": self._rig, "words": words}

    def put(self, session: Session, kind: NoticeKind, text: str, /, **members: Mapping[str, Any]) -> None:
        """Queue a notice once the session's changes are committed. text : its message to people, without the rig."""
        body = self.body(kind, text)
        notice_id, at = body["id"], body["at"]
        # Notices of receivers that are no longer in the settings wait as long, in case these come back.
        old = NoticeRow.at < stamp(self.clock() - KEPT_FOR)
        session.execute(delete(NoticeRow).where(NoticeRow.receiver.not_in(self._wanted), old))
        for receiver in (name for name, kinds in self._wanted.items() if kind in kinds):
            session.add(NoticeRow(receiver=receiver, id=notice_id, at=at, kind=kind, body={**body, **members}))
            numbers = select(NoticeRow.number).where(NoticeRow.receiver == receiver).order_by(NoticeRow.number.desc())
            surplus = NoticeRow.number <= numbers.offset(self._most).limit(1).scalar_subquery()
            self._drop(session, receiver, surplus, f"more than {self._most} wait")
            event.listen(session, "after_commit", lambda _, news=self.news[receiver]: news.set(), once=True)

    def ended(self, session: Session, job: JobRecord) -> None:
        """Queue the notice of a job's end."""
        fault = None if job.fault is None else {"code": job.fault.code, "message": job.fault.message}
        more = "" if job.fault is None else f": {job.fault.message}"
        moments = {
            name: None if moment is None else stamp(moment)
            for name, moment in (("started_at", job.started_at), ("finished_at", job.finished_at))
        }
        found = {**reference(job), "state": str(job.state), "error": fault, "requested_by": job.requested_by, **moments}
        state = job.state if job.state in {JobState.SUCCEEDED, JobState.FAILED} else f"was {job.state}"
        self.put(session, "job.ended", f"{job.kind} {job.id} {state}{more}", job=found)

    def closed(self, session: Session, job: JobRecord) -> None:
        """Queue the copy of a job in its final state, and of each change of that."""
        if self.copies is not None:
            self.copies.put(session, job)

    def oldest(self, receiver: str) -> Notice | None:
        """The notice to send next. Drops those that have waited for too long."""
        while True:
            with self.database.reading() as session:
                waiting = select(NoticeRow).where(NoticeRow.receiver == receiver)
                row = session.scalar(waiting.order_by(NoticeRow.number).limit(1))
            if row is None:
                return None
            limit = stamp(self.clock() - KEPT_FOR)
            if row.at >= limit:
                return Notice(row.number, row.id, row.body)
            with self.database.changing() as session:
                hours = KEPT_FOR // timedelta(hours=1)
                self._drop(session, receiver, NoticeRow.at < limit, f"they have waited for {hours} hours")

    def sent(self, notice: Notice) -> None:
        """Forget a notice that its receiver has."""
        with self.database.changing() as session:
            session.execute(delete(NoticeRow).where(NoticeRow.number == notice.number))

    def waiting(self, receiver: str) -> tuple[int, float]:
        """Number of waiting entries, and age of the oldest, s."""
        query = select(func.count(), func.min(NoticeRow.at)).where(NoticeRow.receiver == receiver)
        with self.database.reading() as session:
            count, oldest = session.execute(query).one()
        if count == 0:
            return 0, 0.0
        return count, max((self.clock() - datetime.fromisoformat(oldest)).total_seconds(), 0.0)

    def _drop(self, session: Session, receiver: str, which: ColumnElement[bool], cause: str) -> None:
        query = delete(NoticeRow).where(NoticeRow.receiver == receiver, which).returning(NoticeRow.id)
        if gone := list(session.scalars(query)):
            self.dropped += len(gone)
            _log.error("notices were dropped", receiver=receiver, count=len(gone), first=gone[0], cause=cause)


_LISTED: dict[str, str] = {
    JobKind.SCAN: "GET /scan lists those that are.",
    JobKind.VERIFICATION: "GET /rig/health/history lists past ones.",
    JobKind.MODEL: "GET /model lists those that are.",
    **dict.fromkeys(RIG_JOBS, "GET /rig/examinations has the last one of each kind."),
}


KEPT_PROGRESS = 20
"""Number of finished jobs with events of progress still on record, for followers that are behind."""

EVERY_JOB = UUID(int=0)
"""Represents all jobs of a store where they are followed."""


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

    def page(
        self,
        *kinds: JobKind,
        before: int | None,
        limit: int,
        name: str | None = None,
        states: Collection[JobState] = (),
        since: datetime | None = None,
        until: datetime | None = None,
        rig: str | None = None,
        preset: str | None = None,
    ) -> Sequence[JobRecord]:
        """Return up to `limit` jobs, newest first, with numbers below `before`, that match.

        name : part of the label, upper or lower case, or the start of the id. since, until : when they were created,
        the latter excluded. rig, preset : by their names.
        """
        query = _jobs(*kinds).order_by(JobRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(JobRow.number < before)
        if name is not None:
            part = func.casefold(JobRow.label).contains(name.casefold(), autoescape=True)
            query = query.where(or_(part, JobRow.id.startswith(name.lower(), autoescape=True)))
        if states:
            query = query.where(JobRow.state.in_(states))
        if since is not None:
            query = query.where(JobRow.created_at >= stamp(since.astimezone(UTC)))
        if until is not None:
            query = query.where(JobRow.created_at < stamp(until.astimezone(UTC)))
        if rig is not None:
            query = query.where(JobRow.rig == rig)
        if preset is not None:
            # A damaged plan may not be JSON.
            found = case((func.json_valid(JobRow.plan), func.json_extract(JobRow.plan, "$.preset.name")))
            query = query.where(found == preset)
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
            for record in map(record_of, session.scalars(query)):
                if record.parent is not None:
                    found[record.parent].append(record)
        return found

    def replan(self, job_id: UUID, plan: Mapping[str, Any]) -> JobRecord:
        """Record a changed plan of a job, now that more is known. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            row.plan = dict(plan)
            return record_of(row)

    def attempts(self, job_id: UUID) -> int:
        """Number of times that the worker began a job. Raises JobNotFoundError."""
        with self.database.reading() as session:
            return self._find(session, job_id).attempts

    def begin_attempt(self, job_id: UUID) -> None:
        """Record that the worker begins a job. Raises JobNotFoundError, StorageError."""
        with self.database.changing() as session:
            self._find(session, job_id).attempts += 1

    def takes(self, job_id: UUID) -> int:
        """Number of times that a job was lined up to be computed, whether the worker began it or not."""
        states = [event.data.get("state") for event in self.events(job_id, after=0) if event.kind == "state"]
        return states.count(JobState.COMPUTING)

    def pin(self, job_id: UUID, *kinds: JobKind, pinned: bool) -> JobRecord:
        """Exempt a job from every retention, or not any more. Raises JobNotFoundError."""
        with self.database.changing() as session:
            row = self._find(session, job_id, *kinds)
            row.pinned = pinned
            return record_of(row)

    def rename(
        self, job_id: UUID, *kinds: JobKind, label: str | None, keep: Callable[[], None] = lambda: None
    ) -> JobRecord:
        """Give a job another label, or none. keep : has its files say so; what that raises leaves the label as it was.

        Raises JobNotFoundError.
        """
        with self.database.changing() as session:
            row = self._find(session, job_id, *kinds)
            row.label = label
            record = record_of(row)
            if record.state.final:
                self.outbox.closed(session, record)
            keep()
        self._wake(job_id, row.parent)
        return record

    def states(self, *kinds: JobKind) -> dict[UUID, JobState]:
        """Return the state of every job on record."""
        with self.database.reading() as session:
            query = select(JobRow.id, JobRow.state).where(JobRow.kind.in_(kinds or JobKind))
            rows = [(or_none(UUID, found), or_none(JobState, state)) for found, state in session.execute(query)]
        return {found: state or JobState.FAILED for found, state in rows if found is not None}

    def unreadable(self) -> Sequence[JobRecord]:
        """The jobs with unreadable rows; they are in a final state from now on. One without an id is forgotten."""
        with self.database.changing() as session:
            rows = [row for row in session.scalars(_jobs()) if record_of(row).fault == UNREADABLE]
            for row in rows:
                _log.error("the record of a job is damaged", number=row.number, job=row.id, kind=row.kind)
                if or_none(UUID, row.id) is None:
                    session.delete(row)
                row.state, row.failure_code, row.failure_message = JobState.FAILED, UNREADABLE.code, UNREADABLE.message
            return [record_of(row) for row in rows]

    def damaged(self) -> Mapping[JobKind, int]:
        """Number of jobs of each kind with a damaged record or damaged files."""
        query = select(JobRow.kind, func.count()).where(JobRow.failure_code == DamagedError.code).group_by(JobRow.kind)
        with self.database.reading() as session:
            return {JobKind(kind): count for kind, count in session.execute(query) if kind in set(JobKind)}

    def advance(self, job_id: UUID, state: JobState) -> datetime:
        """Record that a running job entered another running state, and return when."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            if JobState(row.state).final:
                # It is computed once more.
                row.finished_at = row.summary = row.failure_code = row.failure_message = None
                row.attempts = 0
            row.state = state
            now = self._now()
            row.started_at = row.started_at or now
            _append(session, row, "state", {"state": state, "time": now})
        self._wake(job_id, row.parent)
        return datetime.fromisoformat(now)

    def progress(self, job_id: UUID, progress: JobProgress) -> None:
        """Record a running job's progress. Refused where that cannot be had at once: the next will be recorded."""
        self._record(job_id, "progress", progress.as_json(), progress)

    def file_made(self, job_id: UUID, name: str) -> None:
        """Record that a file of a running job can be fetched. Refused as `progress` is."""
        self._record(job_id, "file", {"name": name})

    def captured(self, job_id: UUID) -> None:
        """Record that a running job needs the rig no longer. Refused as `progress` is."""
        self._record(job_id, "captured", {"time": self._now()})

    def _record(self, job_id: UUID, kind: str, data: dict[str, Any], at: JobProgress | None = None) -> None:
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
        """Record a final state. Only the first one counts: returns False, and changes nothing, for a finished job."""
        with self.database.changing() as session:
            row = self._find(session, job_id)
            if JobState(row.state).final:
                return False
            self._close_row(session, row, state, fault, summary)
            ended = record_of(row)
            self.outbox.ended(session, ended)
            # Later readers want to know how a job ended, not its progress at each moment.
            over = select(JobRow.id).where(JobRow.state.in_([each for each in JobState if each.final]))
            older = over.order_by(JobRow.number.desc()).offset(KEPT_PROGRESS).limit(KEPT_PROGRESS)
            session.execute(delete(EventRow).where(EventRow.kind == "progress", EventRow.job_id.in_(older)))
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
        # Those who wait for its next event would wait for ever.
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
        """Return a job's events with numbers above `after`, in order."""
        query = (
            select(EventRow).where(EventRow.job_id == str(job_id), EventRow.number > after).order_by(EventRow.number)
        )
        with self.database.reading() as session:
            return [JobEvent(row.number, row.kind, row.data, job_id) for row in session.scalars(query)]

    def events_of(self, parent: UUID, *, after: int) -> Sequence[JobEvent]:
        """Return the events of all jobs of a parent with numbers above `after`, in order."""
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
        """Return the first events of all jobs with numbers above `after`, at most `limit`, in order; their data name
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
        """Call `wake`, from any thread, after each new event of a job, of any job of a parent, or of all jobs, and
        after a deletion. Returns the call that ends it.
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
        row.failure_code, row.failure_message = (None, None) if fault is None else (fault.code, fault.message)
        error = None if fault is None else {"code": fault.code, "message": fault.message}
        _append(session, row, "state", {"state": state, "time": row.finished_at, "error": error})
        self.outbox.closed(session, record_of(row))

    def _now(self) -> str:
        return stamp(self._clock())

    def wake(self, *followed: UUID | None) -> None:
        """Call the watchers of these."""
        with self._watching:
            watchers = [wake for each in followed if each is not None for wake in self._watchers.get(each, ())]
        for wake in watchers:
            wake()

    def _wake(self, job_id: UUID, parent: str | None) -> None:
        self.wake(EVERY_JOB, job_id, or_none(UUID, parent))


def _jobs(*kinds: JobKind) -> Select[JobRow]:
    return select(JobRow).where(JobRow.kind.in_(kinds or JobKind))


def _new_row(
    job_id: UUID, kind: JobKind, plan: Mapping[str, Any], *, rig: str, label: str | None, parent: UUID | None
) -> JobRow:
    """A job without events; the caller sets its state."""
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


KEY_LIFE_S = 24 * 3600.0
"""Default time for which a key is remembered."""


class RequestKeys:
    """The keys on record. Any thread may call."""

    def __init__(self, database: Database, *, clock: Clock = utc_now, life_s: float = KEY_LIFE_S) -> None:
        self._database = database
        self._clock = clock
        self._life = timedelta(seconds=life_s)

    def reserve(self, key: str, fingerprint: str) -> UUID | None:
        """Hold a key for a request, or return what the first request with it made.

        Raises
        ------
        KeyInFlightError
            The first request is still being answered.
        IdempotencyError
            The first request had another body.
        """
        with self._database.changing() as session:
            expired = stamp(self._clock() - self._life)
            session.execute(delete(KeyRow).where(KeyRow.created_at < expired))
            held = session.get(KeyRow, key)
            if held is None:
                session.add(KeyRow(key=key, fingerprint=fingerprint, job_id=None, created_at=stamp(self._clock())))
                return None
            if held.fingerprint != fingerprint:
                message = (
                    "This Idempotency-Key was sent before with another request body. Use a new key for a new request, "
                    "or repeat the first one unchanged."
                )
                raise IdempotencyError(message)
            if held.job_id is None:
                message = "The first request with this Idempotency-Key is still being answered. Try again in a second."
                raise KeyInFlightError(message)
            return UUID(held.job_id)

    def tie(self, key: str, made: UUID) -> None:
        """Put on record what a request with a key made. A job is tied to its key by `JobStore.create`."""
        with self._database.changing() as session:
            if (held := session.get(KeyRow, key)) is not None:
                held.job_id = str(made)

    def release(self, key: str) -> None:
        """Free a key after a request that made nothing, so that it may be tried again."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.key == key, KeyRow.job_id.is_(None)))

    def release_all(self) -> None:
        """Free every key with a cut-off request. For the start of the service, when none can be in flight."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.job_id.is_(None)))


MOST_ENTRIES = 100_000
"""The oldest go when there are more: some 20 MB, a year of 270 requests a day."""

_PRUNE_EVERY = 1000


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One request. who : the name of the key. made : the path of what it made, "" where it made nothing."""

    number: int
    at: datetime
    who: str
    address: str
    method: str
    path: str
    status: int
    made: str


class Audit:
    """The record. Any thread may call."""

    def __init__(self, database: Database, *, clock: Clock = utc_now) -> None:
        self._database = database
        self._clock = clock

    def note(self, who: str, address: str, method: str, path: str, status: int, made: str) -> None:
        """Put a request on record. Raises StorageError."""
        row = AuditRow(
            at=stamp(self._clock()),
            who=who,
            address=address,
            method=method[:16],
            path=path[:400],
            status=status,
            made=made[:400],
        )
        with self._database.changing() as session:
            session.add(row)
            session.flush()
            if row.number % _PRUNE_EVERY == 0:
                newest = session.scalar(select(func.max(AuditRow.number))) or 0
                session.execute(delete(AuditRow).where(AuditRow.number <= newest - MOST_ENTRIES))

    def page(self, *, before: int | None, limit: int) -> Sequence[AuditEntry]:
        """Up to `limit` entries, newest first, with numbers below `before`."""
        query = select(AuditRow).order_by(AuditRow.number.desc()).execution_options(yield_per=limit)
        if before is not None:
            query = query.where(AuditRow.number < before)
        with self._database.reading() as session:
            return list(islice(readable(session.scalars(query), _audit_entry), limit))


def _audit_entry(row: AuditRow) -> AuditEntry:
    at = datetime.fromisoformat(row.at)
    return AuditEntry(row.number, at, row.who, row.address, row.method, row.path, row.status, row.made)
