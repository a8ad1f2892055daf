"""The table of verifications. `slrig.verify.migrations` makes it; a test holds the two equal."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, Index, Integer, String
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Base(DeclarativeBase):
    """Holds the metadata."""


class VerificationRow(Base):
    """One verification. `at` is ISO 8601 text in UTC, which sorts as it reads; `look` is `Look.document`."""

    __tablename__ = "verification"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
    at: Mapped[str] = mapped_column(String(32))
    calibration: Mapped[str] = mapped_column(String(80))
    kind: Mapped[str] = mapped_column(String(16))
    state: Mapped[str] = mapped_column(String(16))
    reasons: Mapped[list[str]] = mapped_column(JSON)
    remedy: Mapped[str | None] = mapped_column(String)
    look: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = (
        Index("ix_verification_calibration", "calibration", "number"),
        Index("ix_verification_at", "at"),
        {"sqlite_autoincrement": True},
    )
