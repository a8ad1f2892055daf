"""Changes of the scan store's tables, in order, run at every start of the service."""

from __future__ import annotations

from sqlalchemy import Connection

from slrig.jobs.database import run_migrations


def upgrade(connection: Connection) -> None:
    """Bring the database behind `connection` to the newest tables. Does nothing when it is there already."""
    run_migrations(connection, "slrig.scan:migrations")
