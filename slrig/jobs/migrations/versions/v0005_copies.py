"""Finished jobs that wait to be copied to a catalogue."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "records6"
down_revision = "records5"


def upgrade() -> None:
    """Make the table."""
    op.create_table(
        "job_copy",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("job_id", sa.String(36), nullable=False),
        sa.Column("body", sa.JSON, nullable=False),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    """Drop it."""
    op.drop_table("job_copy")
