"""Run by Alembic as a script: hands it the connection that `upgrade` was given."""

from __future__ import annotations

from alembic import context

from slrig.verify.migrations import VERSION_TABLE
from slrig.verify.tables import Base

if __name__ != "slrig.verify.migrations.env":
    # Under its module name it was imported, to be looked at; only Alembic's own loading of the file has a context.
    context.configure(
        connection=context.config.attributes["connection"],
        target_metadata=Base.metadata,
        render_as_batch=True,
        version_table=VERSION_TABLE,
    )
    with context.begin_transaction():
        context.run_migrations()
