"""Changes of the schedule's tables, in order, run at every start. They count apart from the scan store's."""

from __future__ import annotations

from sqlalchemy import Connection

from slrig.jobs.database import run_migrations

VERSION_TABLE = "alembic_version_schedule"


def upgrade(connection: Connection) -> None:
    """Bring the database behind `connection` to the newest tables. Does nothing when it is there already."""
    run_migrations(connection, "slrig.schedule:migrations")
