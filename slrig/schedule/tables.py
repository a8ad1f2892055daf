"""The tables of schedules and runs. `slrig.schedule.migrations` makes them; a test holds the two equal."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, Boolean, Float, ForeignKey, Index, Integer, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Base(DeclarativeBase):
    """Holds the metadata."""


class ScheduleRow(Base):
    """One schedule. Times are ISO 8601 text in UTC, which sorts as it reads."""

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
    """One due time. `owner` is the process that runs it or waits with it."""

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
