"""Notices that wait to be sent, in the service's database: each is on record with what it tells of, or neither is."""

from __future__ import annotations

import json
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
from slrig.jobs.copies import Copies
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, JobRecord, JobState, reference, stamp, utc_now
from slrig.jobs.tables import NoticeRow

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
    """What waits for each receiver, from old to new. Any thread may call.

    rig : the name that notices bear. wanted : the kinds that each receiver wants, by its name; all others are let go.
    most : may wait for one; the oldest make room. `news` is set when one more waits, `dropped` counts those that were
    never sent. copies : takes every job that ends, for a catalogue; None where there is none.
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
        self._wanted = wanted or {}
        self._clock = clock
        self._most = most
        self.news = {receiver: threading.Event() for receiver in self._wanted}
        self.dropped = 0
        self.copies = copies

    def put(self, session: Session, kind: NoticeKind, words: str, /, **members: Mapping[str, Any]) -> None:
        """Have a notice sent once the session's changes are kept. words : what it says to people, but for the rig."""
        notice_id, at = f"msg_{uuid4().hex}", stamp(self._clock())
        body = {"id": notice_id, "kind": kind, "at": at, "rig": self._rig, "words": f"rig '{self._rig}': {words}"}
        # Those of receivers that are no longer in the settings wait for as long, in case these come back.
        old = NoticeRow.at < stamp(self._clock() - KEPT_FOR)
        session.execute(delete(NoticeRow).where(NoticeRow.receiver.not_in(self._wanted), old))
        for receiver in (name for name, kinds in self._wanted.items() if kind in kinds):
            session.add(NoticeRow(receiver=receiver, id=notice_id, at=at, kind=kind, body={**body, **members}))
            numbers = select(NoticeRow.number).where(NoticeRow.receiver == receiver).order_by(NoticeRow.number.desc())
            surplus = NoticeRow.number <= numbers.offset(self._most).limit(1).scalar_subquery()
            self._drop(session, receiver, surplus, f"more than {self._most} wait")
            event.listen(session, "after_commit", lambda _, news=self.news[receiver]: news.set(), once=True)

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

    def closed(self, session: Session, job: JobRecord) -> None:
        """Have a catalogue know of a job in its final state, and of each change of that."""
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
            limit = stamp(self._clock() - KEPT_FOR)
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
        """How many wait, and for how many seconds the oldest does."""
        query = select(func.count(), func.min(NoticeRow.at)).where(NoticeRow.receiver == receiver)
        with self.database.reading() as session:
            count, oldest = session.execute(query).one()
        if count == 0:
            return 0, 0.0
        return count, max((self._clock() - datetime.fromisoformat(oldest)).total_seconds(), 0.0)

    def _drop(self, session: Session, receiver: str, which: ColumnElement[bool], cause: str) -> None:
        query = delete(NoticeRow).where(NoticeRow.receiver == receiver, which).returning(NoticeRow.id)
        if gone := list(session.scalars(query)):
            self.dropped += len(gone)
            _log.error("notices were dropped", receiver=receiver, count=len(gone), first=gone[0], cause=cause)
