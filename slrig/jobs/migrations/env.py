"""Run by Alembic as a script: hands it what `slrig.jobs.database.upgrade` was given."""

from __future__ import annotations

from alembic import context

if __name__ != "slrig.jobs.migrations.env":
    # Under its module name it was imported, to be looked at; only Alembic's own loading of the file has a context.
    context.configure(
        connection=context.config.attributes["connection"],
        target_metadata=context.config.attributes["tables"],
        render_as_batch=True,
    )
    with context.begin_transaction():
        context.run_migrations()
