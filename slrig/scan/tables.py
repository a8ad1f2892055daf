"""The tables of the scan store. Migrations in `slrig.scan.migrations` make them; a test holds the two equal."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, Float, ForeignKey, Index, Integer, String
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Base(DeclarativeBase):
    """Holds the metadata."""


class ScanRow(Base):
    """One scan. Times are ISO 8601 text in UTC, which sorts as it reads."""

    __tablename__ = "scan"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
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
    fault_kind: Mapped[str | None] = mapped_column(String(64))
    fault_message: Mapped[str | None] = mapped_column(String)
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    last_event: Mapped[int] = mapped_column(Integer)

    __table_args__ = (Index("ix_scan_state", "state"), {"sqlite_autoincrement": True})


class EventRow(Base):
    """One event of one scan; `number` counts from 1 within the scan."""

    __tablename__ = "event"

    scan_id: Mapped[str] = mapped_column(ForeignKey("scan.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)


class KeyRow(Base):
    """One idempotency key. `scan_id` is empty while the first request is being answered.

    No foreign key: a scan may be deleted before its key expires, and a late repeat must not start it again.
    """

    __tablename__ = "idempotency_key"

    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    scan_id: Mapped[str | None] = mapped_column(String(36))
    created_at: Mapped[str] = mapped_column(String(32))
