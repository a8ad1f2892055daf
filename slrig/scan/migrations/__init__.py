"""Changes of the scan store's tables, in order, run at every start of the service."""

from __future__ import annotations

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection


def upgrade(connection: Connection) -> None:
    """Bring the database behind `connection` to the newest tables. Does nothing when it is there already."""
    config = Config()
    config.set_main_option("script_location", "slrig.scan:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
