"""Notices that wait to be sent, in the service's database: each is on record with what it tells of, or neither is."""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any
from uuid import uuid4

import structlog
from sqlalchemy import ColumnElement, delete, event, func, select
from sqlalchemy.orm import Session

from slrig.config import NoticeKind
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, JobRecord, JobState, reference, stamp, utc_now
from slrig.jobs.tables import NoticeRow

MOST_WAITING = 10_000
KEPT_FOR = timedelta(hours=72)

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Notice:
    """One notice. number : their order; id : the same at each try; body : JSON values."""

    number: int
    id: str
    body: Mapping[str, Any]


class Outbox:
    """What waits, from old to new. Any thread may call.

    rig : the name that notices bear. kinds : of notices that are wanted; all others are let go. most : may wait; the
    oldest make room. `news` is set when one more waits, `dropped` counts those that were never sent.
    """

    def __init__(
        self,
        database: Database,
        *,
        rig: str = "",
        kinds: Collection[NoticeKind] = (),
        clock: Clock = utc_now,
        most: int = MOST_WAITING,
    ) -> None:
        self.database = database
        self._rig = rig
        self._kinds = frozenset(kinds)
        self._clock = clock
        self._most = most
        self.news = threading.Event()
        self.dropped = 0

    def put(self, session: Session, kind: NoticeKind, words: str, /, **members: Mapping[str, Any]) -> None:
        """Have a notice sent once the session's changes are kept. words : what it says to people, but for the rig."""
        if kind not in self._kinds:
            return
        notice_id, at = f"msg_{uuid4().hex}", stamp(self._clock())
        body = {"id": notice_id, "kind": kind, "at": at, "rig": self._rig, "words": f"rig '{self._rig}': {words}"}
        row = NoticeRow(id=notice_id, at=at, kind=kind, body={**body, **members})
        session.add(row)
        session.flush()
        # Numbers rise by one, and only the oldest are ever taken away.
        self._drop(session, NoticeRow.number <= row.number - self._most, f"more than {self._most} wait")
        event.listen(session, "after_commit", lambda _: self.news.set(), once=True)

    def ended(self, session: Session, job: JobRecord) -> None:
        """Tell of a job that comes to its end."""
        fault = None if job.fault is None else {"code": job.fault.code, "message": job.fault.message}
        more = "" if job.fault is None else f": {job.fault.message}"
        moments = {
            name: None if moment is None else stamp(moment)
            for name, moment in (("started_at", job.started_at), ("finished_at", job.finished_at))
        }
        told = {**reference(job), "state": str(job.state), "error": fault, "requested_by": job.requested_by, **moments}
        state = job.state if job.state in {JobState.SUCCEEDED, JobState.FAILED} else f"was {job.state}"
        self.put(session, "job.ended", f"{job.kind} {job.id} {state}{more}", job=told)

    def oldest(self) -> Notice | None:
        """The notice to send next. Drops those that have waited for too long."""
        while True:
            with self.database.reading() as session:
                row = session.scalar(select(NoticeRow).order_by(NoticeRow.number).limit(1))
            if row is None:
                return None
            limit = stamp(self._clock() - KEPT_FOR)
            if row.at >= limit:
                return Notice(row.number, row.id, row.body)
            with self.database.changing() as session:
                self._drop(
                    session, NoticeRow.at < limit, f"they have waited for {KEPT_FOR // timedelta(hours=1)} hours"
                )

    def sent(self, notice: Notice) -> None:
        """Forget a notice that its receiver has."""
        with self.database.changing() as session:
            session.execute(delete(NoticeRow).where(NoticeRow.number == notice.number))

    def waiting(self) -> tuple[int, float]:
        """How many wait, and for how many seconds the oldest does."""
        with self.database.reading() as session:
            count, oldest = session.execute(select(func.count(), func.min(NoticeRow.at))).one()
        if count == 0:
            return 0, 0.0
        return count, max((self._clock() - datetime.fromisoformat(oldest)).total_seconds(), 0.0)

    def _drop(self, session: Session, which: ColumnElement[bool], cause: str) -> None:
        gone = list(session.scalars(delete(NoticeRow).where(which).returning(NoticeRow.id)))
        if gone:
            self.dropped += len(gone)
            _log.error("notices were dropped", count=len(gone), first=gone[0], cause=cause)
