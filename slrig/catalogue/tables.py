"""The catalogue's tables, on Postgres and on SQLite. The migrations in `slrig.catalogue.versions` make them; a test
holds them equal.
"""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import BigInteger, DateTime, Dialect, Float, Identity, Index, Integer, String, TypeDecorator
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Moment(TypeDecorator[datetime]):
    """A moment, in UTC. SQLite has no time zones, and keeps it without."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """See `TypeDecorator`."""
        found = None if value is None else value.astimezone(UTC)
        return found if found is None or dialect.name != "sqlite" else found.replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """See `TypeDecorator`."""
        return value if value is None or dialect.name != "sqlite" else value.replace(tzinfo=UTC)


NUMBER = BigInteger().with_variant(Integer, "sqlite")
"""Of rows. SQLite counts by itself in columns of type INTEGER alone."""


class CatalogueBase(DeclarativeBase):
    """Holds the metadata."""


class RigRow(CatalogueBase):
    """How a rig was at `seen_at`, by the catalogue's own clock. All else is by the rig's.

    origin : machine and data folder of the service that writes the row. words : what it does, or why it cannot.
    waiting : for the rig. computing : scans whose frames are computed with, or wait for that. uncopied : jobs that
    ended and are not here yet. health : of its calibration, by what was verified last at `verified_at`.
    """

    __tablename__ = "rig"

    name: Mapped[str] = mapped_column(String, primary_key=True)
    origin: Mapped[str] = mapped_column(String)
    host: Mapped[str] = mapped_column(String)
    version: Mapped[str] = mapped_column(String)
    started_at: Mapped[datetime] = mapped_column(Moment)
    seen_at: Mapped[datetime] = mapped_column(Moment)
    state: Mapped[str] = mapped_column(String)
    words: Mapped[str] = mapped_column(String)
    waiting: Mapped[int] = mapped_column(Integer)
    computing: Mapped[int] = mapped_column(Integer)
    uncopied: Mapped[int] = mapped_column(Integer)
    health: Mapped[str] = mapped_column(String)
    health_message: Mapped[str] = mapped_column(String)
    verified_at: Mapped[datetime | None] = mapped_column(Moment)


class FinishedJobRow(CatalogueBase):
    """One job that ended; `number` is the order in which they came, of one rig the order in which they ended. What
    each column holds `slrig.jobs.copies.told` says.
    """

    __tablename__ = "finished_job"

    number: Mapped[int] = mapped_column(NUMBER, Identity(), primary_key=True)
    job: Mapped[str] = mapped_column(String, unique=True)
    rig: Mapped[str] = mapped_column(String)
    kind: Mapped[str] = mapped_column(String)
    label: Mapped[str | None] = mapped_column(String)
    parent: Mapped[str | None] = mapped_column(String)
    state: Mapped[str] = mapped_column(String)
    requested_by: Mapped[str | None] = mapped_column(String)
    created_at: Mapped[datetime] = mapped_column(Moment)
    started_at: Mapped[datetime | None] = mapped_column(Moment)
    finished_at: Mapped[datetime] = mapped_column(Moment)
    fault_code: Mapped[str | None] = mapped_column(String)
    fault_message: Mapped[str | None] = mapped_column(String)
    points: Mapped[int | None] = mapped_column(BigInteger)
    triangles: Mapped[int | None] = mapped_column(BigInteger)
    sigma_mm: Mapped[float | None] = mapped_column(Float)
    computed_where: Mapped[str | None] = mapped_column(String)
    computed_host: Mapped[str | None] = mapped_column(String)

    __table_args__ = (
        Index("ix_finished_job_rig", "rig", "kind", "number"),
        Index("ix_finished_job_finished", "kind", "finished_at"),
    )
