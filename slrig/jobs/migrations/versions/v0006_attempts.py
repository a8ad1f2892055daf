"""How often the worker began a job."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "records7"
down_revision = "records6"


def upgrade() -> None:
    """Make the column."""
    with op.batch_alter_table("job") as table:
        table.add_column(sa.Column("attempts", sa.Integer, nullable=False, server_default="0"))


def downgrade() -> None:
    """Drop it."""
    with op.batch_alter_table("job") as table:
        table.drop_column("attempts")
