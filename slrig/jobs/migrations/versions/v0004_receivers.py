"""Notices to more than one receiver."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "records5"
down_revision = "records4"


def upgrade() -> None:
    """Name the receiver, which was the webhook."""
    op.add_column("notice", sa.Column("receiver", sa.String(16), nullable=False, server_default="webhook"))


def downgrade() -> None:
    """Drop it."""
    op.drop_column("notice", "receiver")
