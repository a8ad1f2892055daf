"""Every table of the service's database. The migrations in `slrig.jobs.migrations` make them; a test holds them equal.

Times are ISO 8601 text in UTC, which sorts as it reads.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import JSON, Boolean, Float, ForeignKey, Index, Integer, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from slrig.failure import JobFailure
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState


class Base(DeclarativeBase):
    """Holds the metadata."""


class JobRow(Base):
    """One job of any kind. parent : the calibration or the acceptance test that it belongs to, if it belongs to one.
    pinned : no retention removes it. requested_by : the name of the key, or the schedule, that asked for it.
    """

    __tablename__ = "job"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
    kind: Mapped[str] = mapped_column(String(16))
    parent: Mapped[str | None] = mapped_column(String(36))
    state: Mapped[str] = mapped_column(String(16))
    label: Mapped[str | None] = mapped_column(String(200))
    rig: Mapped[str] = mapped_column(String(200))
    plan: Mapped[dict[str, Any]] = mapped_column(JSON)
    created_at: Mapped[str] = mapped_column(String(32))
    started_at: Mapped[str | None] = mapped_column(String(32))
    finished_at: Mapped[str | None] = mapped_column(String(32))
    stage: Mapped[str] = mapped_column(String(64))
    fraction: Mapped[float] = mapped_column(Float)
    detail: Mapped[str] = mapped_column(String)
    failure_code: Mapped[str | None] = mapped_column(String(64))
    failure_message: Mapped[str | None] = mapped_column(String)
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    last_event: Mapped[int] = mapped_column(Integer)
    pinned: Mapped[bool] = mapped_column(Boolean)
    requested_by: Mapped[str | None] = mapped_column(String(80))

    __table_args__ = (
        Index("ix_job_kind_state", "kind", "state"),
        Index("ix_job_parent", "parent"),
        {"sqlite_autoincrement": True},
    )


class EventRow(Base):
    """One event of one job; `number` counts from 1 within the job, `id` rises over the events of all jobs."""

    __tablename__ = "event"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"))
    number: Mapped[int] = mapped_column(Integer)
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = (UniqueConstraint("job_id", "number", name="uq_event_number"), {"sqlite_autoincrement": True})


class KeyRow(Base):
    """One idempotency key, with the kind of request that it came with. `job_id` is empty while the first request is
    being answered.

    No foreign key: a job may be deleted before its key expires, and a late repeat must not start it again.
    """

    __tablename__ = "idempotency_key"

    key: Mapped[str] = mapped_column(String(400), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    job_id: Mapped[str | None] = mapped_column(String(36))
    created_at: Mapped[str] = mapped_column(String(32))


class AuditRow(Base):
    """One request that changed something, or tried to, and who sent it from where."""

    __tablename__ = "audit"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    at: Mapped[str] = mapped_column(String(32))
    who: Mapped[str] = mapped_column(String(80))
    address: Mapped[str] = mapped_column(String(64))
    method: Mapped[str] = mapped_column(String(16))
    path: Mapped[str] = mapped_column(String(400))
    status: Mapped[int] = mapped_column(Integer)
    made: Mapped[str] = mapped_column(String(400))

    __table_args__ = ({"sqlite_autoincrement": True},)


class NoticeRow(Base):
    """One notice that waits to be sent to one receiver; `number` is their order, `id` what it is known by there."""

    __tablename__ = "notice"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    receiver: Mapped[str] = mapped_column(String(16))
    id: Mapped[str] = mapped_column(String(36))
    at: Mapped[str] = mapped_column(String(32))
    kind: Mapped[str] = mapped_column(String(32))
    body: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = ({"sqlite_autoincrement": True},)


class CopyRow(Base):
    """One finished job that a catalogue has not taken yet; `number` is the order in which they ended."""

    __tablename__ = "job_copy"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    at: Mapped[str] = mapped_column(String(32))
    job_id: Mapped[str] = mapped_column(String(36))
    body: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = ({"sqlite_autoincrement": True},)


class ScheduleRow(Base):
    """One schedule."""

    __tablename__ = "schedule"

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    label: Mapped[str | None] = mapped_column(String(200))
    cron: Mapped[str] = mapped_column(String(200))
    time_zone: Mapped[str] = mapped_column(String(64))
    task: Mapped[str] = mapped_column(String(16))
    options: Mapped[dict[str, Any]] = mapped_column(JSON)
    grace_s: Mapped[float] = mapped_column(Float)
    retry_s: Mapped[float] = mapped_column(Float)
    catch_up: Mapped[bool] = mapped_column(Boolean)
    enabled: Mapped[bool] = mapped_column(Boolean)
    created_at: Mapped[str] = mapped_column(String(32))
    next_due: Mapped[str] = mapped_column(String(32))


class RunRow(Base):
    """One due time of a schedule. `owner` is the process that runs it or waits with it."""

    __tablename__ = "run"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    schedule_id: Mapped[str] = mapped_column(ForeignKey("schedule.id", ondelete="CASCADE"))
    due: Mapped[str] = mapped_column(String(32))
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str | None] = mapped_column(String)
    count: Mapped[int] = mapped_column(Integer)
    attempts: Mapped[int] = mapped_column(Integer)
    deadline: Mapped[str] = mapped_column(String(32))
    next_attempt: Mapped[str | None] = mapped_column(String(32))
    started_at: Mapped[str | None] = mapped_column(String(32))
    finished_at: Mapped[str | None] = mapped_column(String(32))
    owner: Mapped[str | None] = mapped_column(String(36))
    alive_until: Mapped[str | None] = mapped_column(String(32))
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        UniqueConstraint("schedule_id", "due", name="uq_run_due"),
        Index("ix_run_state", "state"),
        {"sqlite_autoincrement": True},
    )


class VerificationRow(Base):
    """What one verification, or one scan's redundancy, said of a calibration. `found` is `Verification.document`."""

    __tablename__ = "verification"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
    at: Mapped[str] = mapped_column(String(32))
    calibration: Mapped[str] = mapped_column(String(80))
    kind: Mapped[str] = mapped_column(String(16))
    state: Mapped[str] = mapped_column(String(16))
    reasons: Mapped[list[str]] = mapped_column(JSON)
    remedy: Mapped[str | None] = mapped_column(String)
    found: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = (
        Index("ix_verification_calibration", "calibration", "number"),
        Index("ix_verification_at", "at"),
        {"sqlite_autoincrement": True},
    )


def record_of(row: JobRow) -> JobRecord:
    """A row as the record that it is."""
    return JobRecord(
        number=row.number,
        id=UUID(row.id),
        kind=JobKind(row.kind),
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
        parent=None if row.parent is None else UUID(row.parent),
        requested_by=row.requested_by,
    )


def _moment(stamp: str | None) -> datetime | None:
    return None if stamp is None else datetime.fromisoformat(stamp)
