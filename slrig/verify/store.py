"""The history of a rig's health, in the service's database: every verification, and what was made of it then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import select
from sqlalchemy.orm import Session

from slrig.calibration.health import Health, HealthState, Verification, judge_health, verification_from_document
from slrig.jobs.database import Database
from slrig.jobs.tables import VerificationRow

_TREND = 60
_KEPT = 20_000


@dataclass(frozen=True, slots=True)
class VerificationRecord:
    """One verification on record. number : rises; calibration : the id of the solve, or a digest of the numbers.

    health : what was made of it and of those before it, at its time.
    """

    number: int
    id: UUID
    at: datetime
    calibration: str
    found: Verification
    health: Health

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "id": str(self.id),
            "at": self.at.astimezone(UTC).isoformat(timespec="milliseconds"),
            "calibration": self.calibration,
            "state": str(self.health.state),
            "reasons": list(self.health.reasons),
            "remedy": self.health.remedy,
            **self.found.document(),
        }


class HealthStore:
    """Verifications. Safe to call from any thread and from several processes."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def add(self, found: Verification, *, calibration: str, at: datetime) -> VerificationRecord:
        """Judge a verification with those before it of its calibration, and put it on record. Raises StorageError."""
        with self.database.changing() as session:
            newest = session.scalar(select(VerificationRow).order_by(VerificationRow.number.desc()).limit(1))
            query = select(VerificationRow).where(VerificationRow.calibration == calibration)
            # The first few too: a trend starts from them.
            first = list(session.scalars(query.order_by(VerificationRow.number).limit(3)))
            last = list(session.scalars(query.order_by(VerificationRow.number.desc()).limit(_TREND)))
            rows = {row.number: row for row in [*first, *reversed(last)]}
            health = judge_health([*(verification_from_document(rows[number].found) for number in sorted(rows)), found])
            row = VerificationRow(
                id=str(uuid4()), at=_stamp(at), calibration=calibration, kind=found.kind, state=str(health.state),
                reasons=list(health.reasons), remedy=health.remedy, found=found.document(),
            )  # fmt: skip
            session.add(row)
            session.flush()
            for old in session.scalars(select(VerificationRow).where(VerificationRow.number <= row.number - _KEPT)):
                session.delete(old)
            record = _record(row)
            self.added(session, None if newest is None else _record(newest), record)
            return record

    def added(self, session: Session, before: VerificationRecord | None, now: VerificationRecord) -> None:
        """Called in the transaction that puts a verification on record. before : the one before it, of any calibration.

        For those who tell of it.
        """

    def history(self, *, limit: int = 200, since: datetime | None = None) -> Sequence[VerificationRecord]:
        """Up to `limit` verifications, newest first, none older than `since`."""
        query = select(VerificationRow)
        if since is not None:
            query = query.where(VerificationRow.at >= _stamp(since))
        with self.database.reading() as session:
            return [_record(row) for row in session.scalars(query.order_by(VerificationRow.number.desc()).limit(limit))]

    def latest(self) -> VerificationRecord | None:
        """The newest verification; None where there is none."""
        return next(iter(self.history(limit=1)), None)

    def since_calibration(self, calibration: str, *, limit: int = 1000) -> Sequence[VerificationRecord]:
        """The verifications of one calibration, oldest first; the newest `limit` of them."""
        query = select(VerificationRow).where(VerificationRow.calibration == calibration)
        with self.database.reading() as session:
            rows = session.scalars(query.order_by(VerificationRow.number.desc()).limit(limit))
            return [_record(row) for row in rows][::-1]

    def health_of(self, calibration: str) -> Health:
        """What the last verification of a calibration came to; unknown where there was none."""
        found = self.since_calibration(calibration, limit=1)
        return found[-1].health if found else judge_health([])


def _record(row: VerificationRow) -> VerificationRecord:
    health = Health(HealthState(row.state), tuple(row.reasons), row.remedy)
    found, at = verification_from_document(row.found), datetime.fromisoformat(row.at)
    return VerificationRecord(row.number, UUID(row.id), at, row.calibration, found, health)


def _stamp(moment: datetime) -> str:
    # One zone and one length: the texts sort as the moments do.
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")
