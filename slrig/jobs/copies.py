"""Finished jobs that wait to be copied to a catalogue, in the service's database: each waits from the moment that its
end is on record, and until the catalogue has it, whatever becomes of the job meanwhile.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import delete, event, func, select
from sqlalchemy.orm import Session

from slrig.jobs.database import Database
from slrig.jobs.records import Clock, JobRecord, JobState, stamp, utc_now
from slrig.jobs.tables import CopyRow, JobRow, record_of


@dataclass(frozen=True, slots=True)
class CatalogueCopy:
    """What a catalogue is told of a job that ended. number : the order in which jobs ended. job : JSON values."""

    number: int
    job: Mapping[str, Any]


class Copies:
    """What waits to be copied, from old to new. Any thread may call. `news` is set when one more waits."""

    def __init__(self, database: Database, *, clock: Clock = utc_now) -> None:
        self._database = database
        self._clock = clock
        self.news = threading.Event()

    def put(self, session: Session, job: JobRecord) -> None:
        """Have a job copied once the session's changes are kept."""
        session.add(CopyRow(at=stamp(self._clock()), job_id=str(job.id), body=told(job)))
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
        """How many wait, and for how many seconds the oldest does."""
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
        """What a catalogue is told of these, as far as they are on record, in the order in which they ended."""
        query = select(JobRow).where(JobRow.id.in_(ids)).order_by(JobRow.finished_at, JobRow.number)
        with self._database.reading() as session:
            return [told(record_of(row)) for row in session.scalars(query)]


def told(job: JobRecord) -> dict[str, Any]:
    """What a catalogue is told of a job, by the names of its columns.

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
