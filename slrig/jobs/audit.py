"""Who did what: each request that changed something, or tried to, in the service's database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import delete, func, select

from slrig.jobs.database import Database
from slrig.jobs.records import Clock, stamp, utc_now
from slrig.jobs.tables import AuditRow

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
        """Up to `limit` entries, newest first, whose number is below `before`."""
        query = select(AuditRow).order_by(AuditRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(AuditRow.number < before)
        with self._database.reading() as session:
            return [
                AuditEntry(
                    row.number,
                    datetime.fromisoformat(row.at),
                    row.who,
                    row.address,
                    row.method,
                    row.path,
                    row.status,
                    row.made,
                )
                for row in session.scalars(query)
            ]
