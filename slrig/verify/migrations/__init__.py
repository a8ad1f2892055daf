"""Changes of the tables of verifications, in order, run at every start. They count apart from those of other parts."""

from __future__ import annotations

from sqlalchemy import Connection

from slrig.jobs.database import run_migrations

VERSION_TABLE = "alembic_version_health"


def upgrade(connection: Connection) -> None:
    """Bring the database behind `connection` to the newest tables. Does nothing when it is there already."""
    run_migrations(connection, "slrig.verify:migrations")
