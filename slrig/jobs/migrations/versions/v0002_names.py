"""Who asked for each job, and who did what."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "records3"
down_revision = "records2"


def upgrade() -> None:
    """Add the column and the table."""
    op.add_column("job", sa.Column("requested_by", sa.String(80)))
    op.create_table(
        "audit",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("who", sa.String(80), nullable=False),
        sa.Column("address", sa.String(64), nullable=False),
        sa.Column("method", sa.String(16), nullable=False),
        sa.Column("path", sa.String(400), nullable=False),
        sa.Column("status", sa.Integer, nullable=False),
        sa.Column("made", sa.String(400), nullable=False),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    """Drop them."""
    op.drop_table("audit")
    op.drop_column("job", "requested_by")
