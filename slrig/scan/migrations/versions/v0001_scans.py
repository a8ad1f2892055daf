"""Scans, their events, and idempotency keys."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make the three tables."""
    op.create_table(
        "scan",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String(36), nullable=False, unique=True),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("label", sa.String(200)),
        sa.Column("rig", sa.String(200), nullable=False),
        sa.Column("plan", sa.JSON, nullable=False),
        sa.Column("created_at", sa.String(32), nullable=False),
        sa.Column("started_at", sa.String(32)),
        sa.Column("finished_at", sa.String(32)),
        sa.Column("stage", sa.String(64), nullable=False),
        sa.Column("fraction", sa.Float, nullable=False),
        sa.Column("detail", sa.String, nullable=False),
        sa.Column("fault_kind", sa.String(64)),
        sa.Column("fault_message", sa.String),
        sa.Column("summary", sa.JSON),
        sa.Column("last_event", sa.Integer, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_scan_state", "scan", ["state"])
    op.create_table(
        "event",
        sa.Column("scan_id", sa.String(36), sa.ForeignKey("scan.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("data", sa.JSON, nullable=False),
    )
    op.create_table(
        "idempotency_key",
        sa.Column("key", sa.String(255), primary_key=True),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("scan_id", sa.String(36)),
        sa.Column("created_at", sa.String(32), nullable=False),
    )


def downgrade() -> None:
    """Drop them."""
    op.drop_table("idempotency_key")
    op.drop_table("event")
    op.drop_index("ix_scan_state", "scan")
    op.drop_table("scan")
